"""Uncertainty of voltmeters and thermometers: certificate, drift, maker's limits, learned differences."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message
from bench.calibration.budget.propagation import effective_dof
from bench.calibration.noise import METERS_DRIFT
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.stand import ErrorSize
from bench.config.devices.device import Certificate, CertifiedGain, CertifiedOffset
from bench.config.devices.registry import UnknownVoltmeter
from bench.config.devices.sections import DAYS_90, VoltmeterForm
from bench.model.geometry import Distribution
from bench.stats import contrasts_within

Quantity = Literal["voltmeter_gain", "voltmeter_offset"]

UNKNOWN_AGE: Final = 1.0
"""Assumed years since a calibration, where neither the day of the readings nor the end of validity is known."""

USUAL_ACCURACY: Final = (20e-6, 5e-6)
USUAL_LINEARITY: Final = (2e-6, 1e-6)
"""90-day linearity limits, as fractions of reading and range, of a voltmeter whose driver is missing.

These are the limits of a 34401A on 10 V; other meters of 6½ digits meet them, too.
"""

_SHOWN: Final = {"voltmeter_gain": (1e6, "ppm"), "voltmeter_offset": (1e6, "µV")}


@dataclass(frozen=True)
class Size:
    """The distribution of an error, its origin and degrees of freedom; with `prior` nobody stated it."""

    distribution: Distribution
    origin: str
    dof: float = math.inf
    prior: bool = False

    @classmethod
    def stated(cls, size: ErrorSize) -> Size:
        """Return the distribution that the bench file states."""
        return cls(size.to_distribution(), message("bench file"), size.dof)


def size_of(quantity: Quantity, meter: VoltmeterForm, day: datetime.date | None) -> Size:
    """Return the uncertainty of a meter's relative gain, or of its zero in V, on the day of the readings.

    With a certificate, u² = (U / k)² + a² / 3. Here a is the drift since the calibration: the certified drift per
    year times the years, or else the maker's limits for that time. If `day` is None, the drift is that until the
    certificate's validity ends. Without a certificate, the maker's 90-day limits apply. Source: JCGM 100:2008,
    4.3.3, 4.3.7, (G.2b).
    """
    found = _certified(quantity, meter)
    if meter.certificate is None or found is None:
        limit = _limit(quantity, meter, 0.0)
        return Size(Distribution(limit, "rectangular"), _data_sheet(meter), prior=True)
    years = _age(meter.certificate, day)
    drift = _limit(quantity, meter, years) if found.drift is None else found.drift * years
    parts = found.U / found.k, drift / math.sqrt(3.0)
    scale, unit = _SHOWN[quantity]
    drifts = message(f"the maker's limits for {years:.2g} years")
    if found.drift is not None:
        drifts = message(f"{found.drift * scale:.3g} {unit}/year in {years:.2g} years")
    origin = message(
        f"certificate {meter.certificate.number} of {meter.certificate.date}: U = {found.U * scale:.3g} {unit}, "
        f"k = {found.k:g}; drift: {drifts}"
    )
    dof = effective_dof(np.square([parts]), [found.dof, math.inf])
    return Size(Distribution(math.hypot(*parts)), origin, float(dof[0]), prior=found.drift is None)


def may_move(quantity: Quantity, meter: VoltmeterForm) -> float:
    """Return the standard uncertainty due to 90 days of drift: of a meter's relative gain, or of its zero in V."""
    found = _certified(quantity, meter)
    drift = _limit(quantity, meter, 0.0) if found is None or found.drift is None else found.drift * DAYS_90
    return drift / math.sqrt(3.0)


def _certified(quantity: Quantity, meter: VoltmeterForm) -> CertifiedGain | CertifiedOffset | None:
    values = meter.certificate and meter.certificate.of_range(meter.range)
    if not values:
        return None
    return values.gain if quantity == "voltmeter_gain" else values.offset


