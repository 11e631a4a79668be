"""The linear system in units of its noise, over a grid of noise ratios; products of its columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Protocol

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bench.base.arrays import Floats, Ints, Mask
from bench.diagnosis.linear import LinearSystem


def coupled(matrix: Floats) -> Iterator[tuple[Ints, Ints]]:
    """Yield rows and columns, both ascending, between which and all others a matrix (N, k) is zero.

    Every column is in one of the parts; rows of zeros are in none.
    """
    many, count = matrix.shape
    row, column = np.nonzero(matrix)
    edges = coo_array((np.ones(len(row)), (row, many + column)), shape=(many + count, many + count))
    label = connected_components(edges, directed=False)[1]
    for part in dict.fromkeys(label[many:].tolist()):
        yield np.flatnonzero(label[:many] == part), np.flatnonzero(label[many:] == part)


RATIOS: Final = (0.0, 0.7, 1.4, 2.6, 5.0, 12.0)
"""Grid of gamma: what a setting error of the typical slope adds, in units of a reading's noise."""

RATIO_SPREAD: Final = 1.0
"""Standard deviation of ln gamma about what the bench file states: known to a factor of three, no better."""

LOCAL: Final = 0.5
"""What reaches no more than this part of the rows has them in one block; beyond, it is fitted with its prior."""

ROUNDING: Final = 1e-12
"""A prior leaves more than that of what is fitted, a coefficient nothing."""


@dataclass(frozen=True)
class Span:
    """What is fitted in some of the rows: an orthonormal `basis` (n, k), and what of it a prior leaves in.

    `kept` (k,) is zero for the coefficients, which have none.
    """

    rows: slice | Ints
    basis: Floats
    kept: Floats

    def leave(self, white: Floats, taken: Floats) -> None:
        """Take the part `taken` (k,) of what is fitted out of columns (N, …), in place."""
        inside: Floats = self.basis.T @ white[self.rows]
        white[self.rows] -= self.basis @ (inside.T * taken).T


@dataclass(frozen=True)
class Whitener:
    """A linear map of rows (N,) to numbers of variance sigma^2, those that the coefficients take away left out.

    `blocks` are numbers of rows with the inverse Cholesky factor of their covariance; `fitted` is what is fitted,
    each orthogonal to all others: of several blocks each has coefficients of its own in rows of its own.
    """

    blocks: tuple[tuple[Ints, Floats], ...]
    fitted: tuple[Span, ...] = ()

    def __matmul__(self, columns: Floats) -> Floats:
        """Return columns (N, …) in units of the noise: their scalar products are those that count."""
        white = self._half(columns)
        for span in self.fitted:
            span.leave(white, 1.0 - span.kept)
        return white

    def weigh(self, columns: Floats) -> Floats:
        """Return the inverse covariance times columns (N, …), what the coefficients take away left out."""
        white = self._half(columns)
        for span in self.fitted:
            span.leave(white, 1.0 - span.kept**2)
        weighed = np.empty_like(white)
        for rows, factor in self.blocks:
            weighed[rows] = factor.T @ white[rows]
        return weighed

    @property
    def diagonal(self) -> Floats:
        """Of the map that `weigh` is, shape (N,)."""
        many = sum(len(rows) for rows, _ in self.blocks)
        diagonal = np.empty(many)
        for rows, factor in self.blocks:
            diagonal[rows] = np.sum(factor**2, axis=0)
        for span in self.fitted:
            basis = np.zeros((many, len(span.kept)))
            basis[span.rows] = span.basis
            for rows, factor in self.blocks:
                diagonal[rows] -= (factor.T @ basis[rows]) ** 2 @ (1.0 - span.kept**2)
        return diagonal

    def _half(self, columns: Floats) -> Floats:
        white = np.empty_like(columns, dtype=np.float64)
        for rows, factor in self.blocks:
            white[rows] = factor @ columns[rows]
        return white


