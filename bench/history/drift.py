"""Drift of coefficients between calibrations, and the due date of a block's next calibration."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import special

from bench.base.arrays import Floats, Ints, Mask
from bench.base.languages import message
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.calibration.result import CalibrationError
from bench.history.comparison import LEAST_FOR_DRIFT, LEAST_SPAN, SECONDS_PER_YEAR
from bench.history.measured import ComparedCalibrations

Dates = NDArray[np.datetime64]

SHOWN_P: Final = 0.05
"""Significance level of a drift rate, for all twelve coefficients together."""
GRID: Final = 14
LEAST_SIZE: Final = 0.02
"""Standard deviations below this fraction of their scale count as zero."""
MOST_SIZE: Final = 30.0
PRIOR_DOF: Final = 3.0
PRIOR_WIDTH: Final = (1.0, 4.0)
"""Prior widths of scatter and walk, as multiples of their scales.

The prior of the walk is wider, because the fitted line absorbs part of a walk.
"""
FORGOTTEN: Final = 12.0
"""Grid points are discarded if their log density is more than this below the maximum."""
LEVEL: Final = 0.95
PRODUCTS: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Index pairs of products: 0 stands for the values, 1 for the level and 2 for the rate of a line."""


@dataclass(frozen=True)
class UnitDrift:
    """The drift of one block from n calibrations; arrays are (12,), in the order of `COEFFICIENTS`, or (9,).

    `rate` with standard uncertainty `u_rate` is per year. `between` is the standard deviation between calibrations
    in excess of their stated u, `walk` that of a random walk in a year. Both maximise the restricted likelihood and
    are 0 if not detected; `between_most` and `walk_most` are their upper 95 % limits. `first` and `last` are the
    dates of the first and last calibration, `count` is their number. `p_all_looks` is the p-value of the rate with
    Bonferroni's correction for the number of coefficients. `states` serve to predict; `common` is the u of errors
    that all calibrations share.
    """

    rate: Floats
    u_rate: Floats
    p_all_looks: Floats
    between: Floats
    between_most: Floats
    walk: Floats
    walk_most: Floats
    first: np.datetime64
    last: np.datetime64
    count: int
    states: States
    common: Floats

    @property
    def shown(self) -> Mask:
        """Which coefficients have a significant drift rate, (12,)."""
        return self.p_all_looks < SHOWN_P

    def predicted(self, date: np.datetime64 | Dates) -> tuple[Floats, Floats]:
        """Return the expected values at dates (…) and their standard uncertainties, (…, 12) each.

        The u applies to a calibration result on the date: it includes the scatter between calibrations, but not
        the errors of the new calibration itself. Raises `CalibrationError` for a date before the last calibration.
        """
        days = np.asarray(date, dtype="datetime64[s]")
        years = (days - self.first.astype("datetime64[s]")).astype(float).ravel() / SECONDS_PER_YEAR
        if not np.all(years >= self.states.last_year - 1e-9):
            raise CalibrationError(
                f"{days.min().astype('datetime64[m]')} is before the last calibration "
                f"({self.last.astype('datetime64[m]')}), and a history predicts only later times; ask for a "
                "later date"
            )
        value, variance = self.states.predicted(years)
        shape = (*days.shape, len(self.rate))
        return value.reshape(shape), np.sqrt(variance + self.common**2).reshape(shape)


