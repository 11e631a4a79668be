"""Whitening of the linear system over a grid of noise ratios, and the noise estimated from repeats alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import null_space
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bench.base.arrays import Floats, Ints, Mask
from bench.calibration.design import FIXED
from bench.calibration.noise import rounding_variance
from bench.diagnosis.levels import FEW, LEAST_FREEDOM, MARK_DEG, NEGLIGIBLE
from bench.diagnosis.linear import MODULUS, LinearSystem
from bench.readings.table import Readings


def coupled(matrix: Floats) -> Iterator[tuple[Ints, Ints]]:
    """Yield rows and columns, ascending, of each connected component of a matrix (N, k).

    Every column is in one component; a row of zeros is in none.
    """
    many, count = matrix.shape
    row, column = np.nonzero(matrix)
    edges = coo_array((np.ones(len(row)), (row, many + column)), shape=(many + count, many + count))
    label = connected_components(edges, directed=False)[1]
    for part in dict.fromkeys(label[many:].tolist()):
        yield np.flatnonzero(label[:many] == part), np.flatnonzero(label[many:] == part)


RATIOS: Final = (0.0, 0.7, 1.4, 2.6, 5.0, 12.0)
"""Grid of the noise ratio: a setting error's signal at the typical slope over the noise of a reading."""

RATIO_SPREAD: Final = 1.0
"""Prior standard deviation of ln gamma about the bench file's value, which is known to a factor of three."""


@dataclass(frozen=True)
class Span:
    """A subspace that a fit absorbs, in n of the rows: `rows` are their indices (n,).

    `basis` (n, k) has orthonormal directions. `kept` (k,) is the fraction of each direction that a prior leaves in
    the residuals; it is 0 for coefficients, which have no prior.
    """

    rows: slice | Ints
    basis: Floats
    kept: Floats

    def leave(self, white: Floats, taken: Floats) -> None:
        """Reduce the part of `white` (N, …) in the subspace, in place.

        Along each of the k directions, the fraction `taken` (k,) of that part is subtracted.
        """
        inside: Floats = self.basis.T @ white[self.rows]
        white[self.rows] -= self.basis @ (inside.T * taken).T


@dataclass(frozen=True)
class Whitener:
    """A linear map (`@`) of N rows to numbers with independent noise of equal variance.

    Rows with correlated noise form sets. `blocks` has an entry for each number n of rows in a set: the indices
    (b*n,) of the rows of all b such sets, and matrices (b, n, n). These make the noise of the rows independent for
    any setting error. The factors `root` (N,) then make the variances equal. `fitted` are orthogonal subspaces that
    are removed: of the coefficients of each accelerometer block, and of other unknowns.
    """

    blocks: tuple[tuple[slice | Ints, Floats], ...]
    root: Floats
    fitted: tuple[Span, ...] = ()

    def __matmul__(self, columns: Floats) -> Floats:
        """Return the whitened columns (N, …). Their scalar products enter the likelihood."""
        white = self._half(columns)
        for span in self.fitted:
            span.leave(white, 1.0 - span.kept)
        return white

    def weigh(self, columns: Floats) -> Floats:
        """Return the inverse covariance times `columns` (N, …), with the fitted directions removed."""
        white = self._half(columns)
        for span in self.fitted:
            span.leave(white, 1.0 - span.kept**2)
        white = (white.T * self.root).T
        weighed = np.empty_like(white)
        for rows, turn in self.blocks:
            weighed[rows] = _times(np.swapaxes(turn, 1, 2), white[rows])
        return weighed

    @property
    def diagonal(self) -> Floats:
        """The diagonal of the matrix (N, N) by which `weigh` multiplies, shape (N,)."""
        diagonal = np.empty(len(self.root))
        for rows, turn in self.blocks:
            scaled = turn * self.root[rows].reshape(*turn.shape[:2], 1)
            diagonal[rows] = np.sum(scaled**2, axis=1).ravel()
        for span in self.fitted:
            basis = np.zeros((len(self.root), len(span.kept)))
            basis[span.rows] = span.basis
            basis *= self.root[:, None]
            for rows, turn in self.blocks:
                inside = _times(np.swapaxes(turn, 1, 2), basis[rows])
                diagonal[rows] -= inside**2 @ (1.0 - span.kept**2)
        return diagonal

    def apart(self, columns: Floats) -> Floats:
        """Return the columns (N, …) as rows with independent noise, whose variances are 1 / `root`**2."""
        turned = np.empty_like(columns, dtype=np.float64)
        for rows, turn in self.blocks:
            turned[rows] = _times(turn, columns[rows])
        return turned

    def _half(self, columns: Floats) -> Floats:
        return np.asarray((self.apart(columns).T * self.root).T)


