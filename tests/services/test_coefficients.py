"""Coefficients of a file are taken with a covariance that may be one, and with nothing else."""

import copy
import json

import numpy as np
import pytest

from bench.model.geometry import COEFFICIENTS
from bench.services.coefficients import impossible, read_coefficients
from bench.services.errors import Refused

SIZE = len(COEFFICIENTS)


@pytest.fixture
def good():
    factor = np.random.default_rng(14).standard_normal((SIZE, 20)) * np.logspace(-6, -3, SIZE)[:, None]
    return {
        "unit": "V",
        "g_m_s2": 9.81,
        "per": "g",
        "coefficients": {name: {"value": 1.0 + k, "u": 0.1} for k, name in enumerate(COEFFICIENTS)},
        "order": list(COEFFICIENTS),
        "covariance": (factor @ factor.T).tolist(),
        "noise": {"reading_v": 1e-6},
    }


@pytest.fixture
def read(tmp_path):
    def of(data):
        (tmp_path / "c.json").write_text(
            data if isinstance(data, str) else json.dumps(data), encoding="utf-8"
        )
        return read_coefficients(tmp_path / "c.json", "V")

    return of


def test_a_result_in_any_order_is_taken(read, good):
    straight = read(good).covariance
    turned = good["order"][::-1]
    flipped = np.array(good["covariance"])[::-1, ::-1]
    assert np.array_equal(
        read({**good, "order": turned, "covariance": flipped.tolist()}).covariance, straight
    )


def _entry(i, j, factor):
    def change(data):
        data["covariance"][i][j] *= factor

    return change


def _both(i, j, value):
    def change(data):
        c = np.array(data["covariance"])
        c[i, j] = c[j, i] = value * np.sqrt(c[i, i] * c[j, j])
        data["covariance"] = c.tolist()

    return change


def _indefinite(data):
    """Three correlations of -0.9: each may be, together they cannot."""
    c = np.diag(np.diag(data["covariance"]))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        c[i, j] = c[j, i] = -0.9 * np.sqrt(c[i, i] * c[j, j])
    data["covariance"] = c.tolist()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (_entry(0, 1, 1 + 1e-6), "not symmetric"),
        (_entry(3, 3, -1.0), "negative variance"),
        (_both(2, 5, 1.001), "beyond 1"),
        (_indefinite, "combination of coefficients a negative variance"),
        (_entry(4, 4, 0.0), "beyond 1"),
        (lambda d: d["covariance"][0].__setitem__(0, "1e-6"), "not a number"),
        (lambda d: d["covariance"][0].__setitem__(0, True), "not a number"),
        (lambda d: d["covariance"][0].__setitem__(0, float("nan")), "text of another kind"),
        (lambda d: d["covariance"][0].__setitem__(0, float("inf")), "text of another kind"),
        (lambda d: d["covariance"][0].__setitem__(0, 10**400), "not a number"),
        (lambda d: d["covariance"][0].__setitem__(0, None), "not a number"),
        (lambda d: d["covariance"].append([0.0] * SIZE), "12 coefficients"),
        (lambda d: d["covariance"].pop(), "not a result"),
        (lambda d: d["covariance"][3].pop(), "not a result"),
        (lambda d: d["order"].append("Kxx"), "12 coefficients"),
        (lambda d: d.update(order="Kxx"), "not a result"),
        (lambda d: d["coefficients"]["Kxx"].update(value="2"), "not a number"),
        (lambda d: d["coefficients"]["Kxx"].update(value=float("nan")), "text of another kind"),
        (lambda d: d["noise"].update(reading_v=-1.0), "negative"),
        (lambda d: d.update(unit=["V"]), "unit"),
        (lambda d: d.update(unit="mV"), "the coefficients are in mV/g"),
        (lambda d: d.update(per="m/s^2"), "per"),
        (lambda d: d.update(simulated="false"), "simulated"),
    ],
)
def test_what_no_calibration_gives_is_refused(read, good, change, why):
    changed = copy.deepcopy(good)
    change(changed)
    with pytest.raises(Refused, match=why):
        read(changed)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "[]", "3", "null", '{"unit": "V", "unit": "V"}', "{}", "", "\x00"]
)
def test_what_is_no_result_is_refused(read, text):
    with pytest.raises(Refused, match="not a result"):
        read(text)


@pytest.mark.parametrize("readings", [12, 1000, 100_000])
def test_rounding_alone_is_no_reason(readings):
    """A nearly singular covariance as a sum of many products, added in the order that rounds worst."""
    rng = np.random.default_rng(readings)
    factor = rng.standard_normal((SIZE, readings)) * np.logspace(-9, 3, SIZE)[:, None]
    factor[1] = factor[0] * (1 + 1e-15)
    summed = np.einsum("ik,jk->ij", factor, factor)
    assert impossible(summed) == ""
    assert impossible(summed[::-1, ::-1]) == ""


def test_the_noise_of_each_channel_and_shared_errors_are_read(read, good):
    """An estimate with 12 degrees of freedom, 8 of them of the noise, is widened by sqrt(8/6)."""
    shared = {"what": "pass", "channels": "y", "size": 2e-4, "unit": "V", "dof": 4.0, "p": 1e-5}
    noise = {"reading_v": 2e-6, "x": 1e-6, "y": 1e-6, "z": 3e-6, "setting_arcsec": 2.0, "dof": 12.0}
    taken = read({**good, "noise": {**noise, "shared": [shared]}})
    assert taken.channel_noise == pytest.approx(np.array([1e-6, 1e-6, 3e-6]) * np.sqrt(8 / 6))
    assert [(one.what, one.channels, one.size, one.dof) for one in taken.shared] == [("pass", "y", 2e-4, 4.0)]
    assert read(good).channel_noise is None
