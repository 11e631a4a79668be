"""A run carried out: the bench put together, the plan executed and watched, the result drawn from it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from typing import Any

from rich.console import Console

from bench.analysis.calibration import CalibrationError
from bench.assembly.served import Assembly, dry_bench, real_bench
from bench.cli import CommandError, analyse, printing
from bench.cli.source import Request, Source, load_sources, to_text, write_json, write_whole
from bench.files.bench.file import BenchFile, load_bench
from bench.files.model import load_model
from bench.model import ForwardModel
from bench.procedure.plan import Plan, Read
from bench.run.control import ControlFile
from bench.run.events import EventType
from bench.run.folder import BENCH, MODEL, Run
from bench.run.log import RunLog
from bench.run.record import History, Record, RecordError
from bench.run.resume import Progress, resume_point
from bench.run.runner import RunAborted, Runner, Watch
from bench.run.terminal import ProgressBar, TerminalPerson
from bench.run.watch.early_warning import EarlyWarning
from drivers.clock import utc_now
from drivers.interfaces import BenchError
from drivers.wire.log import WireLog


def carry_out(
    run: Run, record: Record, history: History | None, wire: WireLog | None, target: str | None = None
) -> None:
    """Run to the end; say what is kept when it stops before. `history` is that of a run to be resumed."""
    resume = resume_point(run.plan, history) if history else None
    if history and resume and not run.simulated:
        resume = replace(resume, bench_s=_elapsed_s(history))
    bench = load_bench(run.folder / BENCH)
    where = "simulated instruments" if run.simulated else "the bench"
    out = printing.console(json=target)
    verb = "goes on" if resume else "starts"
    out.print(
        f"run {run.name} {verb} on {where}: {run.plan.name}, {len(run.plan.steps)} steps, "
        f"recorded in {run.folder}"
    )
    out.print(f"procedure {run.manifest.get('procedure')}, bench file {run.manifest.get('bench')}")
    try:
        with _assembly(run, bench, history, wire, out) as (assembly, bar):
            Runner(
                plan=run.plan,
                instruments=assembly.instruments,
                person=assembly.person,
                clock=assembly.clock,
                record=record,
                range_v=bench.voltmeter_range_v,
                observers=(*assembly.observers, bar, RunLog(run.folder, run.plan)),
                at_resumed_time=assembly.at_resumed_time,
                controls=ControlFile(run.folder),
                progress=Progress.of(history) if history else Progress(),
                watch=_watch(run, bench, history),
                block_limits_c=(
                    bench.unit_under_test.temperature.minimum,
                    bench.unit_under_test.temperature.maximum,
                ),
                least_samples=bench.least_samples,
                on_settling=bar.settling,
            ).run(resume)
    except RunAborted as why:
        raise CommandError(f"aborted{': ' if str(why) else ''}{why}; {_recorded(run)}") from None
    except KeyboardInterrupt:
        raise CommandError(f"interrupted; {_kept(run)}") from None
    except (BenchError, RecordError) as error:
        raise CommandError(f"{error}; {_kept(run)}") from error
    finally:
        record.close()


@contextmanager
def _assembly(
    run: Run, bench: BenchFile, history: History | None, wire: WireLog | None, out: Console
) -> Iterator[tuple[Assembly, ProgressBar]]:
    """Put the bench together with the progress bar; a terminal person pauses the bar while it asks."""
    bar = ProgressBar(run.plan, out, step_durations(run.plan))
    with bar:
        if run.simulated:
            taken = [event.reading for event in (history.events if history else ()) if event.reading]
            seed = run.manifest["seed"] or 0
            with dry_bench(bench, truth(run, bench), seed, wire, plan=run.plan, taken=taken) as assembly:
                yield assembly, bar
        else:
            yield real_bench(bench, TerminalPerson(sys.stdin, out, bar.pause, bar.go_on), wire), bar


def _watch(run: Run, bench: BenchFile, history: History | None) -> Watch:
    """Compare each reading with what the model expects from those before it, recorded ones included."""
    readings = sum(isinstance(step, Read) for step in run.plan.steps)
    warning = EarlyWarning(
        bench.unit_under_test.scale_factors.values,
        ForwardModel(bench.installation_models()),
        {name: distribution.u for name, distribution in bench.stand_distributions().items()},
        readings=readings,
    )

    for event in history.events if history else ():
        if event.type == EventType.REMOUNTED:
            warning.remounted()
        if (reading := event.reading) is not None:
            warning.take(reading)
    return warning.take


def truth(run: Run, bench: BenchFile) -> ForwardModel:
    """Return the model that the simulated world obeys: effects of the bench file and of the model file."""
    effects = bench.applied_effects()
    if (run.folder / MODEL).is_file():
        effects += load_model(run.folder / MODEL).applied_effects()
    return ForwardModel(bench.installation_models(), effects)


def step_durations(plan: Plan) -> list[float]:
    """Expected bench time of each step, s."""
    return [plan.step_duration_s(step) for step in plan.steps]


def _elapsed_s(history: History) -> float:
    """Bench time now: on a real bench the time between two programs has passed as well."""
    if not history.events:
        return 0.0
    last = history.events[-1]
    return last.bench_s + max(0.0, (utc_now() - datetime.fromisoformat(last.time)).total_seconds())


def _recorded(run: Run) -> str:
    done = sum(event.reading is not None for event in Run(run.folder).history.events)
    return f"{done} readings are kept in {run.folder}"


def _kept(run: Run) -> str:
    return f"{_recorded(run)}; go on with 'bench resume {run.name}'"


def conclude(run: Run, target: str | None = None) -> int:
    """Calibrate, verify and report a finished run; 1 when the verification failed.

    `target` is where the whole result goes as JSON: null stands for a calibration or verdict that is not.

    A procedure need not be a calibration: where its readings do not make one, that is said and no mistake.
    """
    request = Request(
        sources=[str(run.folder)],
        runs=run.folder.parent,
        bench=None,
        model=None,
        g_m_s2=None,
        out=None,
        skip_bad_rows=False,
    )
    source = analyse.told_of_temperatures(*load_sources(request))
    try:
        return _draw(run, source, target)
    except OSError as error:
        raise CommandError(
            f"{error.filename}: cannot be written ({error.strerror}); the run is finished and kept: free the disk, "
            f"then 'bench report {run.name}' makes it again"
        ) from error


def _draw(run: Run, source: Source, target: str | None) -> int:
    """Draw the results from a finished run and write them into its folder. Raises `OSError`."""
    out = printing.console(json=target)
    result: dict[str, Any] = {
        "run": run.name,
        "folder": str(run.folder),
        "calibration": None,
        "verification": None,
    }
    try:
        calibration = analyse.calibration_of(source)
    except CalibrationError as reason:
        out.print(f"the run is finished; no calibration from it: {reason}")
        write_json([result], target)
        return 0
    file = source.output("calibrate", ".json")
    printing.calibration(source, calibration, analyse.doubts_of(source, calibration), file, out)
    result["calibration"] = analyse.calibration_json(source, calibration)
    write_whole(file, to_text(result["calibration"]))
    verdict = analyse.write_report(source, calibration, out)
    if verdict is None:
        out.print("no verification points in this procedure: no verdict")
    else:
        file = source.output("verify", ".json")
        result["verification"] = verdict.to_json()
        write_whole(file, to_text(result["verification"]))
        printing.verification(source, verdict, file, out)
    write_json([result], target)
    return 0 if verdict is None or verdict.passed else 1
