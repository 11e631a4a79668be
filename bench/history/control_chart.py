"""The control chart of a check block: runs judged against a baseline, with reasons and notes in words.

A chart shows the nine numbers that do not depend on the mounting, or the twelve coefficients: whichever its runs
contain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property

import numpy as np

from bench.base.arrays import Floats, Mask
from bench.base.languages import message
from bench.base.numbers import MINUS, probability
from bench.base.text import listed
from bench.calibration.intrinsic import INTRINSIC
from bench.calibration.result import CalibrationError, through, widening
from bench.history.comparison import SECONDS_PER_YEAR
from bench.history.measured import nine_of
from bench.model.geometry import COEFFICIENTS
from bench.stats.control_charts import (
    ALIKE_P,
    EXACT,
    Centre,
    ChartDesign,
    Components,
    DriftSeen,
    JudgedDeviations,
    ShortTerm,
    StatedDof,
    centre_of,
    components_of,
    drift_of,
    judge,
    least_runs,
    short_term,
    without_one,
)

FEW_RUNS = 8
"""With fewer baseline runs, a note says that the limits are wide."""


def reasons_of(chart: ControlChart, row: int) -> tuple[str, ...]:
    """Return the reasons to reject the later run with index `row`: a clause for each statistic beyond its limit."""
    reasons = []
    shewhart, ewma, short = chart.shewhart, chart.ewma, chart.short
    if shewhart.t2[row] > chart.limit_t2:
        which = _which(chart, shewhart.z[row], chart.limit_single)
        reasons.append(message(f"T² = {shewhart.t2[row]:.1f} is beyond {chart.limit_t2:.1f} ({which})"))
    if ewma.t2[row] > chart.limit_ewma:
        which = _which(chart, ewma.z[row], chart.limit_single_ewma)
        reasons.append(
            message(f"T² of the EWMA = {ewma.t2[row]:.1f} is beyond {chart.limit_ewma:.1f} ({which})")
        )
    if short is not None and short.p[row] < chart.design.alpha:
        reasons.append(
            message(
                f"its short-term standard deviation is {np.sqrt(short.f[row]):.2f} times that of the baseline "
                f"(F = {short.f[row]:.2f} for {short.dof[row]:.0f} and {short.pooled_dof:.0f})"
            )
        )
    return tuple(reasons)


def _which(chart: ControlChart, z: Floats, limit: float) -> str:
    """Return in words the numbers whose `z` is beyond `limit`, farthest first; if none is, the farthest number."""
    order = np.argsort(-np.abs(z))
    beyond = [k for k in order if abs(z[k]) > limit]
    named = [f"{chart.names[k]} {z[k]:+.1f} u".replace("-", MINUS) for k in order]
    if not beyond:
        return message(f"no number alone; the farthest is {named[0]}")
    return ", ".join(named[: len(beyond)])


def notes_of(chart: ControlChart) -> tuple[str, ...]:
    """Return the notes for the reader of the chart, one sentence each."""
    return (*_on_baseline(chart), *_on_components(chart), *_on_meters(chart), *_on_drift(chart))


def _on_baseline(chart: ControlChart) -> list[str]:
    notes = []
    runs = len(chart.baseline)
    if chart.reference is not None:
        notes.append(
            message(
                f"judged by the reference {chart.reference.name}: constant parts of u (meters, temperature) "
                "widen every limit; a baseline of the bench's own runs shows smaller changes"
            )
        )
    elif runs < FEW_RUNS:
        notes.append(
            message(
                f"the baseline has {runs} run{'' if runs == 1 else 's'}: the limits are wide for so few runs and "
                "narrow with more"
            )
        )
    if chart.alone is not None:
        worst = int(np.argmin(chart.alone))
        if runs * chart.alone[worst] < ALIKE_P:
            notes.append(
                message(
                    f"{chart.baseline[worst].name} differs from the other runs of the baseline "
                    f"({probability(min(1.0, runs * float(chart.alone[worst])))}): find the cause, or leave it out"
                )
            )
    return notes


def _on_components(chart: ControlChart) -> list[str]:
    found = chart.components
    if found is None:
        return []
    notes = []
    more = [name for name, p in zip(chart.names, found.more_than_stated, strict=True) if p < ALIKE_P]
    if more:
        notes.append(
            message(
                f"between the runs of the baseline {listed(more)} scatter{'s' if len(more) == 1 else ''} more than "
                "stated u: something differs from run to run by more than the bench file states"
            )
        )
    if found.birge_p < ALIKE_P:
        stated = chart.design.basis == "stated"
        notes.append(
            message(
                f"the baseline scatters {np.sqrt(found.birge2):.2f} times as much as stated u "
                f"({probability(found.birge_p)}); the limits "
                f"{'still use stated u' if stated else 'follow the scatter'}"
            )
        )
    if chart.design.basis != "scatter" and found.alike_p < ALIKE_P:
        notes.append(
            message(
                f"stated u does not fit every coefficient equally ({probability(found.alike_p)}): false "
                "alarms are more frequent than stated; name under 'between_runs' what changes with each run, or "
                "take limits from scatter (11 runs or more)"
            )
        )
    return notes


def _on_meters(chart: ControlChart) -> list[str]:
    known = {run.meters for run in chart.baseline}
    other = [run.name for run in chart.later if known and run.meters not in known]
    if not other:
        return []
    return [
        message(
            f"these runs may have other meters than the baseline: {listed(other)}; u includes the limits of "
            "both; measure a new baseline with the new meters"
        )
    ]


def _on_drift(chart: ControlChart) -> list[str]:
    if chart.drift is None:
        return []
    names = [name for name, p in zip(chart.names, chart.drift.p, strict=True) if p < ALIKE_P]
    if not names:
        return []
    return [
        message(
            f"{listed(names)} of the check block drift{'s' if len(names) == 1 else ''} more than stated; if the "
            "block drifts, not the bench, add it under 'drift' with its u"
        )
    ]


LEAST_FOR_DRIFT = 5
LEAST_SPAN_YEARS = 7.0 / 365.25


@dataclass(frozen=True)
class CheckRun:
    """A calibration of the check block: `value` (12,), and `covariance` (12, 12) of errors that vary by run.

    `noise` (12,) is the part of u due to reading noise. `s` is the short-term standard deviation of a reading, with
    `s_dof` degrees of freedom. Runs with the same `design` (plan and readings) have equal covariances, except by
    chance.
    `meters` are the identities of the voltmeters. `of_meters` (12, 12) is the covariance due to their limits of
    error; it counts if no baseline run used these voltmeters, or if a `Reference` replaces the baseline. `lasting`
    (12, 12) is the covariance of all other errors that do not vary from run to run. `names` are the names of the
    values, unless these are the twelve coefficients or the nine intrinsic numbers. `place` is the local g of the
    run, m/s², and `of_gravity` (12,) the change of its values with one u of this g: runs at one place share it.
    """

    name: str
    when: datetime
    value: Floats
    covariance: Floats
    noise: Floats
    s: float
    s_dof: float
    design: str
    meters: tuple[str, ...]
    of_meters: Floats
    lasting: Floats
    names: tuple[str, ...] = ()
    place: float = 0.0
    of_gravity: Floats | float = 0.0

    @property
    def plan(self) -> str:
        """The first word of `design`: runs of one plan have the same noise in a reading."""
        return self.design.partition(" ")[0]

    def in_nine(self) -> CheckRun:
        """Return the run in the nine intrinsic numbers.

        Raises `CalibrationError` for a K that describes no block.
        """
        own = nine_of(self.name, self.value, self.covariance)
        J = own.jacobian
        return replace(
            self,
            value=own.values,
            covariance=own.covariance,
            noise=np.sqrt(J**2 @ self.noise**2),
            of_meters=through(J, self.of_meters),
            lasting=through(J, self.lasting),
            of_gravity=J @ np.broadcast_to(self.of_gravity, self.value.shape),
        )


@dataclass(frozen=True)
class Reference:
    """A calibration of the check block on another bench: `value` (12,), full `covariance` (12, 12)."""

    name: str
    when: datetime
    value: Floats
    covariance: Floats

    def in_nine(self) -> Reference:
        """Return the reference in the nine intrinsic numbers.

        Raises `CalibrationError` for a K that describes no block.
        """
        own = nine_of(self.name, self.value, self.covariance)
        return replace(self, value=own.values, covariance=own.covariance)


@dataclass(frozen=True)
class KnownDrift:
    """The known drift of the block: `per_year` (12,) with standard uncertainties `u` (12,)."""

    per_year: Floats
    u: Floats

    def in_nine(self, value: Floats) -> KnownDrift:
        """Return the drift in the nine intrinsic numbers of a block with the coefficients `value` (12,)."""
        J = nine_of("the check block", value, np.eye(len(value))).jacobian
        return KnownDrift(J @ self.per_year, np.sqrt(J**2 @ self.u**2))


@dataclass(frozen=True)
class Verdict:
    """The verdict on a run: accepted, or rejected with `reasons`, one clause each."""

    run: str
    when: datetime
    reasons: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Whether the run is accepted, so that the bench was in control."""
        return not self.reasons


