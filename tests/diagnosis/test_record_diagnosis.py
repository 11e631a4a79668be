"""Diagnoses of records at a known input: strangers' records, nulls of them, and twins with a known truth."""

from dataclasses import replace

import numpy as np
import pytest

from bench.base.arrays import rms
from bench.calibration.result import CalibrationError
from bench.diagnosis import record_model
from bench.diagnosis.confirm import confirm_record
from bench.diagnosis.record_calibration import calibrate_record
from bench.diagnosis.record_diagnosis import diagnose_record
from bench.diagnosis.record_model import courses_of, make_courses, make_record, shape_of
from bench.diagnosis.record_noise import Noise, slow_kernels
from bench.diagnosis.record_search import RecordWork
from bench.model.effects import CATALOGUE, AppliedEffect
from bench.readings.csv import read_csv
from bench.readings.table import is_record
from bench.results.known_input import what_in_words
from tests.support.known_inputs import (
    BATH,
    BATH_COLUMNS,
    OFFSET,
    SWEPT,
    SWEPT_COLUMNS,
    as_readings,
    record_at_levels,
    switched_on,
    twin,
)

THERMAL = {"voltmeter_thermal_gain", "voltmeter_thermal_offset"}
WHOLE = record_model.BINS


@pytest.fixture(autouse=True, scope="module")
def half_the_means():
    """A search of half as many means takes half the time, and has the same readings to tell from."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record_model, "BINS", WHOLE // 2)
        yield


@pytest.fixture
def all_the_means(monkeypatch):
    """As many means as the program takes."""
    monkeypatch.setattr(record_model, "BINS", WHOLE)


@pytest.mark.slow
def test_a_meter_in_an_air_bath_follows_its_temperature_late(tmp_path):
    """0.7 to 0.9 ppm/K behind 90 to 110 min, as an independent least-squares fit of the record gives."""
    found = diagnose_record(as_readings(BATH, BATH_COLUMNS, tmp_path))
    assert found.verdict == "confounded"
    thermal, jump = found.effects
    assert {thermal.name, *thermal.cannot_tell_from} == THERMAL  # at one voltage nobody can tell them apart
    x, y, lag = thermal.parameters
    assert 0.7 <= x.value <= 0.9
    assert abs(x.value - y.value) < np.hypot(x.u, y.u)
    assert 75 <= lag.value <= 120
    assert max(found.rivals, key=lambda rival: -rival.chi2).what == "lag"
    assert found.gap.shrinks
    assert all(rms(fit.residual_v) <= 0.4e-6 for fit in found.fits)
    # the two inputs of the meter part by 0.4 µV between 27.3 and 27.8 h
    assert (jump.name, jump.channels) == ("voltmeter_move", ("y",))
    assert jump.parameters[-1].value == pytest.approx(27.55, abs=0.25)


def write_record(folder, *signals):
    """Write a record at 1 V with these signals, V, every 10 s."""
    file = folder / "record.csv"
    header = ",".join(["installation,time_s,reference_v", *(f"u{c}_v" for c in "xyz"[: len(signals)])])
    each = enumerate(np.transpose(signals).tolist())
    rows = (",".join(["R", f"{10 * i}", "1", *map(repr, row)]) for i, row in each)
    file.write_text("\n".join([header, *rows]) + "\n")
    return read_csv(file, ())


@pytest.mark.filterwarnings("error")
def test_a_record_without_noise_is_refused_in_a_sentence(tmp_path):
    noise = 1.0 + np.random.default_rng(3).normal(0.0, 1e-6, 60)
    for signals, told in (
        ([np.full(60, 1.000003)], "ux_v minus reference_v has no noise; give the readings with all digits"),
        ([noise, 1.0 + 1e-9 * np.arange(60)], "uy_v minus reference_v has no noise"),
        ([noise, noise], "ux_v and uy_v have the same noise; give the readings of one meter once"),
    ):
        with pytest.raises(CalibrationError, match=told):
            make_record(write_record(tmp_path, *signals))


@pytest.mark.filterwarnings("error")
def test_a_meter_of_few_digits_is_calibrated_without_a_comparison_of_parts(tmp_path):
    """Its reading stays the same in the second fifth of the record."""
    signal = np.round(1.0 + np.random.default_rng(3).normal(0.0, 0.4e-6, 200), 6)
    signal[30:90] = 1.0
    found = calibrate_record(write_record(tmp_path, signal))
    assert found.repeats is None
    assert abs(found.channels[0].gain.value - 1.0) < 2.0 * found.channels[0].gain.u


@pytest.mark.slow
def test_two_meters_at_the_same_input_have_nothing_to_name(tmp_path):
    columns = {
        "time_s": "time_s",
        "reference_v": "k3_v",
        "ux_v": "k1_v",
        "meter_temperature_c": "dut_temperature_c",
    }
    found = diagnose_record(as_readings(BATH, columns, tmp_path))
    assert (found.verdict, found.effects, found.far) == ("agrees", (), ())


@pytest.mark.slow
def test_a_reference_follows_its_swept_supply_and_not_the_room(tmp_path):
    found = diagnose_record(as_readings(SWEPT, SWEPT_COLUMNS, tmp_path, reference_v="0.0175"))
    assert (found.verdict, [one.name for one in found.effects]) == ("named", ["reference_supply"])
    size = found.effects[0].parameters[0]
    assert -1.6 <= size.value <= -1.2
    assert found.gap.shrinks
    assert any("had not settled" in note for note in found.notes)


@pytest.mark.slow
@pytest.mark.usefixtures("all_the_means")
@pytest.mark.parametrize("tau_min", [15, 90])
def test_self_heating_after_switching_on_is_named_with_its_size(tau_min, tmp_path):
    """Size and time constant within 3.3 u: 99.9 % of an honest u, for each of four numbers."""
    found = diagnose_record(read_csv(switched_on(tmp_path, 3200 + tau_min, 20e-6, tau_min), ()))
    (heating,) = found.effects
    assert (found.verdict, heating.name) == ("named", "voltmeter_warm_up")
    size, tau = heating.parameters
    assert abs(size.value - 20.0) < 3.3 * size.u
    assert abs(tau.value - tau_min) < 3.3 * tau.u
    assert size.u < 4.0
    assert tau.u < 0.25 * tau_min


@pytest.mark.slow
def test_a_time_constant_between_those_of_the_grid_is_one_effect(tmp_path):
    """The grid has 45 and 60 min: what either leaves of 200 µV is far more than the noise."""
    found = diagnose_record(read_csv(switched_on(tmp_path, 3252, 200e-6, 52), ()))
    (heating,) = found.effects
    size, tau = heating.parameters
    assert abs(size.value - 200.0) < 3.3 * size.u
    assert abs(tau.value - 52) < 3.3 * tau.u
    assert tau.u < 2.0
    assert found.gap.shrinks
    assert found.gap.after < 1.5


@pytest.mark.slow
def test_a_record_that_starts_warm_names_nothing(tmp_path):
    assert diagnose_record(read_csv(switched_on(tmp_path, 3200, 0.0, 30), ())).effects == ()


@pytest.fixture(scope="module")
def of_twin(tmp_path_factory):
    """The diagnosis of a twin of the record in the air bath."""
    return diagnose_record(read_csv(twin(tmp_path_factory.mktemp("twin"), 1), ()))


def size_found(found):
    """The size of the only effect, whose name, size and lag must be those of the twin."""
    (thermal,) = found.effects
    assert {thermal.name, *thermal.cannot_tell_from} == THERMAL
    size, lag = thermal.parameters
    assert abs(size.value - 0.74) < 3 * size.u
    assert abs(lag.value - 95) < 3 * lag.u
    return size


@pytest.mark.slow
def test_a_twin_of_the_record_gives_the_same_name_and_its_size(of_twin):
    size_found(of_twin)


@pytest.mark.slow
def test_a_lag_that_begins_away_from_equilibrium_keeps_its_name_and_size(tmp_path):
    """Brought in 8 K colder than the bath: half of the first excursion."""
    readings = read_csv(twin(tmp_path, 1, colder_k=8.0), ())
    found = diagnose_record(readings)
    assert size_found(found).u < 0.05
    # the known effect, subtracted in equilibrium, leaves nothing to find
    again = diagnose_record(readings, found.applied)
    assert again.effects == ()
    assert again.where[0].size < 0.2e-6
    assert rms(again.fits[0].before_v) < 0.2e-6
    count = len(found.record)  # the starting state is a third column beside zero and drift
    assert (found.gap.noise.freedom, again.gap.noise.freedom) == (count - 2, count - 3)
    confirmed = confirm_record(readings, found.applied)
    (applied,) = found.applied
    forms = [(applied.effect, shape_of(applied.effect, applied.complete_values()))]
    work = RecordWork.of(found.record, courses_of(found.record, forms))
    chi2 = work.fitted(0, [], work.noises(work.candidates.variants)[0])[2]
    assert confirmed.before.reduced == pytest.approx(chi2 / (count - 2))


@pytest.mark.slow
def test_a_gain_at_several_levels_is_neither_a_jump_nor_slow(tmp_path):
    found = diagnose_record(record_at_levels(tmp_path, 4, per_k=1e-6))
    assert (found.verdict, [one.name for one in found.effects]) == ("named", ["voltmeter_thermal_offset"])
    assert any("several levels" in note for note in found.notes)
    (size,) = found.effects[0].parameters
    assert abs(size.value - 1.0) < 4 * size.u
    assert size.u < 0.01
    plain = diagnose_record(record_at_levels(tmp_path, 4, levels=(0.0, 5.0, 10.0)))
    assert "each channel equals gain × reference plus a zero and a drift" in what_in_words(plain)
    for x in (*found.fits, *plain.fits):  # the zero is that at 0 V, not at the mean level
        assert abs(x.zero_v - OFFSET) < 4 * x.u_zero_v
        assert x.u_zero_v < 0.1e-6
    assert found.gap.noise.freedom == len(found.record) - 3  # zero, drift and gain


@pytest.mark.slow
@pytest.mark.parametrize(("gain_per_k", "verdict"), [(0.74e-6, "confirmed"), (0.0, "gone")])
def test_a_new_record_confirms_a_model_or_not(of_twin, tmp_path, gain_per_k, verdict):
    found = confirm_record(read_csv(twin(tmp_path, 2, gain_per_k), ()), of_twin.applied)
    assert found.verdict == verdict
    assert (found.unit, found.effects[0].verdict) == ("V", verdict)


def test_an_unknown_state_at_the_start_of_a_lag_changes_no_size(tmp_path):
    """What a lag leaves of any state at the start is a multiple of exp(-t / lag)."""
    lag_s = 5700.0
    record = make_record(read_csv(twin(tmp_path, 6), ()))
    effect = CATALOGUE["voltmeter_thermal_offset"]
    lagging = AppliedEffect(effect, {"offset": np.full(3, 1e-6), "lag": np.asarray(lag_s)})
    forms = [(effect, (("lag", lag_s),))]
    left_v = 5e-6 * np.exp(-(record.conditions.elapsed_s - record.conditions.elapsed_s[0]) / lag_s)
    sizes = []
    for added_v in (0.0 * left_v, left_v):
        work = RecordWork.of(record.less(added_v[:, None]), courses_of(record, forms)).without([lagging])
        sizes.append(work.sizes(work.candidates.variants))
    for first, second in zip(*sizes, strict=True):
        assert first == pytest.approx(second, rel=1e-6)


def test_channels_share_the_noise_of_the_mean(tmp_path):
    """Sizes in two channels with one large common noise and little of their own are almost equal in error."""
    rng = np.random.default_rng(12)
    both = read_csv(twin(tmp_path, 8), ())
    signal = both.signal.copy()
    signal[:, 1] = signal[:, 0] + rng.normal(0.0, 1e-8, len(both))
    record = make_record(replace(both, signal=signal))
    work = RecordWork.of(
        record, courses_of(record, [(CATALOGUE["voltmeter_thermal_offset"], (("lag", 5700.0),))])
    )
    size, covariance = work.sizes(work.candidates.variants)
    u = np.sqrt(np.diag(covariance))
    assert covariance[0, 1] / (u[0] * u[1]) > 0.99
    assert abs(size[0] - size[1]) < 0.1 * u[0]


@pytest.mark.slow
def test_a_confirmation_allows_for_an_unknown_lag_as_the_diagnosis_does(of_twin, tmp_path):
    (found,) = confirm_record(read_csv(twin(tmp_path, 1), ()), of_twin.applied).effects
    size, now = of_twin.effects[0].parameters[0], found.now[0]
    assert (now.value, now.u) == pytest.approx((size.value, size.u), rel=0.02)


@pytest.mark.slow
@pytest.mark.usefixtures("all_the_means")
def test_u_of_a_jump_allows_for_the_lag_of_an_effect_beside_it(tmp_path):
    record = make_record(read_csv(twin(tmp_path, 5, jump_v=2e-6), ()))
    work = RecordWork.of(record, make_courses(record))
    finds, limit = work.search()
    jump, thermal = courses = [one.variant for one in finds]
    (mean, u_lag, *_), (*_, alone) = (work.shaped(courses, number) for number in (1, 0))
    (lag,) = dict(mean.shape).values()
    (noise,) = work.noises(courses)

    def step(lag_s):
        shapes = [(CATALOGUE[thermal.family], (("lag", lag_s),)), (CATALOGUE[jump.family], jump.shape)]
        fine = RecordWork.of(record, courses_of(record, shapes))
        return fine.fitted(0, fine.candidates.variants, noise)[0][
            3
        ]  # after zero, drift and the thermal effect

    by_u = (step(lag + u_lag) - step(lag - u_lag)) / 2.0
    by_grid = step(thermal.shape[0][1]) - step(lag)
    named = work.named(finds, limit)[0].parameters[0].u / 10.0  # in plausible sizes, of 10 µV
    assert named**2 - alone[0] ** 2 == pytest.approx(by_u**2 + by_grid**2, rel=0.3)


@pytest.mark.slow
def test_one_excursion_confirms_no_name(tmp_path):
    """A meter carried outdoors and back: what follows one excursion alone is not told from a coincidence."""
    rows = twin(tmp_path, 4).read_text().splitlines()
    file = tmp_path / "one.csv"
    file.write_text("\n".join(rows[: 1 + 60 * 26]) + "\n")  # before the bath is cooled
    found = diagnose_record(read_csv(file, ()))
    assert found.verdict == "unknown"
    assert [one.name for one in found.effects] == ["slow_in_time"]
    assert "one excursion" in found.effects[0].words


@pytest.mark.slow
def test_a_jump_is_found_at_its_time(tmp_path):
    found = diagnose_record(read_csv(twin(tmp_path, 5, gain_per_k=0.0, jump_v=5e-6), ()))
    (jump,) = found.effects
    assert (found.verdict, jump.name) == ("named", "voltmeter_move")
    step, at = jump.parameters
    assert abs(step.value - 5.0) < 3 * step.u
    assert at.value == pytest.approx(22.3, abs=0.2)


# --- what a record is -------------------------------------------------------------------------------

ROW = "R,{time},1.0,1.000001{digit},"


def record_of(tmp_path, rows, header="installation,time_s,reference_v,ux_v,uz_v"):
    file = tmp_path / "record.csv"
    file.write_text("\n".join([header, *rows]) + "\n")
    return read_csv(file, ())


def test_a_record_needs_no_pass_no_point_and_one_signal(tmp_path):
    readings = record_of(tmp_path, [ROW.format(time=10 * i, digit=i % 10) for i in range(40)])
    assert is_record(readings)
    assert readings.point.tolist() == list(range(1, 41))
    record = make_record(readings)
    assert (record.channels, len(record)) == ((0,), 40)
    assert record.deviation_v[3, 0] == pytest.approx(1.3e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        (
            [ROW.format(time=10 * i, digit=1) for i in range(12)],
            "12 readings give means in 12 equal intervals",
        ),
        (
            [ROW.format(time=10 * i + 200 * (i > 18), digit=1) for i in range(40)],
            "40 readings give means in 27 equal intervals of time, too few",
        ),
        (["R,,1,1,", "R,2,1,1,"], "time_s is empty in row 1"),
        (["R,1,,1,", "R,2,1,1,"], "reference_v is empty in row 1"),
        (["R,1,1,1,", "R,1,1,1,"], "time_s is the same in all rows"),
        (["R,2,1,1,", "R,1,1,1,"], "runs backwards in row 2; if the clock was put back, give times in UTC"),
    ],
)
def test_a_record_that_cannot_be_evaluated_says_why(tmp_path, rows, told):
    with pytest.raises(CalibrationError, match=told):
        make_record(record_of(tmp_path, rows))


def test_drawn_noise_does_not_depend_on_the_signs_of_eigenvectors():
    """LAPACK chooses them differently on other machines; the covariance of the samples is the noise's."""
    variance, vectors = np.linalg.eigh(next(slow_kernels(np.arange(40.0))))
    signs = np.where(np.arange(40) % 3 == 0, -1.0, 1.0)
    one, other = (
        Noise(variance, v, 5.0, 2.0).drawn(np.random.default_rng(4), 20000)
        for v in (vectors, vectors * signs)
    )
    assert np.allclose(one, other, rtol=0.0, atol=1e-12)
    expected = 2.0 * (np.eye(40) + 5.0 * next(slow_kernels(np.arange(40.0))))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs(np.cov(one) - expected).max() < (5.0 / np.sqrt(20000.0) * np.sqrt(2.0) * scale).max()
