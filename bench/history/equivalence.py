"""Degrees of equivalence of benches that measured the same units, in each number and in all jointly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Final

import numpy as np
from scipy import linalg, optimize, special, stats

from bench.base.arrays import Floats, Ints, u_of
from bench.base.languages import message
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.calibration.intrinsic import INTRINSIC
from bench.calibration.result import CalibrationError
from bench.history.comparison import Joint, Snapshot, joint_covariances, joint_of
from bench.history.measured import ComparedCalibrations, coded
from bench.model.geometry import COEFFICIENTS
from bench.stats import chi_square, holm

CONSISTENT_P: Final = 0.05
"""The least p-value at which values count as consistent with their stated uncertainties."""
WEIGHTED_MEAN: Final = "weighted mean"
MANDEL_PAULE: Final = "Mandel-Paule"
DERSIMONIAN_LAIRD: Final = "DerSimonian-Laird"
METHODS: Final = (WEIGHTED_MEAN, MANDEL_PAULE, DERSIMONIAN_LAIRD)


@dataclass(frozen=True)
class Participants:
    """Values `y` (n,) with their covariance (n, n), each of one unit on one bench.

    `unit` (n,) and `bench` (n,) are the indices of unit and bench.
    """

    y: Floats
    covariance: Floats
    unit: Ints
    bench: Ints

    @cached_property
    def Z_unit(self) -> Floats:  # noqa: N802 - the symbol of the field
        """The indicator matrix of units, (n, U)."""
        return np.eye(int(self.unit.max()) + 1)[self.unit]

    @cached_property
    def Z_bench(self) -> Floats:  # noqa: N802
        """The indicator matrix of benches, (n, B)."""
        return np.eye(int(self.bench.max()) + 1)[self.bench]

    def with_dark(self, dark: float) -> Floats:
        """Return the covariance (n, n) with an independent error of each bench added.

        `dark` is the standard deviation of this error.
        """
        return self.covariance + dark**2 * (self.Z_bench @ self.Z_bench.T)

    @cached_property
    def between_dof(self) -> int:
        """Degrees of freedom between benches: number of benches minus number of sets linked by common units."""
        both = np.linalg.matrix_rank(np.concatenate([self.Z_unit, self.Z_bench], axis=1))
        return int(both) - int(self.unit.max()) - 1

    @cached_property
    def between(self) -> Floats:
        """The matrix (n, n) of the quadratic form in `y` that measures differences between benches."""
        both = np.concatenate([self.Z_unit, self.Z_bench], axis=1)
        return _left(self.covariance, self.Z_unit) - _left(self.covariance, both)


def _left(V: Floats, X: Floats) -> Floats:
    """Return V^-1 minus its part in the column space of X (n, p), whose columns may be linearly dependent."""
    lower = linalg.cholesky(V, lower=True)
    whitened = linalg.solve_triangular(lower, X, lower=True)
    along, size, _ = np.linalg.svd(whitened, full_matrices=False)
    along = along[:, size > 1e-9 * size[0]]
    inverse = linalg.solve_triangular(lower, np.eye(len(V)) - along @ along.T, lower=True, trans="T")
    return np.asarray(linalg.solve_triangular(lower, inverse.T, lower=True, trans="T").T)


@dataclass(frozen=True)
class Equivalence:
    """The reference value of each unit and the degree of equivalence of each bench, for one coefficient.

    `reference` (U,) are the reference values, and `u_reference` (U,) their standard uncertainties. `degree`
    (B,) are the degrees of equivalence d, and `covariance` (B, B) is their covariance. `dark` is the dark
    uncertainty of benches (1 σ). The variance of d includes the dark uncertainty of all benches except the
    bench of d itself, whose stated u is kept. `chi2` with `dof` tests the stated uncertainties; `map` (B, n)
    maps `y` to d.
    """

    method: str
    reference: Floats
    u_reference: Floats
    degree: Floats
    covariance: Floats
    dark: float
    chi2: float
    dof: int
    map: Floats

    @property
    def p(self) -> float:
        """The p-value of `chi2` for the hypothesis that the stated uncertainties are correct."""
        return float(special.chdtrc(self.dof, self.chi2))

    @property
    def consistent(self) -> bool:
        """Whether the values agree with their stated uncertainties."""
        return self.p >= CONSISTENT_P

    @property
    def birge(self) -> float:
        """The Birge ratio: the root of the reduced chi-square."""
        return float(np.sqrt(self.chi2 / self.dof))

    @property
    def u_degree(self) -> Floats:
        """The standard uncertainties of the degrees of equivalence, (B,)."""
        return u_of(self.covariance)

    @property
    def en(self) -> Floats:
        """The E_n numbers |d|/U(d) with k = 2, (B,)."""
        return np.asarray(np.abs(self.degree) / (COVERAGE_FACTOR * self.u_degree))


def equivalence(of: Participants, method: str | None = None) -> Equivalence:
    """Return reference values and degrees of equivalence by one of `METHODS`; by default Cox's choice.

    Cox's choice is the weighted mean if the stated uncertainties pass the chi-square test, otherwise Mandel-Paule.
    Raises `CalibrationError` if no unit was measured on two benches.
    """
    if not of.between_dof:
        raise CalibrationError("no unit was measured on two benches; measure one on both to compare them")
    plain = _by(of, 0.0, WEIGHTED_MEAN)
    if method == WEIGHTED_MEAN or (method is None and plain.consistent):
        return plain
    dark = {None: mandel_paule, MANDEL_PAULE: mandel_paule, DERSIMONIAN_LAIRD: dersimonian_laird}[method](of)
    return _by(of, dark, method or MANDEL_PAULE)


def mandel_paule(of: Participants) -> float:
    """Return the dark uncertainty (>= 0) at which chi-square between benches equals its degrees of freedom."""

    excess = float(of.y @ of.between @ of.y) - of.between_dof
    if excess <= 0.0:
        return 0.0
    # In contrasts of the values, which no reference value changes, both covariances become diagonal: by how much a
    # dark uncertainty reduces chi-square is then a sum.
    contrasts = linalg.null_space(of.Z_unit.T)
    lower = linalg.cholesky(contrasts.T @ of.covariance @ contrasts, lower=True)
    whitened = linalg.solve_triangular(lower, contrasts.T @ np.column_stack([of.y, of.Z_bench]), lower=True)
    size, axes = linalg.eigh(whitened[:, 1:] @ whitened[:, 1:].T)
    squares = (axes.T @ whitened[:, 0]) ** 2

    def gap(variance: float) -> float:
        return excess - float(np.sum(squares * variance * size / (1.0 + variance * size)))

    high = dersimonian_laird(of) ** 2 or float(np.var(of.y))
    while gap(high) > 0.0:
        high *= 2.0
    return float(np.sqrt(optimize.brentq(gap, 0.0, high, xtol=1e-12 * high, rtol=1e-12)))


def dersimonian_laird(of: Participants) -> float:
    """Return the dark uncertainty by the method of moments; 0 if benches differ less than expected."""
    per_variance = float(np.sum((of.between @ of.Z_bench) * of.Z_bench))
    return float(np.sqrt(max(0.0, (float(of.y @ of.between @ of.y) - of.between_dof) / per_variance)))


def _by(of: Participants, dark: float, method: str) -> Equivalence:
    V = of.with_dark(dark)
    weighed = linalg.solve(V, of.Z_unit, assume_a="pos")
    u2 = np.asarray(np.linalg.inv(of.Z_unit.T @ weighed), dtype=np.float64)
    to_reference = u2 @ weighed.T
    n, benches = of.Z_bench.shape
    residual = np.eye(n) - of.Z_unit @ to_reference
    means = np.zeros((benches, n))
    for b in range(benches):
        own = np.flatnonzero(of.bench == b)
        w = linalg.solve(of.covariance[np.ix_(own, own)], np.ones(len(own)), assume_a="pos")
        means[b, own] = w / w.sum()
    degrees = means @ residual
    # the stated u of a bench itself is kept: the dark uncertainty applies to the other benches only
    own_part = degrees @ of.Z_bench
    covariance = degrees @ of.covariance @ degrees.T
    covariance += dark**2 * (own_part @ own_part.T)
    covariance[np.diag_indices(benches)] -= dark**2 * np.diag(own_part) ** 2
    plain = _left(of.covariance, of.Z_unit)
    return Equivalence(
        method, to_reference @ of.y, u_of(u2), degrees @ of.y, covariance, dark,
        # chi-square of equal values is zero, but rounding may make it negative
        max(float(of.y @ plain @ of.y), 0.0), n - of.Z_unit.shape[1], degrees,
    )  # fmt: skip


@dataclass(frozen=True)
class Pair:
    """The difference between two benches, first minus second, from the number `units` of common units.

    `map` (n,) maps `y` to the difference.
    """

    first: int
    second: int
    units: int
    difference: float
    u: float
    map: Floats

    @property
    def en(self) -> float:
        """The E_n number of the difference, k = 2."""
        return abs(self.difference) / (COVERAGE_FACTOR * self.u)


def pairs(of: Participants) -> tuple[Pair, ...]:
    """Return the difference between every two benches with common units, from these units alone."""
    found = []
    benches = int(of.bench.max()) + 1
    seen = [set(of.unit[of.bench == b].tolist()) for b in range(benches)]
    for i, j in combinations(range(benches), 2):
        common = sorted(seen[i] & seen[j])
        if not common:
            continue
        rows = np.flatnonzero(np.isin(of.unit, common) & np.isin(of.bench, (i, j)))
        _, unit = np.unique(of.unit[rows], return_inverse=True)
        columns = np.column_stack([np.eye(len(common))[unit], of.bench[rows] == i])
        weighed = linalg.solve(of.covariance[np.ix_(rows, rows)], columns, assume_a="pos")
        covariance = np.linalg.inv(columns.T @ weighed)
        to_difference = np.zeros(len(of.y))
        to_difference[rows] = covariance[-1] @ weighed.T
        u = float(np.sqrt(covariance[-1, -1]))
        found.append(Pair(i, j, len(common), float(to_difference @ of.y), u, to_difference))
    return tuple(found)


APART_P: Final = 0.05
"""Significance level of differences between benches, for all differences together."""


@dataclass(frozen=True)
class JointDifference:
    """A chi-square test of a vector of differences; `p_all_looks` is `p` after Holm's correction."""

    chi2: float
    dof: int
    p: float
    p_all_looks: float

    @property
    def apart(self) -> bool:
        """Whether the differences are significant."""
        return self.p_all_looks < APART_P


