"""A run started, gone on with or diagnosed, by programs of their own that live on without the panel."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from bench.panel.access.kept import private_folder
from bench.panel.access.people import Refusal
from bench.panel.folder import RunsFolder
from bench.panel.launching.detached import Started, start, wait_until
from bench.panel.launching.wish import Wanted, WishFolder
from bench.run.folder import Run, checked_name
from bench.run.manifest import EVENTS, RecordError
from bench.run.record import is_being_written
from drivers.clock import utc_now

ANSWERS: Final = "--answers=folder"
OUTPUT: Final = "panel.log"
"""What the program that carries out a run writes for a terminal, in the run's folder."""


def name_of(wanted: Wanted, runs: RunsFolder) -> str:
    """Return the name of a run to be started, one that no run has. Raises `Refusal`."""
    stem = re.sub(r"[^\w.+-]", "-", Path(wanted.procedure).stem)
    name = wanted.name or f"{stem}-{utc_now().astimezone():%Y%m%d-%H%M%S}"
    try:
        checked_name(name)
    except RecordError as mistake:
        raise Refusal(400, str(mistake)) from mistake
    if (runs.path / name).exists():
        raise Refusal(409, f"there is a run {name} already; choose another name")
    return name


def start_run(wish: WishFolder, runs: RunsFolder) -> Run:
    """Start a wished run in a process of its own and return it once its record has begun. Raises `Refusal`."""
    wanted = wish.wanted()
    if wanted.changed():
        raise Refusal(409, "procedure or bench file was changed since they were checked; check them again")
    name = name_of(wanted, runs)
    wish.mark_started(name)
    arguments = [
        "run", wanted.procedure, f"--bench={wanted.bench}", f"--name={name}", f"--runs={runs.path.absolute()}",
        f"--operator={wanted.operator}", ANSWERS,
    ]  # fmt: skip
    arguments += [f"--unit={wanted.unit}"] if wanted.unit else []
    arguments += ["--dry-run"] if wanted.practice else []
    folder = runs.path / name
    try:
        started = start(arguments, wish.path / OUTPUT)
        begun = wait_until((folder / EVENTS).exists, started)
    except BaseException:
        wish.unmark_started()
        raise
    if not begun:
        raise Refusal(409, "it takes long to begin; look among the runs in a moment")
    return runs.run(name)


def resume_run(run: Run) -> None:
    """Go on with a run, or make its results, in a process of its own, which has begun when this returns.

    Raises `Refusal`.
    """
    if is_being_written(run.folder):
        raise Refusal(409, "a program is carrying out this run now")
    started = start(["resume", str(run.folder.absolute()), f"--runs={_runs(run)}", ANSWERS], _output(run))
    wait_until(lambda: is_being_written(run.folder) or not run.results_missing, started)


def diagnose(run: Run) -> Started:
    """Begin to diagnose a run in a process of its own."""
    target = run.folder.absolute()
    return start(
        ["diagnose", str(target), f"--runs={_runs(run)}", f"--json={target / 'diagnose.json'}"], _output(run)
    )


def _output(run: Run) -> Path:
    folder = private_folder(run.folder.parent / ".panel" / "output")
    return folder / f"{run.name}.log"


def _runs(run: Run) -> Path:
    return run.folder.parent.absolute()
