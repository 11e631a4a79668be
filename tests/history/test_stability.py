"""Static records: Allan deviation and noise terms against closed forms, simulations, a real instrument."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bench.calibration import CalibrationError
from bench.history.stability import averaging, from_columns, read_static, reading_advice, spectrum_of
from bench.readings.csv import ReadingsError
from bench.stats.allan import TERMS, NoiseTerms, allan_curve, fit_terms

DATA = Path(__file__).parents[1] / "data"
STANDARD_GRAVITY = 9.80665
Q, N, B, K, R = range(5)


@cache
def ln100(way):
    return read_static(DATA / f"ln100-{way}.csv")


def test_the_ln100_has_the_allan_deviation_that_is_known_of_it():
    """x: 49 to 67 µg at 1 s, about 1 to 2 µg at 60 s."""
    for way in ("up", "down"):
        record = ln100(way)
        curve = allan_curve(record.signal[:, 0] / STANDARD_GRAVITY, record.interval_s, [64, 3843])
        assert curve.tau_s == pytest.approx([1.0, 60.0], rel=1e-3)
        at_1_s, at_60_s = 1e6 * curve.deviation
        assert 49.0 <= at_1_s <= 67.0
        assert 1.0 <= at_60_s <= 2.0


def test_the_ln100_has_the_bias_that_is_known_of_it():
    """Half the sum of both ways up is the bias: gravity and scale factor drop out."""
    up, down = (ln100(way) for way in ("up", "down"))
    assert up.unit == "m/s^2"
    assert up.interval_s == pytest.approx(1 / 64, rel=2e-3)
    bias_ug = 1e6 * (up.mean[0] + down.mean[0]) / 2 / STANDARD_GRAVITY
    assert bias_ug == pytest.approx(-43.7, abs=0.1)


def test_the_ln100_is_told_to_be_more_than_its_five_terms():
    """Its curve falls as 1/tau, with lines of vibration in it."""
    record = ln100("up")
    terms = fit_terms(allan_curve(record.signal[:, 0], record.interval_s))
    assert terms.shown[Q]
    assert terms.p < 0.001


def test_confidence_limits_hold_as_often_as_they_say():
    """200 records: the truth lies outside 95 % limits 10 times on average, 22 or more with 0.03 %."""
    outside = np.zeros(9)
    for k in range(200):
        curve = allan_curve(np.random.default_rng([13, k]).normal(size=1024), 1.0)
        low, high = curve.limits(curve.freedom(np.zeros(9)))
        truth = 1.0 / np.sqrt(curve.multiples)
        outside += (truth < low) | (truth > high)
    assert np.all(outside < stats.binom.ppf(0.9997, 200, 0.05))


def record_with(rng, n=4096, interval_s=2.0, white=0.0, walk=0.0, drift=0.0):
    """Noise of known terms: N in unit/sqrt(Hz), K in unit/sqrt(s), R in unit/s."""
    fresh = rng.normal(0.0, 1.0, n) * white / np.sqrt(interval_s)
    steps = np.cumsum(rng.normal(0.0, 1.0, n)) * walk * np.sqrt(interval_s)
    return fresh + steps + drift * interval_s * np.arange(n)


@pytest.mark.parametrize(("white", "walk"), [(1e-4, 0.0), (1e-4, 1e-5), (2.0, 0.1)])
def test_noise_terms_come_out_with_an_honest_uncertainty(white, walk):
    z, shown = [], []
    for k in range(40):
        terms = fit_terms(
            allan_curve(record_with(np.random.default_rng([14, k]), white=white, walk=walk), 2.0)
        )
        z.append((terms.values - [0, white, 0, walk, 0]) / terms.u)
        shown.append(terms.shown)
    # mean square of 40: 1 with standard deviation 0.22; terms that cannot be negative take a little from N
    z2 = np.mean(np.array(z)[:, [N] + [K] * bool(walk)] ** 2, axis=0)
    assert np.all(z2 > 1 - 4 * 0.22)
    assert np.all(z2 < 1.3 + 4 * 0.22)
    often = np.mean(shown, axis=0)
    assert often[N] == 1.0
    assert often[K] > 0.95 if walk else often[K] < 0.15
    assert max(often[Q], often[B], often[R]) < 0.2


def test_a_drift_alone_is_named_with_its_rate():
    terms = fit_terms(allan_curve(record_with(np.random.default_rng(15), white=1e-4, drift=1e-7), 2.0))
    assert np.array(TERMS)[terms.shown][-1].symbol == "R"
    assert terms.values[R] == pytest.approx(1e-7, rel=0.03)
    assert terms.slope(1e-3) == pytest.approx(-0.5, abs=0.51)
    assert terms.slope(1e6) == pytest.approx(1.0, abs=1e-3)


def test_averaging_ends_where_the_terms_flatten():
    """White noise and a random walk: log slope -1/4 where K^2 tau/3 is a third of N^2/tau."""
    white, walk = 1e-3, 1e-5
    curve = allan_curve(record_with(np.random.default_rng(16), white=white, walk=walk), 2.0)
    freedom = curve.freedom(np.zeros(len(curve.tau_s)))
    terms = NoiseTerms(np.array([0.0, white**2, 0.0, walk**2, 0.0]), np.zeros((5, 5)), freedom, 1.0)
    found = averaging(curve, terms)
    assert found.why == "longer averages gain little from here"
    assert found.tau_s == pytest.approx(white / walk, rel=0.02)
    assert averaging(curve, fit_terms(curve)).tau_s == pytest.approx(white / walk, rel=0.8)


def test_averaging_of_white_noise_alone_takes_what_the_record_has():
    curve = allan_curve(record_with(np.random.default_rng(18), white=1e-4), 2.0)
    white = NoiseTerms(np.array([0.0, 1e-8, 0.0, 0.0, 0.0]), np.zeros((5, 5)), curve.multiples * 0.0 + 9, 1.0)
    found = averaging(curve, white)
    assert found.tau_s == curve.tau_s[-1] == 2048.0
    assert "too short to show more" in found.why


def test_averaging_for_a_size_is_the_shortest_time_that_surely_reaches_it():
    curve = allan_curve(record_with(np.random.default_rng(17), white=1e-4), 2.0)
    terms = fit_terms(curve)
    found = averaging(curve, terms, 1e-5)
    # N^2/tau = 1e-10 at 100 s; the next of the curve's times with the upper limit below
    assert found.tau_s in {128.0, 256.0}
    assert found.reached
    _, high = curve.limits(terms.freedom)
    assert np.all(high[curve.tau_s < found.tau_s] > 1e-5)
    missed = averaging(curve, terms, 1e-9)
    assert not missed.reached
    assert "not reached" in missed.why


@pytest.mark.parametrize(
    ("tau_s", "samples", "nplc", "takes_s"),
    [
        (2.0, 10, 10.0, 2.0),
        (0.01, 10, 1.0, 0.2),
        (3.0, 15, 10.0, 3.0),
        (60.0, 30, 100.0, 60.0),
        (0.5, 25, 1.0, 0.5),
    ],
)
def test_a_reading_averages_as_long_as_it_should(tau_s, samples, nplc, takes_s):
    advice = reading_advice(tau_s, 50.0, (0.02, 0.2, 1.0, 10.0, 100.0), 512)
    assert (advice.samples, advice.nplc) == (samples, nplc)
    assert advice.tau_s == pytest.approx(takes_s)
    assert advice.line() == f"reading: {{samples: {samples}, nplc: {nplc:g}}}"


def test_what_no_reading_can_average_is_refused():
    with pytest.raises(
        CalibrationError, match=r"takes 5000 samples of 100 power-line cycles, but .* 512 at most"
    ):
        reading_advice(1e4, 50.0, (1.0, 10.0, 100.0), 512)


def write(tmp_path, text):
    path = tmp_path / "still.csv"
    path.write_text(text)
    return path


def rows(times, value="1.0"):
    return "".join(f"{t},{value},2.0,3.0{k % 2}\n" for k, t in enumerate(times))


HEADER = "time_s,ux_v,uy_v,uz_v\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("time_s,ux_v,uy_v\n0,1,2\n", r"line 1: the header lacks uz_v"),
        ("ux_g,uy_g,uz_g\n1,2,3\n", r"line 1: the header lacks time_s"),
        ("time_s,ux_v,uy_g,uz_v\n0,1,2,3\n", r"different units \(v, g\)"),
        (
            HEADER + "0,1,2,3\n1,nan,2,3\n2,1,,3\n",
            r"line 3, column ux_v: .*'nan'\n.*line 4, column uy_v: .*''",
        ),
        (HEADER + "0,9.9E37,2,3\n", r"line 2, column ux_v: the voltmeter was overloaded \(9.9E37\)"),
        ("", "empty; expected a header line such as time_s,ux_v"),
    ],
)
def test_a_file_that_is_no_static_record_says_where(tmp_path, text, told):
    with pytest.raises(ReadingsError, match=told):
        read_static(write(tmp_path, text))


@pytest.mark.parametrize(
    ("times", "told"),
    [
        (range(10), "10 samples are too few for an Allan deviation; record 32"),
        ([*range(20), *range(25, 45)], r"not uniform: 6 s after sample 20 \(at 19 s\), 1 s elsewhere"),
        ([*range(20), *range(10, 40)], "does not rise after sample 20"),
        (np.cumsum(np.linspace(1.0, 1.3, 100)), r"interval changes by \d+\.\d % along the record"),
    ],
)
def test_times_that_are_not_steady_are_refused(tmp_path, times, told):
    with pytest.raises(CalibrationError, match=told):
        read_static(write(tmp_path, HEADER + rows(times)))


def test_times_rounded_to_the_last_digit_are_steady_and_other_columns_are_left_aside(tmp_path):
    text = "installation,time_s,ux_counts,uy_counts,uz_counts\n"
    text += "".join(f"1,{k / 64:.3f},{k % 3},{k % 5},{k % 7}\n" for k in range(200))
    record = read_static(write(tmp_path, text))
    assert (record.unit, len(record.signal)) == ("counts", 200)
    assert record.interval_s == pytest.approx(1 / 64, rel=1e-3)


def test_a_signal_that_never_changes_has_no_allan_deviation():
    record = from_columns("memory", "V", np.arange(40.0), np.ones((40, 3)))
    with pytest.raises(CalibrationError, match="same in every sample"):
        allan_curve(record.signal[:, 0], record.interval_s)


def test_drift_and_mean_are_those_of_a_straight_line():
    time_s = np.arange(100) * 0.1
    record = from_columns("memory", "V", time_s, np.outer(time_s, [1.0, -2.0, 0.0]) + 5.0)
    assert record.drift_per_s == pytest.approx([1.0, -2.0, 0.0], abs=1e-12)
    assert record.mean == pytest.approx(5.0 + 4.95 * np.array([1.0, -2.0, 0.0]))


def test_the_spectrum_of_white_noise_is_twice_the_square_of_its_allan_term_and_shows_a_line():
    """Seed 17, N = 1e-4 V/sqrt(Hz), a line of 1 mV at 0.1 Hz in z: density 2 N², power A²/2."""
    rng, n, interval_s, white = np.random.default_rng(17), 16384, 2.0, 1e-4
    time = interval_s * np.arange(n)
    signal = rng.normal(0.0, white / np.sqrt(interval_s), (n, 3)) + 1e-6 * time[:, None]
    signal[:, 2] += 1e-3 * np.sin(2 * np.pi * 0.1 * time)
    found = spectrum_of(from_columns("x", "V", time, signal))
    assert (found.segments, found.density.shape) == (15, (1024, 3))
    # 1024 frequencies of 15 segments, overlapping by half: the mean is known to 1 %
    assert np.mean(found.density[:, :2]) == pytest.approx(2 * white**2, rel=0.05)
    line = found.density[:, 2]
    at = int(np.argmax(line))
    step = found.frequency_hz[1] - found.frequency_hz[0]
    assert found.frequency_hz[at] == pytest.approx(0.1, abs=step)
    assert np.sum(line[at - 3 : at + 4]) * step == pytest.approx(0.5e-6, rel=0.02)
