"""The end of a run on its live page: a picture of the verdict, what changed, and what to do next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from bench.base.languages import message
from bench.base.numbers import probability, rounded, uncertainty
from bench.panel.folder import RunsFolder
from bench.panel.results import DOES_NOT_FIT, LACK_OF_FIT, Results, VerdictTold, is_plain, results_of
from bench.run.events import RecordError
from bench.run.folder import CALIBRATE_FILE, RESULTS, Run
from bench.run.record import HAS_LOCKS, is_locked

LONGEST_RESULTS_S: Final = 2.0 if HAS_LOCKS else 120.0
"""Time (s) after the end of a run within which results are due; later, only a lock on their list shows it.

Without file locks (Windows), it is the time within which a program computes the results.
"""
MOST_CHANGES: Final = 3
"""Number of coefficients that are listed as changed; the comparison command lists all."""


@dataclass(frozen=True)
class Change:
    """The comparison with the unit's previous calibration, in words."""

    previous: str
    sentence: str
    changed: bool
    rows: tuple[str, ...] = ()


@dataclass(frozen=True)
class Whisker:
    """A verification point in the picture: Δg at `x`, Δg ± U from `low` to `high`, `y` downwards from the top."""

    label: str
    value: str
    y: float
    x: float
    low: float
    high: float
    passed: bool


@dataclass(frozen=True)
class Picture:
    """Δg ± U of each verification point against the limits, as coordinates of a drawing `WIDTH` wide."""

    height: float
    left: float
    right: float
    zero: float
    whiskers: tuple[Whisker, ...]
    label: str


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run that has ended, as the live page shows it.

    `state` is "waiting" while the results are computed, "none" if there are none, else "ready". `misfit` says why a
    diagnosis is offered: no calibration, lack of fit, a failed verification or a doubtful one; else it is empty.
    """

    state: str
    results: Results
    misfit: str
    change: Change | None
    picture: Picture | None


def outcome_of(run: Run, runs: RunsFolder, *, alive: bool, finished: bool, age_s: float) -> Outcome:
    """Return the outcome of a run that ended `age_s` seconds ago.

    `alive` says whether a program has the record open, `finished` whether the run reached its end. The state
    is "none" if results are missing `LONGEST_RESULTS_S` after the end, and no program has the record open or
    computes them.
    """
    found = results_of(run)
    state = "ready" if found.calibration is not None else "none"
    # coefficients are written before the verdict: they alone are not the end
    if finished and (alive or run.results_missing):
        due = alive or age_s < LONGEST_RESULTS_S or is_locked(run.folder / RESULTS)
        state = "waiting" if due else "none"
    done = state == "ready"
    return Outcome(
        state=state,
        results=found,
        misfit=_misfit(found) if state != "waiting" else "",
        change=_change(run, runs) if done else None,
        picture=picture_of(found.verdict) if done and found.verdict else None,
    )


def _misfit(found: Results) -> str:
    """Return why to diagnose a run: no calibration, a misfit, a failed block, or doubt; else ""."""
    if found.diagnosable:
        return message("There is no calibration. The diagnosis looks for the cause.")
    fit = found.calibration.fit if found.calibration is not None else ""
    if fit == DOES_NOT_FIT:
        return message("The model does not fit the readings. The diagnosis looks for the missing effect.")
    if fit == LACK_OF_FIT:
        return message("A lack of fit is shown at 1 %. The diagnosis looks for the missing effect.")
    if found.verdict is not None and found.verdict.state == "failed":
        return message("The block did not pass. The diagnosis looks for the cause.")
    if found.verdict is not None and found.verdict.warnings:
        return message(f"Do not trust this verdict yet: {found.verdict.warnings[0]}.")
    return ""


def _change(run: Run, runs: RunsFolder) -> Change | None:
    """Compare a run with the unit's previous calibration; None if there is no previous one."""
    previous = previous_calibration(run, runs)
    if previous is None:
        return None
    from bench.results.compare import compare_result  # the analyses take long to import
    from bench.services.errors import Refused
    from bench.services.history import compared
    from bench.services.requests.history import Compare

    try:
        files = tuple(str(one.folder / CALIBRATE_FILE) for one in (previous, run))
        found = compare_result(compared(Compare(files)).found, ())
    except (Refused, ValueError, KeyError, OSError) as error:
        return Change(
            previous.name, message(f"The two calibrations cannot be compared: {error}"), changed=False
        )
    (later,) = found.compared
    rows = sorted(later.intrinsic.values.items(), key=lambda one: one[1].p_all_looks)
    listed = tuple(_row(name, one.difference, 2 * one.u, found.unit) for name, one in rows if one.changed)
    if found.changed and listed:
        sentence = message(
            f"Changed beyond the uncertainty: {len(listed)} of the nine numbers free of the mounting."
        )
    elif found.changed:
        sentence = message("No single number changed, but all of them together did.")
    else:
        sentence = message("Nothing changed beyond its uncertainty.")
    sentence += message(f" All {len(rows)} together: {probability(later.intrinsic.p)}.")
    return Change(previous.name, sentence, found.changed, listed[:MOST_CHANGES] if found.changed else ())