def _times(matrices: Floats, columns: Floats) -> Floats:
    """Multiply matrix i of the `matrices` (b, n, n) by the rows i n to i n + n - 1 of the `columns` (b n, …)."""
    return (matrices @ columns.reshape(*matrices.shape[:2], -1)).reshape(columns.shape)


@dataclass(frozen=True)
class NoiseGrid:
    """A grid of noise ratios; for each ratio, a map whitens the rows and projects out the coefficients.

    Each map in `white` takes rows divided by `sigma`, a first estimate of the noise. `freedom` is N minus the
    number of coefficients. `log_det` (ratios,) is the part of ln of the restricted likelihood that does not depend
    on the data; `log_prior` (ratios,) is ln of the prior probabilities. `setting_rad_per_noise` (ratios,) is the
    setting error divided by the noise of a reading, rad per unit of the signal. If `known`, the noise is `sigma`;
    otherwise its standard deviation is unknown.
    """

    white: tuple[Whitener, ...]
    log_det: Floats
    log_prior: Floats
    setting_rad_per_noise: Floats
    sigma: float
    freedom: int
    known: bool = False

    def log_likelihood(self, square: Floats, out: Floats | None = None) -> Floats:
        """Return ln of the likelihood, up to a constant, from the sums of squares of whitened residuals, `square`.

        The sums are in units of `sigma` squared. Unless the noise is known, its variance is integrated out.
        `out` is an array for the result.
        """
        if self.known:
            return np.multiply(square, -0.5, out=out)
        logarithm: Floats = np.log(square, out=out)
        return np.multiply(logarithm, -0.5 * self.freedom, out=logarithm)

    def products(self, columns: Floats) -> ColumnProducts:
        """Return the scalar products of columns (N, P), in the unit of the signal, whitened at each ratio."""
        first = self.white[0]
        rows = first.apart(columns)
        # no ratio sees what the coefficients absorb: without it, differences of products lose no digits
        for span in first.fitted:
            if not span.kept.any():
                root = first.root[span.rows][:, None]
                rows[span.rows] -= (span.basis / root) @ ((span.basis * root).T @ rows[span.rows])
        whole, taken = np.divide(rows.T, self.sigma, order="C"), []
        for spans in zip(*(white.fitted for white in self.white), strict=True):
            own = spans[0].rows
            along = [
                span.basis.T * np.sqrt(1.0 - span.kept**2)[:, None] * white.root[own]
                for span, white in zip(spans, self.white, strict=True)
            ]
            taken.append((whole[:, own] @ np.concatenate(along).T).reshape(len(whole), len(along), -1))
        weight = np.stack([white.root**2 for white in self.white])
        return ColumnProducts(whole, weight, np.concatenate(taken, axis=2))


