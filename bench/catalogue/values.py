"""Coefficients of many calibrations, read from the catalogue as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import and_, func, select

from bench.base.arrays import Floats, Mask
from bench.base.languages import message
from bench.calibration.result import CalibrationError
from bench.catalogue.questions import condition_of
from bench.catalogue.store import CALIBRATIONS, RUNS, Catalogue
from bench.history.comparison import Snapshot
from bench.history.equivalence import BenchComparison, compare_benches
from bench.history.measured import STANDARD_GRAVITY, ComparedCalibrations, coded, of_gravity, to_gravity
from bench.model.geometry import COEFFICIENTS
from bench.run.folder import CALIBRATE_FILE
from bench.services.coefficients import snapshots_in
from bench.services.errors import Refused

Texts = NDArray[np.object_]
"""Array of texts, with None for those not recorded."""

COUNT: Final = len(COEFFICIENTS)


@dataclass(frozen=True)
class CoefficientTable:
    """The calibrations that a question selects, oldest first; those without a date come first.

    `path`, `unit`, `unit_type`, `bench`, `signal_unit` (n,) are texts, None if not recorded; `when` (n,) is
    datetime64 in UTC, NaT if not recorded. `vector` (n, 12) are the coefficients: scale factors in `signal_unit`
    per g, biases in `signal_unit`. This g is `g_m_s2` (n,), with the relative standard uncertainty `gravity_u`
    (n,). `covariance` (n, 12, 12) is the combined covariance without the part from `gravity_u`. `u_meters` (n, 12)
    is the part of u that recurs with the same meters, NaN if not stated. `simulated` (n,) is False only for runs
    recorded as real. The sentences in `left_out` say which selected runs are omitted.
    """

    path: Texts
    unit: Texts
    unit_type: Texts
    bench: Texts
    when: NDArray[np.datetime64]
    vector: Floats
    covariance: Floats
    u_meters: Floats
    g_m_s2: Floats
    gravity_u: Floats
    signal_unit: Texts
    simulated: NDArray[np.bool_]
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.path)

    def of(self, mask: Mask) -> CoefficientTable:
        """Return the calibrations that a mask (n,) selects."""
        arrays = {name: value[mask] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **arrays)  # type: ignore[arg-type]

    def per(self, g_m_s2: float, gravity_u: float) -> CoefficientTable:
        """Return the calibrations with scale factors in unit/g, where 1 g is `g_m_s2` (m/s²).

        `gravity_u` is the relative standard uncertainty of `g_m_s2`. If a calibration refers to another g, its new
        covariance includes the uncertainties of both values of g.
        """
        both = np.where(self.g_m_s2 == g_m_s2, 0.0, np.hypot(self.gravity_u, gravity_u))
        return self._elsewhere(g_m_s2, gravity_u, both)

    def per_standard_g(self) -> CoefficientTable:
        """Return the calibrations with scale factors in unit/g for standard g, which has no uncertainty."""
        return self._elsewhere(STANDARD_GRAVITY, 0.0, self.gravity_u)

    def _elsewhere(self, g_m_s2: float, gravity_u: float, both: Floats) -> CoefficientTable:
        factor = to_gravity(self.g_m_s2, g_m_s2)
        of_g = of_gravity(self.vector * factor, both)
        return replace(
            self,
            g_m_s2=np.full(len(self), g_m_s2),
            gravity_u=np.full(len(self), gravity_u),
            vector=self.vector * factor,
            covariance=self.covariance * factor[:, :, None] * factor[:, None, :]
            + of_g[:, :, None] * of_g[:, None, :],
            u_meters=self.u_meters * factor,
        )


def coefficient_table(catalogue: Catalogue, query: Sequence[str]) -> CoefficientTable:
    """Return the calibrations of the runs that a question selects.

    Runs without a calibration are omitted, and so are vanished folders, damaged records, and results of
    another record; `left_out` counts them. Raises `Refused` for an invalid question.
    """
    asked = condition_of(query)
    believed = and_(
        ~RUNS.c.vanished, RUNS.c.record != "broken", func.coalesce(CALIBRATIONS.c.of_record, True)
    )
    columns = (
        RUNS.c.path, RUNS.c.unit, RUNS.c.unit_type, RUNS.c.bench, RUNS.c.created, RUNS.c.simulated,
        CALIBRATIONS.c.vector, CALIBRATIONS.c.covariance, CALIBRATIONS.c.u_meters, CALIBRATIONS.c.g_m_s2,
        CALIBRATIONS.c.gravity_u, CALIBRATIONS.c.unit.label("signal_unit"),
    )  # fmt: skip
    joined = RUNS.join(CALIBRATIONS, CALIBRATIONS.c.run == RUNS.c.id)
    rows = select(*columns).select_from(joined).where(asked, believed)
    ordered = rows.order_by(RUNS.c.created.is_not(None), RUNS.c.created, RUNS.c.path)
    with catalogue.reading() as connection:
        found = connection.execute(ordered).all()
        left_out = tuple(_left_out(connection, asked))
    n = len(found)
    vector = np.frombuffer(b"".join(row.vector for row in found), dtype="<f8").reshape(n, COUNT)
    covariance = np.frombuffer(b"".join(row.covariance for row in found), dtype="<f8")
    unknown = np.full(COUNT, np.nan).tobytes()
    meters = b"".join(row.u_meters or unknown for row in found)
    return CoefficientTable(
        path=_texts(row.path for row in found),
        unit=_texts(row.unit for row in found),
        unit_type=_texts(row.unit_type for row in found),
        bench=_texts(row.bench for row in found),
        when=np.array([row.created or "NaT" for row in found], dtype="datetime64[us]"),
        vector=vector,
        covariance=covariance.reshape(n, COUNT, COUNT),
        u_meters=np.frombuffer(meters, dtype="<f8").reshape(n, COUNT),
        g_m_s2=np.array([row.g_m_s2 for row in found], dtype=np.float64),
        gravity_u=np.array([row.gravity_u or 0.0 for row in found], dtype=np.float64),
        signal_unit=_texts(row.signal_unit for row in found),
        simulated=np.array([row.simulated is not False for row in found], dtype=np.bool_),
        left_out=left_out,
    )


def _texts(values: Any) -> Texts:
    listed = list(values)
    made = np.empty(len(listed), dtype=object)
    made[:] = listed
    return made


def _left_out(connection: Any, asked: Any) -> list[str]:
    """Return sentences that state how many runs of a question are left out, and why."""
    joined = RUNS.outerjoin(CALIBRATIONS, CALIBRATIONS.c.run == RUNS.c.id)
    gone = RUNS.c.vanished
    broken = and_(~gone, RUNS.c.record == "broken")
    other = and_(~gone, RUNS.c.record != "broken", CALIBRATIONS.c.of_record.is_(False))
    bare = and_(~gone, RUNS.c.record != "broken", CALIBRATIONS.c.run.is_(None))
    sentences = []
    for condition, why in (
        (gone, message("of folders that are gone")),
        (broken, message("whose record is broken")),
        (other, message("whose calibration is older than the record; run 'bench calibrate'")),
        (bare, message("without a calibration")),
    ):
        counted = select(func.count()).select_from(joined).where(asked, condition)
        if count := connection.execute(counted).scalar():
            sentences.append(message(f"{count} run{'' if count == 1 else 's'} {why}"))
    return sentences


MOST_COMPARED: Final = 400
"""Largest number of calibrations compared: beyond it their joint covariance would be too large."""


def measured_of(table: CoefficientTable) -> tuple[ComparedCalibrations, Mask, tuple[str, ...]]:
    """Return the comparable calibrations of a table, the mask (n,) that selects them, and notes on the others.

    A calibration is comparable if unit, bench and date are known and its readings determined all
    coefficients. Raises `Refused` if none is comparable, if simulated and real ones are mixed, or if signal
    units differ.
    """
    known = np.ones(len(table), dtype=bool)
    notes = list(table.left_out)
    for what, there in (
        ("unit", np.array([bool(u) for u in table.unit], dtype=bool)),
        ("bench", np.array([bool(b) for b in table.bench], dtype=bool)),
        ("date", ~np.isnat(table.when)),
        ("covariance of all twelve", _regular(table)),
    ):
        lost = int(np.sum(known & ~there))
        if lost:
            notes.append(f"{lost} calibration{'s' * (lost > 1)} without a {what} left out")
        known &= there
    if not known.any():
        told = f" ({'; '.join(notes)})" if notes else ""
        raise Refused(
            f"no calibration of a known unit on a known bench matches{told}; calibrate more runs, or change the "
            "conditions"
        )
    taken = table.of(known)
    kept = taken.per_standard_g()
    simulated = kept.simulated
    if simulated.any() and not simulated.all():
        raise Refused(
            f"{int(simulated.sum())} of {len(simulated)} calibrations are simulated, the others real; add "
            "simulated=yes or simulated=no"
        )
    signals = sorted(set(kept.signal_unit.tolist()))
    if len(signals) > 1:
        raise Refused(
            f"signals in {', '.join(signals)} cannot be compared; narrow the conditions to units with "
            "one kind of signal (type=…)"
        )
    if np.isnan(kept.u_meters).any():
        notes.append(
            "some results do not state the part of u that their meters share; it counts as independent"
        )
    if simulated.all():
        notes.append(message("all of these were found on simulated instruments"))
    measured = ComparedCalibrations(
        unit=np.array(kept.unit, dtype=str),
        kind=np.array([kind or "" for kind in kept.unit_type], dtype=str),
        bench=np.array(kept.bench, dtype=str),
        when=kept.when,
        vector=kept.vector,
        covariance=kept.covariance,
        meters=np.nan_to_num(kept.u_meters),
        gravity=of_gravity(kept.vector, taken.gravity_u),
        place=taken.g_m_s2,
        signal=signals[0],
        simulated=bool(simulated.all()),
    )
    return measured, known, tuple(notes)


def _regular(table: CoefficientTable) -> Mask:
    """Return the mask (n,) of the calibrations whose readings determined all twelve coefficients."""
    variance = np.diagonal(table.covariance, axis1=1, axis2=2)
    return np.asarray(np.all(variance > 0, axis=1) & np.all(np.isfinite(variance), axis=1))


def compared(table: CoefficientTable, method: str | None = None) -> BenchComparison:
    """Compare benches by the units that at least two of them measured.

    `method` is the method of each reference value (`bench.history.equivalence.METHODS`). Calibrations share
    errors if they used the same meters or measured the same block (K2, K3); these are read from the results
    in the run folders. Raises `CalibrationError` if no unit joins two benches, `Refused` for more than
    `MOST_COMPARED` calibrations, and the errors of `measured_of`.
    """
    measured, known, notes = measured_of(table)
    paths = table.path[known]
    (units, unit), (benches, bench) = coded(measured.unit), coded(measured.bench)
    several = np.array([len(set(bench[unit == k].tolist())) > 1 for k in range(len(units))])
    rows = np.flatnonzero(several[unit])
    if not len(rows):
        raise CalibrationError(
            f"none of {len(units)} units was measured on two of {len(benches)} benches; widen the question"
        )
    if len(rows) > MOST_COMPARED:
        raise Refused(
            f"{len(rows)} calibrations join the benches, but at most {MOST_COMPARED} can be compared with their "
            "whole covariance; narrow the question (after=2026-01-01), or use 'bench fleet effects'"
        )
    there = [
        _snapshot(Path(path), block).per_standard_g()
        for path, block in zip(paths[rows], measured.unit[rows], strict=True)
    ]
    found = compare_benches(measured.of(rows), there, method)
    alone = tuple(sorted(set(benches.tolist()) - set(found.benches)))
    return replace(found, alone=alone, notes=(*notes, *found.notes))


def _snapshot(folder: Path, block: str) -> Snapshot:
    found = snapshots_in(folder / CALIBRATE_FILE)
    if len(found) != 1:
        raise Refused(
            f"{folder / CALIBRATE_FILE}: the file has {len(found)} results instead of one; write it "
            "again with 'bench calibrate'"
        )
    return replace(found[0], block=block)