def together(
    differences: Floats, u: Floats, errors: Floats, of_errors: Floats
) -> tuple[JointDifference, ...]:
    """Return the chi-square tests of m vectors of differences (m, p) with standard uncertainties `u` (m, p).

    `u` combines two parts in quadrature: `of_errors` (m, p), due to calibration errors, and a rest, such as the
    dark uncertainty. The correlations of the first part are those of the covariances `errors` (m, p, p). The rest
    counts as uncorrelated among the p numbers.
    """
    chi2 = []
    for d, whole, covariance, own in zip(differences, u, errors, of_errors, strict=True):
        scale = u_of(covariance)
        scaled = covariance / np.outer(scale, scale) * np.outer(own, own)
        scaled[np.diag_indices(len(d))] += np.maximum(whole**2 - own**2, 0.0)
        chi2.append(float(d / whole @ np.linalg.solve(scaled / np.outer(whole, whole), d / whole)))
    dof = differences.shape[1]
    p = np.asarray(special.chdtrc(dof, np.array(chi2)), dtype=np.float64)
    rows: Sequence[tuple[float, float, float]] = list(zip(chi2, p.tolist(), holm(p).tolist(), strict=True))
    return tuple(JointDifference(one, dof, alone, looks) for one, alone, looks in rows)


@dataclass(frozen=True)
class BenchesIn:
    """The comparison of benches in m numbers `names`: the nine intrinsic numbers or the twelve coefficients.

    `found` has the degrees of equivalence and `pairs` the differences between benches, by number. `together` tests
    the degrees of equivalence of each bench in all numbers jointly, `pairs_together` the differences of each pair.
    """

    names: tuple[str, ...]
    found: tuple[Equivalence, ...]
    pairs: tuple[tuple[Pair, ...], ...]
    together: tuple[JointDifference, ...]
    pairs_together: tuple[JointDifference, ...]

    def apart(self, benches: tuple[str, ...]) -> tuple[tuple[str, str, float], ...]:
        """Return bench, number and E_n of each degree of equivalence with E_n > 1, the largest first."""
        rows = [
            (bench, name, float(en))
            for name, one in zip(self.names, self.found, strict=True)
            for bench, en in zip(benches, one.en, strict=True)
            if en > 1.0
        ]
        return tuple(sorted(rows, key=lambda row: -row[2]))


