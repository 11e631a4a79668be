"""The score: diagnoses compared with what was hidden, with Wilson intervals."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Final

import numpy as np
from scipy.stats import chi2

from bench.base.arrays import Mask
from benchmarks.blind_trial.cases import MOST_TIMES_PLAUSIBLE, Answer, Case, Row, hidden_in, make_case, seal
from benchmarks.blind_trial.effects import CATALOGUE, SEEN_IN_VERIFICATION
from benchmarks.blind_trial.free_positions import FREE, judge_free
from benchmarks.blind_trial.mistakes import SLIPS
from benchmarks.blind_trial.outside import KNOWN, SUPPLIED, WITHOUT_MEAN, judge_known, judge_supply
from benchmarks.blind_trial.signals import (
    SETTING_SIGMA,
    U0,
    K,
    Visibility,
    explained,
    signals,
    signature,
    visibility,
)
from benchmarks.blind_trial.stand import REFERENCE_TEMPERATURE_C, Floats, Weather, make_run
from benchmarks.campaign import Share, spread

# --- the gap on held-out readings that the true form of a hidden effect closes, with a fitted size -------


LEAST_WEIGHT: Final = 1e-12
"""Weight of the prior of unknowns without a prior, against unit noise."""


def true_closing(case: Case, answer: Answer) -> float | None:
    """Return the fraction of the gap that the true form closes, with each pass held out; None without a gap.

    The fit has coefficients and stand errors, as all analyses have, and knows the noise and the signature.
    """
    row = answer.row
    rows, whitener, top, priors = explained(
        row.design, row.noise_v * row.noise_factor, SETTING_SIGMA * row.noise_factor
    )
    run = make_run(row.design)

    def white(volts: Floats) -> Floats:
        return np.asarray(np.einsum("nij,nj->ni", whitener, volts[rows]).ravel())

    left, form = white(case.readings.signal - signals(run)), white(answer.effects[0].change)
    passes = np.repeat(run.pass_number[rows], 3)
    with_form = np.column_stack([top, form])
    prior = np.column_stack([priors, np.zeros(len(priors))])
    folds = [passes == number for number in np.unique(passes)]
    before = sum(_predicted(left, top, priors, held) for held in folds) / len(left)
    after = sum(_predicted(left, with_form, prior, held) for held in folds) / len(left)
    return (before - after) / (before - 1.0) if before > 1.0 else None


def _predicted(left: Floats, columns: Floats, priors: Floats, held: Mask) -> float:
    """Return the chi-square of the rows `held`, as predicted by a fit to all other rows."""
    rest = np.vstack([columns[~held], priors])
    target = np.concatenate([left[~held], np.zeros(len(priors))])
    scale = np.linalg.norm(rest, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    normal = (rest / scale).T @ (rest / scale) + LEAST_WEIGHT * np.eye(len(scale))
    covariance = np.linalg.inv(normal) / np.outer(scale, scale)
    error = left[held] - columns[held] @ (covariance @ (rest.T @ target))
    spread = np.eye(len(error)) + columns[held] @ covariance @ columns[held].T
    return float(error @ np.linalg.solve(spread, error))


# --- the true coefficients of a case at the reference temperature of a model -----------------------------


MODEL_COUNTS_FROM_C: Final = 20.0
"""Temperature at which the temperature effects of the application are zero, °C."""


def coefficients_at(temperature_c: float, seed: int, row: Row, index: int) -> Floats:
    """Return K row by row, V/g, and U0, V, shape (12,), at a temperature.

    The trial's temperature effects are zero at `REFERENCE_TEMPERATURE_C`. The coefficients of a model that
    refers to another temperature contain the effects' values at that temperature.
    """
    run, truths = hidden_in(seed, row, index)
    weather = replace(run.weather, start=run.weather.start + temperature_c - REFERENCE_TEMPERATURE_C)
    there = run.with_weather(weather)
    force = np.resize(np.concatenate([np.eye(3), -np.eye(3)]), (len(run.time_s), 3))
    moved = np.zeros_like(force)
    for truth in truths:
        if truth.stage == "block" and truth.act is not None:
            moved += truth.act(there, force, truth.amplitude) - truth.act(run, force, truth.amplitude)
    columns = np.column_stack([force, np.ones(len(force))])
    added = np.linalg.lstsq(columns, moved, rcond=None)[0].T * np.diag(K)[:, None]
    return np.concatenate([(K + added[:, :3]).ravel(), U0 + added[:, 3]])


# --- do the data distinguish an effect from every other effect? ------------------------------------------


PLAINER_THAN: Final[dict[str, frozenset[str]]] = {
    "head_eccentricity": frozenset({"head_graduation"}),
    "head_ellipticity": frozenset({"head_graduation"}),
    "quadratic_nonlinearity": frozenset({"cross_quadratic"}),
}
"""Larger families of the same subsystem that contain an effect; a diagnosis must name the effect itself first."""

LEFT_TO_TELL: Final = 4.0
"""Least part of an effect, in units of noise, that the nearest rival leaves unexplained if the data decide.

