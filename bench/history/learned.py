"""The errors learned from the runs of one bench, with their u, and the differences between its meters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import linalg, sparse, special
from scipy.sparse import csgraph

from bench.base.arrays import ARCSEC, CHANNELS, Floats, Ints
from bench.base.languages import message
from bench.calibration.noise import KnownStand
from bench.stats import contrasts_within

NONE: Final = 1e-6
"""A variance below this fraction of its stated value counts as zero."""
FEW_DOF: Final = 4.0
"""With at most these degrees of freedom, only the upper limit of a standard deviation is meaningful."""
SHOWN_P: Final = 0.01
"""Significance level of a harmonic of the head's scale."""
HARDLY_BETTER: Final = 0.95
WAVE_NAMES: Final = (
    "head_eccentricity.cosine", "head_eccentricity.sine", "head_ellipticity.cosine", "head_ellipticity.sine",
)  # fmt: skip
NEVER: Final = (
    message("absolute gain of the voltmeters: 1 ppm of it is 1 ppm of every coefficient of every block"),
    message("absolute zero of the voltmeters: it adds fully to the biases of every block"),
)


@dataclass(frozen=True)
class LearnedSize:
    """A learned quantity in `unit`, with its standard uncertainty and degrees of freedom.

    `told` is false if the runs add little or nothing to the prior knowledge of the quantity.
    """

    name: str
    value: float
    u: float
    unit: str
    dof: float
    told: bool = True


@dataclass(frozen=True)
class Variance:
    """A variance component `theta` and its u, in units of the square of `unit`.

    If `held` is true, the runs do not determine the variance, and it keeps its prior.
    """

    name: str
    theta: float
    u_theta: float
    unit: float
    held: bool

    @property
    def dof(self) -> float:
        """The degrees of freedom of the variance, 2 v^2/u(v)^2."""
        return 2.0 * self.theta**2 / max(self.u_theta**2, 1e-300)

    @property
    def size(self) -> float:
        """The standard deviation, in the unit of `unit`; 0 for a negligible variance."""
        return float(np.sqrt(self.theta)) * self.unit if self.theta > NONE else 0.0

    @property
    def u(self) -> float:
        """The standard uncertainty of `size`.

        With few degrees of freedom it is the increase of `size` if the variance grows by its u.
        """
        if self.dof > FEW_DOF:
            return self.size / float(np.sqrt(2.0 * (self.dof - 2.0)))
        return (float(np.sqrt(self.theta + self.u_theta)) - float(np.sqrt(self.theta))) * self.unit

    @property
    def u_next(self) -> float:
        """The standard deviation for the next run: enlarged because the variance is uncertain, never zero."""
        if self.held:
            return self.size
        nu = max(self.dof, FEW_DOF)
        z = self.theta / max(self.u_theta, 1e-300)
        tail = float(np.exp(-0.5 * z**2 - special.log_ndtr(z)) / np.sqrt(2.0 * np.pi))
        return float(np.sqrt(max(self.theta * nu / (nu - 2.0), self.theta + self.u_theta * tail))) * self.unit


@dataclass(frozen=True)
class Contradiction:
    """A run that contradicts the others.

    `what` names the quantity, `size` is its ratio to the value expected from the other runs, `p` Holm's p-value.
    """

    run: str
    what: str
    size: float
    p: float

    @property
    def sentence(self) -> str:
        """The contradiction as a sentence."""
        return message(
            f"{self.run} contradicts the others: {self.what} is {self.size:.3g} times the expected size"
        )


