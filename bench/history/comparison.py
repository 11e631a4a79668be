"""Comparison of calibrations of one block: E_n numbers, joint chi-square tests, shared errors.

Calibrations are compared in the nine numbers that do not depend on the mounting, whose joint test decides, and in
the twelve coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from itertools import combinations
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask, u_of
from bench.base.languages import message
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.calibration.intrinsic import INTRINSIC
from bench.calibration.noise import METERS_DRIFT, ONE_TEMPERATURE_K, drifted
from bench.calibration.result import CalibrationError, through
from bench.history.measured import STANDARD_GRAVITY, nine_of, of_gravity, to_gravity
from bench.model.geometry import COEFFICIENTS
from bench.stats import chi_square, holm

CHANGED_P: Final = 0.05
"""Significance level of a change: of the nine jointly, and of single numbers after Holm's correction."""
LEAST_FOR_DRIFT: Final = 3
LEAST_SPAN: Final = timedelta(days=1)
"""Least time span of calibrations for a drift; over a shorter time they show only scatter."""
MOST_CONDITION: Final = 1e12
ALIKE: Final = 0.01
"""Two calibrations whose coefficients all agree within this fraction of u are not independent.

Independent calibrations agree so closely once in 10^25 times.
"""
SECONDS_PER_YEAR: Final = 365.25 * 86400.0


@dataclass(frozen=True)
class Snapshot:
    """A dated calibration: `vector` (12,) in unit/g with g = `g_m_s2`, and its `covariance` (12, 12).

    `block` is the type and serial number of the block, empty if not recorded. `same_meters` (12, 12) is the
    covariance without the part that cancels if the same meters measure again, None if there is no such part;
    `meters` are the meters' identities, empty if unknown. Each column of `block_terms` (12, q) is the error due to
    an error of one standard uncertainty in the block's nonlinearity K2 or K3; the error is the same in every
    calibration of the block. `wander` (3,) is the rms deviation of each bias from its mean during the run. `dof` is
    the smallest effective degrees of freedom of the nine intrinsic numbers. `temperature_c` is the temperature at
    which the coefficients hold, °C, NaN if unknown.

    `gravity_u` is the relative standard uncertainty of `g_m_s2`. The `covariance` includes it only after `per` has
    converted the scale factors to another g. `of_gravity` (12,) is then the error due to one standard uncertainty
    of g, the same in all calibrations at the `place` with that g. A snapshot in the nine intrinsic numbers has
    arrays of nine instead of twelve; the biases come last in both.
    """

    name: str
    when: datetime | None
    block: str
    unit: str
    g_m_s2: float
    vector: Floats
    covariance: Floats
    simulated: bool = False
    same_meters: Floats | None = None
    meters: tuple[str, ...] = ()
    block_terms: Floats | None = None
    wander: Floats | None = None
    dof: float = np.inf
    temperature_c: float = np.nan
    gravity_u: float = 0.0
    of_gravity: Floats | None = None
    place: float = np.nan

    def per(self, g_m_s2: float, gravity_u: float = 0.0) -> Snapshot:
        """Return the snapshot with scale factors per g of `g_m_s2` (m/s²), which has the relative u `gravity_u`.

        The covariance then includes the errors of both values of g, which all scale factors share. If `g_m_s2` is
        the g of the snapshot, as for calibrations in one place, the snapshot is returned unchanged.
        """
        return self if g_m_s2 == self.g_m_s2 else self._elsewhere(g_m_s2, gravity_u)

    def per_standard_g(self) -> Snapshot:
        """Return the snapshot with its scale factors in unit/g for standard g, which is exact everywhere."""
        return self._elsewhere(STANDARD_GRAVITY, 0.0)

    def _elsewhere(self, g_m_s2: float, gravity_u: float) -> Snapshot:
        factor = to_gravity(self.g_m_s2, g_m_s2)
        both, vector = np.outer(factor, factor), self.vector * factor
        of_g = of_gravity(vector, np.hypot(self.gravity_u, gravity_u))
        error = np.outer(of_g, of_g)
        return replace(
            self,
            g_m_s2=g_m_s2,
            vector=vector,
            covariance=self.covariance * both + error,
            same_meters=None if self.same_meters is None else self.same_meters * both + error,
            gravity_u=gravity_u,
            of_gravity=of_g,
            place=self.g_m_s2,
            block_terms=None if self.block_terms is None else self.block_terms * factor[:, None],
        )

    def in_nine(self) -> Snapshot:
        """Return the snapshot in the nine intrinsic numbers, linearised at the K of this snapshot.

        Raises `CalibrationError` if they are undefined, as for a block with a dead channel.
        """
        own = nine_of(self.name, self.vector, self.covariance)
        J = own.jacobian
        return replace(
            self,
            vector=own.values,
            covariance=own.covariance,
            same_meters=None if self.same_meters is None else through(J, self.same_meters),
            block_terms=None if self.block_terms is None else J @ self.block_terms,
            wander=None if self.wander is None else np.diag(J[6:, 9:]) * self.wander,
            of_gravity=None if self.of_gravity is None else J @ self.of_gravity,
        )

    @property
    def without_meters(self) -> Floats:
        """The covariance without the part that cancels if the same meters measure again, (12, 12)."""
        return self.covariance if self.same_meters is None else self.same_meters

    @property
    def _wander_from_start(self) -> Floats:
        """The covariance (12, 12) of the change of the biases from the start of the run to their mean.

        For a random walk with rms s about its mean over a run, this change has the standard deviation sqrt(2) s.
        """
        between = np.zeros(len(self.vector))
        if self.wander is not None:
            between[-3:] = 2.0 * self.wander**2
        return np.diag(between)

    def against(self, first: Snapshot) -> Snapshot:
        """Return the snapshot with the covariance that applies to a comparison with the calibration `first`.

        The covariance of the difference is the sum of the covariances of `self.against(first)` and
        `first.against(first)`. The errors of the same meters in gain and offset cancel if both calibrations are
        within a day. They cancel less as more time passes, and not at all after `METERS_DRIFT`. Errors of different
        or unidentified meters never cancel. Errors due to K2 and K3 of the same block cancel where they are equal.
        """
        theirs = _of_block(first.block_terms, len(self.vector))
        own = self.without_meters + self._wander_from_start
        if self is first:
            return replace(self, covariance=own - theirs)
        part = _drifted(first, self)
        meters = (self.covariance - self.without_meters) + (first.covariance - first.without_meters)
        block = theirs
        mine, other = self.block_terms, first.block_terms
        if mine is not None and other is not None and (self.block, mine.shape) == (first.block, other.shape):
            block = _of_block(mine - other, len(mine)) - _of_block(mine, len(mine))
        return replace(self, covariance=own + part * meters + block)


