"""Test the early warning.

After an operator's mistake, a run stops in time and for the right reason; without one, it never stops.

    python -m benchmarks.mistakes_campaign watcher --runs 200 --clean 3000 --jobs 2
    python -m benchmarks.mistakes_campaign whole --runs 20 --clean 500 --jobs 2

A scripted operator (`benchmarks.mistaken_operator`) makes one mistake in a run, in each pass in turn. In part
`watcher`, the early warning receives the readings of the simulated world. In part `whole`, every run is a dry
run over the wires of simulated meters, which is recorded, stopped, continued as the question demands, and
calibrated. Its coefficients are compared with those of the same run without the mistake. A repeated step has
the random numbers of its first time, so that only consequences of the mistake make a difference.

A mistake counts if it shifts the three signals of a reading by at least 8 standard deviations of their
prediction from earlier readings. The run must stop at the first such reading or at the next one. A cause is
right if it is the mistake made; if several are named as equally likely, one of them must be. A table with
Wilson intervals (95 %) is printed; the exit status is 1 if a limit is missed.
"""

import math
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np

from bench.base.arrays import Floats
from bench.calibration import CalibrationError
from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Plan
from bench.config.procedure.steps import Mount, Read, Turn, Wait
from bench.model import ForwardModel
from bench.readings.table import Reading
from bench.run.assembly.instruments import operator_of, world_of
from bench.run.early_warning import MOST_LISTED, watcher_of
from bench.run.events import Event, EventType, Mounted, result_to_json
from bench.run.folder import Run
from bench.run.person import mount_prompt
from bench.services.calibration import calibration_of
from bench.services.errors import Refused
from bench.services.source import Request, load_sources
from benchmarks.campaign import ROOT, Share, arguments, spread
from benchmarks.mistaken_operator import KINDS, Mistake, MistakenOperator, draw, pass_of
from drivers.instruments.manual import ManualHead
from drivers.interfaces import CHANNELS
from sim.world.clock import VirtualClock
from tests.support.check_runs import dry_run

CLEAN: Final = "clean"
LARGE: Final = 8.0
"""Least shift of a reading by a mistake that counts, in standard deviations."""
IN_TIME: Final = 0.99
RIGHT: Final = 0.95
METER_NOISE_V: Final = 5e-6
"""Noise of a mean of ten samples, V, in addition to the voltmeter error of the bench file."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run.

    `size` is the largest shift in standard deviations (None: no readings), `large_at` the step of the first
    reading with a large shift. `late` is the number of readings after that one until the run stopped, None if
    it never stopped. `agrees` says whether the coefficients are within u of the undisturbed run's, None if
    they were not compared; `worst` is the largest difference in u.
    """

    kind: str
    place: str
    seed: int
    size: float | None = None
    stopped: bool = False
    late: int | None = None
    causes: tuple[str, ...] = ()
    right: bool = False
    agrees: bool | None = None
    worst: float | None = None
    trouble: str = ""
    large_at: int | None = None


@cache
def setting(procedure: str, bench: str) -> tuple[Plan, BenchFile]:
    """Return plan and bench file by their shipped names."""
    plan = load_procedure(ROOT / "procedures" / f"{procedure}.yaml").expand()
    return plan, load_bench(ROOT / "config" / f"{bench}.yaml")


def is_right(causes: Sequence[str], mistake: Mistake) -> bool:
    """Whether a cause that the sentence names is the mistake that was made."""
    return any(phrase in cause for cause in causes[:MOST_LISTED] for phrase in mistake.named)


# --- the early warning alone -----------------------------------------------------------------------------


class Fed:
    """A simulated bench without wires: the operator's actions, and the readings that follow."""

    def __init__(self, plan: Plan, bench: BenchFile, seed: int, mistake: Mistake | None) -> None:
        self.world = world_of(bench, ForwardModel(bench.installation_models()), seed, VirtualClock())
        self.operator = MistakenOperator(self.world, operator_of(bench), plan, mistake)
        tolerance_rad = bench.instruments.head.tolerance
        self.head = ManualHead("head", self.operator, tolerance_rad=tolerance_rad)
        self.angle_rad = 0.0

    def carry_out(self, step: object, key: str) -> Reading | Mounted | None:
        """Carry out a step; return its result."""
        self.world.begin_step(key)
        match step:
            case Mount():
                self.operator.ask(replace(mount_prompt(step, chamber=False), id=f"{key}#1"))
                return Mounted(None)
            case Wait():
                self.world.clock.sleep(step.duration_s)
            case Turn():
                self.angle_rad = self.head.move(step.target_rad, step.direction, key).angle_rad
            case Read():
                return self._read(step)
        return None

    def _read(self, step: Read) -> Reading:
        noise = self.world.random("noise").normal(0.0, METER_NOISE_V, 3)
        for channel in CHANNELS:
            self.world.new_reading(channel)
        mean = [self.world.signal_v(channel) + float(n) for channel, n in zip(CHANNELS, noise, strict=True)]
        angle_deg = None if step.target_rad is None else math.degrees(self.angle_rad)
        return Reading(
            installation=step.installation, series=step.series, pass_number=step.pass_number, point=step.point,
            angle_deg=angle_deg, direction=step.direction or 0, time_s=self.world.clock.now_s(),
            temperature_c=self.world.block_c, mean=(mean[0], mean[1], mean[2]),
        )  # fmt: skip


