"""A unit in the catalogue: its runs, coefficients over time, and due date."""

from __future__ import annotations

import hashlib
import json
import os
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import timedelta
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from sqlalchemy import delete, insert, select

from bench.base.arrays import u_of
from bench.base.computing import tracked
from bench.base.languages import message
from bench.base.text import as_typed
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.calibration.result import CalibrationError
from bench.catalogue.questions import answer, condition_of, moment
from bench.catalogue.store import (
    CERTIFICATES,
    DUES,
    FOLDERS,
    INSTRUMENTS,
    RUNS,
    USES,
    VERIFICATIONS,
    Catalogue,
    open_catalogue,
)
from bench.catalogue.sync import pool_of
from bench.catalogue.values import CoefficientTable, coefficient_table
from bench.history.drift import Due, due
from bench.model.geometry import COEFFICIENTS
from bench.results.catalogue import (
    CoefficientThen,
    DueResult,
    InstrumentDue,
    UnitCalibration,
    UnitDue,
    UnitResult,
    due_part,
)
from bench.services.errors import Refused
from bench.services.validated import REMINDED_DAYS
from drivers.clock import utc_now

if TYPE_CHECKING:
    from sqlalchemy import Connection


INTERVAL_DAYS: Final = 365.0
"""The default calibration interval (days), for units without a sufficient history."""
MOST_DAYS: Final = 36_525
METHOD: Final = 2
"""Version of the drift method. Increment it when the method gives other due dates; cached dates then expire."""
KEPT_AT_ONCE: Final = 20
"""Number of units whose due dates are written at once; an interrupted query resumes from there."""
FEW: Final = 150
"""Up to this many units are computed in this process, because starting worker processes would take longer."""
ENDED: Final = "a process computing due dates ended; repeat the command, which continues there"

Reckoned = list[tuple[str, dict[str, Any], str]]
"""Computed due dates: name of the unit, due date (JSON data), and fingerprint of the data behind it."""


def due_units(
    catalogue: Catalogue,
    query: Sequence[str],
    *,
    limit_g: float | None = None,
    interval_days: float | None = None,
    before: str | None = None,
    processes: int | None = None,
) -> DueResult:
    """Return the due dates of the selected units and the certificates that expire soon, earliest first.

    `limit_g` is the permitted error (g) of a measurement of 1 g, by default the limit of each unit's last
    verification. If a unit's history is too short to show drift, `interval_days` determines its date. Units
    without a due date have a reason instead. `before` (ISO 8601) leaves out what is due on that day or later;
    by default, all units and all certificates that expire within 30 days or have expired are listed.
    `processes` worker processes compute the dates of many units, by default one for each core. Raises
    `Refused` for an invalid question, limit or interval.
    """
    interval = _checked(limit_g, interval_days)
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
    units = [UnitDue(unit=name, **told[name]["due"]) for name in names if told[name]["due"] is not None]
    asked_for = [one for one in units if before is None or one.due < before]
    return DueResult(
        query=list(query),
        units=sorted(asked_for, key=lambda one: (one.due, one.unit)),
        instruments=_instruments_due(catalogue, query, before),
        not_known={name: told[name]["why_not"] for name in names if told[name]["due"] is None},
    )


def _instruments_due(catalogue: Catalogue, query: Sequence[str], before: str | None) -> list[InstrumentDue]:
    """Return the instruments whose latest certificate expires before a day (default: in 30 days)."""
    day = (utc_now().date() + timedelta(days=REMINDED_DAYS + 1)).isoformat() if before is None else before
    wanted = (INSTRUMENTS.c.name, CERTIFICATES.c.number, CERTIFICATES.c.valid_until)
    stated = (
        select(*wanted)
        .distinct()
        .select_from(
            USES.join(RUNS, RUNS.c.id == USES.c.run)
            .join(INSTRUMENTS, INSTRUMENTS.c.id == USES.c.instrument)
            .join(CERTIFICATES, CERTIFICATES.c.id == USES.c.certificate)
        )
        .where(condition_of(query))
        .order_by(INSTRUMENTS.c.name, CERTIFICATES.c.date)
    )
    with catalogue.reading() as connection:
        latest = {name: (number, until) for name, number, until in connection.execute(stated)}
    found = [
        InstrumentDue(instrument=name, certificate=number, valid_until=until.isoformat())
        for name, (number, until) in latest.items()
        if until is not None and until.isoformat() < day
    ]
    return sorted(found, key=lambda one: (one.valid_until, one.instrument))