The effect that fits better is then the true one in 98 % of cases.
"""
DRAWS: Final = 48


def can_tell(answer: Answer) -> bool:
    """Return whether every other effect leaves at least `LEFT_TO_TELL` of the hidden effect unexplained."""
    return all(
        effect.rho * np.sqrt(max(0.0, 1 - nearest_rival(answer, which) ** 2)) >= LEFT_TO_TELL
        for which, effect in enumerate(answer.effects)
    )


def nearest_rival(answer: Answer, which: int = 0) -> float:
    """Return the largest cosine between the residual of a hidden effect and that of any other effect, 0 to 1.

    The other effect may have any weights of its channels and mountings, but one shape at a time. Effects that would
    have to be implausibly large are no rivals, nor are larger families that contain the effect.
    """
    row, effect = answer.row, answer.effects[which]
    seen = _seen(row.design, row.noise_v * row.noise_factor, row.noise_factor)
    left = seen.left(effect.change)
    left /= np.linalg.norm(left)
    without = {effect.name, *PLAINER_THAN.get(effect.name, ())}
    cosines = [
        float(np.linalg.norm(basis.T @ left))
        for name in CATALOGUE
        if name not in without
        for basis in _subspaces(name, row.design, row.noise_v * row.noise_factor, row.noise_factor)
    ]
    return min(1.0, max(cosines))


def _seen(design: str, noise_v: float, factor: float) -> Visibility:
    return visibility(design, noise_v, SETTING_SIGMA * factor)


@cache
def _subspaces(name: str, design: str, noise_v: float, factor: float) -> tuple[Floats, ...]:
    """Return orthonormal bases of the residuals of an effect, one for each shape, at typical temperatures."""
    rng = np.random.default_rng(0)
    run = make_run(design).with_weather(Weather(phase=1.0))
    seen = _seen(design, noise_v, factor)
    by_shape: dict[str, list[Floats]] = {}
    for _ in range(DRAWS):
        truth = CATALOGUE[name](rng, run)
        left = seen.left(signature(run, truth))
        size = float(np.linalg.norm(left))
        if size * MOST_TIMES_PLAUSIBLE >= LEFT_TO_TELL:
            by_shape.setdefault(truth.shape, []).append(left / size)
    bases = []
    for members in by_shape.values():
        u, s, _ = np.linalg.svd(np.array(members).T, full_matrices=False)
        bases.append(u[:, s > 1e-3 * s[0]])
    return tuple(bases)


# --- the score -------------------------------------------------------------------------------------------


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
    """The outcome of a task: the diagnosis or the error's text, and the seal of the case."""

    task: Task
    seal: dict[str, str]
    diagnosis: Diagnosis | None
    error: str = ""


def run_trial(tasks: Sequence[Task], diagnose: Diagnose, workers: int = 2) -> Iterator[Outcome]:
    """Make and diagnose each case, in order, in `workers` processes.

    `diagnose` must be a function of a module. Worker processes live through the whole trial, so that results
    computed for a design are reused. An exception in the diagnosis becomes an outcome with its text.
    """
    return spread(partial(_examine, diagnose=diagnose), tasks, workers)


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
    """Return for each effect found the set of its possible names."""
    return [{e["name"], *e.get("cannot_tell_from", ())} for e in diagnosis.get("effects", ())]


