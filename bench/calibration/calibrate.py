"""Calibration of a table of readings by a chosen estimator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from bench.base.arrays import ARCSEC, Floats, least_squares, rms, u_of
from bench.base.languages import message
from bench.calibration import gls, mistakes, outliers
from bench.calibration.components import (
    UNEQUAL_P,
    SharedErrorFit,
    note_on_search,
    notes_on_noise,
    take_in,
)
from bench.calibration.design import FIXED, FreeRows, Problem, make_problem
from bench.calibration.estimators import ESTIMATORS, GLS, ROBUST, find_estimator
from bench.calibration.free import first_guess_free, triangular
from bench.calibration.gls import Estimator, Shift, WeightingTask, rounding_of
from bench.calibration.linear import linear_estimate
from bench.calibration.noise import KnownStand, SharedRounding, require_told
from bench.calibration.observability import GAIN, GRAVITY, assumptions, require_rank, unseen_coefficients
from bench.calibration.outliers import FittedRows
from bench.calibration.result import Calibration, CalibrationError, Estimate, LackOfFit, Noise, Outlier
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block
from bench.readings.table import FREE, REFERENCE, VERIFICATION, Readings

ROUNDING: Final = 2.0 * gls.LEAST_NOISE
"""Readings with noise below this fraction of the largest signal count as computed values, without outliers."""
LEVELLED: Final = ("axis_tilt", "zero_offset")
"""The stand angles that levelling the platform sets."""


def calibrate(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    g_m_s2: float,
    estimator: str = GLS,
    noise: Noise | None = None,
    *,
    assumed_u: Mapping[str, float] | None = None,
    nominal_angles: bool = False,
    join_free: bool = True,
    join_verification: bool = False,
    find_shared: bool = True,
    known: KnownStand | None = None,
    nominal: Sequence[float] | None = None,
) -> Calibration:
    """Estimate the twelve coefficients from a table of readings.

    `stand_u` maps names in `STAND_ANGLES` to standard uncertainties of the stand's fixed angles, rad. It may also
    hold "voltmeter_error" (in the unit of the signals) and "setting_error" (rad): priors of the noise, used if the
    readings leave too few degrees of freedom to estimate it. `noise` replaces the estimate altogether. `assumed_u`
    holds assumed uncertainties of other stand angles; they enter `covariance`, but not `covariance_readings`. The
    coefficients are per local g, stated as `g_m_s2`.

    With `nominal_angles` the target angles replace the angles read back. Free positions join the fit through |a| =
    1 g unless `join_free` is false; in a fit to free positions alone K is upper triangular by convention. With
    `join_verification` the verification points join too, and are then no independent check. Without `find_shared`
    the noise is assumed independent from reading to reading. `known` is prior knowledge of stand and noise from
    other runs: its angles replace those in `stand_u`, its noise is combined with that of the readings. `nominal`
    are nominal scale factors (x, y, z): free positions alone do not determine the signs, and take those of
    `nominal`, or else positive ones.

    Raises `CalibrationError` if the readings do not determine the coefficients, or contain a mistake.
    """
    posed = pose(
        readings, model, stand_u, find_estimator(estimator), known, assumed_u=assumed_u,
        nominal_angles=nominal_angles, join_free=join_free, join_verification=join_verification,
    )  # fmt: skip
    return solve(posed, g_m_s2, noise, find_shared=find_shared, nominal=nominal)


def solve(
    posed: Posed,
    g_m_s2: float,
    noise: Noise | None = None,
    *,
    find_shared: bool = True,
    nominal: Sequence[float] | None = None,
) -> Calibration:
    """Solve the problem of a calibration; the other arguments, and the errors, are those of `calibrate`."""
    readings, by, chosen, rows, problem = posed.readings, posed.by, posed.chosen, posed.rows, posed.problem
    resolution = (rows if len(rows) else chosen.free).resolution
    naming = partial(mistakes.naming_deviating, problem, rows)
    with naming():
        start = first_guess(problem, rows.signal, resolution, nominal)
    refit = partial(gls.fit, signal=rows.signal, start=start, noise=noise, resolution=resolution)
    judge = partial(_judged, refit=refit, by=by, chosen=chosen, resolution=resolution)
    with naming():
        judged = judge(problem)
    fit, floor = judged.fit, gls.noise_floor(rows.signal, resolution, problem.free)
    require_told(fit.noise)
    take = partial(take_in, problem, unit=readings.unit, floor=floor, rounding=judged.rounding)
    # an outlier may look like noise that grows with the signal: ask the other readings
    others = judged.doubted or fit
    shared = take(others) if find_shared else SharedErrorFit(fit)
    if find_shared:
        with naming():
            judged = _with_growth(judged, shared.growth, lambda of: take(of).growth, judge, refit)
            fit = fit if judged.problem is problem else refit(problem, shifts=judged.fit.shifts)
    fit_test, doubted = judged.test, judged.doubted
    accepted, alone = fit_test.accepted(), fit.covariance
    if others is not fit:
        # outliers that explain a misfit are no errors that readings share
        searched = find_shared and (accepted or doubted is None)
        shared = take(fit) if searched else SharedErrorFit(fit)
    tails = outliers.heavy_tails(judged.problem, judged.fit) if judged.rounding is None else float("nan")
    notes = () if doubted is None else _notes_on(outliers.listed(doubted, chosen))
    found = outliers.listed(judged.fit, chosen)
    fit = shared.fit
    if by.gain is not None:
        fit = linear_estimate(problem, rows.signal, fit, by.gain(problem, rows), shared.covariance)
    birge = _birge(fit_test, shared)
    covariance = birge**2 * fit.covariance[:FIXED, :FIXED]
    # u widened for a misfit could make a working channel look dead: use u of the noise alone
    with naming():
        mistakes.refuse_singular(fit.block, u_of(covariance if accepted else alone[:FIXED, :FIXED]))
    return Calibration(
        estimator=by.name,
        unit=readings.unit,
        g_m_s2=g_m_s2,
        block=fit.block,
        covariance=covariance,
        covariance_readings=covariance - birge**2 * _of_assumed(problem, fit, posed.assumed, by),
        gain=_whole_gain(fit.gain, fit.free_gain, chosen, len(readings)),
        slope=_whole(fit.slope, chosen, len(readings)),
        shared=shared.components,
        drift=shared.drift,
        wander=shared.wander,
        birge=birge,
        p_tails=tails,
        noise=fit.noise,
        lack_of_fit=replace(fit_test, rms=rms(fit.residuals)),
        fitted=rows,
        residuals=fit.residuals,
        skipped=len(readings.skipped),
        model=problem.model.name,
        stand=_stand(problem, fit) if by.weighs_all else {},
        effects=_effects(problem, fit) if by.weighs_all else {},
        assume=partial(_assumed, problem, fit.block, fit.gain, readings.unit, stated=nominal is not None),
        unseen=partial(unseen_coefficients, problem, fit.block),
        free=chosen.free if len(chosen.free) else None,
        modulus_error=fit.modulus,
        outliers=found,
        notes=(
            *_notes_on_rows(posed),
            *_on_levels(problem),
            *(() if posed.told else _on_levelling(problem)),
            *notes,
            *notes_on_noise(
                fit.noise, tails if accepted and not notes else float("nan"), shared, birge, readings.unit
            ),
            *note_on_search(len(rows), fit.noise),
        ),
        triangular=triangular(fit.block, covariance, g_m_s2) if problem.upper else None,
        signs="" if not problem.upper else "positive" if nominal is None else "bench file",
        angles="nominal" if posed.nominal_angles else "read back",
    )


class Posed(NamedTuple):
    """The problem of a calibration, and the rows of `readings` that it uses, the oriented ones with their angles.

    `assumed` are the names of the stand angles that are only assumed; `told` says whether other runs show how the
    angles change. `join_free` says whether free positions were asked for, `nominal_angles` whether the angles in
    `rows` or `problem` are nominal ones.
    """

    readings: Readings
    by: Estimator
    chosen: FittedRows
    rows: Readings
    problem: Problem
    assumed: frozenset[str]
    told: bool
    join_free: bool
    nominal_angles: bool


def pose(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    by: Estimator = ESTIMATORS[GLS],
    known: KnownStand | None = None,
    *,
    assumed_u: Mapping[str, float] | None = None,
    nominal_angles: bool = False,
    join_free: bool = True,
    join_verification: bool = False,
) -> Posed:
    """Return the problem of a calibration; the arguments and errors are those of `calibrate`."""
    chosen = _choose(readings, model, by, join_free=join_free, join_verification=join_verification)
    rows = mistakes.at_nominal_angles(chosen.oriented) if nominal_angles else chosen.oriented
    conditions = rows.conditions()
    if by.angles_rad is not None:
        conditions = replace(conditions, angle_rad=by.angles_rad(rows))
    u = {**stand_u, **(assumed_u or {})}
    problem = make_problem(model, conditions, u, _free_rows(chosen, readings), known)
    learned = frozenset() if known is None else {name for name, _ in known.keys}
    assumed = frozenset(assumed_u or {}) - learned
    at_nominal = nominal_angles or by.angles_rad is not None
    return Posed(readings, by, chosen, rows, problem, assumed, known is not None, join_free, at_nominal)


# --- rows -------------------------------------------------------------------------------------------


def _choose(
    readings: Readings, model: ForwardModel, by: Estimator, *, join_free: bool, join_verification: bool
) -> FittedRows:
    able = " or ".join(e.name for e in ESTIMATORS.values() if e.weighs_all)
    if join_verification and not by.weighs_all:
        raise CalibrationError(
            f"the estimator {by.name} needs oriented readings; use {able} to let verification points join"
        )
    unoriented = bool(np.any(readings.installation == FREE)) and not len(readings.oriented())
    if unoriented and not (join_free and by.weighs_all):
        raise CalibrationError(
            f"{readings.source}: free positions without readings of known orientation must join the fit; use "
            f"the estimator {able}, without --no-join-free"
        )
    labels = [FREE] * join_free + [VERIFICATION] * join_verification
    joins = np.isin(readings.installation, labels) & by.weighs_all
    free = readings.select(joins)
    mistakes.require_numbers(free, angles=False)
    rows = readings.oriented() if unoriented else usable_rows(readings, model)
    oriented = np.flatnonzero(readings.is_oriented)
    return FittedRows(rows, free, oriented, np.flatnonzero(joins))


def usable_rows(readings: Readings, model: ForwardModel) -> Readings:
    """Return the rows of a table at known orientations, without verification points.

    Raises `CalibrationError` if there are none, an installation is not in the model, or a value is no number.
    """
    rows = readings.oriented()
    if len(readings) and np.all(readings.installation == REFERENCE):
        raise CalibrationError(
            f"{readings.source}: a record at a known input has no coefficients of a block; evaluate it with "
            "'bench calibrate', 'report', 'stability', 'diagnose' or 'confirm'"
        )
    if len(rows) == 0:
        raise CalibrationError(
            f"{readings.source}: no reading in an installation of known orientation; "
            "measure installations 1 and 2, or free positions (F) all round"
        )
    strange = sorted(set(rows.installation.tolist()) - set(model.installations))
    if strange:
        raise CalibrationError(
            f"{readings.source}: installation {', '.join(strange)} is unknown (known are "
            f"{', '.join(model.installations)}); define it in the bench file"
        )
    mistakes.require_numbers(rows, angles=True)
    return rows


def _free_rows(chosen: FittedRows, readings: Readings) -> FreeRows | None:
    """Return the rows that join the fit by their modulus, or None without such rows.

    Their elapsed times and temperatures are those of the whole table, not of these rows alone.
    """
    if not len(chosen.free):
        return None
    whole, own = readings.conditions(), chosen.free.conditions()
    at = chosen.free_rows
    warmth = whole.warmth_k[at] + whole.reference_c
    return FreeRows(
        chosen.free.signal, replace(own, time_s=whole.elapsed_s[at], temperature_c=warmth, began_s=None)
    )


def _notes_on_rows(posed: Posed) -> tuple[str, ...]:
    readings, chosen, estimator = posed.readings, posed.chosen, posed.by.name
    if np.any(chosen.free.installation == VERIFICATION):
        return (message("the verification points joined the fit, so they do not check it independently"),)
    count = int(np.sum(readings.installation == FREE))
    if not count or len(chosen.free):
        return ()
    why = (
        message(f"the estimator {estimator} needs oriented readings")
        if posed.join_free
        else message("as asked")
    )
    return (message(f"{count} free position{' is' if count == 1 else 's are'} not used: {why}"),)


def _on_levelling(problem: Problem) -> Iterator[str]:
    """Yield a note on each installation with several mountings, because its angles count as new in each.

    The readings do not say whether the platform was levelled again. Without the column `mounting_number`, they do
    not say whether the block was mounted again, either.
    """
    conditions = problem.conditions
    noted = conditions.mounting is not None and bool(np.all(conditions.mounting > 0))
    assumed = {s.mount for s in problem.stand if STAND_ANGLES[s.column] in LEVELLED and not s.measured}
    first = {conditions.clamped[mount] for mount in assumed}
    for label, times in Counter(conditions.mounts[mount].installation for mount in sorted(first)).items():
        if times > 1 and noted:
            yield message(
                f"installation {label} was mounted {times} times, and u takes the platform as levelled each time; "
                f"if it was levelled once, state {times**0.5:.3g} times axis_tilt and zero_offset"
            )
        elif times > 1:
            yield message(
                f"installation {label} has {times} series, and u takes platform and block as levelled and mounted "
                "again for each; if the platform was levelled once, state axis_tilt and zero_offset "
                f"{times**0.5:.3g} times as large; if the block stayed mounted, mounting_error and mounting_roll, "
                "too; otherwise u of the cross-axis terms is too small"
            )


def _on_levels(problem: Problem) -> tuple[str, ...]:
    """Return a note on the stand angles measured with a level, and their u; empty without such angles."""
    told = [s for s in problem.stand if s.measured]
    if not told:
        return ()
    mounts = dict.fromkeys(str(problem.conditions.mounts[s.mount]) for s in told)
    sizes = []
    for column, symbol in enumerate(("alpha1", "alpha2")):
        u = [s.prior_u / ARCSEC for s in told if s.column == column]
        low, high = min(u), max(u)
        sizes.append(f"{symbol}: {low:.2g}" + (f" to {high:.2g}" if high > 1.05 * low else "") + " arcsec")
    return (
        message(
            f"a level showed how the platform stood in installation {', '.join(mounts)} (u of "
            f"{', of '.join(sizes)}); "
            "this replaces the limits in the bench file"
        ),
    )


# --- the fit ----------------------------------------------------------------------------------------


def first_guess(
    problem: Problem, signal: Floats, resolution: float = 0.0, nominal: Sequence[float] | None = None
) -> Block:
    """Return a start value of the block for the fit, by ordinary least squares at the nominal geometry.

    If there are only free positions, an ellipsoid is fitted to them, and the scale factors get the signs of
    the `nominal` ones. `resolution` is the last digit of the `signal` (n, 3). Raises `CalibrationError` for
    too few orientations, and for mistakes that such a fit reveals, such as a wrong angle unit or saturation.
    """
    if problem.upper and problem.free is not None:
        mistakes.refuse_saturated_free(problem.free.signal)
        block = first_guess_free(problem.free.signal, nominal)
        mistakes.refuse_singular(block)
        return block
    if not len(signal):
        require_rank(np.zeros((0, 3)))
    columns = mistakes.force_columns(problem)
    solution, left = least_squares(columns, signal)
    if not mistakes.still_channels(signal):
        mistakes.refuse_wrong_angle_unit(problem, signal, left)
    require_rank(columns[:, :3])
    mistakes.refuse_still(signal)
    mistakes.refuse_saturated(columns, signal, resolution)
    block = Block.from_vector(np.concatenate([solution[:3].T.ravel(), solution[3]]))
    mistakes.refuse_singular(block)
    return block


class _Judged(NamedTuple):
    """A fit with its `test` and the `rounding` error that repeats share; `doubted` is a fit without outliers."""

    problem: Problem
    fit: gls.Fit
    rounding: SharedRounding | None
    test: LackOfFit
    doubted: gls.Fit | None


def _judged(
    problem: Problem, refit: partial[gls.Fit], by: Estimator, chosen: FittedRows, resolution: float
) -> _Judged:
    """Return the estimator's fit of the problem, its test, and its outliers."""
    signal = refit.keywords["signal"]
    task = WeightingTask(problem, signal, refit(problem), lambda shifts: refit(problem, shifts=shifts))
    fit, doubted = task.fit, None
    largest = max(float(np.max(np.abs(t.signal), initial=0.0)) for t in (chosen.oriented, chosen.free))
    if fit.noise.reading >= ROUNDING * largest:
        fit = by.weigh(task)
        if not by.drops_outliers:
            # one outlier is enough for a note, but in free positions alone several may mask each other
            most = outliers.most_outliers(problem) if problem.upper else 1
            doubted = outliers.search(problem, task.fit, task.refit, most)
    # growth explains the repeats already: rounding would be taken off the misfit a second time
    rounding = None if problem.growth is not None else rounding_of(problem, fit, resolution)
    digits = ROUNDING * float(np.max(np.abs(signal), initial=0.0))
    test = replace(gls.lack_of_fit(problem, fit, rounding), rms=rms(fit.residuals), rounding=digits)
    if not test.accepted():
        # large residuals of settings come from a wrong model, not from outliers
        doubted = None if by.drops_outliers else _with_moving_positions(problem, fit, task.refit)
    return _Judged(problem, fit, rounding, test, doubted if doubted and doubted.shifts else None)


