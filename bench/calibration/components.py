"""Variance components that readings share (by setting, stay at a point, pass, drift), and notes on them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import ARCSEC, CHANNELS, HOUR, Floats, Ints, rms
from bench.base.languages import message
from bench.base.numbers import scale_for, two_digits
from bench.calibration.design import Problem
from bench.calibration.gls import LEAST_ALONE, MOST_SIGNALS, Fit, finish, is_rounded, rounded_alike
from bench.calibration.noise import SharedRounding, repeat_groups
from bench.calibration.result import BiasWander, Component, Noise, NoisePrior, widening
from bench.model.conditions import Conditions
from bench.stats.reml import Mixed, Projection, asked_for, maximise

ASKED_P: Final = 0.01
"""Familywise significance level for adding a variance component."""
SOME: Final = 0.2
"""Start value of a component's variance, as a fraction of the noise variance."""
HARDLY_ANY: Final = 0.01
"""A component below this fraction of the noise variance is dropped, because others explain it."""
WAVES: Final = 8
"""Number of principal components of a random walk that are kept: the others have 1 % of the walk's variance."""
AT_REST_RAD: Final = np.radians(0.01)
"""Head angles that differ by less belong to one setting: procedures turn farther, encoders at rest drift less."""
NOISE: Final = "noise"
SETTING: Final = "setting error"
ANGLE: Final = "angle of a setting"
VISIT_ANGLE: Final = "angle of a visit"
PASS_ANGLE: Final = "angle of a pass"
PASS_GAIN: Final = "gain of a pass"
READING_GAIN: Final = "gain of a reading"
GAINS: Final = (PASS_GAIN, READING_GAIN)
FRESH: Final = (NOISE, READING_GAIN)
ROUNDED: Final = "rounding"
DRIFT: Final = "drift"


@dataclass(frozen=True)
class SharedErrorFit:
    """A fit with the variance components that its readings share, and with the drift if one was found.

    `covariance` (3n + m, 3n + m) is the covariance of the 3n signals of n oriented readings and of m moduli;
    None without components. `wander` (3,) is the rms deviation of each bias from its mean over the run, in
    the unit of the signal; None if no drift was searched for. For a significant drift it is the estimate,
    widened for few degrees of freedom; for any other, the root of the posterior mean variance. If there are
    components, the rms of the three values replaces each smaller one.
    """

    fit: Fit
    components: tuple[Component, ...] = ()
    drift: BiasWander | None = None
    covariance: Floats | None = None
    wander: Floats | None = None

    @property
    def growth(self) -> Floats | None:
        """The noise per signal, divided by the noise at zero signal, (3,); None if the noise does not grow."""
        own = [c for c in self.components if c.what == READING_GAIN]
        of = np.array([sum(c.size for c in own if c.channels == channel) for channel in CHANNELS])
        return of / self.fit.noise.by_channel if own else None


@dataclass(frozen=True)
class _Term:
    """A candidate component: the design matrix `columns` (N, q) of its random effects.

    `what` is the kind of component, `channels` is "x", "y", "z" or "all".
    """

    what: str
    channels: str
    columns: Floats
    unit_of: Floats
    """The size of a random effect of 1: by channel in the unit of the signal or relative, or one angle, rad."""


def take_in(
    problem: Problem, fit: Fit, unit: str, floor: float = 0.0, rounding: SharedRounding | None = None
) -> SharedErrorFit:
    """Add to the noise of a fit the variance components that its readings share, and return the new fit.

    With a `rounding` error that repeats share, only this component is added. Otherwise the function searches for
    components. It does not search if there are too few repeats or more than `MOST_SIGNALS` signals, or if the noise
    hardly exceeds its lower limit `floor` (unit of the signal).
    """
    try:
        if rounding is not None:
            return _rounded(problem, fit, rounding, unit)
        return _searched(problem, fit, unit, floor)
    except np.linalg.LinAlgError:
        return SharedErrorFit(fit)


