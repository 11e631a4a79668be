"""Questions to the catalogue in words: `unit=17-042 meter=MY53200001 after=2026-05-03 simulated=no`.

A question is words KEY=VALUE, all of which have to hold; `!=` is all else, unknown included. Sizes and times take
`<`, `<=`, `>` and `>=`, too. In a value `*` stands for any text; the value `none` is what nobody recorded.
`after=2026-05-03` is from the beginning of that day (UTC) on, `before=` until its beginning. Values go into
statements as parameters, never as text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from sqlalchemy import ColumnElement, Table, and_, exists, func, not_, or_, select, true

from bench.base.numbers import read_number
from bench.catalogue.schema import (
    CALIBRATIONS,
    CERTIFICATES,
    DIAGNOSES,
    INSTRUMENTS,
    ISSUED,
    RUNS,
    USES,
    VERIFICATIONS,
)
from bench.catalogue.store import Catalogue
from bench.services.errors import Refused

Condition = ColumnElement[bool]
Build = Callable[[str, str], Condition]
"""Makes a condition of an operator and a value. Raises `ValueError` that says what was expected."""

NONE: Final = "none"
_WORD: Final = re.compile(r"([a-z_]+)(!=|>=|<=|=|>|<)(.*)", re.DOTALL)
_YES_NO: Final[Mapping[str, bool]] = {"yes": True, "no": False}
_VERDICTS: Final[Mapping[str, str]] = {"passed": "pass", "failed": "fail"}


@dataclass(frozen=True)
class Key:
    """A key of questions: what it means, in words, and how it becomes a condition."""

    meaning: str
    build: Build


def condition_of(query: Sequence[str]) -> Condition:
    """Return the condition on `RUNS` of a question. Raises `Refused` with every word that is none."""
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
    """Return the folders of the runs that a question names, oldest first, without those that are gone.

    Raises `Refused` for a question that is none.
    """
    asked = select(RUNS.c.path).where(condition_of(query), ~RUNS.c.vanished)
    with catalogue.reading() as connection:
        paths = connection.execute(asked.order_by(RUNS.c.created, RUNS.c.path)).scalars()
        return [Path(path) for path in paths]


# --- conditions -------------------------------------------------------------------------------------


def _like(column: ColumnElement[Any], value: str) -> Condition:
    """Return whether a text is `value`, where `*` stands for any text."""
    if value == NONE:
        return column.is_(None)
    if "*" not in value:
        return column == value
    escaped = value.replace("\\", "\\\\").replace("%", "\\%").replace("_", "\\_").replace("*", "%")
    return column.like(escaped, escape="\\")


def _signed(operator: str, condition: Condition) -> Condition:
    """Return a condition, or that it does not hold. Raises `ValueError` for an operator of sizes."""
    if operator == "=":
        return condition
    if operator == "!=":
        return not_(func.coalesce(condition, False))
    raise ValueError("expected = or !=")


def _text(*columns: ColumnElement[Any]) -> Build:
    """Make a key of texts: any of the columns is the value."""

    def build(operator: str, value: str) -> Condition:
        return _signed(operator, or_(*(_like(column, value) for column in columns)))

    return build


def _among(table: Table, condition: Callable[[str], Condition]) -> Build:
    """Make a key of what belongs to a run in another table: some row of its satisfies the condition."""

    def build(operator: str, value: str) -> Condition:
        wanted = ~_row_of(table) if value == NONE else _row_of(table, condition(value))
        return _signed(operator, wanted)

    return build


def _row_of(table: Table, *conditions: Condition) -> Condition:
    """Return whether a run has a row in a table that satisfies conditions."""
    if conditions:  # by the index of what is asked for, and not run by run
        return RUNS.c.id.in_(select(table.c.run).where(*conditions).correlate(None))
    return exists(select(table.c.run).where(table.c.run == RUNS.c.id).correlate(RUNS))


def _size(column: ColumnElement[Any], table: Table | None = None) -> Build:
    """Make a key of sizes, in the unit that the column has."""

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
    compared: dict[str, Condition] = {
        "=": column == value,
        "!=": column != value,
        "<": column < value,
        "<=": column <= value,
        ">": column > value,
        ">=": column >= value,
    }
    return compared[operator]


def _whether(column: ColumnElement[Any]) -> Build:
    def build(operator: str, value: str) -> Condition:
        if value == NONE:
            return _signed(operator, column.is_(None))
        if value not in _YES_NO:
            raise ValueError("expected yes, no or none")
        return _signed(operator, column.is_(_YES_NO[value]))

    return build


def _time(fixed: str | None = None) -> Build:
    """Make a key of the time at which a run began."""

    def build(operator: str, value: str) -> Condition:
        if fixed and operator != "=":
            raise ValueError("expected =")
        return _compared(RUNS.c.created, fixed or operator, moment(value))

    return build


def moment(text: str) -> datetime:
    """Return a day (its beginning, UTC) or a time as UTC without zone. Raises `ValueError`."""
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(
            "expected a day such as 2026-05-03, or a time such as 2026-05-03T12:00+02:00"
        ) from None
    return when.astimezone(UTC).replace(tzinfo=None) if when.tzinfo else when


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
    "state": Key("what became of the run: finished, aborted, imported …", _text(RUNS.c.state)),
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
"""What may be asked for, in the order in which it is told."""


def keys_in_words() -> Iterator[tuple[str, str]]:
    """Yield each key with what it means."""
    for name, key in KEYS.items():
        yield name, key.meaning
