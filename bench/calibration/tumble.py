"""A multi-point tumble by IEEE Std 1293: bias, scale factor, misalignments, K2, K3, … of each accelerometer.

E/K1 = K0 + a_i + Ki_j a_j + Ki_k a_k + K2 a_i^2 + K3 a_i^3 + Koq a_i |a_i| + ..., where i is the input axis, j and
k are the next two in x, y, z, x (IEEE Std 1293-2018; the nonlinear terms are effects of the model).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import CHANNELS, Floats, HasCovariance, rms, u_of
from bench.base.languages import message
from bench.calibration import gls, mistakes
from bench.calibration.budget.coefficients import MeasuredReadings, meters_of, parts_of
from bench.calibration.budget.whole import GRAVITY, acting_sources, without_meters
from bench.calibration.calibrate import first_guess, usable_rows
from bench.calibration.components import SharedErrorFit, notes_on_components, take_in
from bench.calibration.design import FIXED, Problem, make_problem
from bench.calibration.gls import Fit, rounding_of
from bench.calibration.noise import require_told
from bench.calibration.result import MISALIGNMENTS, NOT_ACCEPTED_P, CalibrationError, LackOfFit, Noise
from bench.config.bench_file.file import BenchFile
from bench.model.conditions import Conditions
from bench.model.effects import CATALOGUE, Parameter, Seen
from bench.model.effects.base import AppliedEffect
from bench.model.forward import ForwardModel
from bench.model.geometry import COEFFICIENTS, HIDDEN, STAND_ANGLES, Block
from bench.readings.csv import CentrifugePoints
from bench.readings.table import Readings

# --- points above 1 g, measured on a centrifuge, joined with a fit at 1 g --------------------------------

ROUNDS: Final = 8
ROUNDING: Final = 1e-14
STEP_G: Final = 1e-4
STILL: Final = 1e-3
"""The joint fit has converged when an iteration changes no unknown by more than this fraction of its u."""


@dataclass(frozen=True)
class AboveOneG:
    """Points above 1 g that joined a fit at 1 g, and a test of their agreement with it.

    `force` (n, 3) is the specific force at the points, g. `gain` (12 + q, n, 3) is the linear map from the signals
    at the points to the unknowns. `chi2` is the chi-square of the points against the fit at 1 g. `dof` are its
    degrees of freedom: the number of signals minus the number of unknowns that the readings at 1 g do not
    determine.
    """

    force: Floats
    gain: Floats
    chi2: float
    dof: int

    @property
    def points(self) -> int:
        """The number of points."""
        return len(self.force)

    @property
    def largest_g(self) -> float:
        """The largest specific force, g."""
        return float(np.max(np.linalg.norm(self.force, axis=1)))

    @property
    def p(self) -> float:
        """The p-value of `chi2`; 1 without degrees of freedom."""
        return float(special.chdtrc(self.dof, self.chi2)) if self.dof > 0 else 1.0


def join(
    problem: Problem, found: SharedErrorFit, points: CentrifugePoints, g_m_s2: float, opened: int
) -> tuple[Fit, AboveOneG]:
    """Return the joint fit of the readings at 1 g and the `points`, and the test of their agreement.

    The fit `found` at 1 g, with its covariance, is the prior; if its noise grows with the signal, so does that of
    the points. `opened` is the number of unknowns that the readings at 1 g do not determine. Raises
    `CalibrationError` if the iteration does not converge.
    """
    fit, growth = found.fit, 0.0 if found.growth is None else found.growth
    force = points.force_ms2 / g_m_s2
    conditions, kept = Conditions.of(["1"] * len(force), np.zeros(len(force))), np.isfinite(points.signal)
    start = np.concatenate([fit.block.vector, fit.others])
    scale = np.sqrt(np.diag(fit.covariance))
    size, along = np.linalg.eigh(fit.covariance / np.outer(scale, scale))
    told = along.T / np.sqrt(np.maximum(size, ROUNDING * size[-1]))[:, None]
    # the signals are linear in each unknown by itself: differences are exact for any step
    ahead = 1e-3 * float(np.max(np.abs(fit.block.K))) * np.eye(len(start))[:FIXED]
    steps = [*ahead, *(np.pad(problem.other_step(j), (FIXED, 0)) for j in range(len(fit.others)))]

    def predicted(vector: Floats, acting: Floats) -> Floats:
        model = replace(problem.model, effects=problem.effects_at(vector[FIXED:]))
        return model.readings_at(acting, conditions, Block.from_vector(vector[:FIXED]))

    at = start
    for _ in range(ROUNDS):
        H = np.stack(
            [(predicted(at + s, force) - predicted(at - s, force))[kept] / (2 * np.sum(s)) for s in steps],
            axis=1,
        )
        level = np.hypot(1.0, growth * (predicted(at, force) - at[9:FIXED]))
        noise = _noise(predicted, at, points, g_m_s2, level * fit.noise.widened().by_channel)
        lower = linalg.cholesky(noise[np.ix_(kept.ravel(), kept.ravel())], lower=True)
        whitened = linalg.solve_triangular(
            lower, np.column_stack([H * scale, (points.signal - predicted(at, force))[kept]]), lower=True
        )
        rows = np.concatenate([told, whitened[:, :-1]])
        target = np.concatenate([told @ ((start - at) / scale), whitened[:, -1]])
        q, r = np.linalg.qr(rows)
        inverse = linalg.solve_triangular(r, np.eye(len(start)))
        step = inverse @ (q.T @ target)
        at = at + scale * step
        if np.max(np.abs(step)) < STILL:
            break
    else:
        raise CalibrationError(
            f"{points.source}: the joint fit did not converge; check units and axes of the forces"
        )
    chi2 = float(np.sum((target - rows @ step) ** 2))
    own = scale[:, None] * inverse
    gain = own @ linalg.solve_triangular(lower, q[len(start) :], lower=True, trans="T").T
    rest, covariance = np.eye(len(start)) - gain @ H, own @ own.T
    through = np.zeros((len(at), *kept.shape))
    through[:, kept] = gain
    joined = replace(
        fit, block=Block.from_vector(at[:FIXED]), others=at[FIXED:], covariance=covariance,
        gain=np.einsum("pq,qni->pni", rest, fit.gain),
    )  # fmt: skip
    return joined, AboveOneG(force, through, chi2, int(kept.sum()) - opened)


def _noise(
    predicted: Callable[[Floats, Floats], Floats], at: Floats, points: CentrifugePoints, g_m_s2: float,
    reading: Floats,
) -> Floats:  # fmt: skip
    """Return the covariance (3n, 3n) of the points' signals: noise of the readings and errors of the force.

    `reading` (n, 3) is the noise of the signals.
    """
    force, size = points.force_ms2 / g_m_s2, np.linalg.norm(points.force_ms2, axis=1)[:, None] / g_m_s2
    along = force / np.where(size > 0.0, size, 1.0)
    slope = (predicted(at, force + STEP_G * along) - predicted(at, force - STEP_G * along)) / (2 * STEP_G)
    own = linalg.block_diag(*(row[:, None] for row in slope * points.u_ms2[:, None] / g_m_s2))
    shared = (slope * size * points.u_relative[:, None]).ravel()
    return np.asarray(np.diag((reading**2).ravel()) + own @ own.T + np.outer(shared, shared))


# --- terms of each accelerometer ----------------------------------------------------------------------

LINEAR: Final = ("K1", "Ki_j", "Ki_k", "K0")
"""The terms of every tumble: scale factor, the two cross-axis terms, bias."""

HOMES: Final = {
    "K2": "quadratic_nonlinearity",
    "K3": "cubic_nonlinearity",
    "Koq": "odd_quadratic_nonlinearity",
    "Kip": "cross_coupling",
    "Kio": "cross_coupling",
    "Kpo": "cross_coupling",
    "Kpp": "cross_quadratic",
    "Koo": "cross_quadratic",
    "K0p": "bias_asymmetry",
    "K1p": "scale_asymmetry",
}
"""The effect of each nonlinear term, in the order of requested terms; K0p and K1p stand for K0' and K1'."""

AS_PARAMETER: Final = {"K1p": ("Kabs", 0.5)}
"""Terms whose effect has another parameter: its name, and the factor from term to parameter, Kabs = K1'/2."""

