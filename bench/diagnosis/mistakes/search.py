"""The search for mistakes of procedure and wiring, which are corrected one after the other in a copy.

The likeliest mistake is corrected in a copy of the record, and the copy is searched again until no mistake is left.
The record itself is never changed. Gross mistakes (other meanings of the record) come first, because they move
readings by volts. Wrong settings and outliers come last: they are linear changes only about a block that was fitted
to readings without gross mistakes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message
from bench.calibration.calibrate import usable_rows
from bench.calibration.design import make_problem
from bench.calibration.gls import noise_floor
from bench.calibration.mistakes import PREFIX, PREFIXES, sheet_of, wrong_unit
from bench.calibration.result import CalibrationError
from bench.diagnosis.levels import HARDLY_EVER, STEPS
from bench.diagnosis.mistakes.gross import GrossMistake, GrossSearch
from bench.diagnosis.mistakes.reinterpretation import (
    IN_UNIT_OF_FILE,
    OrientedRows,
    Reinterpretation,
    head_was_off,
)
from bench.diagnosis.mistakes.terms import TermSearch, WrongReadings
from bench.diagnosis.noise_grid import RATIOS
from bench.model import STAND_ANGLES, Block, ForwardModel
from bench.readings.corrected import MistakeName
from bench.readings.table import Readings


@dataclass(frozen=True)
class Mistake:
    """A mistake in the record, where it is, and how the copy corrects it.

    `name` is a `MistakeName`; `installations` are mountings (`str(Mounting)`; empty: the whole run); `words` is a
    sentence. The p-value `p` is corrected for the number of suppositions. `cannot_tell_from` are mistakes and
    effects that explain the readings equally well; "other_mounting" is another orientation of the block.
    `misfit_before` and `misfit_after` are root mean squares of the deviations from model and data sheet, in units
    of the noise, before and after the correction; noise alone gives 1.
    """

    name: str
    channels: tuple[str, ...]
    installations: tuple[str, ...]
    pass_number: int | None
    point: int | None
    words: str
    p: float
    cannot_tell_from: tuple[str, ...]
    misfit_before: float = np.nan
    misfit_after: float = np.nan


@dataclass(frozen=True)
class MistakeSearch:
    """The mistakes in the order of their correction, and the corrected copy of the readings.

    The `skipped` rows of the copy are outliers.
    """

    mistakes: tuple[Mistake, ...]
    corrected: Readings

    @property
    def scales_the_run(self) -> bool:
        """Whether all signals of the run are in another unit than the file states."""
        return any(
            one.name == MistakeName.WRONG_UNIT
            and not one.installations
            and one.pass_number is None
            and len(one.channels) == len(CHANNELS)
            for one in self.mistakes
        )


class MistakesLeaveTooLittle(CalibrationError):
    """The readings are insufficient once the mistakes are corrected.

    `search` has the mistakes and the corrected copy; `reason` says what is missing.
    """

    def __init__(self, search: MistakeSearch, reason: str) -> None:
        super().__init__(search, reason)
        self.search, self.reason = search, reason

    def __str__(self) -> str:
        """Return a sentence with the mistakes, and with what the other readings lack."""
        mistakes = "; ".join(one.words for one in self.search.mistakes)
        return message(f"a mistake was found: {mistakes}; with it corrected, {self.reason}")


def find_mistakes(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    nominal_scale_factors: Floats | None,
    significance: float = HARDLY_EVER,
) -> MistakeSearch:
    """Return the mistakes in a table of readings, and a copy without them.

    `stand_u` has the standard uncertainties, rad, of `STAND_ANGLES` and "setting_error".
    `nominal_scale_factors` (3,) are those of the data sheet with signs, unit of the signal per g; without them
    (None), mistakes that only change coefficients are not found. The odds of a mistake must exceed
    1/`significance`. Raises `CalibrationError` if no reading can be used, or a signal is not a number.
    """
    usable_rows(readings, model)
    nominal = None if nominal_scale_factors is None else np.asarray(nominal_scale_factors, dtype=np.float64)
    limits = [stand_u[name] for name in (*STAND_ANGLES, "setting_error") if name in stand_u]
    gross = GrossSearch(model.installations, nominal, float(np.linalg.norm(limits)))
    search = _Search(model, stand_u, gross, significance)
    found: list[Mistake] = []
    copies = [readings]
    for _ in range(STEPS):
        # wiring at V is judged by coefficients of readings whose other mistakes are corrected
        steps = (search.unit, search.map, search.terms, partial(search.map, verification=True))
        wrong = next(filter(None, (step(copies[-1]) for step in steps)), [])
        if not wrong:
            break
        found += [mistake for mistake, _ in wrong]
        copies += [copy for _, copy in wrong]
    return MistakeSearch(search.with_misfits(found, copies), copies[-1])


@dataclass(frozen=True)
class _Search:
    """The model, the stand and the data sheet, with a method for each kind of search."""

    model: ForwardModel
    stand_u: Mapping[str, float]
    gross: GrossSearch
    significance: float

    def unit(self, readings: Readings) -> list[tuple[Mistake, Readings]]:
        """Return a wrong unit, found by comparing signals, and the copy; empty with a data sheet (see `map`).

        The p-value counts every unit prefix of every channel in every part of the table.
        """
        unit = (
            wrong_unit(readings, self.model, sheet_of(readings.unit, ()))
            if self.gross.nominal is None
            else None
        )
        if unit is None:
            return []
        table, copy = OrientedRows.of(readings), unit.corrected(readings)
        parts = 1 + len(np.unique(table.pass_number)) + len(np.unique(table.label))
        log_scaling = -PREFIX * np.log(10.0) * float(np.sum(unit.power[table.rows]))
        p = self.gross.p_of_copy(readings, copy, log_scaling, 3 * parts * np.log(len(PREFIXES)))
        where = () if unit.installation is None else (unit.installation,)
        words, name = f"{unit.words}; {IN_UNIT_OF_FILE}", MistakeName.WRONG_UNIT
        return [(Mistake(name, unit.channels, where, unit.pass_number, None, words, p, ()), copy)]

    def map(self, readings: Readings, *, verification: bool = False) -> list[tuple[Mistake, Readings]]:
        """Return the likeliest other meaning of the record, or of its `verification` points, with the copy."""
        gross = (self.gross.find_at_verification if verification else self.gross.find)(readings)
        if gross is None:
            return []
        table = OrientedRows.of(readings, verification=verification)
        return [(_gross_mistake(gross), gross.supposition.correct(readings, table))]

    def terms(self, readings: Readings) -> list[tuple[Mistake, Readings]]:
        """Return the wrong passes and readings, each with a copy that corrects it and those before it."""
        table, terms = self._of(readings)
        angle, kept = readings.angle_rad.copy(), np.ones(len(readings), dtype=bool)
        skipped, found = list(readings.skipped), []
        for wrong in terms.find(self.significance):
            mistake, rows = _of_term(terms, wrong, readings.unit), table.rows[wrong.rows]
            if wrong.off_rad is None:
                kept[rows] = False
                skipped.append(mistake.words.split(";")[0])
            else:
                angle[rows] += wrong.off_rad
            copy = replace(readings, angle_rad=angle.copy(), skipped=tuple(skipped))
            found.append((mistake, copy.select(kept)))
        return found

    def _of(self, readings: Readings) -> tuple[OrientedRows, TermSearch]:
        table = OrientedRows.of(readings)
        problem = make_problem(self.model, readings.oriented().conditions(), self.stand_u)
        floor = noise_floor(table.signal, readings.resolution, problem.free)

        def fit(rows: Mask) -> Block:
            return self.gross.fit(table, rows).block

        return table, TermSearch(problem, table.signal, floor, fit)

    def with_misfits(self, found: Sequence[Mistake], copies: Sequence[Readings]) -> tuple[Mistake, ...]:
        """Return the mistakes with the misfits before and after the correction of each.

        `copies` are the record, then the copy after each correction. A mistake at verification points does not
        change the misfit of the oriented readings, and gets no misfits.
        """
        if not found:
            return ()
        last = self._of(copies[-1])[1].table
        seen = max((last.seen(ratio) for ratio in RATIOS), key=lambda one: one.log_evidence)
        sizes = []
        for copy in copies:
            oriented, terms = self._of(copy)
            sheet = float(np.sum(self.gross.fit(oriented, oriented.every).sheet))
            sizes.append(float(np.sqrt((terms.table.chi2(seen) + sheet) / oriented.signal.size)))
        return tuple(
            replace(mistake, misfit_before=before, misfit_after=after) if before != after else mistake
            for mistake, before, after in zip(found, sizes[:-1], sizes[1:], strict=True)
        )


def _instead(other: Reinterpretation, supposition: Reinterpretation) -> str:
    """Return in words how another supposition with the same name differs from `supposition`."""
    place = str(other.scope).removeprefix("in ")
    if other.channels != supposition.channels:
        return message(f"the same of {', '.join(other.channels)} in {place}")
    if str(other.scope) != str(supposition.scope):
        return message(f"the same in {place}")
    return message(f"this: {other.words.split(';')[0]}")


def _gross_mistake(gross: GrossMistake) -> Mistake:
    supposition = gross.supposition
    names = dict.fromkeys(other.name for other in gross.equal if other.name != supposition.name)
    also = [
        message(f"{name} (the block sat otherwise)") if name == MistakeName.OTHER_MOUNTING else name
        for name in names
    ]
    also += [
        _instead(other, supposition)
        for other in gross.equal
        if other.name == supposition.name and other.words != supposition.words
    ]
    words = supposition.words
    if also:
        words += "; " + message(f"these readings cannot separate it from {', '.join(dict.fromkeys(also))}")
    return Mistake(
        name=supposition.name,
        channels=supposition.channels,
        installations=tuple(str(mount) for mount in supposition.scope.mounts),
        pass_number=supposition.scope.pass_number,
        point=None,
        words=words,
        p=gross.p,
        cannot_tell_from=tuple(names),
    )


def _of_term(terms: TermSearch, wrong: WrongReadings, unit: str) -> Mistake:
    conditions, row = terms.problem.conditions, int(wrong.rows[0])
    mount, number = str(conditions.mounts[conditions.mount[row]]), int(conditions.pass_number[row])
    point = None if wrong.whole else int(conditions.point[row])
    stated_deg = float(np.degrees(conditions.angle_rad[row]))
    said = _pass_words(wrong) if wrong.whole else _reading_words(wrong, stated_deg, unit)
    where = message(f"installation {mount}, pass {number}")
    if point is not None:
        where = message(f"installation {mount}, pass {number}, point {point}")
    return Mistake(
        wrong.name, wrong.channels, (mount,), number, point, f"{where}: {said}", wrong.p, wrong.ties
    )


def _pass_words(wrong: WrongReadings) -> str:
    same = message(f" ({', '.join(wrong.ties)} would look the same)") if wrong.ties else ""
    if wrong.off_rad is not None:
        return head_was_off(float(np.degrees(wrong.off_rad)), also=same)
    what = message("another block was mounted: K and U0 of all channels are others")
    if wrong.name == MistakeName.STUCK_CHANNEL:
        what = message(f"channel {wrong.channels[0]} reads the same at all points, as if stuck")
    return f"{what}; " + message(f"the copy leaves the pass out{same}")


def _reading_words(wrong: WrongReadings, stated_deg: float, unit: str) -> str:
    if wrong.off_rad is not None:
        same = (
            message(f" (an outlier of channel {wrong.channels[0]} would look the same)") if wrong.ties else ""
        )
        words = message(
            f"the signals stand as if the head had been at {stated_deg + np.degrees(wrong.off_rad):.7g}° "
            f"and not at {stated_deg:.7g}°"
        )
        return words + "; " + message(f"the copy has the corrected angle{same}")
    off = ", ".join(message(f"{c} by {wrong.shift[CHANNELS.index(c)]:+.3g} {unit}") for c in wrong.channels)
    words = message(
        f"channel {off} off the value that the other readings predict ({wrong.sigma:.0f} standard deviations)"
    )
    return words + "; " + message("the copy leaves the reading out")
