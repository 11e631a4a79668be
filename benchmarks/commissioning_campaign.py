"""What does commissioning say of a bench with a fault? Promised: it names the instrument, and leaves all safe.

    python -m benchmarks.commissioning_campaign --jobs 2 --seed 1

Every trial is `instruments --commission --dry-run` on a bench file of `config` whose timeouts are short. On every
bench every kind of fault strikes every instrument that can have it, once and from an exchange on; a head with a
motor sticks or stops beside its target as well. The exchange is drawn from those before the cables are pulled.
Judged: the evening is gone through to its end, with its page; a finding that is not well names the instrument
(one that struck once may pass without a trace where the driver is proof against it, which is counted); the head
stands, the chamber stands by. Prints a table by kind and every violation; exit status 1
when there is one.
"""

from __future__ import annotations

import contextlib
import functools
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest import mock

import bench.run.assembly.served
from bench.base.arrays import ARCSEC
from bench.config.bench_file.file import load_bench
from bench.run.commission.course import CABLE
from bench.services.instruments import PAGE, CommissioningPlan, commission
from benchmarks.campaign import ROOT, Tried, amiss, arguments, by_kind, spread, summed
from benchmarks.fault_campaign import exact_bench
from drivers.interfaces import BenchError
from sim.bench import SimulatedBench
from sim.wires.faults import OF_INSTRUMENT, Fault, FaultKind
from sim.world.pose import HeadFault

TIMEOUT_S: Final = 0.5
LATE_PART: Final = 0.8
LIMIT_S: Final = 180.0
"""An adapter whose every answer is late holds an evening up that long."""
ONCE, LASTING = "once", "from then on"
STUCK, BESIDE = "head stuck", "head beside"
HEAD_FAULTS: Final = {STUCK: HeadFault(sticks_after_rad=0.0), BESIDE: HeadFault(stops_off_rad=600.0 * ARCSEC)}
PROOF: Final = {FaultKind.ERROR, FaultKind.LOCAL, FaultKind.POWER_CYCLE, FaultKind.OVERLOAD, FaultKind.LATE}
"""What may pass without a trace when it strikes once: errors are cleared, settings sent, nothing was sampled."""
PROOF_FOR_GOOD: Final[dict[str, str]] = {
    FaultKind.LOCAL: "voltmeter", FaultKind.POWER_CYCLE: "chamber", FaultKind.ERROR: "chamber",
}  # fmt: skip
"""What may do so each time: only RS-232 knows a LOCAL key, a chamber that was switched off stands by, and its
driver reads each setting back in place of the errors in its queue."""


@dataclass(frozen=True)
class Bench:
    """A bench file for trials, and of an evening without faults how many exchanges each instrument has."""

    name: str
    path: Path
    exchanges: Mapping[str, int]
    able: Mapping[str, tuple[str, ...]]
    on_rs232: tuple[str, ...]
    behind_adapter: tuple[str, ...]
    motorised: bool


@dataclass(frozen=True)
class Trial:
    """One evening with one fault, of `instrument` at its `at`-th exchange."""

    bench: Bench
    kind: str
    mode: str
    instrument: str
    at: int


@dataclass
class Outcome(Tried):
    """What became of a trial; `traced`: whether a finding names the instrument."""

    traced: bool = False


Handler = Callable[[bytes, Callable[[], bool]], bytes | None]


