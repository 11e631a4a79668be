"""The score: what a diagnosis said against what was hidden, with Wilson intervals."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.stats import binomtest, chi2

from benchmarks.blind_trial.cases import Answer, Case, Row, make_case, seal
from benchmarks.blind_trial.closing import true_closing
from benchmarks.blind_trial.designs import REFERENCE_TEMPERATURE_C
from benchmarks.blind_trial.effects import SEEN_IN_VERIFICATION
from benchmarks.blind_trial.free_positions import FREE, judge_free
from benchmarks.blind_trial.geometry import Floats
from benchmarks.blind_trial.known import KNOWN, judge_known
from benchmarks.blind_trial.outside_effects import WITHOUT_MEAN
from benchmarks.blind_trial.reference import MODEL_COUNTS_FROM_C, coefficients_at
from benchmarks.blind_trial.slips import SLIPS
from benchmarks.blind_trial.supply import SUPPLIED, judge_supply
from benchmarks.blind_trial.ties import CanTell, can_tell_by_table

Diagnosis = dict[str, Any]
Diagnose = Callable[[Case], Diagnosis]
Marks = dict[str, bool]

VERDICTS: Final = frozenset({"agrees", "mistake", "named", "confounded", "unknown"})
FOREIGN_BUT_ALIKE: Final = 0.8


@dataclass(frozen=True)
class Task:
    """One case to be made and diagnosed."""

    seed: int
    row: Row
    index: int


@dataclass(frozen=True)
class Outcome:
    """What came back for a task: the diagnosis or the error text, and the seal of what was diagnosed."""

    task: Task
    seal: dict[str, str]
    diagnosis: Diagnosis | None
    error: str = ""


@dataclass(frozen=True)
class Share:
    """So many of so many, with the Wilson 95 % interval."""

    successes: int
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper end; 0 and 1 where there was nothing to count."""
        if not self.of:
            return 0.0, 1.0
        ci = binomtest(self.successes, self.of).proportion_ci(confidence_level=0.95, method="wilson")
        return float(ci.low), float(ci.high)

    def __str__(self) -> str:
        if not self.of:
            return "–"
        low, high = self.interval
        return f"{self.successes / self.of:.3f} ({self.successes}/{self.of}; {low:.3f}–{high:.3f})"


def run_trial(tasks: Sequence[Task], diagnose: Diagnose, workers: int = 2) -> Iterator[Outcome]:
    """Make and diagnose each case, in order, in so many processes.

    `diagnose` is a function of a module. A worker lives through the whole trial, so what it computes once for
    a design it keeps. An exception of the diagnosis is an outcome with its text.
    """
    if workers == 1:
        yield from (_examine(task, diagnose) for task in tasks)
        return
    # fresh interpreters: a fork would copy the threads of a linear algebra library
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from pool.map(_examine, tasks, [diagnose] * len(tasks), chunksize=4)


def _examine(task: Task, diagnose: Diagnose) -> Outcome:
    case, answer = make_case(task.seed, task.row, task.index)
    sealed = seal(case, answer)
    try:
        diagnosis = diagnose(case)
        if diagnosis.get("verdict") not in VERDICTS:
            return Outcome(task, sealed, None, f"No such verdict: {diagnosis.get('verdict')!r}.")
    except Exception as error:
        return Outcome(task, sealed, None, f"{type(error).__name__}: {error}")
    return Outcome(task, sealed, diagnosis)


def sets_given(diagnosis: Diagnosis) -> list[set[str]]:
    """Return for each effect found the names under which it may stand."""
    return [{e["name"], *e.get("cannot_tell_from", ())} for e in diagnosis.get("effects", ())]


def judge(
    case: Case,
    answer: Answer,
    diagnosis: Diagnosis,
    can_tell: CanTell = can_tell_by_table,
    likeness: Callable[[Answer], float] | None = None,
) -> Marks:
    """Return what can be said of a diagnosis, right or wrong, by the name of the column.

    Only what applies is there: a name alone is judged where one was given. `likeness` gives the largest
    cosine of an effect outside the catalogue to a member of it; those above 0.8 are counted apart.
    """
    marks = _judge_kind(case, answer, diagnosis, can_tell, likeness)
    if diagnosis["verdict"] == "named":
        marks[NOT_SHRUNK] = not _shrank(diagnosis["gap"])
    return marks