@dataclass(frozen=True)
class ControlChart:
    """The control chart: `baseline` runs, or a `reference` in place of them, and the `later` runs judged.

    `shewhart` and `ewma` have a row for each later run. The EWMA skips a run that T² rejects; the row of such a
    run is NaN. `alone` (m,) is the p-value of each baseline run compared with the other baseline runs, None if they
    are too few. `verdicts` holds the verdict on each later run, in order. `known` is the drift of the block since
    `begun` (POSIX time, s), zero if unknown.
    """

    design: ChartDesign
    baseline: tuple[CheckRun, ...]
    reference: Reference | None
    later: tuple[CheckRun, ...]
    centre: Centre
    shewhart: JudgedDeviations
    ewma: JudgedDeviations
    short: ShortTerm | None
    components: Components | None
    drift: DriftSeen | None
    alone: Floats | None
    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...]
    begun: float
    known: KnownDrift

    def expected(self, when: datetime) -> tuple[Floats, Floats]:
        """Return the expected values of a further run at the time `when`, and the covariance of deviations.

        Both have one entry per number of the block, in the order of `names`: shapes (m,) and (m, m). The expected
        values are the centre of the chart plus the known drift since `begun`, plus any further drift that the runs
        show significantly. The covariance is the sum of three parts: of the centre, between runs, and of the drift.
        The standard uncertainty of the drift grows in proportion to the time since `begun`.
        """
        years = (when.timestamp() - self.begun) / SECONDS_PER_YEAR
        value, u = self.centre.value + years * self.known.per_year, self.known.u
        if self.drift is not None:
            shown = self.drift.p < ALIKE_P
            value = value + years * np.where(shown, self.drift.per_year, 0.0)
            u = np.where(shown, self.drift.u, u)
        scale = np.asarray(self.centre.scale)
        between = self.centre.scatter
        if between is None:
            between = scale * (*self.baseline, *self.later)[-1].covariance
        return value, scale * self.centre.covariance + between + np.diag((years * u) ** 2)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the numbers: the nine intrinsic numbers, the twelve coefficients, or those of a monitor."""
        own = next((run.names for run in (*self.baseline, *self.later) if run.names), ())
        if own:
            return own
        return INTRINSIC if self.centre.dimensions == len(INTRINSIC) else COEFFICIENTS

    @property
    def in_control(self) -> bool:
        """Whether the last judged run is accepted; true if none is."""
        return not self.verdicts or self.verdicts[-1].accepted

    @cached_property
    def limit_t2(self) -> float:
        """The limit above which Hotelling's T² rejects a run."""
        return self.centre.joint_limit(self.design.alpha)

    @cached_property
    def limit_ewma(self) -> float:
        """The limit above which Hotelling's T² of the EWMA rejects a run."""
        return self.centre.joint_limit(self.design.alpha_ewma(self.centre.dimensions))

    @cached_property
    def limit_single(self) -> float:
        """The limit of a single coefficient on its Shewhart chart, in units of its u."""
        return self.centre.single_limit(self.design.alpha_single(self.centre.dimensions))

    @cached_property
    def limit_single_ewma(self) -> float:
        """The limit of a single coefficient on its EWMA chart, in units of its u."""
        return self.centre.single_limit(self.design.alpha_single_ewma(self.centre.dimensions))