DEFAULT: Final = ("K2", "K3", "Koq")

SHOWN: Final = 1e-3
"""Shares of one term in another below this come from rounding and angle errors, and are not listed."""


def parameter_of(term: str) -> Parameter:
    """Return the effect parameter of a nonlinear term."""
    name, _ = AS_PARAMETER.get(term, (term, 1.0))
    return next(p for p in CATALOGUE[HOMES[term]].parameters if p.name == name)


def term_of(parameter: str) -> tuple[str, float]:
    """Return the nonlinear term of an effect parameter, and the factor from the parameter to the term."""
    return next(
        ((t, 1 / by) for t, (name, by) in AS_PARAMETER.items() if name == parameter), (parameter, 1.0)
    )


def columns(force: Floats, channel: int, terms: Sequence[str], conditions: Conditions) -> Floats:
    """Return the design matrix (n, 4 + t) of E/K1 for a channel at specific forces (n, 3), g.

    Its columns are those of `LINEAR`, then one for each of the t nonlinear `terms`.
    """
    i, j, k = channel, (channel + 1) % 3, (channel + 2) % 3
    linear = [force[:, i], force[:, j], force[:, k], np.ones(len(force))]
    return np.column_stack([*linear, *(_nonlinear(term, force, conditions)[:, channel] for term in terms)])