def _notes_on(found: Iterable[Outlier]) -> tuple[str, ...]:
    return tuple(
        message(f"outlier found: {outlier.text()}; the estimator '{ROBUST}' gives it no weight")
        for outlier in found
    )


def _with_growth(
    judged: _Judged,
    growth: Floats | None,
    growth_of: Callable[[gls.Fit], Floats | None],
    judge: Callable[[Problem], _Judged],
    refit: partial[gls.Fit],
) -> _Judged:
    """Return the judgement with noise that grows with the signal, if the readings show it; else `judged`.

    `growth` is that of the readings that are no outliers, `growth_of` returns that of a fit.
    """
    problem, many = judged.problem, growth is None and len(judged.fit.shifts) > 1
    if many:
        # what many outliers seem to be, noise that grows may be: it then leaves no heavy tails
        growth = growth_of(refit(problem))
    if growth is None:
        return judged
    level = judge(replace(problem, growth=growth))
    if many and outliers.heavy_tails(level.problem, level.fit) < UNEQUAL_P:
        return judged
    # without the largest readings the growth seems smaller than it is
    growth = growth_of(level.doubted or refit(problem, shifts=level.fit.shifts))
    return level if growth is None else judge(replace(problem, growth=growth))


def _with_moving_positions(
    problem: Problem, fit: gls.Fit, refit: Callable[[tuple[Shift, ...]], gls.Fit]
) -> gls.Fit | None:
    """Return a fit without the outliers of one that is not accepted, if they are free positions and explain it."""
    if problem.free is None or fit.shifts:
        return None
    most = outliers.most_outliers(problem)
    without = outliers.search(problem, fit, refit, most)
    moving = bool(without.shifts) and all(shift.channel == gls.MODULUS for shift in without.shifts)
    return without if moving and gls.lack_of_fit(problem, without).accepted() else None


