"""What a procedure will do on a bench, before it does it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.analysis.planning.remedies import Outlook, outlook
from bench.analysis.planning.settings import Cost, settings_of
from bench.analysis.planning.until.outlook import TimeOutlook
from bench.api.errors import Refused
from bench.api.learned import learned_for_run
from bench.api.taken import bench_path
from bench.api.traceability import remarks
from bench.api.until import outlook_until
from bench.base.forms import FileMistakes
from bench.devices.wires import is_serial
from bench.files.bench.file import BenchFile, load_bench
from bench.files.shipped import find_procedure
from bench.model import ForwardModel
from bench.procedure.check import (
    check,
    disk_needed_bytes,
    largest_signal_v,
    operator_actions,
    orientations,
    prompts_without_default,
    undetermined,
)
from bench.procedure.load import load_procedure
from bench.procedure.plan import Plan
from drivers.clock import utc_now


@dataclass(frozen=True)
class Findings:
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
    hints: tuple[str, ...]
    until: TimeOutlook | None = None

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
            "hints": list(self.hints),
            **({} if self.until is None else {"until": self.until.to_json()}),
        }


def look_ahead(procedure: str, bench: str | None, runs: Path, until: Sequence[str] = ()) -> Findings:
    """Return what a procedure will do on a bench; `runs` is the folder whose disk is looked at.

    `until` are the goals at which a run is to end. Raises `Refused` with the mistakes of both files, and
    for goals that cannot be reached.
    """
    plan, file = _load(procedure, bench)
    found = _find(plan, file, runs)
    if not until:
        return found
    learned = learned_for_run(file, bench_path(bench), utc_now().isoformat(), simulated=None)
    return replace(found, until=outlook_until(plan, file, until, learned))


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
        raise Refused("\n".join(mistakes))
    return plan, bench


def _find(plan: Plan, bench: BenchFile, runs: Path) -> Findings:
    supply = bench.unit_under_test.supply
    needed, free = disk_needed_bytes(plan), _free_bytes(runs)
    problems = check(plan, bench)
    if needed > free:
        problems.append(
            f"{runs}: a run needs about {disk_space(needed)} of disk, and {disk_space(free)} are free; make "
            "room or choose another folder with --runs"
        )
    undetermined_at = {at_c: undetermined(force) for at_c, force in orientations(plan, bench).items()}
    return Findings(
        plan=plan,
        bench=bench,
        problems=tuple(problems),
        unanswered=tuple(prompts_without_default(plan)),
        operator_actions=operator_actions(plan, bench),
        by_kind_s=plan.duration_by_kind_s(bench.line_frequency, supply),
        by_mount_s=plan.duration_by_mount_s(bench.line_frequency, supply),
        longest_s=plan.longest_duration_s(bench.line_frequency, supply),
        runs=runs,
        needed_bytes=needed,
        free_bytes=free,
        largest_signal_v=largest_signal_v(plan, bench),
        undetermined=undetermined_at,
        outlook=_outlook(plan, bench) if () in undetermined_at.values() else None,
        hints=tuple(_hints(bench)),
    )


def _hints(bench: BenchFile) -> Iterator[str]:
    """Say what is no mistake on a simulated bench, and likely one on a real one; and what certificates lack."""
    yield from remarks(bench)
    for meter in bench.instruments.voltmeters:
        if is_serial(meter.resource) and meter.interface == "lan":
            yield (
                f"{meter.name}: {meter.resource} is a serial port, and a meter there takes commands only when put "
                "into remote: say 'interface: rs232' (without it, it is taken for a meter of bench simulate)"
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


def disk_space(size: float) -> str:
    """Return a size in bytes as a person says it."""
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.4g} GB"
