"""What do signals do after the last reading? Promised: one `resume` makes all results, and a second signal ends it.

    python -m benchmarks.results_campaign --signals 200 --seed 1 --jobs 2

Every trial is a dry run by the command line in a process of its own. As soon as its record says that it has
finished, SIGINT, SIGTERM or SIGKILL comes, single or twice, at a moment drawn over the way out and the making of
results. Judged: no traceback; exit status 2 and the sentence that names `bench resume`, unless all results are there;
how long the process takes to end, after a second signal 1 s at most; then one `resume`, and all results are there
while the record is as it was. Exit status 1 when anything is amiss.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

from bench.run.folder import Run
from bench.run.manifest import EVENTS
from bench.run.states import RunState

PROGRAM: Final = [sys.executable, "-c", "from bench.cli.program import main; main()"]
MADE: Final = ("calibrate.json", "verify.json", "report.html")
PATTERNS: Final = (
    (signal.SIGINT,),
    (signal.SIGTERM,),
    (signal.SIGKILL,),
    (signal.SIGINT, signal.SIGINT),
    (signal.SIGTERM, signal.SIGINT),
    (signal.SIGINT, signal.SIGTERM),
)
STOPPED: Final = 2
SECOND_S: Final = 1.0
"""After a second signal the process takes no longer to end."""
HANGS_S: Final = 60.0


@dataclass(frozen=True)
class Trial:
    """A run: its signals, when the first comes (1: when results should be there), the gap to the second."""

    number: int
    signals: tuple[signal.Signals, ...]
    moment: float
    gap_s: float


@dataclass
class Outcome:
    """What became of a trial: what is amiss, how long it took to end after its last signal, and how it ended."""

    trial: Trial
    wrong: list[str] = field(default_factory=list)
    ended_s: float = 0.0
    how: str = ""


def draw(count: int, seed: int) -> list[Trial]:
    """Draw trials with so many signals at least, the patterns in turn."""
    generator = random.Random(seed)  # noqa: S311 - nothing secret
    trials: list[Trial] = []
    while sum(len(trial.signals) for trial in trials) < count:
        pattern = PATTERNS[len(trials) % len(PATTERNS)]
        trials.append(Trial(len(trials), pattern, generator.random(), generator.uniform(0.0, 0.3)))
    return trials


def begin(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """Start the program in a folder."""
    return subprocess.Popen(  # noqa: S603 - our own program
        [*PROGRAM, *arguments],
        cwd=folder,
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def until_finished(folder: Path, name: str) -> tuple[subprocess.Popen[str], Path]:
    """Begin a run and return it as soon as its record says that it has finished. Raises `RuntimeError`."""
    process = begin(folder, "run", "quick", "--dry-run", "--seed", "7", "--name", name)
    record = folder / "runs" / name / EVENTS
    while not (record.exists() and b'"run_finished"' in record.read_bytes()[-4000:]):
        if process.poll() is not None:
            raise RuntimeError(process.communicate()[1])
        time.sleep(0.002)
    return process, record


def carry_out(trial: Trial, folder: Path, results_s: float) -> Outcome:
    """Run, send the signals, resume, and judge."""
    outcome, name = Outcome(trial), f"run{trial.number}"
    process, record = until_finished(folder, name)
    time.sleep(trial.moment * results_s)
    first, *second = trial.signals
    process.send_signal(first)
    for number in second:
        time.sleep(trial.gap_s)
        process.send_signal(number)
    sent_s = time.monotonic()
    try:
        said = process.communicate(timeout=HANGS_S)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        said = process.communicate()[1]
        outcome.wrong.append("it hangs")
    outcome.ended_s = time.monotonic() - sent_s
    run = Run(record.parent)
    complete = not run.results_missing
    outcome.how = f"status {process.returncode}, results {'complete' if complete else 'missing'}"
    if len(trial.signals) > 1 and outcome.ended_s > SECOND_S:
        outcome.wrong.append(f"it ended {outcome.ended_s:.1f} s after the second signal")
    told = process.returncode == STOPPED and f"'bench resume {name}'" in said
    if not (complete or told or signal.SIGKILL in trial.signals):
        outcome.wrong.append(f"it ended with {process.returncode}: {said[-300:]}")
    if "Traceback" in said or "Exception ignored" in said:
        outcome.wrong.append(said[-600:])
    resumed(outcome, run, complete=complete)
    return outcome


def resumed(outcome: Outcome, run: Run, *, complete: bool) -> None:
    """Resume once, and say what is amiss then."""
    record = (run.folder / EVENTS).read_bytes()
    process = begin(run.folder.parents[1], "resume", run.name)
    said = process.communicate()[1]
    if process.returncode != (STOPPED if complete else 0) or "Traceback" in said:
        outcome.wrong.append(f"resume ended with {process.returncode}: {said[-300:]}")
    if run.results_missing or not all((run.folder / name).is_file() for name in MADE):
        outcome.wrong.append("results are missing after resume")
    if (run.folder / EVENTS).read_bytes() != record or run.history.problems:
        outcome.wrong.append("the record is not as it was")
    if run.history.state is not RunState.FINISHED:
        outcome.wrong.append(f"the run is {run.history.state}")


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the table by signals."""
    lines = [f"{'signals':>20} {'runs':>5} {'longest until it ended':>24} {'amiss':>6}  how it ended"]
    for pattern in PATTERNS:
        those = [outcome for outcome in outcomes if outcome.trial.signals == pattern]
        if not those:
            continue
        hows = ", ".join(f"{n} {how}" for how, n in Counter(one.how for one in those).most_common())
        longest = max(one.ended_s for one in those)
        amiss = sum(bool(one.wrong) for one in those)
        told = " ".join(number.name for number in pattern)
        lines.append(f"{told:>20} {len(those):>5} {longest:>22.2f} s {amiss:>6}  {hows}")
    return "\n".join(lines)


def main() -> None:
    """Carry the campaign out and print its table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--signals", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    trials = draw(given.signals, given.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        process, _ = until_finished(folder, "undisturbed")
        begun_s = time.monotonic()
        process.communicate()
        results_s = time.monotonic() - begun_s
        with ThreadPoolExecutor(given.jobs) as pool:
            outcomes = []
            for outcome in pool.map(partial(carry_out, folder=folder, results_s=results_s), trials):
                outcomes.append(outcome)
                for text in outcome.wrong:
                    print(f"AMISS {outcome.trial}: {text}", flush=True)
    print(table(outcomes))
    amiss = sum(bool(outcome.wrong) for outcome in outcomes)
    signals = sum(len(outcome.trial.signals) for outcome in outcomes)
    print(f"{len(outcomes)} runs, {signals} signals over {results_s:.1f} s, seed {given.seed}, {amiss} amiss")
    sys.exit(1 if amiss else 0)


if __name__ == "__main__":
    main()
