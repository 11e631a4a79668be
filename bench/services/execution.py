"""Carrying out runs, on the bench or dry: begin, watch, resume and give up a run."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from bench.base.computing import quiet, versions
from bench.base.files import read_regular
from bench.base.languages import message
from bench.base.text import as_typed
from bench.config.bench_file.file import BenchFile, foreign_drivers, load_bench, missing_drivers
from bench.config.devices.sections import ControlledChamberForm
from bench.config.model_file import load_model
from bench.config.procedure.load import Procedure, check, load_procedure
from bench.config.shipped import find_procedure
from bench.run.assembly.served import Assembly, dry_bench, real_bench
from bench.run.early_warning import EarlyWarning, watcher_of
from bench.run.events import ENDED, Event, EventType, Manifest, RecordError, RunState, VerdictAsked
from bench.run.folder import BENCH, MODEL, PLAN, PROCEDURE, Digests, Run, all_runs, checked_name, find_run
from bench.run.instruments import with_notes
from bench.run.interrupts import Interrupts, stopped_by
from bench.run.listening import Asker, ClockWatch, WishListener
from bench.run.live import LiveSignals
from bench.run.person import NOBODY_KNOWN, ControlFile, WishAuthor, agree
from bench.run.power import Feeding
from bench.run.record import History, Record, ResumePoint, is_being_written, read_history, resume_point
from bench.run.resume import PlanProgress
from bench.run.runner import Observer, People, Recorder, RunAborted, Runner
from bench.run.samples import SLOW_AFTER_S
from bench.run.sentences import TERMINAL, RunLog, sentence
from bench.run.terminal import ProgressBar, TerminalPerson
from bench.run.workbench import BenchSetup
from bench.services.bench_selection import bench_for_record, bench_path, why_taken
from bench.services.errors import Refused
from bench.services.own_effects import effects_for_record, knowing_effects_on_record, simulated_truth
from bench.services.persons import STARTED_FROM, acting_at, operator_of, resumer
from bench.services.requests.measuring import ResumeRequest, RunRequest
from bench.services.requests.shared import devices_to_type, name_to_type, resume_to_type, runs_folder
from bench.services.traceability import remarks
from bench.services.validated import (
    agree_to_expired,
    is_away,
    refuse_unfit,
    refuse_unvalidated_resumption,
    without_gravity,
)
from bench.services.verification import NOTHING_ASKED, VerdictOptions, judgement_of
from drivers.clock import Clock, Haste, utc_now
from drivers.interfaces import BenchError
from drivers.person import Prompt, PromptKind
from drivers.wire.replay import WireLog, logged_wire

MOST_RECALLED: Final = 500
"""Number of the last readings of a resumed run from which the early warning learns; more add little."""


@dataclass(frozen=True)
class NewRun:
    """A checked run that has not begun: folder, manifest, content of input files by name, notes for the person."""

    folder: Path
    manifest: Manifest
    inputs: dict[str, bytes]
    notes: tuple[str, ...] = ()

    def record(self, shield: Callable[[], AbstractContextManager[None]] = nullcontext) -> Record:
        """Create the run's folder and return its record; `shield` gives a context that delays Ctrl-C."""
        return Record.create(self.folder, self.manifest, self.inputs, utc_now, shield)


