"""The linear system whitened by its noise over a grid of noise ratios, and the noise from repeats alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bench.base.arrays import Floats, Ints, Mask
from bench.diagnosis.levels import BY_CHANCE, NEGLIGIBLE
from bench.diagnosis.linear import MODULUS, LinearSystem, RunSizes
from bench.readings.table import Readings


def coupled(matrix: Floats) -> Iterator[tuple[Ints, Ints]]:
    """Yield the rows and columns (both ascending) of each connected component of a matrix (N, k).

    Between different components the matrix is zero. Every column is in one component; rows of zeros are in none.
    """
    many, count = matrix.shape
    row, column = np.nonzero(matrix)
    edges = coo_array((np.ones(len(row)), (row, many + column)), shape=(many + count, many + count))
    label = connected_components(edges, directed=False)[1]
    for part in dict.fromkeys(label[many:].tolist()):
        yield np.flatnonzero(label[:many] == part), np.flatnonzero(label[many:] == part)


RATIOS: Final = (0.0, 0.7, 1.4, 2.6, 5.0, 12.0)
"""Grid of gamma: the signal of a setting error at the typical slope, in units of a reading's noise."""

RATIO_SPREAD: Final = 1.0
"""Prior standard deviation of ln gamma about the bench file's value, which is known to a factor of three."""

LOCAL: Final = 0.5
"""Largest fraction of the rows that a random column joins in one block; a wider column is fitted.

Of several runs it is one in at most a run's rows: what all runs share would join them all in one dense block.
"""


@dataclass(frozen=True)
class Span:
    """A fitted subspace of some of the rows: an orthonormal `basis` (n, k), and the factor `kept` (k,) of each
    direction.

    `kept` is the part of the direction that the prior leaves in the residuals. It is zero for coefficients, which
    have no prior.
    """

    rows: slice | Ints
    basis: Floats
    kept: Floats

    def leave(self, white: Floats, taken: Floats) -> None:
        """Remove the fraction `taken` (k,) of each fitted direction from columns (N, …), in place."""
        inside: Floats = self.basis.T @ white[self.rows]
        white[self.rows] -= self.basis @ (inside.T * taken).T


@dataclass(frozen=True)
class Whitener:
    """A linear map of rows (N,) to independent numbers of variance sigma^2, with fitted directions removed.

    `blocks` are row indices with the inverse Cholesky factor of their covariance. `fitted` are the fitted
    subspaces, orthogonal to each other. Each of several sensor blocks has its own coefficients in its own
    rows.
    """

    blocks: tuple[tuple[Ints, Floats], ...]
    fitted: tuple[Span, ...] = ()

    def __matmul__(self, columns: Floats) -> Floats:
        """Return the whitened columns (N, …). Their scalar products enter the likelihood."""
        white = self._half(columns)
        for span in self.fitted:
            span.leave(white, 1.0 - span.kept)
        return white

    def weigh(self, columns: Floats) -> Floats:
        """Return the inverse covariance times columns (N, …), with the fitted directions removed."""
        white = self._half(columns)
        for span in self.fitted:
            span.leave(white, 1.0 - span.kept**2)
        weighed = np.empty_like(white)
        for rows, factor in self.blocks:
            weighed[rows] = factor.T @ white[rows]
        return weighed

    @property
    def diagonal(self) -> Floats:
        """Diagonal of the matrix that `weigh` applies, shape (N,)."""
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
    """A grid of noise ratios, each with a linear map to white noise with the coefficients projected out.

    `white` (ratios) map rows to numbers of variance sigma^2 where nothing is missing; `freedom` of them are
    independent. `log_det` (ratios,) completes the restricted likelihood; `log_prior` (ratios,) is ln of the
    prior. `setting_rad_per_noise` (ratios,) is the setting error in rad for a reading noise of one. With `known`
    the noise is fixed at `sigma`; otherwise the data determine it.
    """

    white: tuple[Whitener, ...]
    log_det: Floats
    log_prior: Floats
    setting_rad_per_noise: Floats
    sigma: float
    freedom: int
    known: bool = False

    def log_likelihood(self, square: Floats) -> Floats:
        """Return ln of the likelihood of residuals with the sum of squares `square`, in units of sigma^2."""
        if self.known:
            return -0.5 * square
        return np.asarray(-0.5 * self.freedom * np.log(square), dtype=np.float64)


