"""Checks for mistakes in a table of readings (angle unit, saturation, signal unit) and for an implausible block."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints, Mask, least_squares, rms
from bench.base.languages import message
from bench.calibration.design import Problem
from bench.calibration.result import (
    Calibration,
    CalibrationError,
    DeviatingReadings,
    FaultyReadings,
    SpoiledFit,
)
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block, linear_columns, within_half_turn
from bench.readings.columns import OVERLOAD
from bench.readings.table import REFERENCE, SHORTED, Readings

POINTS: Final = 9
"""Number of test points in the paper."""
NOMINAL_RAD: Final = np.radians(45.0) * np.arange(POINTS)

OTHER_UNITS: Final = {message("radians"): 180.0 / np.pi, "gon": 0.9, message("whole turns"): 360.0}
BADLY: Final = 1e-3
"""Unexplained fraction of the signal variance: a wrong angle unit leaves more than this, the right unit less."""
MUCH_BETTER_ANGLES: Final = 1e-2

CLIPPED: Final = 3
"""Least number of equal readings at the end of a channel's range that may indicate saturation."""
CLIPPED_FREE: Final = 4
FAR_APART: Final = 0.05
LEAST_CLIPPED: Final = 1e-4
"""Saturation needs a predicted excess above this fraction of the range: repeats may be equal by chance."""

COPLANAR: Final = 0.02
"""Least singular value of K, its rows scaled to unit length: real axes are orthogonal within arcminutes."""
ALIKE: Final = 0.999
NO_ANSWER: Final = 5.0

MOST_NAMED: Final = 3
LEAST_ABSOLUTE_STEPS: Final = 30
FAR_OFF: Final = 10.0
FAR_OFF_OF_SIGNAL: Final = 0.02
"""A row is far off if it deviates by more than so many medians, and by more than this fraction of the signal."""

FARTHEST_NOMINAL_RAD: Final = np.radians(1.0)


def require_numbers(rows: Readings, *, angles: bool) -> None:
    """Raise `FaultyReadings` for an overloaded signal or one that is no number.

    With `angles`, an angle that is no number raises it, too.
    """
    bad = np.asarray(~np.isfinite(rows.signal).all(axis=1))
    if np.any(bad):
        raise FaultyReadings(f"{_place(rows, bad)} has a signal that is not a number; remove this reading")
    bad = ~np.isfinite(rows.angle_rad)
    if angles and np.any(bad):
        raise FaultyReadings(f"{_place(rows, bad)} has an angle that is not a number; remove this reading")
    over = np.asarray((np.abs(rows.signal) >= OVERLOAD).any(axis=1))
    if np.any(over):
        raise FaultyReadings(
            f"{_place(rows, over)} has an overloaded voltmeter; measure it again on a higher range, or leave "
            "this reading out"
        )


def _place(rows: Readings, mask: Mask) -> str:
    return f"{rows.source}: {_row_of(rows, int(np.argmax(mask)))}"


def _row_of(rows: Readings, i: int) -> str:
    return message(f"installation {rows.installation[i]}, pass {rows.pass_number[i]}, point {rows.point[i]}")


def refuse_wrong_angle_unit(problem: Problem, signal: Floats, residuals: Floats) -> None:
    """Raise `FaultyReadings` if the angles fit poorly in degrees, but well in another unit.

    `residuals` (n, 3) are the residuals of ordinary least squares to `signal` (n, 3).
    """
    whole = float(np.sum((signal - signal.mean(axis=0)) ** 2))
    as_given = float(np.sum(residuals**2))
    if as_given <= BADLY * whole:
        return
    left = {unit: _left(problem, signal, factor) for unit, factor in OTHER_UNITS.items()}
    unit = min(left, key=lambda name: left[name])
    if left[unit] < MUCH_BETTER_ANGLES * as_given and left[unit] < BADLY * whole:
        raise FaultyReadings(
            f"the angles look like {unit}, not degrees: read as degrees they leave {100 * as_given / whole:.2g} "
            f"% of the variance of the signals unexplained, read as {unit} {100 * left[unit] / whole:.2g} %; "
            "write angle_deg in degrees"
        )


