"""batch: the same work over many runs, restartable, by processes or a cluster; what changed, and which verdicts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from bench.base.computing import one_thread
from bench.cli import printing, progress
from bench.cli.catalogue import CatalogueOption
from bench.cli.options import (
    RUNS,
    BenchOption,
    CalibrateEstimatorOption,
    GravityOption,
    GuardBandOption,
    JoinFreeOption,
    JoinVerificationOption,
    JsonOption,
    LimitOption,
    ModelOption,
    NominalOption,
    PopulationOption,
    RuleOption,
    RunsOption,
    SkipOption,
    WithEstimators,
)

if TYPE_CHECKING:
    from bench.batch.job import Job
    from bench.batch.outcome import Outcome

GROUP: Final = typer.Typer(
    name="batch",
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Example: bench batch calibrate --over 'runs/*' --estimator robust --out recomputed",
    help="Compute many runs anew: what changes, which verdicts would be different; goes on where it stopped.",
)

OverOption = Annotated[
    list[str],
    typer.Option(
        "--over",
        metavar="QUERY|GLOB",
        help="Which runs: a pattern of paths ('runs/*'), or words of a query of the catalogue ('unit=Q-17'); "
        "may be given several times.",
    ),
]
FolderOption = Annotated[
    Path,
    typer.Option("--out", metavar="FOLDER", help="Folder of the batch; the same command goes on with it."),
]
WorkersOption = Annotated[
    int | None,
    typer.Option("--workers", metavar="N", min=1, help="Processes on this machine (default: one a core)."),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        help="Dask scheduler whose workers compute, in place of processes here: tcp://host:8786.",
    ),
]


@GROUP.command(
    cls=WithEstimators,
    epilog="Example: bench batch calibrate --over 'runs/*' --model found.yaml --out recomputed",
)
def calibrate(
    over: OverOption,
    out: FolderOption,
    estimator: CalibrateEstimatorOption = "gls",
    nominal_angles: NominalOption = False,
    join_free: JoinFreeOption = True,
    join_verification: JoinVerificationOption = False,
    limit: LimitOption = None,
    rule: RuleOption = None,
    guard_band: GuardBandOption = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    skip_bad_rows: SkipOption = False,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    catalogue: CatalogueOption = None,
    json: JsonOption = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="A fit that is judged otherwise is not accepted, either.")
    ] = False,
    runs: RunsOption = RUNS,
) -> int:
    """Coefficients and verdicts of many runs anew; exit status 1 where a verdict differs or a run failed."""
    one_thread()
    from bench.batch.job import CALIBRATE, Job

    job = Job(
        CALIBRATE, estimator, nominal_angles, join_free, join_verification, bench, _text(model), g, skip_bad_rows,
        limit, rule, guard_band, effects=_effects(),
    )  # fmt: skip
    outcome = _carried_out(job, over, out, workers, scheduler, catalogue, json, runs)
    return _status(outcome, "fit" if strict else None)


@GROUP.command(epilog="Example: bench batch diagnose --over 'runs/2026-*' --out diagnosed")
def diagnose(
    over: OverOption,
    out: FolderOption,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    skip_bad_rows: SkipOption = False,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    catalogue: CatalogueOption = None,
    json: JsonOption = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Other names under the same verdict are not accepted, either.")
    ] = False,
    runs: RunsOption = RUNS,
) -> int:
    """Diagnoses of many runs anew; exit status 1 where a verdict differs or a run failed."""
    one_thread()
    from bench.batch.job import DIAGNOSE, Job

    job = Job(
        DIAGNOSE, bench=bench, model=_text(model), g_m_s2=g, skip_bad_rows=skip_bad_rows, effects=_effects()
    )
    outcome = _carried_out(job, over, out, workers, scheduler, catalogue, json, runs)
    return _status(outcome, "names" if strict else None)


@GROUP.command(epilog="Example: bench batch report --over 'runs/*' --rule guarded --out pages")
def report(
    over: OverOption,
    out: FolderOption,
    limit: LimitOption = None,
    rule: RuleOption = None,
    guard_band: GuardBandOption = None,
    population: PopulationOption = None,
    bench: BenchOption = None,
    model: ModelOption = None,
    g: GravityOption = None,
    skip_bad_rows: SkipOption = False,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    catalogue: CatalogueOption = None,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Pages of many runs, in the folder of the batch; exit status 1 where a verdict differs or a run failed."""
    one_thread()
    from bench.batch.job import REPORT, Job
    from bench.batch.store import PAGES

    job = Job(
        REPORT, bench=bench, model=_text(model), g_m_s2=g, skip_bad_rows=skip_bad_rows, limit_g=limit, rule=rule,
        guard_band=guard_band, population=population, effects=_effects(), pages=str((out / PAGES).absolute()),
    )  # fmt: skip
    return _status(_carried_out(job, over, out, workers, scheduler, catalogue, json, runs), None)


