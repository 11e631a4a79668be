"""Questions to the catalogue, and their answers as tables.

A question consists of words KEY=VALUE, such as `unit=17-042 meter=MY53200001 after=2026-05-03 simulated=no`.
A run must satisfy all of them. In the value of a text key, `*` matches any text. For keys of texts and of yes
or no, `none` matches values that were not recorded, and `!=` selects them, too. Keys of numbers and times
also accept `<`, `<=`, `>` and `>=`; their conditions never select a run without the value. `after=2026-05-03`
selects runs begun at 0:00 UTC of that day or later, `before=2026-05-03` earlier runs. Values are never part
of the SQL text.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from operator import eq, ge, gt, le, lt, ne
from pathlib import Path
from typing import Any, Final

import numpy as np
from sqlalchemy import ColumnElement, Select, Table, and_, case, exists, func, not_, or_, select, true

from bench.base.arrays import u_of
from bench.base.files import write_whole
from bench.base.numbers import read_number
from bench.catalogue.store import (
    CALIBRATIONS,
    CERTIFICATES,
    DIAGNOSES,
    FOLDERS,
    INSTRUMENTS,
    ISSUED,
    RUNS,
    USES,
    VERIFICATIONS,
    Catalogue,
)  # fmt: skip
from bench.model.geometry import COEFFICIENTS
from bench.results.catalogue import AskResult
from bench.services.errors import Refused

Condition = ColumnElement[bool]
Build = Callable[[str, str], Condition]
"""A function that returns the condition for an operator and a value. It raises `ValueError` for invalid ones."""

NONE: Final = "none"
_WORD: Final = re.compile(r"([a-z_]+)(!=|>=|<=|=|>|<)(.*)", re.DOTALL)
_YES_NO: Final[Mapping[str, bool]] = {"yes": True, "no": False}
_VERDICTS: Final[Mapping[str, str]] = {"passed": "pass", "failed": "fail"}


@dataclass(frozen=True)
class Key:
    """A key in questions: its meaning in words, and the function that builds the condition for a value."""

    meaning: str
    build: Build


def condition_of(query: Sequence[str]) -> Condition:
    """Return a question as an SQL condition on the table `RUNS`. Raises `Refused` with all invalid words."""
    conditions: list[Condition] = []
    mistakes = []
    for word in query:
        found = _WORD.fullmatch(word)
        if found is None:
            mistakes.append(f"{word!r}: expected KEY=VALUE, such as unit=17-042")
            continue
        name, operator, value = found.groups()
        if name not in KEYS:
            mistakes.append(f"{word!r}: no key {name}; known: {', '.join(KEYS)}")
            continue
        try:
            conditions.append(KEYS[name].build(operator, value))
        except ValueError as error:
            mistakes.append(f"{word!r}: {error}")
    if mistakes:
        raise Refused("\n".join(mistakes))
    return and_(true(), *conditions)


def run_folders(catalogue: Catalogue, query: Sequence[str]) -> list[Path]:
    """Return the folders of the runs that satisfy a question, oldest first. Raises `Refused` for an invalid one."""
    asked = select(RUNS.c.path).where(condition_of(query), ~RUNS.c.vanished)
    with catalogue.reading() as connection:
        paths = connection.execute(asked.order_by(RUNS.c.created, RUNS.c.path)).scalars()
        return [Path(path) for path in paths]


# --- conditions -------------------------------------------------------------------------------------


def _like(column: ColumnElement[Any], value: str) -> Condition:
    """Return the condition that the text in a column equals `value`, in which `*` matches any text."""
    if value == NONE:
        return column.is_(None)
    if "*" not in value:
        return column == value
    escaped = value.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_").replace("*", "%")
    return column.like(escaped, escape="\\")


def _signed(operator: str, condition: Condition) -> Condition:
    """Return `condition` for `=`, its negation for `!=`. Raises `ValueError` for any other operator."""
    if operator == "=":
        return condition
    if operator == "!=":
        return not_(func.coalesce(condition, False))
    raise ValueError("expected the operator = or !=")


def _text(*columns: ColumnElement[Any]) -> Build:
    """Return the builder for a text key: at least one of the columns must equal the value."""

    def build(operator: str, value: str) -> Condition:
        return _signed(operator, or_(*(_like(column, value) for column in columns)))

    return build


def _among(table: Table, condition: Callable[[str], Condition]) -> Build:
    """Return the builder for a key on `table`: at least one row of the run there must satisfy the condition."""

    def build(operator: str, value: str) -> Condition:
        wanted = ~_row_of(table) if value == NONE else _row_of(table, condition(value))
        return _signed(operator, wanted)

    return build


def _row_of(table: Table, *conditions: Condition) -> Condition:
    """Return the condition that a run has a row in `table` that satisfies all `conditions`."""
    if conditions:  # a subquery on the index of the conditions, faster than one for each run
        return RUNS.c.id.in_(select(table.c.run).where(*conditions).correlate(None))
    return exists(select(table.c.run).where(table.c.run == RUNS.c.id).correlate(RUNS))


def _size(column: ColumnElement[Any], table: Table | None = None) -> Build:
    """Return the builder for a numerical key on a column; values are in the unit of the column."""

    def build(operator: str, value: str) -> Condition:
        try:
            size = read_number(value)
        except ValueError:
            size = math.nan
        if not math.isfinite(size):
            raise ValueError("expected a number")
        held = _compared(column, operator, size)
        return held if table is None else _row_of(table, held)

    return build


def _compared(column: ColumnElement[Any], operator: str, value: Any) -> Condition:
    compared: Condition = _COMPARISONS[operator](column, value)
    return compared


_COMPARISONS: Final = {"=": eq, "!=": ne, "<": lt, "<=": le, ">": gt, ">=": ge}


def _whether(column: ColumnElement[Any]) -> Build:
    def build(operator: str, value: str) -> Condition:
        if value == NONE:
            return _signed(operator, column.is_(None))
        if value not in _YES_NO:
            raise ValueError("expected yes, no or none")
        return _signed(operator, column.is_(_YES_NO[value]))

    return build


def _time(fixed: str | None = None) -> Build:
    """Return the builder for a key on a run's start time; the operator is `fixed` or, if None, typed."""

    def build(operator: str, value: str) -> Condition:
        if fixed and operator != "=":
            raise ValueError("expected the operator =")
        return _compared(RUNS.c.created, fixed or operator, moment(value))

    return build


