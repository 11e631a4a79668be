"""What came of a batch: its whole table; which verdicts are other ones, how far coefficients went."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bench.base.files import to_text, write_whole
from bench.batch.job import COLUMNS, DIAGNOSE, NOT_IN_TEXT
from bench.batch.store import PARTS, RUNS, Store

TABLE: Final = "changes"
DIFFERENT: Final = "verdicts.csv"
FAILED: Final = "failed.csv"
SUMMARY: Final = "summary.json"
LISTED: Final = 1000
"""So many runs at most are listed in the summary; the tables have all."""
_MEMORY: Final = "512MB"
_PARTS_OF_THE_LISTED: Final = (
    "CREATE VIEW changes AS SELECT parts.* FROM read_parquet($parts) AS parts "
    "JOIN read_parquet($runs) AS listed ON parts.run = listed.run AND parts.fingerprint = listed.fingerprint"
)


@dataclass(frozen=True)
class Outcome:
    """The summary of a batch as JSON has it, and the folder in which its tables stand."""

    summary: Mapping[str, Any]
    folder: Path

    @property
    def different(self) -> int:
        """How many verdicts would be different."""
        return int(self.summary["verdicts"]["different"])

    @property
    def failed(self) -> int:
        """How many runs gave nothing."""
        return int(self.summary["runs"]["failed"])


def conclude(store: Store) -> Outcome:
    """Write the tables and the summary of what is done, and return it. Raises `OSError`."""
    noted = store.noted()
    with asked_of(store.folder) as ask:
        _write_tables(ask, store.folder, noted["command"])
        summary = _summary(ask, store.folder, noted)
    write_whole(store.folder / SUMMARY, to_text(summary))
    return Outcome(summary, store.folder)


Ask = Any
"""A connection to DuckDB that knows the view `changes`: the rows of the runs listed, each once."""


@contextmanager
def asked_of(folder: Path) -> Iterator[Ask]:
    """Let questions be asked about the rows of a batch, as far as it is done; large ones use the disk."""
    import duckdb

    with duckdb.connect(":memory:", config={"memory_limit": _MEMORY, "threads": 1}) as ask:
        parts, runs = _literal(folder / PARTS / "part-*.parquet"), _literal(folder / RUNS)
        ask.execute(_PARTS_OF_THE_LISTED.replace("$parts", parts).replace("$runs", runs))
        yield ask


def _literal(path: Path) -> str:
    """Return a path as SQL has a text: a view takes no parameters."""
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


def _summary(ask: Ask, folder: Path, noted: Mapping[str, Any]) -> dict[str, Any]:
    diagnosis = noted["command"] == DIAGNOSE
    listed = f"{_literal(folder / RUNS)}"
    return {
        "command": noted["command"],
        "over": noted["over"],
        "asked": noted["differing"],
        "program": noted["program"],
        "begun": noted["begun"],
        "runs": {
            "listed": _number(ask, f"SELECT count(*) FROM read_parquet({listed})"),  # noqa: S608
            **_counted(ask),
        },
        "verdicts": _verdicts(ask),
        "names": _flag(ask, "names_differ") if diagnosis else None,
        "fit": None if diagnosis else _flag(ask, "fit_differs"),
        "change_in_u": None if diagnosis else _sizes(ask, "largest_change_in_u"),
        "u_ratio": None if diagnosis else _ratio(ask),
        "different": _different(ask, diagnosis=diagnosis),
        "failed": _rows(
            ask,
            f"SELECT run, failed AS why FROM changes WHERE failed IS NOT NULL ORDER BY run LIMIT {LISTED}",  # noqa: S608
        ),
        "measured_with": _rows(
            ask, "SELECT measured_with AS version, count(*) AS runs FROM changes GROUP BY 1 ORDER BY 1"
        ),
        "files": [f"{TABLE}.parquet", f"{TABLE}.csv", DIFFERENT, FAILED],
    }


def _counted(ask: Ask) -> dict[str, int]:
    (found,) = _rows(
        ask,
        "SELECT count(*) AS done, count(failed) AS failed, count(*) FILTER (WHERE failed IS NULL) AS computed, "
        "count(*) FILTER (WHERE simulated) AS simulated, "
        "count(*) FILTER (WHERE failed IS NULL AND verdict_stored IS NULL) AS without_stored_verdict FROM changes",
    )
    return {name: int(count) for name, count in found.items()}


def _verdicts(ask: Ask) -> dict[str, Any]:
    return {
        **_flag(ask, "verdict_differs"),
        "changes": _rows(
            ask,
            "SELECT verdict_stored AS stored, verdict AS now, simulated, count(*) AS runs FROM changes "
            "WHERE verdict_differs GROUP BY 1, 2, 3 ORDER BY runs DESC, 1, 2, 3",
        ),
    }


def _flag(ask: Ask, name: str) -> dict[str, int]:
    (found,) = _rows(
        ask,
        f"SELECT count(*) FILTER (WHERE {name}) AS different, count(*) FILTER (WHERE NOT {name}) AS same, "  # noqa: S608 - one of our own names
        f"count(*) FILTER (WHERE {name} IS NULL AND failed IS NULL) AS unknown FROM changes",
    )
    return {key: int(count) for key, count in found.items()}


def _sizes(ask: Ask, name: str) -> dict[str, Any] | None:
    (found,) = _rows(
        ask,
        f"SELECT quantile_cont({name}, 0.5) AS median, quantile_cont({name}, 0.95) AS of_95_percent, "  # noqa: S608
        f"max({name}) AS most, arg_max(run, {name}) AS most_of, arg_max(largest_change_of, {name}) AS most_in "
        "FROM changes",
    )
    return None if found["most"] is None else found


def _ratio(ask: Ask) -> dict[str, Any] | None:
    (found,) = _rows(ask, "SELECT min(least_u_ratio) AS least, max(most_u_ratio) AS most FROM changes")
    return None if found["least"] is None else found


def _different(ask: Ask, *, diagnosis: bool) -> list[dict[str, Any]]:
    own = (
        ("names_stored", "names") if diagnosis else
        ("worst_delta_g_stored", "worst_delta_g", "largest_change_in_u", "largest_change_of")
    )  # fmt: skip
    differs = "(verdict_differs OR names_differ)" if diagnosis else "verdict_differs"
    return _rows(
        ask,
        "SELECT run, unit_type, serial, simulated, verdict_stored AS stored, verdict AS now, "  # noqa: S608
        f"{', '.join(own)} FROM changes WHERE {differs} ORDER BY run LIMIT {LISTED}",
    )


def _number(ask: Ask, question: str) -> int:
    return int(ask.execute(question).fetchone()[0])


def _rows(ask: Ask, question: str) -> list[dict[str, Any]]:
    found = ask.execute(question)
    names = [column[0] for column in found.description]
    return [dict(zip(names, row, strict=True)) for row in found.fetchall()]
