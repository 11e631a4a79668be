"""Runs as sums of squares and products, and the noise that they share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import HOUR, Floats, Ints, rms
from bench.calibration import gls
from bench.calibration.calibrate import first_guess, usable_rows
from bench.calibration.design import FIXED, make_problem
from bench.calibration.noise import KnownNoise, RepeatScatter, repeat_groups, scatter_of_repeats, whiten
from bench.calibration.result import CalibrationError, Noise
from bench.model.conditions import Conditions
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES
from bench.readings.table import Readings
from bench.stats.repeats_likelihood import freedom_of, sizes_of

WAVES: Final = 2
"""Number of harmonics of the head's scale: its eccentricity and its ellipticity."""
WALKS: Final = 4
"""Number of retained shapes of a random walk; the others contain 5 % of its variance."""
LEAST_SETTINGS: Final = 4
"""The least number of repeated settings from which the noise of a run is estimated."""


@dataclass(frozen=True)
class RunFit:
    """One run, linearised about a fit of its own.

    `y` (n, 3) are residuals, with the fitted contribution of the stand angles added back. `X` (n, 3, …) are
    derivatives by the run's own unknowns: 12 coefficients and any effects. `stand` (n, 3, a) are derivatives by the
    stand angles `angles` (a,), each a name and an installation; `levels` (a, 2) has each angle as measured by a
    spirit level, with its u, rad (NaN if unmeasured). `slope` (n, 3) are derivatives of the signals by the head
    angle, `waves` (n, 3, 2 WAVES) by the harmonics of the head's scale. `walk` (n, q) are q shapes of a bias that
    walks at random by 1 per root hour. `scatter` is the scatter of repeats, `floor` the least noise assumed.
    """

    name: str
    y: Floats
    X: Floats
    stand: Floats
    angles: tuple[tuple[str, str], ...]
    levels: Floats
    slope: Floats
    waves: Floats
    walk: Floats
    scatter: RepeatScatter
    floor: float
    unit: str

    def noise(self) -> Floats | None:
        """Return the noise variances (4,) of x, y, z and setting error; None for too few repeats."""
        if self.scatter.settings < LEAST_SETTINGS:
            return None
        return _variances(self.scatter, self.floor)


def run_fit(name: str, readings: Readings, model: ForwardModel, stand_u: Mapping[str, float]) -> RunFit:
    """Fit one run alone, with the standard uncertainties `stand_u` of the stand angles, rad.

    `stand_u` has every stand angle, including those that the bench file does not state. Raises `CalibrationError`
    if the fit is impossible.
    """
    rows = usable_rows(readings, model)
    problem = make_problem(model, rows.conditions(), stand_u)
    start = first_guess(problem, rows.signal, rows.resolution)
    # this fit only determines the point of linearisation: rough noise sizes are sufficient
    near = Noise(rms(rows.signal - problem.predict(start, problem.prior_mean)), 0.0, np.inf, "given")
    fit = gls.fit(problem, rows.signal, start, near, rows.resolution)
    system, phase = fit.system, problem.conditions.angle_rad
    a = len(problem.stand)
    by_stand = system.jacobian[:, :, FIXED : FIXED + a]
    # model effects are fitted in each run by itself, like its coefficients, so the stand does not absorb them
    own = np.concatenate([system.jacobian[:, :, :FIXED], system.jacobian[:, :, FIXED + a :]], axis=2)
    waves = [fit.slope * wave(k * phase)[:, None] for k in range(1, WAVES + 1) for wave in (np.cos, np.sin)]
    groups, mounts = repeat_groups(problem.conditions), problem.conditions.mounts
    # series of one mounting share its angles: counted apart, they would seem to be as many mountings
    clamped = problem.conditions.clamped
    keys = [(s.column, s.mount if s.measured else clamped[s.mount], s.measured) for s in problem.stand]
    once = list(dict.fromkeys(keys))
    angles = [problem.stand[keys.index(key)] for key in once]
    shares = np.array([key == other for key in keys for other in once], dtype=float)
    return RunFit(
        name=name,
        y=fit.residuals + by_stand @ fit.others[:a],
        X=own,
        stand=by_stand @ shares.reshape(len(keys), len(once)),
        angles=tuple((STAND_ANGLES[s.column], mounts[s.mount].installation) for s in angles),
        levels=np.array(
            [(s.prior_mean, s.prior_u) if s.measured else (np.nan, np.nan) for s in angles]
        ).reshape(-1, 2),
        slope=fit.slope,
        waves=np.stack(waves, axis=2),
        walk=_walk(problem.conditions),
        scatter=scatter_of_repeats(fit.residuals, fit.slope, groups),
        floor=gls.noise_floor(rows.signal, rows.resolution),
        unit=readings.unit,
    )


