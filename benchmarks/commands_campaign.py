"""Does every run survive whatever is typed, pressed, switched off and killed? Promised: no record is ever lost.

    python -m benchmarks.commands_campaign --transitions 3000 --seed 1

A state machine (hypothesis) goes from an empty folder through `run`, `resume`, `abort`, `calibrate`, `report`,
`export`, `seal` and the panel's buttons, on a bench with three voltmeters that are served on loopback and a head
that a person turns. A meter is off, goes off in mid-run, comes back; a command is hit by Ctrl-C or SIGTERM; it is
stopped, paused or aborted from the panel, or killed: its record then ends at any byte behind what was there before,
and results are missing. After every step: each record only grew and `show --verify` holds; no reading stands there
twice; whatever the program recommends is possible; and where all meters are on, `resume` brings a run to its end
with all its results. Prints how often what was done; exit status 1 where anything is amiss, with what led there.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from bench.run.events import ENDED, RunState
from bench.run.folder import Run
from benchmarks.commands_desk import METERS, STOPPED, Desk, Said

AT_MOST: Final = 4
"""So many runs in a folder: one more step is of one of these."""

TROUBLES: Final = (
    "",
    "",
    "",
    "ctrl-c",
    "sigterm",
    "meter off",
    "kill",
    "kill",
    "stop",
    "pause",
    "abort",
    "results",
)
"""What comes over a command, at one of its events; "results" kills it while the results are made."""


@dataclass
class Told:
    """What a campaign counts, and what it found amiss."""

    done: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


TOLD: Final = Told()


# --- the state machine ------------------------------------------------------------------------------

RUNS: Final = st.integers(0, AT_MOST - 1)
TROUBLE: Final = st.sampled_from(TROUBLES)
AT: Final = st.integers(1, 70)


class Evenings(RuleBasedStateMachine):
    """Whatever is done at a bench, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self._stack = ExitStack()
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))
        self.desk = self._stack.enter_context(Desk(folder).open())

    def teardown(self) -> None:
        self._stack.close()

    def _judge(self, what: str, *further: str) -> None:
        """Count a step, and raise `AssertionError` with all that is amiss after it."""
        TOLD.done[what] += 1
        wrong = [*further, *self.desk.check()]
        TOLD.wrong += wrong
        if wrong:
            raise AssertionError("\n".join(wrong))

    def _name(self, which: int) -> str:
        return (names := self.desk.names())[which % len(names)]

    def _state(self, name: str) -> RunState:
        return Run(self.desk.runs / name).history.state

    @initialize(trouble=TROUBLE, at=AT)
    def begin(self, trouble: str, at: int) -> None:
        self.run(trouble, at)

    @rule(trouble=TROUBLE, at=AT)
    def run(self, trouble: str, at: int) -> None:
        if len(self.desk.names()) >= AT_MOST:  # the oldest is brought away
            shutil.rmtree(self.desk.runs / (oldest := self.desk.names()[0]))
            del self.desk.kept[oldest]
        name = f"n{TOLD.done.total():06d}"
        said = self.desk.command(
            "run", "short.yaml", "--bench", "bench.yaml", "--name", name, trouble=trouble, at=at
        )
        self._judge(f"run, {trouble or 'no trouble'}", *_amiss(said))

    @rule(which=RUNS, trouble=TROUBLE, at=AT)
    def resume(self, which: int, trouble: str, at: int) -> None:
        said = self.desk.command("resume", self._name(which), trouble=trouble, at=at)
        self._judge(f"resume, {trouble or 'no trouble'}", *_amiss(said))

    @rule(trouble=TROUBLE, at=AT)
    def resume_latest(self, trouble: str, at: int) -> None:
        said = self.desk.command("resume", trouble=trouble, at=at)
        self._judge(f"resume the latest, {trouble or 'no trouble'}", *_amiss(said))

    @rule(which=RUNS, trouble=TROUBLE, at=AT)
    def press_resume(self, which: int, trouble: str, at: int) -> None:
        said = self.desk.press(self._name(which), "resume", trouble=trouble, at=at)
        self._judge(f"resume at the panel, {trouble or 'no trouble'}", *_amiss(said))

    @rule(which=RUNS)
    def bring_to_its_end(self, which: int) -> None:
        """With all meters on, what is recommended works: the run ends, with all that is made of it."""
        for meter in [*self.desk.off]:
            self.desk.switch(meter)
        name = self._name(which)
        state = self._state(name)
        if state is RunState.ABORTED:
            return
        before = state is RunState.FINISHED and not Run(self.desk.runs / name).results_missing
        said = self.desk.command("resume", name)
        wrong = _amiss(said)
        if self._state(name) is not RunState.FINISHED or Run(self.desk.runs / name).results_missing:
            wrong.append(f"{name}: was {state}, and resume did not bring it to its end: {said.text[-300:]}")
        if (said.status == STOPPED) != before:
            wrong.append(f"{name}: was {state}, and resume ended with {said.status}: {said.text[-300:]}")
        self._judge("resume to the end", *wrong)

    @rule(which=RUNS, panel=st.booleans())
    def abort(self, *, which: int, panel: bool) -> None:
        name = self._name(which)
        state = self._state(name)
        said = self.desk.press(name, "give-up") if panel else self.desk.command("abort", name)
        wrong = _amiss(said)
        if (said.status == 0) != (state not in ENDED):
            wrong.append(f"{name}: was {state}, and abort ended with {said.status}: {said.text[-300:]}")
        self._judge("give up at the panel" if panel else "abort", *wrong)

    @rule(which=RUNS, command=st.sampled_from(["calibrate", "report", "export", "seal"]))
    def evaluate(self, which: int, command: str) -> None:
        name = self._name(which)
        target = ["--csv", "readings.csv"] if command == "export" else []
        self._judge(command, *_amiss(self.desk.command(command, name, *target)))

    @rule(meter=st.sampled_from(METERS))
    def switch(self, meter: str) -> None:
        self.desk.switch(next(iter(self.desk.off), meter))
        self._judge("switch a meter")


def _amiss(said: Said) -> list[str]:
    text = said.text
    if "Traceback" in text or "mistake of the program" in text or "cannot be trusted" in text:
        return [f"not one of our messages: {text[-600:]}"]
    return []


def main() -> None:
    """Carry the campaign out and print what was done."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--transitions", type=int, default=3000, help="at least so many")
    parser.add_argument("--steps", type=int, default=30, help="from one empty folder")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    begun_s, number = time.monotonic(), given.seed
    once = settings(
        max_examples=10,
        stateful_step_count=given.steps,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    while TOLD.done.total() < given.transitions and not TOLD.wrong:
        with contextlib.suppress(AssertionError):
            run_state_machine_as_test(seed(number)(Evenings), settings=once)
        number += 1
        print(f"{TOLD.done.total()} transitions, {time.monotonic() - begun_s:.0f} s", flush=True)
    for what, times in TOLD.done.most_common():
        print(f"{times:7d} {what}")
    for text in TOLD.wrong:
        print(f"AMISS {text}")
    print(f"{TOLD.done.total()} transitions, seeds {given.seed} to {number - 1}, {len(TOLD.wrong)} amiss")
    sys.exit(1 if TOLD.wrong else 0)


if __name__ == "__main__":
    main()
