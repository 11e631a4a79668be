"""Results of a budget: uncertainty of measured accelerations and of the verification, and a Monte Carlo check."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from pydantic import Field
from scipy import special

from bench.base.arrays import Floats
from bench.base.computing import tracked
from bench.base.languages import message
from bench.base.result_model import Real, ResultModel
from bench.calibration.budget.coefficients import (
    Budget,
    Contribution,
    Setup,
    influences,
    make_budget,
    parts_of,
)
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.budget.meters import FLICKER_RMS
from bench.calibration.budget.propagation import (
    Distributed,
    Propagated,
    Validation,
    batches,
    coverage_factor,
    drawn,
    effective_dof,
    require_trials,
    summary,
    validate,
)
from bench.calibration.budget.sources import ROLL_ORIGIN
from bench.calibration.conformity import (
    SIMPLE,
    DecisionRule,
    MeasuredValues,
    Population,
    probability_all_accepted,
)
from bench.calibration.design import coefficient_columns
from bench.calibration.noise import KnownStand
from bench.calibration.result import CalibrationError
from bench.model.conditions import Conditions
from bench.model.effects import Stage
from bench.model.effects.base import Seen
from bench.model.geometry import COEFFICIENTS, STAND_ANGLES, modulus_slopes

DIRECTIONS: Final = 1000
MAGNITUDES_G: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


@dataclass(frozen=True)
class MeasuredAcceleration:
    """Uncertainty of measured accelerations `force` (d, 3), g.

    `by_source` maps each source to the covariance (d, 3, 3), g², that it causes. `dof` maps each source to
    the degrees of freedom of its standard uncertainty.
    """

    force: Floats
    by_source: dict[str, Floats]
    dof: dict[str, float]

    @property
    def covariance(self) -> Floats:
        """Covariance of the three components, g², shape (d, 3, 3)."""
        return sum(self.by_source.values(), np.zeros((len(self.force), 3, 3)))

    @property
    def u_vector(self) -> Floats:
        """Root mean square length of the error vector, g, shape (d,)."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=1, axis2=2)))

    @property
    def u_modulus(self) -> Floats:
        """Standard uncertainty (d,) of each modulus, g."""
        return np.sqrt(self.modulus_variance(self.covariance))

    @property
    def dof_modulus(self) -> Floats:
        """Effective degrees of freedom of the modulus, shape (d,)."""
        variances = np.stack([self.modulus_variance(c) for c in self.by_source.values()], axis=1)
        return effective_dof(variances, list(self.dof.values()))

    def modulus_variance(self, covariance: Floats) -> Floats:
        """Return the variance of the modulus (d,), g², from covariances (d, 3, 3), g², of components."""
        unit = self.force / np.linalg.norm(self.force, axis=1)[:, None]
        return np.asarray(np.einsum("di,dij,dj->d", unit, covariance, unit))


def measured(
    budget: Budget, force: Floats, *, reading: bool = True, same_voltmeters: bool = False
) -> MeasuredAcceleration:
    """Return the uncertainty of accelerations `force` (d, 3), g, each measured by one reading.

    Without `reading` only the errors of the coefficients count. With `same_voltmeters` the voltmeters of the
    calibration measure the acceleration, so that their gain and offset errors cancel; without it, other voltmeters
    of the same accuracy do. The temperature is the calibration temperature. Raises `CalibrationError` for an
    acceleration of zero.
    """
    if not np.all(np.linalg.norm(force, axis=1) > 0.0):
        raise CalibrationError("an acceleration of zero has no direction; give at least a few micro g")
    inverse = np.linalg.inv(budget.setup.block.K)
    design = coefficient_columns(force)
    by_source, dof = {}, {}
    for contribution in budget.contributions:
        of_coefficients = contribution.parts
        shared, apart = np.zeros((1, 3, 1)), np.zeros((len(force), 3, 0))
        if reading:
            shared, apart = _of_reading(contribution, budget, force, same_voltmeters=same_voltmeters)
        if not shared.any() and of_coefficients.shape[1] > len(of_coefficients):
            # twelve columns can have the same covariance as many columns, one for each reading
            of_coefficients = np.asarray(np.linalg.qr(of_coefficients.T, mode="r")).T
        parts = inverse @ np.concatenate([shared - design @ of_coefficients, apart], axis=2)
        by_source[contribution.source.name] = parts @ np.swapaxes(parts, 1, 2)
        dof[contribution.source.name] = contribution.source.dof
    return MeasuredAcceleration(force, by_source, dof)