def _walk(conditions: Conditions) -> Floats:
    """Return shapes (n, WALKS) of a random walk of a bias, of unit variance per hour.

    Their mean over the run is zero.
    """
    hours = conditions.elapsed_s / HOUR
    shapes = np.zeros((len(hours), WALKS))
    if np.ptp(hours) > 0:
        walk = np.minimum.outer(hours, hours) - hours.min()
        # the run's own biases absorb the mean of the walk
        centred = walk - walk.mean(axis=0) - walk.mean(axis=1)[:, None] + walk.mean()
        size, vectors = np.linalg.eigh(centred)
        most = min(WALKS, int(np.sum(size > 1e-9 * size[-1])))
        shapes[:, :most] = vectors[:, ::-1][:, :most] * np.sqrt(size[::-1][:most])
    return shapes


# --- many runs ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RunSums:
    """The sums of squares and products of many runs, as arrays of equal shape.

    `gram` (runs, w, w) has the sums for the columns W = (B, H, y) of each run; a column that a run lacks is zero. B
    has c columns for stand angles and drift, H has `waves` columns for harmonics of the head. `random` (runs, c) is
    the index of the variance of each column of B; `mean` (runs, c) is the index of the mean of each column; -1
    means that there is none. `chi2` (runs,) with `dof` (runs,) is y^T P y minus the scatter of repeats; P projects
    out the run's own coefficients, but not B and H.
    """

    names: tuple[str, ...]
    gram: Floats
    random: Ints
    mean: Ints
    waves: int
    chi2: Floats
    dof: Floats

    @property
    def columns(self) -> int:
        """The number of columns of B."""
        return int(self.random.shape[1])

    def by_mean(self, means: int) -> Floats:
        """Return the sums for (B, F, y): F has the sum of the columns of B for each mean, then the columns of H."""
        key = ("by mean", means)
        if key not in self._kept:
            c, h = self.columns, self.waves
            W = np.zeros((len(self.names), self.gram.shape[1], c + means + h + 1))
            W[:, np.arange(c), np.arange(c)] = 1.0
            run, column = np.nonzero(self.mean >= 0)
            W[run, column, c + self.mean[run, column]] = 1.0
            W[:, c + np.arange(h + 1), c + means + np.arange(h + 1)] = 1.0
            self._kept[key] = np.swapaxes(W, 1, 2) @ self.gram @ W
        return self._kept[key]

    def belongs(self, variances: int) -> Floats:
        """Return indicators (runs, c, k): 1 where column c of a run has variance k."""
        key = ("belongs", variances)
        if key not in self._kept:
            self._kept[key] = (self.random[:, :, None] == np.arange(variances)).astype(np.float64)
        return self._kept[key]

    @cached_property
    def _kept(self) -> dict[tuple[str, int], Floats]:
        """Cache of `by_mean` and `belongs`."""
        return {}

    def without(self, left_out: Sequence[int]) -> RunSums:
        """Return the sums without the runs at the given indices."""
        kept = [i for i in range(len(self.names)) if i not in set(left_out)]
        return RunSums(
            tuple(self.names[i] for i in kept), self.gram[kept], self.random[kept], self.mean[kept], self.waves,
            self.chi2[kept], self.dof[kept],
        )  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """The parameters that the runs of a bench may share, in order.

    `kinds` are the names of stand angles, `stated` (kinds,) their u, rad. Each pair in `means`, an angle and an
    installation ("" for all), has a mean. The variances are those of the kinds, then of the drift of x, y and z
    in units of `walk` squared (`walk` is in signal units per root hour). With `waves`, the harmonics of the
    head's scale are parameters, too.
    """

    kinds: tuple[str, ...]
    stated: Floats
    means: tuple[tuple[str, str], ...]
    walk: float
    waves: bool

    @classmethod
    def of(
        cls, runs: Sequence[RunFit], stand_u: Mapping[str, float], *, by_installation: bool, waves: bool
    ) -> Layout:
        """Return the layout for runs; `stand_u` has the u of each angle, rad.

        With `by_installation`, an angle has a separate mean in each installation.
        """
        pairs = dict.fromkeys(pair for run in runs for pair in run.angles)
        kinds = tuple(name for name in STAND_ANGLES if any(pair[0] == name for pair in pairs))
        means = [pair if by_installation else (pair[0], "") for pair in pairs]
        ordered = sorted(dict.fromkeys(means), key=lambda pair: (kinds.index(pair[0]), pair[1]))
        stated = np.array([stand_u[name] for name in kinds])
        sizes = [run.noise() for run in runs]
        typical = rms(np.concatenate([np.sqrt(one[:3]) for one in sizes if one is not None] or [np.ones(3)]))
        return cls(kinds, stated, tuple(ordered), typical, waves)

    def mean_of(self, pair: tuple[str, str]) -> int:
        """Return the index in `means` of the mean that applies to `pair`, an angle and an installation."""
        return self.means.index(pair if pair in self.means else (pair[0], ""))