def judge(
    case: Case,
    answer: Answer,
    diagnosis: Diagnosis,
    likeness: Callable[[Answer], float] | None = None,
) -> Marks:
    """Return the marks (right or wrong) of a diagnosis, by column of the table.

    Only applicable marks are present: for example, a lone name is judged only if one was given. `likeness`
    returns the largest cosine between an effect outside the catalogue and an effect of the catalogue; effects
    with a cosine above 0.8 are counted separately.
    """
    marks = _judge_kind(case, answer, diagnosis, likeness)
    if diagnosis["verdict"] == "named":
        marks[NOT_SHRUNK] = not _shrank(diagnosis["gap"])
    return marks


def _shrank(gap: dict[str, Any]) -> bool:
    """Return whether both sizes of the gap are known, and smaller after naming than before."""
    sizes = [(gap.get(f"before{of}"), gap.get(f"after{of}")) for of in ("", "_rms")]
    return all(before is not None and after is not None and after < before for before, after in sizes)


NOT_SHRUNK: Final = "named, the gap not smaller"


def _judge_kind(
    case: Case,
    answer: Answer,
    diagnosis: Diagnosis,
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
    return _judge_single(answer, diagnosis)


def _lone_name(answer: Answer, cosine: float, verdict: str) -> Marks:
    """Return the mark on whether a single name was given, in the column of the unexplained part.

    This is the part of the effect that the nearest catalogue effect leaves, in units of noise; below
    `SOME_LEFT` there is no mark.
    """
    left = answer.effects[0].rho * np.sqrt(max(0.0, 1.0 - cosine**2))
    if left < SOME_LEFT:
        return {}
    words = f"{MUCH_LEFT:g} or more" if left >= MUCH_LEFT else f"{SOME_LEFT:g} to {MUCH_LEFT:g}"
    return {f"given a single name that leaves {words}": verdict == "named"}


SOME_LEFT: Final = 4.0
MUCH_LEFT: Final = 7.0


def _judge_form(case: Case, answer: Answer, diagnosis: Diagnosis) -> Marks:
    """Return whether an effect with a mean form is detected, and whether the form found closes the gap.

    The gap is the excess over noise on held-out readings. The form found must close 80 % of what the true
    form with a fitted size closes.
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


def _judge_single(answer: Answer, diagnosis: Diagnosis) -> Marks:
    verdict, sets = diagnosis["verdict"], sets_given(diagnosis)
    truth = answer.names[0]
    marks = {"detected": verdict != "agrees", "mistake alleged": verdict == "mistake"}
    if verdict in {"named", "confounded"}:
        marks["in the set"] = any(truth in names for names in sets)
        # at the verification points a wobble of one period per turn equals a mounting roll
        if answer.kind != SEEN_IN_VERIFICATION and can_tell(answer):
            marks["first name right"] = bool(sets) and diagnosis["effects"][0]["name"] == truth
    marks |= _judge_gap(answer, diagnosis)
    marks["alone given"] = verdict == "named"
    if verdict == "named":
        # an effect that is found twice, with two shapes, is the same name
        marks["alone right"] = set().union(*sets) == {truth}
    return marks


def _judge_gap(answer: Answer, diagnosis: Diagnosis) -> Marks:
    """Return whether the gap is closed on held-out readings, and whether the coefficients are right again.

    If a name was given, a further mark is that the verification points got no worse. Coefficients are right
    if the chi-square of their twelve errors has a p-value above 1 %; they are judged only if the true effect
    was named alone. With a temperature effect in the model, the coefficients refer to the model's reference
    temperature.
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
    """Return whether the worst |Δg| after naming is at most one u above the worst one before."""
    return max(abs(g) for g, _ in after) <= max(abs(g) for g, _ in before) + max(u for _, u in after)


SIGNIFICANT: Final = 0.01


def _coefficients_right(estimate: dict[str, Any], true: Floats) -> bool:
    error = np.array(estimate["value"]) - true
    chi_square = float(error @ np.linalg.solve(np.array(estimate["covariance"]), error))
    return bool(chi2.sf(chi_square, len(error)) > SIGNIFICANT)


def tally(rows: Sequence[Row], marks: Sequence[tuple[Row, Marks]]) -> dict[str, dict[str, Share]]:
    """Return the shares of marks by row key and column, in the order of the rows."""
    counts: dict[str, dict[str, list[int]]] = {row.key: {} for row in rows}
    for row, given in marks:
        for column, right in given.items():
            count = counts[row.key].setdefault(column, [0, 0])
            count[0] += right
            count[1] += 1
    return {
        key: {column: Share(*count) for column, count in columns.items()} for key, columns in counts.items()
    }