def _searched(problem: Problem, fit: Fit, unit: str, floor: float) -> SharedErrorFit:
    conditions, n = problem.conditions, len(problem.conditions)
    if not 0 < 3 * n <= MOST_SIGNALS or fit.noise.source != "repeats" or is_rounded(fit.noise, floor):
        return SharedErrorFit(fit)
    basic = _basic(fit)
    base = len(basic)
    terms, theta, chance, open_to, alike = _taken_in(
        problem, fit, basic, list(_further(conditions, fit)), floor
    )
    theta[base:] = np.where(theta[base:] < HARDLY_ANY, 0.0, theta[base:])
    if not np.any(theta[base:] > 0):
        return SharedErrorFit(fit, wander=open_to)
    theta = _with_like_gains(terms, theta)
    own = _mixed(problem, fit, [t.columns for t in terms], alike)
    at = Projection.at(own, theta)
    shared = _shared(problem, fit, own, terms, theta, at, chance, base, unit, alike)
    found_drifts = np.zeros(3)
    for component in shared.components:
        if component.what == DRIFT:  # a single run determines it with few degrees of freedom
            found_drifts[CHANNELS.index(component.channels)] = component.size * widening(component.dof)
    wander = np.where(found_drifts > 0, found_drifts, open_to)
    # one run shows little of a random walk, and the channels are alike: none gets less than the rms of all three
    return replace(shared, wander=np.maximum(wander, rms(wander)))


def _rounded(problem: Problem, fit: Fit, rounding: SharedRounding, unit: str) -> SharedErrorFit:
    """Return the fit whose covariance contains the rounding error that repeats share."""
    basic, digit = _basic(fit), np.sqrt(rounding.variance)
    of_moduli = np.linalg.norm(fit.system.free.by_signal * digit, axis=1)
    shared = linalg.block_diag(_by_group(rounding.groups, digit, range(3), 0), np.diag(of_moduli))
    found = _mixed(problem, fit, [*(t.columns for t in basic), shared])
    wider = widening(fit.noise.reading_dof) ** 2
    # the noise includes rounding: only the rest of it is independent from repeat to repeat
    alone = np.maximum(1.0 - rounding.variance / fit.noise.by_channel**2, LEAST_ALONE)
    variances = np.array([*(wider * alone), wider * (fit.noise.setting_rad > 0), 1.0])
    covariance = replace(found, known=np.zeros_like(found.known)).covariance(variances)
    size = float(np.sqrt(rounding.variance.mean()))
    component = Component(ROUNDED, "all", size, unit, fit.noise.dof, 0.0)
    return SharedErrorFit(finish(problem, fit, covariance, fit.noise), (component,), covariance=covariance)


def _taken_in(
    problem: Problem, fit: Fit, basic: list[_Term], further: list[_Term], floor: float
) -> tuple[list[_Term], Floats, Floats, Floats, Floats]:
    """Return the accepted terms, their variances and p-values (k,), and the possible bias wander (3,).

    Last is the covariance (N, N) of rounding errors: repeats of small signals share them even if the noise grows.

    All kinds of component form one family of tests with the familywise error rate `ASKED_P`. By Holm's step-down
    method each next kind is tested in a model that contains the kinds already accepted.
    """
    terms, left, chance = list(basic), list(further), np.zeros(len(basic))
    theta = np.ones(len(basic))
    theta[-1] = float(fit.noise.setting_rad > 0)
    least = np.minimum((floor / fit.noise.by_channel) ** 2, 1.0)
    open_to, alike = np.zeros(3), np.zeros((len(basic[0].columns),) * 2)
    while left:
        mixed = _mixed(problem, fit, [t.columns for t in (*terms, *left)], alike)
        at = Projection.at(mixed, np.concatenate([theta, np.zeros(len(left))]))
        asked = asked_for(at, mixed.columns, len(terms), fit.noise.reading_dof)
        if len(terms) == len(basic):
            open_to = _wander(left, asked.expected)
        what, p = _most_significant(left, asked.chance)
        if p >= ASKED_P:
            break
        new = [t for t in left if t.what == what]
        left = [t for t in left if t.what != what]
        terms += new
        chance = np.concatenate([chance, np.full(len(new), max(p, float(chance.max())))])
        own, start = _mixed(problem, fit, [t.columns for t in terms], alike), np.full(len(terms), SOME)
        start[: len(theta)] = np.where(theta > 0, theta, SOME)
        at_least = np.concatenate([least, np.zeros(len(terms) - 3)])
        theta, _ = maximise(own, start, np.ones(len(terms)), at_least)
        if what == READING_GAIN:
            fresh = [
                v * np.sum(t.columns**2, axis=1) for t, v in zip(terms, theta, strict=True) if t.what in FRESH
            ]
            alike = rounded_alike(problem.conditions, np.sqrt(np.sum(fresh, axis=0)), floor)
    return terms, theta, chance, open_to, alike