def body_of(runs: Sequence[RunFit], variances: Floats, layout: Layout) -> RunSums:
    """Return the sums of runs for given noise variances.

    `variances` (4,) or (runs, 4) are the noise variances of x, y, z (unit^2) and of the setting (rad^2).
    """
    width = max(len(run.angles) for run in runs) + 3 * WALKS
    waves = 2 * WAVES if layout.waves else 0
    every = np.broadcast_to(variances, (len(runs), 4))
    sums = [_sums(run, own, layout, width, waves) for run, own in zip(runs, every, strict=True)]
    grams, random, mean, chi2, dof = zip(*sums, strict=True)
    return RunSums(
        tuple(run.name for run in runs), np.stack(grams), np.stack(random), np.stack(mean), waves,
        np.array(chi2), np.array(dof),
    )  # fmt: skip


def _sums(
    run: RunFit, variances: Floats, layout: Layout, width: int, waves: int
) -> tuple[Floats, Ints, Ints, float, float]:
    """Return the sums of a run (w, w), the indices of variance and mean by column (c,), chi-square, and dof."""
    n, a = len(run.y), len(run.angles)
    noise = Noise(rms(np.sqrt(variances[:3])), float(np.sqrt(variances[3])), np.inf, "given",
                  channels=tuple(np.sqrt(variances[:3]).tolist()))  # fmt: skip
    scale = np.array([layout.stated[layout.kinds.index(name)] for name, _ in run.angles])
    W = np.zeros((n, 3, width + waves + 1))
    W[:, :, :a] = run.stand * scale
    for channel in range(3):
        first = width - 3 * WALKS + channel * WALKS
        W[:, channel, first : first + WALKS] = run.walk * layout.walk
    W[:, :, width : width + waves] = run.waves[:, :, :waves]
    W[:, :, -1] = run.y
    whitened = partial(whiten, slope=run.slope, noise=noise)
    q = _span(whitened(run.X).reshape(3 * n, -1))
    columns = whitened(W).reshape(3 * n, -1)
    columns = columns - q @ (q.T @ columns)
    gram = columns.T @ columns
    random, mean = np.full(width, -1), np.full(width, -1)
    random[:a] = [layout.kinds.index(name) for name, _ in run.angles]
    mean[:a] = [layout.mean_of(pair) for pair in run.angles]
    random[width - 3 * WALKS :] = len(layout.kinds) + np.repeat(np.arange(3), WALKS)
    chi2, dof = _beyond_repeats(run, gram, variances, a)
    dof -= q.shape[1] - FIXED
    for j in np.flatnonzero(np.isfinite(run.levels[:, 0])):
        value, u = run.levels[j] / scale[j]
        gram[j, j] += u**-2
        gram[j, -1] += value / u**2
        gram[-1, j] += value / u**2
        gram[-1, -1] += (value / u) ** 2
    return gram, random, mean, chi2, dof


def _span(columns: Floats) -> Floats:
    """Return an orthonormal basis of the column space of a matrix (N, p)."""
    length = np.linalg.norm(columns, axis=0)
    left, size, _ = np.linalg.svd(columns / np.where(length > 0, length, 1.0), full_matrices=False)
    return np.asarray(left[:, size > 1e-9 * size[0]])


SEEN: Final = 1e-3
"""An eigenvalue of a run's information on the angles counts as zero below this part of the stated information."""


def _beyond_repeats(run: RunFit, gram: Floats, variances: Floats, angles: int) -> tuple[float, float]:
    """Return the chi-square of a run in excess of the scatter of its repeats, and its degrees of freedom.

    Chi-square follows the fit of the coefficients alone; the degrees of freedom also allow for the angles. The test
    of the run (`bench.history.learning`) subtracts the parts of angles and harmonics from chi-square.
    """
    dof = run.y.size - FIXED - 3 * run.scatter.settings
    size = np.linalg.eigvalsh(gram[:angles, :angles])
    return float(gram[-1, -1]) - run.scatter.chi_square(variances), float(dof - np.sum(size > SEEN))


def pooled_noise(runs: Sequence[RunFit]) -> Floats:
    """Return the noise variances (4,) of x, y, z and the setting error from the repeats of all runs.

    Raises `CalibrationError` for too few repeats.
    """
    if sum(run.scatter.settings for run in runs) < LEAST_SETTINGS:
        raise CalibrationError(
            "these runs have too few repeats to show their noise; use runs of a procedure with passes"
        )
    return _variances(_pooled_scatter(runs), min(run.floor for run in runs))


