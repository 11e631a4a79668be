"""When units are due, of many at once: reckoned once and kept in the catalogue until a unit's runs change.

A history of a hundred calibrations takes a good part of a tenth of a second; a laboratory has a thousand. What was
found for a unit stands in a table of its own; a sync that writes, marks or takes back a run of the unit forgets it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from sqlalchemy import delete, insert, select

from bench.api.errors import Refused
from bench.base.progress import tracked
from bench.catalogue.questions import condition_of
from bench.catalogue.schema import DUES, RUNS
from bench.catalogue.store import Catalogue

if TYPE_CHECKING:
    from sqlalchemy import ColumnElement, Connection

INTERVAL_DAYS: Final = 365.0
"""The interval that counts where there is no history, unless another is stated."""
METHOD: Final = 1
"""Of the reckoning (`bench.analysis.history.due`): it rises where dates would be others, and what was kept goes."""
KEPT_AT_ONCE: Final = 20
"""Units whose answers are written at once: an ask that is ended goes on there."""


def due_units(
    catalogue: Catalogue,
    query: Sequence[str],
    *,
    limit_g: float | None = None,
    interval_days: float | None = None,
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return when the units of a question are due, as JSON has it, the first first; and why of others nobody knows.

    `limit_g` is the error allowed, by default the limit of each unit's last verification. Raises `Refused` for a
    question that is none.
    """
    interval = interval_days or INTERVAL_DAYS
    asked = f"method {METHOD}, limit {limit_g!r}, interval {interval!r}"
    of_question = select(RUNS.c.unit).distinct().where(condition_of(query), RUNS.c.unit.is_not(None))
    with catalogue.reading() as connection:
        names = sorted(connection.execute(of_question).scalars())
        known = select(DUES.c.unit, DUES.c.told).where(DUES.c.asked == asked)
        told = {unit: json.loads(text) for unit, text in connection.execute(known)}
    lacking = iter(tracked([name for name in names if name not in told], "reckoning when units are due"))
    while some := list(islice(lacking, KEPT_AT_ONCE)):
        told |= _reckoned(catalogue, some, asked, limit_g, interval)
    rows = [{"unit": name, **told[name]["due"]} for name in names if told[name]["due"] is not None]
    odd = {name: told[name]["why_not"] for name in names if told[name]["due"] is None}
    return sorted(rows, key=lambda row: (row["due"], row["unit"])), odd


def forget_dues(connection: Connection, changed: ColumnElement[bool]) -> None:
    """Forget when units are due of which runs change; `changed` is a condition on runs."""
    units = select(RUNS.c.unit).where(changed)
    connection.execute(delete(DUES).where(DUES.c.unit.in_(units)))


def _reckoned(
    catalogue: Catalogue, names: Sequence[str], asked: str, limit_g: float | None, interval_days: float
) -> dict[str, Any]:
    """Return what is found for units, and keep it where nothing of a unit changed meanwhile."""
    found, marks = {}, {}
    for name in names:
        told, marks[name] = _of_unit(catalogue, name, limit_g, interval_days)
        found[name] = told
    with suppress(Refused), catalogue.writing() as connection:  # who may only read is told all the same
        for name in names:
            if _of_unit(catalogue, name, limit_g, None)[1] == marks[name]:
                connection.execute(delete(DUES).where(DUES.c.unit == name, DUES.c.asked == asked))
                row = {"unit": name, "asked": asked, "told": json.dumps(found[name])}
                connection.execute(insert(DUES).values(row))
    return found


def _of_unit(
    catalogue: Catalogue, name: str, limit_g: float | None, interval_days: float | None
) -> tuple[dict[str, Any], str]:
    """Return when a unit is due (nothing, where no interval is given), and a mark of all that tells it."""
    # what reckons takes longer to load than what was kept takes to read
    from bench.catalogue.unit import compared_of, due_of, limit_of

    table, simulated, _ = compared_of(catalogue, name)
    limit = limit_g if limit_g is not None else limit_of(catalogue, [f"unit={name}"])
    mark = hashlib.sha256(f"{limit!r} {simulated}".encode())
    for part in (table.when, table.vector, table.covariance, table.u_meters):
        mark.update(part.tobytes())
    if interval_days is None:
        return {}, mark.hexdigest()
    due, why_not = due_of(table, limit, interval_days, simulated=simulated)
    return {"due": due and due.to_json(), "why_not": why_not}, mark.hexdigest()