def _birge(test: LackOfFit, shared: SharedErrorFit) -> float:
    """Return the Birge ratio that widens u for a lack of fit; 1 if shared variance components explain it.

    It is the root of the reduced chi-square. Source: R. T. Birge, Phys. Rev. 40 (1932) 207.
    """
    if shared.components or not test.shown or test.dof <= 0:
        return 1.0
    return max(1.0, float(np.sqrt(test.chi2 / test.dof)))


def _of_assumed(problem: Problem, fit: gls.Fit, assumed: frozenset[str], by: Estimator) -> Floats:
    """Return the part (12, 12) of the covariance due to stand angles whose size is only assumed."""
    names = [STAND_ANGLES[unknown.column] for unknown in problem.stand]
    places = [j for j, name in enumerate(names) if name in assumed]
    if not places:
        return np.zeros((FIXED, FIXED))
    if by.gain is not None:
        own = problem.jacobian(fit.block, fit.others)[:, :, FIXED:]
        kept = np.isin(np.arange(own.shape[2]), places)
        parts = np.einsum("pni,niq->pq", fit.gain, problem.by_prior(own * kept))
        return np.asarray(parts @ parts.T)
    at = FIXED + np.array(places)
    across = fit.covariance[:FIXED, at]
    return np.asarray(across @ np.linalg.solve(fit.covariance[np.ix_(at, at)], across.T))