def moment(text: str) -> datetime:
    """Return an ISO 8601 time or day as UTC, without a zone. Raises `ValueError` for any other text."""
    try:
        when = datetime.fromisoformat(text)
        return when.astimezone(UTC).replace(tzinfo=None) if when.tzinfo else when
    except (ValueError, OverflowError):
        raise ValueError(
            "expected a date such as 2026-05-03, or a time such as 2026-05-03T12:00+02:00"
        ) from None


def _verdict(value: str) -> Condition:
    return _like(VERIFICATIONS.c.verdict, _VERDICTS.get(value, value))


def _instrument(value: str) -> Condition:
    own = select(INSTRUMENTS.c.id).where(
        or_(_like(INSTRUMENTS.c.name, value), _like(INSTRUMENTS.c.serial, value))
    )
    return USES.c.instrument.in_(own.correlate(None))


def _meter(value: str) -> Condition:
    return and_(USES.c.role.like("voltmeter%"), _instrument(value))


def _certificate(value: str) -> Condition:
    own = select(CERTIFICATES.c.id).where(_like(CERTIFICATES.c.number, value))
    return USES.c.certificate.in_(own.correlate(None))


def _issued(operator: str, value: str) -> Condition:
    own = select(ISSUED.c.id).where(ISSUED.c.head == RUNS.c.head).correlate(RUNS)
    held = ~exists(own) if value == NONE else exists(own.where(_like(ISSUED.c.number, value)))
    return _signed(operator, held)


