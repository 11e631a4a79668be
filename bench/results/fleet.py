"""The results of `bench fleet` on blocks: variance components, priors, drift, capability; JSON and text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.arrays import Floats, u_of
from bench.base.numbers import MINUS, fixed, places, probability, quantity
from bench.base.result_model import Matrix, Real, ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.calibration.intrinsic import INTRINSIC
from bench.history import bench_or_block, capability, drift, prior
from bench.history.measured import STANDARD_GRAVITY
from bench.model.geometry import COEFFICIENTS
from bench.results.parts import ValuePart, by_coefficient, by_name

MOST_SHOWN: Final = 12
"""Largest number of benches or units that a terminal lists; the JSON has all."""


class FleetResult(ResultModel):
    """The members that every result of `bench fleet` has."""

    signal: str = Field(description="unit of the signal; scale factors are per g")
    simulated: bool = Field(description="true if the calibrations are of simulated runs")
    calibrations: int
    notes: list[str] = Field(description="remarks for the reader, a sentence each")


class LimitedPart(ResultModel):
    """A standard deviation with its upper 95 % limit."""

    value: float = Field(description="standard deviation")
    at_most: Real = Field(description="upper 95 % limit of the standard deviation")


def signed_size(value: float, unit: str) -> str:
    """Return a value with its sign and unit prefix: "+2.5 µV"."""
    return f"{MINUS if value < 0 else '+'}{quantity(abs(value), unit)}"


def limit_in_words(limit: float | None, unit: str) -> str:
    """Return an upper limit with its unit as text; a `limit` of None means infinity."""
    return quantity(math.inf if limit is None else limit, unit)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


# --- bench or block -----------------------------------------------------------------------------------


class SizePart(LimitedPart):
    """A standard deviation between blocks, benches or calibrations, in the unit of the coefficient."""

    u: Real = Field(description="standard uncertainty of the value; null if the value is zero")
    p_all_looks: Real = None
    """p-value corrected for the number of coefficients; absent for units"""
    shown: bool = Field(default=False, description="whether `p_all_looks` is below 5 %; absent for units")


class AllotmentPart(ResultModel):
    """A test of whether units were assigned to benches at random."""

    chi2: float
    dof: int
    p: float
    by_chance: bool
    """whether the units were assigned to benches at random; if not, benches are compared only within units"""


class RepeatsPart(ResultModel):
    """The scatter of repeated calibrations of one unit on one bench."""

    reduced_chi2: Real = Field(description="reduced chi-square of the repeats; null if there are none")
    dof: int


class SizesPart(ResultModel):
    """The variance components of a coefficient: units, benches and excess scatter."""

    unit: SizePart = Field(description="standard deviation between units of a type")
    bench: SizePart = Field(description="standard deviation between benches")
    excess: SizePart
    """scatter of the calibrations beyond their stated u, including the drift of units"""
    stated_u_rms: float = Field(
        description="rms of stated u without errors that repeat with the same meters and local gravity"
    )
    stated_of_meters_rms: float
    """rms of the stated u of the meters and of local gravity, which is part of the difference between benches"""
    shares_of_variance: dict[str, float]
    """parts of the variance of one calibration about the mean of its type: unit, bench, excess, stated"""
    allotment: AllotmentPart
    scatter_of_repeats: RepeatsPart


class EffectOfBench(ResultModel):
    """A bench's effect on a coefficient."""

    effect: float
    u: float
    p_all_looks: float
    shown: bool


class EffectsResult(FleetResult):
    """The variance components of the coefficients (units, benches, excess), and the significant effects."""

    units: int
    benches: int
    types: int
    units_on_several_benches: int
    connected: list[list[str]]
    """sets of benches linked by common units; effects are relative to the mean of a set"""
    coefficients: dict[str, SizesPart] = Field(description="standard deviations for each coefficient")
    benches_effects: dict[str, dict[str, EffectOfBench] | None]
    """effect of each bench on each coefficient; null for a bench that shares no unit with another"""
    benches_apart: list[bench_or_block.OutlyingEffect] = Field(description="benches with significant effects")
    units_apart: list[bench_or_block.OutlyingEffect] = Field(description="units with significant effects")
    answer: str = Field(description="conclusion in a sentence")