def make_noise_grid(
    linear: LinearSystem, sigma: float, setting_rad: float, ratios: Sequence[float] = RATIOS
) -> NoiseGrid:
    """Return the grid of maps. `sigma` is a first estimate of the reading noise; it scales prior sizes.

    `setting_rad` is the setting error that the bench file states (0: not known). Fewer `ratios` make the
    search quicker where the noise is known well enough.
    """
    oriented = linear.setting >= 0
    scaled2 = (linear.slope / linear.relative)[oriented] ** 2
    slope2 = np.bincount(linear.setting[oriented], scaled2, linear.settings).astype(np.float64)
    if not len(slope2):
        slope2, ratios = np.ones(1), ratios[:1]  # where nothing is set, no setting has an error
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
    """Return the whitening map for a given noise of a reading (unit of the signal) and setting error (rad)."""
    wide = _wide(linear)
    return _white(linear, setting_rad / sigma, sigma, wide, _blocks(linear, wide))[0]


def _wide(linear: LinearSystem) -> Mask:
    """Return a mask of the random columns that are in more than the fraction `LOCAL` of the rows."""
    most = min(LOCAL, 1.0 / len(np.unique(linear.readings.run))) * len(linear)
    return np.asarray(np.count_nonzero(linear.random, axis=0) > most)


def _blocks(linear: LinearSystem, wide: Mask) -> tuple[Ints, ...]:
    """Return the blocks of rows joined by a setting or by a column that is not `wide`, in ascending order."""
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
    """Return the subspaces of the coefficients and of `wide` columns with their prior; ln of determinants."""
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
    kept = np.sqrt(np.where(left > NEGLIGIBLE, left, 0.0))
    return (*spans, Span(slice(None), basis, kept)), log_det


def _as_slice(rows: Ints) -> slice | Ints:
    """Return rows that follow one another as a slice, which copies nothing."""
    first, last = int(rows[0]), int(rows[-1])
    return slice(first, last + 1) if last - first == len(rows) - 1 else rows


class Products(Protocol):
    """Interface to the scalar products of P whitened columns, for each ratio of the noise sizes."""

    def across(self, columns: Ints) -> Floats:
        """Return the products of some columns (k,) with all, shape (ratios, k, P)."""

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the products of some columns (k,) with all for one ratio, shape (k, P)."""

    def among(self, columns: Ints) -> Floats:
        """Return the products of columns (…, p) with each other, shape (ratios, …, p, p)."""


@dataclass(frozen=True)
class ColumnProducts:
    """Scalar products of whitened columns, computed on demand.

    `white` (ratios, N, P) holds P columns of N rows for each noise ratio. If N < P, this needs less memory than
    all products.
    """

    white: Floats

    def across(self, columns: Ints) -> Floats:
        """Return the products of some columns (k,) with all, shape (ratios, k, P)."""
        return np.swapaxes(self.white[:, :, columns], 1, 2) @ self.white

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the products of some columns (k,) with all for one ratio, shape (k, P)."""
        return np.asarray(self.white[ratio][:, columns].T @ self.white[ratio])

    def among(self, columns: Ints) -> Floats:
        """Return the products of columns (…, p) with each other, shape (ratios, …, p, p)."""
        if columns.shape[-1] == 1:
            return np.asarray(self._square[:, columns[..., 0], None, None])
        chosen = np.moveaxis(self.white[:, :, columns], 1, -2)
        return np.asarray(np.swapaxes(chosen, -1, -2) @ chosen)

    @cached_property
    def _square(self) -> Floats:
        return np.asarray(np.einsum("gnp,gnp->gp", self.white, self.white))


@dataclass(frozen=True)
class GramProducts:
    """Products from the Gram matrix (ratios, P, P): smaller for more rows than columns."""

    gram: Floats

    def across(self, columns: Ints) -> Floats:
        """Return the products of some columns (k,) with all, shape (ratios, k, P)."""
        return np.asarray(self.gram[:, columns])

    def across_at(self, ratio: int, columns: Ints) -> Floats:
        """Return the products of some columns (k,) with all for one ratio, shape (k, P)."""
        return np.asarray(self.gram[ratio][columns])

    def among(self, columns: Ints) -> Floats:
        """Return the products of columns (…, p) with each other, shape (ratios, …, p, p)."""
        return np.asarray(self.gram[:, columns[..., :, None], columns[..., None, :]])