def _of_reading(
    contribution: Contribution, budget: Budget, force: Floats, *, same_voltmeters: bool
) -> tuple[Floats, Floats]:
    """Return the errors, V, that a source causes in one reading of each of d accelerations: two arrays (d, 3, q).

    The last axis has q independent components, each of one standard deviation. The first array has the errors
    common to the reading and the calibration, which errors of the coefficients may cancel. The second array has
    the errors of the reading alone.
    """
    source, block = contribution.source, budget.setup.block
    per_channel = np.eye(3)[None]
    alone = np.zeros((len(force), 3, 0))
    none = np.zeros((1, 3, 1))
    if source.kind in {"voltmeter_error", "voltmeter_linearity"}:
        own = source.u * per_channel * source.on_channels
        return none, np.broadcast_to(own, (len(force), 3, 3))
    if source.kind in {"voltmeter_gain", "voltmeter_offset", "reference_noise"}:
        sensed = np.ones_like(force) if source.kind == "voltmeter_offset" else block.output(force)
        sensed = sensed * source.on_channels * (FLICKER_RMS if source.kind == "reference_noise" else 1.0)
        meters = np.unique(budget.setup.meters, return_inverse=True)[1]
        errors = source.acting(sensed[:, :, None] * np.eye(int(meters.max()) + 1)[meters][None])
        same = same_voltmeters and source.kind != "reference_noise"
        return (errors, alone) if same else (none, errors)
    if source.name in {"K2", "K3"}:
        power = force ** int(source.name[1]) * np.diag(block.K) * source.on_channels
        return source.u * power[:, :, None] * per_channel, alone
    if source.effect is not None:
        return _of_effect(source, budget, force), alone
    return none, alone


def _of_effect(source: ErrorSource, budget: Budget, force: Floats) -> Floats:
    """Return the error, V, (d, 3, 1), that an effect causes when the block is used, at reference time and
    temperature.
    """
    unknown, setup = source.effect, budget.setup
    none = np.zeros((1, 3, 1))
    if unknown is None:
        return none
    applied = setup.model.effects[unknown.effect]
    if applied.effect.stage is not Stage.BLOCK_OUTPUT or applied.effect.needs_history:
        return none
    seen = Seen(force, Conditions.of(["1"] * len(force), np.zeros(len(force))), setup.block)
    values = applied.complete_values()
    step = 1e-3 * unknown.prior_u

    def addition(change: float) -> Floats:
        changed = np.array(values[unknown.parameter])
        changed[() if unknown.channel is None else unknown.channel] += change
        all_values = {**values, unknown.parameter: changed}
        return applied.effect.addition(all_values, seen)

    slope = (addition(step) - addition(-step)) / (2 * step)
    return source.u * slope[:, :, None]


def directions(count: int = DIRECTIONS) -> Floats:
    """Return unit vectors (count + 6, 3) in all directions, for means and maxima over the sphere.

    The first `count` are spread evenly over the sphere (golden spiral), the last six lie along the axes.
    """
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    flat = np.sqrt(1.0 - z**2)
    spiral = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    return np.concatenate([spiral, np.eye(3), -np.eye(3)])


def magnitudes(range_g: float) -> tuple[float, ...]:
    """Return the magnitudes to report, g, up to and including the measuring range."""
    return (*(m for m in MAGNITUDES_G if m < range_g), range_g)


class AtMagnitude(ResultModel):
    """Standard uncertainties (g) of a measured acceleration of one magnitude, over all directions.

    They are the mean and the largest over the directions, for the vector and for its modulus.
    """

    magnitude_g: float
    u_vector_mean: float
    u_vector_max: float
    u_modulus_mean: float
    u_modulus_max: float
    U_modulus_max: float = Field(description="largest expanded uncertainty of the modulus")
    share: dict[str, float] = Field(description="part of the mean variance of the modulus, by source")