@dataclass(frozen=True)
class Learned:
    """The errors that the runs of one bench share.

    `means` (m + waves,), rad, are the m means of the stand angles, then the harmonics of the head; `covariance` is
    their covariance. `keys` (m) holds the angle and the installation of each mean, with "" for all installations.
    `stated` (m,) are the standard uncertainties of the m means before learning, rad. `variances` has the variances
    of each kind of angle between mountings, then the variances of the drift of each channel (in signal units per
    root hour); `variances_covariance` (k, k) is their covariance. `noise` (4,) is the noise of x, y, z and of the
    setting (rad). `known` is the prior knowledge for later calibrations. `not_told` gives, for each kind of angle
    that the runs do not determine, the reason. `meters` are the differences between voltmeters, or a sentence on
    why they are unknown.
    """

    runs: tuple[str, ...]
    unit: str
    keys: tuple[tuple[str, str], ...]
    means: Floats
    covariance: Floats
    means_dof: Floats
    stated: Floats
    waves: int
    variances: tuple[Variance, ...]
    variances_covariance: Floats
    noise: Floats
    noise_dof: Floats
    known: KnownStand
    not_told: Mapping[str, str]
    contradicting: tuple[Contradiction, ...] = ()
    too_many_contradict: bool = False
    meters: MeterDifferences | str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the means and of the harmonics."""
        own = [f"{name}[{installation}]" if installation else name for name, installation in self.keys]
        return (*own, *WAVE_NAMES[: self.waves])

    def sizes(self) -> Iterator[LearnedSize]:
        """Yield all learned quantities: means, harmonics, variation between mountings, noise, drift, meters."""
        u = np.sqrt(np.diag(self.covariance))
        for j, name in enumerate(self.names):
            told = j >= len(self.stated) or u[j] < HARDLY_BETTER * self.stated[j]
            label = name if j >= len(self.stated) else f"{name}.mean"
            yield LearnedSize(
                label, self.means[j] / ARCSEC, u[j] / ARCSEC, "arcsec", float(self.means_dof[j]), bool(told)
            )
        kinds = len(self.variances) - 3
        for v in self.variances[:kinds]:
            yield LearnedSize(f"{v.name}.remount", v.size / ARCSEC, v.u / ARCSEC, "arcsec", v.dof, not v.held)
        for j, channel in enumerate(CHANNELS):
            nu = float(self.noise_dof[j])
            yield LearnedSize(f"noise[{channel}]", float(self.noise[j]), _u(self.noise[j], nu), self.unit, nu)
        nu = float(self.noise_dof[3])
        size = self.noise[3] / ARCSEC
        yield LearnedSize("setting_error", float(size), _u(size, nu), "arcsec", nu)
        for v in self.variances[kinds:]:
            yield LearnedSize(v.name, v.size, v.u, f"{self.unit}/sqrt(h)", v.dof)
        if not isinstance(self.meters, str):
            yield from self.meters.sizes()

    def shown_waves(self) -> list[int]:
        """Return the indices (from 0) of the significant harmonics of the head."""
        m, found = len(self.keys), []
        for k in range(self.waves // 2):
            at = slice(m + 2 * k, m + 2 * k + 2)
            chi2 = float(self.means[at] @ np.linalg.solve(self.covariance[at, at], self.means[at]))
            if special.chdtrc(2, chi2) < SHOWN_P:
                found.append(k)
        return found

    def not_identified(self) -> list[str]:
        """Return a sentence for each quantity that these runs do not determine, with the reason."""
        told = [
            message(f"{name}.remount: {why}; it keeps its prior, an unknown part of the stated limit")
            for name, why in self.not_told.items()
        ]
        told += [
            message(f"{size.name}: the runs do not improve the bench file's value; it keeps its prior")
            for size in self.sizes()
            if not size.told and size.name.endswith(".mean")
        ]
        if isinstance(self.meters, str):
            return [*told, *NEVER, *filter(None, [self.meters])]
        return [*told, *NEVER, *self.meters.not_told()]


def _u(size: float, dof: float) -> float:
    """Return the u of a standard deviation `size` with `dof` degrees of freedom.

    With few degrees of freedom it is the increase of `size` if the variance grows by its u.
    """
    if dof > FEW_DOF:
        return float(size / np.sqrt(2.0 * (dof - 2.0)))
    return float(size * (np.sqrt(1.0 + np.sqrt(2.0 / max(dof, 1e-30))) - 1.0))


LEAST_FREEDOM: Final = 2
"""Least degrees of freedom that separate a block's variation between runs from meter differences."""
NOT_EXCHANGED: Final = message(
    "differences between the voltmeters: unknown, as no block was measured with exchanged voltmeters; "
    "measure three runs of one block (two of two blocks), each voltmeter on another channel"
)
ONE_METER: Final = message("differences between the voltmeters: none: one voltmeter reads all channels")
TOO_FEW: Final = message(
    "differences between the voltmeters: too few runs with exchanged voltmeters; measure one more run of "
    "that block, each voltmeter on another channel"
)
_PPM, _MICROVOLT = 1e-6, 1e-6


