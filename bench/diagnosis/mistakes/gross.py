"""Gross mistakes of wiring and procedure: a fit of the readings under each supposition, and its odds."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import Floats
from bench.diagnosis.mistakes.reinterpretation import (
    OrientedRows,
    Reinterpretation,
    nothing,
    other_mountings,
    suppositions,
)
from bench.model.geometry import STAND_ANGLES, Block, Installation, specific_force_on_platform

SIZES: Final = 10
"""Number of sizes that are tried for each of the two errors, with equal ratios."""
LARGEST_G: Final = 0.1
"""The largest of these sizes, g: six degrees.

With more, a block that contradicts its data sheet would pass as tilted.
"""


@dataclass(frozen=True)
class CoefficientPrior:
    """Means and standard deviations (4, 3) of (K_ix, K_iy, K_iz, U0_i), in g and g/g."""

    mean: Floats
    u: Floats


def log_evidence(
    table: OrientedRows, columns: Floats, unit: float, prior: CoefficientPrior, least_g: float, left_out: int
) -> float:
    """Return ln of the probability density of the readings, coefficients and errors integrated out.

    The errors are at least `least_g`. `columns` (n, 4) are specific forces, g, and ones; `unit` is the signal
    for 1 g. `left_out` is the number of readings of the record that are not in the table.
    """
    signal = table.signal / unit
    sizes = np.geomspace(least_g, max(LARGEST_G, least_g), SIZES) ** 2
    of_reading, of_position = (v.ravel() for v in np.meshgrid(sizes, np.append(0.0, sizes)))
    within, means = _split(table, np.concatenate([columns, signal], axis=1))
    precision = 1.0 / of_reading
    freedom = len(table) - sum(count for count, _ in means.values())
    normal = within * precision[:, None, None]
    log_det = -freedom * np.log(precision)
    for repeats, (count, gram) in means.items():
        weight = 1.0 / (of_reading + repeats * of_position)
        normal = normal + gram * weight[:, None, None]
        log_det = log_det - count * np.log(weight)
    total = np.zeros(len(precision))
    for channel in range(3):
        total += _of_channel(normal, log_det, prior.mean[:, channel], prior.u[:, channel], 4 + channel)
    lost = -0.5 * 3 * left_out
    return float(np.logaddexp.reduce(total) - np.log(len(total)) + lost)


def _of_channel(normal: Floats, log_det: Floats, mean: Floats, u: Floats, own: int) -> Floats:
    """Return ln of the evidence of a channel for each pair of sizes, but for ln(2 pi)/2 for each reading."""
    inner, right, square = normal[:, :4, :4], normal[:, :4, own], normal[:, own, own]
    around = right - inner @ mean
    left = square - 2 * right @ mean + np.einsum("a,gab,b->g", mean, inner, mean)
    whole = inner + np.diag(u**-2)
    taken = np.einsum("ga,ga->g", around, np.linalg.solve(whole, around[:, :, None])[:, :, 0])
    size = np.linalg.slogdet(whole * np.outer(u, u))[1]
    return np.asarray(-0.5 * (log_det + size + left - taken))


def _split(table: OrientedRows, columns: Floats) -> tuple[Floats, dict[int, tuple[int, Floats]]]:
    """Return X^T X of what differs among the repeats of a position, and that of the positions' means.

    The latter by the number of repeats, with how many positions have so many; to a degree the same position.
    """
    label = np.unique(table.label, return_inverse=True)[1].ravel()
    key = np.stack([table.mount, label, np.round(np.degrees(table.angle_rad)).astype(np.int64)], axis=1)
    _, group = np.unique(key, axis=0, return_inverse=True)
    repeats = np.bincount(group.ravel())
    sums = np.zeros((len(repeats), columns.shape[1]))
    np.add.at(sums, group.ravel(), columns)
    mean = sums / np.sqrt(repeats)[:, None]
    of_repeats = {
        int(m): (int(np.sum(repeats == m)), mean[repeats == m].T @ mean[repeats == m])
        for m in np.unique(repeats)
    }
    return columns.T @ columns - mean.T @ mean, of_repeats


GROSS_G: Final = 5e-4
"""Error of a reading without a mistake, 1 sigma in g: 100 arcsec, or a large effect of the block.