@dataclass(frozen=True)
class NoiseGrid:
    """For each ratio a linear map to white noise with the coefficients projected out.

    `white` (ratios) map rows to numbers of variance sigma^2 when nothing is missing, of which `freedom` are
    independent; `log_det` (ratios,) completes the restricted likelihood; `log_prior` (ratios,).
    `setting_rad_per_noise` (ratios,) is the setting error in rad for a reading noise of one. Where `sigma` is
    `known` it is believed; else the data say how large the noise is.
    """

    white: tuple[Whitener, ...]
    log_det: Floats
    log_prior: Floats
    setting_rad_per_noise: Floats
    sigma: float
    freedom: int
    known: bool = False

    def at(self, ratio: int) -> NoiseGrid:
        """Return the grid with one ratio alone."""
        one = slice(ratio, ratio + 1)
        return replace(
            self,
            white=self.white[one],
            log_det=self.log_det[one],
            log_prior=self.log_prior[one],
            setting_rad_per_noise=self.setting_rad_per_noise[one],
        )

    def log_likelihood(self, square: Floats) -> Floats:
        """Return ln of the likelihood of residuals with this sum of squares, in units of `sigma` squared."""
        if self.known:
            return -0.5 * square
        return np.asarray(-0.5 * self.freedom * np.log(square), dtype=np.float64)


def make_noise_grid(
    linear: LinearSystem, sigma: float, setting_rad: float, ratios: Sequence[float] = RATIOS
) -> NoiseGrid:
    """Set up the maps. `sigma` is a first estimate of the reading noise, which only scales the stand's limits.

    `setting_rad` is the setting error that the bench file states (0: not known). With fewer `ratios` than
    the whole grid the search is quicker: where the noise is known well enough.
    """
    oriented = linear.setting >= 0
    scaled2 = (linear.slope / linear.relative)[oriented] ** 2
    slope2 = np.bincount(linear.setting[oriented], scaled2, linear.settings).astype(np.float64)
    typical = float(np.sqrt(np.mean(slope2)))
    known = np.log(max(setting_rad * typical / sigma, 1e-2)) if setting_rad > 0 else None
    wide = _wide(linear)
    blocks = _blocks(linear, wide)
    whites, log_dets = zip(
        *(_white(linear, ratio / typical, sigma, wide, blocks) for ratio in ratios), strict=True
    )
    grid = np.array(ratios)
    if known is None:
        log_prior = np.full(len(grid), -np.log(len(grid)))
    else:
        distance = (np.log(np.maximum(grid, 0.25)) - known) / RATIO_SPREAD
        log_prior = -0.5 * np.minimum(distance**2, 25.0)
        log_prior = log_prior - np.logaddexp.reduce(log_prior)
    # sizes of runs beside each other come from the same readings
    freedom = (
        len(linear) - linear.fixed.shape[1] - (0 if linear.by_run is None else len(linear.by_run.sizes) - 1)
    )
    return NoiseGrid(tuple(whites), np.array(log_dets), log_prior, grid / typical, sigma, freedom)


def make_whitener(linear: LinearSystem, sigma: float, setting_rad: float) -> Whitener:
    """Return the map for noise of a reading (unit of the signal) and a setting error (rad) of these very sizes."""
    wide = _wide(linear)
    return _white(linear, setting_rad / sigma, sigma, wide, _blocks(linear, wide))[0]


def _wide(linear: LinearSystem) -> Mask:
    """Return which of the random columns reach further than a block may."""
    return np.asarray(np.count_nonzero(linear.random, axis=0) > LOCAL * len(linear))


def _blocks(linear: LinearSystem, wide: Mask) -> tuple[Ints, ...]:
    """Return the rows that a setting or anything that is not `wide` joins, each block in ascending order."""
    row, column = np.nonzero(linear.random[:, ~wide])
    oriented = np.flatnonzero(linear.setting >= 0)
    ends = np.concatenate([column, np.count_nonzero(~wide) + linear.setting[oriented]])
    row = np.concatenate([row, oriented])
    size = len(linear) + np.count_nonzero(~wide) + linear.settings
    edges = coo_array((np.ones(len(row)), (row, len(linear) + ends)), shape=(size, size))
    _, label = connected_components(edges, directed=False)
    mine = label[: len(linear)]
    order = np.argsort(mine, kind="stable")
    starts = np.flatnonzero(np.diff(mine[order], prepend=-1))
    return tuple(np.split(order, starts[1:]))


def _white(
    linear: LinearSystem, setting: float, sigma: float, wide: Mask, blocks: tuple[Ints, ...]
) -> tuple[Whitener, float]:
    factors = []
    log_det = 0.0
    for rows in blocks:
        joined = linear.random[rows][:, ~wide] / sigma
        joined = joined[:, np.any(joined, axis=0)]
        own = linear.setting[rows]
        slope = setting * linear.slope[rows]
        covariance = np.diag(linear.relative[rows] ** 2) + joined @ joined.T
        covariance += np.where(own[:, None] == own, np.outer(slope, slope), 0.0)
        cholesky = np.linalg.cholesky(covariance)
        log_det -= float(np.sum(np.log(np.diag(cholesky))))
        factors.append((rows, np.linalg.inv(cholesky)))
    spans, more = _fitted(Whitener(tuple(factors)), linear.fixed, linear.random[:, wide] / sigma)
    return Whitener(tuple(factors), spans), log_det + more