def _nonlinear(term: str, force: Floats, conditions: Conditions) -> Floats:
    """Return a term of size 1 in all channels, (n, 3), from the effect that simulation and fit use."""
    effect, (name, size) = CATALOGUE[HOMES[term]], AS_PARAMETER.get(term, (term, 1.0))
    sizes = {p.name: np.full(3, size * (p.name == name)) for p in effect.parameters}
    return effect.addition(sizes, Seen(force, conditions, Block(np.eye(3), np.zeros(3))))


@dataclass(frozen=True)
class Separable:
    """The requested terms of a channel, and which of them its orientations determine.

    Of the terms `asked`, those `kept` are estimated. `inseparable` maps each other term to its shares in kept
    terms. Such a term acts on the readings like the sum of the kept terms times these shares. The estimate of
    a kept term contains the inseparable term times its share. A term without shares affects no reading.
    """

    channel: str
    asked: tuple[str, ...]
    kept: tuple[str, ...]
    inseparable: dict[str, dict[str, float]]

    @property
    def rank(self) -> int:
        """Number of requested terms that the orientations determine."""
        return len(self.kept)

    def part_in(self, name: str) -> dict[str, float]:
        """Return the inseparable terms that the estimate of `name` contains, with their shares."""
        return {term: parts[name] for term, parts in self.inseparable.items() if name in parts}

    def sentence(self) -> str:
        """Return a sentence on the number of determined terms, and on the terms that cannot be separated."""
        told = [message(f"{self.rank} of {len(self.asked)} terms are determined")]
        for term, parts in self.inseparable.items():
            if not parts:
                told.append(message(f"{term} shows in no reading"))
            else:
                shares = " and ".join(f"{share:+.3g} {name}" for name, share in parts.items())
                told.append(message(f"{term} cannot be separated: 1 of it looks like {shares}"))
        return message(f"channel {self.channel}: {'; '.join(told)}")


