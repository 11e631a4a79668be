"""Certificates of the instruments with readings: which count, what is corrected by them, what a result says."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from bench.config.bench_file.file import BenchFile, Standing, corrections_of, standings, without
from bench.config.devices.sections import CERTIFICATE, VoltmeterForm
from bench.readings.corrected import VOLTS, Corrections, corrected
from bench.readings.table import Readings
from bench.results.parts import CorrectionPart
from bench.services.bench_selection import BenchTaken, Origin
from drivers.clock import utc_now

NO_CORRECTIONS: Final = Corrections()
_OTHER: Final = "another instrument answered"
_NOTHING: Final = "it states no correction"


@dataclass(frozen=True)
class Traced:
    """The certificates of a bench with readings of a day, each with why nothing is corrected, empty where it is.

    `recorded` is whether a run recorded the readings: else they are taken for what the instruments showed. `by` is
    what was added to them, of it `by_certificates` what certificates say: the rest was learned.
    """

    day: datetime.date
    entries: tuple[tuple[Standing, str], ...] = ()
    recorded: bool = False
    by: Corrections = NO_CORRECTIONS
    by_certificates: Corrections = NO_CORRECTIONS

    def notes(self) -> Iterator[str]:
        """Yield what a reader of a result must know of the certificates, a sentence each."""
        for standing, _ in self.entries:
            yield from standing.remarks()
        applied = [
            f"{s.instrument} {s.correction} (certificate {s.certificate.number})"
            for s, why_not in self.entries
            if not why_not
        ]
        if applied:
            own = "" if self.recorded else ", being taken for what the instruments showed"
            yield f"readings corrected as the certificates say{own}: {'; '.join(applied)}"
        for why in dict.fromkeys(why_not for _, why_not in self.entries):
            names = [standing.instrument for standing, why_not in self.entries if why_not == why]
            if why and why not in (_OTHER, _NOTHING):
                yield f"readings not corrected by the certificate of {', '.join(names)}: {why}"

    def parts(self) -> list[CorrectionPart]:
        """Return what a result says of each certificate."""
        return [CorrectionPart(**one) for one in self.to_json()]

    def to_json(self) -> list[dict[str, Any]]:
        """Return what a result says of each certificate."""
        return [standing.to_json(why_not=why_not) for standing, why_not in self.entries]

    def stated(self) -> dict[str, str]:
        """Return what a page says of each certificate, by its instrument."""
        return {f"certificate of {s.instrument}": _in_words(s, why_not) for s, why_not in self.entries}


def _in_words(standing: Standing, why_not: str) -> str:
    certificate, answered = standing.certificate, standing.answered
    until = certificate.valid_until
    parts = [f"{certificate.number} of {certificate.date}, {certificate.laboratory}"]
    if until is not None:
        parts.append(f"EXPIRED on {until}" if standing.expired else f"valid until {until}")
    if certificate.serial:
        said = "not compared" if answered is None else f"{answered or 'none'} answered"
        parts.append(f"serial number {certificate.serial} ({said})")
    parts.append(f"nothing corrected: {why_not}" if why_not else f"corrected: {standing.correction}")
    return "; ".join(parts)


def trace(
    taken: BenchTaken, bench: BenchFile, readings: Readings, origin: Origin | None
) -> tuple[BenchFile, Readings, Traced]:
    """Return the bench without certificates of other instruments, the readings corrected, and what was done."""
    day = _day(origin)
    found = standings(bench, day, _answered(bench, origin))
    entries = tuple((standing, _why_not(standing, taken, readings, origin)) for standing in found)
    applied = without(bench, {standing.instrument for standing, why_not in entries if why_not})
    counted = without(bench, {standing.instrument for standing in found if standing.foreign})
    by = corrections_of(applied)
    return counted, corrected(readings, by), Traced(day, entries, origin is not None, by, by)


def remarks(bench: BenchFile, serials: Mapping[str, str] | None = None) -> list[str]:
    """Return what is to be said today of the certificates of a bench; `serials` answered, by name."""
    return [words for standing in standings(bench, utc_now().date(), serials) for words in standing.remarks()]


def _day(origin: Origin | None) -> datetime.date:
    """Return the day of the readings; today, where nobody says it: certificates are not older then."""
    try:
        return datetime.datetime.fromisoformat(origin.begun if origin is not None else "").date()
    except ValueError:
        return utc_now().date()


def _answered(bench: BenchFile, origin: Origin | None) -> dict[str, str]:
    """Return the serial numbers that answered; where only identities are recorded, one that stands in its own."""
    if origin is None or origin.simulated:
        return {}
    stated = {s.name: s.certificate.serial for s in bench.instruments.all() if s.certificate is not None}
    seen = {
        name: serial
        for name, serial in stated.items()
        if serial and serial in origin.instruments.get(name, "").split()
    }
    return seen | origin.serials


def _why_not(standing: Standing, taken: BenchTaken, readings: Readings, origin: Origin | None) -> str:
    """Say why readings are not corrected by a certificate; nothing where they are."""
    of_meter = isinstance(standing.section, VoltmeterForm)
    if standing.foreign:
        return _OTHER
    if not standing.correction:
        return _NOTHING
    if readings.corrected:
        return "the readings at hand are corrected already"
    if origin is not None and origin.simulated:
        same = origin.bench.sha256 == taken.sha256
        had_it = of_meter and same and taken.file.simulation.voltmeter.accuracy == CERTIFICATE
        return "" if had_it else "the instruments were simulated without the errors that are stated there"
    if of_meter and readings.unit != VOLTS:
        return f"the signals are in {readings.unit}"
    return ""