def make_noise_grid(
    linear: LinearSystem, sigma: float, setting_rad: float, ratios: Sequence[float] = RATIOS
) -> NoiseGrid:
    """Return the whitening maps of a linear system for a grid of noise ratios.

    `sigma` is a first estimate of the noise of a reading, unit of the signal; the prior u of the unknowns are
    divided by it. The prior of the ratios follows from `setting_rad`, the setting error of the bench file (0:
    unknown). Fewer `ratios` save time.
    """
    oriented = linear.setting >= 0
    scaled2 = (linear.slope / linear.relative)[oriented] ** 2
    slope2 = np.bincount(linear.setting[oriented], scaled2, linear.settings).astype(np.float64)
    if not len(slope2):
        slope2, ratios = np.ones(1), ratios[:1]  # without settings there is no setting error
    typical = float(np.sqrt(np.mean(slope2)))
    known = np.log(max(setting_rad * typical / sigma, 1e-2)) if setting_rad > 0 else None
    whites, log_dets = zip(*_whites(linear, [ratio / typical for ratio in ratios], sigma), strict=True)
    grid = np.array(ratios)
    if known is None:
        log_prior = np.full(len(grid), -np.log(len(grid)))
    else:
        distance = (np.log(np.maximum(grid, 0.25)) - known) / RATIO_SPREAD
        log_prior = -0.5 * np.minimum(distance**2, 25.0)
        log_prior = log_prior - np.logaddexp.reduce(log_prior)
    freedom = len(linear) - linear.fixed.shape[1]
    return NoiseGrid(tuple(whites), np.array(log_dets), log_prior, grid / typical, sigma, freedom)


def make_whitener(linear: LinearSystem, sigma: float, setting_rad: float) -> Whitener:
    """Return the whitening map for a known noise of a reading, `sigma`, and a known `setting_rad`."""
    return next(_whites(linear, [setting_rad / sigma], sigma))[0]


def _wide(linear: LinearSystem) -> Mask:
    """Return the mask (q,) of `random` columns that act in more rows than a run has, or than `FEW` of all.

    They are fitted: as a covariance, each would join all its rows in a dense block. Both ways give the same result.
    In a single run, few columns are all fitted.
    """
    runs = len(np.unique(linear.readings.run))
    few = runs == 1 and linear.random.shape[1] <= FEW * len(linear)
    most = -1.0 if few else min(FEW, 1.0 / runs) * len(linear)
    return np.asarray(np.count_nonzero(linear.random, axis=0) > most)


def _whites(
    linear: LinearSystem, settings: Sequence[float], sigma: float
) -> Iterator[tuple[Whitener, float]]:
    """Yield the map for each setting error, rad per unit of noise, with its part of `NoiseGrid.log_det`."""
    wide = _wide(linear)
    known = settings[0] if len(settings) == 1 else None
    blocks, variance, log_det = _blocks(linear, linear.random[:, ~wide] / sigma, known)
    half = Whitener(blocks, np.ones(len(linear)))
    fixed, shared = half.apart(linear.fixed), half.apart(linear.random[:, wide] / sigma)
    # a setting error couples the rows of all channels, and so all coefficients of a block
    used = [np.flatnonzero(np.any(fixed, axis=axis)) for axis in (1, 0)]
    parts = list(coupled(fixed)) if fixed.shape[1] > FIXED else [used]
    for setting in settings:
        root = 1.0 / np.sqrt(1.0 + setting**2 * variance)
        spans, more = _fitted(root[:, None] * fixed, root[:, None] * shared, parts)
        yield replace(half, root=root, fitted=spans), log_det + more + float(np.sum(np.log(root)))


def _blocks(
    linear: LinearSystem, local: Floats, known: float | None
) -> tuple[tuple[tuple[slice | Ints, Floats], ...], Floats, float]:
    """Return the `blocks` of a `Whitener`, the variances (N,) of a setting error of 1 rad, and ln |T|.

    A setting or a column of `local` (N, k), in units of noise, joins rows; T makes their noise independent. If the
    setting error is `known`, rad per unit of noise, the noise includes it, and the variances are zero.
    """
    mine = np.where(linear.setting >= 0, linear.setting, linear.settings + np.arange(len(linear)))
    row, column = np.nonzero(local)
    if len(row):
        first = int(mine.max()) + 1
        size = first + local.shape[1]
        edges = coo_array((np.ones(len(row)), (mine[row], first + column)), shape=(size, size))
        mine = connected_components(edges, directed=False)[1][mine]
    order = np.argsort(mine, kind="stable")
    starts = np.flatnonzero(np.diff(mine[order], prepend=-1))
    sizes = np.diff(starts, append=len(order))
    blocks, variance, log_det = [], np.empty(len(linear)), 0.0
    for size in np.unique(sizes).tolist():
        alike = order[starts[sizes == size][:, None] + np.arange(size)]
        rows = _as_slice(alike.ravel())
        apart, setting = _covariances(linear, local, alike)
        cholesky = np.linalg.cholesky(apart if known is None else apart + known**2 * setting)
        log_det -= float(np.sum(np.log(np.diagonal(cholesky, axis1=1, axis2=2))))
        inverse = np.linalg.inv(cholesky)
        if known is not None:
            blocks.append((rows, inverse))
            variance[rows] = 0.0
            continue
        values, vectors = np.linalg.eigh(inverse @ setting @ np.swapaxes(inverse, 1, 2))
        blocks.append((rows, np.swapaxes(vectors, 1, 2) @ inverse))
        variance[rows] = np.maximum(values, 0.0).ravel()
    return tuple(blocks), variance, log_det


