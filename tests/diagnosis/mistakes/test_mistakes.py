"""Mistakes of procedure and wiring: put into runs of the paper bench's own simulation, and looked for."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration import CalibrationError
from bench.diagnosis.mistakes.search import find_mistakes
from bench.validation.paper_bench import ARCSEC, STAND_U, U0, K, design
from tests.support.mistaken_runs import (
    EFFECTS,
    MODEL,
    NOISE_V,
    NOMINAL,
    ORDERS,
    find,
    keys,
    outlier_v,
    place,
    run,
    turned_back,
    with_outlier,
    with_signal,
)


def spoil(name, scope, seed):
    """Return the good run, the spoiled one, and what is to be found (installations, pass, channels)."""
    rng = np.random.default_rng([17, seed])
    good = run([18, seed])
    mask, installations, number = place(rng, good, scope)
    channels = ()
    if name == "swapped_channels":
        order = ORDERS[rng.integers(5)]
        channels = tuple("xyz"[i] for i in range(3) if order[i] != i)
        # the signal of channel i comes out where channel order[i] is written
        bad = with_signal(good, mask, lambda signal: signal[:, np.argsort(order)])
    elif name == "reversed_polarity":
        channel = int(rng.integers(3))
        channels = ("xyz"[channel],)
        bad = with_signal(good, mask, lambda signal: signal * np.where(np.arange(3) == channel, -1, 1))
    elif name == "reversed_rotation":
        bad = turned_back(good, mask)
    elif name == "swapped_installations":
        mask &= good.installation != "V"
        if number is not None:
            mask = (good.pass_number == number) & (good.installation != "V")
        installations = ("1", "2")
        other = np.where(good.installation == "1", "2", "1")
        bad = replace(good, installation=np.where(mask, other, good.installation))
    else:
        step = int(rng.choice([-1, 1]))
        bad = good
        for label in "12":
            for p in (1, 2, 3):
                rows = mask & (good.installation == label) & (good.pass_number == p)
                bad = with_signal(bad, rows, lambda signal: np.roll(signal, step, axis=0))
    return good, bad, (installations, number, channels)


ALIKE = {
    ("reversed_polarity", ("x",)): ("reversed_rotation",),
    ("reversed_polarity", ("y",)): ("other_mounting",),
    ("reversed_polarity", ("z",)): ("other_mounting",),
}
"""What one channel's sign in the whole run cannot be told from."""

EVERYWHERE = [
    (name, scope)
    for name in (
        "swapped_channels",
        "reversed_polarity",
        "reversed_rotation",
        "swapped_installations",
        "shifted_points",
    )
    for scope in ("run", "installation", "pass")
    if (name, scope) != ("swapped_installations", "installation")
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "scope"), EVERYWHERE)
def test_a_gross_mistake_is_found_named_placed_and_put_right(name, scope):
    good, bad, (installations, number, channels) = spoil(name, scope, EVERYWHERE.index((name, scope)))
    result = find(bad)
    (mistake,) = result.mistakes
    assert (mistake.installations, mistake.pass_number) == (installations, number)
    assert mistake.p < 1e-50
    assert mistake.misfit_before > 1.5
    # 162 standardised residuals, 12 coefficients fitted: 0.96, and 5 standard deviations of 0.055
    assert mistake.misfit_after < 1.25
    if name == "reversed_rotation" and scope == "run":
        # nothing but the sign of cross-axis terms and of the bias tells it from channel x reversed
        assert mistake.name == "reversed_polarity"
        assert mistake.cannot_tell_from == ("reversed_rotation",)
        return
    assert (mistake.name, mistake.channels) == (name, channels)
    if name == "reversed_polarity" and scope == "run":
        assert mistake.cannot_tell_from == ALIKE[name, channels]
    corrected = result.corrected
    if name == "shifted_points":
        # at one end of each pass a row has lost its reading
        assert len(good) - len(corrected) == {"run": 6, "installation": 3, "pass": 1}[scope]
    good = good.select(np.array([key in keys(corrected) for key in keys(good)]))
    np.testing.assert_array_equal(corrected.signal, good.signal)
    np.testing.assert_array_equal(corrected.angle_rad, good.angle_rad)
    np.testing.assert_array_equal(corrected.installation, good.installation)