def _with_like_gains(terms: list[_Term], theta: Floats) -> Floats:
    """Return the variances (k,), with the gain of a pass in each channel at least the rms over the channels.

    The channels are alike, but few passes determine the gain of a channel that one installation alone turns.
    """
    squared = np.array([t.unit_of[0] ** 2 if t.what == PASS_GAIN else np.inf for t in terms])
    gains = np.isfinite(squared)
    least = np.sum(theta[gains] * squared[gains]) / max(np.sum(gains), 1)
    return np.asarray(np.maximum(theta, least / squared))


def _most_significant(terms: list[_Term], chance: Floats) -> tuple[str, float]:
    """Return the most significant kind and its p-value, adjusted for the number of kinds (Bonferroni).

    The p-values of a kind's channels are combined by Fisher's method.
    """
    kinds = list(dict.fromkeys(t.what for t in terms))
    of = np.array([kinds.index(t.what) for t in terms], dtype=np.int64)
    surprise = np.bincount(of, -2.0 * np.log(np.maximum(chance, 1e-300)))
    of_kind = special.chdtrc(2.0 * np.bincount(of), surprise)
    most = int(np.argmin(of_kind))
    return kinds[most], min(len(kinds) * float(of_kind[most]), 1.0)


def _wander(terms: list[_Term], variances: Floats) -> Floats:
    """Return the rms wander of each bias (3,), in the unit of the signal, from the variances of the drift terms."""
    size = np.zeros(3)
    for term, variance in zip(terms, variances.tolist(), strict=True):
        if term.what == DRIFT:
            size[CHANNELS.index(term.channels)] = float(np.sqrt(variance)) * rms(term.unit_of)
    return size


# --- candidates -------------------------------------------------------------------------------------


def _basic(fit: Fit) -> list[_Term]:
    """Return the noise of each channel and the setting error as terms, scaled by their sizes in `fit`."""
    n = len(fit.residuals)
    free = fit.system.free
    terms = []
    for c, size in enumerate(fit.noise.by_channel.tolist()):
        columns = linalg.block_diag(np.kron(np.eye(n), np.eye(3)[:, [c]]), np.diag(free.by_signal[:, c]))
        terms.append(_Term(NOISE, CHANNELS[c], size * columns, np.array([size])))
    size = fit.noise.setting_rad or _angle(fit)
    along = _along(np.arange(n), fit.slope, size, len(free.left))
    return [*terms, _Term(SETTING, "all", along, np.array([size]))]