def _left(problem: Problem, signal: Floats, factor: float) -> float:
    """Return the residual sum of squares of ordinary least squares, with the angles multiplied by `factor`."""
    turned = replace(problem.conditions, angle_rad=problem.conditions.angle_rad * factor)
    _, left = least_squares(force_columns(replace(problem, conditions=turned)), signal)
    return float(np.sum(left**2))


def force_columns(problem: Problem) -> Floats:
    """Return the design matrix (n, 4): specific force at the nominal stand, and a column of ones."""
    still = np.zeros((len(problem.conditions.mounts), len(STAND_ANGLES)))
    force = problem.model.specific_force(problem.conditions, still, Block(np.eye(3), np.zeros(3)))
    return linear_columns(force)


def still_channels(signal: Floats) -> list[str]:
    """Return the channels whose signal (n, 3) is the same in every reading."""
    return [axis for axis, spread in zip("xyz", np.ptp(signal, axis=0), strict=True) if spread == 0]


def refuse_still(signal: Floats) -> None:
    """Raise `FaultyReadings` for a channel whose signal (n, 3) is the same in every reading."""
    still = still_channels(signal)
    if still:
        raise FaultyReadings(
            f"the signal of channel {', '.join(still)} is the same in every reading; "
            "check its cable and the supply of the block"
        )


def refuse_saturated(columns: Floats, signal: Floats, resolution: float) -> None:
    """Raise `FaultyReadings` for a saturated channel, whose largest or smallest signals are equal.

    A fit to the channel's other signals predicts values beyond them; if no fit is possible, the forces there
    differ. `columns` (n, 4) are the specific force and ones, `resolution` is that of `signal`.
    """
    for i, axis in enumerate("xyz"):
        at_end, sides = np.zeros(len(signal), dtype=bool), np.zeros(len(signal))
        for side, end in ((1.0, signal[:, i].max()), (-1.0, signal[:, i].min())):
            there = signal[:, i] == end
            if there.sum() >= CLIPPED:
                at_end |= there
                sides[there] = side
        if not at_end.any() or at_end.all():
            continue
        rest = columns[~at_end]
        if len(rest) < 4 or np.linalg.svd(rest, compute_uv=False)[-1] < 1e-3 * np.sqrt(len(rest)):
            if _equal_where_forces_differ(columns, signal[:, i], sides):
                _raise_saturated(axis, int(at_end.sum()), signal[at_end, i])
            continue
        solution, left = least_squares(rest, signal[~at_end, i])
        beyond = (columns[at_end] @ solution - signal[at_end, i]) * sides[at_end]
        if np.median(beyond) > max(10 * rms(left), 10 * resolution, LEAST_CLIPPED * np.ptp(signal[:, i])):
            _raise_saturated(axis, int(at_end.sum()), signal[at_end, i])


def _equal_where_forces_differ(columns: Floats, signal: Floats, sides: Floats) -> bool:
    """Return whether the readings at one end of the range are equal though a fit predicts them far apart."""
    expected = columns @ least_squares(columns, signal)[0]
    return any(
        np.ptp(expected[sides == side]) > FAR_APART * np.ptp(expected)
        for side in (1.0, -1.0)
        if side in sides
    )


def refuse_saturated_free(signal: Floats) -> None:
    """Raise `FaultyReadings` if many free positions have equal signals (m, 3) at one end of the range."""
    for i, axis in enumerate("xyz"):
        ends = (signal[:, i] == signal[:, i].max(), signal[:, i] == signal[:, i].min())
        there = max(ends, key=np.count_nonzero)
        if np.count_nonzero(there) >= CLIPPED_FREE and not there.all():
            _raise_saturated(axis, int(np.count_nonzero(there)), signal[there, i])


def _raise_saturated(axis: str, count: int, signal: Floats) -> None:
    values = " and ".join(f"{v:.7g}" for v in np.unique(signal))
    raise FaultyReadings(
        f"channel {axis} is saturated: {count} readings stand at {values}, the end of its range, while "
        "the signal goes further; measure them again on a higher range, or leave them out"
    )