def _of_block(terms: Floats | None, size: int) -> Floats:
    """Return the covariance (size, size) due to the columns of `terms` (size, q); zero for None."""
    return np.zeros((size, size)) if terms is None else np.asarray(terms @ terms.T)


@dataclass(frozen=True)
class Changes:
    """The changes of a later calibration relative to the first, in m numbers.

    `difference` (m,) are the changes, `u` (m,) their standard uncertainties, and `en` (m,) their E_n numbers.
    `p_all_looks` (m,) are two-sided p-values after Holm's correction for all numbers and calibrations compared.
    `chi2` with m degrees of freedom and its `p` test all numbers jointly.
    """

    later: Snapshot
    difference: Floats
    u: Floats
    en: Floats
    p_all_looks: Floats
    chi2: float
    p: float

    @property
    def changed(self) -> Mask:
        """Which numbers changed significantly, (m,)."""
        return self.p_all_looks < CHANGED_P


@dataclass(frozen=True)
class DriftLines:
    """Straight lines fitted to all coefficients over time by generalised least squares.

    `per_year` (12,) are the slopes, `u` (12,) their standard uncertainties, and `p_all_looks` (12,) their
    p-values after Holm's correction. `chi2` with `dof` degrees of freedom and its `p` test the residuals.
    """

    per_year: Floats
    u: Floats
    p_all_looks: Floats
    chi2: float
    dof: int
    p: float

    @property
    def shown(self) -> Mask:
        """Which coefficients drift significantly, (12,)."""
        return self.p_all_looks < CHANGED_P


