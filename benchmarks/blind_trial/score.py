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
from benchmarks.blind_trial.free_positions import FREE
from benchmarks.blind_trial.mistakes import SLIPS
from benchmarks.blind_trial.outside import (
    COMMON_VOLTS,
    DRIFTING,
    ELECTRICS,
    HAND_SET,
    NOT_TOLD,
    OTHER_PSI,
    REPAIRED,
    SENSITIVE,
    WITHOUT_MEAN,
)
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
from benchmarks.campaign import Share, shares, spread

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


class Said:
    """What a diagnosis says of a case: its verdict, the possible names of each effect, and all of these names."""

    def __init__(self, answer: Answer, diagnosis: Diagnosis) -> None:
        self.answer, self.diagnosis = answer, diagnosis
        self.verdict: str = diagnosis["verdict"]
        self.sets = sets_given(diagnosis)
        self.names: set[str] = set().union(*self.sets)
        self.first = diagnosis["effects"][0]["name"] if self.sets else None
        self.truth = next(iter(answer.names), "")

    def marks(self, columns: Sequence[str]) -> Marks:
        """Return the marks in these columns; whether a lone name is right is asked only where one was given."""
        asked = (name for name in columns if name != "alone right" or self.verdict == "named")
        return {name: COLUMNS[name](self) for name in asked}


COLUMNS: Final[dict[str, Callable[[Said], bool]]] = {
    "agrees": lambda said: said.verdict == "agrees",
    "detected": lambda said: said.verdict != "agrees",
    "mistake alleged": lambda said: said.verdict == "mistake",
    "mistake found": lambda said: said.verdict == "mistake",
    "no mistake alleged": lambda said: said.verdict != "mistake",
    "refused": lambda said: said.verdict == "unknown",
    "alone given": lambda said: said.verdict == "named",
    # an effect that is found twice, with two shapes, is the same name
    "alone right": lambda said: said.names == {said.truth},
    "in the set": lambda said: said.truth in said.names,
    "the effect in the set": lambda said: said.truth in said.names,
    "nothing without it": lambda said: all(said.truth in names for names in said.sets),
    "both in the sets": lambda said: said.names.issuperset(said.answer.names),
    "a set without either": lambda said: any(names.isdisjoint(said.answer.names) for names in said.sets),
    "told from bias_drift": lambda said: said.truth in said.names and "bias_drift" not in said.names,
    "told from supply_sensitivity": lambda said: (
        said.truth in said.names and "supply_sensitivity" not in said.names
    ),
    "one alleged": lambda said: [one["name"] for one in said.diagnosis["effects"]].count("outlier") == 1,
    "nothing else": lambda said: all(names == {"outlier"} for names in said.sets),
    "points at the electrics": lambda said: not said.names.isdisjoint(ELECTRICS),
}
"""The columns of the table that follow from verdict and names alone."""
NULL: Final = ("agrees",)
FOUND: Final = ("detected", "mistake alleged", "in the set", "alone given", "alone right")
OF_KIND: Final[dict[str, Sequence[str]]] = {
    **dict.fromkeys(FREE, FOUND), "null": NULL, "free:null": NULL, "free:null records": NULL,
    "free:outlier": ("mistake found", "one alleged", "nothing else"),
    **dict.fromkeys(SLIPS, ("detected", "mistake alleged", "in the set", "nothing without it", "alone given")),
    "pair": ("detected", "both in the sets", "a set without either", "refused"),
    SENSITIVE: ("detected", "in the set", "told from bias_drift", "alone given", "alone right"),
    DRIFTING: ("detected", "in the set", "told from supply_sensitivity", "alone given", "alone right"),
    COMMON_VOLTS: ("detected", "points at the electrics"), HAND_SET: ("no mistake alleged",),
    REPAIRED: ("mistake found", "the effect in the set"),
}  # fmt: skip
"""The columns in which a kind of case is marked; `judge` adds those that need more than verdict and names."""


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
    said = Said(answer, diagnosis)
    hidden, mistaken = diagnosis.get("hidden", ()), said.verdict == "mistake"
    match answer.kind.split(":")[0]:
        case "hidden":
            marks = said.marks(NULL)
            if said.truth != "common_turn":
                marks["hidden listed"] = any(said.truth in str(entry) for entry in hidden)
        case "mistake":
            marks = {
                "mistake found": mistaken,
                "first name right": mistaken and said.first in answer.accepted,
                "in the set": mistaken and not said.names.isdisjoint(answer.accepted),
            }
        case _ if answer.kind == OTHER_PSI:
            told = diagnosis["verification_orientation"]
            marks = said.marks(NULL)
            marks["contradiction told"] = bool(told) and told["contradicts_bench_file"]
            marks["hidden listed"] = set(hidden) >= NOT_TOLD
        case "outside":
            marks = _judge_outside(case, said, likeness)
        case _ if answer.kind in OF_KIND:
            marks = said.marks(OF_KIND[answer.kind])
        case _:
            marks = _judge_single(said)
    if answer.kind in FREE and "in the set" in marks and said.verdict != "agrees":
        marks |= _gap_closed(diagnosis)
    if said.verdict == "named":
        marks[NOT_SHRUNK] = not _shrank(diagnosis["gap"])
    return marks


