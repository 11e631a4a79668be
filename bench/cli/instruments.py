"""instruments: opens everything on a bench at once, shows what it is and reads; lists what interfaces offer."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.cli import printing
from bench.cli.options import BenchOption, JsonOption, WireLogOption, app
from bench.services.errors import Refused

if TYPE_CHECKING:
    from bench.services.instruments import InstrumentLook


@app.command(epilog="Example: bench instruments --bench my-bench.yaml")
def instruments(
    bench: BenchOption = None,
    discover: Annotated[
        bool, typer.Option("--discover", help="List what the interfaces offer; address no instrument.")
    ] = False,
    commission: Annotated[
        bool,
        typer.Option(
            "--commission", help="Go through a first evening with the hardware, asked step by step."
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="With --commission: folder for page and wire log (default: a new one).",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="With --commission: the simulated bench and a scripted person.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Random numbers of a dry run.", min=0)] = 1,
    json: JsonOption = None,
    wire_log: WireLogOption = None,
) -> int:
    """Open every instrument of a bench at once: identity, self-test, a reading, and all that is wrong."""
    if commission:
        from bench.cli.commissioning import commission_bench

        if discover or wire_log is not None:
            raise Refused("--commission goes without --discover and --wire-log: its folder holds a wire log")
        return commission_bench(_named(bench), out, json, dry_run=dry_run, seed=seed)
    if dry_run or out is not None:
        raise Refused("--dry-run and --out go with --commission")
    return _offers(json) if discover else look(bench, json, wire_log)


def _named(bench: str | None) -> str | None:
    """Return the bench file that was named, None for that of the environment. Raises `Refused` without any."""
    if not (bench or os.environ.get("BENCH_FILE")):
        raise Refused(
            "say which bench: --bench FILE (or set BENCH_FILE); --discover lists what the interfaces offer"
        )
    return bench


def look(bench: str | None, target: str | None = None, wire_log: Path | None = None) -> int:
    """Look at the instruments: 0 when all is well, 2 when one could not be opened, else 1.

    Raises `Refused` without a bench file, `FileMistakes`, `OSError` for a wire log that cannot be.
    """
    from bench.config.bench_file.file import load_bench
    from bench.run.listening import Interrupts
    from bench.services.bench_selection import bench_path
    from bench.services.instruments import look_at
    from bench.services.traceability import remarks
    from drivers.wire.replay import logged_wire

    file = load_bench(bench_path(_named(bench)))
    with logged_wire(wire_log) as wire, Interrupts() as interrupts:
        rows = look_at(file, wire, interrupts.haste)
    failures = [failure for row in rows for failure in row.failures]
    result = {
        "bench": file.name,
        "passed": not failures,
        "instruments": [row.to_json() for row in rows],
    }
    printing.write_json([result], target)
    if target != "-":
        _show(rows)
        serials = {row.name: row.identity.serial for row in rows if row.identity is not None}
        printing.notes_on(printing.console(), remarks(file, serials))
    printing.aside(*(f"bench: {failure}" for failure in failures))
    if any(row.absent for row in rows):
        return 2
    return 1 if failures else 0


def _show(rows: Sequence[InstrumentLook]) -> None:
    from bench.run.instruments import same_serials

    out = printing.console()
    table = printing.table()
    for heading in ("instrument", "address", "identity", "settings", "self-test", "shows"):
        # An address is copied from the table, so it must not be broken.
        table.add_column(heading, overflow="fold", no_wrap=heading in {"instrument", "address", "self-test"})
    for row in rows:
        identity = "NOT OPENED" if row.identity is None else str(row.identity)
        shows = "FAILED" if row.failure is not None and row.identity is not None else row.shows
        table.add_row(
            row.name,
            row.address,
            identity,
            row.settings,
            "FAILED" if row.test_failed else row.self_test,
            shows,
        )
    out.print(table)
    for words in same_serials({row.name: row.identity for row in rows if row.identity is not None}):
        out.print(f"note: {words}")
    well = sum(not row.failures for row in rows)
    out.print(f"{well} of {len(rows)} instruments are well")


def _offers(target: str | None) -> int:
    """List what the interfaces offer; address no instrument."""
    from drivers.wire.resources import discover

    offer = discover()
    printing.write_json([asdict(offer)], target)
    if target == "-":
        return 0
    out = printing.console()
    table = printing.table("resource", "what it is", no_wrap=True)
    for resource in offer.resources:
        table.add_row(resource, "")
    for port in offer.serial_ports:
        table.add_row(port.resource, f"serial port {port.device} {port.description}".rstrip())
    out.print(table if table.row_count else "nothing was found")
    printing.notes_on(out, offer.notes)
    return 0
