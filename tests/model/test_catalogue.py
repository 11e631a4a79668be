"""The catalogue as a whole: complete, told in full, written once for simulation and fit."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from bench.calibration.design import FIXED, make_problem
from bench.config.model_file import load_model, write_model_file
from bench.model import AppliedEffect, Block, Conditions, ForwardModel, Installation
from bench.model.effects import CATALOGUE, GROUP, Catalogue
from bench.readings.table import make_readings, scan_order
from tests.support.effect_bench import BLOCK, effect

PROMISED = [
    "quadratic_nonlinearity", "cubic_nonlinearity", "odd_quadratic_nonlinearity", "scale_asymmetry",
    "cross_coupling", "cross_quadratic", "bias_asymmetry", "hysteresis", "thermal_bias", "thermal_scale",
    "thermal_nonlinearity", "thermal_misalignment", "warm_up",
    "bias_drift", "scale_drift", "turn_on_shift", "scale_step", "thermal_settling", "supply_sensitivity",
    "axis_tilt", "zero_offset", "mounting_error", "mounting_offset", "mounting_roll", "head_eccentricity",
    "head_ellipticity", "head_graduation", "backlash", "axis_wobble", "bracket_tilt", "foundation_tilt",
    "block_slip", "mounting_creep", "head_zero_shift", "meters_exchanged", "voltmeter_nonlinearity",
    "voltmeter_drift", "voltmeter_warm_up", "voltmeter_thermal_gain", "voltmeter_thermal_offset",
    "voltmeter_move", "reference_supply", "range_offset", "channel_crosstalk", "voltmeter_gain",
    "reference_step", "voltmeter_offset", "thermal_emf", "wrong_gravity",
]  # fmt: skip
"""Names that model files may hold: none of them may disappear."""
NAMES = list(CATALOGUE)

PER_PASS = {"block_slip", "head_zero_shift", "meters_exchanged", "scale_step", "reference_step"}
PER_MOUNT = PER_PASS | {
    "axis_tilt", "zero_offset", "turn_on_shift", "mounting_error", "mounting_offset", "mounting_roll",
    "bracket_tilt", "mounting_creep",
}  # fmt: skip

LOOK_BACK = {
    "thermal_scale", "hysteresis", "thermal_bias", "turn_on_shift", "thermal_settling", "mounting_creep",
    "channel_crosstalk", "voltmeter_thermal_gain", "voltmeter_thermal_offset",
}  # fmt: skip


def some_values(chosen, rng):
    """Values of a plausible size; a shape from the middle of its grid."""
    values = {}
    for p in chosen.parameters:
        drawn = rng.normal(0, p.plausible, 3 if p.per_channel else ())
        values[p.name] = np.asarray(p.grid[len(p.grid) // 2] if p.is_shape else drawn)
    return values


def test_the_catalogue_has_every_promised_effect_with_its_flags():
    assert set(PROMISED) <= set(CATALOGUE)
    assert {name for name, e in CATALOGUE.items() if e.per_mount} == PER_MOUNT
    assert {name for name, e in CATALOGUE.items() if e.per_pass} == PER_PASS
    assert {name for name, e in CATALOGUE.items() if e.needs_history} == LOOK_BACK


def test_every_effect_says_what_it_is():
    said = [e.sentence for e in CATALOGUE.values()]
    assert len(set(said)) == len(said)
    for e in CATALOGUE.values():
        assert e.shown_by
        assert e.subsystem
        assert any(not p.is_shape for p in e.parameters)
        for p in e.parameters:
            assert p.plausible > 0
            assert p.si_per_unit > 0
            assert p.default in p.grid if p.is_shape else p.default == 0


@pytest.mark.parametrize("name", NAMES)
def test_what_is_not_there_adds_nothing(name):
    conditions, stand = rich()
    plain = ForwardModel(INSTALLATIONS).readings(BLOCK, conditions, stand)
    got = ForwardModel(INSTALLATIONS, (AppliedEffect(CATALOGUE[name], {}),)).readings(
        BLOCK, conditions, stand
    )
    np.testing.assert_array_equal(got, plain)


def test_every_effect_is_written_and_read_back(tmp_path):
    rng = np.random.default_rng(5)
    effects = []
    for chosen in CATALOGUE.values():
        values = some_values(chosen, rng)
        u = {p.name: np.abs(values[p.name]) / 7 for p in chosen.parameters if not p.is_shape}
        mountings = ("2", "1/3 pass 2") if chosen.per_pass else ("2", "1/3") if chosen.per_mount else ()
        effects.append(AppliedEffect(chosen, values, u=u, installations=mountings))
    path = tmp_path / "all.yaml"
    write_model_file(path, "all", effects)
    read = load_model(path).applied_effects()
    assert [e.effect.name for e in read] == NAMES
    for was, now in zip(effects, read, strict=True):
        assert now.installations == was.installations
        assert set(now.u) == set(was.u)
        for p in was.effect.parameters:
            assert now.values[p.name] == pytest.approx(was.values[p.name], rel=1e-13, abs=0)
            assert now.u.get(p.name) == (None if p.is_shape else pytest.approx(was.u[p.name], rel=1e-13))


# --- in a fit ---------------------------------------------------------------------------------------

AXES = {"1": ("x", "y", "z"), "2": ("-x", "z", "y"), "3": ("y", "z", "x"), "1r": ("-x", "-y", "z")}
INSTALLATIONS = {label: Installation.from_axes(label, axes, 0.5) for label, axes in AXES.items()}
MOUNTED = ("1", "2", "3", "1r", "1")


def rich():
    """Five mountings, 24 angles both ways in each, a temperature that goes up and down, two scan orders."""
    turn = np.radians(np.arange(0, 360, 15))
    mountings = range(len(MOUNTED))
    n = 48 * len(MOUNTED)
    time_s = 70.0 * np.arange(n) + 1500.0 * np.repeat(mountings, 48)
    conditions = Conditions.of(
        [label for label in MOUNTED for _ in range(48)],
        np.tile(np.concatenate([turn, turn[::-1]]), len(MOUNTED)),
        series=[1 + (k == 4) for k in mountings for _ in range(48)],
        direction=([1] * 24 + [-1] * 24) * len(MOUNTED),
        time_s=time_s,
        temperature_c=20.0 + np.sin(time_s / 2900.0) + 0.4 * np.cos(time_s / 800.0),
        scan_order=np.array([(0, 1, 2), (2, 1, 0), (1, 0, 2)])[np.arange(n) // 12 % 3],
        meter_c=23.0 + np.cos(time_s / 2100.0),
        supply_v=np.stack([0.1 * np.sin(time_s / k) for k in (1100.0, 1700.0, 2300.0)], axis=1),
    )
    return conditions, np.zeros((len(conditions.mounts), 5))


HIDDEN = {"voltmeter_gain", "voltmeter_offset", "thermal_emf", "wrong_gravity", "reference_supply"}
"""Effects that are the same as other scale factors and biases, whatever the run, or act at a reference alone."""


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_fit_returns_the_truth_where_the_run_determines_it(name):
    """Without noise; the unknowns of `make_problem` by repeated linear least squares, from zero."""
    conditions, stand = rich()
    chosen = CATALOGUE[name]
    mountings = ("2",) if chosen.per_mount else ()
    values = some_values(chosen, np.random.default_rng(NAMES.index(name)))
    truth = AppliedEffect(chosen, values, installations=mountings)
    signal = ForwardModel(INSTALLATIONS, (truth,)).readings(BLOCK, conditions, stand)
    held = {p.name: values[p.name] for p in chosen.parameters if not p.is_size}
    model = ForwardModel(INSTALLATIONS, (AppliedEffect(chosen, held, installations=mountings),))
    problem = make_problem(model, conditions, {})
    assert {e.parameter for e in problem.effects} == set(values) - set(held)

    plausible = {p.name: p.plausible for p in chosen.parameters}
    scale = np.concatenate([np.ones(FIXED), [plausible[e.parameter] for e in problem.effects]])
    block, others = Block(np.round(BLOCK.K, 3), np.round(BLOCK.U0, 3)), problem.prior_mean
    for _ in range(4):
        columns = problem.jacobian(block, others).reshape(signal.size, -1) * scale
        inverse = np.linalg.pinv(columns, rcond=1e-8)
        step = inverse @ (signal - problem.predict(block, others)).ravel() * scale
        block, others = Block.from_vector(block.vector + step[:FIXED]), others + step[FIXED:]
    np.testing.assert_allclose(problem.predict(block, others), signal, rtol=0, atol=1e-11)
    if name == "meters_exchanged":  # three pairs, two differences: their sums alone are known
        return
    determined = np.diag(inverse @ columns)[FIXED:] > 1 - 1e-6
    true = [float(values[e.parameter][() if e.channel is None else e.channel]) for e in problem.effects]
    for e, found, expected, known in zip(problem.effects, others, true, determined, strict=True):
        assert known == (name not in HIDDEN), e
        assert not known or found == pytest.approx(expected, abs=1e-4 * plausible[e.parameter]), e


def test_unknowns_have_names_of_their_own():
    effects = (
        effect("mounting_offset", ("1",)),
        effect("mounting_offset", ("2", "1/2")),
        effect("axis_wobble", harmonic=1),
        effect("axis_wobble", harmonic=2),
        effect("warm_up", tau=600.0),
    )
    conditions = Conditions.of(["1", "2"], [0.0, 1.0])
    names = make_problem(ForwardModel(INSTALLATIONS, effects), conditions, {}).names()
    assert names == [
        "mounting_offset.angle[1]",
        "mounting_offset.angle[2+1/2]",
        "axis_wobble.cosine(harmonic 1)",
        "axis_wobble.sine(harmonic 1)",
        "axis_wobble.cosine(harmonic 2)",
        "axis_wobble.sine(harmonic 2)",
        "warm_up.A[x]",
        "warm_up.A[y]",
        "warm_up.A[z]",
    ]


# --- conditions of a readings table -----------------------------------------------------------------


def test_the_scan_order_comes_from_its_column():
    table = make_readings(
        ["1"] * 3, [1] * 3, [1, 2, 3], np.zeros(3), np.zeros((3, 3)), scan_order=["xyz", "", "ZxY"]
    )
    assert table.conditions().scan_order.tolist() == [[0, 1, 2], [0, 1, 2], [2, 0, 1]]
    assert table.select(np.array([False, False, True])).conditions().scan_order.tolist() == [[2, 0, 1]]
    plain = make_readings(["1"] * 2, [1] * 2, [1, 2], np.zeros(2), np.zeros((2, 3)))
    assert plain.conditions().scan_order.tolist() == [[0, 1, 2]] * 2


@pytest.mark.parametrize("text", ["xy", "xyy", "abc", "x,y,z"])
def test_another_scan_order_is_refused(text):
    with pytest.raises(ValueError, match="such as xyz or zyx"):
        scan_order(text)


# --- installed effects ------------------------------------------------------------------------------
# Effects of installed distributions, by entry points.

MODULE = '''
from bench.model.effects.base import BlockEffect, Parameter

class Fourth(BlockEffect):
    """K4 a^4."""
    name = "fourth"
    parameters = (Parameter("K4", "ug/g^4", 1e-6, 20e-6, per_channel=True),)
    sentence = "the output has a part with the fourth power"
    shown_by = "more angles"

    def addition(self, values, seen):
        return seen.scale * values["K4"] * seen.signal**4
'''


@pytest.fixture
def site(tmp_path, monkeypatch):
    (tmp_path / "my_bench_effects.py").write_text(MODULE)
    about = tmp_path / "my_bench_effects-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-bench-effects\nVersion: 1.2\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield about / "entry_points.txt"
    sys.modules.pop("my_bench_effects", None)


@pytest.mark.parametrize("entry", ["my_bench_effects", "my_bench_effects:Fourth"])
def test_a_distribution_brings_an_effect(site, entry):
    site.write_text(f"[{GROUP}]\nfourth = {entry}\n")
    catalogue = Catalogue(CATALOGUE.values())
    assert list(catalogue)[-1] == "fourth"
    assert catalogue["fourth"].parameters[0].name == "K4"
    assert catalogue.troubles == []


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("my_bench_effects.nothing", "the distribution my-bench-effects 1.2 cannot be loaded"),
        ("my_bench_effects:MODULE", "cannot be loaded"),
        ("math", "is not an effect and contains none"),
    ],
)
def test_what_cannot_be_had_is_said_and_all_else_is_there(site, entry, told):
    site.write_text(f"[{GROUP}]\nwrong = {entry}\n")
    catalogue = Catalogue(CATALOGUE.values())
    assert list(catalogue) == list(CATALOGUE)
    assert [told in trouble for trouble in catalogue.troubles] == [True]


def test_a_name_that_is_taken_stays_with_the_bench(site):
    site.write_text(f"[{GROUP}]\nfourth = my_bench_effects\n")
    shipped = SimpleNamespace(name="fourth")
    catalogue = Catalogue([shipped])
    assert catalogue["fourth"] is shipped
    assert "which exists already" in " ".join(catalogue.troubles)
