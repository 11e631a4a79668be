"""Kills dry runs with SIGKILL at random moments and resumes each until it ends.

Every run must end with exactly the planned readings, none twice, none missing, equal to those of a run of
the same seed that nobody disturbed, with the chain of hashes whole:

    python -m benchmarks.kill_campaign --kills 200 --workers 2

The moments are spread by seed over the life of the process, its start and its conclusion included.
"""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from bench.run.folder import Run
from bench.run.record import read_history
from benchmarks.campaign import PROGRAM, arguments

PROCEDURE = "quick"
LONGEST_S = 2.2
"""A dry run of `quick` takes about as long on a machine of two cores, its start included."""


def start(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Start the program in a folder."""
    return subprocess.Popen(  # noqa: S603 - our own program
        [*PROGRAM, *arguments], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def one(number: int, folder: Path, expected: Run) -> tuple[int, list[str]]:
    """Kill and resume one run until it ends; return how often it was killed, and what is wrong with it."""
    rng = random.Random(number)  # noqa: S311 - a campaign, no secret
    name = f"run{number}"
    kills = 0
    process = start(folder, "run", PROCEDURE, "--dry-run", "--seed", "7", "--name", name)
    while True:
        try:
            process.wait(timeout=rng.uniform(0.3, LONGEST_S) if kills < 3 else None)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
        run = folder / "runs" / name
        if not (run / "run.json").exists():
            process = start(folder, "run", PROCEDURE, "--dry-run", "--seed", "7", "--name", name)
            continue
        if read_history(run).state == "finished":
            return kills, differences(Run(run), expected)
        process = start(folder, "resume", name)


def differences(run: Run, expected: Run) -> list[str]:
    """Say in what a run differs from one that nobody disturbed."""
    wrong = list(run.history.problems)
    steps = [e.data["step"] for e in run.history.events if e.type == "step_done" and "reading" in e.data]
    wrong += [f"step {step} was read twice" for step, times in Counter(steps).items() if times > 1]
    ours, theirs = run.readings(), expected.readings()
    if len(ours) != len(theirs):
        return [*wrong, f"{len(ours)} readings, planned were {len(theirs)}"]
    for column in ("signal", "angle_rad", "time_s", "installation", "point"):
        if not np.array_equal(getattr(ours, column), getattr(theirs, column)):
            wrong.append(f"{column} differs from an undisturbed run")
    return wrong


def main() -> None:
    options = arguments(__doc__, kills=200, workers=2)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start(folder, "run", PROCEDURE, "--dry-run", "--seed", "7", "--name", "whole").wait()
        expected = Run(folder / "runs" / "whole")
        killed, runs, failed = 0, 0, []
        with ThreadPoolExecutor(options.workers) as pool:
            while killed < options.kills:
                batch = range(runs, runs + 8 * options.workers)
                for number, (kills, wrong) in zip(
                    batch, pool.map(lambda n: one(n, folder, expected), batch), strict=True
                ):
                    killed += kills
                    failed += [f"run {number}: {text}" for text in wrong]
                runs += len(batch)
                print(f"{killed} kills in {runs} runs, {len(failed)} faults", flush=True)
    print(*failed, sep="\n")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