@dataclass(frozen=True)
class InNumbers:
    """The changes of all later calibrations from the first, in the numbers `names`.

    The numbers are the nine intrinsic ones or the twelve coefficients. `p_constant` is the p-value of the
    hypothesis that all stayed constant. `drift` is None if dates are missing, the calibrations are too few, or
    their time span is too short.
    """

    names: tuple[str, ...]
    first: Snapshot
    changes: tuple[Changes, ...]
    p_constant: float
    drift: DriftLines | None

    @property
    def shown(self) -> tuple[str, ...]:
        """The names of the numbers that changed significantly in any calibration, each number tested alone."""
        some = np.any([one.changed for one in self.changes], axis=0)
        return tuple(np.array(self.names)[some].tolist())


@dataclass(frozen=True)
class Comparison:
    """A comparison in the `nine` intrinsic numbers, whose joint test decides, and in the `twelve` coefficients.

    `twelve` is None if a calibration comes from free positions alone, which leave the block's orientation open.
    """

    nine: InNumbers
    twelve: InNumbers | None
    notes: tuple[str, ...]

    @property
    def changed(self) -> bool:
        """Whether the nine intrinsic numbers, tested jointly, changed significantly."""
        return self.nine.p_constant < CHANGED_P


def compare(snapshots: Sequence[Snapshot]) -> Comparison:
    """Compare calibrations of one block; the reference is the earliest, or the first if any date is missing.

    Scale factors are converted to the local gravity of the reference. Raises `CalibrationError` if there are fewer
    than two calibrations, if their units differ, or for a singular covariance. A calibration from free positions
    alone may have a singular covariance; then only the nine intrinsic numbers are compared.
    """
    if len(snapshots) < 2:
        raise CalibrationError("a comparison needs two or more calibrations; name another run or result")
    units = sorted({snapshot.unit for snapshot in snapshots})
    if len(units) > 1:
        listed = ", ".join(f"{snapshot.name} in {snapshot.unit}" for snapshot in snapshots)
        raise CalibrationError(
            f"the coefficients are in different units ({listed}); compare calibrations whose "
            "signals have one unit"
        )
    free = [snapshot.name for snapshot in snapshots if _of_free_positions(snapshot)]
    for snapshot in snapshots:
        if snapshot.name not in free:
            _require_regular(snapshot)
    dates = [snapshot.when for snapshot in snapshots if snapshot.when is not None]
    dated = len(dates) == len(snapshots)
    ordered = list(snapshots)
    if dated:
        ordered = [snapshots[k] for k in np.argsort([d.timestamp() for d in dates], kind="stable")]
    notes = _notes(ordered, dated=dated)
    if free:
        alone = message(f"{', '.join(free)}: from free positions alone, so that only the nine are compared")
        notes = (alone, *notes)
    there = [snapshot.per(ordered[0].g_m_s2, ordered[0].gravity_u) for snapshot in ordered]
    drifts = dated and len(dates) >= LEAST_FOR_DRIFT and max(dates) - min(dates) >= LEAST_SPAN
    when = dates if drifts else []
    nine = _compared(INTRINSIC, [snapshot.in_nine() for snapshot in there], when)
    return Comparison(nine, None if free else _compared(COEFFICIENTS, there, when), notes)


def _compared(names: tuple[str, ...], there: Sequence[Snapshot], dates: Sequence[datetime]) -> InNumbers:
    """Compare the snapshots `there` with the first in the numbers `names`; no drift without `dates`."""
    alike = [snapshot.against(there[0]) for snapshot in there]
    differences = [later.vector - alike[0].vector for later in alike[1:]]
    u = [np.sqrt(np.diag(alike[0].covariance) + np.diag(later.covariance)) for later in alike[1:]]
    p = holm(
        np.concatenate(
            [special.erfc(np.abs(d) / s / np.sqrt(2)) for d, s in zip(differences, u, strict=True)]
        )
    )
    changes = tuple(
        _changes(alike[0], later, d, s, own)
        for later, d, s, own in zip(alike[1:], differences, u, p.reshape(-1, len(names)), strict=True)
    )
    since = _SinceFirst.of(there)
    return InNumbers(names, alike[0], changes, since.p_constant, since.drift(dates) if dates else None)


def _of_free_positions(snapshot: Snapshot) -> bool:
    """Return whether K is upper triangular by convention, as from free positions alone."""
    below = [COEFFICIENTS.index(name) for name in ("Kyx", "Kzx", "Kzy")]
    return not np.any(snapshot.vector[below]) and not np.any(np.diag(snapshot.covariance)[below])


