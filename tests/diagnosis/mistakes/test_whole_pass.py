"""A pass that is off as a whole: its angles read wrong by a mark, or another block; effects that are neither."""

from dataclasses import replace

import numpy as np
import pytest

from bench.validation.paper_bench import ARCSEC, U0, K, specific_force
from tests.support.mistaken_runs import find, run

OTHER_K = np.array([[-2.186, -0.015, 0.028], [0.029, -2.148, 0.036], [0.010, 0.009, -2.153]])
OTHER_U0 = np.array([0.057, -0.157, -0.329])


def of_a_pass(rng):
    return str(rng.integers(1, 3)), int(rng.integers(1, 4))


def in_a_pass(where, change):
    """What is added to the signals of a pass: `change` of the force and of the slope du/dphi."""
    return lambda labels, numbers, _phi, force, slope: np.where(
        ((labels == where[0]) & (numbers == where[1]))[:, None], change(force, slope), 0.0
    )


def turned(readings, where, off_rad):
    """A pass with the head elsewhere than its angles say."""
    rows = (readings.installation == where[0]) & (readings.pass_number == where[1])
    angle = readings.angle_rad[rows]
    labels = readings.installation[rows].tolist()
    moved = (specific_force(labels, angle + off_rad) - specific_force(labels, angle)) @ K.T
    signal = readings.signal.copy()
    signal[rows] += moved
    return replace(readings, signal=signal), rows


@pytest.mark.slow
@pytest.mark.parametrize("off_arcmin", [10.0, -60.0])
def test_an_angle_read_wrong_in_a_pass_is_put_right(off_arcmin):
    """An exact mark has odds of 20 or more against any zero, of 7 in one case of 20: it is likelier in both."""
    seed = abs(int(off_arcmin)) + (off_arcmin < 0)
    where, good = of_a_pass(np.random.default_rng([101, seed])), run([102, seed])
    off = np.radians(off_arcmin / 60)
    bad, rows = turned(good, where, off)
    found = find(bad)
    (mistake,) = found.mistakes
    assert (mistake.name, mistake.point) == ("wrong_setting", None)
    assert (mistake.installations, mistake.pass_number) == ((where[0],), where[1])
    assert set(mistake.cannot_tell_from) <= {"head_zero_shift"}
    np.testing.assert_allclose(found.corrected.angle_rad, good.angle_rad + off * rows, atol=1e-12)
    assert mistake.p < 1e-6
    # 162 standardised residuals, 12 coefficients fitted: 0.96, and 5 standard deviations of 0.055
    assert mistake.misfit_after < 1.25


@pytest.mark.parametrize(
    ("off_deg", "everywhere"), [(90.0, False), (-135.0, False), (180.0, False), (90.0, True)]
)
def test_a_head_that_was_stops_off_in_a_pass_is_put_right(off_deg, everywhere):
    """In the pass of one installation, or of both."""
    where, good = of_a_pass(np.random.default_rng([105, 1])), run([106, 1])
    off = np.radians(off_deg)
    bad, rows = turned(good, where, off)
    if everywhere:
        other, more = turned(bad, ("12".replace(where[0], ""), where[1]), off)
        bad, rows = other, rows | more
    found = find(bad)
    (mistake,) = found.mistakes
    assert (mistake.name, mistake.pass_number, mistake.cannot_tell_from) == ("wrong_setting", where[1], ())
    assert mistake.installations == (() if everywhere else (where[0],))
    assert f"the head had been {off_deg:+.0f}° from where it says in" in mistake.words
    turns = (found.corrected.angle_rad - good.angle_rad - off * rows) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    assert mistake.misfit_after < 1.25


@pytest.mark.parametrize("label", ["1", "2"])
def test_a_head_that_was_half_a_turn_off_in_a_mounting_is_one_mistake(label):
    """The other explanation, a block turned by 180 deg, has the same forces."""
    good = run([108, int(label)])
    bad = replace(good, angle_rad=good.angle_rad + np.pi * (good.installation == label))
    (mistake,) = (found := find(bad)).mistakes
    assert (mistake.name, mistake.installations) == ("wrong_setting", (label,))
    assert mistake.cannot_tell_from == ("other_mounting",)
    turns = (found.corrected.angle_rad - good.angle_rad) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)


