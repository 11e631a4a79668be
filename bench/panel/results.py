"""The results of a run: read from the files in its folder, and shown at its end on the live page."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from bench.base.files import from_text
from bench.base.languages import message
from bench.base.numbers import probability, rounded, scale_for, uncertainty
from bench.base.text import as_typed
from bench.calibration.result import LACK_OF_FIT_P, NOT_ACCEPTED_P, NOT_DETERMINED
from bench.panel.access import Refusal
from bench.panel.folder import RunsFolder, head_of, read_page
from bench.results.parts import small_unit
from bench.run.events import RecordError
from bench.run.folder import CALIBRATE_FILE, DIAGNOSE_FILE, RESULTS, VERIFY_FILE, Run, statement_in
from bench.run.record import HAS_LOCKS, is_locked
from bench.services.errors import Refused
from bench.services.requests.evaluation import Compare

REPORT: Final = "report.html"
DIAGNOSIS: Final = "diagnose.html"

FIGURES: Final = {
    "residuals": b"residuals-angle",
    "residuals-in-time": b"residuals-order",
    "verification": b"verification",
}
"""The figures of the report by name, each with a prefix of the identifiers in its SVG, which identifies it."""

_STATES: Final = {
    "pass": "passed",
    message("conditional pass"): "conditional",
    message("conditional fail"): "conditional",
    "inconclusive": "none",
    message("not complete"): "failed",
    message("does not fit"): "failed",
    "fail": "failed",
}
_MARKS: Final = {"passed": "✓", "failed": "✗"}

FITS, LACK_OF_FIT, DOES_NOT_FIT = (
    message("no lack of fit shown at 1 %"),
    message("lack of fit shown at 1 %"),
    message("the model does not fit the readings"),
)
"""The outcomes of the test for lack of fit: no lack of fit; u is widened; the coefficients are not accepted."""

Told = TypeVar("Told")


@dataclass(frozen=True)
class PointRow:
    """A row on a verification point, in words; `of_limit` is Δg, `u_of_limit` its U, both divided by the limit."""

    where: str
    delta: str
    expanded: str
    false_accept: str
    statement: str
    passed: bool
    of_limit: float
    u_of_limit: float


@dataclass(frozen=True)
class VerdictTold:
    """The verdict of the verification as shown on a page.

    `state` selects the style of the box, `words` state the outcome, and `warnings` give reasons to doubt it. The
    other members are the largest |Δg|, its U, the limit and the risk of a wrong decision.
    """

    state: str
    words: str
    worst: str
    expanded: str
    k: str
    limit: str
    unit: str
    rule: str
    risk: str
    rows: tuple[PointRow, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    passed: bool


@dataclass(frozen=True)
class CoefficientRow:
    """A coefficient ± U as shown on a page."""

    name: str
    value: str
    expanded: str
    unit: str


@dataclass(frozen=True)
class CalibrationTold:
    """The calibration as shown on a page: coefficients, unobservable quantities (`hidden`), goodness of fit."""

    rows: tuple[CoefficientRow, ...]
    hidden: tuple[str, ...]
    fit: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class DiagnosisTold:
    """The diagnosis as shown on a page: verdict, named effects, and why the next measurement is proposed."""

    verdict: str
    words: str
    effects: tuple[str, ...]
    next_why: str


@dataclass(frozen=True)
class Results:
    """The available results of a run; `trouble` names files that cannot be read.

    `no_calibration` is why a concluded run has no calibration, and `diagnosable` whether a diagnosis may find the
    cause.
    """

    verdict: VerdictTold | None
    calibration: CalibrationTold | None
    diagnosis: DiagnosisTold | None
    files: tuple[str, ...]
    trouble: tuple[str, ...]
    no_calibration: str
    diagnosable: bool


def results_of(run: Run) -> Results:
    """Return the results of a run, read from the files in its folder."""
    trouble: list[str] = []
    verdict = told_by(run, VERIFY_FILE, verdict_told, trouble)
    calibration = told_by(run, CALIBRATE_FILE, _calibration, trouble)
    diagnosis = told_by(run, DIAGNOSE_FILE, _diagnosis, trouble)
    if verdict or calibration:
        trouble += _distrust(run)
    there = [name for name in (REPORT, DIAGNOSIS) if is_plain(run.folder / name)]
    why, diagnosable = told_by(run, RESULTS, _no_calibration, []) or ("", False)
    return Results(verdict, calibration, diagnosis, tuple(there), tuple(trouble), why, diagnosable)


def _distrust(run: Run) -> list[str]:
    """Return a sentence if the record, or an input, is not the one of which a run's results were made."""
    history = run.history
    if history.problems:
        return [
            message(f"Do not use these results: {'; '.join(history.problems)}; restore the run from a copy")
        ]
    if head_of(run) not in ("", history.head):
        return [
            message("Do not use these results: the record has changed since; restore the run from a copy")
        ]
    return []