def over_directions(
    budget: Budget, magnitude_g: float, *, reading: bool = True, same_voltmeters: bool = False
) -> AtMagnitude:
    """Return the uncertainties of a measured acceleration of `magnitude_g`, over all directions.

    For `reading` and `same_voltmeters` see `measured`.
    """
    found = measured(budget, magnitude_g * directions(), reading=reading, same_voltmeters=same_voltmeters)
    even = slice(0, DIRECTIONS)
    u, factor = found.u_modulus, coverage_factor(found.dof_modulus)
    parts = {n: float(np.mean(found.modulus_variance(c)[even])) for n, c in found.by_source.items()}
    total = sum(parts.values())
    return AtMagnitude(
        magnitude_g=magnitude_g,
        u_vector_mean=found.u_vector[even].mean(),
        u_vector_max=found.u_vector.max(),
        u_modulus_mean=u[even].mean(),
        u_modulus_max=u.max(),
        U_modulus_max=np.max(factor * u),
        share={name: part / total if total > 0.0 else 0.0 for name, part in parts.items()},
    )


# --- delta g ----------------------------------------------------------------------------------------


class DeltaG(ResultModel):
    """Uncertainty of delta g = |a| - 1 at a verification point, local g, and its acceptance limit."""

    angle_deg: float
    point: int
    u: float
    dof: Real = Field(description="effective degrees of freedom; null for infinitely many")
    U: float
    by_source: dict[str, float] = Field(description="standard uncertainty from each error alone")
    accepted_up_to: float
    passes: float = Field(description="probability that a calibration without a mistake passes here")
    capable: bool = Field(description="whether U is within what is accepted")


def delta_g_variances(budget: Budget, *, reading: bool = True) -> Floats:
    """Return the variances of delta g, local g², due to each source, shape (v, sources).

    Delta g is |a| - 1 at each of the setup's v verification points. Errors of gravity and of a meter's gain
    act alike on calibration and check, and cancel. Without `reading` only errors of coefficients count.
    """
    return np.stack([np.sum(part**2, axis=1) for part in _delta_g_parts(budget, reading=reading)], axis=1)


def _delta_g_parts(budget: Budget, *, reading: bool = True) -> list[Floats]:
    """Return for each source the changes (v, q) of delta g at the points; column j is due to its draw j."""
    setup = budget.setup
    rows = np.flatnonzero(setup.verification)
    by_coefficient, by_signal = modulus_slopes(setup.force[rows], setup.block)
    functionals = np.einsum("vp,pni->vni", by_coefficient, budget.gain)
    if reading:
        functionals[np.arange(len(rows)), rows] += by_signal
    return [parts_of(c.source, setup, functionals) for c in budget.contributions]


def delta_g(
    budget: Budget,
    limit_g: float,
    rule: str | DecisionRule = SIMPLE,
    *,
    reading: bool = True,
    population: Population | None = None,
) -> tuple[DeltaG, ...]:
    """Return the uncertainty and the acceptance limit of delta g at each verification point of the setup.

    `limit_g` is the tolerance of |delta g|, `population` the distribution of delta g over many blocks. For
    `reading` see `delta_g_variances`. Raises `CalibrationError` for an unknown rule.
    """
    setup, decision = budget.setup, DecisionRule.of(rule)
    rows = np.flatnonzero(setup.verification)
    if not len(rows):
        return ()
    sources = [c.source for c in budget.contributions]
    variances = delta_g_variances(budget, reading=reading)
    u, dof = np.sqrt(variances.sum(axis=1)), effective_dof(variances, [source.dof for source in sources])
    expanded = coverage_factor(dof) * u
    limits = decision.acceptance_limit(limit_g, MeasuredValues(u, expanded, dof, population)).tolist()
    return tuple(
        DeltaG(
            angle_deg=np.degrees(setup.conditions.angle_rad[row]),
            point=setup.conditions.point[row],
            u=u[i],
            dof=dof[i],
            U=expanded[i],
            by_source=dict(zip((s.name for s in sources), np.sqrt(variances[i]).tolist(), strict=True)),
            accepted_up_to=limits[i],
            passes=_within(limits[i], float(u[i])),
            capable=limits[i] >= expanded[i],
        )
        for i, row in enumerate(rows)
    )


def _within(limit: float, u: float) -> float:
    """Return the probability that a normal error stays within a limit."""
    if limit <= 0.0:
        return 0.0
    return float(special.erf(limit / (u * np.sqrt(2.0)))) if u > 0.0 else 1.0


BATCH: Final = 200
"""Number of trials in one batch: few enough for the processor's cache, and for products in one thread."""
DIGITS: Final = 1
"""Significant digits of u that count as meaningful: error sizes are known no better."""


@dataclass(frozen=True)
class ExactResult:
    """Results of a Monte Carlo simulation (`trials`) and of the linear budget (`linear`), to compare both.

    `names` (m,) are the outputs: 12 coefficients, then delta g at each verification point. `verdict` compares both
    methods by JCGM 101:2008, clause 8.
    """

    names: tuple[str, ...]
    linear: Propagated
    trials: Distributed
    verdict: Validation