@GROUP.command(epilog="Example: bench batch show recomputed")
def show(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of a batch.")],
    json: JsonOption = None,
) -> int:
    """What has come of a batch, as far as it is done; exit status as of the command that made it."""
    from bench.batch.outcome import conclude
    from bench.batch.store import Store

    printing.check_target(json)
    store = Store(folder)
    store.noted()
    with store:
        outcome = conclude(store)
    _told(outcome, json)
    return _status(outcome, None)


# --- the course -------------------------------------------------------------------------------------


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _effects() -> tuple[str, ...]:
    from bench.config.formulas import files_of_environment

    return tuple(files_of_environment())


def _carried_out(
    job: Job,
    over: list[str],
    out: Path,
    workers: int | None,
    scheduler: str | None,
    catalogue: str | None,
    json: str | None,
    runs: Path,
) -> Outcome | None:
    """Carry a batch out, or on; print what came of it. None where a Ctrl-C ended it before."""
    import duckdb  # noqa: F401 - it is there, before much is computed
    import pyarrow  # noqa: F401

    from bench.batch.outcome import conclude
    from bench.batch.store import Course, Store, list_runs

    printing.check_target(json)
    job = job.checked()
    listed = list_runs(over, runs, catalogue)
    printing.notes_aside(f"{place} is no run and holds none: left out" for place in listed.no_runs)
    with Store(out) as store:
        left = store.begin(job, over, listed.runs)
        printing.notes_aside(left.notes)
        try:
            if left.pending:
                with _shown():
                    Course(store, job.command).carry_out(
                        left, _by(job, workers, scheduler, len(left.pending))
                    )
        except KeyboardInterrupt:
            done = len(listed.runs) - len(store.begin(job, over, listed.runs).pending)
            printing.aside(
                f"bench: stopped by Ctrl-C; {done} of {len(listed.runs)} runs are done; the same command goes on"
            )
            return None
        outcome = conclude(store)
    _told(outcome, json)
    return outcome


def _by(job: Job, workers: int | None, scheduler: str | None, pending: int) -> Any:
    """Return what computes: the workers of a cluster, or as many processes as there are cores."""
    if scheduler is not None:
        from bench.batch.cluster import by_scheduler

        return lambda runs: by_scheduler(job, runs, scheduler)
    from bench.batch.processes import by_processes

    return lambda runs: by_processes(job, runs, min(workers or _cores(), pending))


def _cores() -> int:
    """Return how many cores this program may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _shown() -> Iterator[None]:
    """Show how far it is: a bar on a terminal, else a line from time to time."""
    with progress.shown(), progress.in_lines():
        yield


def _told(outcome: Outcome, json: str | None) -> None:
    from bench.cli.batch_outcome import print_outcome

    print_outcome(outcome, printing.console(json=json))
    printing.write_json([dict(outcome.summary)], json)


def _status(outcome: Outcome | None, strict: str | None) -> int:
    """Return 1 where a verdict differs, a run failed or, where asked, `strict` differs; 2 where it was stopped."""
    if outcome is None:
        return 2
    more = outcome.summary[strict]["different"] if strict else 0
    return 1 if outcome.different or outcome.failed or more else 0