def _no_calibration(told: Mapping[str, Any]) -> tuple[str, bool]:
    return str(told.get("no_calibration", "")), bool(told.get("diagnosable"))


def told_by(
    run: Run, name: str, words: Callable[[Mapping[str, Any]], Told], trouble: list[str]
) -> Told | None:
    """Return `words(content)` of a run's result file `name`; None if the file is missing or damaged.

    For a damaged file, a sentence is added to `trouble`.
    """
    try:
        content = from_text(read_page(run, name))
        return None if content is None else words(content)
    except Refusal:
        return None
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError):
        command = name.removesuffix(".json")
        trouble.append(f"{name}: cannot be read; 'bench {command} {as_typed(run.name)}' makes it again")
        return None


def is_plain(path: Path) -> bool:
    """Return whether a path is a regular file and not a link."""
    return path.is_file() and not path.is_symlink()


def _in_words(probability: Any) -> str:
    from bench.results.verification import optional_probability  # takes long to import

    return optional_probability(None if probability is None else float(probability))


def verdict_told(told: Mapping[str, Any]) -> VerdictTold:
    """Return the verdict for a page from `told`, the JSON result of a verification."""
    limit = float(told["limit_g"])
    scale = scale_for(limit, "g")
    points = [_point(one, scale.size, limit, str(told.get("rule", ""))) for one in told["points"]]
    worst = max(told["points"], key=lambda one: abs(float(one["delta_g"])))
    statement = _statement(told, str(told.get("rule", "")))
    state = _STATES.get(statement, "none")
    expanded = _expanded(worst) / scale.size
    warnings = tuple(map(str, told.get("warnings", ())))
    return VerdictTold(
        state="conditional" if warnings and state == "passed" else state,
        words=f"{_MARKS.get(state, '–')} {({'pass': 'passed', 'fail': 'failed'}).get(statement, statement)}",
        worst=rounded(abs(float(worst["delta_g"])) / scale.size, expanded),
        expanded=uncertainty(expanded),
        k=f"{float(worst.get('k', 2.0)):.3g}",
        limit=f"{limit / scale.size:g}",
        unit=scale.unit,
        rule=str(told.get("rule", "")),
        risk=_risk(told),
        rows=tuple(points),
        notes=tuple(map(str, told.get("notes", ()))),
        warnings=warnings,
        passed=bool(told["passed"]),
    )


def _point(one: Mapping[str, Any], size: float, limit: float, rule: str) -> PointRow:
    expanded = _expanded(one) / size
    risk = one.get("p_false_accept")
    return PointRow(
        where=f"{float(one['angle_deg']):.4f}°"
        + (message(f" (pass {one['pass']}, point {one['point']})") if "pass" in one else ""),
        delta=rounded(float(one["delta_g"]) / size, expanded, sign=True),
        expanded=uncertainty(expanded),
        false_accept=_in_words(risk),
        statement=_statement(one, rule),
        passed=bool(one["passed"]),
        of_limit=float(one["delta_g"]) / limit,
        u_of_limit=expanded * size / limit,
    )


def _statement(told: Mapping[str, Any], rule: str) -> str:
    from bench.calibration.conformity import Statement  # takes long to import
    from bench.calibration.verification import by_rule

    return str(by_rule(Statement(statement_in(told)), rule, passed=bool(told["passed"])))


def _expanded(one: Mapping[str, Any]) -> float:
    return float(one.get("U", 2.0 * float(one["u"])))