def _further(conditions: Conditions, fit: Fit) -> Iterator[_Term]:
    """Yield the candidate components.

    Setting, visit, and the angles of a setting, visit and pass have one variance for all channels; pass, drift, and
    the gain of a pass or reading have one per channel. A gain of each reading is noise that grows with the signal.
    """
    settings = repeat_groups(conditions)
    passes = _labels(conditions.mount, conditions.pass_number)
    visits = _visits(conditions)
    n, further = len(conditions), len(fit.system.free.left)
    sizes, angle = fit.noise.by_channel, _angle(fit)
    if np.bincount(settings).max() > 1:
        yield _Term("setting", "all", _by_group(settings, sizes, range(3), further), sizes)
        yield _Term(ANGLE, "all", _along(settings, fit.slope, angle, further), np.array([angle]))
    if len(np.unique(visits)) < n and np.bincount(visits).max() > 1:
        yield _Term("visit", "all", _by_group(visits, sizes, range(3), further), sizes)
        yield _Term(VISIT_ANGLE, "all", _along(visits, fit.slope, angle, further), np.array([angle]))
    if len(np.unique(passes)) > len(conditions.mounts):
        for c in range(3):
            yield _Term("pass", CHANNELS[c], _by_group(passes, sizes, [c], further), sizes[[c]])
        yield _Term(PASS_ANGLE, "all", _along(passes, fit.slope, angle, further), np.array([angle]))
        yield from _gains(PASS_GAIN, passes, fit)
    yield from _gains(READING_GAIN, np.arange(n), fit)
    shapes = _walk(conditions.elapsed_s)
    if shapes.shape[1]:
        for c in range(3):
            columns = np.zeros((3 * n + further, shapes.shape[1]))
            columns[c : 3 * n : 3] = shapes * sizes[c]
            yield _Term(DRIFT, CHANNELS[c], columns, sizes[[c]])


def _gains(what: str, groups: Ints, fit: Fit) -> Iterator[_Term]:
    """Yield errors of gain of each channel, one for each of the `groups` (n,); moduli have those of readings."""
    without_bias = fit.system.jacobian[:, :, :9] @ fit.block.K.ravel()
    joined = np.einsum("mij,ij->mi", fit.system.free.jacobian[:, :9].reshape(-1, 3, 3), fit.block.K)
    for c in np.flatnonzero(without_bias.any(axis=0)).tolist():
        of_channel = np.where(np.arange(3) == c, without_bias, 0.0)
        gain = fit.noise.by_channel[c] / rms(of_channel[:, c])
        columns = _along(groups, of_channel, gain, len(joined))
        if what == READING_GAIN:
            columns = linalg.block_diag(columns[: 3 * len(groups)], np.diag(joined[:, c] * gain))
        yield _Term(what, CHANNELS[c], columns, np.array([gain]))


def _labels(*of: Ints) -> Ints:
    return np.unique(np.stack(of, axis=1), axis=0, return_inverse=True)[1].ravel()


def _visits(conditions: Conditions) -> Ints:
    """Return the visit number of each reading (n,); in a visit, the head rests at one angle within one pass."""
    same = np.abs(np.diff(conditions.angle_rad)) < AT_REST_RAD
    for column in (conditions.mount, conditions.pass_number):
        same &= column[1:] == column[:-1]
    return np.concatenate([[0], np.cumsum(~same)])


def _by_group(groups: Ints, sizes: Floats, channels: Any, further: int) -> Floats:
    n, count = len(groups), int(groups.max()) + 1
    columns = np.zeros((3 * n + further, count * len(channels)))
    for j, c in enumerate(channels):
        columns[3 * np.arange(n) + c, groups * len(channels) + j] = sizes[c]
    return columns


def _angle(fit: Fit) -> float:
    """Return the turn of the head, rad, that changes the signals by as much as the noise."""
    return rms(fit.noise.by_channel) / max(rms(np.linalg.norm(fit.slope, axis=1)), 1e-300)


def _along(groups: Ints, slope: Floats, size: float, further: int) -> Floats:
    n = len(groups)
    columns = np.zeros((3 * n + further, int(groups.max()) + 1))
    for c in range(3):
        columns[3 * np.arange(n) + c, groups] = slope[:, c] * size
    return columns


def _walk(time_s: Floats) -> Floats:
    """Return the leading principal components (n, q) of a centred random walk of unit mean variance."""
    if not np.ptp(time_s) > 0:
        return np.zeros((len(time_s), 0))
    walk = np.minimum.outer(time_s, time_s) - time_s.min()
    centred = walk - walk.mean(axis=0) - walk.mean(axis=1)[:, None] + walk.mean()
    size, shapes = np.linalg.eigh(centred / np.trace(centred) * len(time_s))
    most = min(WAVES, int(np.sum(size > 1e-9 * size[-1])))
    return np.asarray(shapes[:, ::-1][:, :most] * np.sqrt(size[::-1][:most]))


