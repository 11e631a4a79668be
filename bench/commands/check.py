"""check, init: what a procedure will do on a bench, before it does it; copies of the shipped files."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from bench.bench_file import BenchFile, load_bench
from bench.commands import CommandError, printing
from bench.commands.source import bench_path, write_json
from bench.plan import Plan
from bench.procedure import check as check_against
from bench.procedure import load_procedure
from bench.shipped import copy_shipped, find_procedure
from bench.terminal import duration


def check(procedure: str, bench_name: str | None, target: str | None) -> int:
    """Carry out `bench check`; 1 when the procedure cannot be carried out on the bench."""
    plan = load_procedure(find_procedure(procedure)).expand()
    bench = load_bench(bench_path(bench_name))
    problems = check_against(plan, bench)
    write_json([_summary(plan, bench, problems)], target)
    if target == "-":
        return 1 if problems else 0
    out = printing.console()
    for number, step in enumerate(plan.steps, start=1):
        out.print(f"{number:5d}  {step.describe()}")
    table = Table(box=None, pad_edge=False)
    for heading in ("step", "count", "expected time"):
        table.add_column(heading, justify="left" if heading == "step" else "right")
    times = plan.duration_by_kind_s()
    for kind, count in plan.counts().items():
        table.add_row(kind, str(count), duration(times[kind]))
    out.print(table)
    out.print(
        f"{plan.name} on {bench.name}: {len(plan.steps)} steps, {plan.operator_actions()} operator actions, "
        f"about {duration(sum(times.values()))}; plan {plan.hash[:12]}"
    )
    for problem in problems:
        out.print(f"cannot be done: {problem}")
    if not problems:
        out.print(f"no mistakes found; try it with: bench run {procedure} --dry-run")
    return 1 if problems else 0


def _summary(plan: Plan, bench: BenchFile, problems: list[str]) -> dict[str, object]:
    return {
        "procedure": plan.name,
        "bench": bench.name,
        "plan_hash": plan.hash,
        "steps": len(plan.steps),
        "counts": plan.counts(),
        "operator_actions": plan.operator_actions(),
        "expected_s": sum(plan.duration_by_kind_s().values()),
        "problems": problems,
    }


def init(folder: Path) -> int:
    """Carry out `bench init`: copies of the shipped files, never over a file that is there."""
    try:
        copied = copy_shipped(folder)
    except OSError as error:
        raise CommandError(
            f"{folder}: cannot be written ({error.strerror}); choose another folder"
        ) from error
    out = printing.console()
    for path in copied:
        out.print(f"wrote {path}")
    if not copied:
        out.print(f"{folder}: every shipped file is there already; nothing was written")
    return 0
