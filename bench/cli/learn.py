"""learn: what many runs tell of one bench, as a file that a bench file takes."""

from __future__ import annotations

from datetime import date, timedelta
from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import RUNS, BenchOption, JsonOption, ModelOption, RunsOption, SkipOption, app
from bench.services.errors import Refused


@app.command(epilog="Example: bench learn unit-* --out learned.yaml --expires 180")
def learn(
    sources: Annotated[
        list[str], typer.Argument(metavar="RUN…", help="Runs (name or path) or readings files of one bench.")
    ],
    bench: BenchOption = None,
    model: ModelOption = None,
    by_installation: Annotated[
        bool,
        typer.Option("--by-installation", help="Each installation has mean angles of its own (brackets)."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Learned file to write (default: learned.yaml)."),
    ] = None,
    expires: Annotated[
        str | None,
        typer.Option(metavar="DATE|DAYS", help="Until when it counts (default: 365 days)."),
    ] = None,
    json: JsonOption = None,
    skip_bad_rows: SkipOption = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="A run that contradicts the others is not accepted.")
    ] = False,
    runs: RunsOption = RUNS,
) -> int:
    """What many runs tell of one bench: its stand, noise, head; as a file that its bench file takes."""
    from bench.services.learning import learning_of
    from bench.services.source import Request, load_sources

    printing.check_target(json)
    target = out or Path("learned.yaml")
    if target.exists():
        raise Refused(
            f"{target}: is there already, and a learned file is not overwritten; give another --out"
        )
    until = _until(expires)
    loaded = load_sources(Request(sources, runs, bench, model, None, None, skip_bad_rows))
    printing.bench_files(loaded, json)
    found = learning_of(loaded, by_installation=by_installation, expires=until)
    on = printing.console(json=json)
    found.print_on(on)
    printing.notes_on(on, found.notes)
    printing.write_json([found.to_dict()], json)
    if found.learned.too_many_contradict:
        return 1
    found.write(target)
    printing.written("learned file", target, on)
    on.print(f"name it in the bench file: 'learned: {target}'")
    return 1 if strict and found.learned.contradicting else 0


def _until(expires: str | None) -> date | None:
    """Return the day that was typed as such or as a number of days from now; None where nothing was."""
    from drivers.clock import utc_now

    if expires is None:
        return None
    if expires.isascii() and expires.isdecimal() and 0 < int(expires) < 36500:
        return utc_now().date() + timedelta(days=int(expires))
    try:
        return date.fromisoformat(expires)
    except ValueError:
        raise Refused(
            f"--expires {expires}: expected a date such as 2027-01-31, or a number of days from now"
        ) from None
