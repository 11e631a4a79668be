"""run, resume, abort: a procedure carried out on a bench, recorded, then calibrated and reported."""

from __future__ import annotations

import json
import os
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from bench.cli import CommandError, printing
from bench.cli.carrying_out import carry_out, conclude
from bench.cli.provenance import versions
from bench.cli.source import bench_path, check_target
from bench.files.bench.file import load_bench
from bench.files.model import load_model
from bench.files.shipped import find_procedure
from bench.procedure.load import Procedure, check, load_procedure
from bench.run.control import SIGN, leave_wish, parse_wish
from bench.run.folder import BENCH, MODEL, PLAN, PROCEDURE, Run, all_runs, checked_name, find_run
from bench.run.prompts import confirm
from bench.run.record import Manifest, Record, RecordError, is_being_written
from bench.run.signals import Interrupts
from bench.run.states import ENDED
from bench.run.terminal import TerminalPerson
from drivers.clock import utc_now
from drivers.interfaces import Prompt, PromptKind
from drivers.wire.log import logged_wire


@dataclass(frozen=True)
class Request:
    """What `bench run` was asked to do."""

    procedure: str
    bench: str | None
    dry_run: bool
    seed: int
    name: str | None
    operator: str
    model: Path | None
    runs: Path
    wire_log: Path | None = None
    json: str | None = None
    follow: bool = False


def run(request: Request) -> int:
    """Carry out `bench run`."""
    check_target(request.json)
    if request.follow and request.json is not None:
        raise CommandError(
            "--follow makes two runs, and --json is the result of one; the folders of both hold theirs"
        )
    if not (request.bench or os.environ.get("BENCH_FILE") or request.dry_run):
        raise CommandError(
            "a run on real instruments needs a bench file: say --bench FILE (or set BENCH_FILE), "
            "or try it first with --dry-run"
        )
    if request.model is not None and not request.dry_run:
        raise CommandError("--model says what the simulated bench contains; it goes with --dry-run")
    procedure_path, bench_file_path = find_procedure(request.procedure), bench_path(request.bench)
    procedure = load_procedure(procedure_path)
    plan = procedure.expand()
    bench = load_bench(bench_file_path)
    problems = check(plan, bench, dry_run=request.dry_run)
    if problems:
        raise CommandError("\n".join(problems))
    inputs = {
        PLAN: json.dumps(plan.to_json(), indent=1).encode(),
        PROCEDURE: procedure_path.read_bytes(),
        **_included(procedure),
        BENCH: bench_file_path.read_bytes(),
    }
    if request.model is not None:
        load_model(request.model, bench.installation_models())
        inputs[MODEL] = request.model.read_bytes()
    name = checked_name(request.name or free_name(plan.name, request.runs))
    manifest: Manifest = {
        "name": name,
        "created": utc_now().isoformat(),
        "dry_run": request.dry_run,
        "seed": request.seed if request.dry_run else None,
        "operator": request.operator,
        "procedure": str(procedure_path),
        "bench": str(bench_file_path),
        "plan_hash": plan.hash,
        "unit_under_test": {
            "type": bench.unit_under_test.type,
            "serial": bench.unit_under_test.serial,
        },
        "versions": versions(),
    }
    with logged_wire(request.wire_log) as wire, Interrupts() as interrupts:
        record = Record.create(request.runs / name, manifest, inputs, utc_now, interrupts.shield)
        carry_out(Run(request.runs / name), record, None, wire, request.json)
    status = conclude(Run(request.runs / name), request.json)
    return max(status, _follow(request, name)) if request.follow else status


def _follow(request: Request, name: str) -> int:
    """Carry out what the diagnosis of a run proposes; a dry run draws another stand for the mountings to come."""
    from bench.cli.following import follow

    further = replace(request, seed=request.seed + 1, follow=False)
    return follow(
        Run(request.runs / name),
        lambda procedure, called: run(replace(further, procedure=procedure, name=called)),
    )


