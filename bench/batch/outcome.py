"""The outcome of a batch: the whole table, changed verdicts, and shifts of coefficients."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from bench.base.files import to_text, write_whole
from bench.batch import processes
from bench.batch.job import COLUMNS, DIAGNOSE, NOT_IN_TEXT, Job, job_of
from bench.batch.store import PARTS, RUNS, Computed, PartWriter, Store, list_runs
from bench.results.batch import BatchResult
from bench.services.errors import Refused
from bench.services.requests.documents import Batch
from bench.services.requests.shared import runs_folder

TABLE: Final = "changes"
DIFFERENT: Final = "verdicts.csv"
FAILED: Final = "failed.csv"
SUMMARY: Final = "summary.json"
LISTED: Final = 1000
"""Largest number of runs that the summary lists; the tables contain all runs."""
_MEMORY: Final = "512MB"
_PARTS_OF_THE_LISTED: Final = (
    "CREATE VIEW changes AS SELECT parts.* FROM read_parquet($parts) AS parts "
    "JOIN read_parquet($runs) AS listed ON parts.run = listed.run AND parts.fingerprint = listed.fingerprint"
)


def carried_out(request: Batch, tell: Callable[[Iterable[str]], None]) -> BatchResult:
    """Compute the pending runs of a batch; return the result for all its runs. `tell` receives notes.

    Raises `Refused` for options that no run can use, for a folder with another batch, and after Ctrl-C.
    """
    job = job_of(request).checked()
    listed = list_runs(request.over, runs_folder(request.runs), request.catalogue)
    tell(f"{place} is not a run and contains none: left out" for place in listed.no_runs)
    with Store(request.out) as store:
        left = store.begin(job, request.over, listed.runs)
        tell(left.notes)
        try:
            if left.pending:
                computed = _computing(job, request, len(left.pending))
                PartWriter(store, job.command).carry_out(left, computed)
        except KeyboardInterrupt:
            done = len(listed.runs) - len(store.begin(job, request.over, listed.runs).pending)
            raise Refused(
                f"stopped by Ctrl-C; {done} of {len(listed.runs)} runs are done; repeat the command to continue"
            ) from None
        return conclude(store)


def _computing(job: Job, request: Batch, pending: int) -> Computed:
    """Return the function that computes rows: with the workers of a cluster, or with local processes."""
    address = request.scheduler
    if address is not None:
        return lambda runs: processes.by_scheduler(job, runs, address)
    workers = min(request.workers or _cores(), pending)
    return lambda runs: processes.by_processes(job, runs, workers)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def outcome_in(folder: Path) -> BatchResult:
    """Write and return the result so far of the batch in a folder. Raises `Refused` if there is no batch."""
    store = Store(folder)
    store.noted()
    with store:
        return conclude(store)


def conclude(store: Store) -> BatchResult:
    """Write the tables and the summary of the runs done so far; return the result. Raises `OSError`."""
    noted = store.noted()
    with asked_of(store.folder) as ask:
        _write_tables(ask, store.folder, noted["command"])
        result = _result(ask, store.folder, noted)
    write_whole(store.folder / SUMMARY, to_text(result.to_dict()))
    return result


Ask = Any
"""A DuckDB connection with the view `changes`: one row for each listed run that is done."""


@contextmanager
def asked_of(folder: Path) -> Iterator[Ask]:
    """Yield a DuckDB connection; its view `changes` has the rows so far. Large queries use the disk."""
    import duckdb

    with duckdb.connect(":memory:", config={"memory_limit": _MEMORY, "threads": 1}) as ask:
        parts, runs = _literal(folder / PARTS / "part-*.parquet"), _literal(folder / RUNS)
        ask.execute(_PARTS_OF_THE_LISTED.replace("$parts", parts).replace("$runs", runs))
        yield ask


def _literal(path: Path) -> str:
    """Return a path as an SQL text literal, because a view takes no parameters."""
    return "'" + str(path).replace("'", "''") + "'"


def _write_tables(ask: Ask, folder: Path, command: str) -> None:
    left_out = [name for name in NOT_IN_TEXT if name in COLUMNS[command]]
    text = f"SELECT * EXCLUDE ({', '.join(left_out)}) FROM changes"  # noqa: S608 - our own names
    differs = "verdict_differs" if command != DIAGNOSE else "(verdict_differs OR names_differ)"
    for name, question in {
        f"{TABLE}.parquet": "SELECT * FROM changes ORDER BY run",
        f"{TABLE}.csv": f"{text} ORDER BY run",
        DIFFERENT: f"{text} WHERE {differs} ORDER BY run",
        FAILED: "SELECT run, failed FROM changes WHERE failed IS NOT NULL ORDER BY run",
    }.items():
        half = folder / f"{name}.part"
        form = "FORMAT parquet, COMPRESSION zstd" if name.endswith(".parquet") else "FORMAT csv, HEADER"
        ask.execute(f"COPY ({question}) TO {_literal(half)} ({form})")
        half.replace(folder / name)


def _result(ask: Ask, folder: Path, noted: Mapping[str, Any]) -> BatchResult:
    diagnosis = noted["command"] == DIAGNOSE
    (listed,) = rows_of(ask, f"SELECT count(*) AS listed FROM read_parquet({_literal(folder / RUNS)})")  # noqa: S608
    (found,) = rows_of(
        ask,
        "SELECT count(*) AS done, count(failed) AS failed, count(*) FILTER (WHERE failed IS NULL) AS computed, "
        "count(*) FILTER (WHERE simulated) AS simulated, "
        "count(*) FILTER (WHERE failed IS NULL AND verdict_stored IS NULL) AS without_stored_verdict FROM changes",
    )
    runs = {**listed, **found}
    changes = rows_of(
        ask,
        "SELECT verdict_stored AS stored, verdict AS now, simulated, count(*) AS runs FROM changes "
        "WHERE verdict_differs GROUP BY 1, 2, 3 ORDER BY runs DESC, 1, 2, 3",
    )
    failed = f"SELECT run, failed AS why FROM changes WHERE failed IS NOT NULL ORDER BY run LIMIT {LISTED}"  # noqa: S608
    return BatchResult.model_validate(
        {
            **{name: noted[name] for name in ("command", "over", "program", "begun")},
            "asked": noted["differing"],
            "runs": runs,
            "verdicts": {**_flag(ask, "verdict_differs"), "changes": changes},
            "names": _flag(ask, "names_differ") if diagnosis else None,
            "fit": None if diagnosis else _flag(ask, "fit_differs"),
            "change_in_u": None if diagnosis else _summary(ask, _SIZES),
            "u_ratio": None if diagnosis else _summary(ask, _RATIO),
            "different": _different(ask, diagnosis=diagnosis),
            "failed": rows_of(ask, failed),
            "measured_with": rows_of(
                ask, "SELECT measured_with AS version, count(*) AS runs FROM changes GROUP BY 1 ORDER BY 1"
            ),
            "files": [f"{TABLE}.parquet", f"{TABLE}.csv", DIFFERENT, FAILED],
        }
    )


def _flag(ask: Ask, name: str) -> dict[str, int]:
    (found,) = rows_of(
        ask,
        f"SELECT count(*) FILTER (WHERE {name}) AS different, count(*) FILTER (WHERE NOT {name}) AS same, "  # noqa: S608 - one of our own names
        f"count(*) FILTER (WHERE {name} IS NULL AND failed IS NULL) AS unknown FROM changes",
    )
    return found


_SIZES: Final = (
    "SELECT quantile_cont(c, 0.5) AS median, quantile_cont(c, 0.95) AS of_95_percent, max(c) AS most, "
    "arg_max(run, c) AS most_of, arg_max(largest_change_of, c) AS most_in "
    "FROM (SELECT *, largest_change_in_u AS c FROM changes)"
)
_RATIO: Final = "SELECT min(least_u_ratio) AS least, max(most_u_ratio) AS most FROM changes"


def _summary(ask: Ask, question: str) -> dict[str, Any] | None:
    """Return the only row of an answer; None if no run has the compared values."""
    (found,) = rows_of(ask, question)
    return None if found["most"] is None else found


def _different(ask: Ask, *, diagnosis: bool) -> list[dict[str, Any]]:
    own = (
        ("names_stored", "names") if diagnosis else
        ("worst_delta_g_stored", "worst_delta_g", "largest_change_in_u", "largest_change_of")
    )  # fmt: skip
    differs = "(verdict_differs OR names_differ)" if diagnosis else "verdict_differs"
    return rows_of(
        ask,
        "SELECT run, unit_type, serial, simulated, verdict_stored AS stored, verdict AS now, "  # noqa: S608
        f"{', '.join(own)} FROM changes WHERE {differs} ORDER BY run LIMIT {LISTED}",
    )


def rows_of(ask: Ask, question: str) -> list[dict[str, Any]]:
    """Return the rows that an SQL query yields, each as a mapping from column name to value."""
    found = ask.execute(question)
    names = [column[0] for column in found.description]
    return [dict(zip(names, row, strict=True)) for row in found.fetchall()]