@dataclass(frozen=True)
class MeterRun:
    """A calibration of one block (its name is `unit`), reduced to the quantities that its voltmeters affect.

    `meters` are the meters' identities by channel; `day` is the time in days from any origin. `values` (6,)
    are the logarithms of the lengths of the rows of K (in V/g), then the biases in g. `covariance` (6, 6)
    contains the errors that vary from run to run, without those of the meters. Errors that all runs of the
    block share have one column each in `block` (6, q): the change of the values for one standard uncertainty.
    `drift` (3, 2) has, by channel, the standard uncertainties of the changes of relative gain and of zero (V)
    within `per_days`.
    """

    name: str
    unit: str
    meters: tuple[str, str, str]
    day: float
    values: Floats
    covariance: Floats
    block: Floats
    drift: Floats
    per_days: float

    @classmethod
    def of(
        cls, name: str, unit: str, meters: tuple[str, str, str], day: float, coefficients: Floats,
        covariance: Floats, block: Floats, drift: Floats, per_days: float,
    ) -> MeterRun:  # fmt: skip
        """Return the run for `coefficients` (12,) with a `covariance` (12, 12) and block errors (12, q)."""
        values, slope = lengths_and_biases(coefficients)
        return cls(
            name, unit, meters, day, values, slope @ covariance @ slope.T, slope @ block, drift, per_days
        )


def lengths_and_biases(coefficients: Floats) -> tuple[Floats, Floats]:
    """Return ln |row| of K and bias divided by |row|, by channel, (6,), and derivatives (6, 12) by coefficients."""
    rows, bias = coefficients[:9].reshape(3, 3), coefficients[9:]
    length = np.linalg.norm(rows, axis=1)
    slope = np.zeros((6, 12))
    for i in range(3):
        by_row = rows[i] / length[i] ** 2
        slope[i, 3 * i : 3 * i + 3] = by_row
        slope[3 + i, 3 * i : 3 * i + 3] = -bias[i] / length[i] * by_row
        slope[3 + i, 9 + i] = 1.0 / length[i]
    return np.concatenate([np.log(length), bias / length]), slope


@dataclass(frozen=True)
class Contrasts:
    """Gain or zero of M meters: `values` (M,) relative to the meter's group mean, with `covariance` (M, M).

    Meters of a group can be compared. `freedom` (M,) are the degrees of freedom of the difference from the first
    meter of the group (inf for that meter). `between` is the standard deviation between runs of a block beyond
    the stated u. All values are in SI units.
    """

    values: Floats
    covariance: Floats
    freedom: Floats
    between: float

    def difference(self, a: int, b: int) -> tuple[float, float]:
        """Return the difference of meter `a` minus meter `b`, and its standard uncertainty."""
        c = self.covariance
        return float(self.values[a] - self.values[b]), float(np.sqrt(c[a, a] + c[b, b] - 2.0 * c[a, b]))


@dataclass(frozen=True)
class MeterDifferences:
    """The differences between M meters, referred to the time `day`, in days as in `MeterRun`.

    Meters of different `group` (M,) cannot be compared. `used` counts the runs in which each meter read each
    channel.
    """

    meters: tuple[str, ...]
    group: tuple[int, ...]
    used: tuple[tuple[int, int, int], ...]
    gain: Contrasts
    zero: Contrasts
    runs: tuple[str, ...]
    day: float

    def pairs(self) -> Iterator[tuple[int, int]]:
        """Yield pairs of indices: a meter, and the first meter of its group, for all but the first meters."""
        for b, group in enumerate(self.group):
            first = self.group.index(group)
            if first != b:
                yield b, first

    def sizes(self) -> Iterator[LearnedSize]:
        """Yield the difference of each meter from the first meter of its group."""
        for what, contrasts, unit, scale in (
            ("gain", self.gain, "ppm", _PPM), ("offset", self.zero, "µV", _MICROVOLT)
        ):  # fmt: skip
            for b, a in self.pairs():
                value, u = contrasts.difference(b, a)
                dof = float(contrasts.freedom[b])
                yield LearnedSize(f"voltmeter_{what}[{b + 1}-{a + 1}]", value / scale, u / scale, unit, dof)

    def words(self) -> Iterator[str]:
        """Yield a line for each meter: its number, its identity and the channels that it read."""
        for number, (meter, used) in enumerate(zip(self.meters, self.used, strict=True), start=1):
            read = ", ".join(f"{c} in {n}" for c, n in zip(CHANNELS, used, strict=True) if n)
            yield message(
                f"voltmeter {number}: {meter} (read {read} of {len(self.runs)} runs with exchanged voltmeters)"
            )

    def not_told(self) -> Iterator[str]:
        """Yield a sentence if there are groups of meters that cannot be compared."""
        if len(set(self.group)) > 1:
            groups = [
                " and ".join(str(m + 1) for m, own in enumerate(self.group) if own == group)
                for group in dict.fromkeys(self.group)
            ]
            yield message(
                f"differences between voltmeters {', '.join(groups)}: no channel was read by both; "
                "measure a block with these voltmeters exchanged"
            )