def watched(kind: str, number: int, seed: int, procedure: str, bench_name: str) -> Outcome:
    """Give the readings of a run to the early warning; stop at its first certain sign, or when it is too late."""
    plan, bench = setting(procedure, bench_name)
    run_seed = 1000 * seed + number
    mistake = None if kind == CLEAN else draw(kind, number, plan, bench.installation_models(), seed)
    watcher = watcher_of(plan, bench)
    fed = Fed(plan, bench, run_seed, mistake)
    undisturbed = Fed(plan, bench, run_seed, None) if mistake else None
    begun, size, since = False, 0.0, None
    place = pass_of(plan, mistake.index) if mistake else ""
    outcome, large_at = Outcome(kind, place, run_seed), None
    for index, step in enumerate(plan.steps):
        begun = begun or (mistake is not None and index == mistake.index)
        result = fed.carry_out(step, step.key)
        right = undisturbed.carry_out(step, step.key) if undisturbed else None
        if isinstance(result, Reading) and isinstance(right, Reading) and begun:
            here = _size(watcher.foresee(result).covariance[0], result, right)
            size = max(size, here)
            large_at = index if large_at is None and here >= LARGE else large_at
            since = 0 if since is None and here >= LARGE else None if since is None else since + 1
        watcher.observe(_done(index, result))
        signs = watcher.take(result) if isinstance(result, Reading) else ()
        stop = next((sign for sign in signs if sign.confident), None)
        if stop is not None:
            right_cause = mistake is not None and begun and is_right(stop.causes, mistake)
            outcome = replace(outcome, size=size, stopped=True, late=since or 0, large_at=large_at)
            return replace(outcome, causes=stop.causes, right=right_cause)
        if (since is not None and since >= 2) or (begun and mistake and _over(plan, mistake, index)):
            break
    if kind == "typed" and mistake is not None:  # the prompt asks again, so that no reading is wrong
        told = fed.operator.slips_told
        outcome = replace(outcome, size=math.inf, stopped=bool(told), late=0, causes=tuple(told))
        return replace(outcome, right=bool(told) and all(mistake.named[0] in text for text in told))
    return replace(outcome, size=size if mistake else None, large_at=large_at)


def _size(covariance: Floats, wrong: Reading, right: Reading) -> float:
    shift = np.array(wrong.mean) - np.array(right.mean)
    return float(np.sqrt(shift @ np.linalg.solve(covariance, shift)))


def _done(index: int, result: Reading | Mounted | None) -> Event:
    return Event(index + 1, "", 0.0, EventType.STEP_DONE, {"step": index, **result_to_json(result)})


def _over(plan: Plan, mistake: Mistake, index: int) -> bool:
    """Return whether a mistake can have no further effect.

    That is two readings after the mistake or, if it lasts, at the end of its mounting.
    """
    since = plan.steps[mistake.index + 1 : index + 1]
    lasts = mistake.cables or mistake.kind in ("not remounted", "remounted wrongly", "wrong direction")
    if lasts:
        return any(isinstance(step, Mount) for step in since)
    return sum(isinstance(step, Read) for step in since) > 2


# --- whole runs -------------------------------------------------------------------------------------


def whole(kind: str, number: int, seed: int, procedure: str, bench_name: str, folder: Path) -> Outcome:
    """Carry out a whole run over the wires, with and without a mistake, and compare the results."""
    plan, bench = setting(procedure, bench_name)
    run_seed = 1000 * seed + number
    mistake = None if kind == CLEAN else draw(kind, number, plan, bench.installation_models(), seed)
    place = pass_of(plan, mistake.index) if mistake else ""
    outcome = Outcome(kind, place, run_seed)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        runs = Path(temporary)
        run, trouble = _carried_out(runs, "run", plan, run_seed, procedure, bench_name, mistake)
        outcome = replace(outcome, trouble=trouble)
        signs = [event.data for event in run.history.events if event.type == EventType.EARLY_SIGN]
        stops = [data for data in signs if data["confident"]]
        if mistake is None:
            return replace(outcome, stopped=bool(stops), causes=tuple(stops[0]["causes"]) if stops else ())
        fed = watched(kind, number, seed, procedure, bench_name)
        outcome = replace(outcome, size=fed.size, large_at=fed.large_at, stopped=bool(stops))
        if stops:
            causes = tuple(stops[0]["causes"])
            begun = mistake.index if fed.large_at is None else fed.large_at
            reads = [i for i in range(begun, stops[0]["step"] + 1) if isinstance(plan.steps[i], Read)]
            late = max(len(reads) - 1, 0)
            outcome = replace(outcome, late=late, causes=causes, right=is_right(causes, mistake))
        if mistake.kind == "typed":  # the prompt asks again, so that nothing must be stopped
            stopped = fed.stopped and not stops
            outcome = replace(outcome, stopped=stopped, late=0, causes=fed.causes, right=fed.right)
        again, more = _carried_out(runs, "undisturbed", plan, run_seed, procedure, bench_name, None)
        worst = _difference(run, again) if not trouble + more else math.inf
        return replace(outcome, trouble=trouble + more, worst=worst, agrees=worst <= 1.0)