def _row(name: str, difference: float, expanded: float, unit: str) -> str:
    from bench.results.intrinsic import small_unit

    size, shown = small_unit(name, abs(difference), unit)
    sizes = rounded(difference / size, expanded / size, sign=True), uncertainty(expanded / size)
    return f"{name}: {sizes[0]} ± {sizes[1]} {shown}"


def previous_calibration(run: Run, runs: RunsFolder) -> Run | None:
    """Return the unit's last calibrated run before `run`, real or simulated as `run` is; None if none."""
    mine = _identity(run)
    if mine is None:
        return None
    earlier = [
        (one[1], other)
        for other in runs.runs()
        if (one := _identity(other)) is not None
        and one[0] == mine[0]
        and one[1] < mine[1]
        and is_plain(other.folder / CALIBRATE_FILE)
    ]
    return max(earlier, key=lambda one: one[0])[1] if earlier else None


def _identity(run: Run) -> tuple[tuple[str, str, bool], str] | None:
    """Return the unit (type, serial, simulated or not) and the time of a run; None if no serial number is known."""
    try:
        manifest = run.manifest
    except RecordError:
        return None
    unit = manifest.get("unit_under_test")
    if not isinstance(unit, dict) or not unit.get("serial"):
        return None
    return (str(unit.get("type")), str(unit["serial"]), bool(manifest.get("dry_run"))), str(
        manifest.get("created", "")
    )


WIDTH: Final = 600.0
LABELS: Final = 110.0
"""Room for the angles to the left of the whiskers."""
EDGE: Final = 20.0
ROW: Final = 34.0


def picture_of(verdict: VerdictTold) -> Picture:
    """Return the picture of a verdict, with a whisker for each verification point, from top to bottom."""
    largest = max([1.25, *(abs(row.of_limit) + row.u_of_limit for row in verdict.rows)])
    middle, unit = (LABELS + WIDTH - EDGE) / 2, (WIDTH - EDGE - LABELS) / 2 / largest

    def at(of_limit: float) -> float:
        return round(middle + unit * of_limit, 1)

    return Picture(
        height=ROW * (len(verdict.rows) + 1),
        left=at(-1.0),
        right=at(1.0),
        zero=at(0.0),
        whiskers=tuple(
            Whisker(
                label=row.where.partition(" ")[0],
                value=f"{row.delta} ± {row.expanded} {verdict.unit}",
                y=ROW * (i + 0.5),
                x=at(row.of_limit),
                low=at(row.of_limit - row.u_of_limit),
                high=at(row.of_limit + row.u_of_limit),
                passed=row.passed,
            )
            for i, row in enumerate(verdict.rows)
        ),
        label=message(
            f"Δg ± U at {len(verdict.rows)} verification points, with the limits ±{verdict.limit} "
            f"{verdict.unit}; worst |Δg| {verdict.worst} ± {verdict.expanded} {verdict.unit}"
        ),
    )