@dataclass(frozen=True)
class States:
    """The Kalman filter's state of 12 coefficients at the last calibration, for each of m pairs of variances.

    A pair consists of the variance `between` calibrations and the variance `walk` of a random walk in a year.
    `weight` is the probability of each pair; its sum over the pairs is 1. `line` (12, m, 2) is level and rate,
    `covariance` (12, m, 2, 2) their covariance. The filter of the random walk was run on the values, with the final
    state `walked` (12, m), and on the regressors of the line (ones and times), with the final states `columns`
    (12, m, 2). `left` (12, m) is the variance of the walk. `last_year` is the time from the first to the last
    calibration, years.
    """

    last_year: float
    weight: Floats
    between: Floats
    walk: Floats
    line: Floats
    covariance: Floats
    walked: Floats
    columns: Floats
    left: Floats

    @cached_property
    def _prediction(self) -> tuple[Floats, Floats]:
        """Coefficients of polynomials in years since the last calibration: mean (2, 12), variance (3, 12).

        The polynomials are averages over all pairs of variances. For each pair the mean is linear and its variance
        quadratic in time.
        """
        at = np.stack([1.0 - self.columns[..., 0], self.last_year - self.columns[..., 1]], axis=-1)
        slope = self.line[..., 1]
        value = np.sum(at * self.line, axis=-1) + self.walked
        along = np.sum(self.covariance * at[..., None, :], axis=-1)
        spread = np.sum(at * along, axis=-1) + self.left + self.between
        centre = np.sum(self.weight * value, axis=-1), np.sum(self.weight * slope, axis=-1)
        off, turned = value - centre[0][:, None], slope - centre[1][:, None]
        powers = (
            spread + off**2,
            2.0 * along[..., 1] + self.walk + 2.0 * off * turned,
            self.covariance[..., 1, 1] + turned**2,
        )
        return np.array(centre), np.array([np.sum(self.weight * one, axis=-1) for one in powers])

    def predicted(self, years: Floats) -> tuple[Floats, Floats]:
        """Return the means and variances (d, 12) at times (d,) in years since the first calibration."""
        further = (years - self.last_year)[:, None]
        mean, variance = self._prediction
        return mean[0] + further * mean[1], variance[0] + further * (variance[1] + further * variance[2])

    @property
    def rate(self) -> tuple[Floats, Floats]:
        """The mean and the variance (12,) of the rate, per year."""
        mean, variance = self._prediction
        return mean[1], variance[2]


@dataclass(frozen=True)
class OfUnit:
    """The drift of a unit in the `nine` intrinsic numbers and in the `twelve` coefficients.

    `notes` name other effects that may look like drift.
    """

    unit: str
    signal: str
    simulated: bool
    drift: UnitDrift
    nine: UnitDrift
    notes: tuple[str, ...]


def drift_of_unit(measured: ComparedCalibrations) -> OfUnit:
    """Return the drift of a table's only unit.

    Raises `CalibrationError` for a table of several units, and the errors of `history_drift`.
    """
    units, benches = (sorted(set(labels.tolist())) for labels in (measured.unit, measured.bench))
    if len(units) > 1:
        raise CalibrationError(
            f"the conditions match {len(units)} units, but a drift is of one; add unit=…, such as "
            f"unit='{units[0]}'"
        )
    notes: tuple[str, ...] = ()
    if len(benches) > 1:
        notes = (
            message(
                f"measured on {', '.join(benches)}: differences between benches appear as drift or scatter"
            ),
        )
    twelve, nine = (
        history_drift(
            of.when, of.vector, of.variance,
            np.sqrt(
                (len(benches) == 1) * np.min(of.meters**2, axis=0)
                + (len(set(of.place.tolist())) == 1) * np.min(of.gravity**2, axis=0)
            ),
        )
        for of in (measured, measured.in_nine())
    )  # fmt: skip
    return OfUnit(units[0], measured.signal, measured.simulated, twelve, nine, notes)


def day_of(text: str) -> np.datetime64:
    """Return the date in a text such as "2027-06-01". Raises `CalibrationError` for any other text."""
    try:
        day: np.datetime64 | None = np.datetime64(text, "s")
    except ValueError:
        day = None
    if day is None or np.isnat(day):  # also for "" and "NaT", which numpy accepts
        raise CalibrationError(f"--at: expected a date such as 2027-06-01, got {text!r}")
    return day


