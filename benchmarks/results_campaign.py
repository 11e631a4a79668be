"""What do signals do after the last reading? Promised: one `resume` makes all results, and a second signal ends it.

    python -m benchmarks.results_campaign --signals 200 --seed 1

Every trial is a process of its own that resumes a dry run after its last reading, as a kill there leaves it. As
soon as the record says that it has finished, SIGINT, SIGTERM or SIGKILL comes, single or twice, at a moment drawn
over the way out and the making of results. Judged: no traceback; exit status 2 and the sentence that names `bench
resume`, unless all is there; how long the process takes to end, after a second signal 1 s at most; then one
`resume`, and all results are there while the record is as it was. Exit status 1 when anything is amiss.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Final
from unittest import mock

import matplotlib.figure  # noqa: F401 - imported once, for all processes
import scipy.optimize
import scipy.stats  # noqa: F401

from bench.cli import program
from bench.run.events import EVENTS, RunState
from bench.run.folder import RESULTS, Run
from benchmarks.campaign import EMPTY_FIGURE, amiss, arguments

MADE: Final = ("calibrate.json", "verify.json", "report.html")
PATTERNS: Final = (
    (signal.SIGINT,), (signal.SIGTERM,), (signal.SIGKILL,), (signal.SIGINT, signal.SIGINT),
    (signal.SIGTERM, signal.SIGINT), (signal.SIGINT, signal.SIGTERM),
)  # fmt: skip
STOPPED: Final = 2
SECOND_S: Final = 1.0
"""After a second signal the process takes no longer to end."""
HANGS_S: Final = 600.0


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


class Program:
    """The program in a process forked from this one, which has imported numpy, scipy and matplotlib for it."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._err = folder / f"{arguments[1]}.err"
        self.process = get_context("fork").Process(target=self._run, args=(folder, arguments))
        self.process.start()

    def _run(self, folder: Path, arguments: tuple[str, ...]) -> None:
        os.chdir(folder)
        nothing = os.open(os.devnull, os.O_RDWR)
        err = os.open(self._err, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for descriptor, to in ((0, nothing), (1, nothing), (2, err)):
            os.dup2(to, descriptor)
        sys.argv = ["bench", *arguments]
        program.main()

    def send(self, number: int) -> None:
        """Send a signal, where the process still lives."""
        if self.process.is_alive() and self.process.pid is not None:
            os.kill(self.process.pid, number)

    def wait(self) -> tuple[int, str]:
        """Wait for its end; return the exit status and what stands on standard error."""
        self.process.join(HANGS_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        return int(self.process.exitcode or 0), self._err.read_text(encoding="utf-8")


def unfinished(folder: Path, name: str) -> Path:
    """Make a copy of the run `base` as a kill after its last reading leaves it; return its record."""
    run = folder / "runs" / name
    shutil.copytree(folder / "runs/base", run)
    record = run / EVENTS
    lines = record.read_bytes().splitlines(keepends=True)
    end = next(number for number, line in enumerate(lines) if b'"run_finished"' in line)
    record.write_bytes(b"".join(lines[:end]))
    for made in (*MADE, RESULTS):
        (run / made).unlink()
    return record


def until_finished(folder: Path, name: str) -> tuple[Program, Path]:
    """Resume such a copy and return it as soon as its record says that it has finished."""
    record = unfinished(folder, name)
    resuming = Program(folder, "resume", name)
    while resuming.process.is_alive() and b'"run_finished"' not in record.read_bytes()[-4000:]:
        time.sleep(0.002)
    return resuming, record


def carry_out(trial: Trial, folder: Path, results_s: float) -> Outcome:
    """Run, send the signals, resume, and judge."""
    outcome, name = Outcome(trial), f"run{trial.number}"
    process, record = until_finished(folder, name)
    time.sleep(trial.moment * results_s)
    first, *second = trial.signals
    process.send(first)
    for number in second:
        time.sleep(trial.gap_s)
        process.send(number)
    sent_s = time.monotonic()
    status, said = process.wait()
    outcome.ended_s = time.monotonic() - sent_s
    run = Run(record.parent)
    complete = not run.results_missing
    outcome.how = f"status {status}, results {'complete' if complete else 'missing'}"
    if len(trial.signals) > 1 and outcome.ended_s > SECOND_S:
        outcome.wrong.append(f"it ended {outcome.ended_s:.1f} s after the second signal")
    told = status == STOPPED and f"'bench resume {name}'" in said
    if not (complete or told or signal.SIGKILL in trial.signals):
        outcome.wrong.append(f"it ended with {status}: {said[-300:]}")
    if "Traceback" in said or "Exception ignored" in said:
        outcome.wrong.append(said[-600:])
    resumed(outcome, run, complete=complete)
    return outcome


def resumed(outcome: Outcome, run: Run, *, complete: bool) -> None:
    """Resume once, and say what is amiss then."""
    record = (run.folder / EVENTS).read_bytes()
    status, said = Program(run.folder.parents[1], "resume", run.name).wait()
    if status != (STOPPED if complete else 0) or "Traceback" in said:
        outcome.wrong.append(f"resume ended with {status}: {said[-300:]}")
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
        wrong = sum(bool(one.wrong) for one in those)
        told = " ".join(number.name for number in pattern)
        lines.append(f"{told:>20} {len(those):>5} {longest:>22.2f} s {wrong:>6}  {hows}")
    return "\n".join(lines)


def main() -> None:
    """Carry the campaign out and print its table."""
    given = arguments(
        __doc__, signals=200, seed=1, plain=(False, "pages without figures, which cost most of the time")
    )
    trials = draw(given.signals, given.seed)
    if given.plain:
        mock.patch("bench.results.plots._written", return_value=EMPTY_FIGURE).start()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        Program(folder, "run", "quick", "--dry-run", "--seed", "7", "--name", "base").wait()
        undisturbed, _ = until_finished(folder, "undisturbed")
        begun_s = time.monotonic()
        undisturbed.wait()
        results_s = time.monotonic() - begun_s
        outcomes = []
        for trial in trials:
            outcomes.append(outcome := carry_out(trial, folder, results_s))
            amiss([f"{trial}: {text}" for text in outcome.wrong], "AMISS")
            if trial.number % 20 == 0:
                print(f"{trial.number} runs, {time.monotonic() - begun_s:.0f} s", flush=True)
    print(table(outcomes))
    wrong = sum(bool(outcome.wrong) for outcome in outcomes)
    signals = sum(len(outcome.trial.signals) for outcome in outcomes)
    print(f"{len(outcomes)} runs, {signals} signals over {results_s:.1f} s, seed {given.seed}, {wrong} amiss")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