def meter_differences(runs: Sequence[MeterRun]) -> MeterDifferences | str:
    """Return the differences between the meters of runs, or a sentence on why they cannot be determined."""
    kept = exchanged([(run.unit, run.meters) for run in runs])
    if not kept:
        alone = bool(runs) and all(len(set(run.meters)) == 1 for run in runs)
        return ONE_METER if alone else NOT_EXCHANGED
    own = [runs[i] for i in kept]
    design = _Design.of(own)
    if design.freedom < LEAST_FREEDOM:
        return TOO_FEW
    day = float(np.mean([run.day for run in own]))
    gain = design.fit(*_stacked(own, day, 0, np.ones(design.readings)))
    zero = design.fit(*_stacked(own, day, 1, design.mean_length(np.concatenate([r.values[:3] for r in own]))))
    used = design.meter_of.reshape(-1, 3)
    return MeterDifferences(
        design.meters,
        tuple(design.group.tolist()),
        tuple((int(n[0]), int(n[1]), int(n[2])) for n in
              (np.sum(used == m, axis=0) for m in range(len(design.meters)))),
        gain, zero, tuple(run.name for run in own), day,
    )  # fmt: skip


def exchanged(runs: Sequence[tuple[str, tuple[str, str, str]]]) -> list[int]:
    """Return the indices of the runs from which meters can be compared.

    These are the runs of units that had different meters on one channel. `runs` gives the unit and the meters of
    x, y and z; a run with an unidentified meter ("") is left out.
    """
    met: dict[tuple[str, int], set[str]] = {}
    for unit, meters in runs:
        for channel, meter in enumerate(meters):
            if unit and meter:
                met.setdefault((unit, channel), set()).add(meter)
    units = {unit for (unit, _), meters in met.items() if len(meters) > 1}
    return [i for i, (unit, meters) in enumerate(runs) if unit in units and all(meters)]


def _stacked(runs: Sequence[MeterRun], day: float, quantity: int, scale: Floats) -> tuple[Floats, Floats]:
    """Return quantity 0 (gain) or 1 (zero) of N readings, and its covariance (N, N) with the drift from `day`.

    The quantity is the value in the runs times `scale` (N,).
    """
    at = slice(3 * quantity, 3 * quantity + 3)
    y = scale * np.concatenate([run.values[at] for run in runs])
    known = linalg.block_diag(*(run.covariance[at, at] for run in runs))
    for unit in {run.unit for run in runs}:
        width = max(run.block.shape[1] for run in runs if run.unit == unit)
        parts = [
            run.block[at] if run.unit == unit and run.block.shape[1] == width else np.zeros((3, width))
            for run in runs
        ]
        alike = np.concatenate(parts)
        known = known + alike @ alike.T
    known = known * np.outer(scale, scale)
    return y, known + _moved(runs, day, quantity)


def _moved(runs: Sequence[MeterRun], day: float, quantity: int) -> Floats:
    """Return the covariance (N, N) of the drifts of meters from their states on `day`.

    The u of a drift grows in proportion to the time from `day`. Drifts of a meter before and after `day` are
    independent; of two drifts on the same side, the longer contains the shorter.
    """
    of = np.array([meter for run in runs for meter in run.meters])
    part = np.repeat([np.clip((run.day - day) / run.per_days, -1.0, 1.0) for run in runs], 3)
    u = np.concatenate([run.drift[:, quantity] for run in runs])
    alike = (of[:, None] == of) & (np.sign(part)[:, None] == np.sign(part))
    return np.asarray(np.outer(u, u) * np.minimum.outer(np.abs(part), np.abs(part)) ** 2 * alike)