It is larger for a bench with wider limits.
"""
ODDS: Final = 1e6
"""Least odds, divided by the number of looks, of a mistake, whatever the errors of the bench."""
SCALE_U: Final = 0.10
CROSS_AXIS_U: Final = 0.05
BIAS_U_G: Final = 0.5
"""Prior 1 sigma of the coefficients: fractions of the nominal scale factor, and g."""

LEAST_COST: Final = 0.5 * SCALE_U**-2
"""Least cost of the recorded readings for a search. A channel in another unit costs at least 0.8 / SCALE_U^2."""
LEFT_OF_UNIT: Final = 0.1
"""Most of the misfit that remains when a wrong unit is corrected: a factor of ten is 99 % of it."""
LEAST_FALL: Final = 150.0
"""Least decrease of the cost by a mistake; a wrong sign of a scale factor costs 400."""
FITS: Final = 4.0
"""Readings fit if the misfit is at most `LEAST_FALL` plus this per signal, the sheet's part `LEAST_FALL`."""
LEAST_OF_TWO: Final = 0.25
"""Least misfit of two mistakes, g^2 over all readings; positions tilted by a degree give a tenth of it."""
RAISED: Final = 2.0
"""Most factor by which correcting only the first of two mistakes may increase the cost; it saves time."""

LEAST_P: Final = sys.float_info.min
"""Lower limit of p-values, so that none is 0."""

MOST_LEFT_OUT: Final = 4
LEFT_OUT: Final = 50.0
"""Cost of a reading that is left out."""
STRANGE: Final = 400.0
"""Least decrease of the cost for which a reading is left out: it is wrong by 10 mg."""

EQUAL: Final = 12.0
"""Suppositions whose costs differ by less than this explain the readings equally."""


@dataclass(frozen=True)
class SuppositionScores:
    """Cost (-2 ln posterior; lower is better) and coefficients (H, 4, 3) of each of H suppositions.

    A column of the coefficients has K_ix, K_iy, K_iz and U0_i of a channel. `misfit` (H,) is the cost without
    the Jacobian of the map from the recorded to the supposed signals. `sheet` (H,) is the data sheet's part of
    the cost: the distance of the coefficients from it, as a chi-square.
    """

    cost: Floats
    misfit: Floats
    sheet: Floats
    coefficients: Floats


@dataclass(frozen=True)
class GrossMistake:
    """The supposition that explains the readings best, and those that explain them equally.

    `p` is the number of looks divided by the odds: chance reaches odds of B with a probability below 1/B.
    """

    supposition: Reinterpretation
    equal: tuple[Reinterpretation, ...]
    p: float