def _risk(told: Mapping[str, Any]) -> str:
    for key, words in (
        ("p_false_accept", message("a false acceptance")),
        ("p_false_reject", message("a false rejection")),
    ):
        if told.get(key) is not None:
            return message(f"probability of {words}: {_in_words(told[key])}")
    return ""


def _calibration(told: Mapping[str, Any]) -> CalibrationTold:
    unit = str(told["unit"])
    hidden, notes = (tuple(map(str, told.get(name, ()))) for name in ("not_observable", "notes"))
    if "channels" in told:  # of a record at a known input
        rows = [
            CoefficientRow(f"{called} {channel}", *_value_and_uncertainty(one[key]), of)
            for channel, one in told["channels"].items()
            for key, called, of in (("gain", "gain", "V/V"), ("offset_v", "offset", "V"))
            if one[key] is not None
        ]
        return CalibrationTold(tuple(rows), hidden, "", notes)
    rows = []
    for name in map(str, told["order"]):
        one = told["coefficients"][name]
        if one["u"] is None:
            rows.append(CoefficientRow(name, "0", NOT_DETERMINED, ""))
            continue
        scale = scale_for(max(abs(float(one["value"])), _expanded(one)), unit)
        shown = scale.unit if name.startswith("U0") else scale.per_g
        rows.append(CoefficientRow(name, *_value_and_uncertainty(one, scale.size), shown))
    residual = told.get("residual") or {}
    p = residual.get("p")
    fit = "" if p is None else FITS if float(p) >= LACK_OF_FIT_P else LACK_OF_FIT
    if not told.get("fits", p is None or float(p) >= NOT_ACCEPTED_P):
        fit = DOES_NOT_FIT
    return CalibrationTold(tuple(rows), hidden, fit, notes)


def _value_and_uncertainty(of: Mapping[str, Any], size: float = 1.0) -> tuple[str, str]:
    value, expanded = float(of["value"]) / size, _expanded(of) / size
    return rounded(value, expanded), uncertainty(expanded)


_WORDS: Final = {
    "agrees": message("model and readings agree"),
    "mistake": message("a mistake in procedure or wiring"),
    "named": message("an effect that the model lacks, named"),
    "confounded": message("an effect is missing, and several explain it equally"),
    "unknown": message("no known effect explains the readings"),
}


def _diagnosis(told: Mapping[str, Any]) -> DiagnosisTold:
    verdict = str(told["verdict"])
    effects = []
    for one in told.get("effects", ()):
        text = str(one["name"]).replace("_", " ")
        if one.get("channels"):
            text += f" (channels {', '.join(map(str, one['channels']))})"
        if one.get("cannot_tell_from"):
            text += message(", indistinguishable from ") + ", ".join(
                str(o).replace("_", " ") for o in one["cannot_tell_from"]
            )
        effects.append(text)
    further = told.get("next_measurement") or {}
    return DiagnosisTold(verdict, _WORDS.get(verdict, verdict), tuple(effects), str(further.get("why", "")))


def figure_of(run: Run, name: str) -> bytes:
    """Return a figure of a run's report as an SVG file. Raises `Refusal` (404) if there is none."""
    page = read_page(run, REPORT)
    if name in FIGURES:
        for found in re.finditer(rb"<svg .*?</svg>", page, re.DOTALL):
            if b' id="' + FIGURES[name] + b"-" in found[0]:
                names = b'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
                return found[0].replace(b"<svg ", names, 1)
    raise Refusal(404, f"the report of {run.name} has no such figure; choose one on the page")


# --- the end of a run on its live page -------------------------------------------------------------------


LONGEST_RESULTS_S: Final = 2.0 if HAS_LOCKS else 120.0
"""Time (s) after the end of a run within which results are due; later, only while their list is locked.

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
    from bench.services.history import compared

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
    size, shown = small_unit(name, abs(difference), unit)
    sizes = rounded(difference / size, expanded / size, sign=True), uncertainty(expanded / size)
    return f"{name}: {sizes[0]} ± {sizes[1]} {shown}"


def previous_calibration(run: Run, runs: RunsFolder) -> Run | None:
    """Return the unit's latest calibrated run before `run`; None if there is none.

    A simulated run is compared with simulated runs only, a real run with real runs.
    """
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