@pytest.mark.parametrize(
    ("name", "channels", "order", "signs"),
    [
        ("swapped_channels", ("x", "y"), (1, 0, 2), (1, 1, 1)),
        ("swapped_channels", ("x", "y", "z"), (2, 0, 1), (1, 1, 1)),
        ("reversed_polarity", ("z",), (0, 1, 2), (1, 1, -1)),
    ],
)
def test_a_wrong_wiring_at_the_verification_points_alone_is_named_and_put_right(name, channels, order, signs):
    """The other readings stay as they are; points that are right, or 1 mg off, are no wrong wiring."""
    good = run(4)
    points = good.installation == "V"
    result = find(with_signal(good, points, lambda signal: signal[:, np.argsort(order)] * signs))
    (mistake,) = result.mistakes
    assert (mistake.name, mistake.channels, mistake.installations) == (name, channels, ("V",))
    np.testing.assert_array_equal(result.corrected.signal, good.signal)
    assert find(good).mistakes == ()
    assert find(with_signal(good, points, lambda signal: signal * 1.001)).mistakes == ()


@pytest.mark.slow
def test_signs_and_order_of_channels_are_put_right_in_free_and_input_rows_too():
    good = run(3)
    labels = good.installation.copy()
    labels[-3:] = ["F", "S", "R"]
    good = replace(good, installation=labels)
    everything = np.ones(len(good), dtype=bool)
    swapped = find(with_signal(good, everything, lambda signal: signal[:, [0, 2, 1]])).corrected
    np.testing.assert_array_equal(swapped.signal, good.signal)
    turned = find(with_signal(good, everything, lambda signal: signal * [1, -1, 1])).corrected
    np.testing.assert_array_equal(turned.signal[:-1], good.signal[:-1])
    # a reference has its own sign, wherever the block's wires go
    np.testing.assert_array_equal(turned.signal[-1], good.signal[-1] * [1, -1, 1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "noise_v"), [("1 deg", 30e-6), ("10 arcmin", 15e-6), ("1 arcmin", 30e-6), ("reflected", 15e-6)]
)
def test_a_wrong_setting_is_found_and_its_angle_put_right(size, noise_v):
    rng = np.random.default_rng(21)
    # a reflected angle is none at 0 and 180 degrees
    row = int(rng.choice([r for r in range(54) if size != "reflected" or r % 9 not in {0, 4, 8}]))
    stated = design()[3][row]
    sizes = {"1 deg": 1, "10 arcmin": 1 / 6, "1 arcmin": 1 / 60}
    off = -2 * stated if size == "reflected" else rng.choice([-1, 1]) * np.radians(sizes[size])
    readings = run(22, noise_v=noise_v, off=(row, off))
    result = find(readings)
    (mistake,) = result.mistakes
    assert mistake.name == "wrong_setting"
    assert (mistake.installations, mistake.pass_number, mistake.point) == (
        (str(readings.installation[row]),),
        readings.pass_number[row],
        readings.point[row],
    )
    true = result.corrected.angle_rad[row]
    assert f"at {round(np.degrees(true) % 360, 4):.8g}° and not at {np.degrees(stated):g}°" in mistake.words
    assert np.cos(true - stated - off) == pytest.approx(1.0, abs=1e-12)
    assert np.delete(result.corrected.angle_rad, row) == pytest.approx(np.delete(readings.angle_rad, row))
    assert mistake.misfit_after < 1.25
    assert mistake.misfit_before > mistake.misfit_after


@pytest.mark.slow
def test_an_outlier_is_found_and_its_reading_left_out():
    for seed in (1, 8):
        rng = np.random.default_rng([23, seed])
        good = run([24, seed])
        row = 27 if seed == 1 else int(rng.integers(54))  # the first reading of a mounting, or any
        channel, sigma = int(rng.integers(3)), float(rng.choice([20, 30, 300, 1e5]))
        bad = with_outlier(good, row, channel, outlier_v(good, row, channel, sigma, NOISE_V))
        result = find(bad)
        (mistake,) = result.mistakes
        assert "outlier" in (mistake.name, *mistake.cannot_tell_from), seed
        assert (mistake.installations, mistake.pass_number, mistake.point) == (
            (str(good.installation[row]),),
            good.pass_number[row],
            good.point[row],
        )
        assert mistake.misfit_after < 1.25
        if mistake.name == "outlier":
            assert mistake.channels == ("xyz"[channel],)
            place = (good.installation[row], good.pass_number[row], good.point[row])
            told = "installation {}, pass {}, point {}: channel {} by ".format(*place, "xyz"[channel])
            assert mistake.words.startswith(told)
            assert keys(result.corrected) == keys(good)[:row] + keys(good)[row + 1 :]
            assert len(result.corrected.skipped) == 1


@pytest.mark.slow
@pytest.mark.parametrize("size_ug", [20, 180])
def test_hysteresis_that_is_off_in_a_first_reading_is_no_outlier(size_ug):
    def friction(labels, numbers, _phi, force, _slope):
        way = np.diff(force, axis=0, prepend=force[:1])
        way[np.append(True, labels[1:] != labels[:-1])] = 0.0  # at rest when it was mounted
        return size_ug * 1e-6 * np.diag(K) * np.tanh(way / 0.1)

    assert find(run([27, size_ug], added=friction)).mistakes == ()