def control_chart(
    baseline: Sequence[CheckRun],
    later: Sequence[CheckRun],
    design: ChartDesign,
    *,
    reference: Reference | None = None,
    drift: KnownDrift | None = None,
    restarted: datetime | None = None,
) -> ControlChart:
    """Judge `later` runs of a check block against its `baseline` runs, or against a `reference` calibration.

    `drift` is the known drift of the block. `restarted` is the time of a repair, at which the EWMA starts again.
    Raises `CalibrationError` if the baseline has too few runs for limits.
    """
    baseline = tuple(sorted(baseline, key=lambda run: run.when))
    later = tuple(sorted(later, key=lambda run: run.when))
    if reference is None and not baseline:
        raise CalibrationError("a chart needs a baseline: measure the check block first")
    begun = (
        np.mean([run.when.timestamp() for run in baseline])
        if reference is None
        else reference.when.timestamp()
    )
    size = len(baseline[0].value if reference is None else reference.value)
    runs = _Runs(baseline, later, float(begun), drift or KnownDrift(np.zeros(size), np.zeros(size)), design)
    if reference is None:
        of_baseline = runs.values(baseline), runs.covariances(baseline), design.basis, runs.stated()
        centre = centre_of(*of_baseline, runs.places)
        alone = without_one(*of_baseline) if runs.places is None else None
    else:
        # lasting errors of this bench are part of every difference from a reference measured on another bench
        lasting = np.mean([run.lasting + run.of_meters for run in (*baseline, *later)], axis=0)
        one = np.ones(())
        centre = Centre(reference.value, reference.covariance + lasting, one, np.inf, 1)
        alone = None
    shewhart = runs.judged(centre, later, 1.0)
    chart = ControlChart(
        design, baseline, reference, later, centre, shewhart, runs.ewma(centre, shewhart, restarted),
        runs.short_term(), runs.components(), runs.drift_seen(centre, shewhart), alone, (), (), runs.begun,
        runs.known,
    )  # fmt: skip
    verdicts = tuple(Verdict(run.name, run.when, reasons_of(chart, row)) for row, run in enumerate(later))
    return replace(chart, verdicts=verdicts, notes=notes_of(chart))