def new_run(request: RunRequest) -> NewRun:
    """Check a procedure against a bench; return the run to begin. Raises `FileMistakes`, `Refused`."""
    dry_run, unit = request.dry_run, request.unit
    operator, person = operator_of(request.operator, request.laboratory, needed=not dry_run)
    procedure_path, bench_file_path = find_procedure(str(request.procedure)), bench_path(request.bench)
    verdict = _judged(request, bench_file_path)
    loaded = load_procedure(procedure_path)
    plan = loaded.expand()
    file = load_bench(bench_file_path)
    problems = check(plan, file, dry_run=dry_run and not request.living)
    if unit is not None and (not unit.strip() or not unit.isprintable()):
        problems = [
            *problems,
            f"--unit {unit!r}: give a serial number of printable characters, such as 17-042",
        ]
    if problems:
        raise Refused("\n".join(problems))
    model = None if request.model is None else Path(request.model)
    if dry_run:
        simulated_truth(file, model)
    else:
        refuse_unfit(file, bench_file_path, request, away=is_away(request.answers, panel=request.panel))
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
    runs = runs_folder(request.runs)
    name = checked_name(request.name or _free_name(plan.name, runs))
    stated = file.unit_under_test
    serial = stated.serial if unit is None else unit.strip()
    manifest: Manifest = {
        "name": name,
        "created": utc_now().isoformat(),
        "dry_run": dry_run,
        "seed": request.seed if dry_run else None,
        "operator": operator,
        "procedure": str(procedure_path),
        "bench": str(bench_file_path),
        "bench_why": why_taken(request.bench),
        "plan_hash": plan.hash,
        "unit_under_test": {"type": stated.type, "serial": serial},
        "versions": versions(),
    }
    if person is not None:
        manifest["operator_person"] = person
    if request.living:
        manifest["living"] = True
    if foreign := foreign_drivers(file):
        manifest["devices"] = foreign
    if verdict:
        manifest["verdict"] = verdict
    notes = (*_other_unit(stated.serial, serial, file.name), *without_gravity(file))
    if request.until:
        from bench.services.until import noted_goals  # takes long to import

        notes += noted_goals(manifest, plan, file, request.until)
    despite = request.despite_check
    if request.check_block or despite is not None or (file.check_block is not None and not dry_run):
        from bench.services.check_before import checked_before  # takes long to import

        notes += checked_before(manifest, file, bench_file_path, runs, despite)
    return NewRun(runs / name, manifest, inputs, notes)


def _judged(request: RunRequest, bench: Path) -> VerdictAsked | None:
    """Return the limit and rule that replace those of the bench file; None for none. Raises `Refused`."""
    asked = VerdictOptions(request.limit, request.rule, request.guard_band)
    if asked == NOTHING_ASKED:
        return None
    judgement_of(load_bench(bench), asked)
    return asked.recorded()


def _other_unit(stated: str, serial: str, bench: str) -> tuple[str, ...]:
    if serial == stated:
        return ()
    return (
        message(f"this run is of unit {serial}, as --unit says; the bench file {bench} names unit {stated}"),
    )


def _included(procedure: Procedure) -> dict[str, bytes]:
    """Return the files that a procedure includes, by numbered name, because two may have the same name."""
    return {
        f"include-{n}-{path.name}": path.read_bytes() for n, path in enumerate(procedure.files[1:], start=1)
    }


def _free_name(procedure: str, runs: Path) -> str:
    """Return an unused name for a run: procedure and time, with a number if there is such a run already."""
    stem = re.sub(r"[^\w.+-]", "-", procedure)
    base = f"{stem}-{utc_now().astimezone():%Y%m%d-%H%M%S}"
    name, number = base, 2
    while (runs / name).exists():
        name, number = f"{base}-{number}", number + 1
    return name


def asker_of(
    run: Run, record: Record, history: History | None, out: Console, who: WishAuthor | None
) -> Asker | None:
    """Return the object that asks a person the questions of a run; None for a new run that asks nobody.

    A resumed run has a `history`, and a person is always asked. `who` answers at the terminal; with None, no
    question is asked there.
    """
    if not run.asks_somebody and history is None:
        return None
    last_s = 0.0 if history is None else history.events.last_s

    def tell(kind: EventType, data: dict[str, Any]) -> Event:
        event = record.append(kind, last_s, **data)
        if (text := sentence(event)) != event.type:
            out.print(text, style="bold yellow", highlight=False)
        return event

    terminal = None if who is None else TerminalPerson(sys.stdin, out, wishes=(), who=who)
    answers_before = history.progress.answers_heard if history is not None else 0
    return Asker(run.folder, record, tell, terminal=terminal, answers_read=answers_before)


@contextmanager
def started(
    request: RunRequest, out: Console, announce: Callable[[NewRun], None]
) -> Iterator[tuple[Run, Interrupts]]:
    """Call `announce` with a new run, carry it out, and yield it with the signal handler, still active."""
    away = is_away(request.answers, panel=request.panel)
    new = new_run(request)
    who = None if away else acting_at(TERMINAL, request.operator, request.laboratory)
    announce(new)
    with Interrupts() as interrupts, ExitStack() as results:
        with (
            logged_wire(request.wire_log) as wire,
            WishListener(ControlFile(new.folder)) as wishes,
            closing(new.record(interrupts.shield)) as record,
        ):
            run = Run(new.folder)
            asker = asker_of(run, record, None, out, who)
            with _to_be_resumed(record):
                agree_to_expired(run, record, asker)
            carry_out(run, record, out, results, wire=wire, interrupts=interrupts, wishes=wishes, asker=asker)
        yield Run(new.folder), interrupts