class Struck:
    """Stands for `SimulatedBench` where a dry bench is put together: counts exchanges, lets a fault strike."""

    def __init__(self, trial: Trial | None) -> None:
        self._trial = trial
        self.exchanges: dict[str, int] = {}
        self.before_cables: dict[str, int] = {}
        self.bench: SimulatedBench | None = None
        self._cables = self._armed = False

    def __call__(self, *arguments: Any, **named: Any) -> SimulatedBench:
        simulated = self.bench = SimulatedBench(*arguments, **named)
        for name, faulty in simulated.faulty.items():
            faulty.handle = functools.partial(self._handle, name, faulty.handle)  # type: ignore[method-assign]
        if self._trial is not None and self._trial.kind in HEAD_FAULTS:
            simulated.world.head_fault = HEAD_FAULTS[self._trial.kind]
        return simulated

    def _handle(
        self, name: str, handle: Handler, message: bytes, interrupted: Callable[[], bool]
    ) -> bytes | None:
        self.exchanges[name] = self.exchanges.get(name, 0) + 1
        trial = self._trial
        if trial is None or trial.kind in HEAD_FAULTS or name != trial.instrument:
            return handle(message, interrupted)
        # A fault of a wire strikes a reply, so it waits for an exchange that has one.
        due, of_wire = self.exchanges[name] >= trial.at and not self._armed, trial.kind not in OF_INSTRUMENT
        if due and not of_wire:
            self._arm(trial)
        reply = handle(message, interrupted)
        if due and of_wire and reply is not None:
            self._arm(trial)
        return reply

    def _arm(self, trial: Trial) -> None:
        self._armed = True
        kind = FaultKind(trial.kind)
        seconds = LATE_PART * TIMEOUT_S if kind is FaultKind.LATE else 0.0
        at = 1 if trial.mode == ONCE else None
        probability = 1.0 if at is None else None
        if self.bench is not None:
            self.bench.arm(Fault(kind, probability, at, seconds=seconds, instrument=trial.instrument))

    def told(self, line: str) -> None:
        """Take note of how many exchanges there were when the first cable is about to be pulled."""
        self._cables |= CABLE in line
        if not self._cables:
            self.before_cables = dict(self.exchanges)

    def unsafe(self) -> list[str]:
        """Return what was not left safe."""
        if self.bench is None:
            return ["no bench was made"]
        world, wrong = self.bench.world, []
        if world.head_rate_rad_s:
            wrong.append("the head turns")
        if world._chamber_demand_c is not None:
            wrong.append("the chamber conditions")
        return wrong


@contextlib.contextmanager
def struck(trial: Trial | None) -> Iterator[Struck]:
    """Within the context a dry bench has the fault of a trial."""
    watch = Struck(trial)
    with mock.patch.object(bench.run.assembly.served, "SimulatedBench", watch):
        yield watch


# --- trials -----------------------------------------------------------------------------------------


def benches(folder: Path, names: Sequence[str]) -> list[Bench]:
    """Make the benches, each with an evening without faults. Raises `RuntimeError` where that is not well."""
    made = []
    for name in names:
        path, _ = exact_bench(folder, name, f"{TIMEOUT_S:g} s")
        file = load_bench(path)
        with struck(None) as watch:
            result = commission(CommissioningPlan(file, path, folder / f"{name}-well", None, tell=watch.told))
        if result["status"] != 0 or watch.bench is None:
            raise RuntimeError(f"{name}: not well without a fault: {result['findings']}")
        able = {
            str(kind): tuple(n for n in watch.exchanges if _can(watch.bench, n, kind)) for kind in FaultKind
        }
        behind = tuple(m.name for m in file.instruments.voltmeters if m.place is not None)
        motorised = not file.instruments.head.by_hand
        rs232 = tuple(m.name for m in file.instruments.voltmeters if m.interface == "rs232")
        made.append(Bench(name, path, watch.before_cables, able, rs232, behind, motorised))
    return made


def _can(simulated: SimulatedBench, name: str, kind: FaultKind) -> bool:
    on_bus = name in simulated._on_bus and kind not in OF_INSTRUMENT
    seconds = 0.1 if kind is FaultKind.LATE else 0.0
    return not on_bus and simulated.faulty[name].can_have(Fault(kind, at=1, seconds=seconds))


def trials_of(bench: Bench, seed: int) -> list[Trial]:
    """Return every fault of every instrument of a bench, once and lasting, and those of a head."""
    generator = random.Random(f"{seed} {bench.name}")  # noqa: S311 - nothing secret
    made = [
        Trial(bench, kind, mode, instrument, generator.randint(1, bench.exchanges[instrument]))
        for kind, able in bench.able.items()
        for instrument in able
        for mode in (ONCE, LASTING)
    ]
    if bench.motorised:
        made += [Trial(bench, kind, LASTING, "head", 0) for kind in HEAD_FAULTS]
    return made


