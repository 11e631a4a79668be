"""The check of a bench by its check block before a run begins."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from bench.base.arrays import HOUR
from bench.base.languages import message
from bench.base.text import duration
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import CheckBlockSection
from bench.results.control_chart import CheckBlockChart
from bench.run.events import CheckedBefore, Manifest
from bench.run.folder import Run
from bench.services.check_block import chart_of, check_block_runs, is_check_block
from bench.services.errors import Refused
from drivers.clock import utc_now

IN_CONTROL: Final = "in control"


@dataclass(frozen=True)
class CheckBefore:
    """The last check of a bench: `state` is "in control", "out of control", "too old" or "missing".

    `sentence` states the reason. `run` is the name of the charted run that was judged, "" for "missing", and
    `age_s` is its age in s.
    """

    state: str
    sentence: str
    run: str = ""
    age_s: float = 0.0

    @property
    def fine(self) -> bool:
        """Whether the last check found the bench in control, and is not too old."""
        return self.state == IN_CONTROL

    def recorded(self, rule: str, reason: str | None) -> CheckedBefore:
        """Return the check for a manifest, with the bench file's `rule` and the `reason` to begin despite it."""
        told: CheckedBefore = {"rule": rule, "state": self.state, "said": self.sentence}
        if self.run:
            told["run"] = self.run
            told["age_h"] = round(self.age_s / HOUR, 3)
        if reason is not None and not self.fine:
            told["despite"] = reason
        return told


def check_before(bench: BenchFile, path: Path, runs: Path, now: datetime, *, simulated: bool) -> CheckBefore:
    """Judge a bench by the last run of its check block, as of `now`.

    Raises `Refused` for a bench file without section check_block, and as `chart_of`.
    """
    section = bench.check_block
    if section is None:
        raise Refused(f"{path}: the bench file has no section check_block; add it, or leave out the check")
    found = check_block_runs(bench, runs, simulated=simulated)
    if not found:
        said = message(
            f"no{' simulated' if simulated else ''} run of the check block {section.serial} of {bench.name} is in "
            f"{runs}"
        )
        return CheckBefore("missing", said)
    chart = chart_of(found, section, of_bench=path, folder=runs)
    return _judged(chart, section, found, now)


def _judged(
    chart: CheckBlockChart, section: CheckBlockSection, found: list[Run], now: datetime
) -> CheckBefore:
    verdicts = chart.chart.verdicts
    if not verdicts:
        (run, *_) = chart.chart.baseline
        said = message(
            f"{run.name} is the first run of the check block {section.serial}: there is nothing to "
            "compare with; measure it again"
        )
        return CheckBefore("missing", said)
    last = verdicts[-1]
    age_s = (now - last.when).total_seconds()
    if not last.accepted:
        reasons = "; ".join(last.reasons)
        said = message(f"the last run of the check block, {last.run}, is OUT OF CONTROL: {reasons}")
        return CheckBefore("out of control", said, last.run, max(0.0, age_s))
    if age_s < 0.0:  # it would be the last run, and fresh, until the clock has caught up
        said = message(
            f"the last run of the check block, {last.run}, is dated {last.when.astimezone(UTC):%Y-%m-%d %H:%M} "
            "UTC, later than now; set the computer's clock"
        )
        return CheckBefore("missing", said)
    newest = found[-1].name
    if newest != last.run and newest not in {run.name for run in chart.chart.baseline}:
        notes = "; ".join(chart.notes)
        said = message(f"the last run of the check block, {newest}, gives no calibration: {notes}")
        return CheckBefore("missing", said)
    hours = f"{age_s / HOUR:.1f} h"
    if age_s > section.max_age:
        counts = duration(section.max_age)
        said = message(
            f"the last run of the check block, {last.run}, is {hours} old; it is valid for {counts}"
        )
        return CheckBefore("too old", said, last.run, age_s)
    said = message(f"{last.run}, {hours} ago, was in control")
    return CheckBefore(IN_CONTROL, said, last.run, age_s)


def checked_before(
    manifest: Manifest, bench: BenchFile, path: Path, runs: Path, despite: str | None
) -> tuple[str, ...]:
    """Check the bench before a run begins; note the result in the run's manifest, and return it in sentences.

    `despite` is the operator's reason to begin whatever the check says. Before a run of the check block itself,
    nothing is checked. Raises `Refused` if the rule of the bench file forbids the run, and as `check_before`.
    """
    if bench.check_block is None:
        raise Refused(
            f"{path}: the bench file has no section check_block, which --check-block and "
            "--despite-check need; add the section, or leave out these options"
        )
    if despite is not None and (not despite.strip() or not despite.isprintable()):
        raise Refused("--despite-check: give the reason in words, for the record")
    if is_check_block(bench, manifest["unit_under_test"]):
        return (message("this is a run of the check block; remove --check-block and --despite-check"),)
    rule = bench.check_block.rule
    found = check_before(bench, path, runs, utc_now(), simulated=bool(manifest["dry_run"]))
    told = refuse_or_tell(found, rule, despite)
    manifest["check_block"] = found.recorded(rule, despite)
    return told


def refuse_or_tell(found: CheckBefore, rule: str, reason: str | None) -> tuple[str, ...]:
    """Return a check in sentences. A failed one raises `Refused`, unless `rule` is "warn" or a reason is given."""
    if found.fine:
        return (message(f"check block: {found.sentence}"),)
    if reason is not None:
        return (
            message(
                f"check block: {found.sentence}; the run continues, and the record keeps your reason {reason!r}"
            ),
        )
    if rule == "warn":
        return (
            message(f"CHECK BLOCK: {found.sentence}; the bench file's rule is to warn, so the run continues"),
        )
    raise Refused(
        f"check block: {found.sentence}. By the bench file, no run may start: measure the check block, or "
        "give --despite-check 'REASON' for the record"
    )