def _covariances(linear: LinearSystem, local: Floats, rows: Ints) -> tuple[Floats, Floats]:
    """Return the covariances (b, n, n) of blocks of `rows` (b, n) without a setting error, and what 1 rad adds.

    The first are in units of the squared noise of a reading, the second in the squared unit of the signal.
    """
    apart = np.eye(rows.shape[1]) * linear.relative[rows][:, :, None] ** 2
    for number, own in enumerate(rows) if local.shape[1] else ():
        joined = local[own]
        joined = joined[:, np.any(joined, axis=0)]
        apart[number] += joined @ joined.T
    slope = linear.slope[rows]
    along = slope[:, :, None] * slope[:, None, :]
    if local.shape[1]:  # otherwise, a block has one setting
        setting = linear.setting[rows]
        along[setting[:, :, None] != setting[:, None, :]] = 0.0
    return apart, along


def _fitted(white: Floats, wide: Floats, parts: Iterable[Sequence[Ints]]) -> tuple[tuple[Span, ...], float]:
    """Return the subspaces of the columns of coefficients (N, 12 × blocks) and of other unknowns (N, k).

    The columns are whitened; `parts` are rows and columns of each block's coefficients. The second result is the
    contribution of the subspaces to `log_det`.
    """
    spans = []
    log_det = 0.0
    for rows, columns in parts:
        if not len(rows):
            continue  # no row depends on these coefficients
        q, r = np.linalg.qr(white[np.ix_(rows, columns)])
        log_det -= float(np.sum(np.log(np.abs(np.diag(r)))))
        spans.append(Span(_as_slice(rows), q, np.zeros(q.shape[1])))
    if not wide.shape[1]:
        return tuple(spans), log_det
    beside = wide.copy()
    for span in spans:
        span.leave(beside, np.ones_like(span.kept))
    basis, size, _ = np.linalg.svd(beside, full_matrices=False)
    log_det -= 0.5 * float(np.sum(np.log1p(size**2)))
    left = 1.0 / (1.0 + size**2)
    kept = np.sqrt(np.where(left > NEGLIGIBLE, left, 0.0))
    return (*spans, Span(slice(None), basis, kept)), log_det


def _as_slice(rows: Ints) -> slice | Ints:
    """Return `rows` as a slice, which copies nothing, if they are consecutive, else unchanged."""
    first = int(rows[0])
    one_by_one = np.array_equal(rows, np.arange(first, first + len(rows)))
    return slice(first, first + len(rows)) if one_by_one else rows


EVERY: Final = slice(None)


@dataclass(frozen=True)
class ColumnProducts:
    """Scalar products of P columns, whitened at each noise ratio.

    Element i of `columns` (P, N) has column i, whose N rows are independent at all ratios; `weight` (ratios, N) is
    their inverse variance. `taken` (P, ratios, k) are the parts along the fitted directions, whose products are
    subtracted. With two sources of variance, one diagonalisation serves all their ratios: Patterson and Thompson,
    Biometrika 58 (1971) 545.
    """

    columns: Floats
    weight: Floats
    taken: Floats

    def across(self, columns: Ints, at: slice = EVERY) -> Floats:
        """Return the scalar products (ratios, k, P) of k `columns` (indices) with all P, for the ratios `at`."""
        weighed = self.columns[columns] * self.weight[at][:, None]
        whole = np.tensordot(weighed, self.columns, axes=(2, 1))
        taken = self.taken[:, at]
        return np.asarray(whole - np.swapaxes(taken[columns], 0, 1) @ taken.transpose(1, 2, 0))

    def among(self, columns: Ints, at: slice = EVERY) -> Floats:
        """Return the Gram matrices (ratios, …, p, p) of sets of columns, indices (…, p), for the ratios `at`."""
        own, taken = self.columns[columns], np.moveaxis(self.taken[columns][..., at, :], -2, 0)
        gram = np.stack([(own * weight) @ np.swapaxes(own, -2, -1) for weight in self.weight[at]])
        return np.asarray(gram - taken @ np.swapaxes(taken, -2, -1))

    @cached_property
    def square(self) -> Floats:
        """The squared length of each column, shape (ratios, P)."""
        taken = np.einsum("prk,prk->rp", self.taken, self.taken)
        return np.asarray(self.weight @ self.columns.T**2 - taken)


