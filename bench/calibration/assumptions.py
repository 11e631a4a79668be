"""What the readings cannot show is assumed; each sentence says what it costs if the assumption is wrong."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from bench.calibration.design import FIXED, SYMBOLS, Problem
from bench.calibration.observability import (
    Columns,
    DirectionKind,
    Observability,
    axis_in_words,
    columns_of,
    with_angles,
)
from bench.calibration.result import CalibrationError
from bench.model.geometry import COEFFICIENTS, STAND_ANGLES, Block, hidden_axes

MATTERS: Final = 0.02
"""A coefficient is named when it takes more than this part of the largest effect of an assumption."""
MOST_NAMED: Final = 8
"""More stand angles than these are told by their symbols."""

GAIN: Final = "voltmeter gain: 1 ppm of it is 1 ppm of every coefficient, and no reading shows it"
GRAVITY: Final = (
    "local gravity: coefficients are per local g; a wrong value of it changes none of them, but "
    "whatever is computed from them in m/s^2"
)


def require_rank(force: Floats) -> None:
    """Refuse readings whose specific forces (n, 3) do not determine the twelve coefficients.

    Raises `CalibrationError` naming what is missing.
    """
    hidden = hidden_axes(force)
    if not hidden:
        return
    axes = [axis for axis in hidden if axis != "0"]
    lost = [f"K{i}{axis}" for i in "xyz" for axis in axes]
    raise CalibrationError(
        f"{len(force)} readings do not determine {', '.join(lost) or 'the biases'}: the acceleration along "
        f"{', '.join(axes) or 'every axis'} hardly changes in them; add the other installation "
        "(or further angles) to the procedure"
    )


def assumptions(problem: Problem, block: Block, gain: Floats, unit: str) -> tuple[str, ...]:
    """Return sentences on what the fit takes for granted, with the price of each.

    `gain` (12, n, 3) is the estimator's map from readings to coefficients.
    """
    assumed = [name for name in _ASSUMED if not _is_unknown(problem, name)]
    columns = columns_of(with_angles(problem, assumed), block)
    beyond = [name for name in columns.names if name.startswith(tuple(f"{SYMBOLS[a]}[" for a in assumed))]
    sentences = [_absent(problem, columns, block, gain, unit, name) for name in assumed]
    sentences += _undetermined(columns.without(beyond).observability(block), unit)
    sentences += [
        GAIN,
        f"voltmeter offset: it goes whole into the biases, {unit} for {unit}, and no reading shows it",
        GRAVITY,
    ]
    return tuple(sentences)


_ASSUMED: Final = ("mounting_roll",)
"""Stand angles that every bracket has and that a bench file may leave out."""


def _is_unknown(problem: Problem, name: str) -> bool:
    return any(STAND_ANGLES[s.column] == name for s in problem.stand)


def _absent(problem: Problem, columns: Columns, block: Block, gain: Floats, unit: str, name: str) -> str:
    """Say what an arcsecond of a stand angle that is assumed zero puts into the coefficients."""
    oriented = gain[:FIXED].reshape(FIXED, -1)
    mounts = problem.conditions.mounts
    parts = []
    for installation in dict.fromkeys(mount.installation for mount in mounts):
        own = [mount for mount in mounts if mount.installation == installation]
        # the modulus does not depend on the stand's angles: the rows behind those of the gain stay as they are
        shifts = [columns.of(f"{SYMBOLS[name]}[{mount}]")[: oriented.shape[1]] * ARCSEC for mount in own]
        change = max((oriented @ shift for shift in shifts), key=lambda one: float(np.max(np.abs(one))))
        largest = float(np.max(np.abs(change)))
        changed = [j for j in np.argsort(-np.abs(change)) if abs(change[j]) > max(MATTERS * largest, 1e-15)]
        if changed:
            where = f"one of the {len(own)} mountings" if len(own) > 1 else ""
            where = f"{where} in installation {installation}".strip().removeprefix("in ")
            what = ", ".join(f"{_small(change[j], unit)}/g into {COEFFICIENTS[j]}" for j in changed[:3])
            parts.append(f"1 arcsec in {where} puts {what}")
    return (
        f"{name} ({SYMBOLS[name]}, the third mounting angle) is assumed zero and "
        f"{_shown(columns, oriented.shape[1], block, name)}: "
        + ("; ".join(parts) if parts else "it does not act here")
    )


def _shown(columns: Columns, oriented: int, block: Block, name: str) -> str:
    """Whether readings show an angle where it is no unknown; common turns of the block's axes aside.

    Of the rows of `columns` the first `oriented` are signals, those behind them moduli.
    """
    if _is_hidden(columns, block, name):
        return "nothing in these readings shows it"
    if not _is_hidden(Columns(columns.rows[:oriented], columns.names), block, name):
        return "these readings would show it if the bench file stated its size"
    pairs = [
        f"the {d.only} of {' and '.join(sorted(d.others))}"
        for d in columns.observability(block).directions
        if d.kind is DirectionKind.TURN and d.only and d.others[0].startswith(f"{SYMBOLS[name]}[")
    ]
    what = " and ".join(pairs) or "what is no common turn of the block's axes"
    return (
        f"of it the readings that joined by |a| = 1 g would show {what}, if the bench file stated its size; "
        "until then it goes into the coefficients"
    )


def _is_hidden(columns: Columns, block: Block, name: str) -> bool:
    found = columns.observability(block).directions
    hidden = {member for d in found if d.kind is not DirectionKind.TURN for member in d.members}
    return any(member.startswith(f"{SYMBOLS[name]}[") for member in hidden)


def _small(value: float, unit: str) -> str:
    """Return a small amount of a signal as text, volts in microvolts."""
    return f"{value * 1e6:+.3g} µV" if unit == "V" else f"{value:+.3g} {unit}"


def _together(names: list[str]) -> str:
    """Return stand angles in words; those of many mountings by their symbols."""
    if len(names) <= MOST_NAMED:
        return ", ".join(names)
    symbols = dict.fromkeys(name.partition("[")[0] for name in names)
    mountings = dict.fromkeys(name.partition("[")[2] for name in names)
    return f"{', '.join(symbols)} of {len(mountings)} mountings"


def _undetermined(found: Observability, unit: str) -> list[str]:
    """Sentences on the unknowns that only their limits hold: turns of the axes in one, others each by itself."""
    turns = [d for d in found.directions if d.kind is DirectionKind.TURN]
    sentences = []
    if turns:
        taking_part = {member for d in turns for member in d.others}
        names = _together([name for name in found.names if name in taking_part])
        axes = ", ".join(axis_in_words(d.axis) for d in turns)
        sentences.append(
            f"{names}: in some combination a common turn of the block's axes (about {axes}), which no "
            "reading shows; only the limits of the bench file hold it"
        )
    return sentences + [
        f"{d.text(unit)}; only the limits of the bench file hold it"
        for d in found.directions
        if d.kind is not DirectionKind.TURN
    ]