# --- the noise, from repeats ----------------------------------------------------------------------


LEAST_FREEDOM: Final = 6
"""Least number of settings beyond the saturated description from which repeats determine the noise."""
RATIOS2: Final = np.append(0.0, np.geomspace(1e-2, 1e6, 81))
"""Trial variances of the setting error where it is largest, in units of the noise variance."""


@dataclass(frozen=True)
class Repeats:
    """Noise `sigma` of a reading (unit of the signal) from repeats of settings.

    `freedom` are its degrees of freedom, counted in settings.
    """

    sigma: float
    freedom: int


def noise_of_repeats(linear: LinearSystem, resolution: float) -> Repeats:
    """Return the noise from the scatter of repeated settings about a saturated description.

    The description has a free value for each mounting and angle, and a slope in order of measurement for each
    mounting. Each pass has a free bias and a free wave once a turn, so that changes between passes are no
    noise. Noise and setting error (along du/dphi) maximise the restricted likelihood of the residuals. It
    accounts for the errors that the description carries from one setting to another. With too few repeats,
    the scatter about the model is used instead. The noise is never below the rounding to `resolution`.
    """
    parts = parts_of_repeats(linear)
    floor = max(resolution / np.sqrt(12.0), 1e-11 * float(np.max(np.abs(linear.readings.signal))))
    if parts.freedom < LEAST_FREEDOM:
        return Repeats(max(_about_model(linear), floor), max(linear.settings - 4, 1))
    return Repeats(max(likeliest(parts).sigma, floor), parts.freedom)


@dataclass(frozen=True)
class IndependentParts:
    """Independent residuals of repeats: their `squares` (m,), and the setting error's share `along` (m,).

    The residuals are scaled by the relative noise of the rows. `freedom` is in settings.
    """

    squares: Floats
    along: Floats
    freedom: int


@dataclass(frozen=True)
class Likeliest:
    """Maximum likelihood noise `sigma`, its degrees of freedom, and the squares over their expectation.

    The degrees of freedom are reduced by those that determine the setting error.
    """

    sigma: float
    freedom: float
    scaled: Floats


def parts_of_repeats(linear: LinearSystem, chosen: Mask | None = None) -> IndependentParts:
    """Return the residuals of repeats, of all readings or of the readings `chosen` (n,), which must be whole
    mountings.
    """
    oriented = linear.setting >= 0
    readings = linear.readings
    reading = linear.rows.reading[oriented][::3]
    left = (linear.response / linear.relative)[oriented].reshape(-1, 3)
    slope = (linear.slope / linear.relative)[oriented].reshape(-1, 3)
    angle = np.round(np.degrees(readings.angle_rad[reading]) / 5.0).astype(int)
    mount = np.array(_mounts(linear))
    used = np.ones(len(mount), dtype=bool) if chosen is None else chosen[reading]
    squares, along, freedom = [np.zeros(0)], [np.zeros(0)], 0
    for label in dict.fromkeys(mount[used].tolist()):
        own = mount == label
        passes = readings.pass_number[reading]
        free = _beyond(_saturated(angle[own], passes[own], readings.angle_rad[reading][own]))
        part = _of_mount(free, left[own], slope[own])
        squares.append(part[0])
        along.append(part[1])
        freedom += free.shape[1]
    return IndependentParts(np.concatenate(squares), np.concatenate(along), freedom)


def _of_mount(free: Floats, left: Floats, slope: Floats) -> tuple[Floats, Floats]:
    """Return the squares (3k,) of independent parts of `left` (n, 3), and the setting error's share in each.

    `free` (n, k) spans the complement of the saturated description. Units are the channels' relative noise.
    """
    turned = (free[:, :, None] * slope[:, None, :]).reshape(len(slope), -1).T
    vectors, size, _ = np.linalg.svd(turned)
    parts = vectors.T @ (free.T @ left).ravel()
    along = np.zeros(len(parts))
    along[: len(size)] = size**2
    return parts**2, along


