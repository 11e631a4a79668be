"""import: a readings file checked, then kept in a run folder as it came."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import RUNS, BenchOption, RunsOption, app


@app.command("import", epilog="Example: bench import readings.csv --name unit-17-by-hand")
def import_(
    file: Annotated[Path, typer.Argument(help="Readings file.")],
    name: Annotated[str | None, typer.Option(help="Name of the run (default: the file's).")] = None,
    bench: BenchOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Make a run of a readings file that was measured elsewhere."""
    from bench.api.provenance import versions
    from bench.api.source import bench_path
    from bench.files.bench.file import load_bench
    from bench.readings.csv import read_csv
    from bench.run.folder import BENCH, IMPORTED, Run, checked_name
    from bench.run.manifest import Manifest
    from bench.run.record import Record
    from drivers.clock import utc_now

    path = bench_path(bench)
    readings = read_csv(file, load_bench(path).installation_models())
    run = Run(runs / checked_name(name or re.sub(r"[^\w.+-]", "-", file.stem)))
    manifest: Manifest = {
        "name": run.name,
        "created": utc_now().isoformat(),
        "imported": str(file),
        "readings": len(readings),
        "bench": str(path),
        "versions": versions(),
    }
    inputs = {IMPORTED: file.read_bytes(), BENCH: path.read_bytes()}
    record = Record.create(run.folder, manifest, inputs, utc_now)
    record.append("imported", 0.0, file=str(file), readings=len(readings))
    record.close()
    printing.console().print(f"{len(readings)} readings imported as run {run.name} in {run.folder}")
    return 0