def _changes(first: Snapshot, later: Snapshot, difference: Floats, u: Floats, p: Floats) -> Changes:
    en = np.abs(difference) / (COVERAGE_FACTOR * u)
    chi2 = chi_square(difference, first.covariance + later.covariance)
    joint = _p_of(chi2, len(difference), min(first.dof, later.dof))
    return Changes(later, difference, u, en, p, chi2, joint)


def _p_of(chi2: float, count: int, dof: float) -> float:
    """Return the p-value of the chi-square `chi2` of `count` numbers whose u has `dof` degrees of freedom.

    For a finite `dof`, chi2/count follows the F distribution.
    """
    if np.isinf(dof):
        return float(special.chdtrc(count, chi2))
    return float(special.fdtrc(count, dof, chi2 / count))


def _require_regular(snapshot: Snapshot) -> None:
    """Raise `CalibrationError` for a singular covariance: a coefficient was fixed or depends on others."""
    u = u_of(snapshot.covariance)
    if not np.all(u > 0) or np.linalg.cond(snapshot.covariance / np.outer(u, u)) > MOST_CONDITION:
        raise CalibrationError(
            f"{snapshot.name}: the covariance is singular, so not all twelve coefficients were found from "
            "readings; calibrate in installations of known orientation"
        )


@dataclass(frozen=True)
class _SinceFirst:
    """The differences (n - 1, m) of all later calibrations from the first, with their joint covariance.

    Calibrations made within a few days of one another share the errors of their meters, also long after the first.
    `dof` is the smallest of the calibrations' degrees of freedom.
    """

    difference: Floats
    covariance: Floats
    dof: float

    @classmethod
    def of(cls, snapshots: Sequence[Snapshot]) -> _SinceFirst:
        n, count = len(snapshots), len(snapshots[0].vector)
        whole = joint_of(snapshots).whole(np.array([s._wander_from_start for s in snapshots]))
        change = np.kron(np.hstack([-np.ones((n - 1, 1)), np.eye(n - 1)]), np.eye(count))
        difference = np.array([s.vector - snapshots[0].vector for s in snapshots[1:]])
        return cls(difference, change @ whole @ change.T, min(s.dof for s in snapshots))

    @property
    def p_constant(self) -> float:
        """The p-value of the hypothesis that all calibrations have the same true coefficients."""
        chi2 = chi_square(self.difference.ravel(), self.covariance)
        return _p_of(chi2, self.difference.size, self.dof)

    def drift(self, dates: Sequence[datetime]) -> DriftLines:
        """Return straight lines fitted by generalised least squares to all numbers with their covariance."""
        seconds = np.sort([date.timestamp() for date in dates])
        years = (seconds[1:] - seconds[0]) / SECONDS_PER_YEAR
        scale = 1.0 / u_of(self.covariance)
        count = self.difference.shape[1]
        design = np.kron(years[:, None], np.eye(count)) * scale[:, None]
        weighted = np.linalg.solve(self.covariance * np.outer(scale, scale), design)
        covariance = np.linalg.inv(design.T @ weighted)
        slope, u = covariance @ (weighted.T @ (self.difference.ravel() * scale)), u_of(covariance)
        chi2 = chi_square(self.difference.ravel() - np.outer(years, slope).ravel(), self.covariance)
        dof = self.difference.size - count
        p = holm(special.erfc(np.abs(slope) / u / np.sqrt(2)))
        return DriftLines(slope, u, p, chi2, dof, float(special.chdtrc(dof, chi2)))