@contextmanager
def resumed(
    request: ResumeRequest, out: Console, announce: Callable[[Run], None]
) -> Iterator[tuple[Run, Interrupts]]:
    """Call `announce` with a run, carry out its rest, and yield it with the signal handler, still active.

    A finished run that lacks results is yielded at once.
    """
    away = is_away(request.answers, panel=request.panel)
    who = None if away else acting_at(TERMINAL, request.operator)
    by = resumer(os.environ.get(STARTED_FROM, TERMINAL), request.operator)
    run = unfinished_run(request.name, runs_folder(request.runs), results_too=True)
    refuse_missing_devices(run)
    announce(run)
    with Interrupts() as interrupts, ExitStack() as results:
        record, history = taken_up(run, interrupts.shield, results_too=True)
        with (
            closing(record),
            logged_wire(request.wire_log) as wire,
            WishListener(ControlFile(run.folder)) as wishes,
        ):
            if history.torn and not quiet.get():
                print(
                    message("note: the last line of the record was incomplete and was dropped"),
                    file=sys.stderr,
                )
            if history.state is not RunState.FINISHED:
                with knowing_effects_on_record(run):
                    refuse_unvalidated_resumption(run)
                asker = asker_of(run, record, history, out, who)
                with _to_be_resumed(record):
                    accept_changes(run, asker, out)
                carry_out(
                    run,
                    record,
                    out,
                    results,
                    history=history,
                    wire=wire,
                    interrupts=interrupts,
                    wishes=wishes,
                    asker=asker,
                    resumed_by=by,
                )
            else:
                run.results_due(results)
        yield Run(run.folder), interrupts


@contextmanager
def _to_be_resumed(record: Record) -> Iterator[None]:
    """Turn a signal in the context, at a question before the run, into `Refused` that says how to resume."""
    try:
        yield
    except KeyboardInterrupt:
        raise Refused(f"{stopped_by()}; {_kept(record)}") from None


def accept_changes(run: Run, asker: Asker | None, out: Console) -> None:
    """Print which input files changed since the run began; in a real run, a person must agree to continue."""
    changes = []
    for kind, copy in (("procedure", PROCEDURE), ("bench", BENCH)):
        original = Path(str(run.manifest.get(kind)))
        if original.is_file() and read_regular(original) != read_regular(run.folder / copy):
            changes.append(message(f"{original} was changed since the run began"))
    for change in changes:
        out.print(message(f"note: {change}; the run continues with the copy in its folder"))
    if changes and not run.simulated and asker is not None:
        text = message(f"{'; '.join(changes)}. Continue with the files of the start, without these changes?")
        agree(asker, Prompt(id="changed", kind=PromptKind.CONFIRM, text=text, action={"do": "answer"}))


