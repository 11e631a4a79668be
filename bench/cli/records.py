"""runs, show, seal, key, export, import: the records of runs."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from bench.cli import printing
from bench.cli.options import JsonOption, command
from bench.services.requests.measuring import (
    ExportReadings,
    ImportReadings,
    ListRuns,
    MakeKey,
    SealRun,
    ShowRun,
)
from bench.services.requests.shared import runs_folder

if TYPE_CHECKING:
    from bench.services.bench_selection import BenchTaken


@command("bench runs")
def runs(request: ListRuns, json: JsonOption = None) -> int:
    """List the runs, their states and how to continue."""
    from bench.services.records import run_summaries

    folder = runs_folder(request.runs)
    found = run_summaries(folder)
    printing.write_json([found.to_dict()], json)
    if json != "-":
        found.print_on(folder, printing.console())
    return 0


@command("bench show unit-17 --verify")
def show(request: ShowRun, json: JsonOption = None) -> int:
    """Show the inputs, events and readings of a run."""
    from bench.run.folder import find_run
    from bench.services.records import show_run, supply_in_words

    found = find_run(request.run, runs_folder(request.runs))
    result = show_run(found, request)
    printing.write_json([result.to_dict()], json)
    if json != "-":
        result.print_on(found, supply_in_words(found), printing.console(), verified=request.proved)
    return 1 if result.problems else 0


@command("bench seal unit-17 --key ~/.bench-keys/laboratory.pem")
def seal(request: SealRun, json: JsonOption = None) -> int:
    """Seal a run that has ended: sign its record and stamp the time."""
    from bench.services.records import seal_run

    sealed = seal_run(request, lambda: printing.passphrase("Passphrase of the key: "))
    printing.write_json([{"seal": str(sealed.file), **sealed.seal.to_json()}], json)
    if sealed.no_time_stamp:
        printing.aside(f"bench: {sealed.no_time_stamp}; the seal has no time stamp")
    if json != "-":
        out = printing.console()
        out.print(f"sealed: {sealed.seal.events} events, head {sealed.seal.head}")
        out.print(f"seal: {sealed.file}")
        out.print(
            "note the head elsewhere: 'bench show RUN --verify --head HEAD' then shows any change of the "
            "record"
        )
    return 1 if sealed.no_time_stamp else 0


@command("bench key ~/.bench-keys/laboratory.pem")
def key(request: MakeKey) -> int:
    """Make the laboratory's key for seals, or a key for certificates."""
    from bench.run.seal import new_key
    from drivers.clock import utc_now

    file, name = request.file, request.certificate
    cover = printing.passphrase("Passphrase: ", again="Once more: ") if request.passphrase else None
    out = printing.console()
    if name is None:
        public, fingerprint = new_key(file, cover)
    else:
        from bench.certificate.signatory import new_certificate_key

        public, fingerprint = new_certificate_key(file, name, cover, utc_now())
    out.print(f"private key: {file} (keep it secret: it signs in the laboratory's name)")
    kind, of = ("public key", "seals") if name is None else ("certificate", "certificates")
    out.print(f"{kind}: {public} (give it to those who verify {of})")
    out.print(f"fingerprint: {fingerprint}")
    return 0


@command("bench export unit-17")
def export(request: ExportReadings) -> int:
    """Write the readings of a run as a readings file."""
    from bench.services.conclusion import export_readings

    found = export_readings(request)
    if found.file is None:
        sys.stdout.write(found.text)
        return 0
    printing.console().print(f"{found.readings} readings written to {found.file}")
    if found.beside is not None:
        printing.written("origin of the readings", found.beside)
    return 0


@command("bench import readings.csv --name unit-17-by-hand", "import")
def import_(request: ImportReadings) -> int:
    """Make a run of readings that were measured elsewhere."""
    from bench.services.conclusion import check_preview, import_readings, preview_log

    out = printing.console()
    if request.preview:
        log = preview_log(request)
        sys.stdout.write(f"{log.preview()}\n")
        check_preview(request, log)
        out.print(f"{log.rows} rows, {len(log.skipped)} left out; nothing was imported")
        return 0

    def announce(taken: BenchTaken, notes: Sequence[str]) -> None:
        printing.bench_file(taken.part(), None)
        printing.notes_on(out, notes)

    run = import_readings(request, announce)
    out.print(f"{run.manifest['readings']} readings imported as run {run.name} in {run.folder}")
    return 0