def walk_since(time_s: Floats, later_s: Floats) -> Floats:
    """Return the covariance (v, v), at times `later_s` (v,), of a random walk minus its mean over a run.

    `time_s` (n,) are the times of the run. The walk is scaled so that its mean variance over the run is 1. The
    standard deviation of a drift refers to the same scale.
    """
    begin = min(float(time_s.min()), float(later_s.min()))
    at, then = time_s - begin, later_s - begin
    own, across = np.minimum.outer(at, at), np.minimum.outer(then, at)
    mean = across.mean(axis=1)
    about = np.minimum.outer(then, then) - mean[:, None] - mean + own.mean()
    size = float(np.mean(np.diag(own)) - own.mean())
    return np.asarray(about / size) if size > 0 else np.zeros((len(later_s),) * 2)


def shared_later(
    components: Iterable[Component], noise: Floats, conditions: Conditions, output: Floats, by_signal: Floats
) -> Floats:
    """Return the covariance (v, v) of |a| at later readings by errors of the kinds that the fit found.

    `noise` (3,) is that of the signals, `output` (v, 3) the signals minus U0, `by_signal` (v, 3) the derivatives
    of |a|. An error of the head's angle leaves |a| unchanged, the noise contains the rounding, and a drift is left
    out.
    """
    passes = _labels(conditions.mount, conditions.pass_number)
    groups = {
        "setting": repeat_groups(conditions), "visit": _visits(conditions), "pass": passes, PASS_GAIN: passes,
        READING_GAIN: np.arange(len(output)),
    }  # fmt: skip
    covariance = np.zeros((len(output),) * 2)
    for one in components:
        if one.what not in groups:
            continue
        size = one.size * widening(one.dof) * (noise / rms(noise) if one.channels == "all" else np.ones(3))
        concerned = np.array([one.channels in ("all", c) for c in CHANNELS])
        moved = by_signal * size * concerned * (output if one.what in GAINS else 1.0)
        covariance += np.equal.outer(groups[one.what], groups[one.what]) * (moved @ moved.T)
    return covariance


# --- the fit with them ------------------------------------------------------------------------------


def _mixed(problem: Problem, fit: Fit, Z: list[Floats], alike: Floats | float = 0.0) -> Mixed:
    """Return the linear system of the fit as a mixed model.

    Unknowns with a prior, and rounding errors `alike` (N, N) in repeats, enter as a known covariance.
    """
    system, others = fit.system, fit.others
    rows = np.concatenate([system.jacobian.reshape(-1, system.jacobian.shape[2]), system.free.jacobian])
    fixed = rows.shape[1] - len(others)
    y = np.concatenate([system.left.ravel(), system.free.left])
    y = y + rows[:, fixed:] @ (others - problem.prior_mean)
    scaled = problem.by_prior(rows[:, fixed:])
    return Mixed(y, rows[:, :fixed], tuple(Z), scaled @ scaled.T + alike)


def _shared(
    problem: Problem, fit: Fit, mixed: Mixed, terms: list[_Term], theta: Floats, at: Projection, chance: Floats,
    base: int, unit: str, alike: Floats,
) -> SharedErrorFit:  # fmt: skip
    used = theta > 0
    information = at.moments(mixed.only(used).columns)[2]
    spread = np.linalg.pinv(information * np.outer(theta[used], theta[used]), rcond=1e-10)
    dof = np.full(len(theta), np.inf)
    dof[used] = 2.0 / np.maximum(np.diag(spread), 1e-12)
    wider = theta * np.array([widening(nu) ** 2 for nu in dof])
    noise = _noise(fit, terms, theta, dof, base)
    n = len(fit.residuals)
    covariance = replace(mixed, known=alike).covariance(wider)
    final = finish(problem, fit, covariance, noise)
    found = tuple(
        Component(t.what, t.channels, float(np.sqrt(size)) * rms(t.unit_of),
                  _UNITS.get(t.what, unit), float(nu), float(p))
        for t, size, nu, p in zip(terms[base:], theta[base:], dof[base:], chance[base:], strict=True)
        if size > 0
    )  # fmt: skip
    drifts = [
        (t, z, size) for t, z, size in zip(terms, mixed.Z, theta, strict=True) if t.what == DRIFT and size
    ]
    return SharedErrorFit(final, found, _drift(problem, mixed, at, drifts, n) if drifts else None, covariance)