def _effect(value: str) -> Condition:
    names = ", " + DIAGNOSES.c.names + ", "
    return _like(names, f"*, {value}, *")


def _calibrated(column: ColumnElement[Any]) -> Build:
    return _among(CALIBRATIONS, lambda value: _like(column, value))


KEYS: Final[Mapping[str, Key]] = {
    "unit": Key("the block: its serial number, or type and serial number", _text(RUNS.c.serial, RUNS.c.unit)),
    "type": Key("the block's type", _text(RUNS.c.unit_type)),
    "serial": Key("the block's serial number", _text(RUNS.c.serial)),
    "bench": Key("name in the bench file", _text(RUNS.c.bench)),
    "meter": Key("a voltmeter: its serial number, or all that names it", _among(USES, _meter)),
    "instrument": Key("any instrument, likewise", _among(USES, _instrument)),
    "certificate": Key("number of a certificate that the bench file states", _among(USES, _certificate)),
    "issued": Key("number of a certificate that this laboratory issued of its record", _issued),
    "operator": Key("who ran it", _text(RUNS.c.operator)),
    "procedure": Key("name of the procedure file", _text(RUNS.c.procedure)),
    "plan": Key("hash of the plan", _text(RUNS.c.plan_hash)),
    "name": Key("name of the run", _text(RUNS.c.name)),
    "path": Key("folder of the run", _text(RUNS.c.path)),
    "program": Key("version of the program that made the run", _text(RUNS.c.program_version)),
    "state": Key("state of the run: finished, aborted, imported …", _text(RUNS.c.state)),
    "record": Key("what is proved of its record: chain, read, broken, none", _text(RUNS.c.record)),
    "problem": Key("what is wrong with it", _text(RUNS.c.problem)),
    "simulated": Key("yes or no", _whether(RUNS.c.simulated)),
    "vanished": Key("whether its folder is gone: yes or no", _whether(RUNS.c.vanished)),
    "after": Key("begun on that day or later", _time(">=")),
    "before": Key("begun before that day", _time("<")),
    "created": Key("when it was begun", _time()),
    "verdict": Key("of its verification: pass, fail, conditional …", _among(VERIFICATIONS, _verdict)),
    "delta_g": Key(
        "largest Δg of its points, local g, with sign", _size(VERIFICATIONS.c.worst_delta_g, VERIFICATIONS)
    ),
    "model": Key("model of its calibration", _calibrated(CALIBRATIONS.c.model)),
    "estimator": Key("estimator of its calibration", _calibrated(CALIBRATIONS.c.estimator)),
    "p": Key("probability of its lack of fit", _size(CALIBRATIONS.c.p, CALIBRATIONS)),
    "sigma": Key("noise of a reading, in the unit of the signals", _size(CALIBRATIONS.c.sigma, CALIBRATIONS)),
    "diagnosis": Key(
        "agrees, mistake, named, confounded or unknown",
        _among(DIAGNOSES, lambda v: _like(DIAGNOSES.c.verdict, v)),
    ),
    "effect": Key("an effect that its diagnosis names", _among(DIAGNOSES, _effect)),
    "readings": Key("how many readings it has", _size(RUNS.c.readings)),
    "temperature": Key("mean of the readings, °C", _size(RUNS.c.temperature_c)),
}
"""The keys of questions, in the order in which help lists them."""