def until_day(before: str | None) -> str | None:
    """Return the day (UTC, ISO 8601) of a time; None if `before` is None. Raises `Refused` for another text."""
    try:
        return moment(before).date().isoformat() if before else None
    except ValueError as error:
        raise Refused(f"--before {before}: {error}") from None


def _checked(limit_g: float | None, interval_days: float | None) -> float:
    """Return the interval in days. Raises `Refused` for an invalid limit or interval."""
    for option, value in (("--limit", limit_g), ("--interval", interval_days)):
        if value is not None and not value > 0.0:
            raise Refused(f"{option} {value:g} is not positive; give a number above zero")
    if interval_days is not None and interval_days > MOST_DAYS:
        raise Refused(f"--interval {interval_days:g} is too long; give at most {MOST_DAYS} days")
    return interval_days or INTERVAL_DAYS


def _reckoned(
    catalogue: Catalogue, names: Sequence[str], limit_g: float | None, interval_days: float, processes: int
) -> Iterator[Reckoned]:
    """Yield the due dates of units in groups, computed in this process or, for many units, in worker processes."""
    parts = [names[i : i + KEPT_AT_ONCE] for i in range(0, len(names), KEPT_AT_ONCE)]
    told = "computing when units are due"
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
    found = []
    for name in names:
        with catalogue.reading() as connection:
            mark = _mark(connection, name)
        table, simulated, _ = compared_of(catalogue, name)
        limit = limit_g if limit_g is not None else limit_of(catalogue, [f"unit={name}"])
        due, why_not = due_of(table, limit, interval_days, simulated=simulated)
        part = None if due is None else due_part(due).to_dict()
        found.append((name, {"due": part, "why_not": why_not}, mark))
    return found


def _keep(catalogue: Catalogue, found: Reckoned, asked: str) -> None:
    """Cache the due dates in `found`, except those of units whose data changed after the computation."""
    with suppress(Refused), catalogue.writing() as connection:  # read-only users get no cache
        for name, told, mark in found:
            if mark and _mark(connection, name) == mark:
                connection.execute(delete(DUES).where(DUES.c.unit == name, DUES.c.asked == asked))
                connection.execute(insert(DUES).values(unit=name, asked=asked, told=json.dumps(told)))


def _mark(connection: Connection, name: str) -> str:
    """Return a fingerprint of a unit's runs; "" if one was written just now, and might change unnoticed."""
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


MOST_NAMED: Final = 8


def unit_history(
    catalogue: Catalogue, unit: str, *, limit_g: float | None = None, interval_days: float | None = None
) -> UnitResult:
    """Return the history of a unit, named by its serial number or by type and serial number.

    `limit_g` is the permitted error (g) of a measurement of 1 g, by default the limit of the last verification.
    `interval_days` determines the due date if the history is too short to show drift. Raises `Refused` if no unit
    or several have that name.
    """
    interval = _checked(limit_g, interval_days)
    name = _name_of(catalogue, unit)
    table, simulated, notes = compared_of(catalogue, name)
    query = [f"unit={name}"]
    limit = limit_g if limit_g is not None else limit_of(catalogue, query)
    found, why_not = due_of(table, limit, interval, simulated=simulated)
    return UnitResult(
        unit=name,
        simulated=simulated,
        due=None if found is None else due_part(found),
        why_not_due=why_not,
        calibrations=[_calibration(table, k) for k in range(len(table))],
        runs=answer(catalogue, query).mappings(),
        notes=notes,
    )


def _calibration(table: CoefficientTable, k: int) -> UnitCalibration:
    sizes = zip(COEFFICIENTS, table.vector[k].tolist(), u_of(table.covariance[k]).tolist(), strict=True)
    return UnitCalibration(
        path=table.path[k],
        created=f"{table.when[k].astype('datetime64[s]')}+00:00",
        bench=table.bench[k],
        unit=table.signal_unit[k],
        g_m_s2=table.g_m_s2[k],
        coefficients={
            name: CoefficientThen(value=value, u=u, U=COVERAGE_FACTOR * u) for name, value, u in sizes
        },
    )


