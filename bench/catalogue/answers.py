"""Answers of the catalogue as tables: the runs of a question, or their units, benches, instruments …"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from sqlalchemy import ColumnElement, Select, and_, case, func, select

from bench.base.arrays import u_of
from bench.base.files import write_whole
from bench.catalogue.questions import condition_of
from bench.catalogue.schema import (
    CALIBRATIONS,
    CERTIFICATES,
    DIAGNOSES,
    FOLDERS,
    INSTRUMENTS,
    ISSUED,
    RUNS,
    USES,
    VERIFICATIONS,
)
from bench.catalogue.store import Catalogue
from bench.model.geometry import COEFFICIENTS
from bench.services.errors import Refused

Condition = ColumnElement[bool]


@dataclass(frozen=True)
class Answer:
    """A table: the names of its columns, its rows (None where nothing was recorded)."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]

    def __len__(self) -> int:
        return len(self.rows)

    def to_json(self) -> list[dict[str, Any]]:
        """Return the rows as mappings; times in ISO 8601, UTC."""
        return [
            {name: _in_json(value) for name, value in zip(self.columns, row, strict=True)}
            for row in self.rows
        ]

    def to_csv(self) -> str:
        """Return the table as CSV (RFC 4180); what a spreadsheet would take for a formula has a ' before it."""
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(self.columns)
        writer.writerows([_in_a_cell(value) for value in row] for row in self.rows)
        return text.getvalue()

    def write_parquet(self, file: Path) -> None:
        """Write the table as Parquet, times in UTC. Raises `OSError`."""
        import pyarrow
        from pyarrow import parquet

        names = self.columns
        table = pyarrow.table(
            [pyarrow.array([row[k] for row in self.rows]) for k in range(len(names))], names=list(names)
        )
        written = io.BytesIO()
        parquet.write_table(table, written)
        write_whole(file, written.getvalue())


def answer(catalogue: Catalogue, query: Sequence[str], of: str = "runs") -> Answer:
    """Return the runs that a question names, or what `of` says of them (see `KINDS`).

    Raises `Refused` for a question that is none.
    """
    if of not in KINDS:
        raise Refused(f"--of {of}: known are {', '.join(KINDS)}")
    statement = KINDS[of](condition_of(query))
    with catalogue.reading() as connection:
        result = connection.execute(statement)
        found = Answer(tuple(result.keys()), tuple(tuple(row) for row in result))
    return _unpacked(found) if of == "coefficients" else found


def _runs(asked: Condition) -> Select[Any]:
    joined = RUNS.outerjoin(VERIFICATIONS, VERIFICATIONS.c.run == RUNS.c.id).outerjoin(
        DIAGNOSES, DIAGNOSES.c.run == RUNS.c.id
    )
    run = RUNS.c
    return (
        select(
            run.name, run.created, run.unit, run.bench, run.procedure, run.operator, run.state, run.simulated,
            VERIFICATIONS.c.verdict, VERIFICATIONS.c.worst_delta_g, DIAGNOSES.c.verdict.label("diagnosis"),
            DIAGNOSES.c.names.label("effects"), run.readings, run.record, run.problem, run.vanished, run.path,
        )
        .select_from(joined)
        .where(asked)
        .order_by(run.created, run.path)
    )  # fmt: skip


def _coefficients(asked: Condition) -> Select[Any]:
    run = RUNS.c
    kept = CALIBRATIONS.c
    return (
        select(
            run.name, run.created, run.unit, run.bench, run.simulated, kept.estimator, kept.model,
            kept.unit.label("signal_unit"), kept.g_m_s2, kept.sigma, kept.chi2, kept.dof, kept.p, kept.of_record,
            run.record, run.vanished, run.path, kept.vector, kept.covariance,
        )
        .select_from(RUNS.join(CALIBRATIONS, kept.run == run.id))
        .where(asked)
        .order_by(run.created, run.path)
    )  # fmt: skip


def _unpacked(found: Answer) -> Answer:
    """Return the table with each coefficient and its u in a column of its own."""
    size = len(COEFFICIENTS)
    rows = []
    for row in found.rows:
        values = np.frombuffer(row[-2], dtype="<f8")
        sizes = u_of(np.frombuffer(row[-1], dtype="<f8").reshape(size, size))
        rows.append((*row[:-2], *values.tolist(), *sizes.tolist()))
    names = (*found.columns[:-2], *COEFFICIENTS, *(f"u_{name}" for name in COEFFICIENTS))
    return Answer(names, tuple(rows))


