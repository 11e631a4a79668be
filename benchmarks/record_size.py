"""What a record of 100,000 events costs: to go on with it, to check it, and to list 1,000 of them.

The events are those of a run of turns and readings of ten samples a channel, written as the runner writes them.
Each figure is the CPU time and the peak of memory of a process of its own, with its start but for the bare work:

    python -m benchmarks.record_size
"""

from __future__ import annotations

import hashlib
import json
import math
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Final
from unittest.mock import patch

import numpy as np

from bench.base.arrays import Floats
from bench.config.procedure.steps import Mount, Read, Turn
from bench.readings.reading import Reading
from bench.run.events import Mounted, Result, Turned, result_to_json
from bench.run.samples import describe
from benchmarks.campaign import arguments
from drivers.interfaces import CHANNELS

EVENTS: Final = 100_000
RUNS: Final = 1_000
LIMIT_S, LIMIT_MB, LIMIT_RATIO, LIMIT_LIST_S = 5.0, 300.0, 3.0, 2.0
SAMPLES: Final = 10

PROCEDURE: Final = """\
procedure: long
reading: {samples: 10, nplc: 10}
steps:
  - installation:
      label: 1
      steps:
        - repeat: {times: %d, steps: [turn: {angles: {from: 0 deg, step: 45 deg, count: 9}}]}
"""
STEPS_OF_A_PASS: Final = 18