def _pooled_scatter(runs: Sequence[RunFit]) -> RepeatScatter:
    told = [run.scatter for run in runs if run.scatter.settings]
    return RepeatScatter(
        np.concatenate([one.matrix for one in told]),
        np.concatenate([one.freedom for one in told]),
        np.concatenate([one.slope for one in told]),
    )


def _variances(scatter: RepeatScatter, floor: float) -> Floats:
    found = sizes_of(scatter.matrix[None], scatter.freedom, scatter.slope[None], np.array([floor]))
    return np.asarray(found[0])


def scatter_of(runs: Sequence[RunFit], variances: Floats) -> tuple[Floats, Floats]:
    """Return each run's mean square of repeats relative to the noise variances (4,), and its dof, (runs,) each."""
    ratio, dof = [], []
    for run in runs:
        dof.append(3.0 * run.scatter.settings)
        ratio.append(run.scatter.chi_square(variances) / dof[-1])
    return np.array(ratio), np.array(dof)


def between_runs(ratio: Floats, dof: Floats) -> tuple[float, float, float]:
    """Return three numbers for the logarithms of n mean squares.

    They are the mean, the variance between runs, and the variance of the mean. The logarithm of a mean square with
    nu degrees of freedom has the variance psi'(nu/2) (trigamma function).
    """
    x = np.log(ratio) - special.digamma(dof / 2) + np.log(dof / 2)
    own = special.polygamma(1, dof / 2)
    weight = 1.0 / own
    mean = float(weight @ x / weight.sum())
    excess = float(weight @ (x - mean) ** 2) - (len(x) - 1)
    scale = float(weight.sum() - (weight @ weight) / weight.sum())
    spread2 = max(excess / scale, 0.0) if scale > 0 else 0.0
    weight = 1.0 / (own + spread2)
    mean = float(weight @ x / weight.sum())
    return mean, spread2, float(1.0 / weight.sum())


def known_noise(runs: Sequence[RunFit], variances: Floats) -> tuple[KnownNoise, Floats]:
    """Return the noise of the next run as prior knowledge, and the degrees of freedom (4,) of the pooled noise.

    The degrees of freedom of the prior allow for the variation of the noise between runs and the uncertainty
    of this variation.
    """
    whole = _pooled_scatter(runs)
    pooled = _pooled_dof(whole.freedom, whole.slope, variances)
    each = np.array([_own(run, variances) for run in runs if run.scatter.settings])
    spread2 = np.ones(4)
    for j in range(3):
        usable = each[:, 1, j] > 1.0
        if np.sum(usable) > 1:
            ratio, own = np.maximum(each[usable, 0, j], 1e-6), each[usable, 1, j]
            # add the uncertainty of the spread itself, from so few runs
            left = np.sqrt(2.0 / len(ratio)) * float(np.mean(special.polygamma(1, own / 2)))
            spread2[j] = between_runs(ratio, own)[1] + left
    # a single run hardly determines its setting error; the error is taken to vary between runs as the channels do
    spread2[3] = np.mean(spread2[:3])
    dof = 2.0 / (2.0 / np.maximum(pooled, 1e-15) + spread2)
    sizes = np.sqrt(variances)
    return KnownNoise(sizes[:3], dof[:3], float(sizes[3]), float(dof[3])), pooled


LEAST_SHOWN: Final = 0.01
"""A setting error that causes less than this fraction of the noise gets the u of one that causes this fraction."""


def _pooled_dof(freedom: Ints, slope: Floats, variances: Floats) -> Floats:
    """Return the degrees of freedom 2 v^2/u(v)^2 of the variances v (4,).

    The variance of the setting error, v[3], may be 0. u(v) is therefore computed with a small lower limit for it.
    """
    shown = float(np.mean(np.sum(slope**2, axis=1)))
    least = LEAST_SHOWN * float(np.mean(variances[:3])) / shown if shown > 0 else 0.0
    inside = variances.copy()
    inside[3] = max(variances[3], least)
    dof = np.array(freedom_of(freedom, slope[None], inside[None])[0])
    if inside[3] > 0:
        dof[3] *= (variances[3] / inside[3]) ** 2
    return dof


def _own(run: RunFit, variances: Floats) -> tuple[Floats, Floats]:
    """Return a run's own variances relative to the pooled `variances`, (4,), and their degrees of freedom (4,)."""
    own = run.noise()
    if own is None:
        return np.ones(4), np.zeros(4)
    dof = freedom_of(run.scatter.freedom, run.scatter.slope[None], variances[None])[0]
    return own / np.maximum(variances, 1e-300), dof