@pytest.mark.slow
def test_a_slip_and_another_voltmeter_in_one_pass_are_no_outliers():
    def of_one_pass(rng, moved):
        label, number = rng.choice(["1", "2"]), int(rng.integers(1, 4))
        return lambda labels, numbers, _phi, force, _slope: np.where(
            ((labels == label) & (numbers == number))[:, None], moved(force), 0.0
        )

    rng = np.random.default_rng([28, 0])
    turn = rng.normal(size=3)
    turn *= rng.uniform(25, 40) * ARCSEC / np.linalg.norm(turn)
    gain = rng.uniform(1e-4, 2e-4, 3) * rng.choice([-1.0, 1.0], 3)
    for name, moved in {
        "slip": lambda force: np.cross(force, turn) @ K.T,
        "voltmeter": lambda force: (force @ K.T + U0) * gain,
    }.items():
        assert find(run([29, 0], added=of_one_pass(rng, moved))).mistakes == (), name


@pytest.mark.slow
def test_two_outliers_in_one_pass_are_found():
    """Of 20 to 60 standard deviations, in readings that are not next to each other: no slip explains them."""
    rng = np.random.default_rng([44, 0])
    good = bad = run([45, 0])
    first = 9 * int(rng.integers(6))
    rows = [first + 2, first + 5]
    for row in rows:
        channel, sigma = int(rng.integers(3)), float(rng.uniform(20, 60))
        bad = with_outlier(bad, row, channel, outlier_v(good, row, channel, sigma, NOISE_V))
    told = {(m.pass_number, m.point) for m in find(bad).mistakes}
    assert told == {(good.pass_number[row], good.point[row]) for row in rows}


@pytest.mark.slow
def test_an_outlier_of_eight_times_the_noise_may_be_a_tail_and_is_no_mistake():
    for seed in range(3):
        rng = np.random.default_rng([25, seed])
        row, channel = int(rng.integers(54)), int(rng.integers(3))
        assert not find(with_outlier(run([26, seed]), row, channel, 8 * NOISE_V)).mistakes, seed


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is_wrong():
    # each run fires with a probability below 1e-4; three noises, and one, two and three passes
    for seed in range(2, 6):
        readings = run([31, seed], noise_v=(15e-6, 30e-6, 100e-6)[seed % 3], passes=(3, 3, 2, 1)[seed % 4])
        result = find(readings)
        assert result.mistakes == (), seed
        assert result.corrected is readings


@pytest.mark.slow
@pytest.mark.parametrize("effect", EFFECTS)
def test_a_large_effect_is_no_mistake(effect):
    assert find(run([32, list(EFFECTS).index(effect)], **EFFECTS[effect])).mistakes == ()


@pytest.mark.slow
def test_a_mistake_is_found_beside_a_large_effect():
    for seed, options in list(enumerate(EFFECTS.values()))[::4]:  # one of the block, of time, of a mounting
        readings = run([33, seed], off=(22, np.radians(1 / 6)), **options)
        everything = np.ones(len(readings), dtype=bool)
        result = find(with_signal(readings, everything, lambda signal: signal[:, [1, 0, 2]]))
        assert [m.name for m in result.mistakes] == ["swapped_channels", "wrong_setting"], seed