def carry_out(trial: Trial, folder: Path, limit_s: float = LIMIT_S) -> Outcome:
    """Go through an evening with a fault, and judge it."""
    outcome = Outcome(trial)
    what = (trial.bench.name, trial.kind, trial.mode, trial.instrument, trial.at)
    out = folder / "-".join(map(str, what)).replace(" ", "-")
    begun_s = time.monotonic()
    with struck(trial) as watch:
        try:
            result = commission(CommissioningPlan(load_bench(trial.bench.path), trial.bench.path, out, None))
        except BenchError as error:
            outcome.violations.append(f"no page: {error}")
            return outcome
    outcome.time_s = time.monotonic() - begun_s
    outcome.violations += watch.unsafe() + _judged(trial, result, outcome)
    if not (out / PAGE).is_file():
        outcome.violations.append("no page")
    if outcome.time_s > limit_s:
        outcome.violations.append(f"it took {outcome.time_s:.0f} s")
    return outcome


def _judged(trial: Trial, result: Mapping[str, Any], outcome: Outcome) -> list[str]:
    """Return what is wrong with a result: it ends early, hides the fault, or blames another."""
    wrong = [f"ended early: {result['ended']}"] if result["ended"] else []
    troubles = [one for one in result["findings"] if one["state"] not in ("works", "skipped")]
    suspects = trial.bench.behind_adapter if trial.instrument.startswith("adapter") else (trial.instrument,)
    outcome.traced = any(one["instrument"] in suspects for one in troubles)
    proof = trial.mode == ONCE and trial.kind in PROOF
    if trial.instrument not in trial.bench.on_rs232:
        proof |= trial.instrument.startswith(PROOF_FOR_GOOD.get(trial.kind, "nobody"))
    if not outcome.traced and not proof:
        wrong.append("the instrument is not named")
    others = [one for one in troubles if one["instrument"] not in suspects]
    wrong += [f"another is blamed: {one['instrument']}: {one['said']}" for one in others]
    wrong += [f"without a remedy: {one['said']}" for one in troubles if not one["remedy"]]
    return wrong


# --- the table --------------------------------------------------------------------------------------


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the table by kind of fault."""
    counts: dict[str, Callable[[Sequence[Outcome]], object]] = {
        "evenings": len,
        "named": summed("traced"),
        "no trace": lambda rows: len(rows) - summed("traced")(rows),
        "violations": summed("violations"),
        "longest, s": lambda rows: f"{max(row.time_s for row in rows):.1f}",
    }
    return by_kind(outcomes, (*map(str, FaultKind), *HEAD_FAULTS), lambda row: row.trial.kind, counts)


def violations(outcomes: Sequence[Outcome]) -> list[str]:
    """Return every violation with what led to it."""
    return [
        f"{row.trial.bench.name} {row.trial.kind} {row.trial.mode} {row.trial.instrument} at {row.trial.at}: {text}"
        for row in outcomes
        for text in row.violations
    ]


def main() -> int:
    given = arguments(
        __doc__, seed=1, workers=(2, "processes"), limit=(LIMIT_S, "how long an evening may take, s"),
        bench={"nargs": "*", "help": "shipped bench files by name (default: all)"},
    )  # fmt: skip
    names = given.bench or sorted(file.stem for file in (ROOT / "config").glob("*.yaml"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        trials = [trial for one in benches(folder, names) for trial in trials_of(one, given.seed)]
        begun_s = time.monotonic()
        work = functools.partial(carry_out, folder=folder, limit_s=given.limit)
        outcomes = list(spread(work, trials, given.workers))
        took_s = time.monotonic() - begun_s
    print(table(outcomes))
    print(f"{len(outcomes)} evenings on {len(names)} benches in {took_s:.0f} s, seed {given.seed}")
    return amiss(violations(outcomes))


if __name__ == "__main__":
    sys.exit(main())