# --- answers ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AnswerTable:
    """An answer as a table: column names and rows, with None for values that were not recorded."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]

    def __len__(self) -> int:
        return len(self.rows)

    def mappings(self) -> list[dict[str, Any]]:
        """Return each row as a mapping from column to value; times are in ISO 8601, UTC."""
        return [dict(zip(self.columns, map(_in_json, row), strict=True)) for row in self.rows]

    def result(self, query: Sequence[str], of: str) -> AskResult:
        """Return the table as the result object of the question `query`; `of` is the kind of its rows."""
        return AskResult(query=list(query), of=of, count=len(self), rows=self.mappings())

    def write_csv(self, file: Path) -> None:
        """Write the table as CSV (RFC 4180); a text that a spreadsheet would run gets a leading apostrophe."""
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(self.columns)
        writer.writerows([_in_a_cell(value) for value in row] for row in self.rows)
        write_whole(file, text.getvalue())

    def write_parquet(self, file: Path) -> None:
        """Write the table as Parquet, times in UTC. Raises `OSError`."""
        import pyarrow
        from pyarrow import parquet

        table = pyarrow.table({name: [row[k] for row in self.rows] for k, name in enumerate(self.columns)})
        written = io.BytesIO()
        parquet.write_table(table, written)
        write_whole(file, written.getvalue())


def answer(catalogue: Catalogue, query: Sequence[str], of: str = "runs") -> AnswerTable:
    """Return the rows of kind `of` (in `KINDS`) for the runs that satisfy a question. Raises `Refused`."""
    if of not in KINDS:
        raise Refused(f"--of {of}: choose from {', '.join(KINDS)}")
    statement = KINDS[of](condition_of(query))
    with catalogue.reading() as connection:
        result = connection.execute(statement)
        found = AnswerTable(tuple(result.keys()), tuple(tuple(row) for row in result))
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


def _unpacked(found: AnswerTable) -> AnswerTable:
    """Return the table with each coefficient and each u in a column of its own."""
    size = len(COEFFICIENTS)
    rows = []
    for row in found.rows:
        values = np.frombuffer(row[-2], dtype="<f8")
        sizes = u_of(np.frombuffer(row[-1], dtype="<f8").reshape(size, size))
        # a coefficient that is zero by convention has no u
        rows.append((*row[:-2], *values.tolist(), *(size or None for size in sizes.tolist())))
    names = (*found.columns[:-2], *COEFFICIENTS, *(f"u_{name}" for name in COEFFICIENTS))
    return AnswerTable(names, tuple(rows))


def _counts() -> list[Any]:
    # a subquery on the few failed runs; a join with all verifications takes several times as long
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


def _used(
    table: Table, key: ColumnElement[Any], names: str, order: str, *further: Any
) -> Callable[[Condition], Select[Any]]:
    """Return the function that builds the query for what runs used (instruments, certificates).

    `table` has a row for each, `key` is its column in `USES`; `names` are the columns shown, sorted by `order`.
    `further` are counts in addition to those of runs and units.
    """
    columns = [table.c[name] for name in names.split()]

    def of(asked: Condition) -> Select[Any]:
        return (
            select(
                *columns,
                func.count(USES.c.run.distinct()).label("runs"),
                func.count(RUNS.c.unit.distinct()).label("units"),
                *further,
                func.min(RUNS.c.created).label("first"),
                func.max(RUNS.c.created).label("last"),
            )
            .select_from(USES.join(RUNS, RUNS.c.id == USES.c.run).join(table, table.c.id == key))
            .where(asked)
            .group_by(table.c.id, *columns)
            .order_by(*(table.c[name] for name in order.split()))
        )

    return of


def _issued_rows(asked: Condition) -> Select[Any]:
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
    "instruments": _used(
        INSTRUMENTS, USES.c.instrument, "name serial driver", "name",
        func.count(RUNS.c.bench.distinct()).label("benches"),
    ),
    "certificates": _used(
        CERTIFICATES, USES.c.certificate, "number laboratory date valid_until serial", "number date"
    ),
    "issued": _issued_rows,
    "folders": _folders,
}  # fmt: skip
"""The queries by kind of answer: runs, or objects that they have in common. `issued` are certificates that this
laboratory issued of their records; `folders` are folders with a problem."""


def _in_json(value: Any) -> Any:
    if isinstance(value, datetime):
        return f"{value.isoformat()}+00:00"
    return value.isoformat() if isinstance(value, date) else value


def _in_a_cell(value: Any) -> Any:
    told = _in_json(value)
    if isinstance(told, bool):
        return "yes" if told else "no"
    return f"'{told}" if isinstance(told, str) and told[:1] in ("=", "+", "-", "@", "\t", "\r") else told