def history_drift(when: Dates, values: Floats, variance: Floats, common: Floats | None = None) -> UnitDrift:
    """Return the drift of m quantities of one block: `values` (n, m) at times `when` (n,), in any order.

    `variance` (n, m) are the stated variances. `common` (m,) are the standard uncertainties of errors that all
    calibrations share, such as the gain of the same meters; they are part of the stated u. Such errors do not
    affect rates, and more calibrations do not reduce them. Raises `CalibrationError` for fewer than three
    calibrations, or if all lie within a day.
    """
    order = np.argsort(when, kind="stable")
    dates = np.asarray(when, dtype="datetime64[s]")[order]
    seconds = (dates - dates[0]).astype(float) if len(dates) else np.zeros(0)
    if len(dates) < LEAST_FOR_DRIFT or seconds[-1] < LEAST_SPAN.total_seconds():
        raise CalibrationError(
            f"a drift needs {LEAST_FOR_DRIFT} calibrations or more over more than a day; there are "
            f"{len(dates)} over {seconds[-1] / 3600.0:.2g} h"
            if len(dates) >= LEAST_FOR_DRIFT
            else f"a drift needs {LEAST_FOR_DRIFT} calibrations or more over more than a day; there are "
            f"{len(dates)}"
        )
    alike = np.zeros(values.shape[1]) if common is None else np.asarray(common, dtype=float)
    stated = variance[order]
    own = np.maximum(stated - alike**2, 1e-6 * stated)
    years = seconds / SECONDS_PER_YEAR
    history = _History(years, np.asarray(values, dtype=float)[order], own)
    states, sizes = history.known()
    rate, variance_of_rate = states.rate
    p = special.erfc(np.abs(rate) / np.sqrt(2.0 * variance_of_rate))
    return UnitDrift(
        rate=rate, u_rate=np.sqrt(variance_of_rate), p_all_looks=np.minimum(1.0, len(rate) * p),
        between=sizes[0], between_most=sizes[1], walk=sizes[2], walk_most=sizes[3],
        first=dates[0], last=dates[-1], count=len(dates), states=states, common=alike,
    )  # fmt: skip