@dataclass(frozen=True)
class GrossSearch:
    """A search for gross mistakes in tables of one bench.

    `nominal` (3,) are the scale factors of the data sheet with their signs, in signal units per g, or None.
    `stand_rad` is the standard deviation of a reading's error by the bench's limits, rad (as much in g).
    """

    installations: Mapping[str, Installation]
    nominal: Floats | None
    stand_rad: float = 0.0

    @property
    def gross_g(self) -> float:
        """Standard deviation, in g, of the error of a reading without a mistake."""
        return max(GROSS_G, self.stand_rad)

    def find(self, table: OrientedRows) -> GrossMistake | None:
        """Return the most probable mistake; None if its odds do not exceed `ODDS` for each look.

        The best supposition of each name is compared if it lowers the cost by `LEAST_FALL`. If only two mistakes
        together explain the readings, the first of them is among these.
        """
        if float(self.score(table, [nothing(table)]).cost[0]) < LEAST_COST:
            return None
        supposed = suppositions(table, units=self.nominal is not None)
        looks = len(supposed)
        scores = self.score(table, supposed)
        cost = scores.cost
        likely = list(_best_of_each(supposed, cost))
        if not likely:
            return None
        as_recorded = self._log_evidence(table, table)
        odds = {
            h: self._log_evidence(put_right(table, supposed[h]), table)
            + supposed[h].log_jacobian
            - as_recorded
            for h in likely
        }
        if not _fits(scores, len(table))[int(np.argmin(cost))]:
            two, with_both, more = self._first_of_two(table, supposed, cost)
            looks += more
            if two:
                odds[two] = max(odds.get(two, -np.inf), self._log_evidence(with_both, table) - as_recorded)
        best = max(odds, key=lambda h: odds[h])
        if odds[best] - np.log(looks) <= np.log(ODDS):
            return None
        cost = np.where(cost < cost[best], np.inf, cost)
        p = max(looks * float(np.exp(-odds[best])), LEAST_P)
        return self._with_equals(table, supposed, cost, best, p)

    def p_of_units(
        self, recorded: OrientedRows, right: OrientedRows, log_scaling: float, log_looks: float
    ) -> float:
        """Return the p-value of a copy with corrected units: the number of looks divided by the odds, 1 at most.

        The priors of the block hold in the corrected unit. `log_scaling` is ln of the factor by which the
        correction enlarges a volume of signals, so that densities of the recorded signals are compared.
        """
        odds = self._log_evidence(right, right) + log_scaling - self._log_evidence(recorded, right)
        return max(math.exp(min(log_looks - odds, 0.0)), LEAST_P)

    def first_guess(self, table: OrientedRows) -> tuple[Block, float]:
        """Return the block fitted to the readings as recorded, and its chi-square distance from the data sheet."""
        scores = self.score(table, [nothing(table)])
        found = scores.coefficients[0]
        return Block(found[:3].T.copy(), found[3].copy()), float(scores.sheet[0])

    def score(self, table: OrientedRows, supposed: Sequence[Reinterpretation]) -> SuppositionScores:
        """Return the cost of each supposition (lower is better), with errors in units of `gross_g`."""
        scale = self._scale(table)
        signal = np.stack([s.signal(table) for s in supposed]) / (self.gross_g * scale)
        columns = self._columns(table, supposed)
        weight = np.stack([np.ones(len(table)) if s.source is None else s.source >= 0 for s in supposed])
        mean, precision = self._prior(scale)
        scores = _fit(columns, signal, weight.astype(np.float64), mean, precision, self.gross_g * scale)
        cost = scores.misfit - 2.0 * np.array([s.log_jacobian for s in supposed])
        # another unit brings the channels to their data sheet and the readings together, or it is none
        apart = (scores.sheet > LEAST_COST) | (scores.misfit > LEFT_OF_UNIT * scores.misfit[0])
        other_unit = np.array([s.factor is not None for s in supposed])
        return replace(scores, cost=np.where(other_unit & apart, np.inf, cost))

    def _scale(self, table: OrientedRows) -> Floats:
        """Size of a channel's signals for 1 g, (3,)."""
        if self.nominal is not None:
            return np.abs(self.nominal)
        spread = np.ptp(np.percentile(table.signal, [5, 95], axis=0), axis=0) / 2
        return np.asarray(np.maximum(spread, max(1e-3 * float(spread.max()), 1e-300)))

    def _columns(self, table: OrientedRows, supposed: Sequence[Reinterpretation]) -> Floats:
        """Specific forces and a one for the bias, (H, n, 4)."""
        angle = np.stack([table.angle_rad if s.angle_rad is None else s.angle_rad for s in supposed])
        on_platform = specific_force_on_platform(angle.ravel(), np.zeros((angle.size, len(STAND_ANGLES))))
        on_platform = on_platform.reshape(*angle.shape, 3)
        names = table.labels
        turns = np.stack([self.installations[name].block_from_platform for name in names])
        number = {name: i for i, name in enumerate(names)}
        stated = np.array([number[label] for label in table.label.tolist()])
        force = np.einsum("nij,hnj->hni", turns[stated], on_platform)
        for h, s in enumerate(supposed):
            if s.label is not None:
                at = [number[label] for label in s.label.tolist()]
                force[h] = np.einsum("nij,nj->ni", turns[at], on_platform[h])
            for label, turn in s.turns.items():
                rows = table.label == label
                force[h, rows] = force[h, rows] @ turn.T
        return np.concatenate([force, np.ones((*force.shape[:2], 1))], axis=2)

    def _prior(self, scale: Floats) -> tuple[Floats, Floats]:
        """Prior means and precisions of (K_ix, K_iy, K_iz, U0_i), (4, 3), in units of `gross_g`."""
        mean = np.zeros((4, 3))
        if self.nominal is None:
            return mean, np.full((4, 3), 1e-6 * self.gross_g**2)  # no more than keeps the fit solvable
        mean[:3] = np.diag(self.nominal) / (self.gross_g * scale)
        return mean, np.asarray((_sheet_u() / self.gross_g) ** -2)

    def _log_evidence(self, table: OrientedRows, recorded: OrientedRows) -> float:
        """Return ln of the probability density of the `recorded` signals for a table, errors integrated out."""
        unit = float(np.max(self._scale(recorded)))
        mean = np.zeros((4, 3))
        if self.nominal is None:
            u = np.vstack([np.ones((3, 3)), 1.0 + np.abs(np.median(recorded.signal, axis=0)) / unit])
        else:
            mean[:3], u = np.diag(self.nominal) / unit, _sheet_u()
        columns = self._columns(table, [nothing(table)])[0]
        left_out = len(recorded) - len(table)
        return log_evidence(table, columns, unit, CoefficientPrior(mean, u), self.gross_g, left_out)

    def _first_of_two(
        self, table: OrientedRows, supposed: Sequence[Reinterpretation], cost: Floats
    ) -> tuple[int, OrientedRows, int]:
        """Return the first of two mistakes that make the readings fit, or 0; both put right; and the looks."""
        looks = 0
        if cost[0] * self.gross_g**2 < LEAST_OF_TWO:
            return 0, table, looks
        leaving = any(s.source is not None for s in supposed)
        for h in np.argsort(cost).tolist():
            if h and supposed[h].factor is None and cost[h] < RAISED * cost[0]:
                corrected = put_right(table, supposed[h])
                second = [s for s in suppositions(corrected) if leaving or s.source is None]
                looks += len(second)
                scores = self.score(corrected, second)
                fitting = np.where(_fits(scores, len(table)), scores.cost, np.inf)
                if np.isfinite(fitting.min()):
                    return h, put_right(corrected, second[int(np.argmin(fitting))]), looks
        return 0, table, looks

    def _with_equals(
        self, table: OrientedRows, supposed: Sequence[Reinterpretation], cost: Floats, best: int, p: float
    ) -> GrossMistake:
        """Name the plainest of the equally good ones; see whether another mounting would do as well."""
        mountings = other_mountings(table)
        other = self.score(table, mountings).cost
        ranked = np.flatnonzero(cost - cost[best] < EQUAL)
        chosen = supposed[ranked[0]] if ranked[0] else supposed[best]
        equal = [supposed[h] for h in ranked.tolist() if h and supposed[h] is not chosen]
        equal += [m for m, c in zip(mountings, other, strict=True) if c - cost[best] < EQUAL]
        return GrossMistake(chosen, tuple(equal), p)


