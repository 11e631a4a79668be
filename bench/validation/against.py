"""Past runs computed again, each with the estimator of its stored result, to find changes above 0.1 u."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from bench.base.computing import CalibrationError
from bench.batch.job import job_of
from bench.batch.outcome import asked_of, carried_out
from bench.batch.store import list_runs
from bench.batch.work import stored_calibration
from bench.calibration.estimators import GLS, find_estimator
from bench.results.validation import AgainstPart, ChangedRun
from bench.services.requests.documents import BatchCalibrate, Validate
from bench.services.requests.shared import runs_folder

THRESHOLD_U: Final = 0.1
"""Largest change of a coefficient, in its u, that is not listed."""


def past_runs(request: Validate, over: str) -> list[str]:
    """Return the runs that `over` names: a path pattern or a query of the catalogue.

    Raises `Refused` if there are none.
    """
    return list(list_runs([over], runs_folder(request.runs), request.catalogue, "--against").runs)


def against(request: Validate, over: str, folder: Path) -> AgainstPart:
    """Recompute the runs that `over` names (see `past_runs`) into a folder.

    A run without a stored result is computed with the default estimator, and not compared. Raises `Refused`
    if no run is found.
    """
    by_estimator: dict[str, list[str]] = {}
    for run in past_runs(request, over):
        stored = stored_calibration(Path(run)).calibration
        by_estimator.setdefault(_known(GLS if stored is None else stored.estimator), []).append(run)
    rows: list[dict[str, Any]] = []
    for estimator, runs in by_estimator.items():
        rows += _rows(BatchCalibrate(over=runs, out=folder / estimator, estimator=estimator))
    compared = [row for row in rows if row["estimator_stored"] is not None and row["failed"] is None]
    return AgainstPart(
        over=[over],
        runs=len(rows),
        compared=len(compared),
        threshold_u=THRESHOLD_U,
        changed=[_changed(row) for row in compared if _differs(row)],
        failed={row["run"]: row["failed"] for row in rows if row["failed"] is not None},
    )


def _known(estimator: str) -> str:
    try:
        return find_estimator(estimator).name
    except CalibrationError:
        return GLS  # an estimator that is not installed here: the default estimator replaces it


def _rows(request: BatchCalibrate) -> Iterator[dict[str, Any]]:
    job_of(request).checked()
    carried_out(request, lambda notes: None)
    with asked_of(request.out) as ask:
        found = ask.execute(
            "SELECT run, failed, estimator_stored, largest_change_in_u, largest_change_of, verdict_stored, "
            "verdict, verdict_differs FROM changes ORDER BY run"
        )
        names = [column[0] for column in found.description]
        yield from (dict(zip(names, row, strict=True)) for row in found.fetchall())


def _differs(row: dict[str, Any]) -> bool:
    """Return whether a result changed by more than the threshold, has another verdict, or cannot be compared."""
    change = row["largest_change_in_u"]
    return change is None or change > THRESHOLD_U or bool(row["verdict_differs"])


def _changed(row: dict[str, Any]) -> ChangedRun:
    change = row["largest_change_in_u"]
    return ChangedRun(
        run=row["run"],
        largest_change_in_u=-1.0 if change is None or math.isnan(change) else change,
        largest_change_of=row["largest_change_of"] or "unknown",
        verdict_stored=row["verdict_stored"],
        verdict=row["verdict"],
    )