@dataclass(frozen=True)
class _Design:
    """The design of the meter comparison: N readings, one of each channel in each run.

    `cell` (N,) is the index of the pair of unit and channel; `meter_of` (N,) is the index of the meter. Only
    meters with the same `group` (M,) can be compared.
    """

    meters: tuple[str, ...]
    cell: Ints
    meter_of: Ints
    group: Ints

    @classmethod
    def of(cls, runs: Sequence[MeterRun]) -> _Design:
        meters = tuple(dict.fromkeys(meter for run in runs for meter in run.meters))
        meter_of = np.array([meters.index(meter) for run in runs for meter in run.meters])
        cells = [(run.unit, channel) for run in runs for channel in range(3)]
        numbers = {cell: k for k, cell in enumerate(dict.fromkeys(cells))}
        cell = np.array([numbers[one] for one in cells])
        count = len(meters) + len(numbers)
        links = sparse.coo_array((np.ones(len(cell)), (meter_of, len(meters) + cell)), shape=(count, count))
        label = csgraph.connected_components(links, directed=False)[1][: len(meters)]
        group = np.unique(label, return_inverse=True)[1]
        return cls(meters, cell, meter_of, np.asarray(group).ravel())

    @property
    def readings(self) -> int:
        return len(self.cell)

    @property
    def freedom(self) -> int:
        return self.readings - int(self.cell.max()) - 1 - int(contrasts_within(self.group).shape[1])

    def mean_length(self, logarithms: Floats) -> Floats:
        """Return the geometric mean of the row lengths in each reading's cell, V/g, (N,), from `logarithms`."""
        mean = np.bincount(self.cell, logarithms) / np.bincount(self.cell)
        return np.asarray(np.exp(mean[self.cell]))

    def fit(self, y: Floats, known: Floats) -> Contrasts:
        """Return the contrasts of the meters, with a variance between runs estimated by restricted likelihood."""
        cells = np.eye(int(self.cell.max()) + 1)[self.cell]
        basis = contrasts_within(self.group)
        X = np.concatenate([cells, np.eye(len(self.meters))[self.meter_of] @ basis], axis=1)
        between2, u_between2 = _beyond(y, X, known)

        def weighed(variance: float) -> tuple[Floats, Floats]:
            root = np.linalg.cholesky(known + variance * np.eye(len(y)))
            rows = linalg.solve_triangular(root, np.column_stack([X, y]), lower=True)
            normal = np.linalg.inv(rows[:, :-1].T @ rows[:, :-1])
            own = slice(cells.shape[1], None)
            return (normal @ (rows[:, :-1].T @ rows[:, -1]))[own], normal[own, own]

        found, covariance = weighed(between2)
        return Contrasts(
            basis @ found, basis @ covariance @ basis.T,
            self._freedom(lambda variance: basis @ weighed(variance)[1] @ basis.T, between2, u_between2),
            float(np.sqrt(between2)),
        )  # fmt: skip

    def _freedom(self, covariance: Callable[[float], Floats], variance: float, u_variance: float) -> Floats:
        """Return the degrees of freedom (M,) of differences from each group's first meter, by Satterthwaite."""
        step = 0.01 * variance
        here, slope = covariance(variance), (covariance(variance + step) - covariance(variance)) / step
        found = np.full(len(self.meters), np.inf)
        for b, group in enumerate(self.group.tolist()):
            a = int(np.flatnonzero(self.group == group)[0])
            if a != b:
                of = np.zeros(len(self.meters))
                of[[a, b]] = -1.0, 1.0
                size, by_variance = float(of @ here @ of), float(of @ slope @ of)
                found[b] = 2.0 * size**2 / max((by_variance * u_variance) ** 2, 1e-300)
        return found


def _beyond(y: Floats, X: Floats, known: Floats) -> tuple[float, float]:
    """Return the variance of each reading in excess of the covariance `known`, and its standard uncertainty.

    Restricted likelihood, with `X` as fixed effects, gives the variance; it is widened for its dof and never zero.
    """
    off = linalg.null_space(X.T)
    size, axes = np.linalg.eigh(off.T @ known @ off)
    left = axes.T @ (off.T @ y)
    unit = float(np.sqrt(np.mean(size)))
    size, left2 = np.asarray(size / unit**2), np.asarray((left / unit) ** 2)

    most = 3.0 * float(np.sqrt(left2.max())) + 1e-3
    low, high, theta = 0.0, most, 0.0
    for _ in range(3):
        thetas = np.linspace(low, high, 100) ** 2
        of: Floats = size + thetas[:, None]
        best = int(np.argmin(np.sum(np.log(of) + left2 / of, axis=1)))
        theta = float(thetas[best])
        low, high = np.sqrt(thetas[[max(best - 1, 0), min(best + 1, len(thetas) - 1)]]).tolist()
    u_theta = float(np.sum((size + theta) ** -2.0) / 2.0) ** -0.5
    counts = Variance("between runs", theta, u_theta, unit, held=False).u_next
    return counts**2, u_theta * unit**2
