"""check, init: what a procedure will do on a bench, before it does it; copies of the shipped files."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from bench.analysis.planning.remedies import Outlook, outlook
from bench.analysis.planning.settings import Cost, settings_of
from bench.base.forms import FileMistakes
from bench.cli import CommandError, printing
from bench.cli.source import bench_path, write_json
from bench.files.bench.file import BenchFile, load_bench
from bench.files.shipped import copy_shipped, find_procedure
from bench.model import ForwardModel
from bench.model.block import COEFFICIENTS
from bench.procedure.check import check as check_against
from bench.procedure.check import (
    disk_needed_bytes,
    largest_signal_v,
    operator_actions,
    orientations,
    prompts_without_default,
    undetermined,
)
from bench.procedure.listing import listing
from bench.procedure.load import load_procedure
from bench.procedure.plan import Plan
from bench.run.terminal import duration


@dataclass(frozen=True)
class _Findings:
    """What is known of a plan on a bench before it is carried out."""

    plan: Plan
    bench: BenchFile
    problems: tuple[str, ...]
    unanswered: tuple[str, ...]
    operator_actions: int
    by_kind_s: Mapping[str, float]
    by_mount_s: Mapping[str, float]
    longest_s: float
    runs: Path
    needed_bytes: int
    free_bytes: int
    largest_signal_v: float
    undetermined: Mapping[float | None, tuple[str, ...]]
    outlook: Outlook | None

    @property
    def expected_s(self) -> float:
        """Expected time of the whole plan, s."""
        return sum(self.by_kind_s.values())

    def to_json(self) -> dict[str, Any]:
        """Return the findings as JSON values."""
        return {
            "procedure": self.plan.name,
            "bench": self.bench.name,
            "plan_hash": self.plan.hash,
            "steps": len(self.plan.steps),
            "counts": self.plan.counts(),
            "operator_actions": self.operator_actions,
            "expected_s": self.expected_s,
            "expected_by_kind_s": dict(self.by_kind_s),
            "expected_by_installation_s": dict(self.by_mount_s),
            "longest_s": self.longest_s,
            "disk": {
                "folder": str(self.runs),
                "needed_bytes": self.needed_bytes,
                "free_bytes": self.free_bytes,
            },
            "largest_signal_v": self.largest_signal_v,
            "not_determined": [
                {"temperature_c": at_c, "coefficients": list(names)}
                for at_c, names in self.undetermined.items()
            ],
            "observability": self.outlook and self.outlook.to_json(),
            "problems": list(self.problems),
            "dry_run_refuses": list(self.unanswered),
        }


def check(
    procedure: str,
    bench_name: str | None,
    target: str | None,
    *,
    every_step: bool = False,
    runs: Path = Path("runs"),
) -> int:
    """Carry out `bench check`; 1 when the procedure cannot be carried out on the bench.

    `every_step` lists each step in a line of its own; `runs` is the folder whose disk is looked at. Raises
    `CommandError` with the mistakes of both files.
    """
    plan, bench = _load(procedure, bench_name)
    found = _find(plan, bench, runs)
    write_json([found.to_json()], target)
    if target != "-":
        _print(found, every_step=every_step)
        _offer_dry_run(found, procedure, bench_name)
    return 1 if found.problems else 0


def _load(procedure: str, bench_name: str | None) -> tuple[Plan, BenchFile]:
    plan: Plan | None = None
    bench: BenchFile | None = None
    mistakes = []
    try:
        plan = load_procedure(find_procedure(procedure)).expand()
    except FileMistakes as error:
        mistakes.append(str(error))
    try:
        bench = load_bench(bench_path(bench_name))
    except FileMistakes as error:
        mistakes.append(str(error))
    if plan is None or bench is None:
        raise CommandError("\n".join(mistakes))
    return plan, bench


def _find(plan: Plan, bench: BenchFile, runs: Path) -> _Findings:
    needed, free = disk_needed_bytes(plan), _free_bytes(runs)
    problems = check_against(plan, bench)
    if needed > free:
        problems.append(
            f"{runs}: a run needs about {_told_bytes(needed)} of disk, and {_told_bytes(free)} are free; make "
            "room or choose another folder with --runs"
        )
    undetermined_at = {at_c: undetermined(force) for at_c, force in orientations(plan, bench).items()}
    return _Findings(
        plan=plan,
        bench=bench,
        problems=tuple(problems),
        unanswered=tuple(prompts_without_default(plan)),
        operator_actions=operator_actions(plan, bench),
        by_kind_s=plan.duration_by_kind_s(bench.line_frequency),
        by_mount_s=plan.duration_by_mount_s(bench.line_frequency),
        longest_s=plan.longest_duration_s(bench.line_frequency),
        runs=runs,
        needed_bytes=needed,
        free_bytes=free,
        largest_signal_v=largest_signal_v(plan, bench),
        undetermined=undetermined_at,
        outlook=_outlook(plan, bench) if () in undetermined_at.values() else None,
    )


def _outlook(plan: Plan, bench: BenchFile) -> Outlook | None:
    """What a calibration from the plan leaves open; None where an installation is not known."""
    settings = settings_of(plan)
    installations = bench.installation_models()
    if not {s.mount.installation for s in settings} <= set(installations):
        return None
    cost = Cost.of_plan(plan, bench.line_frequency)
    return outlook(settings, ForwardModel(installations), bench.nominal_block(), cost)


def _free_bytes(folder: Path) -> int:
    """Return what is free on the disk of a folder, or of the nearest one above it that is there."""
    path = folder.resolve()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free


# --- printed ----------------------------------------------------------------------------------------


def _print(found: _Findings, *, every_step: bool) -> None:
    out = printing.console()
    plan, bench = found.plan, found.bench
    for line in listing(plan, every_step=every_step):
        steps = f"{line.first}" if line.first == line.last else f"{line.first}–{line.last}"
        out.print(f"{steps:>13}  {line.text}")
    counts = {kind: str(count) for kind, count in plan.counts().items()}
    _print_times(out, "step", found.by_kind_s, counts)
    _print_times(out, "installation", {name or "before": s for name, s in found.by_mount_s.items()}, {})
    at_most = f" (at most {duration(found.longest_s)})" if found.longest_s > found.expected_s else ""
    out.print(
        f"{plan.name} on {bench.name}: {len(plan.steps)} steps, {found.operator_actions} operator actions, "
        f"about {duration(found.expected_s)}{at_most}; plan {plan.hash[:12]}"
    )
    out.print(
        f"signals up to {found.largest_signal_v:.3g} V at nominal scale factors, on the "
        f"{bench.voltmeter_range_v:g} V range; about {_told_bytes(found.needed_bytes)} in {found.runs}, where "
        f"{_told_bytes(found.free_bytes)} are free"
    )
    for sentence in _told_coefficients(found.undetermined):
        out.print(sentence)
    for sentence in _told_outlook(found.outlook):
        out.print(sentence)
    for problem in found.problems:
        out.print(f"cannot be done: {problem}")
    for sentence in found.unanswered:
        out.print(f"a dry run refuses it: {sentence}")


def _print_times(out: Console, heading: str, times_s: Mapping[str, float], counts: Mapping[str, str]) -> None:
    table = Table(box=None, pad_edge=False)
    table.add_column(heading)
    if counts:
        table.add_column("count", justify="right")
    table.add_column("expected time", justify="right")
    for name, seconds in times_s.items():
        table.add_row(name, *([counts[name]] if counts else []), duration(seconds))
    out.print(table)


def _told_coefficients(undetermined: Mapping[float | None, tuple[str, ...]]) -> Iterator[str]:
    """Say which coefficients a calibration from the plan determines; by temperature where there are several."""
    if not undetermined:
        yield "no calibration: it has no reading in an installation of known orientation"
    for names in dict.fromkeys(undetermined.values()):
        temperatures = [at_c for at_c, these in undetermined.items() if these == names]
        told = ", ".join("the first temperature" if at_c is None else f"{at_c:g} °C" for at_c in temperatures)
        where = f"at {told}: " if len(undetermined) > 1 else ""
        if not names:
            yield f"{where}determines all twelve coefficients"
        elif len(names) == len(COEFFICIENTS):
            yield f"{where}no calibration: the orientations determine none of the twelve coefficients"
        else:
            determined = [name for name in COEFFICIENTS if name not in names]
            yield (
                f"{where}no calibration by itself: the orientations determine {', '.join(determined)} and "
                f"leave {', '.join(names)} open"
            )


def _told_outlook(found: Outlook | None) -> Iterator[str]:
    """Say what the readings leave open between coefficients and stand, and the cheapest ways to show it."""
    if found is None:
        return
    for sentence in found.open:
        yield f"leaves open: {sentence}"
    if found.open:
        ways = "; ".join(f"{r.text} ({_told_cost(r.cost_s)})" for r in found.remedies[:_WAYS_TOLD])
        yield f"would be shown by: {ways or 'nothing that this bench can do'}"
    if found.turns:
        yield (
            f"leaves open, as every procedure on one head does: a common turn of the block's axes (about "
            f"{', '.join(found.turns)}); the limits of the stand's angles alone hold it"
        )


_WAYS_TOLD: Final = 2


def _told_cost(seconds: float) -> str:
    return f"about {duration(seconds)} more" if seconds else "no further readings"


def _offer_dry_run(found: _Findings, procedure: str, bench_name: str | None) -> None:
    if found.problems or found.unanswered:
        return
    on = f" --bench {bench_name}" if bench_name else ""
    printing.console().print(
        f"no mistakes found; try it in seconds with: bench run {procedure}{on} --dry-run"
    )


def _told_bytes(size: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.4g} GB"


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
