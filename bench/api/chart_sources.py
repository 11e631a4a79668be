"""Which runs a control chart is of: those named, or those of the check block in a folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.api.arguments import CHARTED, checked
from bench.api.check_block import CheckBlockChart, chart_of, check_block_runs, is_check_block
from bench.api.errors import Refused
from bench.api.taken import find_bench_file, own_bench
from bench.files.bench.check_block import CheckBlockSection
from bench.files.bench.file import BenchFile
from bench.run.folder import Run, all_runs, find_run
from bench.run.manifest import MANIFEST, RecordError


@dataclass(frozen=True)
class ChartedRuns:
    """Runs of a check block, what the bench file says of it, and where that file is."""

    runs: list[Run]
    section: CheckBlockSection
    bench_file: Path


def charted_runs(
    sources: Sequence[str], folder: Path, bench: str | None, *, real: bool | None = None
) -> ChartedRuns:
    """Return the runs that are named, or in one folder those of its bench's check block.

    The bench file is the one asked for, that of BENCH_FILE, or that which the latest run of a check block recorded.
    `real` says which runs of a folder are meant. Raises `Refused` where there are none.
    """
    place = Path(sources[0])
    if len(sources) == 1 and place.is_dir() and not (place / MANIFEST).is_file():
        return _in_folder(place, bench, real)
    named = [find_run(name, folder) for name in sources]
    file, path = _bench_file(bench, named[-1])
    section = file.check_block or CheckBlockSection(serial=file.unit_under_test.serial, drift={})
    return ChartedRuns(named, section, path)


@checked(runs=CHARTED)
def chart(
    runs: str | Path | Sequence[str | Path] | None = None, *, bench: str | Path | None = None
) -> CheckBlockChart:
    """Return the control chart of a check block, as `bench chart` finds it.

    `runs` are runs of the check block by name or path, or the folder in which they are (BENCH_RUNS, or ./runs).
    `bench` states the check block; without it the bench file counts that the latest of its runs recorded.
    """
    folder = Path(os.environ.get("BENCH_RUNS") or "runs")
    given = [folder] if runs is None else [runs] if isinstance(runs, str | Path) else list(runs)
    found = charted_runs([str(one) for one in given], folder, None if bench is None else str(bench))
    return chart_of(found.runs, found.section, of_bench=found.bench_file, folder=folder)


def _bench_file(bench: str | None, run: Run) -> tuple[BenchFile, Path]:
    if bench or os.environ.get("BENCH_FILE"):
        taken = find_bench_file(bench)
        return taken.file, Path(taken.where)
    return own_bench(run)


def _in_folder(folder: Path, bench: str | None, real: bool | None) -> ChartedRuns:
    kinds = (True, False) if real is None else (not real,)
    file, path, latest = _of_folder(folder, bench, kinds)
    section = file.check_block
    if section is None:
        raise Refused(f"{path}: states no check_block; add it, or name the runs of the check block")
    simulated = latest.simulated if latest is not None else kinds[0]
    runs = check_block_runs(file, folder, simulated=simulated)
    if not runs:
        raise Refused(
            f"{folder}: no finished run of the check block {section.serial} of {file.name} there; measure it with "
            f"bench run PROCEDURE --unit {section.serial}"
        )
    return ChartedRuns(runs, section, path)


def _of_folder(folder: Path, bench: str | None, kinds: Sequence[bool]) -> tuple[BenchFile, Path, Run | None]:
    """Return the bench file, where it is, and the latest run of its check block, if there is one."""
    asked = bench or os.environ.get("BENCH_FILE")
    given = find_bench_file(bench) if asked else None
    for run in reversed(all_runs(folder)):
        try:
            unit = run.manifest.get("unit_under_test")
            if unit is None or run.simulated not in kinds:
                continue
            file, path = (given.file, Path(given.where)) if given else _bench_file(None, run)
        except (RecordError, OSError, ValueError):
            continue
        if is_check_block(file, unit):
            return file, path, run
    if given:
        return given.file, Path(given.where), None
    raise Refused(
        f"{folder}: no run of a check block there; say --bench FILE whose check_block names it, and measure it "
        "with bench run PROCEDURE --unit SERIAL"
    )