@dataclass(frozen=True)
class BenchComparison:
    """The comparison of benches with one another, in the `nine` intrinsic numbers and in the `twelve` coefficients.

    `benches` and `units` are the participants; `alone` are benches that share no unit with another.
    """

    benches: tuple[str, ...]
    units: tuple[str, ...]
    alone: tuple[str, ...]
    nine: BenchesIn
    twelve: BenchesIn
    calibrations: int
    signal: str
    simulated: bool
    notes: tuple[str, ...]


def compare_benches(
    measured: ComparedCalibrations, there: Sequence[Snapshot], method: str | None = None
) -> BenchComparison:
    """Return the comparison of benches by their calibrations of common units.

    `there` holds the snapshots of the n calibrations, per g of `STANDARD_GRAVITY`. The snapshots supply the errors
    that calibrations share (of the meters, and K2 and K3 of a block). Raises `CalibrationError` if no common unit
    links the benches.
    """
    (units, unit), (benches, bench) = coded(measured.unit), coded(measured.bench)
    days = int((measured.when.max() - measured.when.min()) / np.timedelta64(1, "D"))
    drifted = message(
        f"over {days} days: changes of a unit between its calibrations appear as differences of benches"
    )
    return BenchComparison(
        benches=tuple(benches.tolist()),
        units=tuple(units.tolist()),
        alone=(),
        nine=_compared(INTRINSIC, [one.in_nine() for one in there], unit, bench, method),
        twelve=_compared(COEFFICIENTS, there, unit, bench, method),
        calibrations=len(measured),
        signal=measured.signal,
        simulated=measured.simulated,
        notes=(drifted,) if days else (),
    )