def put_right(table: OrientedRows, supposition: Reinterpretation) -> OrientedRows:
    """Return the oriented rows as they were if the supposition holds."""
    kept = np.ones(len(table), dtype=bool) if supposition.source is None else supposition.source >= 0
    label = table.label if supposition.label is None else supposition.label
    angle = table.angle_rad if supposition.angle_rad is None else supposition.angle_rad
    signal = supposition.signal(table)
    return replace(table, label=label, angle_rad=angle, signal=signal).select(kept)


def _best_of_each(supposed: Sequence[Reinterpretation], cost: Floats) -> Iterator[int]:
    """Yield the supposition of each name that lowers the cost most, where one does so by `LEAST_FALL`."""
    for name in dict.fromkeys(one.name for one in supposed[1:]):
        named = [h for h, one in enumerate(supposed) if one.name == name]
        best = min(named, key=lambda h: float(cost[h]))
        if cost[0] - cost[best] >= LEAST_FALL:
            yield best


def _sheet_u() -> Floats:
    """Prior 1 sigma of (K_ix, K_iy, K_iz, U0_i) about a data sheet, (4, 3), g/g and g."""
    return np.vstack([np.where(np.eye(3) == 1, SCALE_U, CROSS_AXIS_U), np.full(3, BIAS_U_G)])


