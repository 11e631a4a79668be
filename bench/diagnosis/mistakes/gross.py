"""Gross mistakes of wiring and procedure: other meanings of the record, compared by their evidence."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints, Mask
from bench.diagnosis.levels import BY_CHANCE, CHUNK, HARDLY_EVER
from bench.diagnosis.mistakes.reinterpretation import (
    OrientedRows,
    Reinterpretation,
    losses_of,
    nothing,
    other_mountings,
    other_wirings,
    suppositions,
)
from bench.model.geometry import STAND_ANGLES, Block, Installation, specific_force_on_platform
from bench.readings.table import Readings

ERRORS_G: Final[tuple[float, ...]] = tuple(np.geomspace(5e-4, 0.1, 10).tolist())
"""Prior 1 sigma of the errors of a reading and of a position without a mistake, g; all sizes equally probable.

The smallest corresponds to 100 arcsec, or to a large effect of the block; a bench with wider limits has a larger
one. The largest corresponds to less than six degrees: otherwise a block that contradicts its data sheet would
count as tilted.
"""
SHEET_U: Final = (0.10, 0.05, 0.5)
"""Prior 1 sigma of the coefficients about a data sheet: scale factor, g/g; cross-axis term, g/g; bias, g."""


def sheet_u(scale: Floats) -> Floats:
    """Return the prior u (4, 3) of the coefficients about those of a data sheet, one column for each channel.

    A column has the channel's row of K, unit of the signal per g, then its bias, unit of the signal. `scale` (3,)
    are the scale factors of the data sheet.
    """
    own, cross, bias = SHEET_U
    return np.asarray(np.vstack([np.where(np.eye(3) == 1, own, cross), np.full(3, bias)]) * scale)


@dataclass(frozen=True, eq=False)
class GrossMistake:
    """The supposed mistake that explains the readings best; `equal` are others that explain them equally well.

    `p` is an upper limit of the p-value, the number of suppositions divided by the odds: chance gives odds of B
    with a probability of at most 1/B.
    """

    supposition: Reinterpretation
    equal: tuple[Reinterpretation, ...]
    p: float


@dataclass(frozen=True)
class GrossFit:
    """A block fitted to readings with the data sheet as prior, and how well it fits.

    `misfit` is the chi-square of the readings; `sheet` (3,) is that of each channel's coefficients about the data
    sheet.
    """

    block: Block
    misfit: float
    sheet: Floats


@dataclass(frozen=True)
class GrossSearch:
    """A search for gross mistakes in tables of readings of one bench.

    `nominal` (3,) are the signed scale factors of the data sheet, unit of the signal per g, None if unknown.
    `stand_rad` is the combined prior u of the stand angles and the setting error, rad. The search assumes
    errors of the specific force, g, no smaller than this angle or than `ERRORS_G[0]`.
    """

    installations: Mapping[str, Installation]
    nominal: Floats | None
    stand_rad: float = 0.0

    def find(self, readings: Readings) -> GrossMistake | None:
        """Return the most probable mistake; None unless its odds exceed the number of suppositions / `HARDLY_EVER`.

        It competes with the supposition that a reading, pass or mounting is useless. If the corrected copy is
        still far from the model, two mistakes may hide each other, and each mounting is left out in turn. A
        mistake found then replaces the first if, together with a second one, it explains the readings clearly
        better.
        """
        table = OrientedRows.of(readings)
        if not self._may_be_wrong(table, table.every, _enough(())):
            return None  # no number of suppositions makes one of them likely
        maps = suppositions(table, units=self.nominal is not None)
        found = self._likeliest(table, maps, table.every)
        if found is None or self._explains(found, readings, table, maps):
            return found
        # with other mistakes, half a turn in a mounting looks like a part of all signals reversed
        maps = [one for one in maps if not one.turns_half]
        if found.supposition.turns_half:
            found = self._likeliest(table, maps, table.every)
            if found is None or self._explains(found, readings, table, maps):
                return found
        others = [self._likeliest(table, maps, table.mount != k) for k in range(len(table.mounts))]
        after = {one: self._with_second(one, readings, table) for one in (found, *filter(None, others))}
        better = [one for one, score in after.items() if score - after[found] > _enough(maps)]
        return min(better, key=lambda one: (len(one.equal), -after[one]), default=found)

    def _explains(
        self, found: GrossMistake, readings: Readings, table: OrientedRows, maps: Sequence[Reinterpretation]
    ) -> bool:
        """Return whether no further mistake may be in the corrected copy."""
        corrected = OrientedRows.of(found.supposition.correct(readings, table))
        return not self._may_be_wrong(corrected, corrected.every, _enough(maps))

    def find_at_verification(self, readings: Readings) -> GrossMistake | None:
        """Return the wiring mistake at verification points whose correction best gives |a| = 1 g.

        The orientation of the points is not used. The coefficients are those of the oriented readings, with the
        signs of the data sheet. The result is None if no mistake is found, or if there is no data sheet.
        """
        points, table = OrientedRows.of(readings, verification=True), OrientedRows.of(readings)
        if len(points) < 2 or self.nominal is None:  # a single point may be wrong by itself
            return None
        block, maps = self.fit(table, table.every).block, other_wirings(points)
        errors_g = np.maximum(ERRORS_G, self._smallest_g)
        scores = np.array([_of_moduli(_off_g(block, one.signal(points)), errors_g) for one in maps])
        odds = scores - _of_moduli(_off_g(block, points.signal), errors_g)
        best = int(np.argmax(odds))
        if odds[best] <= _enough(maps):
            return None
        near = np.flatnonzero(odds > odds[best] + math.log(BY_CHANCE))
        equal = tuple(maps[i] for i in near if i != best)
        return GrossMistake(maps[best], equal, p_of(float(odds[best]), math.log(len(maps))))

    def _with_second(self, first: GrossMistake, readings: Readings, table: OrientedRows) -> float:
        copy = OrientedRows.of(first.supposition.correct(readings, table))
        scores = self._log_evidence(copy, [nothing(copy), *suppositions(copy)], table, copy.every)
        return float(np.max(scores)) + first.supposition.log_jacobian

    def _likeliest(
        self, table: OrientedRows, maps: Sequence[Reinterpretation], kept: Mask
    ) -> GrossMistake | None:
        """Return the likeliest of the mistakes `maps` in the `kept` rows (n,); None if none is likely.

        Rows that are more probably useless are left out, and the mistakes in the other rows are compared
        again.
        """
        losses = [one for one in losses_of(table) if (kept & ~one.scope.mask).any()]
        maps = [one for one in maps if not one.scope.mask[~kept].any()]
        while maps and self._may_be_wrong(table, kept, _enough(maps)):
            scores = self._log_evidence(table, [nothing(table), *maps, *losses], table, kept)
            odds = scores[1:] - scores[0]
            best = self._best(table, [*maps, *losses], odds)
            if odds[best] <= _enough(maps):
                return None
            if best < len(maps):
                near = -math.log(BY_CHANCE)
                chosen, *equal = (m for m, of in zip(maps, odds, strict=False) if of > odds[best] - near)
                mountings = other_mountings(table)
                alike = self._log_evidence(table, mountings, table, kept) - scores[0] > odds[best] - near
                equal += [m for m, like in zip(mountings, alike, strict=True) if like]
                return GrossMistake(chosen, tuple(equal), p_of(float(odds[best]), math.log(len(maps))))
            lost = losses[best - len(maps)].scope.mask
            kept = kept & ~lost
            if np.count_nonzero(lost) > 1:
                maps = [one for one in maps if not one.scope.mask[lost].any()]
        return None

    def _best(self, table: OrientedRows, supposed: Sequence[Reinterpretation], odds: Floats) -> int:
        """Return the index of the largest of the `odds` (ln), except units that contradict the data sheet."""
        while True:
            best = int(np.argmax(odds))
            if not supposed[best].scales or not np.isfinite(odds[best]):
                return best
            moved = replace(table, signal=supposed[best].signal(table))
            sheet = self.fit(moved, table.every).sheet
            if np.all(sheet[supposed[best].factor != 1.0] < 2.0 * _enough(supposed)):
                return best
            odds[best] = -np.inf

    def p_of_copy(self, recorded: Readings, right: Readings, log_scaling: float, log_looks: float) -> float:
        """Return an upper limit of the p-value of a copy with corrected units, `right`, against `recorded`.

        It is the number of suppositions (ln: `log_looks`) divided by the odds of the copy. `log_scaling` is ln of
        the Jacobian determinant of the correction of all signals. It converts a density of corrected signals to one
        of recorded signals.
        """
        copy, record = OrientedRows.of(right), OrientedRows.of(recorded)
        odds = [self._log_evidence(table, [nothing(table)], copy, table.every)[0] for table in (copy, record)]
        return p_of(odds[0] - odds[1] + log_scaling, log_looks)

    def fit(self, table: OrientedRows, rows: Mask) -> GrossFit:
        """Return the block fitted to the recorded signals in `rows`, with the data sheet as prior.

        The standard deviation of the errors is the least that the bench permits.
        """
        mean, u = self._prior(table)
        columns, signal = self._columns(table, nothing(table))[rows], table.signal[rows]
        unit = self._smallest_g * self._scale(table)
        found = np.empty((4, 3))
        for i in range(3):
            white = np.vstack([columns / unit[i], np.diag(1.0 / u[:, i])])
            right = np.concatenate([signal[:, i] / unit[i], mean[:, i] / u[:, i]])
            found[:, i] = np.linalg.lstsq(white, right, rcond=None)[0]
        misfit = np.sum(((signal - columns @ found) / unit) ** 2)
        block = Block(found[:3].T.copy(), found[3].copy())
        return GrossFit(block, float(misfit), np.sum(((found - mean) / u) ** 2, axis=0))

    def _may_be_wrong(self, table: OrientedRows, kept: Mask, enough: float) -> bool:
        """Return whether ln of the odds of a mistake that explains all `kept` rows could exceed `enough`."""
        fit = self.fit(table, kept)
        return bool(fit.misfit + np.sum(fit.sheet) > 2.0 * enough)

    @property
    def _smallest_g(self) -> float:
        return max(ERRORS_G[0], self.stand_rad)

    def _scale(self, table: OrientedRows) -> Floats:
        """The absolute signal (3,) of each channel for 1 g, from the data sheet or from the signals."""
        if self.nominal is not None:
            return np.abs(self.nominal)
        spread = np.ptp(np.percentile(table.signal, [5, 95], axis=0), axis=0) / 2
        return np.asarray(np.maximum(spread, max(1e-3 * float(spread.max()), 1e-300)))

    def _prior(self, table: OrientedRows) -> tuple[Floats, Floats]:
        """The prior means (4, 3) and sigmas (4, 3) of K_ix, K_iy, K_iz, U0_i of channel i, unit of the signal."""
        mean = np.zeros((4, 3))
        if self.nominal is not None:
            mean[:3] = np.diag(self.nominal)
            return mean, sheet_u(np.abs(self.nominal))
        scale = float(np.max(self._scale(table)))
        return mean, scale * np.vstack(
            [np.ones((3, 3)), 1.0 + np.abs(np.median(table.signal, axis=0)) / scale]
        )

    def _columns(self, table: OrientedRows, supposed: Reinterpretation) -> Floats:
        """The specific force of each reading, and 1 for the bias, (n, 4)."""
        angle = table.angle_rad if supposed.angle_rad is None else supposed.angle_rad
        label = table.label if supposed.label is None else supposed.label
        force = specific_force_on_platform(angle, np.zeros((len(angle), len(STAND_ANGLES))))
        for name in np.unique(label):
            turn = supposed.turns.get(str(name), np.eye(3)) @ self.installations[name].block_from_platform
            force[label == name] = force[label == name] @ turn.T
        return np.column_stack([force, np.ones(len(force))])

    def _log_evidence(
        self, table: OrientedRows, supposed: Sequence[Reinterpretation], like: OrientedRows, kept: Mask
    ) -> Floats:
        """Return ln of the density (H,) of the `kept` signals under each supposition, unknowns integrated.

        Priors are those for the table `like`. A reading without signals has a density of 1 per g.
        """
        unit = float(np.max(self._scale(like)))
        mean, u = (of / unit for of in self._prior(like))
        errors_g = np.maximum(ERRORS_G, self._smallest_g)
        as_recorded, products = nothing(table), []
        plain, there = self._columns(table, as_recorded), _positions(table, as_recorded, kept)
        for one in supposed:
            columns = self._columns(table, one) if one.turns or one.moves else plain
            positions = _positions(table, one, kept) if one.moves or one.source is not None else there
            products.append(_products(np.hstack([columns, one.signal(table) / unit]), *positions))
        jacobians = np.array([one.log_jacobian for one in supposed])
        parts = (products[i : i + CHUNK] for i in range(0, len(products), CHUNK))
        evidence = [_integrated(part, mean, u, errors_g) for part in parts]
        return np.asarray(np.concatenate([*evidence, np.empty(0)]) + jacobians)


def _off_g(block: Block, signal: Floats) -> Floats:
    return np.asarray(np.linalg.norm(block.specific_force(signal), axis=1) - 1.0)


def _of_moduli(off_g: Floats, errors_g: Floats) -> float:
    """Return ln of the evidence of moduli that are `off_g` (n,), summed over prior sigmas `errors_g` (k,)."""
    of_size = -0.5 * np.sum((off_g / errors_g[:, None]) ** 2, axis=1) - len(off_g) * np.log(errors_g)
    return float(np.logaddexp.reduce(of_size))


def _enough(maps: Sequence[Reinterpretation]) -> float:
    return math.log(max(len(maps), 1) / HARDLY_EVER)


def p_of(log_odds: float, log_looks: float) -> float:
    """Return the number of suppositions over the odds, exp(`log_looks` - `log_odds`): at most 1, never 0."""
    return max(math.exp(min(log_looks - log_odds, 0.0)), sys.float_info.min)


Products = dict[int, tuple[int, Floats]]
"""Numbers of rows and their X^T X (7, 7), by the number m of repeats.

