"""Mistakes in a table: each is named with its cause, none becomes a coefficient."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.calibration import CalibrationError, calibrate
from bench.calibration.calibrate import ESTIMATORS
from bench.calibration.mistakes import refuse_mixed_units, sheet_of, wrong_unit
from bench.calibration.result import FaultyReadings, SpoiledFit
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.diagnosis.mistakes.search import find_mistakes
from bench.model import ForwardModel, Installation
from bench.planning.requirements import MOST_MOUNTINGS, Cost, fitted, outlook, settings_of
from bench.readings.csv import read_csv
from bench.readings.table import make_readings, stacked
from bench.validation.paper_bench import STAND_U, TRUTH, U0, K, design, simulate, specific_force
from tests.support.honest_runs import MODEL, free_forces
from tests.support.results import calibration_json

FITTING = ("gls", "least-squares", "robust")


def refused(readings, match, estimator="gls", model=MODEL):
    with pytest.raises(CalibrationError, match=match) as refusal:
        calibrate(readings, model, STAND_U, 9.81, estimator)
    return refusal.value


@pytest.mark.parametrize(
    ("per_degree", "unit"), [(np.pi / 180, "radians"), (400 / 360, "gon"), (1 / 360, "whole turns")]
)
@pytest.mark.parametrize("estimator", FITTING)
def test_angles_in_another_unit(per_degree, unit, estimator):
    readings = simulate(np.random.default_rng(1), 1e-4)
    readings.angle_rad[:] = readings.angle_rad * per_degree
    refused(readings, f"the angles look like {unit}, not degrees: .*write angle_deg in degrees", estimator)


@pytest.mark.slow
def test_a_poor_fit_alone_is_not_called_a_wrong_unit():
    """A quadratic term of 5 % is no unit of angle."""
    readings = simulate(np.random.default_rng(2), 1e-4, K2=0.05)
    assert calibrate(readings, MODEL, STAND_U, 9.81).lack_of_fit.p < 1e-9


@pytest.mark.parametrize("ends", ["top", "bottom", "both"])
def test_a_saturated_channel(ends):
    """Channel y cut at 1.2 V: the readings beyond stand at the same value, whatever the head's angle."""
    readings = simulate(np.random.default_rng(3), 1e-4)
    low, high = {"top": (-9, 1.2), "bottom": (-1.2, 9), "both": (-1.2, 1.2)}[ends]
    readings.signal[:, 1] = np.clip(readings.signal[:, 1], low, high)
    for estimator in FITTING:
        refused(
            readings, r"channel y is saturated: \d+ readings stand at .*1\.2.* on a higher range", estimator
        )


def test_equal_readings_of_a_coarse_meter_are_not_called_saturated():
    """Rounded to 1 mV, the six readings with an axis straight up are all alike."""
    readings = simulate(np.random.default_rng(4), 1e-5)
    readings.signal[:] = readings.signal.round(3)
    for axis in range(3):
        assert np.sum(readings.signal[:, axis] == readings.signal[:, axis].max()) >= 3
    result = calibrate(readings, MODEL, STAND_U, 9.81)
    assert np.all(np.abs(result.block.vector - TRUTH) < 5 * result.u)


def test_a_saturated_channel_of_free_positions():
    forces = free_forces(40, np.random.default_rng(5))
    signal = np.minimum(forces @ K.T + U0, [1.0, 9, 9])
    readings = make_readings(["F"] * 40, [1] * 40, [*range(40)], np.full(40, np.nan), signal)
    assert isinstance(refused(readings, r"channel x is saturated: \d+ readings stand at 1,"), FaultyReadings)


def test_overload_is_named():
    readings = simulate(None, 0.0)
    readings.signal[30, 2] = 9.9e37
    refused(readings, "installation 2, pass 1, point 4 has an overloaded voltmeter")