def likeliest(parts: IndependentParts) -> Likeliest:
    """Return the maximum likelihood noise of these residuals, estimated jointly with a setting error."""
    squares, along = parts.squares, parts.along
    ratio = RATIOS2 / max(float(along.max()), 1e-300)
    size = 1.0 + np.outer(ratio, along)
    noise2 = np.mean(squares / size, axis=1)
    misfit = len(squares) * np.log(np.maximum(noise2, 1e-300)) + np.sum(np.log(size), axis=1)
    best = int(np.argmin(misfit))
    # of the information on the noise the setting error takes what both have in common
    shared = along / size[best]
    taken = float(shared.sum()) ** 2 / max(float(shared @ shared), 1e-300)
    expected = np.maximum(noise2[best], 1e-300) * size[best]
    return Likeliest(float(np.sqrt(noise2[best])), len(squares) - taken, squares / expected)


def _about_model(linear: LinearSystem) -> float:
    """Return the scatter about the model across du/dphi."""
    oriented = linear.setting >= 0
    left = linear.response[oriented]
    whole = np.concatenate([linear.fixed, linear.random], axis=1)[oriented]
    rest = (left - whole @ np.linalg.lstsq(whole, left, rcond=None)[0]).reshape(-1, 3)
    slope = linear.slope[oriented].reshape(-1, 3)
    unit = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)
    across = rest - np.sum(rest * unit, axis=1, keepdims=True) * unit
    # of unequal channels what is left across du/dphi is that of the two that turn least with it
    share = np.mean(np.sum(linear.by_channel**2 * (1.0 - unit**2), axis=1)) / 2
    return float(np.sqrt(np.sum(across**2) / (2 * max(len(rest) - 4, 1)) / share))


def cells_of(linear: LinearSystem) -> NDArray[np.int64]:
    """Return the cell number (n,) of each setting by mounting and angle, to 5 deg; a cell holds repeats."""
    reading = linear.rows.reading[linear.setting >= 0][::3]
    angle = np.round(np.degrees(linear.readings.angle_rad[reading]) / 5.0).astype(int)
    keys = list(zip(_mounts(linear), angle.tolist(), strict=True))
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([number[key] for key in keys], dtype=np.int64)


def _mounts(linear: LinearSystem) -> list[str]:
    readings, reading = linear.readings, linear.rows.reading[linear.setting >= 0][::3]
    return [f"{s}/{i}" for s, i in zip(readings.series[reading], readings.installation[reading], strict=True)]


def _saturated(angle: Ints, passes: Ints, angle_rad: Floats) -> Floats:
    """Return the columns of the saturated description of the settings of a mounting."""
    cells = (angle[:, None] == np.unique(angle)).astype(np.float64)
    of_pass = (passes[:, None] == np.unique(passes)).astype(np.float64)
    waves = [of_pass * np.cos(angle_rad)[:, None], of_pass * np.sin(angle_rad)[:, None]]
    rank = np.arange(len(angle), dtype=np.float64)[:, None] / len(angle)
    return np.column_stack([cells, of_pass, *waves, rank])


def _beyond(columns: Floats) -> Floats:
    """Return an orthonormal basis (n, k) of the complement of the columns (n, p)."""
    u, size, _ = np.linalg.svd(columns)
    return np.asarray(u[:, np.count_nonzero(size > 1e-9 * size[0]) :])


HARDLY_ANY: Final = 0.1
"""Fraction of the noise below which repeated rounding error is neglected."""
TERMS: Final = 30


def digit_of(readings: Readings) -> float:
    """Return the step of the signals' last digit, unit of the signal:

    2e-5 where all signals are even at 1e-5; 0 if no such step is found.
    """
    resolution = readings.resolution
    if not resolution > 0.0 or readings.resolution_read is not None:
        return resolution
    steps = np.round(readings.signal / resolution).astype(np.int64)
    return resolution * max(int(np.gcd.reduce(steps.ravel())), 1)


def is_coarse(digit: float, sigma: float) -> bool:
    """Return whether the last digit is coarser than the noise `sigma`, which includes rounding."""
    return digit > sigma


