"""Which runs a control chart is of, and whether the check block lets a run begin."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from bench.base.text import duration
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import CheckBlockSection
from bench.run.events import MANIFEST, CheckedBefore, Manifest, RecordError
from bench.run.folder import Run, all_runs, find_run
from bench.services.arguments import CHARTED, checked
from bench.services.bench_selection import find_bench_file, own_bench
from bench.services.check_block import CheckBlockChart, chart_of, check_block_runs, is_check_block
from bench.services.errors import Refused
from drivers.clock import utc_now


@dataclass(frozen=True)
class ChartedRuns:
    """Runs of a check block, what the bench file says of it, and where that file is."""

    runs: list[Run]
    section: CheckBlockSection
    bench_file: Path


def charted_runs(
    sources: Sequence[str], folder: Path, bench: str | None, *, real: bool | None = None
) -> ChartedRuns:
    """Return the runs that are named, or in one folder those of its bench's check block.

    The bench file is the one asked for, that of BENCH_FILE, or that which the latest run of a check block recorded.
    `real` says which runs of a folder are meant. Raises `Refused` where there are none.
    """
    place = Path(sources[0])
    if len(sources) == 1 and place.is_dir() and not (place / MANIFEST).is_file():
        return _in_folder(place, bench, real)
    named = [find_run(name, folder) for name in sources]
    file, path = _bench_file(bench, named[-1])
    section = file.check_block or CheckBlockSection(serial=file.unit_under_test.serial, drift={})
    return ChartedRuns(named, section, path)


@checked(runs=CHARTED)
def chart(
    runs: str | Path | Sequence[str | Path] | None = None, *, bench: str | Path | None = None
) -> CheckBlockChart:
    """Return the control chart of a check block, as `bench chart` finds it.

    `runs` are runs of the check block by name or path, or the folder in which they are (BENCH_RUNS, or ./runs).
    `bench` states the check block; without it the bench file counts that the latest of its runs recorded.
    """
    folder = Path(os.environ.get("BENCH_RUNS") or "runs")
    given = [folder] if runs is None else [runs] if isinstance(runs, str | Path) else list(runs)
    found = charted_runs([str(one) for one in given], folder, None if bench is None else str(bench))
    return chart_of(found.runs, found.section, of_bench=found.bench_file, folder=folder)


def _bench_file(bench: str | None, run: Run) -> tuple[BenchFile, Path]:
    if bench or os.environ.get("BENCH_FILE"):
        taken = find_bench_file(bench)
        return taken.file, Path(taken.where)
    return own_bench(run)


def _in_folder(folder: Path, bench: str | None, real: bool | None) -> ChartedRuns:
    kinds = (True, False) if real is None else (not real,)
    file, path, latest = _of_folder(folder, bench, kinds)
    section = file.check_block
    if section is None:
        raise Refused(f"{path}: states no check_block; add it, or name the runs of the check block")
    simulated = latest.simulated if latest is not None else kinds[0]
    runs = check_block_runs(file, folder, simulated=simulated)
    if not runs:
        raise Refused(
            f"{folder}: no finished run of the check block {section.serial} of {file.name} there; measure it with "
            f"bench run PROCEDURE --unit {section.serial}"
        )
    return ChartedRuns(runs, section, path)


def _of_folder(folder: Path, bench: str | None, kinds: Sequence[bool]) -> tuple[BenchFile, Path, Run | None]:
    """Return the bench file, where it is, and the latest run of its check block, if there is one."""
    asked = bench or os.environ.get("BENCH_FILE")
    given = find_bench_file(bench) if asked else None
    for run in reversed(all_runs(folder)):
        try:
            unit = run.manifest.get("unit_under_test")
            if unit is None or run.simulated not in kinds:
                continue
            file, path = (given.file, Path(given.where)) if given else _bench_file(None, run)
        except (RecordError, OSError, ValueError):
            continue
        if is_check_block(file, unit):
            return file, path, run
    if given:
        return given.file, Path(given.where), None
    raise Refused(
        f"{folder}: no run of a check block there; say --bench FILE whose check_block names it, and measure it "
        "with bench run PROCEDURE --unit SERIAL"
    )


HOUR_S: Final = 3600.0
IN_CONTROL: Final = "in control"


@dataclass(frozen=True)
class CheckBefore:
    """The last check of a bench: `state` (in control, out of control, too old, missing), in a sentence.

    `run` is the run of the check block, empty where there is none, `age_s` how old it is.
    """

    state: str
    sentence: str
    run: str = ""
    age_s: float = 0.0

    @property
    def fine(self) -> bool:
        """Whether nothing speaks against a run."""
        return self.state == IN_CONTROL

    def recorded(self, rule: str, reason: str | None) -> CheckedBefore:
        """Return what a manifest says of it; `reason` is why it was set aside, where it was."""
        told: CheckedBefore = {"rule": rule, "state": self.state, "said": self.sentence}
        if self.run:
            told["run"] = self.run
            told["age_h"] = round(self.age_s / HOUR_S, 3)
        if reason is not None and not self.fine:
            told["despite"] = reason
        return told


def check_before(bench: BenchFile, path: Path, runs: Path, now: datetime, *, simulated: bool) -> CheckBefore:
    """Return what the last run of the check block says, now. Raises `Refused` where its chart cannot be made."""
    from bench.services.check_block import (  # with all that charts need: most runs have none
        chart_of,
        check_block_runs,
    )

    section = bench.check_block
    if section is None:
        raise Refused(f"{path}: states no check_block; add it, or leave the check out")
    found = check_block_runs(bench, runs, simulated=simulated)
    kind = " simulated" if simulated else ""
    if not found:
        return CheckBefore(
            "missing", f"no{kind} run of the check block {section.serial} of {bench.name} is in {runs}"
        )
    chart = chart_of(found, section, of_bench=path, folder=runs)
    return _judged(chart, section, found, now)


def _judged(
    chart: CheckBlockChart, section: CheckBlockSection, found: list[Run], now: datetime
) -> CheckBefore:
    verdicts = chart.chart.verdicts
    if not verdicts:
        (run, *_) = chart.chart.baseline
        return CheckBefore(
            "missing",
            f"{run.name} is the first run of the check block {section.serial}: nothing is there yet to hold it "
            "against; measure it once more",
        )
    last = verdicts[-1]
    age_s = max(0.0, (now - last.when).total_seconds())
    if not last.accepted:
        said = f"the last run of the check block, {last.run}, is OUT OF CONTROL: {'; '.join(last.reasons)}"
        return CheckBefore("out of control", said, last.run, age_s)
    newest = found[-1].name
    if newest != last.run and newest not in {run.name for run in chart.chart.baseline}:
        return CheckBefore(
            "missing",
            f"the last run of the check block, {newest}, gives no calibration: {'; '.join(chart.notes)}",
        )
    hours = f"{age_s / HOUR_S:.1f} h"
    if age_s > section.max_age:
        counts = duration(section.max_age)
        said = f"the last run of the check block, {last.run}, is {hours} old; it counts for {counts}"
        return CheckBefore("too old", said, last.run, age_s)
    return CheckBefore(IN_CONTROL, f"{last.run}, {hours} ago, was in control", last.run, age_s)


def checked_before(
    manifest: Manifest, bench: BenchFile, path: Path, runs: Path, despite: str | None
) -> tuple[str, ...]:
    """Hold a run that is to begin to the check block of its bench: into its manifest, and in words.

    `despite` is why it is begun whatever the check says. Raises `Refused` where the bench file says so. A run of
    the check block itself is not held to it.
    """
    if bench.check_block is None:
        raise Refused(
            f"{path}: states no check_block; --check-block and --despite-check go with one that does"
        )
    if despite is not None and (not despite.strip() or not despite.isprintable()):
        raise Refused("--despite-check: say in words why the run is begun all the same; the record keeps it")
    from bench.services.check_block import is_check_block

    if is_check_block(bench, manifest["unit_under_test"]):
        return ("this is a run of the check block: its chart follows it",)
    rule = bench.check_block.rule
    found = check_before(bench, path, runs, utc_now(), simulated=bool(manifest["dry_run"]))
    told = refuse_or_tell(found, rule, despite)
    manifest["check_block"] = found.recorded(rule, despite)
    return told


def refuse_or_tell(found: CheckBefore, rule: str, reason: str | None) -> tuple[str, ...]:
    """Return what is to be told of a check. Raises `Refused` where the rule says so and no reason sets it aside."""
    if found.fine:
        return (f"check block: {found.sentence}",)
    if reason is not None:
        return (f"check block: {found.sentence}; the run goes on, as {reason!r} is on record",)
    if rule == "warn":
        return (f"CHECK BLOCK: {found.sentence}; the bench file's rule is to warn, and the run goes on",)
    raise Refused(
        f"check block: {found.sentence}. The bench file refuses a run then: measure the check block "
        "('bench chart' shows its chart), or say --despite-check 'REASON', which the record keeps"
    )