def effects_result(found: bench_or_block.BenchOrBlock, notes: Sequence[str]) -> EffectsResult:
    """Return the result of an analysis of units and benches, with `notes` added."""
    rows = zip(found.benches, found.effect, found.u, found.p_all_looks, strict=True)
    return EffectsResult.from_object(
        found,
        **found.counts,
        coefficients={name: _sizes(one) for name, one in zip(COEFFICIENTS, found.sizes, strict=True)},
        benches_effects={
            bench: None
            if np.isnan(effect[0])
            else by_coefficient(
                EffectOfBench, effect=effect, u=u, p_all_looks=p, shown=p < bench_or_block.SHOWN_P
            )
            for bench, effect, u, p in rows
        },
        notes=[*found.notes, *notes],
    )


def _sizes(one: bench_or_block.Sizes) -> SizesPart:
    return SizesPart(
        unit=_size(one.unit),
        bench=_size(one.bench),
        excess=_size(one.excess),
        stated_u_rms=one.stated,
        stated_of_meters_rms=one.meters,
        shares_of_variance=one.shares,
        allotment=AllotmentPart.from_object(one.allotment, by_chance=one.by_chance),
        scatter_of_repeats=RepeatsPart(reduced_chi2=one.scatter, dof=one.scatter_dof),
    )


def _size(size: bench_or_block.EstimatedSize) -> SizePart:
    asked = {} if math.isnan(size.p_all_looks) else {"p_all_looks": size.p_all_looks, "shown": size.shown}
    return SizePart(value=size.value, u=size.u, at_most=size.most, **asked)


def print_effects(result: EffectsResult, out: Console) -> None:
    """Print the variance components, the benches and units that stand out, and the conclusion."""
    out.print(
        f"{result.calibrations} calibrations of {result.units} units ({result.types} types) on {result.benches} "
        f"benches; {result.units_on_several_benches} units measured on several"
    )
    shown = table(
        "coefficient", ">units differ", ">benches differ", ">at most", ">adjusted p", ">excess", ">p",
        ">stated u", "",
    )  # fmt: skip
    signal = result.signal
    for name, s in result.coefficients.items():
        shown.add_row(
            name, quantity(s.unit.value, signal), quantity(s.bench.value, signal),
            limit_in_words(s.bench.at_most, signal), f"{_number(s.bench.p_all_looks):.2g}",
            quantity(s.excess.value, signal), f"{_number(s.excess.p_all_looks):.2g}",
            quantity(s.stated_u_rms, signal), "BENCHES DIFFER" if s.bench.shown else "",
        )  # fmt: skip
    out.print(shown)
    for what, apart in (("bench", result.benches_apart), ("unit", result.units_apart)):
        for one in apart[:MOST_SHOWN]:
            sizes = f"{signed_size(one.effect, signal)}, u {quantity(one.u, signal)}"
            out.print(f"{what} {one.name} stands out in {one.coefficient}: {sizes}")
        if len(apart) > MOST_SHOWN:
            out.print(f"… and {len(apart) - MOST_SHOWN} more; --json FILE lists all")
    print_notes(out, result.notes)
    out.print(result.answer, style="bold")


# --- a further unit of a type -------------------------------------------------------------------------


class ExpectedPart(ResultModel):
    """The distribution of a coefficient for a further unit of the type."""

    mean: float
    u: float = Field(description="standard uncertainty for a further unit")
    between_units: float = Field(description="standard deviation of units, widened for their small number")
    u_mean: float