def linearity_of(meter: VoltmeterForm, largest_v: float) -> Size:
    """Return the distribution of a meter's nonlinearity, V, for signals up to `largest_v`.

    It is rectangular within the maker's limit.
    """
    of_reading, of_range = USUAL_LINEARITY if isinstance(meter, UnknownVoltmeter) else meter.kind.linearity
    limit = of_reading * largest_v + of_range * meter.range
    return Size(Distribution(limit, "rectangular"), _data_sheet(meter), prior=True)


def _data_sheet(meter: VoltmeterForm) -> str:
    if isinstance(meter, UnknownVoltmeter):
        return message(
            f"the driver {meter.driver} is missing: assumed as a meter of 6½ digits on {meter.range:g} V"
        )
    return message(f"{meter.driver}, limits of 90 days on {meter.range:g} V")


def _limit(quantity: Quantity, meter: VoltmeterForm, years: float) -> float:
    if isinstance(meter, UnknownVoltmeter):
        of_reading, of_range = (part * max(1.0, years / DAYS_90) for part in USUAL_ACCURACY)
    else:
        of_reading, of_range = meter.kind.limits_after(years, meter.range)
    return of_reading if quantity == "voltmeter_gain" else of_range * meter.range


def _age(certificate: Certificate, day: datetime.date | None) -> float:
    """Return the years from calibration to `day` or, if unknown, to the end of the certificate's validity."""
    if day is not None:
        return certificate.years_until(day)
    return (
        UNKNOWN_AGE if certificate.valid_until is None else certificate.years_until(certificate.valid_until)
    )


CONTRADICTS_P: Final = 0.01
"""P-value below which learned differences contradict certificates and makers' limits, and are not used."""


@dataclass(frozen=True)
class LearnedDifferences:
    """Differences of M meters from the mean of their group: `values` (M,) with `covariance` (M, M).

    They are learned from other runs. Meters with the same number in `group` were compared with each other.
    """

    values: Floats
    covariance: Floats
    group: tuple[int, ...]


@dataclass(frozen=True)
class JointErrors:
    """Joint errors of the n voltmeters of a bench, given learned differences: `mean` (n,), `covariance` (n, n)."""

    mean: Floats
    covariance: Floats

    @property
    def u(self) -> float:
        """Root mean square of the standard uncertainties of the n errors."""
        return float(np.sqrt(np.mean(np.diag(self.covariance))))

    @property
    def root(self) -> tuple[tuple[float, ...], ...]:
        """Matrix (n, n) that turns n independent draws into errors with this covariance.

        Each draw has the standard deviation `u`.
        """
        size, axes = np.linalg.eigh(self.covariance)
        root = axes * np.sqrt(np.maximum(size, 0.0)) / max(self.u, 1e-300)
        return tuple(tuple(row) for row in root.tolist())


def joint_errors(
    told: LearnedDifferences, at: Sequence[int | None], prior_u: Floats, certified: Mask, kept: float
) -> JointErrors | str:
    """Return the joint errors of n meters given learned differences, or the reason not to use these.

    `at` has the index of each meter in the learned differences `told`, None for a meter not among them. `prior_u`
    (n,) are the standard uncertainties by certificates or makers' limits; `certified` (n,) marks the meters with
    certificates. `kept` is the correlation of a meter's error with its error on the day of learning.
    """
    n = len(prior_u)
    places = [place if place is not None else -1 for place in at]
    group = np.array([told.group[place] if place >= 0 else -1 - k for k, place in enumerate(places)])
    basis = contrasts_within(group)
    if not basis.shape[1]:
        return message("no two of these meters were compared")
    if np.all(certified):
        return message("certificates cover all of it")
    values = np.where(np.array(places) >= 0, told.values[places], 0.0)
    own = told.covariance[np.ix_(places, places)]
    difference, spread = basis.T @ values, basis.T @ own @ basis
    prior = np.diag(prior_u**2)
    expected = basis.T @ prior @ basis + spread
    chi2 = float(difference @ np.linalg.solve(expected, difference))
    if special.chdtrc(len(difference), chi2) < CONTRADICTS_P:
        return message("they contradict certificates or makers' limits: have the voltmeters calibrated")
    gain = kept * prior @ basis @ np.linalg.inv(expected)
    found = JointErrors(gain @ difference, prior - kept * gain @ basis.T @ prior)
    found = _as_certified(found, prior, certified)
    covariance = found.covariance.copy()
    for number in np.unique(group):
        same = group == number
        free = same & ~certified
        # no difference shows an error that all meters share: averaging limits must not make it smaller
        left = np.sqrt(np.maximum(np.min(prior_u[same]) ** 2 - np.diag(covariance), 0.0)) * free
        covariance += np.outer(left, left)
    if np.any(np.diag(covariance) > (1 + 1e-9) * prior_u**2):
        return message("the certificates are worse than the makers' limits")
    return JointErrors(found.mean[:n], covariance)