def _shrank(gap: dict[str, Any]) -> bool:
    """Say whether both sizes of the gap on readings held out are there and smaller than before."""
    sizes = [(gap.get(f"before{of}"), gap.get(f"after{of}")) for of in ("", "_rms")]
    return all(before is not None and after is not None and after < before for before, after in sizes)


NOT_SHRUNK: Final = "named, the gap not smaller"


def _judge_kind(
    case: Case,
    answer: Answer,
    diagnosis: Diagnosis,
    can_tell: CanTell,
    likeness: Callable[[Answer], float] | None,
) -> Marks:
    verdict = diagnosis["verdict"]
    kind = answer.kind.split(":")[0]
    if answer.kind in FREE:
        return judge_free(answer.kind, answer.names[0] if answer.names else "", diagnosis)
    if kind == "null":
        return {"agrees": verdict == "agrees"}
    if kind == "hidden":
        return _judge_hidden(answer, diagnosis)
    if kind == "mistake":
        return _judge_mistake(answer, diagnosis)
    if kind == "outside":
        alike = likeness is not None and likeness(answer) >= FOREIGN_BUT_ALIKE
        apart = " (like a member)" if alike else ""
        marks = {
            f"detected{apart}": verdict != "agrees",
            f"flagged unknown{apart}": verdict == "unknown",
            f"given a single name{apart}": verdict == "named",
        }
        if likeness is not None:
            marks |= _lone_name(answer, likeness(answer), verdict)
        return marks | _judge_form(case, answer, diagnosis)
    if answer.kind in KNOWN:
        return judge_known(answer.kind, answer.names, diagnosis)
    if answer.kind in SLIPS:
        return _judge_slip(answer, diagnosis)
    if answer.kind in SUPPLIED:
        return judge_supply(answer.kind, diagnosis)
    if kind == "pair":
        return _judge_pair(answer, diagnosis)
    return _judge_single(case, answer, diagnosis, can_tell)


def _lone_name(answer: Answer, cosine: float, verdict: str) -> Marks:
    """Say whether a single name was given where the nearest member leaves this much, units of noise."""
    left = answer.effects[0].rho * np.sqrt(max(0.0, 1.0 - cosine**2))
    if left < SOME_LEFT:
        return {}
    words = f"{MUCH_LEFT:g} or more" if left >= MUCH_LEFT else f"{SOME_LEFT:g} to {MUCH_LEFT:g}"
    return {f"given a single name that leaves {words}": verdict == "named"}


SOME_LEFT: Final = 4.0
MUCH_LEFT: Final = 7.0


def _judge_form(case: Case, answer: Answer, diagnosis: Diagnosis) -> Marks:
    """Say whether what has a mean form is found at all, and whether the form given to it closes the gap.

    On readings held out, by what is above noise, against what the true form with its size refitted closes.
    """
    if answer.names[0] in WITHOUT_MEAN:
        return {}
    marks = {"detected (has a mean form)": diagnosis["verdict"] != "agrees"}
    form = diagnosis.get("form")
    if diagnosis["verdict"] == "unknown" and form is not None:
        closed, true = form["gap"]["closed"], true_closing(case, answer)
        if true is not None and true > 0.0:
            marks["form closes 80 %"] = closed is not None and closed >= FORM_CLOSES * true
    return marks


FORM_CLOSES: Final = 0.8


def _judge_hidden(answer: Answer, diagnosis: Diagnosis) -> Marks:
    marks = {"agrees": diagnosis["verdict"] == "agrees"}
    if answer.names[0] != "common_turn":
        marks["hidden listed"] = any(answer.names[0] in str(entry) for entry in diagnosis.get("hidden", ()))
    return marks


def _judge_mistake(answer: Answer, diagnosis: Diagnosis) -> Marks:
    found = diagnosis["verdict"] == "mistake"
    sets = sets_given(diagnosis)
    first = diagnosis["effects"][0]["name"] if sets else None
    return {
        "mistake found": found,
        "first name right": found and first in answer.accepted,
        "in the set": found and any(not names.isdisjoint(answer.accepted) for names in sets),
    }