def separable(force: Floats, channel: int, terms: Sequence[str], conditions: Conditions) -> Separable:
    """Return which of `LINEAR` and `terms` the orientations determine; earlier terms have precedence.

    `force` (n, 3), g, is at the nominal geometry. A term is determined if more than the fraction `HIDDEN` of its
    column is linearly independent of the determined terms before it.
    """
    asked = (*LINEAR, *terms)
    whole = columns(force, channel, terms, conditions)
    kept: list[int] = []
    lost: dict[str, dict[str, float]] = {}
    for at, name in enumerate(asked):
        column, before = whole[:, at], whole[:, kept]
        size = float(np.linalg.norm(column))
        share, *_ = np.linalg.lstsq(before, column, rcond=None) if kept else (np.zeros(0),)
        left = float(np.linalg.norm(column - before @ share))
        if size <= HIDDEN * np.sqrt(len(force)):
            lost[name] = {}
        elif left > HIDDEN * size:
            kept.append(at)
        else:
            parts = zip((asked[k] for k in kept), share.tolist(), strict=True)
            lost[name] = {part: value for part, value in parts if abs(value) > SHOWN}
    return Separable(CHANNELS[channel], asked, tuple(asked[k] for k in kept), lost)


# --- the estimates --------------------------------------------------------------------------------


NO_PRIOR: Final = 1.0
"""Prior standard deviation of a term, g/g^n: far beyond any plausible size, so that the data decide."""
OPEN_AT_1_G: Final = 1e-2
"""Prior in place of `NO_PRIOR` if points above 1 g follow: 500 plausible sizes, which keeps their fit well
conditioned.
"""
K: Final = 2.0
"""Coverage factor of U."""
MOVES: Final = 0.01
"""Changes below this fraction of the size of an omitted term are not reported."""


@dataclass(frozen=True)
class Quantity:
    """One estimated quantity of an accelerometer, in `unit`.

    `u` is the combined u if `TumbleView.combined`; `u_readings` is the part from the readings and the stated stand
    errors. `contains` are the terms that cannot be separated from it, with their shares: "K3" with {"Koq": 0.59} is
    an estimate of K3 + 0.59 Koq.
    """

    name: str
    value: float
    u: float
    u_readings: float
    unit: str
    contains: Mapping[str, float]

    @property
    def words(self) -> str:
        """The combination of terms that was estimated, such as "K3 + 0.586 Koq".

        For the scale factor the shares are relative.
        """
        parts = "".join(f" {'+' if c > 0 else '-'} {abs(c):.3g} {term}" for term, c in self.contains.items())
        if not parts:
            return self.name
        return f"K1 (1{parts})" if self.name == "K1" else self.name + parts


@dataclass(frozen=True)
class TumbleView(HasCovariance):
    """The three accelerometers of a block, each by the terms of IEEE Std 1293.

    `axes` has the m quantities of all channels, in the order of `names` ("x.K0") and of `covariance` (m, m).
    `covariance_readings` is the part of the covariance due to the readings and the stated stand errors; if
    `combined`, `covariance` also has the errors that no reading shows. `judged` says which terms the
    orientations determine. `left_out[channel][term][quantity]` is the change of the quantity, g or g/g^n, if
    a term that was not requested has the value 1 g/g^n. `block` has the coefficients estimated together with
    the requested terms. `gain` (m, n, 3) is the linear map from the readings `fitted` to the quantities;
    `slope` (n, 3) is du/dphi. `above` describes the points above 1 g that joined the fit.
    """

    unit: str
    g_m_s2: float
    block: Block
    axes: Mapping[str, tuple[Quantity, ...]]
    covariance: Floats
    covariance_readings: Floats
    gain: Floats
    slope: Floats
    judged: tuple[Separable, ...]
    left_out: Mapping[str, Mapping[str, Mapping[str, float]]]
    noise: Noise
    lack_of_fit: LackOfFit
    fitted: Readings
    combined: bool = False
    notes: tuple[str, ...] = ()
    above: AboveOneG | None = None

    @property
    def above_agrees(self) -> bool:
        """Whether the points above 1 g, if there are any, agree with the readings."""
        return self.above is None or self.above.p >= NOT_ACCEPTED_P

    @property
    def names(self) -> list[str]:
        """Channel and name of each quantity, in the order of `covariance`."""
        return [f"{channel}.{q.name}" for channel, own in self.axes.items() for q in own]

    def correlation(self, first: str, second: str) -> float:
        """Return the correlation of two quantities, which are given by their `names`."""
        a, b = self.names.index(first), self.names.index(second)
        return float(self.covariance[a, b] / (self.u[a] * self.u[b]))


