"""seal: the head of a run's chain, signed and time-stamped."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import RUNS, JsonOption, RunArgument, RunsOption, app


@app.command(epilog="Example: bench seal unit-17 --key ~/.bench-keys/laboratory.pem")
def seal(
    run: RunArgument,
    key: Annotated[
        Path | None,
        typer.Option("--key", metavar="FILE", help="Private key to sign with ('bench key' makes it)."),
    ] = None,
    timestamp: Annotated[
        str | None,
        typer.Option(
            "--timestamp",
            metavar="URL",
            help="Server that stamps the time (RFC 3161).",
        ),
    ] = None,
    json: JsonOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Seal a run that has ended: note the head of its chain, signed with a key, stamped with the time."""
    from bench.cli.passphrase import passphrase as typed
    from bench.run.folder import find_run
    from bench.services.records import seal_run

    printing.check_target(json)
    found = find_run(run, runs)
    sealed = seal_run(found, key, timestamp, lambda: typed("Passphrase of the key: "))
    printing.write_json([{"seal": str(sealed.file), **sealed.seal.to_json()}], json)
    if sealed.no_time_stamp:
        printing.aside(f"bench: {sealed.no_time_stamp}; the seal stands without it")
    if json != "-":
        out = printing.console()
        out.print(f"sealed: {sealed.seal.events} events, head {sealed.seal.head}")
        out.print(f"seal: {sealed.file}")
        out.print(
            "note the head elsewhere: 'bench show RUN --verify --head HEAD' holds the record against it"
        )
    return 1 if sealed.no_time_stamp else 0