class PriorResult(FleetResult):
    """The prior for a further unit of a type: the file for `bench calibrate --prior`."""

    type: str = Field(description="type of the units")
    per_g_m_s2: float = Field(description="gravity to which the scale factors refer, m/s²")
    units: list[str] = Field(description="units behind the prior, to which it must not be applied")
    benches: list[str]
    last: str = Field(description="date of the last calibration")
    dof: int = Field(description="degrees of freedom: number of units minus 1")
    shrunk: float = Field(description="fraction by which the correlations were reduced, 0 to 1")
    coefficients: dict[str, ExpectedPart] = Field(description="expected coefficients of a further unit")
    covariance: Matrix = Field(description="covariance of the coefficients of a further unit, 12 × 12")


def prior_result(found: prior.Prior, notes: Sequence[str]) -> PriorResult:
    """Return the result for a prior, with `notes` added."""
    return PriorResult.from_object(
        found,
        type=found.kind,
        per_g_m_s2=STANDARD_GRAVITY,
        coefficients=by_coefficient(
            ExpectedPart, found, u=u_of(found.covariance), between_units=found.between, u_mean=found.mean_u
        ),
        notes=[*found.notes, *notes],
    )


def print_prior(result: PriorResult, out: Console) -> None:
    """Print the prior for a further unit of a type."""
    out.print(
        f"type {result.type}: {len(result.units)} units, {result.calibrations} calibrations on "
        f"{len(result.benches)} benches; {result.dof} degrees of freedom, correlations shrunk by "
        f"{100 * result.shrunk:.0f} %"
    )
    shown = table("coefficient", ">mean", ">u of a further unit", ">units differ by", ">u of the mean")
    for name, one in result.coefficients.items():
        digits = places(one.u)
        sizes = (one.mean, one.u, one.between_units, one.u_mean)
        shown.add_row(name, *(fixed(size, digits) for size in sizes))
    out.print(shown)
    print_notes(out, result.notes)


# --- the drift of a unit ------------------------------------------------------------------------------


class RatePart(ResultModel):
    """The drift rate of a coefficient or intrinsic number, with the scatter and random walk of its values."""

    value: float = Field(description="rate per year")
    u: float
    p_all_looks: Real = Field(description="p-value of the rate, corrected for the number of coefficients")
    shown: bool = Field(description="whether `p_all_looks` is below 5 %")
    between_calibrations: LimitedPart
    """standard deviation beyond the stated u, by restricted likelihood; 0 if not significant"""
    random_walk: LimitedPart
    """standard deviation of the random walk over a year, by restricted likelihood; 0 if not significant"""


class ForetoldPoint(ResultModel):
    """The coefficients and intrinsic numbers predicted for a date."""

    at: str = Field(description="date given with --at")
    coefficients: dict[str, ValuePart] = Field(description="predicted coefficients by name")
    intrinsic: dict[str, ValuePart] = Field(description="predicted intrinsic numbers by name")


class DriftResult(FleetResult):
    """The drift of a unit over its calibrations."""

    unit: str = Field(description="type and serial number")
    per_g_m_s2: float = Field(description="gravity to which the scale factors refer, m/s²")
    first: str = Field(description="date of the first calibration")
    last: str = Field(description="date of the last calibration")
    intrinsic_per_year: dict[str, RatePart]
    """rates of the nine numbers that do not depend on the mounting, by name"""
    p: float = Field(description="p-value for no drift of any of the nine (Bonferroni), which decides")
    drifts: bool = Field(description="whether `p` is below 5 %")
    per_year: dict[str, RatePart] = Field(description="rates of the twelve coefficients, by name")
    expected: ForetoldPoint | None


