"""How well each voltmeter is known: by its certificate with its drift since, else by its maker's limits."""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from bench.analysis.budget.propagation import effective_dof
from bench.devices.certificates import Certificate, CertifiedGain, CertifiedOffset
from bench.devices.unknown import UnknownVoltmeter
from bench.devices.voltmeters import DAYS_90, VoltmeterForm
from bench.model import Distribution

Quantity = Literal["voltmeter_gain", "voltmeter_offset"]

UNKNOWN_AGE: Final = 1.0
"""Years since the calibration where nobody says of which day the readings are, nor until when it counts."""

USUAL_ACCURACY: Final = (20e-6, 5e-6)
USUAL_LINEARITY: Final = (2e-6, 1e-6)
"""Limits of 90 days of a meter of 6½ digits on 10 V, parts of reading and of range, where a recorded run had
one that nobody here knows: those of a 34401A, which the others here keep, too."""

_SHOWN: Final = {"voltmeter_gain": (1e6, "ppm"), "voltmeter_offset": (1e6, "µV")}


@dataclass(frozen=True)
class Size:
    """How large an error may be: its distribution, where that is from, its degrees of freedom, whether a prior."""

    distribution: Distribution
    origin: str
    dof: float = math.inf
    prior: bool = False


def size_of(quantity: Quantity, meter: VoltmeterForm, day: datetime.date | None) -> Size:
    """Return what is left of a meter's gain (1) or zero (V) on its range, on the day of the readings.

    With a certificate u² = (U / k)² + a² / 3, a being the drift since: its drift per year times the years, else the
    maker's limits for that time. JCGM 100:2008, 4.3.3, 4.3.7, (G.2b). Without one the maker's limits of 90 days.
    """
    found = _certified(quantity, meter)
    if meter.certificate is None or found is None:
        limit = _limit(quantity, meter, 0.0)
        return Size(Distribution(limit, "rectangular"), _data_sheet(meter), prior=True)
    years = _age(meter.certificate, day)
    drift = _limit(quantity, meter, years) if found.drift is None else found.drift * years
    parts = found.U / found.k, drift / math.sqrt(3.0)
    scale, unit = _SHOWN[quantity]
    whose = "the maker's limits for" if found.drift is None else f"{found.drift * scale:.3g} {unit}/year in"
    origin = (
        f"certificate {meter.certificate.number} of {meter.certificate.date}: U = {found.U * scale:.3g} {unit}, "
        f"k = {found.k:g}; drift: {whose} {years:.2g} years"
    )
    dof = effective_dof(np.square([parts]), [found.dof, math.inf])
    return Size(Distribution(math.hypot(*parts)), origin, float(dof[0]), prior=found.drift is None)


def may_move(quantity: Quantity, meter: VoltmeterForm) -> float:
    """Return u of how far a meter's gain (1) or zero (V) on its range may move within 90 days."""
    found = _certified(quantity, meter)
    drift = _limit(quantity, meter, 0.0) if found is None or found.drift is None else found.drift * DAYS_90
    return drift / math.sqrt(3.0)


def is_certified(quantity: Quantity, meter: VoltmeterForm) -> bool:
    """Whether a certificate states a meter's gain or zero on its range."""
    return _certified(quantity, meter) is not None


def _certified(quantity: Quantity, meter: VoltmeterForm) -> CertifiedGain | CertifiedOffset | None:
    values = meter.certificate and meter.certificate.of_range(meter.range)
    if not values:
        return None
    return values.gain if quantity == "voltmeter_gain" else values.offset


def linearity_of(meter: VoltmeterForm, largest_v: float) -> Size:
    """Return the limit of a meter's nonlinearity for signals up to `largest_v`, as its maker states it."""
    of_reading, of_range = USUAL_LINEARITY if isinstance(meter, UnknownVoltmeter) else meter.kind.linearity
    limit = of_reading * largest_v + of_range * meter.range
    return Size(Distribution(limit, "rectangular"), _data_sheet(meter), prior=True)


def _data_sheet(meter: VoltmeterForm) -> str:
    if isinstance(meter, UnknownVoltmeter):
        return f"the driver {meter.driver} is not here: as of a meter of 6½ digits on {meter.range:g} V"
    return f"{meter.driver}, limits of 90 days on {meter.range:g} V"


def _limit(quantity: Quantity, meter: VoltmeterForm, years: float) -> float:
    if isinstance(meter, UnknownVoltmeter):
        of_reading, of_range = (part * max(1.0, years / DAYS_90) for part in USUAL_ACCURACY)
    else:
        of_reading, of_range = meter.kind.limits_after(years, meter.range)
    return of_reading if quantity == "voltmeter_gain" else of_range * meter.range


def _age(certificate: Certificate, day: datetime.date | None) -> float:
    """Return the years since the calibration; as old as it may be where the day is not known."""
    if day is not None:
        return certificate.years_until(day)
    return (
        UNKNOWN_AGE if certificate.valid_until is None else certificate.years_until(certificate.valid_until)
    )