The rows for m repeats have the variance reading^2 + m position^2.
"""


def _positions(table: OrientedRows, supposed: Reinterpretation, kept: Mask) -> tuple[Mask, Ints]:
    """Return the mask (n,) of `kept` rows with signals, and the number of the position of each, to 1 degree."""
    label = table.label if supposed.label is None else supposed.label
    angle = table.angle_rad if supposed.angle_rad is None else supposed.angle_rad
    number = np.unique(label, return_inverse=True)[1].ravel()
    key = (table.mount * 1000 + number) * 1000 + np.round(np.degrees(angle)).astype(np.int64)
    kept = kept if supposed.source is None else kept & (supposed.source >= 0)
    return kept, np.unique(key[kept], return_inverse=True)[1].ravel()


def _products(columns: Floats, kept: Mask, position: Ints) -> Products:
    """Return the products of the `kept` rows of `columns` (n, 7), by the number m of repeats.

    Key m has those of the means over m repeats of a `position`, key 0 those of deviations from means.
    """
    columns, repeats = columns[kept], np.bincount(position)
    mean = np.zeros((len(repeats), columns.shape[1]))
    np.add.at(mean, position, columns)
    mean /= np.sqrt(repeats)[:, None]
    found = {0: (len(columns) - len(repeats), columns.T @ columns - mean.T @ mean)}
    for m in sorted(set(repeats.tolist())):
        of = mean[repeats == m]
        found[m] = (len(of), of.T @ of)
    return found


def _integrated(supposed: Sequence[Products], mean: Floats, u: Floats, errors_g: Floats) -> Floats:
    """Return ln of the evidence (H,) of H suppositions, averaged over the errors of readings and positions.

    Each channel has its own errors, or others would favour a wrong factor on a channel that hardly moves.
    """
    of_reading, of_position = (
        np.repeat(errors_g**2, len(errors_g) + 1),
        np.tile([0.0, *errors_g**2], len(errors_g)),
    )
    repeats, none = sorted(set().union(*supposed)), (0, np.zeros((7, 7)))
    count = np.array([[products.get(m, none)[0] for m in repeats] for products in supposed])
    gram = np.array([[products.get(m, none)[1] for m in repeats] for products in supposed])
    variance = of_reading + np.outer(repeats, of_position)
    around = np.zeros((3, 1, 1, 7, 5))
    around[..., :4, :4], around[:, 0, 0, :4, 4], around[:, 0, 0, 4:, 4] = np.eye(4), -mean.T, np.eye(3)
    centred = np.swapaxes(around, 3, 4) @ gram @ around
    # (5, 5, 3, H, sizes): many small matrices are eliminated much faster side by side than by LAPACK one by one
    whole = np.ascontiguousarray(np.moveaxis(centred, (3, 4), (0, 1))) @ (1.0 / variance)
    whole[range(4), range(4)] += u[:, :, None, None] ** -2
    # keeps the last pivot positive in spite of rounding, or if there are no readings
    whole[4, 4] += 1e-9 * (1.0 + whole[4, 4])
    for k in range(4):
        whole[k + 1 :, k + 1 :] -= whole[k + 1 :, k, None] * (whole[k, k + 1 :] / whole[k, k])
    pivots = whole[range(5), range(5)]
    cost = 0.5 * (np.log(pivots[:4] * u[:, :, None, None] ** 2).sum(axis=0) + pivots[4])
    of_channel = -0.5 * (count @ np.log(variance)) - cost
    of_each = np.logaddexp.reduce(of_channel, axis=2) - np.log(of_channel.shape[2])
    return np.asarray(of_each.sum(axis=0))