def exact_monte_carlo(budget: Budget, trials: int, seed: int = 1) -> ExactResult:
    """Propagate the sources of a budget through the exact geometry, and compare with the linear budget.

    Raises `CalibrationError` for fewer trials than a coverage interval needs.
    """
    require_trials(trials)
    rng = np.random.default_rng(seed)
    simulated = Simulation(budget)
    sizes = tracked(list(batches(trials, BATCH)), "Monte Carlo trials")
    outputs = np.concatenate([simulated.outputs(count, rng) for count in sizes])
    found = summary(outputs)
    linear = _linear(budget)
    points = [f"Δg {np.degrees(a):g}°" for a in budget.setup.conditions.angle_rad[budget.setup.verification]]
    return ExactResult((*COEFFICIENTS, *points), linear, found, validate(linear, found, DIGITS))


def _linear(budget: Budget) -> Propagated:
    """Return the coefficients, then delta g, by the linear budget, without covariances between the two."""
    total, variances = budget.combined, delta_g_variances(budget)
    count = len(variances)
    covariance = np.diag(np.concatenate([np.zeros(12), variances.sum(axis=1)]))
    covariance[:12, :12] = total.covariance
    dof = effective_dof(variances, [c.source.dof for c in budget.contributions])
    return Propagated(
        np.concatenate([total.value, np.zeros(count)]), covariance, np.concatenate([total.dof, dof])
    )


class Simulation:
    """A Monte Carlo simulation of a budget's bench, many trials at once."""

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._setup = budget.setup
        sources = [c.source for c in budget.contributions if c.source.u > 0.0]
        self._angles = [s for s in sources if s.name in STAND_ANGLES or s.angles]
        self._setting = [s for s in sources if s.name == "setting_error"]
        still = np.zeros((len(self._setup.conditions.mounts), len(STAND_ANGLES)))
        self._plain = replace(self._setup.model, effects=())
        plain = self._plain.readings(self._setup.block, self._setup.conditions, still)
        self._effects = self._setup.signal - plain
        self._additive = [
            (s, influences(s, self._setup)) for s in sources if s not in self._angles + self._setting
        ]

    def outputs(self, trials: int, rng: np.random.Generator) -> Floats:
        """Return the coefficients (V/g, V), then delta g (g) at v verification points, (trials, 12 + v)."""
        setup, gain = self._setup, self._budget.gain
        readings = self.readings(trials, rng)
        excess = (readings - setup.signal).reshape(trials, -1)
        coefficients = setup.block.vector + excess @ gain.reshape(len(gain), -1).T
        rows = readings[:, setup.verification]
        K, U0 = coefficients[:, :9].reshape(-1, 3, 3), coefficients[:, 9:]
        force = np.linalg.solve(K, np.swapaxes(rows - U0[:, None], 1, 2))
        return np.concatenate([coefficients, np.linalg.norm(force, axis=1) - 1.0], axis=1)

    def readings(self, trials: int, rng: np.random.Generator) -> Floats:
        """Return simulated readings (trials, n, 3), V, each trial with random errors of all sources."""
        setup = self._setup
        n, mounts = len(setup.conditions), len(setup.conditions.mounts)
        stand = np.zeros((trials, mounts, len(STAND_ANGLES)))
        for source in self._angles:
            kinds = [STAND_ANGLES.index(name) for name in source.angles or (source.name,)]
            drawn_angles = _draw(source, (trials, len(kinds) * mounts), rng).reshape(
                trials, len(kinds), mounts
            )
            stand[:, :, kinds] += np.swapaxes(drawn_angles[:, :, setup.conditions.clamped], 1, 2)
        setting = sum((_draw(s, (trials, n), rng) for s in self._setting), np.zeros((trials, n)))
        signal = self._plain.readings(
            setup.block,
            setup.conditions.repeated(trials),
            stand.reshape(-1, len(STAND_ANGLES)),
            setting.reshape(-1),
        ).reshape(trials, n, 3)
        signal += self._effects
        for source, parts in self._additive:
            for part in parts:
                signal += part.on_readings(_draw(source, (trials, part.draws), rng))
        return signal