def test_a_cable_that_is_off():
    """A channel with noise alone, and one that gives exactly the same."""
    readings = simulate(np.random.default_rng(6), 1e-4)
    readings.signal[:, 2] = np.random.default_rng(7).normal(0, 1e-4, 54)
    for estimator in ESTIMATORS:
        refused(
            readings,
            "not show that channel z responds to acceleration; check cable|K is singular",
            estimator,
        )
    readings.signal[:, 2] = 0.1
    assert type(refused(readings, "channel z is the same in every reading")) is FaultyReadings


def test_two_meters_on_one_channel():
    readings = simulate(np.random.default_rng(8), 1e-4)
    readings.signal[:, 2] = readings.signal[:, 1] + np.random.default_rng(9).normal(0, 1e-4, 54)
    for estimator in ESTIMATORS:
        refused(
            readings,
            "K is singular: channels y and z respond equally; check whether two voltmeters",
            estimator,
        )


def test_three_axes_in_a_plane():
    flat = K.copy()
    flat[2] = flat[0] + flat[1]
    installation, pass_number, point, phi = design()
    signal = (
        specific_force(installation, phi) @ flat.T + U0 + np.random.default_rng(1).normal(0, 1e-4, (54, 3))
    )
    refused(make_readings(installation, pass_number, point, phi, signal), "lie in one plane")


def test_any_installations_and_angles_that_have_the_rank():
    """Six orientations of a further installation and installation 2, at angles of no pattern, one pass."""
    rng = np.random.default_rng(10)
    turned = Installation.from_axes("T", ("y", "-x", "z"))
    model = ForwardModel({**MODEL.installations, "T": turned})
    phi = rng.uniform(0, 2 * np.pi, 14)
    base = specific_force(["1"] * 7, phi[:7])
    force = np.concatenate([base @ turned.block_from_platform.T, specific_force(["2"] * 7, phi[7:])])
    signal = force @ K.T + U0 + rng.normal(0, 1e-4, (14, 3))
    readings = make_readings(["T"] * 7 + ["2"] * 7, [1] * 14, [*range(1, 8)] * 2, phi, signal)
    for estimator in ("gls", "least-squares"):
        result = calibrate(readings, model, STAND_U, 9.81, estimator)
        assert np.all(np.abs(result.block.vector - TRUTH) < 5 * result.u)


def test_nominal_angles_in_place_of_those_read_back():
    """The head stood where it was asked to; its scale was read with errors of 20 arcmin."""
    rng = np.random.default_rng(11)
    readings = simulate(rng, 2e-5)
    nominal = readings.angle_rad.copy()
    readings.angle_rad[:] += rng.normal(0, np.radians(20 / 60), 54)
    readings.target_rad[:] = nominal
    by_scale = calibrate(readings, MODEL, STAND_U, 9.81)
    by_target = calibrate(readings, MODEL, STAND_U, 9.81, nominal_angles=True)
    assert by_scale.noise.setting_rad > 50 * by_target.noise.setting_rad
    assert np.all(np.abs(by_target.block.vector - TRUTH) < 4 * by_target.u)
    assert (calibration_json(by_scale)["angles"], calibration_json(by_target)["angles"]) == (
        "read back",
        "nominal",
    )
    readings.target_rad[:] = np.nan
    np.testing.assert_allclose(
        calibrate(readings, MODEL, STAND_U, 9.81, nominal_angles=True).block.vector, by_target.block.vector
    )
    readings.angle_rad[5] += 0.3
    with pytest.raises(
        CalibrationError, match="pass 1, point 6 has no nominal angle; add the column target_deg"
    ):
        calibrate(readings, MODEL, STAND_U, 9.81, nominal_angles=True)


@pytest.mark.slow
def test_least_squares_weighs_all_alike_and_is_honest():
    """Against numpy's least squares on the nominal forces; its errors over u in 50 runs, seeds [71, k]."""
    z = []
    for k in range(50):
        readings = simulate(np.random.default_rng([71, k]), 1e-4)
        result = calibrate(readings, MODEL, STAND_U, 9.81, "least-squares")
        z.append((result.block.vector - TRUTH) / result.u)
    installation, _, _, phi = design()
    columns = np.column_stack([specific_force(installation, phi), np.ones(54)])
    expected = np.linalg.lstsq(columns, readings.signal, rcond=None)[0]
    np.testing.assert_allclose(result.block.vector, [*expected[:3].T.ravel(), *expected[3]], atol=1e-12)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    # a chi-square of 50 is out of these bounds once in 10^5
    assert np.all((rms > 0.59) & (rms < 1.46)), rms.round(3)
    assert result.stand == {}


