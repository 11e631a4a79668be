"""Measure time and memory of each part of the program, and compare them with the promised limits.

The first word names the part:

    python -m benchmarks.speed plan      # expand, hash, check and list 100,000 steps
    python -m benchmarks.speed record    # check, resume and list records of 100,000 events
    python -m benchmarks.speed diagnosis --each 17
    python -m benchmarks.speed runs --runs 1 5 20   # one diagnosis of many runs

`plan`, `record` and `runs` work in separate processes, whose start is part of their cost. `diagnosis` uses
cases of the blind trial: nothing hidden, one effect, one effect outside the catalogue. Each is diagnosed
twice: first its threshold is simulated, then the threshold is in the cache. In `runs`, each run has the same
hidden effect of rho 2.3, which no single run shows. The exit status is 1 if a promise is broken.
"""

import argparse
import hashlib
import json
import math
import os
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from bench.base.arrays import Floats
from bench.config.bench_file.file import load_bench
from bench.config.procedure.steps import Mount, Read, Turn
from bench.config.shipped import find_bench
from bench.model import ForwardModel
from benchmarks.campaign import Cost, arguments, command, cost_of

# --- plan -------------------------------------------------------------------------------------------

STEPS: Final = 100_000
LONG_PLAN: Final = """\
procedure: long
on_failure: {repeat: 2, then: continue}
steps:
  - installation:
      label: 1
      steps:
        - temperatures:
            at: [23 degC, 50 degC, -20 degC]
            settle: {precision: 0.1 K, window: 30 min, timeout: 6 h}
            steps:
              - repeat:
                  times: %d
                  steps:
                    - input: {source: short}
                    - turn: {angles: {from: 0 deg, step: 45 deg, count: 9}}
"""
WAIT: Final = "- wait: {for: 1 s}\n"
PLANS: Final[dict[str, tuple[dict[str, str], float, float]]] = {
    "a few repeats": ({"long": LONG_PLAN % (STEPS // 3 // 31)}, 2.0, 200.0),
    "a line for each step": ({"long": "procedure: long\nsteps:\n" + WAIT * STEPS}, 4.0, 300.0),
    "seventeen files that include the next one twice": (
        {str(k): f"steps: [{{include: {k + 1}.yaml}}, {{include: {k + 1}.yaml}}]\n" for k in range(16)}
        | {"16": f"steps:\n{WAIT}", "long": "procedure: long\nsteps: [{include: 0.yaml}, {include: 1.yaml}]\n"},
        2.5, 200.0,
    ),
}  # fmt: skip
"""Files, largest CPU time (s) and largest memory (MB), by form of the plan.

In a file with a line for each step, every word is an event of the parser.
"""


def plan(given: argparse.Namespace) -> bool:
    """Print the cost of a plan that is made in several ways; return whether it is within limits."""
    print(f"{'':10} {'CPU / s':>8} {'peak / MB':>10}")
    kept = [cost_of(planned, name).result for name in PLANS]
    return all(kept)


def planned(name: str) -> bool:
    """Expand, hash, check and list a plan; print the time after each; return whether it is within limits."""
    from bench.config.procedure.check import check, disk_needed_bytes, operator_actions
    from bench.config.procedure.load import load_procedure
    from bench.results.check import listing

    files, limit_s, limit_mb = PLANS[name]
    print(f"{name}; the limits are {limit_s:g} s and {limit_mb:g} MB")
    bench = load_bench(find_bench("paper-stand"))
    with tempfile.TemporaryDirectory() as folder:
        for file, text in files.items():
            (Path(folder) / f"{file}.yaml").write_text(text, encoding="utf-8")
        begun = time.process_time()
        made = load_procedure(Path(folder) / "long.yaml").expand()
    lap("expanded", begun, f"{len(made.steps)} steps")
    lap("hashed", begun, made.hash[:12])
    check(made, bench)
    disk_needed_bytes(made)
    operator_actions(made, bench)
    made.duration_by_kind_s()
    spent_s, peak_mb = lap("checked", begun, "")
    lap("listed", begun, f"{sum(1 for _ in listing(made))} lines")
    return spent_s <= limit_s and peak_mb <= limit_mb


def lap(what: str, begun: float, note: str) -> tuple[float, float]:
    """Print and return the CPU time since `begun`, s, and the peak memory, MB."""
    spent_s = time.process_time() - begun
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{what:10} {spent_s:8.2f} {peak_mb:10.0f}   {note}", flush=True)
    return spent_s, peak_mb


# --- record -----------------------------------------------------------------------------------------

LIMIT_S, LIMIT_MB, LIMIT_RATIO, LIMIT_LIST_S = 5.0, 300.0, 3.0, 2.0
SAMPLES: Final = 10
LONG_RUN: Final = """\
procedure: long
reading: {samples: 10, nplc: 10}
steps:
  - installation:
      label: 1
      steps:
        - repeat: {times: %d, steps: [turn: {angles: {from: 0 deg, step: 45 deg, count: 9}}]}
"""


def record(given: argparse.Namespace) -> bool:
    """Print the cost of checking a long record, of resuming it, and of listing a thousand of them."""
    with tempfile.TemporaryDirectory(dir=Path()) as name, patch.dict(os.environ):
        os.environ["XDG_CACHE_HOME"] = str(Path(name) / "cache")
        folder = Path(name).absolute() / "runs" / "long"
        # in a separate process, because a child begins with the peak of its parent's memory
        cost_of(make_record, folder.parent, given.events)
        bare = cost_of(parsed, folder)
        bare_s = float(bare.result)
        show_cost("bare parsing and hashing", bare._replace(cpu_s=bare_s), "")
        show_cost("the program's start", cost_of(int), "")
        check = cost_of(command, "show", "long", "--verify", "--runs", folder.parent)
        ratio = check.cpu_s / bare_s
        show_cost("show --verify", check, f"{ratio:.2f} x the bare; the limit is {LIMIT_RATIO:g}")
        going_on = cost_of(resumed, folder)
        show_cost("resume to its first step", going_on, f"the limit is {LIMIT_S:g} s, {LIMIT_MB:g} MB")
        listed = cost_of(command, "runs", "--runs", copies(folder, given.many))
        show_cost("runs, once seen", listed, f"{given.many} runs; the limit is {LIMIT_LIST_S:g} s")
    kept = going_on.cpu_s <= LIMIT_S and going_on.peak_mb <= LIMIT_MB
    return kept and ratio <= LIMIT_RATIO and listed.cpu_s <= LIMIT_LIST_S


def show_cost(what: str, found: Cost, note: str) -> None:
    print(f"{what:26} {found.cpu_s:7.2f} s CPU {found.peak_mb:6.0f} MB   {note}", flush=True)


def make_record(runs: Path, events: int) -> None:
    """Write the run `long`, interrupted after `events` events, with some steps still to do."""
    from bench.run.events import Mounted, Result, Turned, result_to_json
    from bench.run.folder import Run
    from bench.services.execution import new_run
    from bench.services.requests.measuring import RunRequest

    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "long.yaml"
        file.write_text(LONG_RUN % (events // 2 // 18 + 10), encoding="utf-8")
        new = new_run(RunRequest(str(file), "paper-stand", runs=runs, dry_run=True, seed=1, name="long"))
    rng = np.random.default_rng(1)
    signals = signals_of_pass()
    with patch("os.fsync"):  # the time of the disk does not count in these figures
        written = new.record()
        written.append("run_started", 0.0, step=0, instruments={})
        angle_deg, bench_s = 0.0, 0.0
        for index, step in enumerate(Run(new.folder).plan.steps[: (events - 2) // 2]):
            begun = {"step": index, "key": step.key, "attempt": 1}
            bench_s = 10.0 * index
            written.append("step_started", bench_s, **begun)
            result: Result | None = None
            if isinstance(step, Mount):
                result = Mounted(None)
            elif isinstance(step, Turn):
                angle_deg = math.degrees(step.target_rad)
                result = Turned(angle_deg, angle_deg)
            elif isinstance(step, Read):
                samples = signals[round(angle_deg)] + 1e-4 * rng.standard_normal((SAMPLES, 3))
                result = reading_of(step, angle_deg, bench_s, samples)
            written.append("step_done", bench_s + 5.0, **begun, **result_to_json(result))
        written.append("run_interrupted", bench_s + 6.0)
        written.close()


def signals_of_pass() -> dict[int, Floats]:
    """Return the signals of the stated block at the angles of a pass, V, by angle in degrees."""
    from bench.readings.table import make_readings

    bench = load_bench(find_bench("paper-stand"))
    degrees = np.arange(9) * 45.0
    pass_ = (["1"] * 9, [1] * 9, list(range(1, 10)), np.radians(degrees), np.zeros((9, 3)))
    rows = make_readings(*pass_, source="angles").conditions()
    at = ForwardModel(bench.installation_models()).readings(bench.simulated_block(), rows, np.zeros((1, 5)))
    return {round(angle): signal for angle, signal in zip(degrees, at, strict=True)}


def reading_of(step: Read, angle_deg: float, time_s: float, samples: Floats) -> Any:
    """Return a reading with samples (n, 3), V, and all else that a bench records of a reading."""
    from bench.readings.table import Reading
    from bench.run.samples import describe
    from drivers.interfaces import CHANNELS

    columns = dict(zip(CHANNELS, samples.T.tolist(), strict=True))
    found = [describe(columns)[channel] for channel in CHANNELS]
    told: Any = {
        name: tuple(getattr(of, name) for of in found) for name in ("mean", "sd", "drift", "drift_p")
    }
    return Reading(
        installation="1", series=1, pass_number=step.pass_number, point=step.point, target_deg=angle_deg,
        angle_deg=angle_deg, direction=1, time_s=time_s, temperature_c=20.0, samples_taken=SAMPLES,
        samples=columns, scan_order="xyz", **told,
    )  # fmt: skip


def parsed(folder: Path) -> float:
    """Parse and hash every line, without anything else; return the CPU time, s."""
    begun = time.process_time()
    with (folder / "events.jsonl").open("rb") as file:
        for line in file:
            json.loads(line)
            hashlib.sha256(line).hexdigest()
    return time.process_time() - begun


def resumed(folder: Path) -> None:
    """Carry out `bench resume RUN` up to its first step."""
    from bench.run.workbench import Workbench

    def begun(*given: object) -> None:
        raise SystemExit

    with patch.object(Workbench, "execute", begun), patch.object(Workbench, "still_mounted", begun):
        command("resume", folder.name, "--runs", folder.parent)


def copies(folder: Path, number: int) -> Path:
    """Make `number` runs from the files of one, of which only the first is read; return their folder.

    The others are marked as read already, as they would be minutes after a first listing.
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


# --- diagnosis and runs -----------------------------------------------------------------------------

FIRST_S, AGAIN_S = 60.0, 1.0
RUNS_S, RUNS_MB = 30.0, 700.0
RHO: Final = 2.3


def diagnosis(given: argparse.Namespace) -> bool:
    """Print the CPU time, s, of everything that `bench diagnose` computes, on one core, by verdict."""
    from bench.diagnosis import ThresholdCache
    from bench.diagnosis.pipeline import diagnose_fully
    from benchmarks.blind_trial.adapter import LOCAL_GRAVITY, STATED_BENCH
    from benchmarks.blind_trial.cases import Row, make_case

    bench = load_bench(find_bench(STATED_BENCH))
    model = ForwardModel(bench.installation_models())
    spent: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        cache = ThresholdCache(Path(folder))
        for row in (Row("null"), Row("single", rho=20.0), Row("outside", rho=20.0)):
            for index in range(given.each):
                case, _ = make_case(5, row, index)
                for what in ("a first design", ""):
                    begun = time.process_time()
                    full = diagnose_fully(
                        case.readings, model, bench, LOCAL_GRAVITY, cache, source=case.id, simulated=True
                    )
                    spent[what or full.diagnosis.verdict].append(time.process_time() - begun)
    print("| verdict | cases | CPU, s: median | largest |\n|---|---|---|---|")
    for verdict, took in spent.items():
        print(f"| {verdict} | {len(took)} | {np.median(took):.2f} | {max(took):.2f} |")
    first = spent.pop("a first design")
    return max(first) < FIRST_S and all(max(took) < AGAIN_S for took in spent.values())


def many_runs(given: argparse.Namespace) -> bool:
    """Print the cost of one diagnosis of many runs, with its page, compared with that of one run."""
    kept = True
    print("runs  blocks     CPU / s   ratio   peak / MB   ratio   verdict")
    for blocks in (False, True):
        first: Cost | None = None
        for runs in given.runs:
            found = cost_of(diagnosed, runs, blocks)
            first = first or found
            kept = kept and (runs > 20 or (found.cpu_s <= RUNS_S and found.peak_mb <= RUNS_MB))
            of = "a block each" if blocks else "one block"
            times, larger = found.cpu_s / first.cpu_s, found.peak_mb / first.peak_mb
            print(f"{runs:4}  {of:12} {found.cpu_s:6.1f}  {times:5.1f}  {found.peak_mb:9.0f}  {larger:6.1f}   "
                  f"{found.result}", flush=True)  # fmt: skip
    return kept


def diagnosed(runs: int, blocks: bool) -> str:
    """Return the verdict of a diagnosis that is made in this process."""
    from bench.diagnosis import ThresholdCache
    from bench.diagnosis.pipeline import diagnose_fully
    from bench.results.diagnosis_page import render_diagnosis
    from bench.results.diagnosis_words import NO_FILES
    from benchmarks.blind_trial.cases import Row, make_case

    case, _ = make_case(1, Row("single", rho=RHO, runs=runs, blocks=blocks), 0)
    bench = load_bench(find_bench("paper-stand"))
    model = ForwardModel(bench.installation_models())
    full = diagnose_fully(
        case.readings, model, bench, 9.81, ThresholdCache(None), source="many", simulated=False, stated=False
    )
    render_diagnosis(full, NO_FILES, "many", bench.verification.limit, {"model": model.name})
    return full.diagnosis.verdict


PARTS: Final[dict[str, Callable[[argparse.Namespace], bool]]] = {
    "plan": plan, "record": record, "diagnosis": diagnosis, "runs": many_runs,
}  # fmt: skip


def main() -> int:
    given = arguments(
        __doc__, part={"positional": True, "choices": PARTS}, events=(100_000, "of a long record"),
        many=(1000, "runs that are listed"), each=(17, "diagnosed cases of each kind"),
        runs=([1, 5, 20], "runs of one diagnosis"),
    )  # fmt: skip
    return 0 if PARTS[given.part](given) else 1


if __name__ == "__main__":
    sys.exit(main())
