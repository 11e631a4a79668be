"""The combined uncertainty of a calibration: from its readings, and from bench errors that no reading shows.

Each error acts on measured readings as on planned ones, and through the estimator's linear map on the
coefficients. A plan's budget therefore agrees with the calibration of its readings if the noise is the same.
Source: JCGM 100:2008 (GUM), 4.3 and 5.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import date
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import ARCSEC, Floats, Ints
from bench.base.languages import message
from bench.base.text import listed
from bench.calibration.budget.coefficients import MeasuredReadings, meters_of, parts_of
from bench.calibration.budget.error_source import NAME, ErrorSource, TiltRate, foundation_of
from bench.calibration.budget.meters import KnownMeters
from bench.calibration.budget.propagation import effective_dof
from bench.calibration.budget.sources import ROLL_ORIGIN, assumed_stand, hidden_sources
from bench.calibration.components import shared_later, walk_since
from bench.calibration.result import Calibration, Component, SourceOfError, widening
from bench.config.bench_file.file import BenchFile
from bench.model import Block, ForwardModel
from bench.model.geometry import COEFFICIENTS, modulus_slopes
from bench.readings.corrected import VOLTS
from bench.readings.table import VERIFICATION, Readings

GRAVITY: Final = "gravity"
METERS: Final = ("voltmeter_gain", "voltmeter_offset")
"""Sources whose error is the same whenever the same voltmeters read the block."""
OF_BLOCK: Final = ("K2", "K3")
"""Sources whose error belongs to the block and is the same in every calibration and check."""


def sign(
    calibration: Calibration,
    readings: Readings,
    bench: BenchFile,
    model: ForwardModel,
    day: date | None = None,
    meters: KnownMeters | None = None,
) -> Calibration:
    """Return the calibration with its combined covariance, which adds errors that its readings do not show.

    `readings` is the whole table of the calibration, `day` its date, `meters` the learned errors of the voltmeters.
    For readings in another unit than volts, a note says that errors of voltmeters are left out.
    """
    repeats = tuple(_zero_repeats(calibration, bench))
    taken = _taken(calibration, readings, bench)
    of_bench = _acting(calibration, readings, bench, model, day, meters)
    own = tuple(_source(error, taken, calibration.gain) for error in of_bench if error.name != GRAVITY)
    roll = calibration.covariance - calibration.covariance_readings
    moving = _foundation(readings, bench)
    if moving is not None:
        parts = moving.parts(
            taken.conditions, taken.block, taken.setting_slope, model.installations, calibration.gain
        )
        tilts = parts @ parts.T
        own = (
            SourceOfError(NAME, "α1, α2", moving.shown, moving.origin, moving.prior, moving.dof, tilts), *own,
        )  # fmt: skip
    own += repeats
    if np.any(np.diag(roll) > 0):
        own = (_roll(bench, roll), *own)
    covariance = calibration.covariance_readings + sum((s.covariance for s in own), np.zeros((12, 12)))
    gravity = [error.u for error in of_bench if error.name == GRAVITY]
    signed = replace(
        calibration, covariance=covariance, sources=own, gravity_u=gravity[0] if gravity else 0.0,
        notes=(*calibration.notes, *_on_roll(roll, covariance, calibration), *without_meters(readings.unit)),
    )  # fmt: skip
    return replace(signed, dof=dof_through(signed, np.eye(len(COEFFICIENTS))))


def dof_through(calibration: Calibration, jacobian: Floats, known: float | Floats = 0.0) -> Floats:
    """Return the effective degrees of freedom (m,) of quantities computed from a calibration's coefficients.

    The calibration must have its combined covariance. `jacobian` (m, 12) has the derivatives of the quantities;
    `known` is an additional variance with infinite degrees of freedom.
    """
    if not calibration.sources:
        return np.full(len(jacobian), np.inf)
    parts = [calibration.covariance_readings, *(s.covariance for s in calibration.sources)]
    variances = [np.sum((jacobian @ part) * jacobian, axis=1) for part in parts]
    variances.append(np.broadcast_to(np.asarray(known, dtype=np.float64), len(jacobian)))
    dof = [calibration.noise.reading_dof, *(s.dof for s in calibration.sources), np.inf]
    return effective_dof(np.stack(variances, axis=1), dof)


def _zero_repeats(calibration: Calibration, bench: BenchFile) -> Iterator[SourceOfError]:
    """Yield the scatter of the zeros between repeats, if the bench file states it."""
    stated = bench.uncertainty.zero_repeats
    if stated is None:
        return
    own = np.zeros((12, 12))
    if stated.scale is not None:
        own[9:, 9:] = np.diag(np.array(stated.scale) ** 2 * np.diag(calibration.covariance_readings)[9:])
        shown = ", ".join(f"{one:.3g} u" for one in stated.scale)
    else:
        sizes = np.array(stated.restart or stated.drift)
        own[9:, 9:] = calibration.block.K @ np.diag(sizes**2) @ calibration.block.K.T
        shown = ", ".join(f"{1e3 * one:.3g} mg" for one in sizes.tolist())
    yield SourceOfError("zero_repeats", "U0", shown, message("stated in the bench file"), False, np.inf, own)


def _foundation(readings: Readings, bench: BenchFile) -> TiltRate | None:
    return foundation_of(readings, bench, levelled=readings.conditions().level_rad is not None)


def _on_roll(roll: Floats, covariance: Floats, calibration: Calibration) -> tuple[str, ...]:
    """Return advice to measure the third mounting angle if it causes most of the u of a coefficient.

    `roll` (12, 12) is the part of `covariance` (12, 12) that this angle causes. If the readings determine the nine
    intrinsic numbers, no further installation reduces this part.
    """
    most = [
        n
        for n, part, u2 in zip(COEFFICIENTS, np.diag(roll), np.diag(covariance), strict=True)
        if part > 0.5 * u2
    ]
    if not most:
        return ()
    if _only_turns(calibration):
        return (
            message(
                f"most of u of {listed(most)} comes from the third mounting angle, as a turn common to all "
                "installations, which changes none of the nine; state a measured mounting_roll in the bench file"
            ),
        )
    return (
        message(
            f"most of u of {listed(most)} comes from the third mounting angle, which these installations do "
            "not show; use the procedure remount-90, or state a measured mounting_roll in the bench file"
        ),
    )


def _only_turns(calibration: Calibration) -> bool:
    """Return whether every change that no reading shows is a rotation of the block, which leaves K K^T and U0."""
    length = np.linalg.norm(calibration.block.K, axis=1)
    sheared = [
        (change[:9].reshape(3, 3) @ calibration.block.K.T) / np.outer(length, length)
        for change in calibration.unseen().T
    ]
    biases = calibration.unseen()[9:] / length[:, None]
    return all(np.all(np.abs(one + one.T) < TURNED) for one in sheared) and bool(
        np.all(np.abs(biases) < TURNED)
    )


TURNED: Final = 0.1
"""Relative change of K K^T, or of a bias in g, below which a change of K of size 1 is a turn of the block."""


OF_METERS: Final = (
    *METERS, "voltmeter_linearity", "reference_noise", "room_temperature", "meter_temperature",
)  # fmt: skip
"""Sources that act only on readings in volts: errors of the bench's voltmeters."""


