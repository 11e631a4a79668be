"""runs, show, export, import: the run records."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from rich.table import Table

from bench.cli import printing
from bench.cli.provenance import versions
from bench.cli.source import Request, bench_path, load_sources, write_json
from bench.files.bench.file import load_bench
from bench.readings.csv import format_csv, read_csv
from bench.run.folder import BENCH, IMPORTED, Run, all_runs, checked_name, find_run
from bench.run.record import Manifest, Record, RecordError, is_being_written
from bench.run.resume import resume_point
from bench.run.states import ENDED, RunState
from bench.run.terminal import duration
from drivers.clock import utc_now


def runs(folder: Path, target: str | None) -> int:
    """Carry out `bench runs`."""
    found = all_runs(folder)
    write_json([{"runs": [_summary(run) for run in found]}], target)
    if target == "-":
        return 0
    out = printing.console()
    if not found:
        out.print(f"{folder}: no runs there")
        return 0
    table = Table(box=None, pad_edge=False)
    for heading in ("run", "begun", "instruments", "state", "readings", "to go on"):
        table.add_column(heading, justify="right" if heading == "readings" else "left")
    for s in map(_summary, found):
        table.add_row(
            str(s["name"]),
            str(s["created"])[:19].replace("T", " "),
            str(s["instruments"]),
            str(s["state"]),
            str(s["readings"]),
            str(s["to_go_on"]),
        )
    out.print(table)
    return 0


def _summary(run: Run) -> dict[str, object]:
    """Return a row of the list; a run that cannot be read is one as well, with the reason."""
    try:
        state, to_go_on = _told_state(run)
        count = _count(run)
    except (RecordError, ValueError, TypeError, KeyError) as reason:
        return {
            "name": run.name,
            "created": "",
            "instruments": "-",
            "state": f"damaged: {reason}",
            "readings": 0,
            "to_go_on": "",
        }
    return {
        "name": run.name,
        "created": run.created,
        "instruments": "simulated" if run.simulated else ("-" if state == "imported" else "real"),
        "state": state,
        "readings": count,
        "to_go_on": to_go_on,
    }


def _told_state(run: Run) -> tuple[str, str]:
    """Return the state of a run as it is told, and the command that goes on with it."""
    if run.history.problems:
        return "damaged", f"bench show {run.name} --verify"
    if run.imported:
        return "imported", ""
    state = run.history.state
    if state in ENDED:
        return state.value, ""
    if is_being_written(run.folder):
        return state.value, ""
    alive = {RunState.READY: "not begun", RunState.RUNNING: "unfinished", RunState.PAUSED: "unfinished"}
    return alive.get(state, state.value), f"bench resume {run.name}"


def _count(run: Run) -> int:
    if run.imported:
        return int(run.manifest["readings"])
    return len({e.data["step"] for e in run.history.events if e.type == "step_done" and "reading" in e.data})


def show(name: str, folder: Path, target: str | None, *, check: bool) -> int:
    """Carry out `bench show`; 1 when the record was changed."""
    run = find_run(name, folder)
    problems = list(run.history.problems)
    write_json([{**_summary(run), "manifest": run.manifest, "problems": problems}], target)
    if target == "-":
        return 1 if problems else 0
    out = printing.console()
    for key, value in {**_summary(run), **run.manifest}.items():
        if value not in ("", None):
            out.print(f"{key.replace('_', ' ')}: {_told(value)}")
    if check:
        events = len(run.history.events)
        out.print(
            f"record: {events} events, " + ("; ".join(problems) if problems else "chain of hashes whole")
        )
        if run.history.torn:
            out.print("record: the last line is half written; 'bench resume' drops it")
    else:
        _show_events(run)
    return 1 if problems else 0


def _told(value: object) -> str:
    """Return a value of the manifest as text; what it holds by name as a list."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {part}" for name, part in value.items())
    return str(value)


def _show_events(run: Run) -> None:
    out = printing.console()
    if run.imported:
        return
    steps = run.plan.steps
    for event in run.history.events:
        if event.type == "step_started":
            continue
        text = event.type
        if "step" in event.data and event.type == "step_done":
            text = steps[int(event.data["step"])].describe()
        reading = event.data.get("reading")
        if reading:
            text += "  " + "  ".join(f"{value:+.6f} {reading['unit']}" for value in reading["mean"])
        if "error" in event.data:
            text += f": {event.data['error']}"
        out.print(f"{event.number:5d}  {duration(event.bench_s):>11}  {text}")
    point = resume_point(run.plan, run.history)
    if point.step < len(steps):
        out.print(f"next: step {point.step + 1}, {steps[point.step].describe()}")


def export(name: str, folder: Path, target: str) -> int:
    """Carry out `bench export`."""
    (source,) = load_sources(Request([name], folder, None, None, None, None, False))
    text = format_csv(source.readings)
    if target == "-":
        sys.stdout.write(text)
    else:
        Path(target).write_text(text, encoding="utf-8", newline="")
        printing.console().print(f"{len(source.readings)} readings written to {target}")
    return 0


def import_file(file: Path, name: str | None, bench: str | None, folder: Path) -> int:
    """Carry out `bench import`: the file is checked, then kept in a run folder as it came."""
    path = bench_path(bench)
    readings = read_csv(file, load_bench(path).installation_models())
    run = Run(folder / checked_name(name or re.sub(r"[^\w.+-]", "-", file.stem)))
    manifest: Manifest = {
        "name": run.name,
        "created": utc_now().isoformat(),
        "imported": str(file),
        "readings": len(readings),
        "bench": str(path),
        "versions": versions(),
    }
    inputs = {IMPORTED: file.read_bytes(), BENCH: path.read_bytes()}
    record = Record.create(run.folder, manifest, inputs, utc_now)
    record.append("imported", 0.0, file=str(file), readings=len(readings))
    record.close()
    printing.console().print(f"{len(readings)} readings imported as run {run.name} in {run.folder}")
    return 0