def is_rounded(digit: float, sigma: float) -> bool:
    """Return whether the rounding error repeats; the noise is then fixed at `sigma`."""
    return repeated(digit, sigma) > HARDLY_ANY * sigma


def with_rounding(linear: LinearSystem, digit: float, sigma: float) -> LinearSystem:
    """Return the system with a rounding error shared by repeats of a setting, where it is not negligible.

    `sigma` is the noise from the repeats, at least the rounding noise.
    """
    if not is_rounded(digit, sigma):
        return linear
    size = repeated(digit, sigma)
    oriented = np.flatnonzero(linear.setting >= 0)
    key = 3 * np.repeat(cells_of(linear), 3) + linear.rows.channel[oriented]
    moduli = np.flatnonzero(linear.rows.channel == MODULUS)
    columns = np.zeros((len(linear), int(key.max()) + 1 + len(moduli)))
    columns[oriented, key] = size
    # a verification point is read once, so that nothing of its rounding error averages out
    columns[moduli, int(key.max()) + 1 + np.arange(len(moduli))] = size
    return linear.with_noise(columns)


def grid_with_rounding(linear: LinearSystem, sigma: float, setting_rad: float, digit: float) -> NoiseGrid:
    """Return the grid of `make_noise_grid`, with the noise fixed where the rounding error repeats."""
    return replace(make_noise_grid(linear, sigma, setting_rad), known=is_rounded(digit, sigma))


def repeated(digit: float, sigma: float) -> float:
    """Return the standard deviation of the repeated part of the rounding error, unit of the signal."""
    if not digit > 0.0:
        return 0.0
    s2 = max(sigma**2 / digit**2 - 1.0 / 12.0, 0.0)
    k2 = np.arange(1, TERMS + 1) ** 2
    return float(digit * np.sqrt(np.sum(np.exp(-4 * np.pi**2 * k2 * s2) / (2 * np.pi**2 * k2))))


def with_sizes_of_runs(linear: LinearSystem, least: float) -> LinearSystem:
    """Return the system with a noise size for each run, where the runs differ significantly.

    `least` is the lower limit of the noise of a run in the unit of the signal, set by rounding. Where a run
    has too few repeats to determine its noise, all runs count as alike.
    """
    by_run = _by_run(linear, least)
    return linear if by_run is None else replace(linear, by_run=by_run)


def _by_run(linear: LinearSystem, least: float) -> RunSizes | None:
    readings = linear.readings
    numbers = np.unique(readings.run)
    if len(numbers) < 2:
        return None
    found: list[Likeliest] = []
    for number in numbers:
        parts = parts_of_repeats(linear, readings.run == number)
        if parts.freedom < LEAST_FREEDOM:
            return None
        found.append(likeliest(parts))
    freedom = np.array([one.freedom for one in found])
    variance = np.maximum([one.sigma**2 for one in found], least**2)
    if p_alike(variance, freedom, _kurtosis(found)) >= BY_CHANCE:
        return None
    rows = np.bincount(readings.run[linear.rows.reading], minlength=len(numbers))
    return RunSizes(np.sqrt(variance / np.average(variance, weights=rows)), freedom)


def p_alike(variance: Floats, freedom: Floats, kurtosis: float) -> float:
    """Return the p-value of equal variances (runs,), each with its degrees of `freedom` (Bartlett's test).

    `kurtosis` is the excess kurtosis of the residuals, for which the test statistic is corrected.
    """
    runs, whole = len(variance), float(freedom.sum())
    apart = whole * np.log(np.average(variance, weights=freedom)) - float(freedom @ np.log(variance))
    apart /= 1.0 + (float(np.sum(1.0 / freedom)) - 1.0 / whole) / (3.0 * (runs - 1))
    return float(special.chdtrc(runs - 1, max(float(apart), 0.0) / (1.0 + max(kurtosis, 0.0) / 2.0)))


def _kurtosis(found: list[Likeliest]) -> float:
    """Return the excess kurtosis of the residuals of repeats, each run in units of its own noise."""
    squares = np.concatenate([one.scaled for one in found])
    return float(np.mean(squares**2) / np.mean(squares) ** 2 - 3.0)
