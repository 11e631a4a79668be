"""Mistakes in a table of readings that no fit should swallow; an implausible block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Mask, least_squares, rms
from bench.calibration.closed_form import NOMINAL_RAD, POINTS
from bench.calibration.design import Problem
from bench.calibration.result import Calibration, CalibrationError
from bench.model.geometry import STAND_ANGLES, Block, linear_columns, within_half_turn
from bench.readings.columns import OVERLOAD
from bench.readings.table import Readings

OTHER_UNITS: Final = {"radians": 180.0 / np.pi, "gon": 0.9, "whole turns": 360.0}
BADLY: Final = 1e-3
"""Part of the signals' variance that a wrong unit of angle leaves at least, and the right one at most."""
MUCH_BETTER: Final = 1e-2

CLIPPED: Final = 3
"""So many equal readings at the end of a channel's range may be more than chance."""
CLIPPED_FREE: Final = 4
FAR_APART: Final = 0.05
LEAST_CLIPPED: Final = 1e-4
"""What is cut off, as a part of the channel's range, before it is called so: repeats may be exactly equal."""

COPLANAR: Final = 0.02
"""Least singular value of K with rows of unit length: the axes of a block stand square, within minutes."""
ALIKE: Final = 0.999
NO_ANSWER: Final = 5.0

FARTHEST_NOMINAL_RAD: Final = np.radians(1.0)


def require_numbers(rows: Readings, *, angles: bool) -> None:
    """Refuse a signal, or an angle where `angles` matter, that is no number, and overload."""
    bad = np.asarray(~np.isfinite(rows.signal).all(axis=1))
    if angles:
        bad |= ~np.isfinite(rows.angle_rad)
    if np.any(bad):
        raise CalibrationError(
            f"{_place(rows, bad)} has a signal or an angle that is not a number; leave this reading out"
        )
    over = np.asarray((np.abs(rows.signal) >= OVERLOAD).any(axis=1))
    if np.any(over):
        raise CalibrationError(
            f"{_place(rows, over)} has an overloaded voltmeter; measure it again on a higher range, or leave "
            "this reading out"
        )


def _place(rows: Readings, mask: Mask) -> str:
    i = int(np.argmax(mask))
    return f"{rows.source}: installation {rows.installation[i]}, pass {rows.pass_number[i]}, point {rows.point[i]}"


def refuse_wrong_angle_unit(problem: Problem, signal: Floats, residuals: Floats) -> None:
    """Refuse angles in another unit than degrees: a poor fit as they are, a good one in that unit.

    `residuals` (n, 3) are what ordinary least squares leave of the signals.
    """
    whole = float(np.sum((signal - signal.mean(axis=0)) ** 2))
    as_given = float(np.sum(residuals**2))
    if as_given <= BADLY * whole:
        return
    left = {unit: _left(problem, signal, factor) for unit, factor in OTHER_UNITS.items()}
    unit = min(left, key=lambda name: left[name])
    if left[unit] < MUCH_BETTER * as_given and left[unit] < BADLY * whole:
        raise CalibrationError(
            f"the angles look like {unit}, not degrees: as degrees they leave {100 * as_given / whole:.2g} % of "
            f"the variance of the signals, as {unit} {100 * left[unit] / whole:.2g} %; write angle_deg in degrees"
        )


def _left(problem: Problem, signal: Floats, factor: float) -> float:
    """Sum of squares that ordinary least squares leave at the angles times a factor."""
    turned = replace(problem.conditions, angle_rad=problem.conditions.angle_rad * factor)
    _, left = least_squares(force_columns(replace(problem, conditions=turned)), signal)
    return float(np.sum(left**2))


def force_columns(problem: Problem) -> Floats:
    """Return the specific force at the nominal stand, and ones, shape (n, 4)."""
    still = np.zeros((len(problem.conditions.mounts), len(STAND_ANGLES)))
    force = problem.model.specific_force(problem.conditions, still, Block(np.eye(3), np.zeros(3)))
    return linear_columns(force)


def still_channels(signal: Floats) -> list[str]:
    """Return the channels whose signal (n, 3) is the same in every reading."""
    return [axis for axis, spread in zip("xyz", np.ptp(signal, axis=0), strict=True) if spread == 0]


def refuse_still(signal: Floats) -> None:
    """Refuse a channel whose signal is the same in every reading."""
    still = still_channels(signal)
    if still:
        raise CalibrationError(
            f"the signal of channel {', '.join(still)} is the same in every reading; "
            "check its cable and the supply of the block"
        )