def refuse_singular(block: Block, u: Floats | None = None) -> None:
    """Raise `SpoiledFit` if a channel does not respond, or the sensitive axes do not span three dimensions.

    `u` (12,) are the standard uncertainties of the coefficients, if known.
    """
    length = np.linalg.norm(block.K, axis=1)
    # rows of coefficients that are fixed by convention have no u
    least = np.zeros(3) if u is None else np.linalg.norm(u[:9].reshape(3, 3), axis=1)
    dead = [axis for axis, k, s in zip("xyz", length, least, strict=True) if not k > NO_ANSWER * s]
    if dead:
        raise SpoiledFit(
            f"the readings do not show that channel {', '.join(dead)} responds to acceleration",
            "check cable, supply and the unit of the signals; 'bench diagnose' finds single wrong readings",
        )
    unit = block.K / length[:, None]
    if np.linalg.svd(unit, compute_uv=False)[-1] >= COPLANAR:
        return
    between = np.abs(unit @ unit.T) - np.eye(3)
    i, j = divmod(int(np.argmax(between)), 3)
    if between[i, j] > ALIKE:
        raise SpoiledFit(
            f"K is singular: channels {'xyz'[i]} and {'xyz'[j]} respond equally",
            "check whether two voltmeters are on one accelerometer",
        )
    raise SpoiledFit(
        "K is singular: the sensitive axes of the three channels lie in one plane",
        "check which accelerometer each channel measures",
    )


@contextmanager
def naming_deviating(problem: Problem, rows: Readings) -> Iterator[None]:
    """Context in which a `SpoiledFit` becomes a `DeviatingReadings`, which names the deviating rows.

    The names replace its advice; it is raised unchanged if no row deviates strongly.
    """
    try:
        yield
    except SpoiledFit as error:
        far = _deviation(problem, rows)
        if not np.any(far > 1.0):
            raise
        raise DeviatingReadings(
            f"{error.args[0]}; these readings are far off: {_named(rows, far)}",
            "find the mistake with 'bench diagnose'",
        ) from error


def _named(rows: Readings, far: Floats) -> str:
    """Return in words the rows with `far` (n,) above 1: whole passes, then the worst of the other rows in order."""
    turns = list(zip(rows.installation.tolist(), rows.pass_number.tolist(), strict=True))
    of_turn = {turn: np.array([one == turn for one in turns]) for turn in dict.fromkeys(turns)}
    wrong = {
        turn: own for turn, own in of_turn.items() if np.all(far[own] > 1.0) and np.count_nonzero(own) > 1
    }
    left = np.where(np.any([*wrong.values(), far < 0.0], axis=0), 0.0, far)
    count = int(np.count_nonzero(left > 1.0))
    worst = np.sort(np.argsort(-left, kind="stable")[: min(MOST_NAMED, count)])
    named = [message(f"all of installation {label}, pass {number}") for label, number in wrong]
    named += [_row_of(rows, int(i)) for i in worst]
    if count > MOST_NAMED and not wrong:
        first, second, third = named
        return message(f"{first} and {second} and {third} and {count - MOST_NAMED} more")
    return " and ".join(named) + (f" and {count - MOST_NAMED} more" if count > MOST_NAMED else "")


def _deviation(problem: Problem, rows: Readings) -> Floats:
    """Return how far each row (n,) is off a fit of least absolute deviations, relative to the limit `FAR_OFF`."""
    if not len(rows):
        return np.zeros(0)
    columns, weight = force_columns(problem), np.ones(len(rows))
    for _ in range(LEAST_ABSOLUTE_STEPS):
        root = np.sqrt(weight)[:, None]
        left = rows.signal - columns @ np.linalg.lstsq(root * columns, root * rows.signal)[0]
        off = np.linalg.norm(left, axis=1)
        weight = 1.0 / np.maximum(off, 1e-9 * max(float(off.max()), 1e-300))
    usual = float(np.median(np.linalg.norm(rows.signal, axis=1)))
    return np.asarray(off / max(FAR_OFF * float(np.median(off)), FAR_OFF_OF_SIGNAL * usual))


def at_nominal_angles(rows: Readings) -> Readings:
    """Return the rows with the target angles instead of the angles read back.

    A row without a target angle gets the paper's angle of its point. Raises `CalibrationError` for a row that has
    neither.
    """
    nominal = rows.target_rad.copy()
    missing = ~np.isfinite(nominal)
    of_paper = np.isin(rows.installation, ["1", "2"]) & (rows.point >= 1) & (rows.point <= POINTS)
    papers = NOMINAL_RAD[np.clip(rows.point, 1, POINTS) - 1]
    off = rows.angle_rad - papers
    usable = missing & of_paper & (np.abs(within_half_turn(off)) <= FARTHEST_NOMINAL_RAD)
    nominal[usable] = papers[usable]
    if np.any(missing & ~usable):
        raise CalibrationError(
            f"{_place(rows, missing & ~usable)} has no nominal angle; add the column target_deg, or leave out "
            "--nominal-angles"
        )
    return replace(rows, angle_rad=nominal)