def drift_result(found: drift.OfUnit, at: str | None, notes: Sequence[str]) -> DriftResult:
    """Return the result on a unit's drift, with coefficients predicted for date `at`. Raises `CalibrationError`."""
    own = found.drift
    expected = None
    if at is not None:
        (value, u), (of_nine, u_nine) = (one.predicted(drift.day_of(at)) for one in (own, found.nine))
        expected = ForetoldPoint(
            at=at,
            coefficients=by_coefficient(ValuePart, value=value, u=u),
            intrinsic=by_name(INTRINSIC, ValuePart, value=of_nine, u=u_nine),
        )
    p = float(np.min(found.nine.p_all_looks))
    return DriftResult.from_object(
        found,
        per_g_m_s2=STANDARD_GRAVITY,
        calibrations=own.count,
        first=str(own.first.astype("datetime64[D]")),
        last=str(own.last.astype("datetime64[D]")),
        intrinsic_per_year=_rates(INTRINSIC, found.nine),
        p=p,
        drifts=p < drift.SHOWN_P,
        per_year=_rates(COEFFICIENTS, own),
        expected=expected,
        notes=[*notes, *found.notes],
    )


def _rates(names: Sequence[str], own: drift.UnitDrift) -> dict[str, RatePart]:
    return by_name(
        names, RatePart, own, value=own.rate, u=own.u_rate,
        between_calibrations=_limited(own.between, own.between_most),
        random_walk=_limited(own.walk, own.walk_most),
    )  # fmt: skip


def _limited(value: Floats, at_most: Floats) -> list[LimitedPart]:
    return [LimitedPart(value=one, at_most=most) for one, most in zip(value, at_most, strict=True)]


def print_drift(result: DriftResult, out: Console) -> None:
    """Print drift rates, scatter and random walk, and the coefficients predicted for a date."""
    per = f"{result.signal}/g of {result.per_g_m_s2} m/s²"
    out.print(f"{result.unit}: {result.calibrations} calibrations, {per}")
    expected = result.expected
    then = (None, None) if expected is None else (expected.intrinsic, expected.coefficients)
    for rates, later in zip((result.intrinsic_per_year, result.per_year), then, strict=True):
        out.print(_rates_table(rates, later, "" if expected is None else expected.at))
    print_notes(out, result.notes)
    verdict = "the unit DRIFTS" if result.drifts else "no drift shown"
    out.print(
        f"{verdict} in the nine numbers that do not depend on the mounting: {probability(result.p)}",
        style="bold",
    )


def _rates_table(rates: dict[str, RatePart], then: dict[str, ValuePart] | None, at: str) -> Table:
    shown = table(
        "number", ">per year", ">u", ">adjusted p", ">scatter", ">at most", ">random walk in a year",
        ">at most", "", *(() if then is None else (f">at {at}", ">u")),
    )  # fmt: skip
    for name, one in rates.items():
        digits = places(one.u)
        limited = (one.between_calibrations, one.random_walk)
        sizes = [fixed(_number(size), digits) for each in limited for size in (each.value, each.at_most)]
        row = [name, fixed(one.value, digits, sign=True), fixed(one.u, digits)]
        row += [f"{_number(one.p_all_looks):.2g}", *sizes, "DRIFTS" if one.shown else ""]
        if then is not None:
            row += [fixed(size, places(then[name].u)) for size in (then[name].value, then[name].u)]
        shown.add_row(*row)
    return shown


# --- the laboratory's capability ----------------------------------------------------------------------


class ScatterPart(LimitedPart):
    """The scatter (1 sigma) of a unit's calibrations beyond stated u, after removal of significant drift."""

    value: float = Field(description="root mean square, allowing for the degrees of freedom")
    at_least: float = Field(description="lower 95 % limit of the scatter")


class DriftOfUnits(ResultModel):
    """The drift of one coefficient, as a standard deviation over the units.

    `rate` is in the unit of the coefficient per year; `walk`, the random walk in one year, is in the unit of
    the coefficient. `p` is the probability of such a drift by chance. `taken_out` says whether the drift was
    significant and therefore removed before the scatter over time was computed.
    """

    rate: float = Field(description="standard deviation of the rates, per year; 0 if no drift was removed")
    walk: float = Field(description="standard deviation of the walk over a year; 0 if none was removed")
    p: float = Field(description="p-value of the drift")
    taken_out: bool