@dataclass(frozen=True)
class _Runs:
    """The runs of a chart, and the known drift of the block since `begun` (POSIX time, s)."""

    baseline: tuple[CheckRun, ...]
    later: tuple[CheckRun, ...]
    begun: float
    known: KnownDrift
    design: ChartDesign

    def years(self, runs: Sequence[CheckRun]) -> Floats:
        """Return the time of each run in years since `begun`, (n,)."""
        return np.array([(run.when.timestamp() - self.begun) / SECONDS_PER_YEAR for run in runs])

    def values(self, runs: Sequence[CheckRun]) -> Floats:
        """Return the values (n, 12) minus the known drift."""
        return np.array([run.value for run in runs]) - self.years(runs)[:, None] * self.known.per_year

    @cached_property
    def _pooled(self) -> dict[str, Floats]:
        """The covariance of each design of run, pooled over its baseline runs or else its later runs."""
        found = {}
        for design in {run.design for run in (*self.baseline, *self.later)}:
            own = [run for run in self.baseline if run.design == design]
            own = own or [run for run in self.later if run.design == design]
            covariance = np.mean([run.covariance for run in own], axis=0)
            noise = np.mean([(run.noise * widening(run.s_dof)) ** 2 for run in own], axis=0)
            share = np.minimum(noise / np.diag(covariance), 1.0)
            size = np.sqrt(1.0 + share * (self._noise_beside(own) - 1.0))
            found[design] = covariance * np.outer(size, size)
        return found

    def _noise_beside(self, own: Sequence[CheckRun]) -> float:
        """Return the squared ratio of the noise of baseline runs of the same plan to that of runs of one design."""
        alike = [run for run in self.baseline if run.plan == own[0].plan]
        if not alike or not all(run.s_dof > 0 and run.s > 0 for run in (*alike, *own)):
            return 1.0
        ours, theirs = (np.mean([(run.s * widening(run.s_dof)) ** 2 for run in of]) for of in (alike, own))
        return float(ours / theirs)

    def covariances(self, runs: Sequence[CheckRun]) -> Floats:
        """Return the pooled covariance of each run, (n, 12, 12)."""
        return np.array([self._pooled[run.design] for run in runs])

    def stated(self) -> StatedDof:
        """Return the degrees of freedom of the noise behind the stated u of the baseline."""
        dof = np.array([run.s_dof for run in self.baseline])
        # without degrees of freedom, the noise was given
        if not dof.all():
            return EXACT
        return StatedDof(float(dof.sum()), float(np.mean([widening(own) ** 2 for own in dof])))

    @cached_property
    def places(self) -> Mask | None:
        """Whether each run of the baseline was at each of its places, (m, k); None for one place."""
        place, own = np.unique([run.place for run in self.baseline], return_inverse=True)
        return own[:, None] == np.arange(len(place)) if len(place) > 1 else None

    def ewma(
        self, centre: Centre, shewhart: JudgedDeviations, restarted: datetime | None
    ) -> JudgedDeviations:
        """Return the EWMA of the later runs that T² does not reject; it starts again at `restarted`."""
        kept = shewhart.p_joint >= self.design.alpha
        after = np.array([restarted is not None and run.when >= restarted for run in self.later], dtype=bool)
        columns = [np.full_like(shewhart.deviation, np.nan) for _ in range(4)]
        joint = [np.full(len(self.later), np.nan) for _ in range(2)]
        for part in (kept & ~after, kept & after):
            rows = np.flatnonzero(part)
            found = self.judged(centre, [self.later[int(row)] for row in rows], self.design.smoothing)
            for column, own in zip(columns, (found.deviation, found.u, found.z, found.p), strict=True):
                column[rows] = own
            joint[0][rows], joint[1][rows] = found.t2, found.p_joint
        return JudgedDeviations(*columns, *joint)

    def judged(self, centre: Centre, runs: Sequence[CheckRun], smoothing: float) -> JudgedDeviations:
        if not runs:
            rows = np.zeros((0, centre.dimensions))
            return JudgedDeviations(rows, rows, rows, rows, np.zeros(0), np.zeros(0))
        # change of the values if the drift rate of one coefficient is wrong by one u
        of_drift = self.years(runs)[:, None, None] * np.diag(self.known.u)
        shared = np.concatenate([of_drift, self._other_meters(runs), self._other_places(runs)], axis=2)
        return judge(
            centre, self.values(runs), self.covariances(runs), smoothing, shared if shared.any() else None
        )

    def _other_meters(self, runs: Sequence[CheckRun]) -> Floats:
        """Return square roots (n, 12, 12) of the covariances due to meters not used in the baseline."""
        known = {run.meters for run in self.baseline}
        parts = []
        for run in runs:
            other = bool(known) and run.meters not in known
            # factor 2: the new meters and those of the baseline may each be anywhere within their limits
            parts.append(_root(2.0 * run.of_meters) if other else np.zeros_like(run.of_meters))
        return np.array(parts)

    def _other_places(self, runs: Sequence[CheckRun]) -> Floats:
        """Return the changes (n, 12, k) of the deviations with one u of g at each of k places.

        The baseline has an error of g in the part of its runs that were at this place.
        """
        here = self.baseline or self.later[:1]
        first = {run.place: run for run in (*here, *runs)}
        size = np.array([np.broadcast_to(run.of_gravity, run.value.shape) for run in first.values()])
        if len(first) == 1:
            return np.zeros((len(runs), size.shape[1], 1))
        weights = np.linalg.inv(self.covariances(here))
        if self.design.basis == "scatter":  # the centre is then the plain mean
            weights = np.broadcast_to(np.eye(size.shape[1]), weights.shape)
        weights = np.linalg.inv(weights.sum(axis=0)) @ weights
        at = np.array([[run.place == place for place in first] for run in here], dtype=np.float64)
        of = np.array([[run.place == place for place in first] for run in runs], dtype=np.float64)
        return np.asarray(of[:, None, :] * size.T - np.einsum("mk,mpq,kq->pk", at, weights, size))

    def short_term(self) -> ShortTerm | None:
        behind = [run for run in self.baseline if run.s_dof > 0]
        if not behind or not self.later:
            return None
        later, before = (
            np.array([[run.s for run in runs], [run.s_dof for run in runs]]) for runs in (self.later, behind)
        )
        return short_term(*later, *before)

    def components(self) -> Components | None:
        runs, size = self.baseline, len(self.known.u)
        if len(runs) < least_runs("scaled", size) or len({(run.design, run.place) for run in runs}) > 1:
            return None
        noise = np.sqrt(np.mean([run.noise**2 for run in runs], axis=0))
        return components_of(self.values(runs), self.covariances(runs)[0], noise, self.stated())

    def drift_seen(self, centre: Centre, shewhart: JudgedDeviations) -> DriftSeen | None:
        """Return the drift of the baseline and accepted runs in excess of the known drift.

        The u of the result includes the u of the known drift. The result is None if the runs are too few, their
        time span is too short, or their meters or places differ.
        """
        accepted = shewhart.p_joint >= self.design.alpha
        runs = [*self.baseline, *(run for run, good in zip(self.later, accepted, strict=True) if good)]
        if len(runs) < LEAST_FOR_DRIFT or len({(run.meters, run.place) for run in runs}) > 1:
            return None
        years = np.array([run.when.timestamp() for run in runs]) / SECONDS_PER_YEAR
        if np.ptp(years) < LEAST_SPAN_YEARS:
            return None
        if centre.scatter is not None:
            u = np.sqrt(np.diag(centre.scatter))
        else:
            u = np.sqrt(float(centre.scale) * np.mean([np.diag(c) for c in self.covariances(runs)], axis=0))
        return drift_of(years, self.values(runs), u, centre.dof, self.known.u)


def _root(covariance: Floats) -> Floats:
    """Return a square root of a covariance, which may be singular."""
    sizes, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(sizes, 0.0)))