def _notes(snapshots: Sequence[Snapshot], *, dated: bool) -> tuple[str, ...]:
    notes = []
    blocks = sorted({snapshot.block for snapshot in snapshots if snapshot.block})
    if len(blocks) > 1:
        notes.append(message(f"THESE ARE DIFFERENT BLOCKS, as recorded: {', '.join(blocks)}"))
    elif any(not snapshot.block for snapshot in snapshots):
        notes.append(message("not every result names its block; they are assumed to be of one block"))
    if not dated:
        notes.append(
            message(
                "not every calibration has a date: the first one is the reference, and no drift is computed"
            )
        )
    if any(_one_and_the_same(a, b) for a, b in combinations(snapshots, 2)):
        notes.append(
            message(
                "two of these calibrations agree within a hundredth of their uncertainty; check whether both "
                "come from the same readings"
            )
        )
    if len({snapshot.simulated for snapshot in snapshots}) > 1:
        notes.append(message("some of these calibrations are of simulated instruments, some of real ones"))
    known = sorted({round(s.temperature_c, 1) for s in snapshots if np.isfinite(s.temperature_c)})
    if known and known[-1] - known[0] > ONE_TEMPERATURE_K:
        notes.append(
            message(
                f"the block was at {', '.join(f'{at:g}' for at in known)} °C: u leaves its temperature "
                "coefficients out, so a change may be due to the temperature"
            )
        )
    others = sorted({s.g_m_s2 for s in snapshots if s.g_m_s2 != snapshots[0].g_m_s2})
    if others:
        listed = ", ".join(f"{g:.6g}" for g in others)
        notes.append(
            message(
                f"local gravity differs ({snapshots[0].g_m_s2:.6g} m/s² here, {listed} elsewhere): scale "
                "factors are converted to the first one's gravity, and u includes the stated u of both"
            )
        )
    notes.append(_on_meters(snapshots))
    return tuple(notes)


def _on_meters(snapshots: Sequence[Snapshot]) -> str:
    bare = [snapshot.name for snapshot in snapshots if snapshot.same_meters is None]
    if bare:
        return message(
            f"{', '.join(bare)}: its uncertainty excludes errors of the meters; if the meters differ, their "
            "errors appear as a change"
        )
    parts = [_drifted(snapshots[0], later) for later in snapshots[1:]]
    if max(parts) == 0.0:
        return message(
            "the same meters measured on the same day (by identity and address): their gain and offset "
            "cancel, and the uncertainty excludes them"
        )
    if all(snapshot.meters == snapshots[0].meters != () for snapshot in snapshots):
        return message(
            "the same meters measured (by identity and address): the uncertainty includes the drift of "
            f"their gain and offset, all of it after {METERS_DRIFT.days} days"
        )
    return message("the meters may differ: every uncertainty includes their gain and offset")


def _drifted(first: Snapshot, later: Snapshot) -> float:
    """Return the largest possible difference of the meters' errors between two calibrations.

    It is stated as a fraction, 0 to 1, of the meters' limits.
    """
    return drifted((first.meters, first.when), (later.meters, later.when))


def _one_and_the_same(a: Snapshot, b: Snapshot) -> bool:
    u = np.sqrt(np.diag(a.covariance) + np.diag(b.covariance))
    return bool(np.all(np.abs(a.vector - b.vector) <= ALIKE * u))


SECONDS_PER_DAY: Final = 86400.0


def joint_covariances(snapshots: Sequence[Snapshot]) -> Floats:
    """Return, for each of m numbers, the covariance between n calibrations, (m, n, n).

    Calibrations with the same meters share the errors of their gains and offsets: less as time passes, and none
    from `METERS_DRIFT` on. Calibrations of the same block share the errors due to its K2 and K3. Calibrations at
    one place share the error of g. All scale factors must be per the same g.
    """
    n = len(snapshots)
    found = np.zeros((len(snapshots[0].vector), n, n))
    meters = np.sqrt(np.maximum([np.diag(s.covariance - s.without_meters) for s in snapshots], 0.0))  # (n, m)
    for i, first in enumerate(snapshots):
        found[:, i, i] = np.diag(first.covariance)
        for j in range(i):
            other = snapshots[j]
            alike = _meter_correlation(first, other) * meters[i] * meters[j]
            alike += _shared_block_terms(first, other) + _shared_gravity(first, other)
            found[:, i, j] = found[:, j, i] = alike
    return found


