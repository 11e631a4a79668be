"""What the catalogue knows of one unit: its runs, its coefficients over time, when it is due."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from sqlalchemy import select

from bench.analysis.calibration.conformity import COVERAGE_FACTOR
from bench.analysis.calibration.result import CalibrationError
from bench.analysis.history.due import Due, due
from bench.api.errors import Refused
from bench.base.arrays import Mask, u_of
from bench.catalogue.answers import Answer, answer
from bench.catalogue.dues import INTERVAL_DAYS
from bench.catalogue.questions import condition_of
from bench.catalogue.schema import RUNS, VERIFICATIONS
from bench.catalogue.store import Catalogue
from bench.catalogue.values import CoefficientTable, coefficient_table
from bench.model.block import COEFFICIENTS

MOST_NAMED: Final = 8


@dataclass(frozen=True)
class UnitHistory:
    """A unit: its `runs`, the calibrations that are compared (`table`, per one g), when it is `due` or why not.

    `simulated` says that they are of simulated runs, of which there are none where there is a real one. `notes` are
    what a reader should know, a sentence each.
    """

    unit: str
    runs: Answer
    table: CoefficientTable
    simulated: bool
    due: Due | None
    why_not_due: str
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return it as `bench catalogue unit --json` writes it."""
        return {
            "unit": self.unit,
            "simulated": self.simulated,
            "due": None if self.due is None else self.due.to_json(),
            "why_not_due": self.why_not_due,
            "calibrations": in_json(self.table),
            "runs": self.runs.to_json(),
            "notes": list(self.notes),
        }


def in_json(table: CoefficientTable) -> list[dict[str, Any]]:
    """Return calibrations as `bench catalogue unit --json` writes them."""
    return [_calibration(table, k) for k in range(len(table))]


def _calibration(table: CoefficientTable, k: int) -> dict[str, Any]:
    sizes = u_of(table.covariance[k])
    return {
        "path": table.path[k],
        "created": f"{table.when[k].astype('datetime64[s]')}+00:00",
        "bench": table.bench[k],
        "unit": table.signal_unit[k],
        "g_m_s2": float(table.g_m_s2[k]),
        "coefficients": {
            name: {"value": float(value), "u": float(u), "U": float(COVERAGE_FACTOR * u)}
            for name, value, u in zip(COEFFICIENTS, table.vector[k], sizes, strict=True)
        },
    }


def unit_history(
    catalogue: Catalogue, unit: str, *, limit_g: float | None = None, interval_days: float | None = None
) -> UnitHistory:
    """Return what is known of a unit, named by its serial number or by type and serial number.

    `limit_g` is the error allowed, by default the limit of its last verification. Raises `Refused` where none, or
    several, are of that name.
    """
    name = _name_of(catalogue, unit)
    table, simulated, notes = compared_of(catalogue, name)
    query = [f"unit={name}"]
    limit = limit_g if limit_g is not None else limit_of(catalogue, query)
    found, why_not = due_of(table, limit, interval_days or INTERVAL_DAYS, simulated=simulated)
    runs = answer(catalogue, query)
    return UnitHistory(name, runs, table, simulated, found, why_not, tuple(notes))


def unit_calibrations(catalogue: Catalogue, unit: str) -> CoefficientTable:
    """Return the calibrations of a unit that are compared, as in its history: what its figure needs.

    Raises `Refused` where none, or several, are of that name.
    """
    return compared_of(catalogue, _name_of(catalogue, unit))[0]


def compared_of(catalogue: Catalogue, name: str) -> tuple[CoefficientTable, bool, list[str]]:
    """Return the calibrations of a unit (type and serial number), whether they are simulated, and what to know."""
    table = coefficient_table(catalogue, [f"unit={name}"])
    notes = [f"without {words}" for words in table.left_out]
    return *_compared(table, notes), notes


def _name_of(catalogue: Catalogue, unit: str) -> str:
    if "*" in unit:
        raise Refused(f"{unit}: name one unit; 'bench catalogue ask unit={unit} --of units' lists them")
    asked = select(RUNS.c.unit).distinct().where(condition_of([f"unit={unit}"])).order_by(RUNS.c.unit)
    with catalogue.reading() as connection:
        names = [str(name) for name in connection.execute(asked).scalars()]
    if not names:
        raise Refused(
            f"{unit}: the catalogue has no such unit; 'bench catalogue ask --of units' lists those it has"
        )
    if len(names) > 1:
        listed = ", ".join(f"'{name}'" for name in names[:MOST_NAMED])
        raise Refused(f"{unit}: this is the serial number of several units: {listed}; name one with its type")
    return names[0]


def _compared(table: CoefficientTable, notes: list[str]) -> tuple[CoefficientTable, bool]:
    """Return those calibrations that can be compared, per the g of the last, and whether they are simulated."""
    dated = ~np.isnat(table.when)
    if not np.all(dated):
        notes.append(f"without {np.sum(~dated)} calibrations that have no date")
    kept = _rows(table, dated)
    simulated = bool(len(kept)) and bool(np.all(kept.simulated))
    if not simulated and np.any(kept.simulated):
        notes.append(f"without {np.sum(kept.simulated)} calibrations of simulated runs")
        kept = _rows(kept, ~kept.simulated)
    if len(kept):
        same = np.array([one == kept.signal_unit[-1] for one in kept.signal_unit], dtype=np.bool_)
        if not np.all(same):
            notes.append(f"without {np.sum(~same)} calibrations of signals in another unit")
            kept = _rows(kept, same)
        kept = _per_g(kept, float(kept.g_m_s2[-1]))
    return kept, simulated


def _rows(table: CoefficientTable, mask: Mask) -> CoefficientTable:
    arrays: Mapping[str, Any] = {
        name: value[mask] for name, value in vars(table).items() if isinstance(value, np.ndarray)
    }
    return replace(table, **arrays)


def _per_g(table: CoefficientTable, g_m_s2: float) -> CoefficientTable:
    """Return scale factors per another local gravity: the same per m/s²."""
    factor = np.where(np.arange(len(COEFFICIENTS)) < 9, g_m_s2 / table.g_m_s2[:, None], 1.0)
    return replace(
        table,
        g_m_s2=np.full(len(table), g_m_s2),
        vector=table.vector * factor,
        covariance=table.covariance * factor[:, :, None] * factor[:, None, :],
        u_meters=table.u_meters * factor,
    )


def limit_of(catalogue: Catalogue, query: list[str]) -> float | None:
    """Return the limit of the last verification of a question, local g; None where none states one."""
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
    """Return when a unit of these calibrations is due, or None and why nobody knows."""
    if not len(table):
        return None, "no calibration that can be believed has a date"
    if limit_g is None:
        return None, "no verification states a limit: say --limit"
    meters = None if np.any(np.isnan(table.u_meters)) else table.u_meters
    try:
        found = due(
            table.when, table.vector, table.covariance, limit_g, interval_days, meters, simulated=simulated
        )
    except CalibrationError as error:
        return None, str(error)
    return found, ""