NOT_SHRUNK: Final = "named, the gap not smaller"


def _shrank(gap: dict[str, Any]) -> bool:
    """Return whether both sizes of the gap are known, and smaller after naming than before."""
    sizes = [(gap.get(f"before{of}"), gap.get(f"after{of}")) for of in ("", "_rms")]
    return all(before is not None and after is not None and after < before for before, after in sizes)


def _gap_closed(diagnosis: Diagnosis) -> Marks:
    """Return whether the gap on held-out readings is within the noise, if it is known."""
    p_after = diagnosis.get("gap", {}).get("p_after")
    return {} if p_after is None else {"gap closed": p_after > SIGNIFICANT}


SOME_LEFT: Final = 4.0
MUCH_LEFT: Final = 7.0
FORM_CLOSES: Final = 0.8


def _judge_outside(case: Case, said: Said, likeness: Callable[[Answer], float] | None) -> Marks:
    """Return the marks of a case with an effect outside the catalogue.

    A single name is counted by the part of the effect that the nearest catalogue effect leaves unexplained, in
    units of noise; below `SOME_LEFT` there is no such mark. The gap is the excess over noise on held-out readings.
    The form found must close 80 % of what the true form with a fitted size closes.
    """
    answer, verdict = said.answer, said.verdict
    cosine = 0.0 if likeness is None else likeness(answer)
    apart = " (like a member)" if cosine >= FOREIGN_BUT_ALIKE else ""
    marks = {
        f"detected{apart}": verdict != "agrees",
        f"flagged unknown{apart}": verdict == "unknown",
        f"given a single name{apart}": verdict == "named",
    }
    left = answer.effects[0].rho * np.sqrt(max(0.0, 1.0 - cosine**2))
    if likeness is not None and left >= SOME_LEFT:
        words = f"{MUCH_LEFT:g} or more" if left >= MUCH_LEFT else f"{SOME_LEFT:g} to {MUCH_LEFT:g}"
        marks[f"given a single name that leaves {words}"] = verdict == "named"
    if said.truth in WITHOUT_MEAN:
        return marks
    marks["detected (has a mean form)"] = verdict != "agrees"
    form = said.diagnosis.get("form")
    if verdict == "unknown" and form is not None:
        closed, true = form["gap"]["closed"], true_closing(case, answer)
        if true is not None and true > 0.0:
            marks["form closes 80 %"] = closed is not None and closed >= FORM_CLOSES * true
    return marks


def _judge_single(said: Said) -> Marks:
    marks = said.marks(FOUND[:2])
    if said.verdict in {"named", "confounded"}:
        marks |= said.marks(["in the set"])
        # at the verification points a wobble of one period per turn equals a mounting roll
        if said.answer.kind != SEEN_IN_VERIFICATION and can_tell(said.answer):
            marks["first name right"] = said.first == said.truth
        marks |= _gap_closed(said.diagnosis)
    return marks | _judge_coefficients(said) | said.marks(FOUND[3:])


def _judge_coefficients(said: Said) -> Marks:
    """Return whether the verification points got no worse by naming, and whether the coefficients are right again.

    Coefficients are right if the chi-square of their twelve errors has a p-value above 1 %; they are judged only
    if the true effect was named alone. With a temperature effect in the model, the coefficients refer to the
    model's reference temperature.
    """
    answer, diagnosis, marks = said.answer, said.diagnosis, Marks()
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
    return {row.key: shares(given for of, given in marks if of == row) for row in rows}