def _noise(fit: Fit, terms: list[_Term], theta: Floats, dof: Floats, base: int) -> Noise:
    sizes = np.sqrt(theta[:base]) * np.array([rms(t.unit_of) for t in terms[:base]])
    channels = sizes[:3]
    own = replace(fit.noise, reading=rms(channels), setting_rad=float(sizes[3]))
    x, y, z = channels.tolist()
    nx, ny, nz = np.where(np.isfinite(dof[:3]), dof[:3], fit.noise.reading_dof).tolist()
    return replace(own, channels=(x, y, z), channel_dof=(nx, ny, nz))


def _drift(
    problem: Problem, mixed: Mixed, at: Projection, drifts: list[tuple[_Term, Floats, float]], n: int
) -> BiasWander:
    """Return the best linear unbiased prediction of each bias over time, with its slope per hour."""
    time_h = problem.conditions.elapsed_s / HOUR
    line = time_h - time_h.mean()
    size, course = np.zeros(3), np.zeros((n, 3))
    for term, columns, variance in drifts:
        c = CHANNELS.index(term.channels)
        own = columns[c : 3 * n : 3]
        course[:, c] = own @ (variance * (columns.T @ at.Py))
        size[c] = float(np.sqrt(variance)) * rms(term.unit_of)
    return BiasWander(size, course, line @ course / (line @ line), float(np.ptp(time_h)))


UNEQUAL_P: Final = 0.001
"""P-value below which unequal noise of the channels, or heavy tails, are reported."""

EXCESS_P: Final = 0.01
"""P-value below which residuals without repeats exceed the noise that the bench file states."""
DISAGREES_P: Final = 0.05
"""P-value below which a contradiction to the stated noise is reported; high, as few readings seldom show any."""

_SHARED_BY: Final = {
    "setting": message("the readings at a setting (installation and point) in all passes"),
    ANGLE: message("the readings at a setting (installation and point) in all passes"),
    "visit": message("the readings of one stay at a setting"),
    VISIT_ANGLE: message("the readings of one stay at a setting"),
    "pass": message("the readings of one pass"),
    PASS_ANGLE: message("the readings of one pass"),
    PASS_GAIN: message("the readings of one pass"),
}
_UNITS: Final = {ANGLE: "rad", VISIT_ANGLE: "rad", PASS_ANGLE: "rad", PASS_GAIN: "1", READING_GAIN: "1"}


def notes_on_noise(
    noise: Noise, tails: float, shared: SharedErrorFit, birge: float, unit: str
) -> tuple[str, ...]:
    """Return notes on the noise, its prior, its heavy tails, and the errors that readings share.

    `tails` is the p-value of heavy tails, `birge` the Birge ratio by which a lack of fit widened u.
    """
    notes = [*note_on_prior(noise, unit), *note_on_excess(noise)]
    if noise.channels is not None and noise.p_equal < UNEQUAL_P:
        sizes = ", ".join(f"{c} {size:.2g} {unit}" for c, size in zip(CHANNELS, noise.channels, strict=True))
        notes.append(
            message(
                f"the channels differ in noise ({sizes}; p = {noise.p_equal:.1g}): each has its own noise"
            )
        )
    if tails < UNEQUAL_P:
        notes.append(
            message(
                f"the noise has heavy tails (p = {tails:.1g}): u describes its standard deviation; the "
                "estimator 'robust' reduces the weight of outliers"
            )
        )
    notes += notes_on_components(shared.components, unit)
    if shared.drift is not None:
        notes.append(
            message(
                f"U0 is the bias at the mean of the run of {shared.drift.hours:.2g} h; at one instant it is "
                "less certain, by its drift"
            )
        )
    if birge > 1.0:
        notes.append(
            message(
                f"the residuals exceed the noise: u is enlarged to {birge:.2g} times that of the noise alone "
                "(Birge ratio)"
            )
        )
    return tuple(notes)