def _draw(source: ErrorSource, shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
    if source.root is None:
        return drawn(source.distribution, shape, rng, source.dof)
    root = np.array(source.root)
    independent = drawn(source.distribution, (shape[0], root.shape[1]), rng, source.dof)
    return np.asarray(independent @ root.T)


DOMINATES: Final = 0.5
"""The block's nonlinearity and effects dominate if their share of the variance exceeds this."""
NAMED: Final = 0.01
"""Sources with a larger share of the variance than this are named among the dominant sources."""


@dataclass(frozen=True)
class Question:
    """Options of an assessment: measuring range (g), limit of delta g (g), decision rule, Monte Carlo trials.

    `same_voltmeters` is as in `measured`; `population` is the distribution of delta g over many blocks.
    """

    range_g: float
    limit_g: float
    rule: DecisionRule
    trials: int = 0
    same_voltmeters: bool = False
    population: Population | None = None


@dataclass(frozen=True)
class Assessment:
    """A budget with its results (`exact` is None without Monte Carlo), and additional notes `beside`."""

    budget: Budget
    question: Question
    accelerations: tuple[AtMagnitude, ...]
    points: tuple[DeltaG, ...]
    exact: ExactResult | None
    beside: tuple[str, ...] = ()

    @property
    def capable(self) -> bool | None:
        """Whether U of delta g is within the acceptance limit at all verification points; None without any.

        If so, a calibration without mistakes passes each point with at least the coverage probability.
        """
        return all(point.capable for point in self.points) if self.points else None

    @cached_property
    def passes(self) -> float | None:
        """Probability that a calibration without a mistake passes at all points; None without any."""
        if not self.points:
            return None
        every = np.concatenate(_delta_g_parts(self.budget), axis=1)
        limits = np.array([point.accepted_up_to for point in self.points])
        return probability_all_accepted(every @ every.T, limits)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on assumed uncertainties and other limitations of the results, then `beside`."""
        return (*self._notes(), *self.beside)

    def _notes(self) -> Iterator[str]:
        sources = [c.source for c in self.budget.contributions]
        priors = [s.name for s in sources if s.prior and s.u > 0.0 and s.origin != ROLL_ORIGIN]
        if priors:
            yield message(
                f"{', '.join(priors)}: assumed from plausible sizes or makers' limits; state known values "
                "in the section 'uncertainty' of the bench file"
            )
        setup = self.budget.setup
        temperatures = np.unique(setup.conditions.temperature_c[setup.fitted])
        if np.sum(np.isfinite(temperatures)) > 1:
            yield message(
                f"the procedure has {len(temperatures)} temperatures, and the coefficients are assumed "
                "equal at all of them; for one temperature, give a procedure with that one alone"
            )
        of_block = [c.source.name for c in self.budget.contributions if c.source.group == "block"]
        found = [a for a in self.accelerations if sum(a.share[name] for name in of_block) > DOMINATES]
        if found:
            share = found[0].share
            names = sorted((n for n in of_block if share[n] > NAMED), key=lambda n: "K3" in n)
            part = 100.0 * sum(share[name] for name in of_block)
            yield message(
                f"from {found[0].magnitude_g:g} g on {' and '.join(names)} "
                f"dominate{'s' if len(names) == 1 else ''} ({part:.0f} % of the variance of |a|): their sizes are "
                "priors, which a calibration at 1 g hardly shows; a centrifuge measures them"
            )
        if any(s.origin == ROLL_ORIGIN for s in sources):
            yield message(
                "mounting_roll: not stated in the bench file, assumed as large as mounting_error; state "
                "the measured value in the section 'stand'"
            )
        if any(s.name == "gravity" and s.u > 0.0 for s in sources):
            yield message(
                "gravity: coefficients per local g do not depend on it; values in m/s² and use at another place do"
            )


def assess(
    setup: Setup,
    sources: Sequence[ErrorSource],
    estimator: str,
    question: Question,
    known: KnownStand | None = None,
) -> Assessment:
    """Return the budget of an estimator with its results; `known` is prior knowledge from other runs.

    Raises the `CalibrationError` of `make_budget`, `measured`, `delta_g` and `exact_monte_carlo`.
    """
    budget = make_budget(setup, sources, estimator, known=known)
    accelerations = tuple(
        over_directions(budget, size, same_voltmeters=question.same_voltmeters)
        for size in magnitudes(question.range_g)
    )
    points = delta_g(budget, question.limit_g, question.rule, population=question.population)
    exact = exact_monte_carlo(budget, question.trials) if question.trials else None
    return Assessment(budget, question, accelerations, points, exact)