def without_meters(unit: str) -> tuple[str, ...]:
    """Return a note that u leaves out the errors of voltmeters, for readings in another `unit` than volts."""
    if unit == VOLTS:
        return ()
    return (
        message(
            f"the readings are in {unit}, not in volts: u does not contain the errors of this bench's voltmeters"
        ),
    )


def acting_sources(
    unit: str,
    bench: BenchFile,
    model: ForwardModel,
    day: date | None = None,
    meters: KnownMeters | None = None,
) -> list[ErrorSource]:
    """Return those of the `hidden_sources` whose errors act on readings in `unit`.

    Errors of voltmeters act on readings in volts only. For the arguments after `unit` see `hidden_sources`.
    """
    found = hidden_sources(bench, model, day, meters)
    return [error for error in found if unit == VOLTS or error.kind not in OF_METERS]


def delta_g_elsewhere(
    block: Block, covariance: Floats, noise: Floats, readings: Readings, bench: BenchFile, model: ForwardModel,
    *, same_meters: bool, day: date | None = None, block_terms: Floats | None = None,
    meters: KnownMeters | None = None, calibrated_c: float | None = None, shared: Iterable[Component] = (),
    wander: Floats | None = None,
) -> Floats:  # fmt: skip
    """Return the covariance (v, v) of |a|, local g², at verification rows, from coefficients of another day.

    `covariance` (12, 12) is that of the coefficients, `noise` (3,) the noise of the signals. With
    `same_meters` the meters' gain and offset cancel, so `covariance` must exclude them; otherwise the gain
    and offset errors of today's meters are added. All other errors of the readings count in full.
    `block_terms` (12, q), as in `Calibration`, are the changes of the coefficients by K2 and K3. They are
    correlated with the changes of the readings at the points by K2 and K3. `calibrated_c` is the temperature
    of the block, °C, at its calibration; None stands for that of the readings. `shared` are the errors that the
    readings of the calibration share, `wander` (3,) is the rms wander of its biases.
    """
    rows = np.flatnonzero(readings.installation == VERIFICATION)
    taken = MeasuredReadings(readings, block, meters_of(bench), np.zeros((len(readings), 3)), calibrated_c)
    by_coefficient, by_signal = modulus_slopes(taken.force[rows], block)
    own = variance_at_points(readings, noise)
    whole = by_coefficient @ covariance @ by_coefficient.T + np.diag(np.sum(by_signal**2 * own, axis=1))
    whole += _shared_at(rows, shared, noise, readings, block, by_signal)
    if wander is not None:
        # as in a comparison: a random walk is sqrt(2) times its rms from its mean at the start of a run
        wandered = by_signal * np.sqrt(2.0) * wander
        whole += wandered @ wandered.T
    functionals = np.zeros((len(rows), len(readings), 3))
    functionals[np.arange(len(rows)), rows] = by_signal
    of_block = np.zeros((len(rows), 0))
    for error in acting_sources(readings.unit, bench, model, day, meters):
        if error.name == GRAVITY or (same_meters and error.kind in METERS):
            continue
        parts = parts_of(error, taken, functionals)
        whole += parts @ parts.T
        if error.kind in OF_BLOCK:
            of_block = np.concatenate([of_block, parts], axis=1)
    if block_terms is not None and block_terms.shape[1] == of_block.shape[1]:
        across = of_block @ (by_coefficient @ block_terms).T
        whole += across + across.T
    return np.asarray(whole)