def tumble_view(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    g_m_s2: float,
    terms: Sequence[str] = DEFAULT,
    noise: Noise | None = None,
    *,
    assumed_u: Mapping[str, float] | None = None,
    above: CentrifugePoints | None = None,
) -> TumbleView:
    """Estimate the requested `terms` (names in `HOMES`) of each accelerometer from the oriented readings.

    The other arguments are as in `calibrate`. The terms replace the effects of the model. Points `above` 1 g join
    the fit. At 1 g a power series is not unique (DTIC AD0607702): only points above 1 g separate a cubic term from
    terms that act like one at 1 g. Raises `CalibrationError` if the readings do not determine the twelve
    coefficients or show no response of a channel, or a term is unknown or repeated.
    """
    strange = [term for term in terms if term not in HOMES]
    if strange or len(set(terms)) < len(terms):
        raise CalibrationError(
            f"terms {', '.join(strange or terms)}: {'unknown' if strange else 'given twice'}; give each once, "
            f"from {', '.join(HOMES)}"
        )
    assumed = dict(assumed_u or {})
    sizes = {**stand_u, **assumed}
    rows = usable_rows(readings, model)
    plain = replace(model, effects=())
    conditions = rows.conditions()
    start = first_guess(make_problem(plain, conditions, sizes), rows.signal, rows.resolution)
    still = make_problem(plain, conditions, {}).stand_matrix(np.zeros(0))
    force = plain.specific_force(conditions, still, Block(np.eye(3), np.zeros(3)))
    alone = tuple(separable(force, channel, terms, conditions) for channel in range(3))
    judged = alone if above is None else _judged_with(above, force, terms, g_m_s2)
    problem = _problem(
        plain, make_problem(with_terms(plain, terms), conditions, sizes), judged,
        NO_PRIOR if above is None else OPEN_AT_1_G,
    )  # fmt: skip
    fit = gls.fit(problem, rows.signal, start, noise, rows.resolution)
    require_told(fit.noise)
    rounding = rounding_of(problem, fit, rows.resolution)
    floor = gls.noise_floor(rows.signal, rows.resolution)
    shared = take_in(problem, fit, readings.unit, floor, rounding)
    if shared.growth is not None:
        fit = gls.fit(replace(problem, growth=shared.growth), rows.signal, start, noise, rows.resolution)
    fit_test = replace(gls.lack_of_fit(problem, fit, rounding), rms=rms(fit.residuals))
    fit, joined = shared.fit, None
    if above is not None:
        opened = sum(own.rank - there.rank for own, there in zip(judged, alone, strict=True))
        fit, joined = join(problem, shared, above, g_m_s2, opened)
    mistakes.refuse_singular(fit.block, u_of(fit.covariance[:FIXED, :FIXED]))
    axes, through = _quantities(problem, fit, judged, readings.unit)
    whole = through @ fit.covariance @ through.T
    whole = 0.5 * (whole + whole.T)
    shown = whole - _of_assumed(problem, fit, through, assumed)
    gain = np.einsum("mp,pni->mni", through, fit.gain)
    moved = _left_out(fit, force, conditions, terms, through, axes, joined)
    axes = sized(axes, whole, shown)
    return TumbleView(
        readings.unit, g_m_s2, fit.block, axes, whole, shown, gain, fit.slope, judged, moved, fit.noise, fit_test,
        rows, notes=notes_on_components(shared.components, readings.unit), above=joined,
    )  # fmt: skip