# --- the noise, from repeats ----------------------------------------------------------------------


@dataclass(frozen=True)
class Repeats:
    """The standard deviation of a reading from repeated settings, unit of the signal.

    `freedom` are its degrees of freedom, counted in settings.
    """

    sigma: float
    freedom: int


def noise_of_repeats(linear: LinearSystem, resolution: float) -> Repeats:
    """Return the noise of a reading from the scatter of repeated settings, whatever effects the model lacks.

    The fit has a free value for each mounting and angle, and a drift for each mounting. For each pass it has a bias
    and a wave once per turn, so that changes between passes do not count as noise. Noise and setting error maximise
    the restricted likelihood. With too few repeats, the result is the scatter about the model. It is at least the
    rounding error of `resolution`, unit of the signal.
    """
    oriented = linear.setting >= 0
    left, slope = (
        of[oriented].reshape(-1, 3) for of in np.array([linear.response, linear.slope]) / linear.relative
    )
    passes = linear.readings.pass_number[linear.rows.reading[oriented][::3]]
    mount, angle = _mounts_and_angles(linear)
    squares, along, freedom = [np.zeros(0)], [np.zeros(0)], 0
    for one in np.unique(mount):
        own = mount == one
        free = null_space(_saturated(angle[own], passes[own]).T, rcond=1e-9)
        turned = (free[:, :, None] * slope[own][:, None, :]).reshape(len(free), -1).T
        vectors, size, _ = np.linalg.svd(turned)
        squares.append((vectors.T @ (free.T @ left[own]).ravel()) ** 2)
        along.append(np.pad(size**2, (0, len(vectors) - len(size))))
        freedom += free.shape[1]
    floor = max(resolution / np.sqrt(12.0), 1e-11 * float(np.max(np.abs(linear.readings.signal))))
    if freedom < LEAST_FREEDOM:
        return Repeats(max(_about_model(linear), floor), max(linear.settings - 4, 1))
    return Repeats(max(_likeliest(np.concatenate(squares), np.concatenate(along)), floor), freedom)


def _likeliest(squares: Floats, along: Floats) -> float:
    """Return the noise of the largest likelihood for independent `squares` (m,) of residuals.

    Each has the noise variance plus `along` (m,) times that of a setting; ratios on a grid are compared.
    """
    ratio = np.append(0.0, np.geomspace(1e-2, 1e6, 81)) / max(float(along.max()), 1e-300)
    size = 1.0 + np.outer(ratio, along)
    noise2 = np.mean(squares / size, axis=1)
    misfit = len(squares) * np.log(np.maximum(noise2, 1e-300)) + np.sum(np.log(size), axis=1)
    return float(np.sqrt(noise2[np.argmin(misfit)]))


def _about_model(linear: LinearSystem) -> float:
    """Return the scatter of the residuals about the model, perpendicular to du/dphi in each setting."""
    oriented = linear.setting >= 0
    left = linear.response[oriented]
    whole = np.concatenate([linear.fixed, linear.random], axis=1)[oriented]
    rest = (left - whole @ np.linalg.lstsq(whole, left, rcond=None)[0]).reshape(-1, 3)
    slope = linear.slope[oriented].reshape(-1, 3)
    unit = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)
    across = rest - np.sum(rest * unit, axis=1, keepdims=True) * unit
    # with unequal channels, the residual across du/dphi has mainly the noise of those that change least
    share = np.mean(np.sum(linear.by_channel**2 * (1.0 - unit**2), axis=1)) / 2
    return float(np.sqrt(np.sum(across**2) / (2 * max(len(rest) - 4, 1)) / share))