def carry_out(
    run: Run,
    record: Record,
    out: Console,
    results: ExitStack | None = None,
    *,
    history: History | None = None,
    wire: WireLog | None = None,
    interrupts: Interrupts | None = None,
    wishes: WishListener | None = None,
    asker: Asker | None = None,
    resumed_by: WishAuthor = NOBODY_KNOWN,
) -> None:
    """Carry out a run to its end. If it stops early, raise `Refused` with the number of readings kept.

    Until `results` closes, the results of the run are shown as due. A resumed run has a `history`. `interrupts`
    handles signals during the run, `wishes` reads the requests (pause, skip, …) left in its folder, `asker` puts
    questions to a person. `resumed_by` is the person who resumed it.
    """
    signals = interrupts or Interrupts()
    run.results_due(results)
    wishes = wishes or WishListener(ControlFile(run.folder))
    resume = resume_point(run.plan, history) if history else None
    if history and resume and not run.simulated:
        resume = replace(resume, bench_s=_elapsed_s(history))
    with knowing_effects_on_record(run):
        bench = load_bench(run.folder / BENCH)
    watcher = watcher_of(run.plan, bench)
    if history:
        watcher.recall(history.taken[-MOST_RECALLED:], history.progress)
    if not quiet.get():
        where = message("simulated instruments") if run.simulated else message("the bench")
        steps = message(f"{run.plan.name}, {len(run.plan.steps)} steps, recorded in {run.folder}")
        out.print(message(f"run {run.name} {'continues' if resume else 'starts'} on {where}: {steps}"))
        out.print(
            message(f"procedure {run.manifest.get('procedure')}, bench file {run.manifest.get('bench')}")
        )
    try:
        with _assembly(run, bench, history, wire, out, signals.haste, asker) as (assembly, bar):
            bar.recall(history.progress.chosen if history else ())
            # a stopped dry run is resumed by a person, who can be asked
            decider = asker if history else None
            people = People(
                assembly.person, decider, asker, wishes, hold_signals=signals.hold, resumed_by=resumed_by
            )
            live = _live(run, bench, watcher, asker)
            recorder = Recorder(
                record,
                observers=(*assembly.observers, watcher.observe, *live, bar, RunLog(run.folder, run.plan)),
                progress=history.progress.copy() if history else PlanProgress(),
                clocks=None if run.simulated else _clock_watch(history, resume, assembly.clock),
            )
            Runner(
                run.plan,
                _setup(bench, assembly),
                people,
                recorder,
                watch=watcher.take,
                choose=_chooser(run, bench),
                certificates=_on_certificates(bench, simulated=run.simulated),
                on_settling=bar.settling,
                at_resumed_time=assembly.at_resumed_time,
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


def _live(run: Run, bench: BenchFile, watcher: EarlyWarning, asker: Asker | None) -> list[Observer]:
    """Return the observers that show a person the live signals with each question; none without a person."""
    if asker is None:
        return []
    shown = (lambda line: None) if asker.terminal is None else asker.terminal.show_live
    least_v_g = min(abs(scale) for scale in bench.unit_under_test.scale_factors.values)
    asker.live = LiveSignals(run.folder, run.plan, watcher, least_v_g, shown)
    return [asker.live.observe]


def _on_certificates(
    bench: BenchFile, *, simulated: bool
) -> Callable[[Mapping[str, str]], Sequence[str]] | None:
    """Return the function that maps serial numbers to remarks on certificates; None if a simulation has none."""
    if simulated and all(section.certificate is None for section in bench.instruments.all()):
        return None
    return lambda serials: remarks(bench, None if simulated else serials)


def _chooser(run: Run, bench: BenchFile) -> Callable[[int, PlanProgress], dict[str, Any] | None]:
    """Return the chooser of settings of a run with goals; for any other run, it chooses nothing."""
    if not run.manifest.get("until"):
        return lambda index, progress: None
    from bench.services.until import Until  # takes long to import

    return Until(run, bench)


def _setup(bench: BenchFile, assembly: Assembly) -> BenchSetup:
    feed, supply, chamber = (
        bench.unit_under_test.supply,
        bench.instruments.power_supply,
        bench.instruments.chamber,
    )
    limits = bench.unit_under_test.temperature
    return BenchSetup(
        assembly.instruments,
        assembly.clock,
        bench.voltmeter_range_v,
        block_limits_c=(limits.minimum, limits.maximum),
        least_samples=bench.least_samples,
        setting_u_rad=bench.stand_distributions()["setting_error"].u,
        slow_chamber_s=chamber.slow_after if isinstance(chamber, ControlledChamberForm) else SLOW_AFTER_S,
        aside=assembly.aside,
        mistake=(lambda: None) if assembly.simulated is None else assembly.simulated.failure,
        feeding=None if feed is None or supply is None else Feeding(feed, supply.limits),
    )


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
    """Yield the assembled bench and its progress bar, which pauses while a question is asked at the terminal."""
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
    """Return the present bench time (s) of a real bench: that of the last event plus civil time since."""
    if (last := history.events.last) is None:
        return 0.0
    return last.bench_s + max(0.0, (utc_now() - datetime.fromisoformat(last.time)).total_seconds())


def _clock_watch(history: History | None, resume: ResumePoint | None, clock: Clock) -> ClockWatch:
    """Return the watch of the computer's clock, which may have been set back while the run was stopped."""
    last = None
    if resume and history and (event := history.events.last) is not None:
        last = datetime.fromisoformat(event.time), clock.now_s() - (resume.bench_s - event.bench_s)
    return ClockWatch(utc_now, clock.now_s, last)


def _refuse_renamed(record: Record) -> None:
    """Raise `Refused` if the folder of a finished run was renamed or moved, as results cannot be written there."""
    place = record.whereabouts()
    if place == record.folder:
        return
    now = message(f"it is {place} now") if place else message("it is no longer beside the other runs")
    again = as_typed(place or "FOLDER") + devices_to_type(place)
    raise Refused(
        f"{record.folder}: the run is finished, but its folder was moved ({now}); "
        f"'bench resume {again}' computes its results there"
    )


def _recorded(record: Record) -> str:
    """Return a sentence on how many readings are kept, and where; the folder may have been renamed meanwhile."""
    place = record.whereabouts()
    if place is None:
        return message(f"{record.folder} was moved or deleted during the run")
    try:
        done = len(read_history(place).readings)
    except RecordError as error:
        return str(error)
    return message(f"{done} reading{' is' if done == 1 else 's are'} kept in {place}")


def _kept(record: Record) -> str:
    place, kept = record.whereabouts(), _recorded(record)
    if place is None:
        return kept
    resume = message(f"resume with 'bench resume {resume_to_type(place)}'")
    return f"{kept}; {resume}"


# --- runs that another program has left -------------------------------------------------------------


def unfinished_run(name: str | None, runs: Path, *, results_too: bool = False) -> Run:
    """Return the run called `name`; without a name, the latest run that can be resumed.

    With `results_too` and no such run, return the latest finished run that lacks results. Raises `Refused` if
    there is none, and for an imported run.
    """
    if name is None:
        digests = Digests(runs)
        states = [(run, _idle_at(run, digests)) for run in all_runs(runs)]
        digests.save()
        waiting = [run for run, state in states if state is not None and state not in ENDED]
        if results_too and not waiting:
            waiting = [run for run, state in states if _lacks_results(run, state)]
        if not waiting:
            raise Refused(f"{runs}: no unfinished run there; name a run, or its folder with --runs")
        return waiting[-1]
    found = find_run(name, runs)
    if found.imported:
        raise Refused(
            f"{found.name}: the run was imported from a readings file and cannot be resumed; evaluate "
            f"it with 'bench calibrate {name_to_type(found.folder)}'"
        )
    return found


def taken_up(
    run: Run,
    shield: Callable[[], AbstractContextManager[None]] = nullcontext,
    *,
    results_too: bool = False,
) -> tuple[Record, History]:
    """Open the record of an unfinished run to continue it. Raises `Refused` for an ended run.

    With `results_too`, a finished run that lacks results is accepted, too.
    """
    record, history = Record.reopen(run.folder, utc_now, shield)
    if history.state in ENDED and not (results_too and _lacks_results(run, history.state)):
        record.close()
        raise Refused(
            f"{run.name}: the run is {history.state} and cannot be resumed; see its results with "
            f"'bench show {name_to_type(run.folder)}', or start a new run"
        )
    return record, history


def _lacks_results(run: Run, state: RunState | None) -> bool:
    return state is RunState.FINISHED and run.results_missing


def _idle_at(run: Run, digests: Digests) -> RunState | None:
    """Return the state of a run that no program is carrying out; None for a run in progress or imported."""
    try:
        state = None if run.imported else digests.of(run).state
    except (RecordError, ValueError):
        return None
    return None if is_being_written(run.folder) else state


def refuse_missing_devices(run: Run) -> None:
    """Raise `Refused` if a driver that the run used is not installed here."""
    came_from = run.manifest.get("devices", {})
    missing = [
        message(f"the driver '{name}'") + (f" (it came from {came_from[name]})" if name in came_from else "")
        for name in missing_drivers(run.folder / BENCH)
    ]
    if missing:
        raise Refused(
            f"{run.name} needs {' and '.join(missing)}, which this computer lacks; name its folder with "
            "--devices or BENCH_DEVICES, or install its distribution"
        )


def give_up(run: Run, who: WishAuthor = NOBODY_KNOWN) -> tuple[str, ...]:
    """End an unfinished run for good; return sentences on what remains. Raises `Refused`, `RecordError`."""
    record, history = taken_up(run)
    try:
        record.append(EventType.RUN_ABORTED, history.events.last_s, **who.to_json())
    finally:
        record.close()
    if history.progress.power in {"on", "found on", "fault"}:
        return ("the supply of the block stayed on when the run stopped; switch it off",)
    return ()