def _fitted(half: Whitener, fixed: Floats, wide: Floats) -> tuple[tuple[Span, ...], float]:
    """Return what coefficients take up, and beside them the `wide` columns with their prior; ln of determinants."""
    white = half @ fixed
    spans = []
    log_det = 0.0
    for rows, columns in coupled(white):
        if not len(rows):
            continue  # a coefficient of which no row tells
        q, r = np.linalg.qr(white[np.ix_(rows, columns)])
        log_det -= float(np.sum(np.log(np.abs(np.diag(r)))))
        spans.append(Span(_as_slice(rows), q, np.zeros(q.shape[1])))
    if not wide.shape[1]:
        return tuple(spans), log_det
    beside = Whitener(half.blocks, tuple(spans)) @ wide
    q, r = np.linalg.qr(np.concatenate([beside, np.eye(wide.shape[1])]))
    log_det -= float(np.sum(np.log(np.abs(np.diag(r)))))
    basis, size, _ = np.linalg.svd(q[: len(wide)], full_matrices=False)
    left = 1.0 - size**2
    kept = np.sqrt(np.where(left > ROUNDING, left, 0.0))
    return (*spans, Span(slice(None), basis, kept)), log_det


def _as_slice(rows: Ints) -> slice | Ints:
    """Return rows that follow one another as a slice, which copies nothing."""
    first, last = int(rows[0]), int(rows[-1])
    return slice(first, last + 1) if last - first == len(rows) - 1 else rows


class Products(Protocol):
    """Scalar products of P columns, for each ratio of the noise sizes."""

    def across(self, columns: Ints) -> Floats:
        """Return those of some columns (k,) with all, shape (ratios, k, P)."""

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the same for one ratio, shape (k, P)."""

    def among(self, columns: Ints) -> Floats:
        """Return those of columns (…, p) with each other, shape (ratios, …, p, p)."""

    def at(self, ratio: int) -> Products:
        """Return those of one ratio alone."""


@dataclass(frozen=True)
class OfColumns:
    """From the columns `white` (ratios, N, P), which are fewer numbers where there are fewer rows than columns."""

    white: Floats

    def across(self, columns: Ints) -> Floats:
        """Return those of some columns (k,) with all, shape (ratios, k, P)."""
        return np.swapaxes(self.white[:, :, columns], 1, 2) @ self.white

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the same for one ratio, shape (k, P)."""
        return np.asarray(self.white[ratio][:, columns].T @ self.white[ratio])

    def among(self, columns: Ints) -> Floats:
        """Return those of columns (…, p) with each other, shape (ratios, …, p, p)."""
        if columns.shape[-1] == 1:
            return np.asarray(self._square[:, columns[..., 0], None, None])
        chosen = np.moveaxis(self.white[:, :, columns], 1, -2)
        return np.asarray(np.swapaxes(chosen, -1, -2) @ chosen)

    @cached_property
    def _square(self) -> Floats:
        return np.asarray(np.einsum("gnp,gnp->gp", self.white, self.white))

    def at(self, ratio: int) -> OfColumns:
        """Return those of one ratio alone."""
        return OfColumns(self.white[ratio : ratio + 1])


@dataclass(frozen=True)
class OfGram:
    """From the Gram matrix (ratios, P, P), which is fewer numbers where there are more rows than columns."""

    gram: Floats

    def across(self, columns: Ints) -> Floats:
        """Return those of some columns (k,) with all, shape (ratios, k, P)."""
        return np.asarray(self.gram[:, columns])

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the same for one ratio, shape (k, P)."""
        return np.asarray(self.gram[ratio][columns])

    def among(self, columns: Ints) -> Floats:
        """Return those of columns (…, p) with each other, shape (ratios, …, p, p)."""
        return np.asarray(self.gram[:, columns[..., :, None], columns[..., None, :]])

    def at(self, ratio: int) -> OfGram:
        """Return those of one ratio alone."""
        return OfGram(self.gram[ratio : ratio + 1])
