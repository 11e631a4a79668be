"""Tables of readings on one bench, of one block or of several, made into one table: one body of data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.readings.table import Readings

BETWEEN_S: Final = 3600.0
"""From the last reading of a table to the first of the next, s, where nobody knows better."""


@dataclass(frozen=True)
class JoinedPart:
    """A table, and the time at which its clock began, s of any common clock; None where it is not known.

    `block` is the number of the block that it is of, `None` where nobody says.
    """

    readings: Readings
    began_s: float | None = None
    block: int | None = None


def together(parts: Sequence[JoinedPart]) -> Readings:
    """Return one table of several, in the order in which they were measured.

    Series are renumbered so that no mounting of one table is taken for one of another: the first table keeps
    its own, each further one begins after the last series before it. Times run on: with the real distance
    where every table has its beginning and none begins before another ends, else `BETWEEN_S` apart; rows
    without a time get one at the pace of `Conditions.elapsed_s`; `Readings.began_s` keeps when the clock of each
    run began. `notes` say which table became what. Raises
    `ValueError` for tables in different units.
    """
    units = {part.readings.unit: part.readings.source for part in parts}
    if len(units) > 1:
        each = ", ".join(f"{source} in {unit}" for unit, source in units.items())
        raise ValueError(f"signals in different units cannot be taken together: {each}")
    ordered, starts, real = _starts(parts)
    tables: list[Readings] = []
    notes: list[str] = []
    last_series = 0
    for part, start_s in zip(ordered, starts, strict=True):
        table = part.readings
        shift = last_series - (int(table.series.min()) - 1) if tables else 0
        clock_s = _clock_s(table)
        began_s = np.zeros(len(table)) if table.began_s is None else table.began_s
        tables.append(
            replace(
                table,
                series=table.series + shift,
                time_s=start_s + clock_s - clock_s[0],
                began_s=start_s + began_s - clock_s[0],
                block=None if part.block is None else np.full(len(table), part.block),
            )
        )
        last_series = int(tables[-1].series.max())
        first_series = int(tables[-1].series.min())
        series = f"series {first_series}" + (f" to {last_series}" if last_series > first_series else "")
        begun = f", begun {start_s / 3600.0:.2f} h after the first" if len(tables) > 1 else ""
        notes.append(
            f"{table.source} is {series}{begun}{'' if real or not begun else ' (set, not measured)'}"
        )
    return stacked(tables, tuple(notes))


def _clock_s(table: Readings) -> Floats:
    """The time of each reading on the clock of the table, also where it is not known."""
    return table.time_s if table.began_s is not None else table.conditions().elapsed_s


def _starts(parts: Sequence[JoinedPart]) -> tuple[list[JoinedPart], list[float], bool]:
    """Return the tables in order, when the first reading of each was taken, s, and whether that is measured."""
    lasts = {id(part): float(np.max(clock_s) - clock_s[0]) for part, clock_s in _clocks(parts)}
    known = [p.began_s + _first_s(p.readings) for p in parts if p.began_s is not None]
    if len(known) == len(parts):
        order = np.argsort(known, kind="stable")
        ordered = [parts[i] for i in order]
        starts = [known[i] - min(known) for i in order]
        ends = [start + lasts[id(part)] for start, part in zip(starts, ordered, strict=True)]
        if all(later >= end for end, later in zip(ends, starts[1:], strict=False)):
            return ordered, starts, True
    starts = [0.0]
    for part in parts[:-1]:
        starts.append(starts[-1] + lasts[id(part)] + BETWEEN_S)
    return list(parts), starts, False


def _clocks(parts: Sequence[JoinedPart]) -> Iterator[tuple[JoinedPart, Floats]]:
    return ((part, _clock_s(part.readings)) for part in parts)


def _first_s(table: Readings) -> float:
    return float(table.time_s[0]) if np.isfinite(table.time_s[0]) else 0.0


def stacked(tables: Sequence[Readings], notes: tuple[str, ...] = ()) -> Readings:
    """Return tables as one, one after another; what each says stands with its name."""
    columns: dict[str, Any] = {
        of.name: np.concatenate([getattr(table, of.name) for table in tables])
        for of in fields(Readings)
        if isinstance(getattr(tables[0], of.name), np.ndarray)
    }
    extra = {
        name: np.concatenate(
            [table.extra.get(name, np.full(len(table), "", dtype=np.str_)) for table in tables]
        )
        for name in dict.fromkeys(name for table in tables for name in table.extra)
    }
    return replace(
        tables[0],
        source=" + ".join(table.source for table in tables),
        **columns,
        extra=extra,
        notes=(*notes, *(f"{table.source}: {note}" for table in tables for note in table.notes)),
        skipped=tuple(text for table in tables for text in table.skipped),
        verification_missing=sum(table.verification_missing for table in tables),
        corrected=any(table.corrected for table in tables),
        resolution_read=min(table.resolution for table in tables)
        if any(table.corrected for table in tables)
        else None,
    )