def _compared(
    names: tuple[str, ...], there: Sequence[Snapshot], unit: Ints, bench: Ints, method: str | None
) -> BenchesIn:
    covariances, joint = joint_covariances(there), joint_of(there)
    values = np.array([one.vector for one in there])
    taking = [Participants(values[:, k], covariances[k], unit, bench) for k in range(len(names))]
    found = tuple(equivalence(one, method) for one in taking)
    by_pair = tuple(pairs(one) for one in taking)
    return BenchesIn(
        names, found, by_pair, _benches_together(taking, found, joint), _pairs_together(by_pair, joint)
    )


def _benches_together(
    taking: Sequence[Participants], found: Sequence[Equivalence], joint: Joint
) -> tuple[JointDifference, ...]:
    """Return, for each bench, a joint test of its degrees of equivalence over all coefficients."""
    degrees = np.stack([one.degree for one in found], axis=1)
    u = np.stack([one.u_degree for one in found], axis=1)
    maps = np.stack([one.map for one in found], axis=1)
    own = np.stack(
        [u_of(one.map @ of.covariance @ one.map.T) for of, one in zip(taking, found, strict=True)], axis=1
    )
    return together(degrees, u, np.array([joint.of_sums(one) for one in maps]), own)


def _pairs_together(by_coefficient: Sequence[Sequence[Pair]], joint: Joint) -> tuple[JointDifference, ...]:
    """Return, for each pair of benches, a joint test of its differences over all coefficients."""
    each = list(zip(*by_coefficient, strict=True))
    u = np.array([[pair.u for pair in one] for one in each])
    errors = np.array([joint.of_sums(np.array([pair.map for pair in one])) for one in each])
    return together(np.array([[pair.difference for pair in one] for one in each]), u, errors, u)


# --- one unit that travels between laboratories -------------------------------------------------------


LEAST_LABORATORIES: Final = 3


@dataclass(frozen=True)
class LaboratoryJudged:
    """A laboratory's m numbers compared with the Mandel-Paule consensus of all other laboratories.

    `difference` (m,) is the laboratory's value minus the consensus. Its standard uncertainty `u` (m,) combines the
    laboratory's own u with the u of the consensus, which includes the others' `dark` uncertainty (m,).
    `chi2` tests all m numbers jointly; `p_all_looks` is its p-value after Holm's correction over laboratories.
    """

    difference: Floats
    u: Floats
    dark: Floats
    chi2: float
    p: float
    p_all_looks: float

    @property
    def en(self) -> Floats:
        """The E_n numbers of the differences, k = 2, (m,)."""
        return np.asarray(np.abs(self.difference) / (COVERAGE_FACTOR * self.u))

    @property
    def off(self) -> bool:
        """Whether the laboratory differs significantly from the consensus of the others."""
        return self.p_all_looks < APART_P


@dataclass(frozen=True)
class Drift:
    """The `change` (k,) of a travelling unit between two measurements with the same instruments, in k numbers.

    Its `covariance` (k, k) has `dof` degrees of freedom, infinite if the covariance was not estimated from repeats.
    """

    names: tuple[str, ...]
    change: Floats
    covariance: Floats
    dof: float = np.inf

    @property
    def p(self) -> float:
        """The p-value of the joint test that nothing changed: chi-square, or F if `dof` is finite."""
        chi2, k = chi_square(self.change, self.covariance), len(self.change)
        return float(stats.chi2.sf(chi2, k) if np.isinf(self.dof) else stats.f.sf(chi2 / k, k, self.dof))


