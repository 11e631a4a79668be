"""runs, show, seal, key, export, import: the records of runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.cli import printing
from bench.cli.options import RUNS, BenchOption, JsonOption, RunArgument, RunsOption, app

if TYPE_CHECKING:
    from bench.services.bench_selection import BenchTaken


@app.command(epilog="Example: bench runs")
def runs(runs: RunsOption = RUNS, json: JsonOption = None) -> int:
    """List the runs, what became of them, and how to go on."""
    from bench.services.records import run_summaries

    found = run_summaries(runs)
    printing.write_json([found.to_dict()], json)
    if json != "-":
        found.print_on(runs, printing.console())
    return 0


@app.command(epilog="Example: bench show unit-17 --verify")
def show(
    run: RunArgument,
    verify: Annotated[bool, typer.Option("--verify", help="Check the record for changed lines.")] = False,
    head: Annotated[
        str | None, typer.Option("--head", metavar="SHA256", help="Head of the chain, as noted elsewhere.")
    ] = None,
    key: Annotated[
        Path | None,
        typer.Option("--key", metavar="PUB", help="Public key that the seal must be signed with."),
    ] = None,
    authority: Annotated[
        Path | None,
        typer.Option("--authority", metavar="PEM", help="Certificate that its time stamp must stand on."),
    ] = None,
    runs: RunsOption = RUNS,
    json: JsonOption = None,
) -> int:
    """Show what a run holds: inputs, events, readings."""
    from bench.run.folder import find_run
    from bench.services.records import show_run, supply_in_words

    found = find_run(run, runs)
    verify = verify or any(given is not None for given in (head, key, authority))
    result = show_run(found, head, key, authority, verify=verify)
    printing.write_json([result.to_dict()], json)
    if json != "-":
        result.print_on(found, supply_in_words(found), printing.console(), verified=verify)
    return 1 if result.problems else 0


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
    from bench.cli.printing import passphrase as typed
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


@app.command(epilog="Example: bench key ~/.bench-keys/laboratory.pem")
def key(
    file: Annotated[
        Path, typer.Argument(help="Where the private key is written; the public one is FILE.pub.")
    ],
    passphrase: Annotated[
        bool, typer.Option("--passphrase", help="Ask for a passphrase that covers the private key.")
    ] = False,
    certificate: Annotated[
        str | None,
        typer.Option(
            "--certificate",
            metavar="NAME",
            help="Make one that signs certificates (P-256) in place of seals, and beside it FILE.crt: an X.509 "
            "certificate in the laboratory's name, signed by itself.",
        ),
    ] = None,
) -> int:
    """Make the laboratory's key (Ed25519, PEM), with which 'bench seal' signs; or one that signs certificates."""
    from bench.cli.printing import passphrase as typed
    from bench.run.seal import new_key
    from drivers.clock import utc_now

    cover = typed("Passphrase: ", again="Once more: ") if passphrase else None
    out = printing.console()
    if certificate is None:
        public, fingerprint = new_key(file, cover)
    else:
        from bench.certificate.signatory import new_certificate_key

        public, fingerprint = new_certificate_key(file, certificate, cover, utc_now())
    out.print(f"private key: {file} (keep it; who has it signs in the laboratory's name)")
    kind = "public key" if certificate is None else "certificate"
    out.print(f"{kind}: {public} (give it to whoever is to check)")
    out.print(f"fingerprint: {fingerprint}")
    return 0


@app.command(epilog="Example: bench export unit-17 --csv readings.csv")
def export(
    run: RunArgument,
    csv: Annotated[str, typer.Option("--csv", metavar="FILE", help="File; - is standard output.")],
    runs: RunsOption = RUNS,
) -> int:
    """Write the readings of a run as a readings file."""
    from bench.services.conclusion import export_readings

    if csv == "-":
        sys.stdout.write(export_readings(run, runs, None).text)
        return 0
    found = export_readings(run, runs, Path(csv))
    printing.console().print(f"{found.readings} readings written to {csv}")
    if found.beside is not None:
        printing.written("where they come from", found.beside)
    return 0


@app.command("import", epilog="Example: bench import readings.csv --name unit-17-by-hand")
def import_(
    file: Annotated[Path, typer.Argument(help="Readings file.")],
    name: Annotated[str | None, typer.Option(help="Name of the run (default: the file's).")] = None,
    bench: BenchOption = None,
    runs: RunsOption = RUNS,
) -> int:
    """Make a run of a readings file that was measured elsewhere."""
    from bench.services.conclusion import import_readings

    out = printing.console()

    def announce(taken: BenchTaken, notes: Sequence[str]) -> None:
        printing.bench_file(taken, None)
        printing.notes_on(out, notes)

    run = import_readings(file, name, bench, runs, announce)
    out.print(f"{run.manifest['readings']} readings imported as run {run.name} in {run.folder}")
    return 0
