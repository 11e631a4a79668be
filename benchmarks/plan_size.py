"""What a plan of 100,000 steps costs: CPU time and memory to expand, hash, list and check it.

Made by a few repeats, by a file that says each step, by files that include one another twice; each in a process
of its own, with the bare import of the program beside it:

    python -m benchmarks.plan_size
"""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

STEPS = 100_000
LIMITS = {"repeats": (2.0, 200.0), "every_step": (4.0, 300.0), "doubled": (2.5, 200.0)}
"""CPU time, s, and memory, MB: in a file that says each step every word is an event of YAML's parser."""

PROCEDURE = """\
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
STEPS_OF_A_PASS = 4 + 9 * 3
REPEATS = STEPS // 3 // STEPS_OF_A_PASS


def repeats(folder: Path) -> None:
    """A few lines, many repeats."""
    (folder / "long.yaml").write_text(PROCEDURE % REPEATS, encoding="utf-8")


def every_step(folder: Path) -> None:
    """A line for each step."""
    text = "procedure: long\nsteps:\n" + "- wait: {for: 1 s}\n" * STEPS
    (folder / "long.yaml").write_text(text, encoding="utf-8")


def doubled(folder: Path) -> None:
    """Seventeen files, each of which includes the next one twice, but for the first."""
    for k in range(16):
        step = f"{{include: {k + 1}.yaml}}"
        (folder / f"{k}.yaml").write_text(f"steps: [{step}, {step}]\n", encoding="utf-8")
    (folder / "16.yaml").write_text("steps: [{wait: {for: 1 s}}]\n", encoding="utf-8")
    text = "procedure: long\nsteps: [{include: 0.yaml}, {include: 1.yaml}]\n"
    (folder / "long.yaml").write_text(text, encoding="utf-8")


def measure(write: Callable[[Path], None] | None) -> None:
    from bench.config.bench_file.file import load_bench
    from bench.config.procedure.check import check, disk_needed_bytes, operator_actions
    from bench.config.procedure.load import load_procedure
    from bench.config.shipped import find_bench
    from bench.results.check import listing

    bench = load_bench(find_bench("paper-stand"))
    begun = time.process_time()
    if write is not None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "long.yaml"
            write(Path(folder))
            plan = load_procedure(file).expand()
        lap("expanded", begun, f"{len(plan.steps)} steps")
        lap("hashed", begun, plan.hash[:12])
        check(plan, bench)
        disk_needed_bytes(plan)
        operator_actions(plan, bench)
        plan.duration_by_kind_s()
        limit_s, limit_mb = LIMITS[write.__name__]
        lap("checked", begun, f"the limit is {limit_s:g} s and {limit_mb:g} MB")
        lines = sum(1 for _ in listing(plan))
        lap("listed", begun, f"{lines} lines")
    else:
        lap("imported", begun, "nothing expanded")


def lap(what: str, begun: float, note: str) -> None:
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{what:10} {time.process_time() - begun:8.2f} {peak_mb:10.0f}   {note}", flush=True)


def main() -> None:
    print(f"{'':10} {'CPU / s':>8} {'peak / MB':>10}")
    context = multiprocessing.get_context("spawn")
    for write in (None, repeats, every_step, doubled):
        print(f"{write.__doc__ if write else 'Nothing.'}")
        process = context.Process(target=measure, args=(write,))
        process.start()
        process.join()


if __name__ == "__main__":
    main()
