"""Slips, zeros set anew and exchanged meters are found, named and closed; noise that is too large is a finding."""

from dataclasses import replace

import numpy as np
import pytest

from bench.base.arrays import ARCSEC
from bench.diagnosis import Threshold, ThresholdCache, diagnose
from bench.diagnosis.candidates import spells
from bench.diagnosis.noise_kinds import BENCH_FILE, OWN_SCATTER, noise_findings
from bench.diagnosis.posterior import NoiseSize
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, paper_run
from tests.support.paper_bench import K

SEED = 61


class Fixed(ThresholdCache):
    """A threshold that nobody simulated, about that of the paper's design."""

    def threshold(self, linear, whitened, setting_rad):
        return Threshold(2.5, 0.006, 1.0, 0.05, 1.0, 2000)


def turned(readings, rows, axis, angle_rad):
    """Readings of a block that stands turned about an axis of the platform in some rows: exact, by Rodrigues.

    In installation 1 the axes of block and platform are the same.
    """
    bias = readings.signal.mean(axis=0)
    bias = np.linalg.lstsq(
        np.column_stack([np.sin(readings.angle_rad), np.cos(readings.angle_rad), np.ones(len(readings))])[
            rows
        ],
        readings.signal[rows],
        rcond=None,
    )[0][2]
    force = np.linalg.solve(K, (readings.signal - bias).T).T
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * cross @ cross
    return replace(readings, signal=np.where(rows[:, None], force @ turn.T @ K.T + bias, readings.signal))


def in_pass(readings, mount, *numbers):
    return (readings.installation == mount) & np.isin(readings.pass_number, numbers)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.02, 1.0])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_a_slip_is_in_the_set_and_the_noise_stays_what_it_is(axis, degrees):
    """From pass 2 on, up to a degree, where second order is ten times the noise."""
    readings = paper_run(np.random.default_rng(SEED))
    slipped = turned(readings, in_pass(readings, "1", 2, 3), axis, np.radians(degrees))
    found = diagnose(slipped, MODEL, STAND, np.diag(K), Fixed(None))
    assert found.verdict in {"named", "confounded"}
    (effect,) = found.effects
    assert "block_slip" in {effect.name, *effect.cannot_tell_from}
    assert found.noise.reading < 1.5 * NOISE_V
    assert not found.findings


@pytest.mark.slow
def test_a_slip_within_a_pass_is_noise_that_nobody_stated():
    """In pass 2 from its third point on: what is left is larger than stated."""
    readings = paper_run(np.random.default_rng(SEED))
    rows = in_pass(readings, "1", 2) & (readings.point > 2)
    slipped = turned(readings, rows, (0.6, 0.0, 0.8), np.radians(0.3))
    n = len(readings)
    sampled = replace(slipped, samples=np.full(n, 10), signal_sd=np.full((n, 3), NOISE_V * np.sqrt(10)))
    found = diagnose(sampled, MODEL, STAND, np.diag(K), Fixed(None))
    assert found.verdict == "unknown"


def test_a_slip_has_a_part_of_the_false_alarms_to_itself():
    """A sixth: either alone is then as rare as both together where it is that much rarer by itself."""
    limit = Threshold(2.5, 0.006, 1.0, 0.05, 1.0, 2000, slip=Threshold(9.0, 0.006, 6.0, 0.05, 1.0, 2000))
    limit = limit.at(0.006)
    assert limit.value == pytest.approx(1.0 + np.log(0.05 / 0.005))
    assert limit.slip.value == pytest.approx(6.0 + np.log(0.05 / 0.001))
    assert limit.p(limit.value) == pytest.approx(0.006)
    assert limit.p(-1.0, limit.slip.value) == pytest.approx(0.006)
    assert limit.reached(limit.value, 0.0)
    assert limit.reached(-1.0, limit.slip.value)
    assert not limit.reached(limit.value - 0.1, limit.slip.value - 0.1)
    without = replace(limit, slip=None).at(0.006)
    assert not without.reached(-1.0, 1e9)
    assert without.p(without.value) == pytest.approx(0.006)


class OfSlips(ThresholdCache):
    """A threshold that only a slip reaches, about that of the paper's design."""

    def threshold(self, linear, whitened, setting_rad):
        return Threshold(1e9, 0.006, 1e8, 0.05, 1.0, 2000, slip=Threshold(10.0, 0.001, 6.0, 0.05, 1.0, 2000))


@pytest.mark.slow
def test_a_slip_is_found_by_its_likelihood_where_all_sizes_and_axes_cost_too_much():
    """Of 15 arcsec in one pass, about an axis between the others; nothing is found where it did not slip."""
    readings = paper_run(np.random.default_rng(SEED))
    axis = np.array([0.6, 0.0, 0.8])
    slipped = turned(readings, in_pass(readings, "2", 3), axis, 15 * ARCSEC)
    found = diagnose(slipped, MODEL, STAND, np.diag(K), OfSlips(None))
    assert [effect.name for effect in found.effects] == ["block_slip"]
    assert found.effects[0].p_all_looks < 0.006
    assert diagnose(readings, MODEL, STAND, np.diag(K), OfSlips(None)).verdict == "agrees"