def note_on_prior(noise: Noise, unit: str) -> tuple[str, ...]:
    """Return a note on whether the readings agree with the prior of the noise; none without a prior."""
    return () if noise.prior is None else (_on_prior(noise.prior, unit),)


def note_on_search(readings: int, noise: Noise) -> tuple[str, ...]:
    """Return a note if the repeats could show shared errors, but the `readings` are too many for the search."""
    if 3 * readings <= MOST_SIGNALS or noise.source != "repeats":
        return ()
    return (
        message(
            f"above {MOST_SIGNALS // 3} readings the program does not search for errors that readings share, and "
            "u lacks them; calibrate fewer passes to see whether there are any"
        ),
    )


def note_on_excess(noise: Noise) -> tuple[str, ...]:
    """Return a note if the residuals exceed the stated noise of the bench file (one-sided p < `EXCESS_P`)."""
    of = noise.stated
    if of is None or not (of.ratio > 1.0 and of.p / 2 < EXCESS_P):  # p is two-sided
        return ()
    return (
        message(
            f"the residuals are {of.ratio:.2g} times as large as voltmeter_error and setting_error of the bench "
            "file allow (p < 0.01); repeat passes, and check the head or the model"
        ),
    )


def _on_prior(prior: NoisePrior, unit: str) -> str:
    where = message("the bench file states") if prior.stated else message("other runs gave")
    scale = scale_for(prior.reading, unit)
    rests = message(
        f"u rests on the sizes of the noise that {where} (reading {prior.reading / scale.size:.3g} {scale.unit}, "
        f"setting {prior.setting_rad / ARCSEC:.2g} arcsec, {prior.dof:.2g} degrees of freedom)"
    )
    if not prior.readings_dof > 0:
        return message(f"{rests}: so few readings leave no degrees of freedom to estimate the noise")
    scatter = message(f"they scatter {prior.ratio:.2g} times as much")
    if prior.p < DISAGREES_P:
        return message(
            f"{rests}, and the readings disagree: {scatter} (p = {prior.p:.1g}); measure more points"
        )
    return message(f"{rests}: so few readings hardly show the noise, and {scatter} (p = {prior.p:.2g})")


def notes_on_components(components: Sequence[Component], unit: str) -> tuple[str, ...]:
    """Return a note on each kind of the `components`; `unit` is that of the signal."""
    return tuple(_on_components(components, unit))


def _on_components(components: Sequence[Component], unit: str) -> Iterator[str]:
    for what in dict.fromkeys(c.what for c in components):
        own = [c for c in components if c.what == what]
        if what in {ANGLE, VISIT_ANGLE, PASS_ANGLE}:
            sizes = message(f"{own[0].size / ARCSEC:.2g} arcsec of the head")
        elif what in GAINS:
            by_channel = ", ".join(f"{c.channels} {two_digits(c.size * 1e6)} ppm" for c in own)
            sizes = message(f"{by_channel} of the scale factor")
        elif own[0].channels == "all":
            sizes = f"{own[0].size:.2g} {unit}"
        else:
            sizes = ", ".join(f"{c.channels} {c.size:.2g} {unit}" for c in own)
        if what == READING_GAIN:
            yield message(f"the noise grows with the signal ({sizes}); u includes it")
        elif what == ROUNDED:
            yield message(
                f"the last digit of the signals is coarse: repeats share a rounding error ({sizes}); u includes it"
            )
        elif what == DRIFT:
            yield message(
                f"the biases appear to drift over the run by {sizes} rms about their means; u includes it"
            )
        else:
            yield message(
                f"{_SHARED_BY[what]} seem to share an error ({sizes}), which repeats do not average; u "
                "includes it"
            )