NOISIER_P: Final = 0.01
"""P-value below which the samples at the verification points scatter more than those of the calibration."""


def scatter_of_samples(readings: Readings) -> tuple[Floats, float]:
    """Return the variance (3,) of a mean of samples, by their scatter, and its degrees of freedom (0: unknown)."""
    known = np.isfinite(readings.signal_sd).all(axis=1) & (readings.samples > 1)
    free = readings.samples[known] - 1.0
    of_mean = readings.signal_sd[known] ** 2 / readings.samples[known, None]
    return np.asarray((free @ of_mean) / max(float(free.sum()), 1.0)), float(free.sum())


def variance_at_points(readings: Readings, noise: Floats, fitted: Readings | None = None) -> Floats:
    """Return the variance (3,) of a signal at the verification points, by the `noise` (3,) of the calibration.

    If the samples at the points scatter significantly more than those of the `fitted` readings (None: than the
    noise), the excess is added: they may be fewer, shorter or coarser.
    """
    rows = readings.verification()
    scatter, own_dof = scatter_of_samples(rows)
    known, dof = (noise**2, 0.0) if fitted is None else scatter_of_samples(fitted)
    excess = np.zeros(3)
    if own_dof > 0:
        if not dof > 0:
            known, dof = noise**2, np.inf
        above = scatter / np.maximum(known, 1e-300)
        p = special.chdtrc(own_dof, own_dof * above) if np.isinf(dof) else special.fdtrc(own_dof, dof, above)
        excess = np.where(p < NOISIER_P / 3, widening(own_dof) ** 2 * scatter - known, 0.0)
    return np.asarray(np.maximum(noise**2 + excess, rows.resolution**2 / 12.0))


