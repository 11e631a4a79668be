"""When units are due, of many at once: reckoned once and kept in the catalogue until a unit's runs change.

A history of a hundred calibrations takes a good part of a tenth of a second; a laboratory has a thousand. What was
found for a unit stands in a table of its own; a sync that writes, marks or takes back a run of the unit forgets
it, and `bench catalogue sync --due` has it reckoned anew, so that who asks need not wait. Processes reckon of many.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from sqlalchemy import delete, insert, select

from bench.api.errors import Refused
from bench.base.progress import tracked
from bench.catalogue.processes import pool_of
from bench.catalogue.questions import condition_of
from bench.catalogue.schema import DUES, FOLDERS, RUNS
from bench.catalogue.store import Catalogue, open_catalogue

if TYPE_CHECKING:
    from sqlalchemy import ColumnElement, Connection

INTERVAL_DAYS: Final = 365.0
"""The interval that counts where there is no history, unless another is stated."""
METHOD: Final = 1
"""Of the reckoning (`bench.analysis.history.due`): it rises where dates would be others, and what was kept goes."""
KEPT_AT_ONCE: Final = 20
"""Units whose answers are written at once: an ask that is ended goes on there."""
FEW: Final = 150
"""So few units are reckoned in this process: starting others takes longer."""
ENDED: Final = "a process that reckoned when units are due was ended; ask again: it goes on where it was"

Reckoned = list[tuple[str, dict[str, Any], str]]
"""Units with what was found, and a mark of all that tells it."""


def due_units(
    catalogue: Catalogue,
    query: Sequence[str],
    *,
    limit_g: float | None = None,
    interval_days: float | None = None,
    processes: int | None = None,
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return when the units of a question are due, as JSON has it, the first first; and why of others nobody knows.

    `limit_g` is the error allowed, by default the limit of each unit's last verification. Of many units `processes`
    reckon, as many as there are cores unless stated. Raises `Refused` for a question that is none.
    """
    interval = interval_days or INTERVAL_DAYS
    asked = f"method {METHOD}, limit {limit_g!r}, interval {interval!r}"
    of_question = select(RUNS.c.unit).distinct().where(condition_of(query), RUNS.c.unit.is_not(None))
    with catalogue.reading() as connection:
        names = sorted(connection.execute(of_question).scalars())
        known = select(DUES.c.unit, DUES.c.told).where(DUES.c.asked == asked)
        told = {unit: json.loads(text) for unit, text in connection.execute(known)}
    lacking = [name for name in names if name not in told]
    count = os.cpu_count() or 1 if processes is None else processes
    for some in _reckoned(catalogue, lacking, limit_g, interval, count):
        told |= {name: found for name, found, _ in some}
        _keep(catalogue, some, asked)
    rows = [{"unit": name, **told[name]["due"]} for name in names if told[name]["due"] is not None]
    odd = {name: told[name]["why_not"] for name in names if told[name]["due"] is None}
    return sorted(rows, key=lambda row: (row["due"], row["unit"])), odd


def forget_dues(connection: Connection, changed: ColumnElement[bool]) -> None:
    """Forget when units are due of which runs change; `changed` is a condition on runs."""
    units = select(RUNS.c.unit).where(changed)
    connection.execute(delete(DUES).where(DUES.c.unit.in_(units)))


def _reckoned(
    catalogue: Catalogue, names: Sequence[str], limit_g: float | None, interval_days: float, processes: int
) -> Iterator[Reckoned]:
    """Yield what is found for units, some at a time: here, or by processes where they are many."""
    parts = [names[i : i + KEPT_AT_ONCE] for i in range(0, len(names), KEPT_AT_ONCE)]
    told = "reckoning when units are due"
    if len(names) <= FEW or processes < 2:
        for part in tracked(parts, told):
            yield _reckon(catalogue, part, limit_g, interval_days)
        return
    where = catalogue.engine.url.render_as_string(hide_password=False)
    with pool_of(processes, ENDED) as pool:
        asked = deque(pool.submit(_reckon_apart, where, part, limit_g, interval_days) for part in parts)
        for _ in tracked(parts, told):
            yield asked.popleft().result()


def _reckon_apart(where: str, names: Sequence[str], limit_g: float | None, interval_days: float) -> Reckoned:
    with open_catalogue(where, existing=True) as catalogue:
        return _reckon(catalogue, names, limit_g, interval_days)


def _reckon(
    catalogue: Catalogue, names: Sequence[str], limit_g: float | None, interval_days: float
) -> Reckoned:
    # what reckons takes longer to load than what was kept takes to read
    from bench.catalogue.unit import compared_of, due_of, limit_of

    found = []
    for name in names:
        with catalogue.reading() as connection:
            mark = _mark(connection, name)
        table, simulated, _ = compared_of(catalogue, name)
        limit = limit_g if limit_g is not None else limit_of(catalogue, [f"unit={name}"])
        due, why_not = due_of(table, limit, interval_days, simulated=simulated)
        found.append((name, {"due": due and due.to_json(), "why_not": why_not}, mark))
    return found


def _keep(catalogue: Catalogue, found: Reckoned, asked: str) -> None:
    """Keep what was found where nothing of a unit changed meanwhile."""
    with suppress(Refused), catalogue.writing() as connection:  # who may only read is told all the same
        for name, told, mark in found:
            if mark and _mark(connection, name) == mark:
                connection.execute(delete(DUES).where(DUES.c.unit == name, DUES.c.asked == asked))
                connection.execute(insert(DUES).values(unit=name, asked=asked, told=json.dumps(told)))


def _mark(connection: Connection, name: str) -> str:
    """Return a mark of the runs of a unit as they are known; empty where one was written a moment ago.

    Its files may then change once more without their times showing it (`bench.catalogue.scan.SETTLED_NS`).
    """
    asked = (
        select(FOLDERS.c.path, FOLDERS.c.fingerprint, FOLDERS.c.reason, RUNS.c.vanished, RUNS.c.record)
        .join(RUNS, RUNS.c.id == FOLDERS.c.run)
        .where(RUNS.c.unit == name)
        .order_by(FOLDERS.c.path)
    )
    rows = [tuple(row) for row in connection.execute(asked)]
    if not all(fingerprint for _, fingerprint, *_ in rows):
        return ""
    return hashlib.sha256(repr(rows).encode()).hexdigest()