def _whole(oriented: Floats, chosen: FittedRows, rows: int) -> Floats:
    whole = np.zeros((rows, 3))
    whole[chosen.oriented_rows] = oriented
    return whole


def _whole_gain(oriented: Floats, free: Floats, chosen: FittedRows, rows: int) -> Floats:
    """Return the map (12, rows, 3) from the whole table's signals to the coefficients; unused rows are zero."""
    whole = np.zeros((FIXED, rows, 3))
    whole[:, chosen.oriented_rows] = oriented[:FIXED]
    whole[:, chosen.free_rows] = free[:FIXED]
    return whole


def _assumed(problem: Problem, block: Block, gain: Floats, unit: str, *, stated: bool) -> tuple[str, ...]:
    if not problem.upper:
        return assumptions(problem, block, gain[:FIXED], unit)
    return (
        message(
            "common rotation of the block's axes: no free position shows it; by convention K is upper "
            "triangular (axis z along channel z, axis y in the plane of channels y and z)"
        ),
        message(
            "sign of each channel: no free position shows it; every scale factor has the sign that the bench file "
            "states"
        )
        if stated
        else message(
            "sign of each channel: no free position shows it; every scale factor is stated positive"
        ),
        GAIN,
        GRAVITY,
    )


def _stand(problem: Problem, fit: gls.Fit) -> dict[str, Estimate]:
    """Return the estimated stand angles by name, in arcseconds."""
    found = _estimates(problem, fit)[: len(problem.stand)]
    return {
        name: Estimate(value / ARCSEC, u / ARCSEC, "arcsec", unknown.prior_u / ARCSEC)
        for (name, value, u), unknown in zip(found, problem.stand, strict=True)
    }


def _effects(problem: Problem, fit: gls.Fit) -> dict[str, Estimate]:
    """Return the estimated effect parameters by name, in the units of the catalogue."""
    found = _estimates(problem, fit)[len(problem.stand) :]
    sizes = [problem.parameter(unknown) for unknown in problem.effects]
    return {
        name: Estimate(value / p.si_per_unit, u / p.si_per_unit, p.unit)
        for (name, value, u), p in zip(found, sizes, strict=True)
    }


def _estimates(problem: Problem, fit: gls.Fit) -> list[tuple[str, float, float]]:
    """Return name, value and u (SI) of each unknown other than the coefficients."""
    u = u_of(fit.covariance)[FIXED:]
    return list(zip(problem.names(), fit.others.tolist(), u.tolist(), strict=True))
