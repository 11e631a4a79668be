"""run, resume, abort: a procedure carried out on a bench, recorded, then calibrated and reported."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.bench_file import BenchFile, load_bench
from bench.calibration import CalibrationError
from bench.commands import CommandError, analyse, printing
from bench.commands.provenance import versions
from bench.commands.source import Request as AnalysisRequest
from bench.commands.source import bench_path, load_sources
from bench.compose import Assembly, dry_bench, real_bench
from bench.interrupts import Interrupts
from bench.model import ForwardModel
from bench.model_file import load_model
from bench.plan import Plan
from bench.procedure import check, load_procedure
from bench.record import Record, sha256
from bench.resume import ResumePoint, resume_point
from bench.run_folder import BENCH, MODEL, PLAN, PROCEDURE, Run, all_runs, find_run
from bench.runner import Runner
from bench.shipped import find_procedure
from bench.terminal import ProgressBar, TerminalPerson
from drivers.clock import utc_now

UNFINISHED = frozenset({"running", "failed", "interrupted", "empty"})


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


def run(request: Request) -> int:
    """Carry out `bench run`."""
    if request.bench is None and not request.dry_run:
        raise CommandError(
            "a run on real instruments needs a bench file: say --bench FILE (or set BENCH_FILE), "
            "or try it first with --dry-run"
        )
    if request.model is not None and not request.dry_run:
        raise CommandError("--model says what the simulated bench contains; it goes with --dry-run")
    procedure_path, bench_file_path = find_procedure(request.procedure), bench_path(request.bench)
    plan = load_procedure(procedure_path).expand()
    bench = load_bench(bench_file_path)
    problems = check(plan, bench, dry_run=request.dry_run)
    if problems:
        raise CommandError("\n".join(problems))
    inputs = {
        PLAN: json.dumps(plan.to_json(), indent=1).encode(),
        PROCEDURE: procedure_path.read_bytes(),
        BENCH: bench_file_path.read_bytes(),
    }
    if request.model is not None:
        load_model(request.model)
        inputs[MODEL] = request.model.read_bytes()
    name = request.name or free_name(plan.name, request.runs)
    if not re.fullmatch(r"[\w.+-][\w.+ -]*", name):
        raise CommandError(f"{name!r}: a run's name is letters, digits, dots, dashes and blanks")
    manifest = {
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
    with Interrupts() as interrupts:
        record = Record.create(request.runs / name, manifest, inputs, utc_now, interrupts.shield)
        _carry_out(Run(request.runs / name), record, None)
    return _conclude(Run(request.runs / name))


def resume(name: str | None, runs: Path) -> int:
    """Carry out `bench resume`."""
    found = _unfinished(name, runs)
    with Interrupts() as interrupts:
        record, history = Record.reopen(found.folder, utc_now, interrupts.shield)
        if history.torn:
            print("note: the last line of the record was half written and is dropped", file=sys.stderr)
        _carry_out(found, record, resume_point(found.plan, history))
    return _conclude(Run(found.folder))


def abort(name: str | None, runs: Path) -> int:
    """Carry out `bench abort`."""
    found = _unfinished(name, runs)
    record, history = Record.reopen(found.folder, utc_now)
    record.append("run_aborted", history.events[-1].bench_s if history.events else 0.0)
    record.close()
    printing.console().print(f"{found.name}: aborted; its record is kept in {found.folder}")
    return 0


def _unfinished(name: str | None, runs: Path) -> Run:
    if name is None:
        waiting = [run for run in all_runs(runs) if run.history.state in UNFINISHED]
        if not waiting:
            raise CommandError(f"{runs}: no unfinished run there")
        return waiting[-1]
    found = find_run(name, runs)
    if found.history.state not in UNFINISHED:
        raise CommandError(f"{found.name}: nothing to do, the run is {found.history.state}")
    return found


def free_name(procedure: str, runs: Path) -> str:
    """Return a name that no run has: the procedure and the time, and a number where that is taken."""
    base = f"{procedure}-{utc_now().astimezone():%Y%m%d-%H%M%S}"
    name, number = base, 2
    while (runs / name).exists():
        name, number = f"{base}-{number}", number + 1
    return name


def _carry_out(run: Run, record: Record, resume: ResumePoint | None) -> None:
    """Run to the end; say what is kept when it stops before."""
    bench = load_bench(run.folder / BENCH)
    where = "simulated instruments" if run.simulated else "the bench"
    out = printing.console()
    verb = "goes on" if resume else "starts"
    out.print(f"run {run.name} {verb} on {where}: {len(run.plan.steps)} steps, recorded in {run.folder}")
    try:
        with _assembly(run, bench) as (assembly, bar):
            Runner(
                plan=run.plan,
                instruments=assembly.instruments,
                person=assembly.person,
                clock=assembly.clock,
                record=record,
                range_v=bench.voltmeter_range_v,
                observers=(*assembly.observers, bar),
                at_resumed_time=assembly.at_resumed_time,
            ).run(resume)
    except KeyboardInterrupt:
        raise CommandError(f"interrupted; {_kept(run)}") from None
    except Exception:
        print(f"bench: {_kept(run)}", file=sys.stderr)
        raise
    finally:
        record.close()


@contextmanager
def _assembly(run: Run, bench: BenchFile) -> Iterator[tuple[Assembly, ProgressBar]]:
    """Put the bench together with the progress bar; a terminal person pauses the bar while it asks."""
    out = printing.console()
    bar = ProgressBar(run.plan, out, step_durations(run.plan))
    with bar:
        if run.simulated:
            with dry_bench(bench, truth(run, bench), int(run.manifest["seed"])) as assembly:
                yield assembly, bar
        else:
            yield real_bench(bench, TerminalPerson(sys.stdin, out, bar.pause, bar.go_on)), bar


def truth(run: Run, bench: BenchFile) -> ForwardModel:
    """Return the model that the simulated world obeys: effects of the bench file and of the model file."""
    effects = bench.applied_effects()
    if (run.folder / MODEL).is_file():
        effects += load_model(run.folder / MODEL).applied_effects()
    return ForwardModel(bench.installation_models(), effects)


def step_durations(plan: Plan) -> list[float]:
    """Expected bench time of each step, s."""
    return [plan.step_duration_s(step) for step in plan.steps]


def _kept(run: Run) -> str:
    done = sum(1 for e in Run(run.folder).history.events if e.type == "step_done" and "reading" in e.data)
    return f"{done} readings are kept in {run.folder}; go on with 'bench resume {run.name}'"


def _conclude(run: Run) -> int:
    """Calibrate, verify and report a finished run; 1 when the verification failed.

    A procedure need not be a calibration: where its readings do not make one, that is said and no mistake.
    """
    request = AnalysisRequest([str(run.folder)], run.folder.parent, None, None, None, None, False)
    (source,) = load_sources(request)
    try:
        calibration = analyse.calibration_of(source)
    except CalibrationError as reason:
        printing.console().print(f"the run is finished; no calibration from it: {reason}")
        return 0
    file = source.output("calibrate", ".json")
    file.write_text(json.dumps(calibration.to_json(), indent=1) + "\n", encoding="utf-8")
    printing.calibration(source, calibration, file)
    verdict = analyse.write_report(source)
    if verdict is None:
        printing.console().print("no verification points in this procedure: no verdict")
        return 0
    file = source.output("verify", ".json")
    file.write_text(json.dumps(verdict.to_json(), indent=1) + "\n", encoding="utf-8")
    printing.verification(run.name, verdict, file)
    return 0 if verdict.passed else 1


__all__ = ["Request", "abort", "resume", "run", "sha256"]
