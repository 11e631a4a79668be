"""What the check block says of a run that is to begin: it may, it may with a word, or it may not."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bench.api.errors import Refused
from bench.base.words import duration
from bench.files.bench.check_block import CheckBlockSection
from bench.files.bench.file import BenchFile
from bench.run.folder import Run
from bench.run.manifest import CheckedBefore, Manifest
from drivers.clock import utc_now

if TYPE_CHECKING:
    from bench.api.check_block import CheckBlockChart

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
    from bench.api.check_block import (
        chart_of,
        check_block_runs,
    )  # with all that charts need: most runs have none

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
    from bench.api.check_block import is_check_block

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