def unit_calibrations(catalogue: Catalogue, unit: str) -> list[UnitCalibration]:
    """Return the calibrations of one unit that can be compared. Raises the `Refused` of `unit_history`."""
    table, _, _ = compared_of(catalogue, _name_of(catalogue, unit))
    return [_calibration(table, k) for k in range(len(table))]


def compared_of(catalogue: Catalogue, name: str) -> tuple[CoefficientTable, bool, list[str]]:
    """Return the comparable calibrations of a unit, whether all are simulated, and notes on those left out.

    All scale factors refer to the local g of the last calibration.
    """
    kept = coefficient_table(catalogue, [f"unit={name}"])
    notes = [message(f"without {words}") for words in kept.left_out]
    dated = ~np.isnat(kept.when)
    if not np.all(dated):
        notes.append(message(f"without {np.sum(~dated)} calibrations that have no date"))
    kept = kept.of(dated)
    simulated = bool(len(kept)) and bool(np.all(kept.simulated))
    if not simulated and np.any(kept.simulated):
        notes.append(message(f"without {np.sum(kept.simulated)} calibrations of simulated runs"))
        kept = kept.of(~kept.simulated)
    if len(kept):
        same = np.array([one == kept.signal_unit[-1] for one in kept.signal_unit], dtype=np.bool_)
        if not np.all(same):
            notes.append(message(f"without {np.sum(~same)} calibrations of signals in another unit"))
            kept = kept.of(same)
        kept = kept.per(float(kept.g_m_s2[-1]), float(kept.gravity_u[-1]))
    return kept, simulated, notes


def _name_of(catalogue: Catalogue, unit: str) -> str:
    if "*" in unit:
        command = f"bench catalogue ask {as_typed(f'unit={unit}')} --of units"
        raise Refused(
            f"{unit}: a pattern may mean several units; give the name of one unit ('{command}' lists them)"
        )
    asked = select(RUNS.c.unit).distinct().where(condition_of([f"unit={unit}"])).order_by(RUNS.c.unit)
    with catalogue.reading() as connection:
        names = [str(name) for name in connection.execute(asked).scalars()]
    if not names:
        raise Refused(
            f"{unit}: the catalogue has no such unit; 'bench catalogue ask --of units' lists its units"
        )
    if len(names) > 1:
        listed = ", ".join(f"'{name}'" for name in names[:MOST_NAMED])
        raise Refused(f"{unit}: several units have this serial number: {listed}; name one with its type")
    return names[0]


def limit_of(catalogue: Catalogue, query: list[str]) -> float | None:
    """Return the last limit of |Δg| (local g) that a verification of the selected runs states, or None."""
    joined = RUNS.join(VERIFICATIONS, VERIFICATIONS.c.run == RUNS.c.id)
    asked = (
        select(VERIFICATIONS.c.limit_g)
        .select_from(joined)
        .where(condition_of(query), VERIFICATIONS.c.limit_g.is_not(None))
        .order_by(RUNS.c.created.desc())
        .limit(1)
    )
    with catalogue.reading() as connection:
        found = connection.execute(asked).scalar()
    return None if found is None else float(found)


def due_of(
    table: CoefficientTable, limit_g: float | None, interval_days: float, *, simulated: bool
) -> tuple[Due | None, str]:
    """Return the due date of a unit from its calibrations and ""; without a due date, None and the reason.

    `limit_g` is the permitted error (g) of a measurement of 1 g; None gives no due date. `interval_days`
    determines the date if the history is too short to show drift.
    """
    if not len(table):
        return None, "no trusted calibration has a date"
    if limit_g is None:
        return None, "no verification states a limit; give --limit"
    meters = None if np.any(np.isnan(table.u_meters)) else table.u_meters
    try:
        found = due(
            table.when, table.vector, table.covariance, limit_g, interval_days, meters, simulated=simulated
        )
    except CalibrationError as error:
        return None, str(error)
    return found, ""
