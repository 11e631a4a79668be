"""Free positions alone, from the file to what others read: temperature, certificate, verification."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from openpyxl import load_workbook

from bench.readings.csv import write_csv
from bench.readings.table import make_readings
from bench.validation.paper_bench import U0, K
from tests.support.commands import printed, refused
from tests.support.honest_runs import free_forces


@pytest.fixture
def free(bench):
    """The file free.csv: 24 positions of the paper's block at 21 °C, noise 100 µV (seed 8)."""
    rng = np.random.default_rng(8)
    signal = free_forces(24, rng) @ K.T + U0 + rng.normal(0, 1e-4, (24, 3))
    table = make_readings(
        ["F"] * 24, [1] * 24, range(1, 25), np.full(24, np.nan), signal, temperature_c=np.full(24, 21.0)
    )
    write_csv(table, Path("free.csv"))
    return Path("free.csv")


def test_their_temperature_is_stated_and_no_certificate_is_made(bench, free):
    printed(bench("import", free, "--name", "free"))
    assert json.loads(printed(bench("calibrate", "free", "--json", "-")))["temperature_c"] == 21.0
    refused(bench("certificate", "free", "--draft"), "free positions alone determine nine")


def test_without_verification_points_verify_says_so(bench, free):
    refused(bench("verify", free), "the readings have no verification point (installation V)")
    printed(bench("calibrate", free, "--json", "unit.json"))
    refused(bench("verify", free, "--coefficients", "unit.json"), "the readings have no verification point")


OPEN = {"Kyx", "Kzx", "Kzy", "Nyx", "Nzx", "Nzy", "alpha_xy", "alpha_xz", "alpha_yz"}


def test_what_they_do_not_determine_has_no_uncertainty_anywhere(bench, free):
    """K is the paper's, turned until it is upper triangular (QR by numpy), with the signs of the bench file."""
    status, out, _ = bench("calibrate", free, "--json", "free.json")
    assert status == 0
    assert out.count("by convention, not determined") == 3
    told = json.loads(Path("free.json").read_text())
    assert told["by_convention"] == {"zero": ["Kyx", "Kzx", "Kzy"], "signs": "bench file"}
    _, r = np.linalg.qr(K[::-1].T)
    upper = r.T[::-1, ::-1]
    upper = upper * np.sign(np.diag(upper)) * np.sign(np.diag(K))
    for (i, j), value in np.ndenumerate(upper):
        name = f"K{'xyz'[i]}{'xyz'[j]}"
        one = told["coefficients"][name]
        if name in OPEN:
            assert (one["value"], one["u"], one["U"], one["u_readings"]) == (0.0, None, None, None)
            assert told["coefficients_per_ms2"][name]["u"] is None
        else:
            assert abs(one["value"] - value) < 4 * one["u"]
    printed(bench("coefficients", "free.json", "--json", "block.json"))
    block = json.loads(Path("block.json").read_text())
    rows = block["coefficients"] | block["inverse"]["values"] | block["misalignments"]["values"]
    assert {name for name, row in rows.items() if row["u"] is None and row["U"] is None} == OPEN
    assert all(row["u"] > 0 for row in (rows | block["intrinsic"]["values"]).values() if row["u"] is not None)
    assert "are those of the bench file" in block["convention"]
    # the angles and sensitivities do not depend on the convention
    gram = K @ K.T
    for i, name in enumerate(("Sx", "Sy", "Sz")):
        own = block["intrinsic"]["values"][name]
        assert abs(own["value"] - np.sqrt(gram[i, i])) < 4 * own["u"]


@pytest.mark.parametrize("form", ["c", "csv", "json", "excel", "px4", "ardupilot", "kalibr"])
def test_every_form_says_what_is_by_convention(bench, free, form):
    printed(bench("calibrate", free, "--json", "free.json"))
    printed(bench("coefficients", "free.json", "--as", form, "--out", "forms"))
    (file,) = Path("forms").iterdir()
    if form == "excel":
        book = load_workbook(file)
        cells = {row[0].value: row[2].value for row in book["inverse"].iter_rows()}
        assert [cells[name] for name in ("Nyx", "Nzx", "Nzy")] == ["by convention, not determined"] * 3
        text = " ".join(str(cell.value) for row in book["about"].iter_rows() for cell in row)
    else:
        text = file.read_text()
    assert "by convention, not determined" in text
    assert "are those of the bench file" in text
    if form == "c":
        assert "/* Nyx: by convention, not determined */" in text
        assert "/* Nzx, Nzy: by convention, not determined */" in text
    if form == "csv":
        table = {row[0]: row[2:4] for row in csv.reader(text.splitlines()) if len(row) == 5}
        assert {name for name, own in table.items() if own == ["by convention, not determined"] * 2} == OPEN


def test_signals_without_nominal_scale_factors_have_positive_ones(bench):
    rng = np.random.default_rng(8)
    signal = 1e3 * (free_forces(24, rng) @ K.T + U0 + rng.normal(0, 1e-4, (24, 3)))
    table = make_readings(["F"] * 24, [1] * 24, range(1, 25), np.full(24, np.nan), signal, unit="counts")
    write_csv(table, Path("counts.csv"))
    told = json.loads(printed(bench("calibrate", "counts.csv", "--json", "-")))
    assert told["by_convention"]["signs"] == "positive"
    assert all(told["coefficients"][name]["value"] > 0 for name in ("Kxx", "Kyy", "Kzz"))