def cells_of(linear: LinearSystem) -> Ints:
    """Return a number (n,) for each setting, the same for one mounting at one angle, rounded to `MARK_DEG`."""
    mount, angle = _mounts_and_angles(linear)
    cells = np.column_stack([mount, np.round(angle / MARK_DEG)])
    return np.unique(cells, axis=0, return_inverse=True)[1].ravel()


def _mounts_and_angles(linear: LinearSystem) -> tuple[Ints, Floats]:
    """Return the number of the mounting (n,) and the angle (n,), deg, of each setting."""
    readings, reading = linear.readings, linear.rows.reading[linear.setting >= 0][::3]
    labels = zip(readings.series[reading].tolist(), readings.installation[reading].tolist(), strict=True)
    number: dict[object, int] = {}
    mount = np.array([number.setdefault(label, len(number)) for label in labels], dtype=np.int64)
    return mount, np.degrees(readings.angle_rad[reading])


def _saturated(angle_deg: Floats, passes: Ints) -> Floats:
    """Return the columns that describe the settings of a mounting without a model (`noise_of_repeats`)."""
    near = np.round(angle_deg / MARK_DEG)
    cells = (near[:, None] == np.unique(near)).astype(np.float64)
    of_pass = (passes[:, None] == np.unique(passes)).astype(np.float64)
    angle = np.radians(angle_deg)[:, None]
    rank = np.arange(len(near), dtype=np.float64)[:, None] / len(near)
    return np.column_stack([cells, of_pass, of_pass * np.cos(angle), of_pass * np.sin(angle), rank])


SAME_SIZE: Final = 0.1
"""Fraction of the noise below which a difference of two sizes, or a rounding error of repeats, is neglected.

Added in quadrature, a size of this fraction changes the noise by 0.5 %.
"""


def digit_of(readings: Readings) -> float:
    """Return the step of the last digit of the signals, at least the resolution of the file; 0 if there is none."""
    resolution = readings.resolution
    if not resolution > 0.0 or readings.resolution_read is not None:
        return resolution
    steps = np.round(readings.signal / resolution).astype(np.int64)
    return resolution * max(int(np.gcd.reduce(steps.ravel())), 1)


def is_coarse(digit: float, sigma: float) -> bool:
    """Return whether the last digit, `digit`, is larger than the noise `sigma`, which includes rounding."""
    return digit > sigma


def is_rounded(digit: float, sigma: float) -> bool:
    """Return whether repeats share a rounding error, so that the noise is `sigma`, not that of residuals."""
    return repeated(digit, sigma) > SAME_SIZE * sigma


def with_rounding(linear: LinearSystem, digit: float, sigma: float) -> LinearSystem:
    """Return the system with the rounding error that repeats share as a further noise, unless it is negligible.

    `digit` is the step of the last digit; `sigma` is the noise from repeats, at least that of rounding.
    """
    if not is_rounded(digit, sigma):
        return linear
    size = repeated(digit, sigma)
    oriented = np.flatnonzero(linear.setting >= 0)
    key = 3 * np.repeat(cells_of(linear), 3) + linear.rows.channel[oriented]
    moduli = np.flatnonzero(linear.rows.channel == MODULUS)
    columns = np.zeros((len(linear), int(key.max()) + 1 + len(moduli)))
    columns[oriented, key] = size
    # a verification point has no repeats, so that its whole rounding error is noise of its own
    columns[moduli, int(key.max()) + 1 + np.arange(len(moduli))] = size
    return linear.with_noise(columns)


def repeated(digit: float, sigma: float) -> float:
    """Return the standard deviation of the rounding error that repeats share; `sigma` includes rounding."""
    if not digit > 0.0:
        return 0.0
    return float(rounding_variance(np.array([sigma]), digit / np.sqrt(12.0))[0] ** 0.5)