def make_record(runs: Path, events: int) -> Path:
    """Write a run that was interrupted after so many events, of which some steps are left; return its folder."""
    from bench.services.execution import new_run
    from bench.services.requests.measuring import RunRequest

    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "long.yaml"
        file.write_text(PROCEDURE % (events // 2 // STEPS_OF_A_PASS + 10), encoding="utf-8")
        new = new_run(RunRequest(str(file), "paper-stand", runs=runs, dry_run=True, seed=1, name="long"))
    record = new.record()
    with patch("os.fsync"):  # what a disk takes is none of these figures
        _write_events(new.folder, record.append, events)
    record.close()
    return new.folder


def _write_events(folder: Path, append: Callable[..., object], events: int) -> None:
    from bench.run.folder import Run

    rng = np.random.default_rng(1)
    signals = _signals(folder)
    append("run_started", 0.0, step=0, instruments={})
    angle_deg, bench_s = 0.0, 0.0
    for index, step in enumerate(Run(folder).plan.steps[: (events - 2) // 2]):
        begun = {"step": index, "key": step.key, "attempt": 1}
        bench_s = 10.0 * index
        append("step_started", bench_s, **begun)
        result: Result | None = None
        if isinstance(step, Mount):
            result = Mounted(None)
        elif isinstance(step, Turn):
            angle_deg = math.degrees(step.target_rad)
            result = Turned(angle_deg, angle_deg)
        elif isinstance(step, Read):
            samples = signals[round(angle_deg)] + 1e-4 * rng.standard_normal((SAMPLES, 3))
            result = _reading(step, angle_deg, bench_s, samples)
        append("step_done", bench_s + 5.0, **begun, **result_to_json(result))
    append("run_interrupted", bench_s + 6.0)


def _signals(folder: Path) -> dict[int, Floats]:
    """The signals of the stated block at the angles of a pass, V, by angle in degrees."""
    from bench.config.bench_file.file import load_recorded_bench
    from bench.model import ForwardModel
    from bench.readings.table import make_readings

    bench = load_recorded_bench(folder / "bench.yaml")
    degrees = np.arange(9) * 45.0
    rows = make_readings(
        ["1"] * 9, [1] * 9, list(range(1, 10)), np.radians(degrees), np.zeros((9, 3)), source="angles"
    ).conditions()
    at = ForwardModel(bench.installation_models()).readings(bench.simulated_block(), rows, np.zeros((1, 5)))
    return {round(angle): signal for angle, signal in zip(degrees, at, strict=True)}


def _reading(step: Read, angle_deg: float, time_s: float, samples: Floats) -> Reading:
    """A reading of samples (n, 3), V, with all that a bench records of one."""
    columns = dict(zip(CHANNELS, samples.T.tolist(), strict=True))
    found = [describe(columns)[channel] for channel in CHANNELS]
    return Reading(
        installation="1",
        series=1,
        pass_number=step.pass_number,
        point=step.point,
        target_deg=angle_deg,
        angle_deg=angle_deg,
        direction=1,
        time_s=time_s,
        temperature_c=20.0,
        mean=tuple(of.mean for of in found),
        sd=tuple(of.sd for of in found),
        samples_taken=SAMPLES,
        samples=columns,
        drift=tuple(of.drift for of in found),
        drift_p=tuple(of.drift_p for of in found),
        scan_order="xyz",
    )


# --- what is measured, each in a process of its own -------------------------------------------------


def bare(folder: Path) -> None:
    """Parse and hash every line, and nothing else."""
    with (folder / "events.jsonl").open("rb") as file:
        for line in file:
            json.loads(line)
            hashlib.sha256(line).hexdigest()


def started(folder: Path) -> None:
    """Import what going on with a run imports."""


def verified(folder: Path) -> None:
    """`bench show RUN --verify`."""
    command("show", folder.name, "--verify", "--runs", str(folder.parent))


def resumed(folder: Path) -> None:
    """`bench resume RUN`, up to its first step."""
    from bench.run.workbench import Workbench

    def begun(*given: object) -> None:
        raise SystemExit

    with patch.object(Workbench, "execute", begun), patch.object(Workbench, "still_mounted", begun):
        command("resume", folder.name, "--runs", str(folder.parent))


def listed(folder: Path) -> None:
    """`bench runs`."""
    command("runs", "--runs", str(folder.parent))


def command(*arguments: str) -> None:
    """Carry out a command, silently."""
    from bench.cli.app import main

    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), suppress(SystemExit):  # noqa: PTH123
        main(list(arguments))


def cost(work: Callable[[Path], None], folder: Path) -> tuple[float, float]:
    """Return CPU time in s and peak memory in MB of a process that does this alone."""
    context = multiprocessing.get_context("spawn")
    told: multiprocessing.Queue[tuple[float, float]] = context.Queue()
    process = context.Process(target=_measured, args=(work, folder, told))
    process.start()
    found = told.get()
    process.join()
    return found


def _measured(
    work: Callable[[Path], None], folder: Path, told: multiprocessing.Queue[tuple[float, float]]
) -> None:
    begun_s = time.process_time() if work is bare else 0.0
    try:
        work(folder)
    finally:
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        told.put((time.process_time() - begun_s, peak_mb))


def main() -> None:
    options = arguments(__doc__, events=EVENTS, runs=RUNS)
    with tempfile.TemporaryDirectory(dir=Path()) as name:
        os.environ["XDG_CACHE_HOME"] = str(Path(name) / "cache")
        folder = Path(name) / "runs" / "long"
        # in a process of its own as well: a child begins with the peak of its parent's memory
        maker = multiprocessing.get_context("spawn").Process(
            target=make_record, args=(folder.parent, options.events)
        )
        maker.start()
        maker.join()
        parsed = cost(bare, folder)
        tell("bare parsing and hashing", parsed, "")
        tell("the program's start", cost(started, folder), "")
        check = cost(verified, folder)
        tell("show --verify", check, f"{check[0] / parsed[0]:.2f} x the bare; the limit is {LIMIT_RATIO:g}")
        tell(
            "resume to its first step", cost(resumed, folder), f"the limit is {LIMIT_S:g} s, {LIMIT_MB:g} MB"
        )
        many = copies(folder, options.runs)
        tell(
            "runs, once seen",
            cost(listed, many / "0"),
            f"{options.runs} runs; the limit is {LIMIT_LIST_S:g} s",
        )


def tell(what: str, found: tuple[float, float], note: str) -> None:
    """Print a line of the table."""
    print(f"{what:26} {found[0]:7.2f} s CPU {found[1]:6.0f} MB   {note}", flush=True)


def copies(folder: Path, number: int) -> Path:
    """Make many runs of the files of one, of which the first alone is read; return their folder.

    The others are taken to have been seen, as they would be after minutes of reading the same again.
    """
    from bench.run.folder import SETTLED_S, Digest, Digests, Run

    many = folder.parent.with_name("many")
    for index in range(number):
        copy = many / str(index)
        copy.mkdir(parents=True)
        for file in folder.iterdir():
            os.link(file, copy / file.name)
    time.sleep(SETTLED_S + 1.0)
    read = Digest.of(Run(many / "0"))
    with patch.object(Digest, "of", lambda run: read):
        digests = Digests(many)
        for index in range(number):
            digests.of(Run(many / str(index)))
        digests.save()
    return many


if __name__ == "__main__":
    main()