class CapabilityPart(ResultModel):
    """The calibration and measurement capability (CMC) for one coefficient."""

    U: float = Field(description="expanded uncertainty, k = 2")
    u: float
    stated: LimitedPart
    scatter_over_time: ScatterPart
    between_benches: LimitedPart | None = Field(description="standard deviation of benches; null for one")
    drift_of_units: DriftOfUnits
    calibrations_that_state_less: int


class CapabilityResult(FleetResult):
    """The laboratory's calibration and measurement capability, estimated from past calibrations."""

    quantity: str
    device: str
    k: float = Field(description="coverage factor")
    quantile: float = Field(description="fraction of everyday calibrations that reach the stated capability")
    per_g_m_s2: float = Field(description="gravity to which the scale factors refer, m/s²")
    units: int
    benches: list[str]
    days: int = Field(description="days between the first and the last calibration")
    first: str = Field(description="date of the first calibration")
    last: str = Field(description="date of the last calibration")
    repeats: int = Field(description="number of calibrations beyond the first of each unit")
    units_with_too_few_runs: int = Field(description="units with fewer than three runs, too few for drift")
    coefficients: dict[str, CapabilityPart] = Field(description="capability for each coefficient")


def capability_result(found: capability.Capability, notes: Sequence[str]) -> CapabilityResult:
    """Return the result on the calibration and measurement capability, with `notes` added."""
    columns: dict[str, Iterable[Any]] = {
        "U": found.U,
        "u": found.u,
        "stated": _limited(found.stated, found.stated_most),
        "scatter_over_time": [
            ScatterPart(value=one.scatter, at_least=one.scatter_least, at_most=one.scatter_most)
            for one in found.spreads
        ],
        "between_benches": [
            None if math.isnan(one.bench) else LimitedPart(value=one.bench, at_most=one.bench_most)
            for one in found.spreads
        ],
        "drift_of_units": [DriftOfUnits.from_object(one, taken_out=one.shown) for one in found.spreads],
        "calibrations_that_state_less": found.below.astype(int),
    }
    return CapabilityResult.from_object(
        found,
        **found.counts,
        quantity="coefficients of a triaxial accelerometer block, by gravity",
        device="the best existing: the blocks of the history",
        k=COVERAGE_FACTOR,
        per_g_m_s2=STANDARD_GRAVITY,
        coefficients=by_coefficient(CapabilityPart, **columns),
        notes=[*found.notes, *notes],
    )


def print_capability(result: CapabilityResult, out: Console) -> None:
    """Print the calibration and measurement capability."""
    signal = result.signal
    out.print(
        f"{'SIMULATED: ' if result.simulated else ''}calibration and measurement capability: coefficients of "
        "triaxial accelerometer blocks by gravity, U with k=2"
    )
    out.print(
        f"from {result.calibrations} calibrations of {result.units} units on {len(result.benches)} benches, "
        f"{result.first} to {result.last}; U combines the stated u that {100 * result.quantile:.0f} % of "
        "them reach with the scatter beyond it"
    )
    shown = table(
        "coefficient", ">U (k=2)", ">stated u", ">scatter over time", ">at most", ">between benches",
        ">calibrations stating less", "",
    )  # fmt: skip
    for name, one in result.coefficients.items():
        per = "" if name.startswith("U0") else "/g"
        between = one.between_benches
        shown.add_row(
            name, quantity(one.U, signal) + per, quantity(one.stated.value, signal),
            quantity(one.scatter_over_time.value, signal), limit_in_words(one.scatter_over_time.at_most, signal),
            "–" if between is None else quantity(between.value, signal), str(one.calibrations_that_state_less),
            "units drift" if one.drift_of_units.taken_out else "",
        )  # fmt: skip
    out.print(shown)
    print_notes(out, result.notes)