def _as_certified(found: JointErrors, prior: Floats, certified: Mask) -> JointErrors:
    """Return joint errors in which certified meters keep their certified u and have no mean error.

    The errors of the other meters have their conditional distribution, given the errors of the certified meters.
    """
    if not np.any(certified):
        return found
    a, rest = np.flatnonzero(certified), np.flatnonzero(~certified)
    own = found.covariance[np.ix_(a, a)]
    by = found.covariance[np.ix_(rest, a)] @ np.linalg.inv(own)
    mean, covariance = np.zeros(len(found.mean)), prior.copy()
    mean[rest] = found.mean[rest] - by @ found.mean[a]
    stated = prior[np.ix_(a, a)]
    covariance[np.ix_(rest, a)] = by @ stated
    covariance[np.ix_(a, rest)] = stated @ by.T
    covariance[np.ix_(rest, rest)] = (
        found.covariance[np.ix_(rest, rest)] - by @ own @ by.T + by @ stated @ by.T
    )
    return JointErrors(mean, covariance)


# --- the voltmeters of a bench --------------------------------------------------------------------------


@dataclass(frozen=True)
class LearnedMeters:
    """Learned differences of relative gain and of zero (V) between the meters `meters`, as of `day`."""

    meters: tuple[str, ...]
    day: datetime.date
    gain: LearnedDifferences
    zero: LearnedDifferences


@dataclass(frozen=True)
class KnownMeters:
    """The errors of a bench's voltmeters that follow from learned differences between them.

    `quantities` maps the name of a source to its distribution and the joint errors of the meters. The
    corrected readings of x, y and z are U (1 + `gain`) + `offset_v`.
    """

    quantities: Mapping[str, tuple[Size, JointErrors]]
    gain: tuple[float, float, float]
    offset_v: tuple[float, float, float]


def known_meters(
    bench: BenchFile, day: datetime.date, meters: Sequence[str], learned: LearnedMeters
) -> tuple[KnownMeters | None, tuple[str, ...]]:
    """Return the voltmeters' errors on `day` given learned differences between the meters, and notes.

    `meters` are the identities of the voltmeters. The errors are None if no learned difference is used; the notes
    say why.
    """
    apart = abs((day - learned.day).days) / METERS_DRIFT.days
    kept = math.sqrt(max(1.0 - apart**2, 0.0))
    at = [learned.meters.index(meter) if meter in learned.meters else None for meter in meters]
    origin = message(f"differences learned from exchanged voltmeters, {learned.day}")
    found: dict[str, tuple[Size, JointErrors]] = {}
    notes = []
    every: tuple[tuple[Quantity, str, LearnedDifferences], ...] = (
        ("voltmeter_gain", message("the gains"), learned.gain),
        ("voltmeter_offset", message("the zeros"), learned.zero),
    )  # fmt: skip
    for name, words, told in every:
        stated = getattr(bench.uncertainty, name)
        forms = bench.instruments.voltmeters
        sizes = [size_of(name, meter, day) for meter in forms]
        if stated is not None:
            sizes = [Size.stated(stated)] * len(forms)
        certified = np.array([stated is None and _certified(name, meter) is not None for meter in forms])
        if kept == 0.0:
            own: JointErrors | str = message(
                f"in {METERS_DRIFT.days} days voltmeters may drift through their limits"
            )
        else:
            own = joint_errors(told, at, np.array([size.distribution.u for size in sizes]), certified, kept)
        if isinstance(own, str):
            notes.append(
                message(f"what was learned of how {words} of the voltmeters differ is not used: {own}")
            )
            continue
        origins = "; ".join(dict.fromkeys(size.origin for size in sizes))
        size = Size(
            Distribution(own.u),
            f"{origins}; {origin}",
            min(s.dof for s in sizes),
            any(s.prior for s in sizes),
        )
        found[name] = size, own
    if not found:
        return None, tuple(notes)
    notes.append(
        message(f"readings corrected by the {origin}; what the voltmeters have in common stays as stated")
    )
    return KnownMeters(
        found, _added(found, bench, "voltmeter_gain"), _added(found, bench, "voltmeter_offset")
    ), tuple(notes)