def _counts() -> list[Any]:
    # the few that failed are looked up: to join all verifications takes several times as long
    fails = select(VERIFICATIONS.c.run).where(VERIFICATIONS.c.verdict == "fail").correlate(None)
    failed = func.sum(case((RUNS.c.id.in_(fails), 1), else_=0))
    simulated = func.sum(case((RUNS.c.simulated.is_(True), 1), else_=0))
    return [
        func.count().label("runs"),
        simulated.label("simulated_runs"),
        failed.label("failed"),
        func.min(RUNS.c.created).label("first"),
        func.max(RUNS.c.created).label("last"),
    ]


def _grouped(column: ColumnElement[Any], *further: Any) -> Callable[[Condition], Select[Any]]:
    def of(asked: Condition) -> Select[Any]:
        return (
            select(column, *further, *_counts())
            .select_from(RUNS)
            .where(asked)
            .group_by(column)
            .order_by(column.is_(None), column)
        )

    return of


def _instruments(asked: Condition) -> Select[Any]:
    one = INSTRUMENTS.c
    joined = USES.join(RUNS, RUNS.c.id == USES.c.run).join(INSTRUMENTS, one.id == USES.c.instrument)
    counts = (
        func.count(USES.c.run.distinct()).label("runs"),
        func.count(RUNS.c.unit.distinct()).label("units"),
    )
    return (
        select(
            one.name, one.serial, one.driver, *counts, func.count(RUNS.c.bench.distinct()).label("benches"),
            func.min(RUNS.c.created).label("first"), func.max(RUNS.c.created).label("last"),
        )
        .select_from(joined)
        .where(asked)
        .group_by(one.id, one.name, one.serial, one.driver)
        .order_by(one.name)
    )  # fmt: skip


def _certificates(asked: Condition) -> Select[Any]:
    one = CERTIFICATES.c
    joined = USES.join(RUNS, RUNS.c.id == USES.c.run).join(CERTIFICATES, one.id == USES.c.certificate)
    counts = (
        func.count(USES.c.run.distinct()).label("runs"),
        func.count(RUNS.c.unit.distinct()).label("units"),
    )
    return (
        select(
            one.number, one.laboratory, one.date, one.valid_until, one.serial, *counts,
            func.min(RUNS.c.created).label("first"), func.max(RUNS.c.created).label("last"),
        )
        .select_from(joined)
        .where(asked)
        .group_by(one.id, one.number, one.laboratory, one.date, one.valid_until, one.serial)
        .order_by(one.number, one.date)
    )  # fmt: skip


def _issued(asked: Condition) -> Select[Any]:
    one = ISSUED.c
    return (
        select(
            one.number, one.state, one.time, one.by, RUNS.c.name.label("run"), RUNS.c.unit, RUNS.c.bench,
            RUNS.c.created, one.register,
        )
        .select_from(ISSUED.join(RUNS, one.head == RUNS.c.head))
        .where(asked)
        .order_by(one.number, one.register)
    )  # fmt: skip


def _folders(asked: Condition) -> Select[Any]:
    bad = and_(FOLDERS.c.reason.is_not(None), FOLDERS.c.run.is_(None))
    told = and_(FOLDERS.c.reason.is_not(None), FOLDERS.c.run.in_(select(RUNS.c.id).where(asked)))
    return select(FOLDERS.c.path, FOLDERS.c.reason).where(bad | told).order_by(FOLDERS.c.path)


KINDS: Final[Mapping[str, Callable[[Condition], Select[Any]]]] = {
    "runs": _runs,
    "coefficients": _coefficients,
    "units": _grouped(RUNS.c.unit, func.count(RUNS.c.bench.distinct()).label("benches")),
    "benches": _grouped(RUNS.c.bench, func.count(RUNS.c.unit.distinct()).label("units")),
    "operators": _grouped(RUNS.c.operator, func.count(RUNS.c.unit.distinct()).label("units")),
    "instruments": _instruments,
    "certificates": _certificates,
    "issued": _issued,
    "folders": _folders,
}
"""What a question may be asked of: its runs, or what they have in common; `issued` are the certificates
that this laboratory issued of their records as they are, `folders` those that are bad."""


def _in_json(value: Any) -> Any:
    if isinstance(value, datetime):
        return f"{value.isoformat()}+00:00"
    return value.isoformat() if isinstance(value, date) else value


def _in_a_cell(value: Any) -> Any:
    told = _in_json(value)
    if isinstance(told, bool):
        return "yes" if told else "no"
    return f"'{told}" if isinstance(told, str) and told[:1] in ("=", "+", "-", "@", "\t", "\r") else told