# --- signals in another unit ----------------------------------------------------------------------


SHEET = (-2.18, -2.14, -2.14)


@pytest.fixture(scope="module")
def readings():
    """Two passes of the paper's points, with the verification points in the first."""
    file = Path(__file__).parents[1] / "data" / "records" / "readings.csv"
    one = read_csv(file, ("1", "2", "V"))
    two = replace(one, pass_number=one.pass_number + 1)
    return replace(stacked([one, two]), source="r.csv", began_s=None, block=None)


def scaled(readings, rows=True, channels=(0, 1, 2), factor=1e3):
    signal = readings.signal.copy()
    mask = np.zeros(signal.shape, dtype=bool)
    mask[np.ix_(np.flatnonzero(np.broadcast_to(rows, len(readings))), channels)] = True
    signal[mask] *= factor
    return replace(readings, signal=signal)


CASES = {
    "all signals seem to be in mV": ({}, {}),
    "all signals seem to be in µV": ({"factor": 1e6}, {}),
    "the signals of channel y seem to be in mV": ({"channels": (1,)}, {}),
    "the signals of channel x, z seem to be in another unit": ({"channels": (0, 2), "factor": 1e-3}, {}),
    "all signals of pass 2 seem to be in mV": ({}, {"pass_number": 2}),
    "the signals of channel z of pass 2 seem to be in mV": ({"channels": (2,)}, {"pass_number": 2}),
    "all signals of installation 2 seem to be in mV": ({}, {"installation": "2"}),
    "the signals of channel y of installation 1 seem to be in mV": (
        {"channels": (1,)},
        {"installation": "1"},
    ),
}