@dataclass(frozen=True)
class _History:
    """Values `y` (n, 12) with variances `own` (n, 12) at ascending times `years` (n,) since the first."""

    years: Floats
    y: Floats
    own: Floats

    @cached_property
    def _scales(self) -> tuple[Floats, Floats]:
        """The scales (12,): standard deviations of the scatter, and of the random walk in a year."""
        line = np.stack([np.ones_like(self.years), self.years], axis=1)
        left = self.y - line @ np.linalg.lstsq(line, self.y, rcond=None)[0]
        scatter = np.sqrt(np.median(self.own, axis=0) + np.sum(left**2, axis=0) / (len(self.y) - 2))
        return scatter, scatter / np.sqrt(self.years[-1] / (len(self.y) - 1))

    def known(self) -> tuple[States, tuple[Floats, Floats, Floats, Floats]]:
        """Return the states, and the REML estimates and upper limits of scatter and of walk, (12,) each."""
        lowest = np.full((2, self.y.shape[1]), np.log(LEAST_SIZE))
        highest = np.full_like(lowest, np.log(MOST_SIZE))
        for _ in range(2):
            nodes = np.linspace(lowest, highest, GRID, axis=-1)
            states, density, likelihood = self._at(nodes)
            lowest, highest = _within(nodes, density)
        between, walk = (np.exp(nodes[j]) * self._scales[j][:, None] for j in (0, 1))
        found = []
        best = likelihood.reshape(self.y.shape[1], -1).argmax(axis=1)
        share = states.weight.reshape(density.shape)
        for sizes, index, along in ((between, best // GRID, 2), (walk, best % GRID, 1)):
            found.append(np.where(index == 0, 0.0, _taken(sizes, index)))
            found.append(_taken(sizes, np.argmax(np.cumsum(share.sum(axis=along), axis=1) >= LEVEL, axis=1)))
        return states, (found[0], found[1], found[2], found[3])

    def _at(self, nodes: Floats) -> tuple[States, Floats, Floats]:
        """Run the filter for all pairs of scatter and walk, whose logarithms are `nodes` (2, 12, g).

        Return the states, and the log density (with priors) and the log likelihood, (12, g, g) each.
        """
        scatter, step = self._scales
        between = np.exp(2 * nodes[0]) * scatter[:, None] ** 2
        walk = np.exp(2 * nodes[1]) * step[:, None] ** 2
        tau = np.repeat(between, GRID, axis=1)
        q = np.tile(walk, (1, GRID))
        squares, logs, walked, left = self._filtered(tau, q)
        precision = squares[:, :, 1:, 1:]
        covariance = np.asarray(np.linalg.inv(precision), dtype=np.float64)
        line = np.einsum("kmce,kme->kmc", covariance, squares[:, :, 1:, 0])
        misfit = squares[:, :, 0, 0] - np.einsum("kmc,kmc->km", line, squares[:, :, 1:, 0])
        likelihood = -0.5 * (logs + np.linalg.slogdet(precision)[1] + misfit)
        prior = [
            n - 0.5 * (PRIOR_DOF + 1) * np.log1p(np.exp(2 * n) / (PRIOR_DOF * width**2))
            for n, width in zip(nodes, PRIOR_WIDTH, strict=True)
        ]
        shape = (self.y.shape[1], GRID, GRID)
        density = likelihood.reshape(shape) + prior[0][:, :, None] + prior[1][:, None, :]
        heights = np.exp(density - density.max(axis=(1, 2), keepdims=True)).reshape(tau.shape)
        weight = heights / heights.sum(axis=1, keepdims=True)
        gone = walked[:, :, 0] - np.einsum("kmc,kmc->km", walked[:, :, 1:], line)
        columns = walked[:, :, 1:]
        # `columns` accounts for the walk of the columns, so the walk of the values is stored by itself
        states = States(
            float(self.years[-1]), weight, tau, q, line, covariance,
            gone + np.einsum("kmc,kmc->km", columns, line), columns, left,
        )  # fmt: skip
        return states, density, likelihood.reshape(shape)

    def _filtered(self, tau: Floats, q: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Run the Kalman filter of the walk on the values and on the columns of the line, for variances (12, m).

        Return the sums of squares and products of whitened innovations (12, m, 3, 3), the sum of the logarithms of
        their variances (12, m), the filtered walks of values and columns (12, m, 3), and the variance of a walk
        (12, m).
        """
        # component by component: arrays (12, m) that stay in the processor's cache
        walked = [np.zeros_like(tau) for _ in range(3)]
        left, logs = np.zeros_like(tau), np.zeros_like(tau)
        sums = [np.zeros_like(tau) for _ in PRODUCTS]
        before = 0.0
        for year, y, own in zip(self.years, self.y, self.own, strict=True):
            left = left + q * (year - before)
            before = year
            spread = left + own[:, None] + tau
            inverse = 1.0 / spread
            seen = [y[:, None] - walked[0], 1.0 - walked[1], year - walked[2]]
            weighed = [one * inverse for one in seen]
            for k, (i, j) in enumerate(PRODUCTS):
                sums[k] += seen[i] * weighed[j]
            logs += np.log(spread)
            for k, one in enumerate(weighed):
                walked[k] += left * one
            left = left - left * inverse * left
        squares = np.zeros((*tau.shape, 3, 3))
        for total, (i, j) in zip(sums, PRODUCTS, strict=True):
            squares[..., i, j] = squares[..., j, i] = total
        return squares, logs, np.stack(walked, axis=-1), left


def _within(nodes: Floats, density: Floats) -> tuple[Floats, Floats]:
    """Return the lowest and the highest node with a relevant density, (2, 12) each.

    The range is extended by one node on either side.
    """
    top = density.max(axis=(1, 2), keepdims=True)
    counts = density > top - FORGOTTEN
    ends: list[Floats] = []
    for pick in (0, -1):
        for j, other in ((0, 2), (1, 1)):
            some = counts.any(axis=other)
            first = some.argmax(axis=1) if pick == 0 else GRID - 1 - some[:, ::-1].argmax(axis=1)
            further = np.clip(first + (-1 if pick == 0 else 1), 0, GRID - 1)
            ends.append(_taken(nodes[j], further))
    return np.stack(ends[:2]), np.stack(ends[2:])


def _taken(values: Floats, index: Ints) -> Floats:
    """Return, for each row of `values` (12, g), its element at `index` (12,), shape (12,)."""
    return np.take_along_axis(values, index[:, None], axis=1)[:, 0]


DIRECTIONS: Final[Floats] = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
"""Directions of the specific force, (26, 3), not normalised."""
MOST_YEARS: Final = 20.0
"""The longest extrapolation of a history, years."""
STEPS: Final = (92, 7, 1)
"""Step sizes of the search for the due date, days; each search refines the previous one."""
DAY: Final = np.timedelta64(1, "D")


@dataclass(frozen=True)
class Due:
    """The due date of a block's next calibration, with its `basis` ("drift" or "interval") and the reason `why`.

    `predicted_g` is the error expected on the due date, `now_g` that on the day of the last calibration: |mean| + k
    u in the worst direction, in local g. Both are None if the basis is the interval. `count` is the number of
    calibrations; `last` is the time of the last calibration.
    """

    date: np.datetime64
    basis: str
    why: str
    last: np.datetime64
    count: int
    limit_g: float
    now_g: float | None = None
    predicted_g: float | None = None
    simulated: bool = False


def due(
    when: Dates,
    vector: Floats,
    covariance: Floats,
    limit_g: float,
    interval_days: float,
    u_meters: Floats | None = None,
    *,
    simulated: bool = False,
) -> Due:
    """Return the due date of a block that was calibrated at times `when` (n,).

    `vector` (n, 12) are the coefficients, per local g, and `covariance` (n, 12, 12) their stated covariances.
    `u_meters` (n, 12) is the part of u that recurs with the same meters; None if the meters differ. `limit_g` is
    the permitted error, in g, of a measurement of 1 g in any direction. If the history is too short to show drift,
    `interval_days` determines the date. `simulated` is copied into the result. Raises `CalibrationError` if there
    is no calibration, or if K of the last one is singular.
    """
    if len(when) == 0:
        raise CalibrationError("no calibration has a date, so no due date is known; add dates to the runs")
    order = np.argsort(when, kind="stable")
    dates, values, known = when[order], vector[order], covariance[order]
    last = dates[-1]
    by_interval = last + np.timedelta64(round(interval_days * 86400), "s")
    seen = sensitivities(values[-1])
    errors = (values - values[-1]) @ seen.T
    common = None if u_meters is None else np.sqrt(np.min(u_meters[order] ** 2, axis=0) @ (seen.T**2))
    try:
        drift = history_drift(dates, errors, np.einsum("dj,njk,dk->nd", seen, known, seen), common)
    except CalibrationError as error:
        why = message(f"{error}: the interval of {interval_days:g} days applies")
        return Due(by_interval, "interval", why, last, len(dates), limit_g, simulated=simulated)
    now = float(_expanded(drift, np.array([last]))[0])
    if now >= limit_g:
        why = message(
            f"the last calibration leaves an error of {now:.2g} g (k = {COVERAGE_FACTOR:g}), more than the "
            f"{limit_g:.2g} g allowed: no interval is short enough"
        )
        return Due(last, "drift", why, last, len(dates), limit_g, now, now, simulated)
    day, error_g = _first_day(drift, last.astype("datetime64[D]"), limit_g)
    why = (
        message(f"the expected error reaches {limit_g:.2g} g then (k = {COVERAGE_FACTOR:g})")
        if error_g >= limit_g
        else message(
            f"after {MOST_YEARS:g} years the expected error is still {error_g:.2g} g; the history predicts no "
            "further"
        )
    )
    return Due(day, "drift", why, last, len(dates), limit_g, now, error_g, simulated)


def _first_day(drift: UnitDrift, last: np.datetime64, limit_g: float) -> tuple[np.datetime64, float]:
    """Return the first day after the last calibration on which the error reaches the limit, and that error."""
    begin, end = 0, round(MOST_YEARS * 365.25)
    for step in STEPS:
        days = np.unique(np.append(np.arange(begin + step, end, step), end))
        error_g = _expanded(drift, last + days * DAY)
        reached = int(np.argmax(error_g >= limit_g)) if np.any(error_g >= limit_g) else len(days) - 1
        begin, end = int(days[reached - 1]) if reached else begin, int(days[reached])
    return last + end * DAY, float(error_g[reached])


def sensitivities(vector: Floats) -> Floats:
    """Return the sensitivity coefficients of 1 g measured along 26 directions, (26, 12).

    They are the derivatives by the coefficients `vector` (12,). Raises `CalibrationError` if K is singular.
    """
    along = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    try:
        weights = along @ np.linalg.inv(vector[:9].reshape(3, 3))
    except np.linalg.LinAlgError:
        raise CalibrationError("the last calibration has a singular K; calibrate again") from None
    of_k = np.einsum("da,db->dab", weights, along).reshape(len(along), 9)
    return np.concatenate([of_k, weights], axis=1)


def _expanded(drift: UnitDrift, days: Dates) -> Floats:
    """Return the largest expanded error |mean| + k u of any direction on each day, g."""
    mean, u = drift.predicted(days)
    return np.asarray(np.max(np.abs(mean) + COVERAGE_FACTOR * u, axis=-1))
