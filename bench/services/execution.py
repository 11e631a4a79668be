"""Runs: begun, carried out on the bench or dry, watched, and what can be gone on with."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Final

from rich.console import Console

from bench.base.computing import quiet
from bench.base.files import to_text, write_whole
from bench.config.bench_file.file import BenchFile, foreign_drivers, load_bench
from bench.config.devices.sections import ControlledChamberForm
from bench.config.model_file import load_model
from bench.config.procedure.load import Procedure, check, load_procedure
from bench.config.shipped import find_procedure
from bench.run.assembly.served import Assembly, dry_bench, real_bench
from bench.run.early_warning import watcher_of
from bench.run.events import Manifest, RecordError, VerdictAsked
from bench.run.folder import BENCH, MODEL, PLAN, PROCEDURE, RESULTS, Run, checked_name
from bench.run.instruments import with_notes
from bench.run.listening import Asker, ClockWatch, Interrupts, WishListener
from bench.run.person import ControlFile
from bench.run.power import Feeding
from bench.run.record import History, Record, read_history, resume_point
from bench.run.resume import Progress
from bench.run.runner import RunAborted, Runner
from bench.run.samples import SLOW_AFTER_S
from bench.run.sentences import RunLog
from bench.run.terminal import ProgressBar, TerminalPerson
from bench.services.bench_selection import bench_for_record, bench_path, why_taken
from bench.services.check_runs import checked_before
from bench.services.errors import Refused
from bench.services.heard import Heard
from bench.services.own_effects import effects_for_record, knowing_effects_on_record
from bench.services.records import versions
from bench.services.simulated_truth import simulated_truth
from bench.services.traceability import remarks
from bench.services.until import noted_goals, until_of
from drivers.clock import utc_now
from drivers.interfaces import BenchError
from drivers.wire.pyvisa_connection import Haste
from drivers.wire.replay import WireLog

MOST_RECALLED: Final = 500
"""So many of the last readings of a resumed run teach the early warning what to expect; more teach it little."""


@dataclass(frozen=True)
class NewRun:
    """A run that may begin: its folder, what its manifest says, and the files that it is begun with.

    `notes` is what whoever begins it should know.
    """

    folder: Path
    manifest: Manifest
    inputs: dict[str, bytes]
    notes: tuple[str, ...] = ()

    def record(self, shield: Callable[[], AbstractContextManager[None]] | None = None) -> Record:
        """Make the folder and return its record; `shield` keeps a line from being cut in two by Ctrl-C."""
        if shield is None:
            return Record.create(self.folder, self.manifest, self.inputs, utc_now)
        return Record.create(self.folder, self.manifest, self.inputs, utc_now, shield)


def new_run(
    procedure: str,
    bench: str | None,
    runs: Path,
    *,
    dry_run: bool,
    seed: int,
    name: str | None = None,
    operator: str = "",
    unit: str | None = None,
    model: Path | None = None,
    verdict: VerdictAsked | None = None,
    living: bool = False,
    until: Sequence[str] = (),
    check_block: bool = False,
    despite_check: str | None = None,
) -> NewRun:
    """Check a procedure against a bench and return the run that it makes.

    `unit` is the serial number of the block, `verdict` how it is judged, in place of the bench file's. A person
    answers the questions of a `living` dry run, `until` are the goals at which it ends. With `check_block` a dry
    run, too, is held to the bench's check block; `despite_check` is why a run is begun whatever that says.

    Raises `FileMistakes` and `Refused` with all that speaks against it.
    """
    if re.search("[\ud800-\udfff]", operator):
        raise Refused("--operator: this is not UTF-8 text; type the name again, or set the terminal to UTF-8")
    procedure_path, bench_file_path = find_procedure(procedure), bench_path(bench)
    loaded = load_procedure(procedure_path)
    plan = loaded.expand()
    file = load_bench(bench_file_path)
    problems = check(plan, file, dry_run=dry_run and not living)
    if unit is not None and (not unit.strip() or not unit.isprintable()):
        problems = [
            *problems,
            f"--unit {unit!r}: a serial number is text that can be printed, such as 17-042",
        ]
    if problems:
        raise Refused("\n".join(problems))
    if dry_run:
        simulated_truth(file, model)
    inputs = {
        PLAN: json.dumps(plan.to_json(), indent=1).encode(),
        PROCEDURE: procedure_path.read_bytes(),
        **_included(loaded),
        **bench_for_record(file, bench_file_path),
    }
    if model is not None:
        load_model(model, file.installation_models())
        inputs[MODEL] = model.read_bytes()
    inputs |= effects_for_record()
    name = checked_name(name or _free_name(plan.name, runs))
    stated = file.unit_under_test
    serial = stated.serial if unit is None else unit.strip()
    manifest: Manifest = {
        "name": name,
        "created": utc_now().isoformat(),
        "dry_run": dry_run,
        "seed": seed if dry_run else None,
        "operator": operator,
        "procedure": str(procedure_path),
        "bench": str(bench_file_path),
        "bench_why": why_taken(bench),
        "plan_hash": plan.hash,
        "unit_under_test": {"type": stated.type, "serial": serial},
        "versions": versions(),
    }
    if living:
        manifest["living"] = True
    if foreign := foreign_drivers(file):
        manifest["devices"] = foreign
    if verdict:
        manifest["verdict"] = verdict
    notes = _other_unit(stated.serial, serial, file.name)
    notes += noted_goals(manifest, plan, file, until)
    if check_block or despite_check is not None or (file.check_block is not None and not dry_run):
        notes += checked_before(manifest, file, bench_file_path, runs, despite_check)
    return NewRun(runs / name, manifest, inputs, notes)


def _other_unit(stated: str, serial: str, bench: str) -> tuple[str, ...]:
    """Say that a run is of another unit than its bench file names."""
    if serial == stated:
        return ()
    return (f"this run is of unit {serial}, as --unit says; the bench file {bench} names unit {stated}",)


def _included(procedure: Procedure) -> dict[str, bytes]:
    """The files that a procedure includes, numbered, since two may have one name."""
    return {
        f"include-{n}-{path.name}": path.read_bytes() for n, path in enumerate(procedure.files[1:], start=1)
    }


def _free_name(procedure: str, runs: Path) -> str:
    """Return a name that no run has: the procedure and the time, and a number where that is taken."""
    stem = re.sub(r"[^\w.+-]", "-", procedure)
    base = f"{stem}-{utc_now().astimezone():%Y%m%d-%H%M%S}"
    name, number = base, 2
    while (runs / name).exists():
        name, number = f"{base}-{number}", number + 1
    return name


def carry_out(
    run: Run,
    record: Record,
    history: History | None,
    wire: WireLog | None,
    out: Console,
    interrupts: Interrupts | None = None,
    heard: Heard | None = None,
) -> None:
    """Run to the end; say what is kept when it stops before. `history` is that of a run to be resumed.

    `interrupts` hears the signals meanwhile, `heard` is who is asked and what is wished.
    """
    signals = interrupts or Interrupts()
    write_whole(run.folder / RESULTS, to_text({"made": None}))
    heard = heard or Heard(WishListener(ControlFile(run.folder)))
    resume = resume_point(run.plan, history) if history else None
    if history and resume and not run.simulated:
        resume = replace(resume, bench_s=_elapsed_s(history))
    with knowing_effects_on_record(run):
        bench = load_bench(run.folder / BENCH)
    watcher = watcher_of(run.plan, bench)
    if history:
        watcher.recall(history.taken[-MOST_RECALLED:], history.progress)
    where = "simulated instruments" if run.simulated else "the bench"
    verb = "goes on" if resume else "starts"
    if not quiet.get():
        out.print(
            f"run {run.name} {verb} on {where}: {run.plan.name}, {len(run.plan.steps)} steps, "
            f"recorded in {run.folder}"
        )
        out.print(f"procedure {run.manifest.get('procedure')}, bench file {run.manifest.get('bench')}")
    try:
        with _assembly(run, bench, history, wire, out, signals.haste, heard.asker) as (assembly, bar):
            bar.recall(history.progress.chosen if history else ())
            Runner(
                plan=run.plan,
                instruments=assembly.instruments,
                person=assembly.person,
                clock=assembly.clock,
                record=record,
                range_v=bench.voltmeter_range_v,
                observers=(*assembly.observers, watcher.observe, bar, RunLog(run.folder, run.plan)),
                at_resumed_time=assembly.at_resumed_time,
                controls=heard.wishes,
                stopped=lambda: heard.wishes.stopped,
                asker=heard.asker,
                progress=history.progress.copy() if history else Progress(),
                watch=watcher.take,
                # who resumes a dry run that stopped is there to be asked
                decider=heard.asker if history else None,
                block_limits_c=(
                    bench.unit_under_test.temperature.minimum,
                    bench.unit_under_test.temperature.maximum,
                ),
                least_samples=bench.least_samples,
                setting_u_rad=bench.stand_distributions()["setting_error"].u,
                slow_chamber_s=_slow_chamber_s(bench),
                clocks=None if run.simulated else ClockWatch(utc_now, assembly.clock.now_s),
                on_settling=bar.settling,
                hold_signals=signals.hold,
                certificates=_on_certificates(bench, simulated=run.simulated),
                fed=_fed(bench),
                choose=until_of(run, bench),
            ).run(resume)
        _refuse_renamed(record)
    except RunAborted as why:
        raise Refused(f"aborted{': ' if str(why) else ''}{with_notes(why)}; {_recorded(record)}") from None
    except KeyboardInterrupt as stop:
        raise Refused(
            f"interrupted; {with_notes(stop)}{'; ' if with_notes(stop) else ''}{_kept(record)}"
        ) from None
    except (BenchError, RecordError) as error:
        raise Refused(f"{with_notes(error)}; {_kept(record)}") from error
    finally:
        record.close()


def _on_certificates(
    bench: BenchFile, *, simulated: bool
) -> Callable[[Mapping[str, str]], Sequence[str]] | None:
    """Return what says of serial numbers what is to be told of the certificates; None where nobody asks for them.

    Those of simulated instruments are nobody's; by those of a real run an instrument is known again elsewhere.
    """
    if simulated and all(section.certificate is None for section in bench.instruments.all()):
        return None
    return lambda serials: remarks(bench, None if simulated else serials)


def _fed(bench: BenchFile) -> Feeding | None:
    """Return how the power supply feeds the block, None where the bench file does not say so."""
    section, supply = bench.unit_under_test.supply, bench.instruments.power_supply
    return None if section is None or supply is None else Feeding(section, supply.limits)


def _slow_chamber_s(bench: BenchFile) -> float:
    chamber = bench.instruments.chamber
    return chamber.slow_after if isinstance(chamber, ControlledChamberForm) else SLOW_AFTER_S


@contextmanager
def _assembly(
    run: Run,
    bench: BenchFile,
    history: History | None,
    wire: WireLog | None,
    out: Console,
    haste: Haste,
    asker: Asker | None,
) -> Iterator[tuple[Assembly, ProgressBar]]:
    """Put the bench together with the progress bar; a question at the terminal pauses the bar."""
    supply = bench.unit_under_test.supply
    step_s = [run.plan.step_duration_s(step, bench.line_frequency, supply) for step in run.plan.steps]
    bar = ProgressBar(run.plan, out, step_s)
    if asker is not None and asker.terminal is not None:
        asker.terminal.beside(bar)
    living = asker if run.asks_somebody else None
    with bar:
        if run.simulated:
            taken = [one[1] for one in (history.taken if history else ()) if one is not None]
            seed = run.manifest["seed"] or 0
            model = run.folder / MODEL
            with knowing_effects_on_record(run):
                truth = simulated_truth(bench, model if model.is_file() else None)
            with dry_bench(
                bench, truth, seed, wire, haste, plan=run.plan, taken=taken, living=living
            ) as assembly:
                yield assembly, bar
        else:
            yield real_bench(bench, living or TerminalPerson(sys.stdin, out), wire, haste), bar


def _elapsed_s(history: History) -> float:
    """Bench time now: on a real bench the time between two programs has passed as well."""
    if not history.events:
        return 0.0
    last = history.events[-1]
    return last.bench_s + max(0.0, (utc_now() - datetime.fromisoformat(last.time)).total_seconds())


def _refuse_renamed(record: Record) -> None:
    """Raise `Refused` where the folder of a finished run is not where it was: its results would go nowhere."""
    place = record.whereabouts()
    if place == record.folder:
        return
    now = f"it is {place} now" if place else "it is not found beside the other runs"
    again = place or "FOLDER"
    raise Refused(
        f"{record.folder}: the run is finished and recorded, but its folder was renamed or moved ({now}); "
        f"'bench resume {again}' makes its results there"
    )


def _recorded(record: Record) -> str:
    """Say how much is kept, and where; the folder may have been renamed while the run went on."""
    place = record.whereabouts()
    if place is None:
        return f"{record.folder} was moved or deleted while the run went on"
    try:
        done = sum(taken is not None for taken in read_history(place).taken)
    except RecordError as error:
        return str(error)
    return f"{done} readings are kept in {place}"


def _kept(record: Record) -> str:
    place = record.whereabouts() or record.folder
    return f"{_recorded(record)}; go on with 'bench resume {place.name}'"
