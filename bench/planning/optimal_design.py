"""Optimal designs by greedy addition and exchange, their goals, and the bench for which they are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints, quadratic_forms
from bench.base.languages import message
from bench.base.numbers import figures
from bench.calibration.budget.assessment import delta_g_variances, directions
from bench.calibration.budget.coefficients import Budget, Setup, make_budget
from bench.calibration.budget.error_source import ErrorSource, learned_sources
from bench.calibration.budget.sources import effect_sources, stand_source
from bench.calibration.design import FIXED, Problem, make_problem
from bench.calibration.estimators import GLS
from bench.calibration.noise import LEAST_REPEATS, KnownStand, repeat_groups, whiten
from bench.calibration.result import CalibrationError, Noise
from bench.model import STAND_ANGLES, Block, Conditions, Distribution, ForwardModel
from bench.model.conditions import Mounting
from bench.model.geometry import COEFFICIENTS, modulus_slopes
from bench.planning.requirements import Setting, conditions_of

DIRECTIONS: Final = 128
"""Number of directions over which the goals of a measured acceleration are evaluated."""
WHOLE: Final = 10.0
LEAST_WHOLE_G: Final = 1e-3
"""The loose goal for the whole block requires `WHOLE` times the uncertainty of the other goals, at least 1 mg."""


@dataclass(frozen=True)
class Goal:
    """A goal: a required standard uncertainty `asked`, in `unit`, of k linear functions of the coefficients.

    Each row of `functionals` (k, 12) is one function; the goal limits the sum of their variances. `floor` is the
    variance that no calibration lowers: the noise of the reading at the verification point `judged` and, in a plan,
    the errors that no reading reveals. A `loose` goal serves only to make a plan determine the whole block.
    """

    name: str
    functionals: Floats
    asked: float
    unit: str
    floor: float = 0.0
    judged: Setting | None = None
    loose: bool = False

    def variance(self, covariance: Floats) -> float:
        """Return the variance of the goal for a covariance (12, 12) of the coefficients, without the floor."""
        return float(np.einsum("ki,ij,kj->", self.functionals, covariance, self.functionals))

    def u(self, covariance: Floats) -> float:
        """Return the standard uncertainty, with the floor, for a covariance (12, 12) of the coefficients."""
        return float(np.sqrt(self.variance(covariance) + self.floor))

    def ratio(self, covariance: Floats) -> float:
        """Return the uncertainty divided by the required uncertainty; at most 1 if the goal is reached."""
        return self.u(covariance) / self.asked

    def relaxed(self, endless: float) -> Goal:
        """Return the goal; if it is loose, with a required u of at least twice the square root of `endless`.

        `endless` is the variance of the goal that infinitely many readings would give.
        """
        return replace(self, asked=max(self.asked, 2.0 * float(np.sqrt(endless)))) if self.loose else self

    def tightened(self, wider2: float) -> Goal:
        """Return a goal with a lower required u: its square minus the floor is divided by `wider2`."""
        return replace(self, asked=float(np.sqrt(self.floor + (self.asked**2 - self.floor) / wider2)))


def coefficient_goals(asked: Mapping[str, float]) -> list[Goal]:
    """Return a goal for each coefficient to which `asked` assigns a required standard uncertainty.

    `asked` holds required standard uncertainties, for K in V/g and for U0 in V. Its keys are names of coefficients
    or the groups "K", "U0" and "all". A name overrides its group, and "K" or "U0" overrides "all". Raises
    `CalibrationError` for an unknown name and for an uncertainty that is not positive.
    """
    sizes: dict[str, float] = {}
    for wanted in ("all", "K", "U0"):
        if wanted in asked:
            sizes |= {n: asked[wanted] for n in COEFFICIENTS if wanted == "all" or n.startswith(wanted)}
    for name, size in asked.items():
        if name not in {*COEFFICIENTS, "all", "K", "U0"}:
            known = ", ".join(COEFFICIENTS)
            raise CalibrationError(f"no coefficient {name!r}; choose from {known}, K, U0, all")
        _require_positive(name, size)
        if name in COEFFICIENTS:
            sizes[name] = size
    identity = np.eye(len(COEFFICIENTS))
    return [
        Goal(name, identity[[i]], sizes[name], "V" if name.startswith("U0") else "V/g")
        for i, name in enumerate(COEFFICIENTS)
        if name in sizes
    ]


def delta_g_goals(
    block: Block, force: Floats, reading_v: float, asked_g: float, at: Sequence[Setting]
) -> list[Goal]:
    """Return a goal for Δg at each verification point `at`; `force` (n, 3) is the specific force there, of 1 g.

    Each goal requires u = `asked_g`. Its floor is the variance from the noise `reading_v`, V, of the reading at the
    point. Raises `CalibrationError` if this noise alone exceeds the required uncertainty.
    """
    _require_positive("Δg", asked_g)
    functionals, by_signal = modulus_slopes(force, block)
    floors = reading_v**2 * np.sum(by_signal**2, axis=1)
    if np.max(floors) * (1.0 - 1e-9) >= asked_g**2:
        raise CalibrationError(
            f"u(Δg) of {asked_g:.3g} g cannot be reached: one reading at a verification point alone has "
            f"{figures(float(np.sqrt(np.max(floors))), 2, up=True)} g; lower voltmeter_error in the bench file "
            "(more samples a reading) or relax the goal"
        )
    return [
        Goal(
            message(f"Δg at verification point {i + 1}"),
            functionals[[i]],
            asked_g,
            "g",
            float(floors[i]),
            at[i],
        )
        for i in range(len(force))
    ]


def modulus_goals(block: Block, magnitude_g: float, asked_g: float) -> list[Goal]:
    """Return goals that require u = `asked_g` of the modulus of a specific force, in many directions.

    The variance is convex in the magnitude, so goals at zero and at `magnitude_g` cover all magnitudes between.
    """
    _require_positive("the modulus", asked_g)
    _require_positive("the magnitude", magnitude_g)
    # d|a| = -(a/|a|)^T N (dK a + dU0): the part from dK grows with the magnitude, the part from dU0 is constant
    slopes, _ = modulus_slopes(directions(DIRECTIONS), block)
    size = np.ones(len(COEFFICIENTS))
    goals = []
    for magnitude in (magnitude_g, 0.0):
        size[:9] = magnitude
        goals += [Goal(f"|a| at {magnitude:g} g", row[None] * size, asked_g, "g") for row in slopes]
    return goals


def vector_goal(block: Block, magnitude_g: float = 1.0, asked_g: float = 1.0) -> Goal:
    """Return the goal for the error vector of a measured specific force of `magnitude_g`.

    The goal limits the root mean square of the error over all directions of the force.
    """
    inverse = np.linalg.inv(block.K)
    force = magnitude_g * directions(DIRECTIONS)[:DIRECTIONS]  # only the evenly spread directions
    weight = np.zeros((12, 12))
    for a in force:
        rows = np.concatenate([np.einsum("ki,j->kij", inverse, a).reshape(3, 9), inverse], axis=1)
        weight += rows.T @ rows / len(force)
    size, vectors = np.linalg.eigh(weight)
    name = message(f"rms error vector at {magnitude_g:g} g")
    return Goal(name, (vectors * np.sqrt(np.maximum(size, 0.0))).T, asked_g, "g")


def whole_goal(block: Block, goals: Sequence[Goal]) -> Goal:
    """Return a goal, loose compared with `goals`, that makes a plan calibrate the whole block.

    Without this goal, a plan for one coefficient could leave the other coefficients undetermined.
    """
    typical = float(np.max(np.abs(block.K)))
    asked = max(goal.asked / (typical if goal.unit.startswith("V") else 1.0) for goal in goals)
    goal = vector_goal(block, 1.0, max(WHOLE * asked, LEAST_WHOLE_G))
    return replace(goal, name=message(f"whole block: {goal.name}"), loose=True)


def worst(goals: Sequence[Goal], covariance: Floats) -> Goal:
    """Return the goal that is furthest from being reached with this covariance (12, 12) of the coefficients."""
    return max(goals, key=lambda goal: goal.ratio(covariance))


def _require_positive(name: str, size: float) -> None:
    if not (np.isfinite(size) and size > 0):
        raise CalibrationError(f"the uncertainty asked for {name} must be a positive number, not {size:g}")


_POWERS: Final = (8.0, 40.0)
"""Exponents of the power mean that replaces the largest ratio: first a smooth score, then nearly the maximum."""
_WITHIN_REACH: Final = 1.05
"""Greatest ratio of u to required u at which exchanges are tried: they lower the ratio by a few percent only."""
_GAIN: Final = 1e-6
_WEAKLY_KNOWN: Final = 1.0
"""Prior u of the coefficients, V/g and V, too weak to have an influence: it keeps matrices invertible."""
_DETERMINED: Final = 1e-2
_MANY: Final = 1e5
LEAST_FREEDOM: Final = 6
"""Number of signals beyond the unknowns that a plan must have, for an estimate of the noise."""


@dataclass(frozen=True)
class SettingPool:
    """The c candidate settings of a design, with whitened derivatives `rows` (c, 3, p) of their signals.

    The first 12 unknowns are the coefficients. The p - 12 others are angles of the mountings, in units of their
    prior standard uncertainty.
    """

    rows: Floats

    @property
    def unknowns(self) -> int:
        """The number of unknowns p."""
        return int(self.rows.shape[2])

    @cached_property
    def information(self) -> Floats:
        """The information matrix of one visit to each setting, shape (c, p, p)."""
        return np.asarray(np.einsum("cip,ciq->cpq", self.rows, self.rows))


class ExchangeDesign:
    """A design: the number of visits to each candidate setting, `counts` (c,). Methods change it in place.

    The counts stay between `least` and `most` (c,), if given. The score of a design is a power mean of the
    squared ratios of u to the required u of its `goals`; a lower score is better.
    """

    def __init__(
        self,
        candidates: SettingPool,
        goals: Sequence[Goal],
        counts: Ints | None = None,
        least: Ints | None = None,
        most: Ints | None = None,
    ) -> None:
        self._rows = candidates.rows
        self._information_of = candidates.information
        self._functionals = np.concatenate([goal.functionals for goal in goals])
        self._goal = np.repeat(np.arange(len(goals)), [len(goal.functionals) for goal in goals])
        self._floor = np.array([goal.floor for goal in goals])
        self._asked2 = np.array([goal.asked for goal in goals]) ** 2
        prior = np.ones(candidates.unknowns)
        prior[:FIXED] = _WEAKLY_KNOWN**-2
        self._prior = np.diag(prior)
        self.counts = np.zeros(len(self._rows), dtype=np.int64) if counts is None else counts.copy()
        self._least = np.zeros_like(self.counts) if least is None else least
        self._most = np.full_like(self.counts, np.iinfo(np.int64).max) if most is None else most

    @property
    def settings(self) -> int:
        """The total number of visits."""
        return int(self.counts.sum())

    def covariance(self, counts: Floats | Ints | None = None) -> Floats:
        """Return the covariance (p, p) of coefficients and angles for `counts` (default: present)."""
        weight = self.counts if counts is None else counts
        information = self._prior + np.tensordot(weight.astype(np.float64), self._information_of, axes=1)
        scale = 1 / np.sqrt(np.diag(information))
        return np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)

    @property
    def coefficient_covariance(self) -> Floats:
        """Covariance of the coefficients, shape (12, 12)."""
        return self.covariance()[:FIXED, :FIXED]

    @property
    def largest(self) -> float:
        """The largest ratio of u to required u over all goals.

        u is widened here because the noise is estimated from the same readings.
        """
        wider2 = widening(3 * self.settings - len(self._prior)) ** 2
        variances = wider2 * (self._variances(self.covariance()) - self._floor) + self._floor
        return self._largest(variances)

    def limit(self) -> float:
        """Return the largest ratio of u to required u in the limit of endless visits to every candidate."""
        return self._largest(self._variances(self.covariance(np.full(len(self._rows), _MANY))))

    @property
    def determines(self) -> bool:
        """Whether readings at all candidates, and not just a weak prior, determine the coefficients."""
        covariance = self.covariance(np.full(len(self._rows), _MANY))
        return bool(np.max(np.diag(covariance)[:FIXED]) < _DETERMINED)

    # --- moves --------------------------------------------------------------------------------------

    def add_best(self) -> None:
        """Add one visit to the candidate setting at which a visit lowers the score most."""
        gain = self._after(self.covariance(), 1.0, _POWERS[0])
        self.counts[int(np.argmin(np.where(self.counts < self._most, gain, np.inf)))] += 1

    def drop_least(self) -> None:
        """Remove the visit whose removal raises the score least."""
        loss = self._after(self.covariance(), -1.0, _POWERS[-1])
        loss[self.counts <= self._least] = np.inf
        self.counts[int(np.argmin(loss))] -= 1

    def exchange(self) -> None:
        """Move visits to other candidate settings as long as a move lowers the score."""
        for power in _POWERS if len(self._asked2) > 1 else _POWERS[:1]:
            score = float(self._score(self._variances(self.covariance()), power))
            while (better := self._exchanged(score, power)) < score:
                score = better

    def _exchanged(self, score: float, power: float) -> float:
        """Make the first exchange that improves the score, least important visits first; return the new score."""
        loss = self._after(self.covariance(), -1.0, power)
        for leave in sorted(np.flatnonzero(self.counts > self._least), key=loss.__getitem__):
            self.counts[leave] -= 1
            scores = self._after(self.covariance(), 1.0, power)
            scores = np.where(self.counts < self._most, scores, np.inf)
            enter = int(np.argmin(scores))
            if scores[enter] < score * (1 - _GAIN):
                self.counts[enter] += 1
                return float(scores[enter])
            self.counts[leave] += 1
        return score

    # --- the value of a design ----------------------------------------------------------------------

    def _variances(self, covariance: Floats) -> Floats:
        each = quadratic_forms(self._functionals, covariance[:FIXED, :FIXED])
        return np.asarray(np.bincount(self._goal, each) + self._floor)

    def _after(self, covariance: Floats, sign: float, power: float) -> Floats:
        """Return the score (c,) after one visit more (+1) or less (-1) to each candidate (Woodbury identity)."""
        through = self._rows @ covariance
        core = np.eye(3) + sign * through @ np.swapaxes(self._rows, 1, 2)
        seen = through[:, :, :FIXED] @ self._functionals.T
        solved = np.linalg.solve(core, seen)
        change = np.einsum("cik,cik->ck", seen, solved)
        variances = self._variances(covariance)
        goals = np.zeros((len(change), len(self._floor)))
        np.add.at(goals.T, self._goal, change.T)
        after = variances - sign * goals
        if sign < 0:  # the remaining visits may no longer determine all unknowns
            after = np.where(np.linalg.det(core)[:, None] > 1e-9, after, np.inf)
        return self._score(after, power)

    def _largest(self, variances: Floats) -> float:
        return float(np.sqrt(np.max(variances / self._asked2)))

    def _score(self, variances: Floats, power: float) -> Floats:
        """Return the power mean, along the last axis, of the squared ratios of u to required u.

        The mean is infinite if any ratio is infinite.
        """
        ratio = np.maximum(variances, 0.0) / self._asked2
        top = np.max(ratio, axis=-1)
        size = np.where(np.isfinite(top) & (top > 0), top, 1.0)
        part = np.where(np.isfinite(ratio), ratio, 0.0) / size[..., None]
        mean: Floats = size * np.sum(part**power, axis=-1) ** (1 / power)
        return np.where(np.isfinite(top), mean, np.inf)


def widening(freedom: float) -> float:
    """Return the factor by which noise estimated with `freedom` degrees of freedom widens an uncertainty."""
    return Noise(1.0, 1.0, max(float(freedom), 1.0), "residuals").widened().reading


def least_settings(candidates: SettingPool) -> int:
    """Return the fewest settings that determine coefficients, angles of the mountings, and the noise."""
    return -(-(candidates.unknowns + LEAST_FREEDOM) // 3)


def even(candidates: SettingPool, mounts: int, settings: int) -> Ints:
    """Return counts (c,) of settings spread evenly over the mountings and over the angles of each mounting."""
    angles = len(candidates.rows) // mounts
    counts = np.zeros((mounts, angles), dtype=np.int64)
    for mount in range(mounts):
        own = (settings + mounts - 1 - mount) // mounts
        np.add.at(counts[mount], np.round(np.arange(own) * angles / max(own, 1)).astype(np.int64) % angles, 1)
    return counts.ravel()


def best_of(candidates: SettingPool, goals: Sequence[Goal], mounts: int, settings: int) -> ExchangeDesign:
    """Return the best design of `settings` visits found by exchanges, from a greedy and from an even start."""
    greedy = ExchangeDesign(candidates, goals)
    for _ in range(settings):
        greedy.add_best()
    spread = ExchangeDesign(candidates, goals, even(candidates, mounts, settings))
    for design in (greedy, spread):
        design.exchange()
    return min((greedy, spread), key=lambda design: design.largest)


def fewest(candidates: SettingPool, goals: Sequence[Goal], mounts: int, most: int) -> ExchangeDesign | None:
    """Return the smallest design found that reaches all goals; None if it needs more than `most` settings."""
    design = ExchangeDesign(candidates, goals)
    if design.limit() > 1:
        return None
    least = least_settings(candidates)
    while (design.largest > 1 or design.settings < least) and design.settings < most:
        design.add_best()
    if design.largest > _WITHIN_REACH or most < least:
        return None
    if design.largest > 1:
        design = best_of(candidates, goals, mounts, most)
        if design.largest > 1:
            return None
    while True:
        reached = design.counts.copy()
        if design.settings == least:
            return design
        design.drop_least()
        if design.largest > 1:
            design.exchange()
        if design.largest > 1:
            design = ExchangeDesign(candidates, goals, even(candidates, mounts, design.settings))
            design.exchange()
        if design.largest > 1:
            return ExchangeDesign(candidates, goals, reached)


WITHOUT_NOISE: Final = 1e-4
"""Noise that approximates infinitely many readings, as a fraction of the noise of one reading."""


@dataclass(frozen=True)
class Stand:
    """The bench for planning: model, block, and standard uncertainties `sizes` of the stand's errors (rad, V).

    `known` is prior knowledge of stand and noise from other runs, used instead of `sizes`. `hidden` are the
    error sources that no reading reveals; the combined u of a calibration includes them. `meters` holds the
    index of the voltmeter of each channel. `mountings` numbers the mountings, equal while the block stays mounted.
    """

    model: ForwardModel
    block: Block
    sizes: Mapping[str, float]
    known: KnownStand | None = None
    hidden: tuple[ErrorSource, ...] = ()
    meters: tuple[int, int, int] = (0, 1, 2)
    mountings: Mapping[Mounting, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.known is not None and self.known.noise is not None:
            return
        if not self.sizes.get("voltmeter_error", 0.0) > 0:
            raise CalibrationError(
                "the bench file states no voltmeter_error above 0, which planning needs; state it in the section "
                "'stand'"
            )

    @property
    def noise(self) -> Noise:
        """The noise of each reading and of each setting of the head."""
        if self.known is not None and self.known.noise is not None:
            return self.known.noise.given()
        return Noise(self.sizes["voltmeter_error"], self.sizes.get("setting_error", 0.0), np.inf, "given")

    def conditions(self, settings: Sequence[Setting]) -> Conditions:
        """Return the conditions of readings at these settings, with the mountings that the stand knows."""
        numbers = np.array([self.mountings.get(s.mount, 0) for s in settings], dtype=np.int64)
        return replace(conditions_of(settings), mounting=numbers)

    def unknowns(self, mounts: int) -> int:
        """Return the number of unknowns of a fit to readings in `mounts` mountings."""
        return FIXED + mounts * sum(name in STAND_ANGLES and u > 0 for name, u in self.sizes.items())

    def promise(self, settings: Sequence[Setting], goals: Sequence[Goal]) -> Promise:
        """Return the uncertainties of coefficients and goals that `bench calibrate` will state for these settings.

        The estimator is generalised least squares, with noise widened because it is estimated from the readings.
        Raises `CalibrationError` if the settings do not determine the coefficients.
        """
        wider = widening(self._freedom(self.conditions(settings)))
        budget = self.budget([*settings, *checks_of(goals)], wider)
        combined = budget.combined.covariance
        of_readings = combined - sum(
            (budget.contribution(source.name).covariance for source in self.hidden), np.zeros((FIXED, FIXED))
        )
        floored = [
            replace(goal, floor=sum(parts.values()) - goal.variance(of_readings))
            for goal, parts in zip(goals, parts_of_goals(goals, budget), strict=True)
        ]
        return Promise(tuple(floored), of_readings, combined)

    def budget(self, settings: Sequence[Setting], noise: float = 1.0) -> Budget:
        """Return the budget of readings at these settings, with noise scaled by the factor `noise`."""
        setup = Setup(self.model, self.conditions(settings), self.block, self.meters)
        sizes = {n: u * (1.0 if n in STAND_ANGLES else noise) for n, u in self.sizes.items() if u > 0}
        sources = [stand_source(name, Distribution(u)) for name, u in sizes.items()]
        beside = [*effect_sources(setup), *self.hidden]
        known = self.known
        if known is None:
            return make_budget(setup, [*sources, *beside], GLS, stated=sizes)
        if known.noise is not None:
            known = replace(known, noise=known.noise.times(noise))
        learned = learned_sources(sources, known, setup.conditions)
        return make_budget(setup, [*learned, *beside], GLS, stated=sizes, known=known)

    def _freedom(self, conditions: Conditions) -> int:
        """Return the degrees of freedom of the noise estimate, which uses repeats if there are enough."""
        again = repeats(conditions)
        if again >= LEAST_REPEATS:
            return 3 * again
        return 3 * len(conditions) - self.unknowns(len(conditions.mounts))


def checks_of(goals: Sequence[Goal]) -> list[Setting]:
    """Return the verification points `judged` of the goals, in order, for goals with such a point."""
    return [goal.judged for goal in goals if goal.judged is not None]


def parts_of_goals(goals: Sequence[Goal], budget: Budget) -> list[dict[str, float]]:
    """Return the variance of each goal by source; the budget must include the points `checks_of(goals)`."""
    names = [c.source.name for c in budget.contributions]
    points = iter(delta_g_variances(budget).tolist() if checks_of(goals) else ())
    return [
        {c.source.name: goal.variance(c.covariance) for c in budget.contributions}
        if goal.judged is None
        else dict(zip(names, next(points), strict=True))
        for goal in goals
    ]


@dataclass(frozen=True)
class Promise:
    """The covariances (12, 12) of the coefficients that a calibration of the planned readings will state.

    `readings` is the covariance from the readings alone; `combined` includes the errors that no reading
    reveals. The floors of the `goals` include these errors, too. `goal.u(readings)` is therefore the combined
    standard uncertainty of a goal.
    """

    goals: tuple[Goal, ...]
    readings: Floats
    combined: Floats


def repeats(conditions: Conditions) -> int:
    """Return the number of readings that repeat an earlier one at the same mounting, point and approach."""
    return len(conditions) - (int(repeat_groups(conditions).max()) + 1)


def whitened(stand: Stand, conditions: Conditions) -> tuple[Floats, Problem]:
    """Return derivatives (n, 3, 12 + q) of readings, in units of their noise, and the problem of a fit.

    The q stand angles, or independent combinations of correlated angles, are in units of their prior standard
    uncertainty.
    """
    problem = make_problem(stand.model, conditions, stand.sizes, known=stand.known)
    linear = problem.linear(stand.block, problem.prior_mean)
    rows = whiten(linear.jacobian, linear.slope, stand.noise)
    return np.concatenate([rows[:, :, :FIXED], problem.by_prior(rows[:, :, FIXED:])], axis=2), problem