def _judge_slip(answer: Answer, diagnosis: Diagnosis) -> Marks:
    sets = sets_given(diagnosis)
    return {
        "detected": diagnosis["verdict"] != "agrees",
        "mistake alleged": diagnosis["verdict"] == "mistake",
        "in the set": any(answer.names[0] in names for names in sets),
        "nothing without it": all(answer.names[0] in names for names in sets),
        "alone given": diagnosis["verdict"] == "named",
    }


def _judge_pair(answer: Answer, diagnosis: Diagnosis) -> Marks:
    sets = sets_given(diagnosis)
    truth = set(answer.names)
    return {
        "detected": diagnosis["verdict"] != "agrees",
        "both in the sets": truth <= set().union(*sets),
        "a set without either": any(names.isdisjoint(truth) for names in sets),
        "refused": diagnosis["verdict"] == "unknown",
    }


def _judge_single(case: Case, answer: Answer, diagnosis: Diagnosis, can_tell: CanTell) -> Marks:
    verdict, sets = diagnosis["verdict"], sets_given(diagnosis)
    truth = answer.names[0]
    marks = {"detected": verdict != "agrees", "mistake alleged": verdict == "mistake"}
    if verdict in {"named", "confounded"}:
        marks["in the set"] = any(truth in names for names in sets)
        # at the verification points a wobble once a turn does the same as a mounting roll
        if answer.kind != SEEN_IN_VERIFICATION and can_tell(case, answer):
            marks["first name right"] = bool(sets) and diagnosis["effects"][0]["name"] == truth
    marks |= _judge_gap(answer, diagnosis)
    marks["alone given"] = verdict == "named"
    if verdict == "named":
        # an effect that is found twice, with two shapes, is the same name
        marks["alone right"] = set().union(*sets) == {truth}
    return marks


def _judge_gap(answer: Answer, diagnosis: Diagnosis) -> Marks:
    """Say whether the gap is closed on readings held out, and whether the coefficients are right again.

    With a name, also whether the verification points are no worse for it. Right are coefficients whose twelve
    errors together have a chi-square that chance exceeds in 1 %; counted where the true effect was named, and
    alone. With an effect of temperature in the model they are those at the temperature from which it counts.
    """
    marks: Marks = {}
    p_after = diagnosis.get("gap", {}).get("p_after")
    if diagnosis["verdict"] in {"named", "confounded"} and p_after is not None:
        marks["gap closed"] = p_after > SIGNIFICANT
    if diagnosis.get("delta_g") and diagnosis["delta_g"]["before"]:
        marks["Δg not worse"] = _not_worse(**diagnosis["delta_g"])
    alone = {effect["name"] for effect in diagnosis["effects"]} == set(answer.names)
    if diagnosis["verdict"] == "named" and alone and "coefficients" in diagnosis:
        for when, at_c in (("before", REFERENCE_TEMPERATURE_C), ("after", MODEL_COUNTS_FROM_C)):
            true = coefficients_at(at_c, answer.seed, answer.row, answer.index)
            marks[f"coefficients right {when}"] = _coefficients_right(diagnosis["coefficients"][when], true)
    return marks


def _not_worse(before: list[tuple[float, float]], after: list[tuple[float, float]]) -> bool:
    """Say whether the worst |Δg| after a name is at most one u above the worst one before."""
    return max(abs(g) for g, _ in after) <= max(abs(g) for g, _ in before) + max(u for _, u in after)


SIGNIFICANT: Final = 0.01


def _coefficients_right(estimate: dict[str, Any], true: Floats) -> bool:
    error = np.array(estimate["value"]) - true
    chi_square = float(error @ np.linalg.solve(np.array(estimate["covariance"]), error))
    return bool(chi2.sf(chi_square, len(error)) > SIGNIFICANT)


def tally(rows: Sequence[Row], marks: Sequence[tuple[Row, Marks]]) -> dict[str, dict[str, Share]]:
    """Count the marks: row key to column to share, in the order of the rows."""
    counts: dict[str, dict[str, list[int]]] = {row.key: {} for row in rows}
    for row, given in marks:
        for column, right in given.items():
            count = counts[row.key].setdefault(column, [0, 0])
            count[0] += right
            count[1] += 1
    return {
        key: {column: Share(*count) for column, count in columns.items()} for key, columns in counts.items()
    }