def transport_dark(drifts: Sequence[Drift], names: Sequence[str]) -> Floats:
    """Return the standard deviation (m,) that travel adds to each of a unit's numbers `names`, beyond u.

    It is the Mandel-Paule solution for changes with the variance u^2 + 2 dark^2, and 0 for changes within u. If no
    change in `drifts` is significant after Holm's correction, the result is 0 for all numbers: the scatter of a few
    changes must not widen u by chance.
    """
    found = np.zeros(len(names))
    changed = any(holm(np.array([drift.p for drift in drifts])) < APART_P) if drifts else False
    for k, name in enumerate(names if changed else ()):
        of = [(d.names.index(name), d) for d in drifts if name in d.names]
        if of:
            y, halves = np.zeros(2 * len(of)), np.repeat([d.covariance[i, i] / 2.0 for i, d in of], 2)
            y[1::2] = [d.change[i] for i, d in of]
            both, each = np.repeat(np.arange(len(of)), 2), np.arange(len(y))
            found[k] = mandel_paule(Participants(y, np.diag(halves), both, each))
    return found


def against_others(
    values: Floats, covariances: Floats, transport: Floats | None = None
) -> tuple[LaboratoryJudged, ...]:
    """Compare each of n laboratories with the Mandel-Paule consensus of all other laboratories.

    `values` (n, m) have the `covariances` (n, m, m) or, if laboratories share errors, (n, m, n, m). `transport`
    (m,) is the standard deviation that travel adds to the unit's numbers (`transport_dark`); it widens u. Raises
    `CalibrationError` for fewer than three laboratories, because two cannot show which one deviates.
    """
    n, m = values.shape
    whole = between_laboratories(covariances, np.zeros(m) if transport is None else transport)
    if n < LEAST_LABORATORIES:
        raise CalibrationError(
            f"{n} laboratories are too few to say which is off; give results of {LEAST_LABORATORIES} or more"
        )
    found = []
    for own in range(n):
        rest = np.arange(n) != own
        weights, dark = consensus_weights(values[rest], whole[rest][:, :, rest])
        signed = np.insert(-weights, own, 1.0, axis=0)
        difference = np.sum(signed * values, axis=0)
        joint = covariance_of_sum(signed, whole) + np.diag(dark**2 * np.sum(weights**2, axis=0))
        found.append((difference, u_of(joint), dark, chi_square(difference, joint)))
    p = np.asarray(special.chdtrc(m, np.array([chi2 for *_, chi2 in found])))
    return tuple(
        LaboratoryJudged(*one, alone, looks)
        for one, alone, looks in zip(found, p.tolist(), holm(p).tolist(), strict=True)
    )


def between_laboratories(covariances: Floats, transport: Floats) -> Floats:
    """Return the covariance (n, m, n, m) of n laboratories, widened by `transport`; see `against_others`."""
    n, m = covariances.shape[:2]
    own, whole = np.arange(n), np.zeros((n, m, n, m))
    if covariances.ndim == whole.ndim:
        whole += covariances
    else:
        whole[own, :, own] = covariances
    whole[own, :, own] += np.diag(transport**2)
    return whole


def covariance_of_sum(weights: Floats, whole: Floats) -> Floats:
    """Return the covariance (m, m) of sums with the `weights` (n, m) of values with the covariance `whole`."""
    return np.asarray(np.einsum("ia,iajb,jb->ab", weights, whole, weights))


def consensus_weights(values: Floats, whole: Floats) -> tuple[Floats, Floats]:
    """Return the Mandel-Paule weights (n, m) of n laboratories' numbers, and their dark uncertainty (m,).

    `whole` (n, m, n, m) is the covariance of the `values` (n, m).
    """
    n, m = values.shape
    one_unit, own = np.zeros(n, dtype=np.int64), np.arange(n)
    dark = np.array(
        [mandel_paule(Participants(values[:, k], whole[:, k, :, k], one_unit, own)) for k in range(m)]
    )
    weights = 1.0 / (np.diagonal(whole.reshape(n * m, n * m)).reshape(n, m) + dark**2)
    return weights / weights.sum(axis=0), dark