FARTHEST: Final = 0.2
"""Largest relative deviation of a scale factor from nominal that manufacturing tolerance explains."""


def implausible(result: Calibration, nominal: Sequence[float]) -> tuple[str, ...]:
    """Return a sentence for each scale factor that contradicts its nominal value (x, y, z; V/g, with sign).

    Only signals in volts are compared. The sign is not compared for free positions alone, which do not determine
    it.
    """
    if result.unit != "V":
        return ()
    sentences = []
    for i, (axis, announced) in enumerate(zip("xyz", nominal, strict=True)):
        found = float(result.block.K[i, i])
        most = "xyz"[int(np.argmax(np.abs(result.block.K[i])))]
        said = message(f"scale factor {found:.4g} V/g, but the bench file announces {announced:.4g} V/g")
        prefix = round(math.log10(abs(found / announced)) / 3) if found else 0
        if prefix and abs(math.log10(abs(found / announced)) - 3 * prefix) < 0.3:
            said = (
                message(f"{said}; perhaps the signals are in mV, not in V")
                if prefix == 1
                else message(f"{said}; perhaps the signals are in another unit, not in V")
            )
        elif most != axis:
            said = message(
                f"{said}; it responds most to {most}: perhaps two channels or installations are swapped"
            )
        elif found * announced < 0 and result.triangular is None:
            said = message(f"{said}; perhaps the pair of wires is reversed")
        elif abs(abs(found / announced) - 1) <= FARTHEST:
            continue
        else:
            said = message(f"{said}; check that it is the block of the bench file")
        sentences.append(message(f"channel {axis}: {said}"))
    return tuple(sentences)


# --- signals in another unit than stated ---------------------------------------------------


PREFIX: Final = 3.0
"""Powers of ten from one unit prefix to the next."""
NEAR: Final = 0.3
"""Tolerance in log10 (a factor of 2) within which a ratio of sizes counts as a power of 1000."""
LEAST_SPAN_G: Final = 0.5
"""Least span, g, of specific force along a channel for an estimate of the channel's signal per g."""
PREFIXES: Final = (-2, -1, 0, 1, 2)
MUCH_BETTER: Final = 1e-4
"""For a channel that hardly moves, another unit is assumed if it lowers squared residuals to this fraction."""
CLEARLY: Final = 30.0
"""A row is in another unit if its signal norm is this many times larger or smaller than the median."""
FITS: Final = 0.02
"""Largest unexplained fraction of the signal variance if the units are right."""

_NAMES: Final = {
    "V": {1: "mV", 2: "µV"},
    "g": {1: "mg", 2: "µg"},
    "m/s^2": {1: "mm/s²", 2: "µm/s²"},
}


def in_another_unit(channels: Sequence[str], part: str, unit: str, tens: int) -> str:
    """Return in words that signals are 10 to the power of `tens` times too large.

    `part` names the affected part of the table ("pass 2"), empty for all of it; `unit` is the unit in the file.
    """
    everything = len(channels) == len(CHANNELS)
    than = message("the others")
    if everything and not part:
        than = message("the data sheet, if that is of this block")
    prefix, left = divmod(tens, round(PREFIX))
    name = _NAMES.get(unit, {}).get(prefix)
    said = message(f"in {name}, instead of {unit}") if name else message("in another unit than stated")
    if left:
        said = message("read with another range or decimal point than stated")
    if everything:
        return message(
            f"all signals{_of_part('', part)} seem to be {said}: they are {10 ** abs(tens)} times too "
            f"{'large' if tens > 0 else 'small'} beside {than}"
        )
    return message(
        f"the signals of channel {_of_part(', '.join(channels), part)} seem to be {said}: they are "
        f"{10 ** abs(tens)} times too {'large' if tens > 0 else 'small'} beside {than}"
    )


def _of_part(what: str, part: str) -> str:
    kind, _, labels = part.partition(" ")
    if kind == "pass":
        return message(f"{what} of pass {labels}")
    return message(f"{what} of installation {labels}") if part else what


