"""Coefficients out of the catalogue as arrays, for whoever reckons with many calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import and_, func, select

from bench.base.arrays import Floats
from bench.catalogue.questions import condition_of
from bench.catalogue.schema import CALIBRATIONS, RUNS
from bench.catalogue.store import Catalogue
from bench.model.block import COEFFICIENTS

Texts = NDArray[np.object_]
"""Texts, None where nothing was recorded."""

COUNT: Final = len(COEFFICIENTS)


@dataclass(frozen=True)
class CoefficientTable:
    """Calibrations of a question, oldest first; those without a date come first.

    `path`, `unit`, `unit_type`, `bench`, `signal_unit` (n,) are texts, None where nothing was recorded; `when` (n,)
    datetime64 in UTC, NaT likewise. `vector` (n, 12) are the coefficients in `signal_unit` per g = `g_m_s2` (n,),
    biases in `signal_unit`; `covariance` (n, 12, 12) is the combined one, `u_meters` (n, 12) the part of u that the
    same meters bring again, NaN where a result does not tell it; `sigma` (n,) the noise of a reading. `simulated`
    (n,) is True where it was, or where nobody recorded it. `left_out` says, in sentences, what of the question is
    not here.
    """

    path: Texts
    unit: Texts
    unit_type: Texts
    bench: Texts
    when: NDArray[np.datetime64]
    vector: Floats
    covariance: Floats
    u_meters: Floats
    sigma: Floats
    g_m_s2: Floats
    signal_unit: Texts
    simulated: NDArray[np.bool_]
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.path)


def coefficient_table(catalogue: Catalogue, query: Sequence[str]) -> CoefficientTable:
    """Return the calibrations of the runs that a question names.

    Left out, and told, are those of folders that are gone, of records that cannot be believed, and results that are
    not of the record as it is now. Raises `Refused` for a question that is none.
    """
    asked = condition_of(query)
    believed = and_(
        ~RUNS.c.vanished, RUNS.c.record != "broken", func.coalesce(CALIBRATIONS.c.of_record, True)
    )
    columns = (
        RUNS.c.path, RUNS.c.unit, RUNS.c.unit_type, RUNS.c.bench, RUNS.c.created, RUNS.c.simulated,
        CALIBRATIONS.c.vector, CALIBRATIONS.c.covariance, CALIBRATIONS.c.u_meters, CALIBRATIONS.c.sigma,
        CALIBRATIONS.c.g_m_s2, CALIBRATIONS.c.unit.label("signal_unit"),
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
        sigma=np.array([np.nan if row.sigma is None else row.sigma for row in found], dtype=np.float64),
        g_m_s2=np.array([row.g_m_s2 for row in found], dtype=np.float64),
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
    """Say how many runs of a question have no coefficients here, and why."""
    joined = RUNS.outerjoin(CALIBRATIONS, CALIBRATIONS.c.run == RUNS.c.id)
    gone = RUNS.c.vanished
    broken = and_(~gone, RUNS.c.record == "broken")
    other = and_(~gone, RUNS.c.record != "broken", CALIBRATIONS.c.of_record.is_(False))
    bare = and_(~gone, RUNS.c.record != "broken", CALIBRATIONS.c.run.is_(None))
    sentences = []
    for condition, why in (
        (gone, "of folders that are gone"),
        (broken, "whose record is broken"),
        (other, "whose calibration is not of the record as it is now: bench calibrate"),
        (bare, "without a calibration"),
    ):
        counted = select(func.count()).select_from(joined).where(asked, condition)
        if count := connection.execute(counted).scalar():
            sentences.append(f"{count} run{'s' * (count > 1)} {why}")
    return sentences