def refuse_saturated(columns: Floats, signal: Floats, resolution: float) -> None:
    """Refuse a channel that stays at the end of its range where the other readings say it went beyond.

    `columns` (n, 4) are the specific force and ones.
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
    """Whether readings at one end are equal although the fit to all has them far apart."""
    expected = columns @ least_squares(columns, signal)[0]
    return any(
        np.ptp(expected[sides == side]) > FAR_APART * np.ptp(expected)
        for side in (1.0, -1.0)
        if side in sides
    )


def refuse_saturated_free(signal: Floats) -> None:
    """Refuse a channel with many equal readings at an end: in free positions no two are alike."""
    for i, axis in enumerate("xyz"):
        ends = (signal[:, i] == signal[:, i].max(), signal[:, i] == signal[:, i].min())
        there = max(ends, key=np.count_nonzero)
        if np.count_nonzero(there) >= CLIPPED_FREE and not there.all():
            _raise_saturated(axis, int(np.count_nonzero(there)), signal[there, i])


def _raise_saturated(axis: str, count: int, signal: Floats) -> None:
    values = " and ".join(f"{v:.7g}" for v in np.unique(signal))
    raise CalibrationError(
        f"channel {axis} is saturated: {count} readings stand at {values}, the end of its range, where the "
        "signal goes further; measure them again on a higher range, or leave them out"
    )


def refuse_singular(block: Block, u: Floats | None = None) -> None:
    """Refuse a block whose channels do not tell three axes: one does not answer, or two are alike.

    `u` (12,) are the standard uncertainties, where they are known.
    """
    length = np.linalg.norm(block.K, axis=1)
    # rows of coefficients that are fixed by convention have no u
    least = np.zeros(3) if u is None else np.linalg.norm(u[:9].reshape(3, 3), axis=1)
    dead = [axis for axis, k, s in zip("xyz", length, least, strict=True) if not k > NO_ANSWER * s]
    if dead:
        raise CalibrationError(
            f"channel {', '.join(dead)} does not answer to the acceleration; check its cable and the supply of "
            "the block"
        )
    unit = block.K / length[:, None]
    if np.linalg.svd(unit, compute_uv=False)[-1] >= COPLANAR:
        return
    between = np.abs(unit @ unit.T) - np.eye(3)
    i, j = divmod(int(np.argmax(between)), 3)
    if between[i, j] > ALIKE:
        raise CalibrationError(
            f"K is singular: channels {'xyz'[i]} and {'xyz'[j]} answer alike; are two voltmeters on one "
            "accelerometer?"
        )
    raise CalibrationError(
        "K is singular: the sensitive axes of the three channels lie in one plane; check which accelerometer "
        "each channel measures"
    )


def at_nominal_angles(rows: Readings) -> Readings:
    """Return the rows at their target angles in place of those read back; without targets, at the paper's.

    Raises `CalibrationError` where a row has neither.
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
            f"{_place(rows, missing & ~usable)} has no nominal angle: there is no target_deg, and its point is "
            "not one of the paper's; add the column, or use the angles read back"
        )
    return replace(rows, angle_rad=nominal)


FARTHEST: Final = 0.2
"""A scale factor further from its nominal value than this part of it is no tolerance of manufacture."""


def implausible(result: Calibration, nominal: Sequence[float]) -> tuple[str, ...]:
    """Return a sentence for each scale factor that contradicts its nominal value (x, y, z; V/g, with sign).

    Signals in another unit than volts are not compared; free positions alone do not show a sign.
    """
    if result.unit != "V":
        return ()
    sentences = []
    for i, (axis, announced) in enumerate(zip("xyz", nominal, strict=True)):
        found = float(result.block.K[i, i])
        most = "xyz"[int(np.argmax(np.abs(result.block.K[i])))]
        sentence = (
            f"channel {axis}: scale factor {found:.4g} V/g, but the bench file announces {announced:.4g} V/g"
        )
        prefix = round(math.log10(abs(found / announced)) / 3) if found else 0
        if prefix and abs(math.log10(abs(found / announced)) - 3 * prefix) < 0.3:
            sentence += f"; are the signals in {'mV' if prefix == 1 else 'another unit'}, and not in V?"
        elif most != axis:
            sentence += f"; it answers most to {most}: are two channels or installations swapped?"
        elif found * announced < 0 and result.triangular is None:
            sentence += "; is the pair of wires reversed?"
        elif abs(abs(found / announced) - 1) <= FARTHEST:
            continue
        else:
            sentence += "; is it the block that the bench file names?"
        sentences.append(sentence)
    return tuple(sentences)
