"""What the certificates of a bench are worth: on the day of the readings, for the instruments that answered."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from typing import Any, Final

from bench.base.arrays import ARCSEC, CHANNELS
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import InstrumentForm
from bench.config.devices.certificates import Certificate, ChamberCertificate, HeadCertificate
from bench.config.devices.voltmeters import VoltmeterForm
from bench.readings.corrected import Corrections

_MICRO: Final = 1e-6


@dataclass(frozen=True)
class Standing:
    """A certificate of a bench on a day: of which instrument, and the serial number that answered there.

    `answered` is None where nobody knows it, as of readings from a file, and empty where the instrument says none.
    """

    section: InstrumentForm
    certificate: Certificate
    day: datetime.date
    answered: str | None = None

    @property
    def instrument(self) -> str:
        """Name of the instrument."""
        return self.section.name

    @property
    def expired(self) -> bool:
        """Whether the certificate counted no more on that day."""
        until = self.certificate.valid_until
        return until is not None and self.day > until

    @property
    def foreign(self) -> bool:
        """Whether another instrument answered than the one that was calibrated."""
        stated = self.certificate.serial
        return bool(
            stated and self.answered and stated.strip().casefold() != self.answered.strip().casefold()
        )

    @property
    def correction(self) -> str:
        """What it adds to what the instrument shows, in words; empty where that is nothing."""
        certificate = self.certificate
        if isinstance(self.section, VoltmeterForm):
            return ", ".join(self._of_the_meter(self.section))
        known = len(getattr(certificate, "values", ()))
        if isinstance(certificate, HeadCertificate):
            largest = max((abs(value.correction) for value in certificate.values), default=0.0)
            return f"table of {known} angles, up to {largest / ARCSEC:.3g} arcsec" if largest else ""
        if isinstance(certificate, ChamberCertificate):
            largest = max((abs(value.correction) for value in certificate.values), default=0.0)
            return f"{known} temperature{'s' * (known > 1)}, up to {largest:.3g} K" if largest else ""
        return ""

    def _of_the_meter(self, meter: VoltmeterForm) -> Iterator[str]:
        values = meter.certificate and meter.certificate.of_range(meter.range)
        if values and values.gain and values.gain.correction:
            yield f"gain {values.gain.correction / _MICRO:+.4g} ppm"
        if values and values.offset and values.offset.correction:
            yield f"offset {values.offset.correction / _MICRO:+.4g} µV"

    def remarks(self) -> Iterator[str]:
        """Yield what whoever relies on it must know, a sentence each."""
        certificate = self.certificate
        which = f"{self.instrument}: its {certificate.words}"
        if self.foreign:
            yield (
                f"{which}, is of serial number {certificate.serial}, but {self.answered} answered: nothing of it "
                "is counted; take the right instrument, or state the certificate of this one in the bench file"
            )
            return
        if self.expired:
            until = certificate.valid_until
            yield f"{which}, expired on {until}: its values count, with the drift since; have it calibrated"
        if self.day < certificate.date:
            yield f"{which}, is dated after the readings ({self.day}): its values count as far back as ahead"
        if isinstance(self.section, VoltmeterForm):
            range_v = self.section.range
            if self.section.certificate is not None and self.section.certificate.of_range(range_v) is None:
                yield f"{which}, says nothing of the {range_v:g} V range: there the data sheet's limits count"

    def to_json(self, *, why_not: str) -> dict[str, Any]:
        """Return what a result says of it."""
        certificate = self.certificate
        until = certificate.valid_until
        return {
            "instrument": self.instrument,
            "certificate": certificate.number,
            "laboratory": certificate.laboratory,
            "date": str(certificate.date),
            "valid_until": None if until is None else str(until),
            "expired": self.expired,
            "serial": certificate.serial,
            "serial_answered": self.answered,
            "correction": self.correction,
            "applied": not why_not,
            "why_not": why_not,
        }


def standings(
    bench: BenchFile, day: datetime.date, answered: Mapping[str, str] | None = None
) -> tuple[Standing, ...]:
    """Return the certificates of a bench on a day; `answered` are serial numbers by the instrument's name."""
    serials = answered or {}
    return tuple(
        Standing(section, section.certificate, day, None if section.by_hand else serials.get(section.name))
        for section in bench.instruments.all()
        if section.certificate is not None
    )


def without(bench: BenchFile, names: Set[str]) -> BenchFile:
    """Return a bench without the certificates of some of its instruments, by name."""
    if not names:
        return bench

    def own(section: Any) -> Any:
        named = section is not None and section.name in names
        return section.model_copy(update={"certificate": None}) if named else section

    instruments = bench.instruments
    kept = {
        "voltmeters": tuple(own(meter) for meter in instruments.voltmeters),
        "head": own(instruments.head),
        "chamber": own(instruments.chamber),
        "thermometer": own(instruments.thermometer),
    }
    return bench.model_copy(update={"instruments": instruments.model_copy(update=kept)})


def corrections_of(bench: BenchFile) -> Corrections:
    """Return what the certificates of a bench add to readings: each voltmeter's for its range to its channels."""
    gain, offset_v = dict.fromkeys(CHANNELS, 0.0), dict.fromkeys(CHANNELS, 0.0)
    for meter in bench.instruments.voltmeters:
        values = meter.certificate and meter.certificate.of_range(meter.range)
        for channel in meter.channels if values else ():
            gain[channel] = values.gain.correction if values and values.gain else 0.0
            offset_v[channel] = values.offset.correction if values and values.offset else 0.0
    head = bench.instruments.head.certificate
    told_by = bench.instruments.thermometer or bench.instruments.chamber
    thermometer = told_by.certificate if told_by is not None else None
    return Corrections(
        gain=(gain["x"], gain["y"], gain["z"]),
        offset_v=(offset_v["x"], offset_v["y"], offset_v["z"]),
        head=tuple(sorted((v.angle % math.tau, v.correction) for v in head.values)) if head else (),
        thermometer=tuple(sorted((v.temperature, v.correction) for v in thermometer.values))
        if thermometer
        else (),
    )