@pytest.mark.parametrize("stops", [1, -3])
def test_stops_of_a_seventh_of_a_turn_are_put_right_to_the_second(monkeypatch, stops):
    """A seventh of a turn is 17 arcsec less than the nearest minute of arc."""
    plan = [(label, number, point) for label in "12" for number in (1, 2, 3) for point in range(1, 9)]
    labels, numbers, points = (list(column) for column in zip(*plan, strict=True))
    angles = (np.array(points) - 1) * 2 * np.pi / 7
    monkeypatch.setattr("tests.support.mistaken_runs.design", lambda _: (labels, numbers, points, angles))
    good, off = run([107, 1]), stops * 2 * np.pi / 7
    bad, rows = turned(good, ("2", 3), off)
    found = find(bad)
    (mistake,) = found.mistakes
    assert mistake.name == ("shifted_points" if stops == 1 else "wrong_setting")
    turns = (found.corrected.angle_rad - good.angle_rad - off * rows) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=0.1 * ARCSEC / (2 * np.pi))


@pytest.mark.slow
@pytest.mark.parametrize("off_arcsec", [20.0, 560.0])
def test_another_zero_of_the_head_that_is_no_mark_stays_an_effect(off_arcsec):
    """40 arcsec off a mark are 25 standard deviations."""
    seed = int(off_arcsec)
    bad, _ = turned(run([103, seed]), of_a_pass(np.random.default_rng([104, seed])), off_arcsec * ARCSEC)
    assert find(bad).mistakes == ()


@pytest.mark.slow
def test_another_block_in_a_pass_is_named_and_its_pass_left_out():
    where = of_a_pass(np.random.default_rng([105, 0]))
    bad = run([106, 0], added=in_a_pass(where, lambda force, _: force @ (OTHER_K - K).T + OTHER_U0 - U0))
    found = find(bad)
    (mistake,) = found.mistakes
    assert (mistake.name, mistake.channels) == ("another_block", ("x", "y", "z"))
    assert (mistake.installations, mistake.pass_number, mistake.point) == ((where[0],), where[1], None)
    assert mistake.cannot_tell_from == ()
    assert len(found.corrected) == len(bad) - 9
    assert len(found.corrected.skipped) == 1
    assert mistake.misfit_after < 1.25


EFFECTS = {
    "turn of 1 deg about any axis": lambda rng: np.radians(1.0) * rng.normal(size=3),
    "turn of 1 arcmin": lambda rng: np.radians(1.0 / 60) * rng.normal(size=3),
}


@pytest.mark.slow
@pytest.mark.parametrize("effect", EFFECTS)
def test_a_slip_of_the_block_in_a_pass_is_no_other_block(effect):
    rng = np.random.default_rng([107, 0])
    where, vector = of_a_pass(rng), EFFECTS[effect](rng)
    size = np.linalg.norm(vector)
    axis = vector / size

    def slipped(force, _):
        along = np.outer(force @ axis, axis)
        moved = along + np.cos(size) * (force - along) + np.sin(size) * np.cross(axis, force)
        return (moved - force) @ K.T

    found = find(run([108, 0], added=in_a_pass(where, slipped)))
    assert "another_block" not in [one.name for one in found.mistakes]


@pytest.mark.slow
@pytest.mark.parametrize("channels", [1, 3])
def test_other_voltmeters_in_a_pass_are_no_other_block(channels):
    rng = np.random.default_rng([109, channels])
    own = np.arange(3) < channels
    gain, zero = rng.normal(0, 1e-3, 3) * own, rng.normal(0, 5e-3, 3) * own
    meters = in_a_pass(of_a_pass(rng), lambda force, _: (force @ K.T + U0) * gain + zero)
    assert "another_block" not in [m.name for m in find(run([110, channels], added=meters)).mistakes]


@pytest.mark.slow
def test_a_channel_that_is_stuck_in_a_pass_is_named_and_its_pass_left_out():
    """At each value that it may have had, in a channel that moves with the head or across it."""
    for seed in range(3):
        rng = np.random.default_rng([112, seed])
        good, (label, number), channel = run([111, seed]), of_a_pass(rng), seed
        rows = (good.installation == label) & (good.pass_number == number)
        signal = good.signal.copy()
        signal[rows, channel] = signal[rng.choice(np.flatnonzero(rows)), channel]
        found = find(replace(good, signal=signal))
        (mistake,) = found.mistakes
        assert (mistake.name, mistake.channels) == ("stuck_channel", ("xyz"[channel],)), seed
        assert (mistake.installations, mistake.pass_number) == ((label,), number)
        assert len(found.corrected) == len(good) - 9


def test_a_stuck_pass_is_left_out_before_wiring_at_the_verification_points_is_judged():
    """The coefficients that a stuck pass spoils make the right wiring at the points look wrong."""
    good = run([113, 0])
    rows = (good.installation == "1") & (good.pass_number == 3)
    signal = good.signal.copy()
    signal[rows, 2] = 1.51
    found = find(replace(good, signal=signal))
    assert [mistake.name for mistake in found.mistakes] == ["stuck_channel"]
    points = good.installation == "V"
    np.testing.assert_array_equal(found.corrected.signal[-points.sum() :], good.signal[points])