def _carried_out(
    runs: Path, name: str, plan: Plan, seed: int, procedure: str, bench_name: str, mistake: Mistake | None
) -> tuple[Run, str]:
    """Carry out a dry run with the mistaken operator; return the run and the reason if it stopped for good."""
    make, trouble = partial(MistakenOperator, plan=plan, mistake=mistake), ""
    with mock.patch("bench.run.assembly.served.ScriptedOperator", make):
        try:
            dry_run(procedure, bench_name, runs, name, seed)
        except Refused as why:
            trouble = str(why)
    return Run(runs / name), trouble


def _difference(run: Run, undisturbed: Run) -> float:
    """Return the largest difference of a coefficient, in units of its standard uncertainty."""
    vectors = []
    for one in (run, undisturbed):
        (source,) = load_sources(Request([str(one.folder)], one.folder.parent))
        with suppress(CalibrationError):
            vectors.append(calibration_of(source).calibration)
    if len(vectors) < 2:
        return math.inf
    off = vectors[0].block.vector - vectors[1].block.vector
    return float(np.max(np.abs(off) / np.sqrt(np.diag(vectors[1].covariance)[:12])))


# --- the campaign -----------------------------------------------------------------------------------


def table(outcomes: Sequence[Outcome]) -> tuple[list[str], bool]:
    """Return the lines of the table, and whether every limit is kept."""
    lines, kept = [], True
    for kind in KINDS:
        rows = [row for row in outcomes if row.kind == kind]
        large = [row for row in rows if row.size is not None and row.size >= LARGE]
        if not rows:
            continue
        in_time = sum(row.stopped and row.late is not None and row.late <= 1 for row in large)
        stopped = [row for row in large if row.stopped]
        right = sum(row.right for row in stopped)
        alone = sum(row.right and len(row.causes) == 1 for row in stopped)
        lines.append(
            f"{kind:24} {len(rows):5} runs, {len(large):5} of 8 sd; in time {Share(in_time, len(large))}; "
            f"right cause {Share(right, len(stopped))}, {alone} of them alone"
        )
        kept &= in_time >= IN_TIME * len(large) and right >= RIGHT * len(stopped)
        compared = [row for row in rows if row.agrees is not None and row.stopped]
        if compared:
            agree = sum(bool(row.agrees) for row in compared)
            worst = max(row.worst or 0.0 for row in compared)
            share = Share(agree, len(compared))
            lines.append(f"{'':24} after the redo within u: {share}, worst {worst:.2f} u")
            kept &= agree == len(compared)
    clean = [row for row in outcomes if row.kind == CLEAN]
    if clean:
        false = sum(row.stopped for row in clean)
        lines.append(f"{CLEAN:24} {len(clean):5} runs; false stops {Share(false, len(clean))}")
        kept &= not false
    troubles = [row for row in outcomes if row.trouble]
    lines += [f"TROUBLE {row.kind} seed {row.seed}: {row.trouble}" for row in troubles]
    return lines, kept and not troubles


def _one(part: str, seed: int, options: dict[str, Any], task: tuple[str, int]) -> Outcome:
    return (whole if part == "whole" else watched)(*task, seed, **options)


def main() -> int:
    given = arguments(
        __doc__, part={"positional": True, "choices": ["watcher", "whole"]},
        runs=(20, "runs of each kind of mistake"), clean=(50, "runs without a mistake"),
        kinds={"nargs": "*", "choices": KINDS, "help": "(default: all)"}, seed=1, jobs=(1, "processes"),
        procedure="calibration", bench="paper-stand",
    )  # fmt: skip
    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        options = {"procedure": given.procedure, "bench_name": given.bench}
        options |= {"folder": Path(folder)} if given.part == "whole" else {}
        tasks = [(kind, number) for number in range(given.runs) for kind in given.kinds or KINDS]
        tasks += [(CLEAN, number) for number in range(given.clean)]
        outcomes = list(spread(partial(_one, given.part, given.seed, options), tasks, given.jobs))
    took_s = time.monotonic() - begun_s
    print(f"{len(outcomes)} runs in {took_s:.0f} s with {given.jobs} processes, seed {given.seed}")
    lines, kept = table(outcomes)
    print("\n".join(lines))
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
