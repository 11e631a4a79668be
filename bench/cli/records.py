"""runs, show, seal, key, export, import: the records of runs."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Annotated

import typer

from bench.base.files import read_regular
from bench.cli import printing
from bench.cli.options import RUNS, BenchOption, JsonOption, RunArgument, RunsOption, app
from bench.services.errors import Refused


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
    from bench.cli.passphrase import passphrase as typed
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
    from bench.base.files import write_whole
    from bench.readings.csv import format_csv
    from bench.services.bench_selection import SUFFIX, is_told
    from bench.services.source import Request, load_sources

    (source,) = load_sources(Request([run], runs))
    text = format_csv(source.as_read)
    if csv == "-":
        sys.stdout.write(text)
    else:
        beside = Path(csv + SUFFIX)
        if beside.exists() and not is_told(beside):
            raise Refused(f"{beside}: is a file of something else; export under another name")
        write_whole(Path(csv), text)
        printing.console().print(f"{len(source.readings)} readings written to {csv}")
        if source.origin is not None:
            write_whole(beside, source.origin.text_beside(Path(csv), text.encode()))
            printing.written("where they come from", beside)
    return 0


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