def _judged_with(
    above: CentrifugePoints, force: Floats, terms: Sequence[str], g_m_s2: float
) -> tuple[Separable, ...]:
    """Return which terms the points above 1 g and the readings at 1 g determine together, for each channel.

    A point counts for a channel only if its signal was read.
    """
    every = [np.concatenate([force, above.force_ms2[np.isfinite(read)] / g_m_s2]) for read in above.signal.T]
    nowhere = [Conditions.of(["1"] * len(one), np.zeros(len(one))) for one in every]
    return tuple(separable(every[k], k, terms, nowhere[k]) for k in range(3))


def _of_assumed(problem: Problem, fit: gls.Fit, through: Floats, assumed: Mapping[str, float]) -> Floats:
    """Return the part (m, m) of the covariance due to stand angles of merely assumed size."""
    at = [FIXED + k for k, unknown in enumerate(problem.stand) if STAND_ANGLES[unknown.column] in assumed]
    if not at:
        return np.zeros((len(through),) * 2)
    across = through @ fit.covariance[:, at]
    return np.asarray(across @ np.linalg.solve(fit.covariance[np.ix_(at, at)], across.T))


def with_terms(model: ForwardModel, terms: Sequence[str]) -> ForwardModel:
    """Return the model with no effects but those of the terms, each once and with the value zero."""
    homes = dict.fromkeys(HOMES[term] for term in terms)
    return replace(model, effects=tuple(AppliedEffect(CATALOGUE[home], {}) for home in homes))


def _problem(plain: ForwardModel, whole: Problem, judged: Sequence[Separable], prior_u: float) -> Problem:
    """Return the problem with the determined terms as unknowns, which have the wide prior `prior_u`."""
    kept = tuple(
        replace(unknown, prior_u=prior_u, stated=False)
        for unknown in whole.effects
        if unknown.channel is not None and term_of(unknown.parameter)[0] in judged[unknown.channel].kept
    )
    return replace(whole, effects=kept) if kept else replace(whole, model=plain, effects=())


Row = tuple[str, float, str, Floats]
"""Name, value, unit of a quantity, and its derivatives (12 + q,) by the unknowns of the fit."""


def _quantities(
    problem: Problem, fit: gls.Fit, judged: Sequence[Separable], unit: str
) -> tuple[dict[str, tuple[Quantity, ...]], Floats]:
    """Return the quantities of each channel, with u still zero, and their derivatives (m, 12 + q)."""
    rows = [list(_rows(problem, fit, own, channel, unit)) for channel, own in enumerate(judged)]
    axes = {
        own.channel: tuple(
            Quantity(name, value, 0.0, 0.0, of, _contained(own, name, channel))
            for name, value, of, _ in found
        )
        for channel, (own, found) in enumerate(zip(judged, rows, strict=True))
    }
    return axes, np.stack([derivative for found in rows for *_, derivative in found])


def _rows(problem: Problem, fit: gls.Fit, judged: Separable, channel: int, unit: str) -> Iterator[Row]:
    """Yield bias, scale factor, the two angles, and the nonlinear terms of a channel."""
    vector = np.concatenate([fit.block.vector, fit.others])
    ones = np.eye(len(vector))
    own, bias = COEFFICIENTS.index(f"K{judged.channel}{judged.channel}"), 9 + channel
    scale = float(vector[own])

    def part(at: int, sign: float = 1.0) -> tuple[float, Floats]:
        """Return coefficient `at` divided by the scale factor and multiplied by `sign`, with its derivatives."""
        value = sign * float(vector[at]) / scale
        return value, sign * ones[at] / scale - value / scale * ones[own]

    value, derivative = part(bias)
    yield "K0", value, "g", derivative
    yield "K1", scale, f"{unit}/g", ones[own]
    for name, (cross, of, sign) in MISALIGNMENTS.items():
        if of == COEFFICIENTS[own]:
            value, derivative = part(COEFFICIENTS.index(cross), sign)
            yield name, value, "rad", derivative
    first = FIXED + len(problem.stand)
    for at, unknown in enumerate(problem.effects, first):
        if unknown.channel == channel:
            term, by = term_of(unknown.parameter)
            of_term = parameter_of(term).unit.replace("ug", "g")
            yield term, by * float(vector[at]), of_term, by * ones[at]


