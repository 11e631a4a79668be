"""Mistakes of procedure and wiring, looked for before any effect: large, discrete, each with a correction.

First what moves readings by volts (exchanged channels, the wrong installation …), then a pass that is off as a
whole, then single readings that contradict the repeats of their own point. What is found is put right in a copy.
The search goes on there until nothing more is found. The record itself is never changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.calibration.calibrate import usable_rows
from bench.calibration.design import Problem, make_problem
from bench.calibration.gls import noise_floor
from bench.calibration.mistakes import PREFIX, PREFIXES, WrongUnit, sheet_of, wrong_unit
from bench.calibration.result import CalibrationError
from bench.diagnosis.levels import HARDLY_EVER
from bench.diagnosis.mistakes.gross import GrossMistake, GrossSearch
from bench.diagnosis.mistakes.hypotheses import Table
from bench.diagnosis.mistakes.reinterpretation import OrientedRows
from bench.diagnosis.mistakes.single_readings import SingleMistake, find_single
from bench.diagnosis.mistakes.whole_pass import PassMistake, find_in_pass
from bench.diagnosis.noise_grid import RATIOS
from bench.model import STAND_ANGLES, Block, ForwardModel
from bench.readings.corrected import MistakeName
from bench.readings.table import Readings

MOST: Final = 5
"""Most gross mistakes that are corrected one after another, and half the most searches of passes and readings."""


@dataclass(frozen=True)
class Evidence:
    """Root mean square misfit of all readings to the model and to the data sheet, in units of the noise (1: noise
    alone).
    """

    before: float
    after: float


@dataclass(frozen=True)
class Mistake:
    """A mistake, its place, and its correction in the copy.

    `name` is one of swapped_channels, reversed_polarity, reversed_rotation, swapped_installations,
    shifted_points, wrong_setting, outlier, wrong_unit, another_block, stuck_channel. `installations` are
    written as `str(Mount)`; none means the whole run. `words` is a sentence; `p` is corrected for all looks.
    `cannot_tell_from` are names of mistakes and effects that explain these readings equally ("other_mounting":
    the block was mounted in another orientation).
    """

    name: str
    channels: tuple[str, ...]
    installations: tuple[str, ...]
    pass_number: int | None
    point: int | None
    words: str
    p: float
    cannot_tell_from: tuple[str, ...]
    evidence: Evidence = Evidence(np.nan, np.nan)


@dataclass(frozen=True)
class MistakeSearch:
    """The mistakes in the order of their correction, and the corrected copy.

    The copy omits each reading with an outlier and lists it in `skipped`.
    """

    mistakes: tuple[Mistake, ...]
    corrected: Readings


class MistakesLeaveTooLittle(CalibrationError):
    """The readings with the mistakes corrected are insufficient; `reason` says why, `search` has the mistakes."""

    def __init__(self, search: MistakeSearch, reason: str) -> None:
        super().__init__(search, reason)
        self.search, self.reason = search, reason

    def __str__(self) -> str:
        """Return the mistakes and what is missing without them, in a sentence."""
        return f"a mistake: {'; '.join(one.words for one in self.search.mistakes)}; put right, {self.reason}"


def find_mistakes(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    nominal_scale_factors: Floats | None,
    significance: float = HARDLY_EVER,
) -> MistakeSearch:
    """Look for mistakes in a table of readings.

    `stand_u` are standard uncertainties by the names in `STAND_ANGLES` and of the "setting_error", rad;
    `nominal_scale_factors` (3,) are those of the data sheet with their signs, in the unit of the signal per
    g, or None: then a mistake that the coefficients take up (channels exchanged in the whole run) cannot be
    seen. `significance` is the probability, all looks counted, of finding any single reading wrong where none
    is. Raises `CalibrationError` where no row can be used or one is not a number.
    """
    usable_rows(readings, model)
    nominal = None if nominal_scale_factors is None else np.asarray(nominal_scale_factors, dtype=np.float64)
    limits = [stand_u[name] for name in (*STAND_ANGLES, "setting_error") if name in stand_u]
    stage = _Stage(model, stand_u, GrossSearch(model.installations, nominal, float(np.linalg.norm(limits))))
    found: list[Mistake] = []
    copies = [readings]
    unit = wrong_unit(readings, model, sheet_of(readings.unit, ())) if nominal is None else None
    if unit is not None:  # no data sheet says how large signals are: they are compared with each other
        copies.append(unit.corrected(readings))
        found.append(_unit_mistake(unit, _p_of_unit(stage.gross, unit, *copies)))
    for _ in range(MOST):
        table = OrientedRows.of(copies[-1])
        gross = stage.gross.find(table)
        if gross is None:
            break
        found.append(_gross_mistake(gross))
        copies.append(gross.supposition.correct(copies[-1], table))
    for _ in range(2 * MOST):
        before, view = copies[-1], stage.view(copies[-1])
        of_pass = find_in_pass(view.problem, view.table.signal, view.floor, partial(stage.fit, view.table))
        wrong = (
            [_of_pass(view, of_pass)]
            if of_pass
            else [_of_reading(view, single) for single in find_single(view.rows, significance)]
        )
        if not wrong:
            break
        found += [one.mistake for one in wrong]
        copies += [_put_right(before, wrong[: k + 1]) for k in range(len(wrong))]
    return MistakeSearch(_with_evidence(stage, found, copies), copies[-1])


@dataclass(frozen=True)
class _FirstGuess:
    """The oriented rows of a table before the fit; `block` is a first guess that wrong readings do not affect."""

    table: OrientedRows
    problem: Problem
    block: Block
    floor: float
    sheet: float
    unit: str

    @property
    def rows(self) -> Table:
        """The table of hypotheses."""
        return Table.of(self.problem, self.block, self.table.signal, self.floor)


@dataclass(frozen=True)
class _Stage:
    """The model, the stand and the data sheet."""

    model: ForwardModel
    stand_u: Mapping[str, float]
    gross: GrossSearch

    def fit(self, table: OrientedRows, rows: Mask) -> Block:
        """Return the block fitted to some rows (n,) of a table."""
        return self.gross.first_guess(table.select(rows))[0]

    def view(self, readings: Readings) -> _FirstGuess:
        """Look at a table; `sheet` is how far the coefficients lie from the data sheet, as a chi-square."""
        table = OrientedRows.of(readings)
        problem = make_problem(self.model, readings.oriented().conditions(), self.stand_u)
        block, sheet = self.gross.first_guess(table)
        floor = noise_floor(table.signal, readings.resolution, problem.free)
        return _FirstGuess(table, problem, block, floor, sheet, readings.unit)


@dataclass(frozen=True)
class _Wrong:
    """A mistake in some `rows` of the readings: their angles are off by `off_rad`, or they are left out if None."""

    mistake: Mistake
    rows: Ints
    off_rad: float | None


def _of_pass(view: _FirstGuess, of_pass: PassMistake) -> _Wrong:
    conditions = view.problem.conditions
    row = int(np.argmax(of_pass.rows))
    mount, number = str(conditions.mounts[conditions.mount[row]]), int(conditions.pass_number[row])
    channels: tuple[str, ...] = ()
    if of_pass.channel is not None:
        name, channels = MistakeName.STUCK_CHANNEL, (CHANNELS[of_pass.channel],)
        said = (
            f"channel {channels[0]} reads the same at all points, as if stuck; the copy leaves the pass out"
        )
    elif of_pass.off_rad is None:
        name, channels = MistakeName.ANOTHER_BLOCK, tuple(CHANNELS)
        said = "another block was mounted: K and U0 of all channels are others; the copy leaves the pass out"
    else:
        name = MistakeName.WRONG_SETTING
        off = np.degrees(of_pass.off_rad)
        said = (
            f"the signals stand as if the head had been {off:+.4g}° from where it says: its zero or its index was "
            "read wrong; the copy has the angles put right"
        )
    words = f"installation {mount}, pass {number}: {said}"
    if of_pass.ties:
        words += f" ({', '.join(of_pass.ties)} would look the same)"
    mistake = Mistake(name, channels, (mount,), number, None, words, of_pass.p, of_pass.ties)
    return _Wrong(mistake, view.table.rows[of_pass.rows], of_pass.off_rad)


def _p_of_unit(gross: GrossSearch, unit: WrongUnit, recorded: Readings, right: Readings) -> float:
    """Return the p-value of signals in another unit.

    The looks are all prefixes of all channels in all parts of the table.
    """
    table = OrientedRows.of(recorded)
    parts = 1 + len(np.unique(table.pass_number)) + len(np.unique(table.label))
    log_scaling = -PREFIX * np.log(10.0) * float(np.sum(unit.power[table.rows]))
    log_looks = 3 * parts * np.log(len(PREFIXES))
    return gross.p_of_units(table, OrientedRows.of(right), log_scaling, log_looks)


def _unit_mistake(unit: WrongUnit, p: float) -> Mistake:
    return Mistake(
        name=MistakeName.WRONG_UNIT,
        channels=unit.channels,
        installations=() if unit.installation is None else (unit.installation,),
        pass_number=unit.pass_number,
        point=None,
        words=f"{unit.words}; the copy has them in the unit of the file",
        p=p,
        cannot_tell_from=(),
    )


def _gross_mistake(gross: GrossMistake) -> Mistake:
    supposition = gross.supposition
    names = dict.fromkeys(other.name for other in gross.equal if other.name != supposition.name)
    elsewhere = [other for other in gross.equal if other.name == supposition.name]
    also = [
        f"{name} (the block sat otherwise)" if name == MistakeName.OTHER_MOUNTING else name for name in names
    ]
    also += [f"the same {other.scope}" for other in elsewhere]
    alike = f"; these readings cannot tell it from {', '.join(dict.fromkeys(also))}" if also else ""
    return Mistake(
        name=supposition.name,
        channels=supposition.channels,
        installations=tuple(str(mount) for mount in supposition.scope.mounts),
        pass_number=supposition.scope.pass_number,
        point=None,
        words=supposition.words + alike,
        p=gross.p,
        cannot_tell_from=tuple(names),
    )


def _of_reading(view: _FirstGuess, single: SingleMistake) -> _Wrong:
    conditions = view.problem.conditions
    mount = str(conditions.mounts[conditions.mount[single.row]])
    number, point = int(conditions.pass_number[single.row]), int(conditions.point[single.row])
    mistake = Mistake(
        name=MistakeName.OUTLIER if single.off_rad is None else MistakeName.WRONG_SETTING,
        channels=single.channels,
        installations=(mount,),
        pass_number=number,
        point=point,
        words=f"installation {mount}, pass {number}, point {point}: {_single_words(view, single)}",
        p=single.p,
        cannot_tell_from=(MistakeName.OUTLIER,) if single.as_outlier and single.off_rad is not None else (),
    )
    return _Wrong(mistake, view.table.rows[[single.row]], single.off_rad)


def _single_words(view: _FirstGuess, single: SingleMistake) -> str:
    stated = float(np.degrees(view.table.angle_rad[single.row]))
    if single.off_rad is not None:
        words = (
            f"the signals stand as if the head had been at {stated + np.degrees(single.off_rad):.7g}° and not at "
            f"{stated:.7g}°; the copy has the angle put right"
        )
        if single.as_outlier:
            words += f" (an outlier of channel {single.channels[0]} would look the same)"
        return words
    off = ", ".join(
        f"{c} by {v:+.3g} {view.unit}"
        for c, v in zip("xyz", single.shift, strict=True)
        if c in single.channels
    )
    return (
        f"channel {off} off what the other readings let expect ({single.sigma:.0f} standard deviations); "
        "the copy leaves the reading out"
    )


def _put_right(readings: Readings, wrong: Sequence[_Wrong]) -> Readings:
    """Return a copy with the angles of wrong settings corrected, and without the rows of other mistakes."""
    angle, kept = readings.angle_rad.copy(), np.ones(len(readings), dtype=bool)
    skipped = list(readings.skipped)
    for one in wrong:
        if one.off_rad is None:
            kept[one.rows] = False
            skipped.append(one.mistake.words.split(";")[0])
        else:
            angle[one.rows] += one.off_rad
    return replace(readings, angle_rad=angle, skipped=tuple(skipped)).select(kept)


def _with_evidence(
    stage: _Stage, found: Sequence[Mistake], copies: Sequence[Readings]
) -> tuple[Mistake, ...]:
    """Return the mistakes, each with the misfit of readings and data sheet before and after its correction.

    The misfit is a root mean square in units of the noise.
    """
    if not found:
        return ()
    views = [stage.view(copy) for copy in copies]
    last = max((views[-1].rows.seen(ratio) for ratio in RATIOS), key=lambda seen: seen.log_evidence)
    sizes = [float(np.sqrt((view.rows.chi2(last) + view.sheet) / view.table.signal.size)) for view in views]
    return tuple(
        replace(mistake, evidence=Evidence(before, after))
        for mistake, before, after in zip(found, sizes[:-1], sizes[1:], strict=True)
    )
