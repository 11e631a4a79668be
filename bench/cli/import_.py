"""import: a readings file checked, then kept in a run folder as it came."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from bench.base.files import read_regular
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
    from bench.base.files import read_given
    from bench.readings.csv import read_csv
    from bench.run.events import Manifest
    from bench.run.folder import BENCH, IMPORTED, Run, checked_name
    from bench.run.record import Record
    from bench.services.bench_selection import SUFFIX, bench_of, origin_beside
    from bench.services.errors import Refused
    from bench.services.records import versions
    from drivers.clock import utc_now

    try:
        content = read_given(file)  # once: a pipe has nothing more to give
    except OSError as error:
        raise Refused(f"{file}: cannot be read ({error.strerror}); check the name") from error
    told = origin_beside(file)
    taken, notes = bench_of(str(file), None, told, bench)
    on = printing.console()
    printing.bench_file(taken, None)
    printing.notes_on(on, notes)
    path = Path(taken.where)
    readings = read_csv(file, taken.file.installation_models(), content=content)
    run = Run(runs / checked_name(name or re.sub(r"[^\w.+-]", "-", file.stem)))
    manifest: Manifest = {
        "name": run.name,
        "created": utc_now().isoformat(),
        "imported": str(file),
        "readings": len(readings),
        "bench": str(path),
        "bench_why": taken.why,
        "versions": versions(),
    }
    if told.origin is not None:
        manifest["dry_run"] = told.origin.simulated
    inputs = {IMPORTED: content, BENCH: read_regular(path)}
    if told.origin is not None:
        inputs[IMPORTED + SUFFIX] = read_regular(file.with_name(file.name + SUFFIX))
    record = Record.create(run.folder, manifest, inputs, utc_now)
    record.append("imported", 0.0, file=str(file), readings=len(readings))
    record.close()
    on.print(f"{len(readings)} readings imported as run {run.name} in {run.folder}")
    return 0