@dataclass(frozen=True)
class Joint:
    """The joint covariance of all twelve coefficients (or nine intrinsic numbers) of n calibrations, in parts.

    `own` (n, 12, 12) is the independent part of each calibration. `meters` (n, 12, 12) are square roots of the
    covariances due to the meters; `alike` (n, n) is the correlation of these errors between calibrations. `terms`
    (n, 12, q) are the errors due to K2 and K3, shared by all calibrations with the same block index in `block`
    (n,). `gravity` (n, 12, 1) are the errors due to g, shared by all calibrations with the same index in `place`
    (n,).
    """

    own: Floats
    meters: Floats
    alike: Floats
    terms: Floats
    block: Ints
    gravity: Floats
    place: Ints

    def whole(self, more: Floats) -> Floats:
        """Return the covariance (12 n, 12 n) of all calibrations; `more` (n, 12, 12) adds to `own`."""
        n, size, _ = self.meters.shape
        found = np.einsum("ij,iab,jcb->iajc", self.alike, self.meters, self.meters, optimize=True)
        for errors, of in ((self.terms, self.block), (self.gravity, self.place)):
            here = (of[:, None] == of).astype(np.float64)
            found += np.einsum("ij,iaq,jcq->iajc", here, errors, errors, optimize=True)
        found[np.arange(n), :, np.arange(n)] += self.own + more
        return np.asarray(found.reshape(n * size, n * size))

    def of_sums(self, weights: Floats) -> Floats:
        """Return the covariance (12, 12) of weighted sums over calibrations.

        `weights` (12, n) has a row for each coefficient.
        """
        found = np.einsum("kn,ln,nkl->kl", weights, weights, self.own, optimize=True)
        meters = weights.T[:, :, None] * self.meters
        n, size, _ = meters.shape
        mixed = (self.alike @ meters.reshape(n, -1)).reshape(n, size, -1)
        found += np.einsum("nka,nla->kl", meters, mixed, optimize=True)
        for errors, of in ((self.terms, self.block), (self.gravity, self.place)):
            for one in np.unique(of):
                here = of == one
                summed = np.einsum("kn,nkq->kq", weights[:, here], errors[here], optimize=True)
                found += summed @ summed.T
        return np.asarray(0.5 * (found + found.T))


def joint_of(snapshots: Sequence[Snapshot]) -> Joint:
    """Return the joint covariance of n calibrations over all twelve coefficients; see `joint_covariances`."""
    size = len(snapshots[0].vector)
    meters = np.array([s.covariance - s.without_meters for s in snapshots])
    level, along = np.linalg.eigh(meters)
    roots = (along * np.sqrt(np.maximum(level, 0.0))[:, None, :]) @ along.swapaxes(1, 2)
    none = np.zeros((size, 0))
    listed = [none if s.block_terms is None else s.block_terms for s in snapshots]
    most = max(one.shape[1] for one in listed)
    terms = np.array([np.pad(one, ((0, 0), (0, most - one.shape[1]))) for one in listed])
    names: dict[tuple[str, int], int] = {}
    block = [
        names.setdefault((s.block, one.shape[1]), len(names))
        for s, one in zip(snapshots, listed, strict=True)
    ]
    alike = np.array([[1.0 if a is b else _meter_correlation(a, b) for b in snapshots] for a in snapshots])
    still = np.zeros(size)
    gravity = np.array([still if s.of_gravity is None else s.of_gravity for s in snapshots])[:, :, None]
    _, place = np.unique([s.place for s in snapshots], return_inverse=True)
    own = np.array([s.without_meters for s in snapshots])
    own = own - terms @ terms.swapaxes(1, 2) - gravity @ gravity.swapaxes(1, 2)
    return Joint(own, roots, alike, terms, np.array(block, dtype=np.int64), gravity, place)


def _meter_correlation(first: Snapshot, other: Snapshot) -> float:
    """Return the correlation of the meters' errors after whole days: 1 within a day, 0 for different meters."""
    if not first.meters or first.meters != other.meters or first.when is None or other.when is None:
        return 0.0
    apart = abs(_day(first.when) - _day(other.when))
    return max(0.0, 1.0 - apart / METERS_DRIFT.days)


def _day(when: datetime) -> float:
    return float(np.floor(when.timestamp() / SECONDS_PER_DAY))


def _shared_block_terms(first: Snapshot, other: Snapshot) -> Floats:
    mine, theirs = first.block_terms, other.block_terms
    if mine is None or theirs is None or (first.block, mine.shape) != (other.block, theirs.shape):
        return np.zeros(len(first.vector))
    return np.asarray(np.sum(mine * theirs, axis=1))


def _shared_gravity(first: Snapshot, other: Snapshot) -> Floats:
    if first.of_gravity is None or other.of_gravity is None or first.place != other.place:
        return np.zeros(len(first.vector))
    return np.asarray(first.of_gravity * other.of_gravity)