def _fits(scores: SuppositionScores, n: int) -> NDArray[np.bool_]:
    """Return whether the `n` readings fit with each supposition, shape (H,)."""
    return np.asarray((scores.sheet <= LEAST_FALL) & (scores.misfit <= LEAST_FALL + FITS * 3 * n))


def _fit(
    columns: Floats, signal: Floats, weight: Floats, mean: Floats, precision: Floats, unit: Floats
) -> SuppositionScores:
    """Fit each supposition, leaving out readings that fit it least, one after another.

    `columns` (H, n, 4), `signal` (H, n, 3), `weight` (H, n), `mean` and `precision` (4, 3); `unit` (3,) is
    what the signals are given in. Where leaving out cannot make a supposition as good as another, none is.
    """
    cost, sheet, coefficients, gain = _weighted_fit(columns, signal, weight, mean, precision)
    within_reach = cost - 2 * np.sort(gain, axis=1)[:, -MOST_LEFT_OUT:].sum(axis=1) <= cost.min()
    at = np.flatnonzero(within_reach & (gain.max(axis=1) > STRANGE))
    weight, gain = weight[at].copy(), gain[at]
    for left_out in range(1, MOST_LEFT_OUT + 1):
        strange = gain.max(axis=1) > STRANGE
        at, weight, gain = at[strange], weight[strange], gain[strange]
        if not len(at):
            break
        weight[np.arange(len(at)), gain.argmax(axis=1)] = 0.0
        fitted = _weighted_fit(columns[at], signal[at], weight, mean, precision)
        cost[at], sheet[at], coefficients[at], gain = fitted[0] + left_out * LEFT_OUT, *fitted[1:]
    return SuppositionScores(cost, cost, sheet, coefficients * unit)


def _weighted_fit(
    columns: Floats, signal: Floats, weight: Floats, mean: Floats, precision: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return cost and the data sheet's part (H,), coefficients (H, 4, 3), and each reading's part (H, n).

    That part is what leaving the reading out would gain.
    """
    weighted = columns * weight[:, :, None]
    transposed = weighted.transpose(0, 2, 1)
    prior = np.einsum("ai,ab->iab", precision, np.eye(4))
    normal = (transposed @ columns)[:, None] + prior  # (H, 3, 4, 4)
    right = transposed @ signal + precision * mean
    inverse = np.linalg.inv(normal)
    coefficients = np.einsum("hiab,hbi->hai", inverse, right)
    left = signal - columns @ coefficients
    square = weight[:, :, None] * left**2
    sheet = np.sum(precision * (coefficients - mean) ** 2, axis=(1, 2))
    cost = square.sum(axis=(1, 2)) + sheet
    lever = np.sum((columns[:, None] @ inverse) * columns[:, None], axis=3).transpose(0, 2, 1)
    return cost, sheet, coefficients, np.sum(square / np.maximum(1 - lever, 1e-6), axis=2)