def _included(procedure: Procedure) -> dict[str, bytes]:
    """The files that a procedure includes, numbered, since two may have one name."""
    return {
        f"include-{n}-{path.name}": path.read_bytes() for n, path in enumerate(procedure.files[1:], start=1)
    }


def resume(name: str | None, runs: Path, wire_log: Path | None = None, target: str | None = None) -> int:
    """Carry out `bench resume`."""
    check_target(target)
    found = _unfinished(name, runs)
    _accept_changes(found, target)
    with logged_wire(wire_log) as wire, Interrupts() as interrupts:
        record, history = Record.reopen(found.folder, utc_now, interrupts.shield)
        if history.torn:
            print("note: the last line of the record was half written and is dropped", file=sys.stderr)
        carry_out(found, record, history, wire, target)
    return conclude(Run(found.folder), target)


def _accept_changes(run: Run, target: str | None) -> None:
    """Say what was changed since the run began; on a real bench the person must agree to go on without it."""
    changes = changed_since(run)
    out = printing.console(json=target)
    for change in changes:
        out.print(f"note: {change}; the run goes on with the copy in its folder")
    if changes and not run.simulated:
        prompt = Prompt(
            id="changed",
            kind=PromptKind.CONFIRM,
            text="Go on as the run was begun, without these changes?",
            action={"do": "answer"},
        )
        confirm(TerminalPerson(sys.stdin, out), prompt)


def changed_since(run: Run) -> list[str]:
    """Say which of the files that a run was begun with look different now, where they still are."""
    changes = []
    for kind, copy in (("procedure", PROCEDURE), ("bench", BENCH)):
        original = Path(str(run.manifest.get(kind)))
        if original.is_file() and original.read_bytes() != (run.folder / copy).read_bytes():
            changes.append(f"{original} was changed since the run began")
    return changes


def abort(name: str | None, runs: Path) -> int:
    """Carry out `bench abort`."""
    found = _unfinished(name, runs)
    record, history = Record.reopen(found.folder, utc_now)
    record.append("run_aborted", history.events[-1].bench_s if history.events else 0.0)
    record.close()
    printing.console().print(f"{found.name}: aborted; its record is kept in {found.folder}")
    return 0


def control(name: str, wish: str, reason: str, runs: Path) -> int:
    """Carry out `bench control`: leave a wish for the program that carries out the run."""
    found = find_run(name, runs)
    try:
        asked = replace(parse_wish(f"{wish} {reason}"), by_person=False)
    except ValueError as mistake:
        raise CommandError(str(mistake).replace(SIGN, "")) from mistake
    if not is_being_written(found.folder):
        raise CommandError(f"{found.name}: nobody is carrying out this run; 'bench runs' tells how to go on")
    leave_wish(found.folder, asked)
    printing.console().print(f"{found.name}: {asked.wish} is asked for; it is heard before the next step")
    return 0


def _unfinished(name: str | None, runs: Path) -> Run:
    if name is None:
        waiting = [run for run in all_runs(runs) if _waits(run)]
        if not waiting:
            raise CommandError(f"{runs}: no unfinished run there")
        return waiting[-1]
    found = find_run(name, runs)
    if found.imported:
        raise CommandError(f"{found.name}: was imported from a readings file; there is nothing to go on with")
    if found.history.state in ENDED:
        raise CommandError(f"{found.name}: nothing to do, the run is {found.history.state}")
    return found


def _waits(run: Run) -> bool:
    """Whether a run was begun here, has not ended, and nobody is carrying it out."""
    try:
        waits = not run.imported and run.history.state not in ENDED
    except (RecordError, ValueError):
        return False
    return waits and not is_being_written(run.folder)


def free_name(procedure: str, runs: Path) -> str:
    """Return a name that no run has: the procedure and the time, and a number where that is taken."""
    stem = re.sub(r"[^\w.+-]", "-", procedure)
    base = f"{stem}-{utc_now().astimezone():%Y%m%d-%H%M%S}"
    name, number = base, 2
    while (runs / name).exists():
        name, number = f"{base}-{number}", number + 1
    return name