def _added(
    found: Mapping[str, tuple[Size, JointErrors]], bench: BenchFile, name: str
) -> tuple[float, float, float]:
    by_channel = dict.fromkeys(CHANNELS, 0.0)
    if name in found:
        for meter, mean in zip(bench.instruments.voltmeters, found[name][1].mean.tolist(), strict=True):
            for channel in meter.channels:
                by_channel[channel] = -mean
    return by_channel["x"], by_channel["y"], by_channel["z"]


GRADIENT: Final = Distribution(0.2, "rectangular")
"""Prior of the temperature difference between a thermometer at the block and its accelerometers, K."""


def thermometer_size(bench: BenchFile) -> Size | None:
    """Return the uncertainty of the measured temperature of the block, K.

    The result is None if the bench file has neither a thermometer nor a certificate of the chamber: the band
    of the air temperature, an error source of its own, then covers the error.
    """
    told_by = bench.instruments.thermometer or bench.instruments.chamber
    certificate = None if told_by is None else told_by.certificate
    size: Size | None = None
    if certificate is not None:
        worst = max(certificate.values, key=lambda value: value.U / value.k)
        origin = message(
            f"certificate {certificate.number} of {certificate.date}: the largest U, k = {worst.k:g}"
        )
        size = Size(Distribution(worst.U, k=worst.k), origin, worst.dof)
    thermometer = bench.instruments.thermometer
    if thermometer is None:
        return size
    if size is None:
        limit = Distribution(thermometer.tolerance_k, "rectangular")
        origin = message(f"no certificate: ±{limit.limit:.2g} K, as for instruments of its type")
        size = Size(limit, origin, prior=True)
    stated = thermometer.gradient
    gradient = GRADIENT if stated is None else Distribution(stated, "rectangular")
    origin = message(
        f"{size.origin}; ±{gradient.limit:g} K to the block{' as usual' if stated is None else ''}"
    )
    both = Distribution(math.hypot(size.distribution.u, gradient.u))
    return Size(both, origin, size.dof, size.prior or stated is None)


# --- 1/f noise of a reference ------------------------------------------------------------------------

HALF_WAVES: Final = 16
"""Largest number of half waves of 1/f noise over a run: faster ones resemble the noise of readings."""
FLICKER_RMS: Final = float(np.sqrt(np.sum(1.0 / np.arange(1, HALF_WAVES + 1)) / np.log(10.0)))
"""Root mean square of these waves for a standard deviation of 1 per decade of frequency."""


def flicker_waves(time_s: Floats) -> Floats:
    """Return waves (n, 16) at the times (n,) whose random sum is 1/f noise.

    In the sum each wave is multiplied by an independent standard normal number. The noise has a standard deviation
    of 1 per decade of frequency. The waves have a half to eight periods over the times; slower parts are constant,
    faster ones resemble noise without correlation.
    """
    span = float(np.ptp(time_s))
    if not span > 0.0:
        return np.zeros((len(time_s), HALF_WAVES))
    k = np.arange(1, HALF_WAVES + 1)
    # a decade has the variance 1, so wave k of the mean square 1/2 has the variance 1/(k ln 10)
    wave = np.cos(np.pi * k * (time_s[:, None] - time_s.min()) / span)
    return np.asarray(np.sqrt(2.0 / (k * np.log(10.0))) * wave)
