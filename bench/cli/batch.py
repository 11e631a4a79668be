"""batch: evaluate many runs again, in restartable batches by processes or a cluster; list changed results."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bench.base.computing import one_thread
from bench.cli import printing
from bench.cli.options import JsonOption, command, group
from bench.services.requests.documents import Batch, BatchCalibrate, BatchDiagnose, BatchReport

if TYPE_CHECKING:
    from bench.results.batch import BatchResult

GROUP: Final = group("batch", "bench batch calibrate --over 'runs/*' --estimator robust --out recomputed")


@command("bench batch calibrate --over 'runs/*' --model found.yaml --out recomputed", to=GROUP)
def calibrate(request: BatchCalibrate, json: JsonOption = None) -> int:
    """Recompute coefficients and verdicts; exit status 1 if a verdict changes or a run fails."""
    return 0 if _carried_out(request, json).accepted(strict=request.strict) else 1


@command("bench batch diagnose --over 'runs/2026-*' --out diagnosed", to=GROUP)
def diagnose(request: BatchDiagnose, json: JsonOption = None) -> int:
    """Recompute diagnoses; exit status 1 if a verdict changes or a run fails."""
    return 0 if _carried_out(request, json).accepted(strict=request.strict) else 1


@command("bench batch report --over 'runs/*' --rule guarded --out pages", to=GROUP)
def report(request: BatchReport, json: JsonOption = None) -> int:
    """Write reports into the folder of the batch; exit status 1 if a verdict changes or a run fails."""
    return 0 if _carried_out(request, json).accepted() else 1


@command("bench batch show recomputed", to=GROUP)
def show(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of a batch.")],
    json: JsonOption = None,
) -> int:
    """Show the results of a batch so far; exit status as for the command that made it."""
    from bench.batch.outcome import outcome_in

    return 0 if _told(outcome_in(folder), folder, json).accepted() else 1


def _carried_out(request: Batch, json: str | None) -> BatchResult:
    """Carry out or continue a batch; print and return its result.

    Progress is shown as a bar, or as lines for a log if standard error is not a terminal.
    """
    one_thread()
    import duckdb  # noqa: F401 - fail now if it is missing
    import pyarrow  # noqa: F401

    from bench.batch.outcome import carried_out

    with printing.progress(), printing.in_lines():
        result = carried_out(request, printing.notes_aside)
    return _told(result, request.out, json)


def _told(result: BatchResult, folder: Path, json: str | None) -> BatchResult:
    printing.told(result, json, partial(result.print_on, folder=folder))
    return result