def test_spells_are_named_once():
    """Two installations of three passes and the verification points: neither is mounted twice."""
    readings = paper_run(None)
    passes = [
        [(f"{i} pass 2", f"{i} pass 3"), (f"{i} pass 3",), (f"{i} pass 1",), (f"{i} pass 2",)] for i in "12"
    ]
    assert list(spells(readings, lasting=False)) == [*passes[0], *passes[1]]
    own = [*passes[0], ("1",), *passes[1], ("2",)]
    more = list(spells(readings, lasting=True))
    assert more[: len(own)] == own
    assert more[len(own) :] == [
        ("1 pass 2", "1 pass 3", "2", "V"), ("1 pass 3", "2", "V"), ("2", "V"),
        ("2 pass 2", "2 pass 3", "V"), ("2 pass 3", "V"), ("V",),
    ]  # fmt: skip


def test_a_second_visit_is_a_spell_of_its_own():
    readings = paper_run(None, verification=False)
    again = np.where(in_pass(readings, "1", 3), 2, 1)
    labels = list(spells(replace(readings, series=again), lasting=False))
    assert {("1",), ("1/2",), ("1 pass 2",)} <= set(labels)
    assert ("2",) not in labels


def return_run(rng, slip_arcsec):
    """The paper's run with a pass of installation 1 mounted anew, in which the block sits turned."""
    readings = paper_run(rng)
    again = in_pass(readings, "1", 3)
    slipped = turned(readings, again, (1, 0, 0), slip_arcsec * ARCSEC)
    return replace(slipped, series=np.where(again, 2, 1))


@pytest.mark.slow
def test_a_slip_of_a_visit_is_a_mounting_angle_of_it_and_that_is_said():
    found = diagnose(return_run(np.random.default_rng(SEED), 60), MODEL, STAND, np.diag(K), Fixed(None))
    assert found.verdict == "confounded"
    (effect,) = found.effects
    alike = {"block_slip", "mounting_roll"}
    assert alike <= {effect.name, *effect.cannot_tell_from}
    (told,) = (note for note in found.notes if "the very same" in note)
    assert alike <= set(told.replace(":", "").replace(",", "").split())


def test_a_roll_of_the_block_is_named_alone_where_verification_points_show_it():
    """In installations that are mounted once nothing says that the block slipped: it sits rolled."""
    readings = paper_run(np.random.default_rng(SEED))
    rolled = turned(readings, readings.installation == "1", (1, 0, 0), 90 * ARCSEC)
    found = diagnose(rolled, MODEL, STAND, np.diag(K), Fixed(None))
    (effect,) = found.effects
    assert "block_slip" not in {effect.name, *effect.cannot_tell_from}
    assert "mounting_roll" in {effect.name, *effect.cannot_tell_from}


# --- noise that is larger than stated ---------------------------------------------------------------


def sampled(sd_v):
    readings = paper_run(None)
    n = len(readings)
    return replace(readings, samples=np.full(n, 10), signal_sd=np.full((n, 3), sd_v))


def findings(reading_v, setting_arcsec, readings, **stated):
    noise = NoiseSize(reading_v, setting_arcsec * ARCSEC, 150)
    return noise_findings(noise, readings, stated, 2.2)


def test_the_larger_of_the_readings_own_scatter_and_the_bench_file_counts():
    """45 uV over 10 samples are 14 uV, rounding to 0.1 uV adds nothing."""
    assert findings(150e-6, 0.0, sampled(45e-6), voltmeter_error=100e-6) == ()
    (stated,) = findings(949e-6, 0.0, sampled(45e-6), voltmeter_error=100e-6)
    assert (stated.source, stated.stated) == (BENCH_FILE, 100e-6)
    (found,) = findings(40e-6, 0.0, sampled(45e-6), voltmeter_error=10e-6)
    assert (found.what, found.source) == ("reading", OWN_SCATTER)
    assert found.stated == pytest.approx(45e-6 / np.sqrt(10), rel=1e-3)
    assert found.factor == pytest.approx(40e-6 / found.stated)
    assert found.p < 1e-9
    assert "readings' own scatter" in found.words


@pytest.mark.parametrize("reading_v", [1e-6, 14e-6, 28e-6])
def test_noise_that_is_smaller_or_less_than_twice_as_large_is_none(reading_v):
    assert findings(reading_v, 3.3, sampled(45e-6), setting_error=3.3 * ARCSEC) == ()


def test_without_samples_the_bench_file_counts():
    (found,) = findings(949e-6, 0.0, paper_run(None), voltmeter_error=100e-6)
    assert (found.source, found.stated) == (BENCH_FILE, 100e-6)
    assert findings(949e-6, 0.0, replace(paper_run(None), unit="counts"), voltmeter_error=100e-6) == ()


def test_a_setting_error_is_a_finding_where_it_shows():
    """20 arcsec for 3 show 210 uV beside 15 uV; beside 1 mV of noise they do not."""
    (found,) = findings(15e-6, 20.0, paper_run(None), setting_error=3 * ARCSEC)
    assert found.what == "setting"
    assert found.unit == "arcsec"
    assert findings(1e-3, 20.0, paper_run(None), setting_error=3 * ARCSEC) == ()