@pytest.mark.parametrize("words", CASES)
@pytest.mark.parametrize("sheet", [SHEET, None])
def test_another_unit_is_named_and_put_right(readings, words, sheet):
    how, where = CASES[words]
    rows = np.ones(len(readings), dtype=bool)
    for name, value in where.items():
        rows &= getattr(readings, name) == value
    spoilt = scaled(readings, rows, **how)
    found = wrong_unit(spoilt, MODEL, sheet)
    if sheet is None and (not where and len(how.get("channels", (0, 1, 2))) == 3):
        assert found is None  # only the data sheet shows it
        return
    if sheet is None and how.get("factor") == 1e-3:
        words = "the signals of channel y seem to be in mV"  # the smallest are taken to be right
    assert found is not None
    assert found.words.startswith(words)
    corrected = found.corrected(spoilt).signal
    factor = 1e-3 if sheet is None and how.get("factor") == 1e-3 else 1.0
    np.testing.assert_allclose(corrected, readings.signal * factor, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("words", [w for w in CASES if not w.startswith("all signals seem")])
def test_a_calibration_refuses_signals_in_two_units_and_a_diagnosis_names_them(readings, words):
    how, where = CASES[words]
    rows = np.ones(len(readings), dtype=bool)
    for name, value in where.items():
        rows &= getattr(readings, name) == value
    spoilt = scaled(readings, rows, **how)
    with pytest.raises(SpoiledFit, match=rf"r\.csv: {words}.*convert them to one unit"):
        refuse_mixed_units(spoilt, MODEL, SHEET)
    if (
        len(how.get("channels", SHEET)) == 1
    ):  # those of one channel are in `tests/diagnosis/mistakes/test_units`
        return
    first, *_ = find_mistakes(spoilt, MODEL, {}, np.array(SHEET)).mistakes
    assert first.name == "wrong_unit"
    assert first.words.startswith(words)
    assert first.pass_number == where.get("pass_number")
    assert first.misfit_after < 1e-2 * first.misfit_before or how.get("factor") == 1e-3


@pytest.mark.slow
def test_the_p_of_a_wrong_unit_comes_of_its_odds(readings):
    """More readings make longer odds; a marker would be the same for all."""
    few = readings.select(readings.point <= 3)
    spoilt = scaled(few, channels=(1,), factor=1e-3)
    (unit,) = find_mistakes(spoilt, MODEL, {}, np.array(SHEET)).mistakes
    more = find_mistakes(scaled(readings, channels=(1,), factor=1e-3), MODEL, {}, np.array(SHEET)).mistakes[0]
    assert unit.name == "wrong_unit"
    assert unit.p > more.p > sys.float_info.min


def test_where_the_units_are_right_nothing_is_said(readings):
    """Blocks with scale factors drawn within a factor of 1.8 of the sheet, biases to 2 g, one axis reversed."""
    draw = np.random.default_rng(20261123)
    assert wrong_unit(readings, MODEL, SHEET) is None
    for _ in range(50):
        scale = np.exp(draw.uniform(-0.58, 0.58, 3)) * draw.choice((1.0, -1.0), 3)
        other = replace(readings, signal=readings.signal * scale + draw.uniform(-4.0, 4.0, 3))
        assert wrong_unit(other, MODEL, SHEET) is None
        assert wrong_unit(other, MODEL, None) is None


def test_one_position_says_nothing_of_units(readings):
    few = readings.select((readings.point == 1) & (readings.installation == "1"))
    assert len(few) == 2
    assert wrong_unit(scaled(few), MODEL, SHEET) is None


def test_what_a_data_sheet_says_in_each_unit():
    assert sheet_of("V", SHEET) == SHEET
    assert sheet_of("g", SHEET) == (1.0, 1.0, 1.0)
    assert sheet_of("counts", SHEET) is None


# --- what an error says to do ---------------------------------------------------------------------


BENCH = load_bench(find_bench("paper-stand"))
OF_BENCH = ForwardModel(BENCH.installation_models())


def looked_at(procedure, verified=True):
    plan = load_procedure(find_procedure(procedure)).plan
    settings = settings_of(plan)
    return outlook(
        settings if verified else fitted(settings), OF_BENCH, BENCH.simulated_block(), Cost.of_plan(plan)
    )


@pytest.mark.parametrize(
    ("procedure", "rank", "unknowns", "left"),
    [
        ("paper", 16, 20, 1),
        ("calibration", 16, 20, 1),
        ("turn-24", 16, 20, 1),
        ("return", 20, 24, 1),
        ("remount-180", 24, 28, 1),
        ("remount-90", 25, 28, 0),
    ],
)
def test_three_turns_stay_open_always_and_the_third_mounting_angle_until_another_axis_lies_along_the_shaft(
    procedure, rank, unknowns, left
):
    found = looked_at(procedure)
    assert (found.found.rank, found.found.columns) == (rank, unknowns)
    assert found.turns == ["x", "y", "z"]
    assert len(found.open) == left
    assert bool(found.remedies) == bool(left)


def test_the_cheapest_remedy_costs_no_reading_where_there_are_verification_points():
    with_points, without = looked_at("paper"), looked_at("paper", verified=False)
    assert with_points.remedies[0].text.startswith("let the verification points join the fit")
    assert with_points.remedies[0].cost_s == 0.0
    first = without.remedies[0]
    assert first.text == "four verification points (installation V) that join the fit by |a| = 1 g"
    # a mounting of 20 min; four settings of 2 min, 10 s settling and 10 samples of 0.41 s
    assert first.cost_s == pytest.approx(1200 + 4 * (120 + 10 + 4.1))
    texts = [remedy.text for remedy in without.remedies]
    assert any("'remount-90'" in text for text in texts)
    assert any(text.startswith("one pass in installation 3 (axes [y, z, x]") for text in texts)
    # what turns the block about the platform's normal by half a turn, or repeats a mounting, shows nothing new
    assert not any("180" in text or "return" in text for text in texts)
    assert [r.cost_s for r in without.remedies] == sorted(r.cost_s for r in without.remedies)


def test_of_very_many_mountings_the_first_of_each_installation_are_looked_at():
    many = [
        s._replace(mount=s.mount._replace(series=visit))
        for visit in range(1, MOST_MOUNTINGS)
        for s in fitted(settings_of(load_procedure(find_procedure("quick")).plan))
    ]
    found = outlook(many, OF_BENCH, BENCH.simulated_block(), Cost(120.0, 1200.0))
    assert found.found.columns == 20


def test_check_says_it_before_the_run_and_in_json(bench):
    status, out, _ = bench("check", "calibration")
    assert status == 0
    told = [line for line in out.splitlines() if "leaves open" in line or "to determine it" in line]
    assert told[0].startswith(
        "leaves open: a change of alpha5[1], alpha5[2] in the ratio 1 : 1 is indistinguishable from a change "
        "of coefficients"
    )
    assert told[1].startswith(
        "to determine it, choose one: let the verification points join the fit by |a| = 1 g (no further"
    )
    assert "common turn of the block's axes (about x, y, z)" in told[2]
    found = json.loads(bench("check", "calibration", "--json", "-")[1])["observability"]
    assert (found["rank"], found["unknowns"]) == (16, 20)
    assert {d["kind"] for d in found["directions"]} == {"turn", "mixed"}
    assert found["remedies"][0]["cost_s"] == 0.0
    assert {"Kxx", "alpha1[1]"} <= set(found["determined"])


def test_no_observability_is_told_of_what_calibrates_nothing(bench):
    assert json.loads(bench("check", "stability", "--json", "-")[1])["observability"] is None
    assert "leaves open:" not in bench("check", "stability")[1]


def test_a_setting_of_a_plan_costs_its_turn_its_settling_and_its_reading():
    for name in ("paper", "quick", "temperature", "stability"):
        cost = Cost.of_plan(load_procedure(find_procedure(name)).plan)
        reading = {"quick": 5 * 0.41, "stability": 4.1}.get(name, 4.1)
        settle = {"quick": 5.0, "stability": 30.0}.get(name, 10.0)
        assert cost.setting_s == pytest.approx(120 + settle + reading)
    assert Cost(100.0, 1000.0, 10.0).settings_within(1510.0, 1) == 5
    assert Cost(100.0, 1000.0, 10.0).settings_within(1509.0, 1) == 4
    assert Cost(100.0, 1000.0).settings_within(0.0, 1) == 0
    assert np.isclose(Cost(100.0, 1000.0, 10.0).total_s(3, 2), 2310.0)


def in_millivolts(signal):
    signal[5] *= 1000.0


def on_both(signal):
    signal[[5, 20], 1:] = [[500.0, 500.0], [-400.0, -400.0]]


@pytest.mark.parametrize(
    ("spoil", "what"), [(in_millivolts, "did not converge"), (on_both, "not show that channel y, z")]
)
def test_rows_that_spoil_a_fit_are_named(spoil, what):
    """One row in mV, two rows with other signals on y and z."""
    readings = simulate(np.random.default_rng(8), 1e-4)
    spoil(readings.signal)
    row = f"installation 1, pass {readings.pass_number[5]}, point {readings.point[5]}"
    why = f"{what}.*; these readings are far off: {row}.*; find the mistake with 'bench diagnose'$"
    assert isinstance(refused(readings, why), SpoiledFit)


def test_rows_that_are_whole_passes_are_named_as_passes():
    readings = simulate(np.random.default_rng(8), 1e-4)
    wrong = (readings.installation == "2") & (readings.pass_number == 3)
    signal = np.where(wrong[:, None], 1000.0 * readings.signal, readings.signal)
    signal[5] *= 1000.0
    row = f"installation 1, pass {readings.pass_number[5]}, point {readings.point[5]}"
    refused(replace(readings, signal=signal), f"far off: all of installation 2, pass 3 and {row}; find")