@dataclass(frozen=True)
class WrongUnit:
    """Signals that are in another unit than stated.

    `power` (n, 3) is zero for correct signals; any other signal is too large by a factor of 1000^`power`. `part`
    names the affected part of the table in words, empty for all rows; `channels` are the affected channels. `unit`
    is the stated unit, `size` the value of `power` for the affected signals. If the affected part is a pass or an
    installation, `pass_number` or `installation` is set.
    """

    power: Ints
    part: str
    channels: tuple[str, ...]
    unit: str
    size: int
    pass_number: int | None = None
    installation: str | None = None

    @property
    def whole(self) -> bool:
        """Whether all signals are in another unit; only the nominal scale factors can show this."""
        return not self.part and len(self.channels) == len(CHANNELS)

    @property
    def words(self) -> str:
        """A sentence on which signals are affected, and on their likely unit."""
        return in_another_unit(self.channels, self.part, self.unit, round(PREFIX) * self.size)

    def corrected(self, readings: Readings) -> Readings:
        """Return a copy of the readings with the affected signals converted to their true unit."""
        factor = 10.0 ** (-PREFIX * self.power)
        return replace(
            readings,
            signal=readings.signal * factor,
            signal_sd=readings.signal_sd * factor,
            resolution_read=None,
        )


def wrong_unit(readings: Readings, model: ForwardModel, nominal: Sequence[float] | None) -> WrongUnit | None:
    """Return which signals are in another unit than stated; None if none are, or if this is not clear.

    `nominal` (3,) are the data sheet's scale factors, in the unit of the signal per g; without them the signals are
    compared with each other.
    """
    oriented = readings.oriented()
    if (
        not len(oriented)
        or not np.isfinite(oriented.signal).all()
        or not np.isfinite(oriented.angle_rad).all()
    ):
        return None
    conditions = oriented.conditions()
    still = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
    plain = replace(model, effects=())
    force = plain.specific_force(conditions, still, Block(np.eye(3), np.zeros(3)))
    for name, labels in _groupings(oriented):
        power = _powers(oriented.signal, force, labels, nominal)
        _with_still_parts(power, oriented.signal, force, labels)
        if not power.any():
            continue
        scaled = oriented.signal * 10.0 ** (-PREFIX * power)
        if _unexplained(force, scaled) > FITS:
            continue
        return _described(readings, oriented, name, labels, power, scaled)
    return None


ONE_UNIT: Final = message("convert them to one unit")


def refuse_mixed_units(readings: Readings, model: ForwardModel, nominal: Sequence[float] | None) -> None:
    """Raise `SpoiledFit` if some of the signals, but not all, are in another unit."""
    found = wrong_unit(readings, model, nominal)
    if found is not None and not found.whole:
        raise SpoiledFit(
            f"{readings.source}: {found.words}; {ONE_UNIT}",
            "'bench diagnose' writes a corrected copy",
        )


def _groupings(readings: Readings) -> Iterator[tuple[str, list[str]]]:
    """Yield name and row labels of each grouping of rows by which units may differ: none, pass, installation."""
    yield "", [""] * len(readings)
    yield "pass", [str(number) for number in readings.pass_number]
    yield "installation", [str(label) for label in readings.installation]


def _powers(signal: Floats, force: Floats, labels: list[str], nominal: Sequence[float] | None) -> Ints:
    """Return the power of 1000 (n, 3) by which each signal is too large, judged by group of rows."""
    names = sorted(set(labels))
    rows = {name: np.array([label == name for label in labels]) for name in names}
    size = np.array([_sizes(signal[rows[name]], force[rows[name]]) for name in names])
    reference = np.log10(np.abs(nominal)) if nominal is not None else np.nanmin(size, initial=np.inf)
    off = (size - reference) / PREFIX
    whole = np.round(off)
    known = np.isfinite(off) & (np.abs(off - whole) <= NEAR / PREFIX)
    power = np.zeros((len(signal), 3), dtype=np.int64)
    for k, name in enumerate(names):
        told = np.unique(whole[k][known[k]])
        # a channel that hardly moves in this group gets the power of the other channels, if these agree
        one = np.where(known[k], whole[k], told[0] if len(told) == 1 else 0.0)
        power[rows[name]] = one.astype(np.int64)
    return power