def sized(
    axes: Mapping[str, Sequence[Quantity]], covariance: Floats, readings: Floats
) -> dict[str, tuple[Quantity, ...]]:
    """Return the quantities with `u` from their covariance (m, m), and `u_readings` from its part `readings`."""
    u, shown = iter(u_of(covariance).tolist()), iter(u_of(readings).tolist())
    return {
        channel: tuple(replace(q, u=next(u), u_readings=next(shown)) for q in own)
        for channel, own in axes.items()
    }


def _contained(judged: Separable, name: str, channel: int) -> dict[str, float]:
    """Return the shares of inseparable terms that the quantity `name` contains.

    The shares in an angle have the sign of that angle.
    """
    if name not in MISALIGNMENTS:
        return judged.part_in(name)
    cross, _, sign = MISALIGNMENTS[name]
    next_axis = CHANNELS[(channel + 1) % 3]
    of = "Ki_j" if cross[2] == next_axis else "Ki_k"
    return {term: sign * share for term, share in judged.part_in(of).items()}


def _left_out(
    fit: gls.Fit, force: Floats, conditions: Conditions, terms: Sequence[str], through: Floats,
    axes: Mapping[str, Sequence[Quantity]], above: AboveOneG | None,
) -> dict[str, dict[str, dict[str, float]]]:  # fmt: skip
    """Return the changes of the quantities if a term that was not requested has the value 1 g/g^n.

    They are keyed by channel, term and quantity; changes up to `MOVES` are left out.
    """
    others = [term for term in HOMES if term not in terms]
    moved: dict[str, dict[str, dict[str, float]]] = {}
    first = 0
    for channel, letter in enumerate(CHANNELS):
        own = axes[letter]
        scale = fit.block.K[channel, channel]
        shown = columns(force, channel, others, conditions)[:, len(LINEAR) :] * scale
        by_unknown = fit.gain[:, :, channel] @ shown
        if above is not None:
            there = Conditions.of(["1"] * above.points, np.zeros(above.points))
            more = columns(above.force, channel, others, there)[:, len(LINEAR) :] * scale
            by_unknown = by_unknown + above.gain[:, :, channel] @ more
        shift = through[first : first + len(own)] @ by_unknown
        moved[letter] = {
            term: {
                q.name: float(by)
                for q, by in zip(
                    own, shift[:, at] / [scale if q.name == "K1" else 1.0 for q in own], strict=True
                )
                if abs(by) > MOVES
            }
            for at, term in enumerate(others)
        }
        first += len(own)
    return moved


def combine(
    view: TumbleView, bench: BenchFile, model: ForwardModel, terms: Sequence[str], day: date | None = None
) -> TumbleView:
    """Return the view with its combined covariance, which adds the errors that no reading shows.

    Priors of the `terms` do not enter the covariance, because the fit estimates these terms. `day` is the
    date of the readings, from which the drift since each certificate follows. For a view in another unit than
    volts, a note says that errors of voltmeters are left out.
    """
    taken = MeasuredReadings(view.fitted, view.block, meters_of(bench), view.slope)
    covariance = view.covariance.copy()
    for error in acting_sources(view.unit, bench, with_terms(replace(model, effects=()), terms), day):
        if error.name != GRAVITY:
            parts = parts_of(error, taken, view.gain)
            covariance += parts @ parts.T
    axes = sized(view.axes, covariance, view.covariance_readings)
    notes = (*view.notes, *without_meters(view.unit))
    return replace(view, axes=axes, covariance=covariance, combined=True, notes=notes)