def delta_g_contributions(
    calibration: Calibration,
    readings: Readings,
    bench: BenchFile,
    model: ForwardModel,
    day: date | None = None,
    meters: KnownMeters | None = None,
) -> dict[str, Floats]:
    """Return the contributions, by name, to the covariance (v, v) of |a| at the verification rows, local g².

    Their sum is the covariance. An error that acts alike on calibration and check, such as the gain of a meter,
    cancels. The noise of the readings at the points is a separate contribution.
    """
    rows = np.flatnonzero(readings.installation == VERIFICATION)
    taken = _taken(calibration, readings, bench)
    by_coefficient, by_signal = modulus_slopes(taken.force[rows], calibration.block)
    functionals = np.einsum("vp,pni->vni", by_coefficient, calibration.gain)
    functionals[np.arange(len(rows)), rows] += by_signal
    at_points = variance_at_points(readings, calibration.noise.widened().by_channel, calibration.fitted)
    noise = np.diag(np.sum(by_signal**2 * at_points, axis=1))
    found = {
        "noise_and_stand": by_coefficient @ calibration.covariance_readings @ by_coefficient.T,
        **{
            s.name: by_coefficient @ s.covariance @ by_coefficient.T
            for s in calibration.sources
            if s.name == "mounting_roll"
        },
        "reading_at_the_point": noise,
    }
    shared = _shared_at(
        rows, calibration.shared, calibration.noise.by_channel, readings, calibration.block, by_signal
    )
    if np.any(shared):
        found["errors_that_readings_share"] = shared
    if calibration.drift is not None:
        # U0 is the mean over the run, and the biases wander further until the check
        time_s = readings.conditions().elapsed_s
        used = np.any(calibration.gain != 0.0, axis=(0, 2))
        gone = walk_since(time_s[used], time_s[rows])
        for c, size in enumerate(calibration.drift.size.tolist()):
            drifted = size**2 * gone * np.outer(by_signal[:, c], by_signal[:, c])
            found["drift"] = found.get("drift", 0.0) + drifted
    for error in _acting(calibration, readings, bench, model, day, meters):
        if error.name != GRAVITY:
            parts = parts_of(error, taken, functionals)
            found[error.name] = parts @ parts.T
    moving = _foundation(readings, bench)
    if moving is not None:
        parts = moving.parts(
            taken.conditions, taken.block, taken.setting_slope, model.installations, functionals
        )
        found[NAME] = parts @ parts.T
    return found


def _shared_at(
    rows: Ints,
    shared: Iterable[Component],
    noise: Floats,
    readings: Readings,
    block: Block,
    by_signal: Floats,
) -> Floats:
    """Return the covariance (v, v), local g², of |a| at the verification rows due to shared errors.

    The kinds of error are those that the fitted readings share; these rows have errors of their own.
    """
    at = readings.installation == VERIFICATION
    output = readings.signal[rows] - block.U0
    return shared_later(shared, noise, readings.conditions().select(at), output, by_signal)


def _taken(calibration: Calibration, readings: Readings, bench: BenchFile) -> MeasuredReadings:
    known = calibration.temperatures_c
    at_c = float(np.mean(known)) if len(known) else None
    return MeasuredReadings(readings, calibration.block, meters_of(bench), calibration.slope, at_c)


def _acting(
    calibration: Calibration,
    readings: Readings,
    bench: BenchFile,
    model: ForwardModel,
    day: date | None,
    meters: KnownMeters | None,
) -> list[ErrorSource]:
    """Return the errors that no reading shows.

    The meters' nonlinearity is left out if repeats share an error at least as large, which then includes it. The
    effects of the meters' temperature are left out if this temperature is recorded: the model corrects them.
    """
    read = readings.conditions().meter_c is not None
    shown = max((c.size for c in calibration.shared if c.what == "setting"), default=0.0)
    return [
        error
        for error in acting_sources(calibration.unit, bench, model, day, meters)
        if (error.kind != "voltmeter_linearity" or error.u > shown)
        and not (read and error.kind == "meter_temperature")
    ]


def _source(error: ErrorSource, taken: MeasuredReadings, gain: Floats) -> SourceOfError:
    parts = parts_of(error, taken, gain)
    return SourceOfError(
        error.name, error.symbol, error.shown, error.origin, error.prior, error.dof, parts @ parts.T,
        cancels=error.kind in METERS, of_block=parts if error.kind in OF_BLOCK else None,
    )  # fmt: skip


def _roll(bench: BenchFile, covariance: Floats) -> SourceOfError:
    size = assumed_stand(bench)["mounting_roll"].u
    return SourceOfError(
        "mounting_roll", "α5", f"{size / ARCSEC:.3g} arcsec", ROLL_ORIGIN, True, np.inf, covariance
    )