def _with_still_parts(power: Ints, signal: Floats, force: Floats, labels: list[str]) -> None:
    """Correct `power` of groups in which a channel hardly moves: choose the unit with which all rows fit best."""
    for i in range(3):
        own = signal[:, i : i + 1] * 10.0 ** (-PREFIX * power[:, i : i + 1])
        if _unexplained(force, own) <= FITS:
            continue
        for name in sorted(set(labels)):
            rows = np.array([label == name for label in labels])
            if np.isfinite(_sizes(signal[rows], force[rows])[i]):
                continue
            left = {
                c: _left_over(force, np.where(rows[:, None], own * 10.0 ** (-PREFIX * c), own))
                for c in PREFIXES
            }
            best = min(left, key=left.__getitem__)
            if left[best] < MUCH_BETTER * left[0]:
                power[rows, i] += best


def _left_over(force: Floats, signal: Floats) -> float:
    """Return the residual sum of squares of a linear fit at the nominal geometry."""
    return float(np.sum(least_squares(linear_columns(force), signal)[1] ** 2))


def _sizes(signal: Floats, force: Floats) -> Floats:
    """Return log10 of each channel's signal per g, (3,); NaN for a channel that hardly moves."""
    low, high = np.percentile(signal, [5, 95], axis=0)
    from_g, to_g = np.percentile(force, [5, 95], axis=0)
    moves = (to_g - from_g >= LEAST_SPAN_G) & (high > low)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moves, np.log10((high - low) / (to_g - from_g)), np.nan)


def _unexplained(force: Floats, signal: Floats) -> float:
    """Return the largest fraction of a channel's variance that a fit at the nominal geometry leaves unexplained."""
    _, left = least_squares(linear_columns(force), signal)
    whole = np.sum((signal - signal.mean(axis=0)) ** 2, axis=0)
    return float(np.max(np.sum(left**2, axis=0) / np.maximum(whole, 1e-300)))


def _described(
    readings: Readings, oriented: Readings, name: str, labels: list[str], power: Ints, scaled: Floats
) -> WrongUnit:
    wrong = sorted({label for label, row in zip(labels, power, strict=True) if row.any()})
    channels = tuple(axis for axis, of in zip(CHANNELS, power.T, strict=True) if of.any())
    alone = wrong[0] if name and len(wrong) == 1 else None
    whole = np.zeros((len(readings), 3), dtype=np.int64)
    whole[readings.is_oriented] = power
    for row in np.flatnonzero(~readings.is_oriented):
        whole[row] = _of_other(readings, int(row), power, scaled, everywhere=not name)
    return WrongUnit(
        whole,
        f"{name} {', '.join(wrong)}" if name else "",
        channels,
        readings.unit,
        int(power.flat[np.flatnonzero(power)[0]]),
        int(alone) if alone is not None and name == "pass" else None,
        alone if name == "installation" else None,
    )


def _of_other(readings: Readings, row: int, power: Ints, scaled: Floats, *, everywhere: bool) -> Ints:
    """Return the power of 1000 (3,) for a row that is not oriented.

    With `everywhere` it is the power that all oriented rows share; otherwise the row's own signal determines it.
    """
    if everywhere or readings.installation[row] in {REFERENCE, SHORTED}:
        return power[0] if everywhere else np.zeros(3, dtype=np.int64)
    usual = float(np.median(np.linalg.norm(scaled, axis=1)))
    if CLEARLY > float(np.linalg.norm(readings.signal[row])) / usual > 1 / CLEARLY:
        return np.zeros(3, dtype=np.int64)
    choices = np.unique(power, axis=0)
    sizes = np.linalg.norm(readings.signal[row] * 10.0 ** (-PREFIX * choices), axis=1)
    return np.asarray(choices[int(np.argmin(np.abs(np.log(np.maximum(sizes, 1e-300) / usual))))])


def sheet_of(unit: str, scale_factors: Sequence[float]) -> Sequence[float] | None:
    """Return the nominal signal per g (3,) in the `unit` of the signals; None if it is unknown.

    It is `scale_factors` for V, 1 for g, and 9.81 for m/s^2.
    """
    return {"V": scale_factors or None, "g": (1.0, 1.0, 1.0), "m/s^2": (9.81, 9.81, 9.81)}.get(unit)