PAIRS = {
    "two wrong settings": ["wrong_setting", "wrong_setting"],
    "outlier and wrong setting": ["outlier", "wrong_setting"],
    "swapped channels and outlier": ["outlier", "swapped_channels"],
    "polarity in one pass and a reversed head in the other installation": [
        "reversed_polarity",
        "reversed_rotation",
    ],
    "swapped channels in one installation, the head reversed in the other": [
        "reversed_rotation",
        "swapped_channels",
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_two_mistakes_are_found(pair):
    seed = list(PAIRS).index(pair)
    rng = np.random.default_rng([41, seed])
    first, second = (int(r) for r in rng.choice([r for r in range(1, 54) if r != 27], 2, replace=False))
    off = None if "setting" not in pair else (first, np.radians(1 / 60) * rng.choice([-1, 1]))
    bad = run([42, seed], off=off)
    in_1, in_2 = bad.installation == "1", bad.installation == "2"
    if pair == "two wrong settings":
        angle = bad.angle_rad.copy()
        angle[second] += np.radians(1.0)
        bad = replace(bad, angle_rad=angle)
    if "outlier" in pair:
        bad = with_outlier(bad, second, int(rng.integers(3)), 7e-3)
    if "swapped channels and" in pair:
        bad = with_signal(bad, np.ones(len(bad), dtype=bool), lambda signal: signal[:, [2, 1, 0]])
    if "polarity" in pair:
        bad = with_signal(bad, in_1 & (bad.pass_number == 2), lambda signal: signal * [-1, 1, 1])
    if "swapped channels in" in pair:
        bad = with_signal(bad, in_1, lambda signal: signal[:, [2, 1, 0]])
    if "head" in pair:
        bad = turned_back(bad, in_2)
    before = {name: np.array(getattr(bad, name)) for name in ("signal", "angle_rad", "installation", "point")}
    result = find(bad)
    assert sorted(m.name for m in result.mistakes) == PAIRS[pair]
    assert result.mistakes[-1].misfit_after < 1.25
    for name, column in before.items():  # the record is left as it is
        np.testing.assert_array_equal(getattr(bad, name), column)


@pytest.mark.slow
def test_a_single_pass_shows_gross_mistakes_and_large_slips():
    good = run(51, passes=1)
    everything = np.ones(len(good), dtype=bool)
    (swap,) = find(with_signal(good, everything, lambda signal: signal[:, [1, 0, 2]])).mistakes
    assert (swap.name, swap.channels) == ("swapped_channels", ("x", "y"))
    (slip,) = find(run(51, passes=1, off=(5, np.radians(1)))).mistakes
    assert (slip.name, slip.point) == ("wrong_setting", 6)


@pytest.mark.slow
def test_a_block_with_all_signs_against_its_data_sheet_is_told_channel_by_channel():
    result = find_mistakes(run(53), MODEL, STAND_U, -NOMINAL)
    assert [m.name for m in result.mistakes] == ["reversed_polarity"] * 3
    assert {m.channels for m in result.mistakes} == {("x",), ("y",), ("z",)}


def test_without_a_data_sheet_what_the_coefficients_take_up_is_not_seen():
    good = run(52)
    everything, in_2 = np.ones(len(good), dtype=bool), good.installation == "2"
    swap = [1, 0, 2]
    whole = with_signal(good, everything, lambda signal: signal[:, swap])
    assert find_mistakes(whole, MODEL, STAND_U, None).mistakes == ()
    part = with_signal(good, in_2, lambda signal: signal[:, swap])
    (mistake,) = find_mistakes(part, MODEL, STAND_U, None).mistakes
    # which of the two installations was wired as intended, nobody can tell
    assert mistake.name == "swapped_channels"
    assert "the same in installation" in mistake.words


def test_a_reading_that_is_no_number_is_refused_with_its_place():
    readings = run(62)
    bad = with_outlier(readings, 12, 0, np.nan)
    with pytest.raises(CalibrationError, match="installation 1, pass 2, point 4"):
        find(bad)


@pytest.mark.slow
@pytest.mark.parametrize("late", [False, True])
def test_a_head_that_was_not_turned_and_points_exchanged_are_wrong_settings(late):
    """The signals are those of the stop before; where points are exchanged those of the stop after, too."""
    row = int(np.random.default_rng([51, 0]).choice([r for r in range(54) if r % 9]))
    angle = design()[3]
    step = float(angle[row - 1] - angle[row])
    good = run([52, 0], off=(row, step))
    rows = [row]
    if late:
        rows, order = [row - 1, row], np.arange(len(good))
        order[[row - 1, row]] = row, row - 1
        straight = run([52, 0])
        good = replace(straight, signal=straight.signal[order])
    found = find(good)
    assert {m.name for m in found.mistakes} == {"wrong_setting"}
    places = {(m.pass_number, m.point) for m in found.mistakes}
    assert places == {(good.pass_number[r], good.point[r]) for r in rows}
    if not late:
        assert found.corrected.angle_rad[row] == pytest.approx(angle[row - 1], abs=1e-12)


def test_a_mistake_is_not_said_to_look_like_itself():
    """All channels reversed: each looks like the others; a pass of the other installation, like its exchange."""
    good = run(7)
    reversed_all = find(replace(good, signal=-good.signal)).mistakes[0]
    assert reversed_all.words.endswith("the same of y in the whole run, the same of z in the whole run")
    moved = (good.installation == "2") & (good.pass_number == 1)
    labels, numbers = np.where(moved, "1", good.installation), np.where(moved, 4, good.pass_number)
    (placed,) = find(replace(good, installation=labels, pass_number=numbers)).mistakes
    assert placed.name == "swapped_installations"
    assert placed.words.endswith(
        "cannot separate it from this: installations 1 and 2 are exchanged in pass 4"
    )
