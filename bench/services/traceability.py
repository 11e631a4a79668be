"""What is known of the instruments of a bench: certificates, and errors learned from other runs."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.languages import message
from bench.calibration.budget.meters import KnownMeters, LearnedDifferences, LearnedMeters, known_meters
from bench.calibration.noise import KnownNoise, KnownStand
from bench.config.bench_file.file import (
    BenchFile,
    FileMistakes,
    Standing,
    corrections_of,
    load_recorded_bench,
    standings,
    without,
)
from bench.config.bench_file.learned import LearnedFile, MetersEntry
from bench.config.devices.sections import CERTIFICATE, VoltmeterForm
from bench.model.effects import AppliedEffect, Effect
from bench.model.forward import ForwardModel
from bench.readings.corrected import VOLTS, Corrections, corrected
from bench.readings.table import Readings
from bench.results.parts import CorrectionPart
from bench.services.bench_selection import BenchTaken, Origin, instrument_name
from drivers.clock import utc_now

NO_CORRECTIONS: Final = Corrections()
NEAR_DEG: Final = 2.0
"""Distance from a row of a head's table within which interpolation adds little: at rows 45° apart, 4 % of their
difference."""
_OTHER: Final = "another instrument answered"
_NOTHING: Final = "it states no correction"


@dataclass(frozen=True)
class Traced:
    """The certificates of a bench for readings of a day, and the corrections of the readings.

    Each of the `entries` is a certificate with the reason why it does not correct the readings, "" if it
    does. `recorded` says whether the origin of the readings is known; if not, the readings are assumed to be what
    the instruments showed. `by` are all corrections of the readings, including learned ones; `by_certificates`
    are those from certificates. `between_deg` are the head angles of readings, degrees, that are far from every
    row of the table in the head's certificate.
    """

    day: datetime.date
    entries: tuple[tuple[Standing, str], ...] = ()
    recorded: bool = False
    by: Corrections = NO_CORRECTIONS
    by_certificates: Corrections = NO_CORRECTIONS
    between_deg: tuple[float, ...] = ()

    def notes(self) -> Iterator[str]:
        """Yield notes on the certificates for the reader of a result, a sentence each."""
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
        if self.between_deg:
            first, *more = self.between_deg
            yield (
                f"the head's certificate has no row near {first:g}°{f' and {len(more)} more angles' * bool(more)}: "
                "the correction there is interpolated, and u does not contain the error of interpolation; "
                "have these angles calibrated"
            )
        for why in dict.fromkeys(why_not for _, why_not in self.entries):
            names = [standing.instrument for standing, why_not in self.entries if why_not == why]
            if why and why not in (_OTHER, _NOTHING):
                yield message(f"readings not corrected by the certificate of {', '.join(names)}: {why}")

    def parts(self) -> list[CorrectionPart]:
        """Return for each certificate its part of a result."""
        return [
            CorrectionPart.from_object(
                standing,
                known := standing.certificate,
                certificate=known.number,
                date=str(known.date),
                valid_until=None if known.valid_until is None else str(known.valid_until),
                serial_answered=standing.answered,
                applied=not why_not,
                why_not=why_not,
            )
            for standing, why_not in self.entries
        ]

    def stated(self) -> dict[str, str]:
        """Return a description of each certificate for the page, by instrument."""
        return {
            message(f"certificate of {s.instrument}"): _in_words(s, why_not) for s, why_not in self.entries
        }


def _in_words(standing: Standing, why_not: str) -> str:
    certificate, answered = standing.certificate, standing.answered
    until = certificate.valid_until
    parts = [message(f"{certificate.number} of {certificate.date}, {certificate.laboratory}")]
    if until is not None:
        parts.append(message(f"EXPIRED on {until}") if standing.expired else message(f"valid until {until}"))
    if certificate.serial:
        said = message("not compared") if answered is None else message(f"{answered or 'none'} answered")
        parts.append(message(f"serial number {certificate.serial} ({said})"))
    parts.append(
        message(f"nothing corrected: {why_not}") if why_not else message(f"corrected: {standing.correction}")
    )
    return "; ".join(parts)


def trace(
    taken: BenchTaken, bench: BenchFile, readings: Readings, origin: Origin | None
) -> tuple[BenchFile, Readings, Traced]:
    """Return the bench without certificates of other instruments, the corrected readings, and the corrections.

    A certificate belongs to another instrument if the instrument reported another serial number.
    """
    day = _day(origin)
    found = standings(bench, day, _answered(bench, origin))
    entries = tuple((standing, _why_not(standing, taken, readings, origin)) for standing in found)
    applied = without(bench, {standing.instrument for standing, why_not in entries if why_not})
    counted = without(bench, {standing.instrument for standing in found if standing.foreign})
    by = corrections_of(applied)
    between = tuple(_between_rows(by, readings))
    return counted, corrected(readings, by), Traced(day, entries, origin is not None, by, by, between)


def _between_rows(by: Corrections, readings: Readings) -> Iterator[float]:
    """Yield each angle of the readings, degrees, that is far from every row of the head's correction table.

    Yield none if all corrections in the table are equal.
    """
    if len({correction for _, correction in by.head}) < 2:
        return
    rows_deg = np.degrees([angle for angle, _ in by.head])
    for angle in np.unique(np.round(np.degrees(readings.angle_rad) % 360.0, 1)):
        if np.min(np.abs((angle - rows_deg + 180.0) % 360.0 - 180.0)) > NEAR_DEG:
            yield float(angle)


def remarks(bench: BenchFile, serials: Mapping[str, str] | None = None) -> list[str]:
    """Return today's remarks on the certificates of a bench; `serials` are the reported serial numbers by name."""
    return [words for standing in standings(bench, utc_now().date(), serials) for words in standing.remarks()]


def _day(origin: Origin | None) -> datetime.date:
    try:
        return datetime.datetime.fromisoformat(origin.begun if origin is not None else "").date()
    except ValueError:
        return utc_now().date()


def _answered(bench: BenchFile, origin: Origin | None) -> dict[str, str]:
    """Return the serial numbers that the instruments reported, by name; empty for a simulated run.

    For an instrument without a recorded serial number, the certificate's counts if it is a word of the recorded
    identity.
    """
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
    of_meter = isinstance(standing.section, VoltmeterForm)
    if standing.foreign:
        return _OTHER
    if not standing.correction:
        return _NOTHING
    if readings.corrected:
        return message("these readings are corrected already")
    if origin is not None and origin.simulated:
        same = origin.bench.sha256 == taken.sha256
        had_it = of_meter and same and taken.file.simulation.voltmeter.accuracy == CERTIFICATE
        return (
            "" if had_it else message("the instruments were simulated without the errors in the certificates")
        )
    if of_meter and readings.unit != VOLTS:
        return message(f"the signals are in {readings.unit}")
    return ""


# --- what was learned -----------------------------------------------------------------------------


def voltmeter_names(
    bench: BenchFile, taken: BenchTaken, origin: Origin | None, readings: str
) -> dict[str, str]:
    """Return the name of the voltmeter that read each channel, by channel; {} if that is not recorded."""
    recorded = None if origin is None else _recorded(bench, taken, origin, readings)
    if origin is None or recorded is None:
        return {}
    meters = recorded.instruments.voltmeters
    if not all(origin.instruments.get(meter.name) for meter in meters):
        return {}
    return {
        channel: instrument_name(
            origin.instruments[m.name], origin.serials.get(m.name, ""), m.resource, recorded.name
        )
        for m in meters
        for channel in m.channels
    }


def _recorded(bench: BenchFile, taken: BenchTaken, origin: Origin, readings: str) -> BenchFile | None:
    """Return the bench file of the recording, which may assign other voltmeters; None if it is not found."""
    if taken.sha256 == origin.bench.sha256:
        return bench
    path = origin.bench_file(Path(readings))
    try:
        return None if path is None else load_recorded_bench(path)
    except FileMistakes:
        return None


def learned_meters(entry: MetersEntry) -> LearnedMeters:
    """Return the differences between voltmeters in `entry`, a section of a learned file, as arrays."""
    gain, zero = (
        LearnedDifferences(np.array(one.values), np.array(one.covariance), entry.group)
        for one in (entry.gain, entry.offset_v)
    )
    return LearnedMeters(entry.meters, entry.day, gain, zero)


SIMULATED: Final = "the sizes of learned file {bench} come from simulated runs"


@dataclass(frozen=True)
class LearnedTaken:
    """What an analysis uses of a learned file, with notes; `name` identifies the differences in `meters`."""

    known: KnownStand | None = None
    effects: tuple[AppliedEffect, ...] = ()
    own: tuple[Effect, ...] = ()
    notes: tuple[str, ...] = ()
    meters: KnownMeters | None = None
    name: str = ""


NOTHING_LEARNED: Final = LearnedTaken()


def take_learned(
    file: LearnedFile | None,
    day: datetime.date,
    unit: str,
    *,
    head: str = "",
    hashes: tuple[str, ...] = (),
    simulated: bool | None = None,
) -> LearnedTaken:
    """Return what is used of a learned file for readings made on `day` with signals in `unit`, and notes.

    Nothing is used of a file that has expired, or that was learned from these readings (identified by `head` and
    `hashes`). Nothing is used of simulated runs if these readings are real (`simulated` is False; None: unknown).
    """
    if file is None:
        return NOTHING_LEARNED
    told = f"what was learned of bench {file.bench} from {len(file.runs)} runs ({file.made})"
    if file.has(head, hashes):
        why = "these readings are among them and would count twice"
    elif file.expired(day):
        why = f"it expired on {file.expires}; learn again"
    elif simulated is False and file.simulated:
        why = "it comes from simulated runs; these readings are real"
    else:
        notes = [f"{told} replaces the stated limits of the stand"]
        if simulated is None and file.simulated:
            notes.append(SIMULATED.format(bench=file.bench))
        if simulated and not file.simulated:
            notes.append("these readings are simulated; the learned file is from real runs")
        known = _known(file, unit)
        if known.noise is None:
            notes.append(
                f"the learned noise is in {file.noise.unit}, these readings in {unit}: it is not used"
            )
        return LearnedTaken(known, file.applied_effects(), file.own_effects(), tuple(notes))
    return LearnedTaken(notes=(f"{told} is not used: {why}; the stated limits are used",))


def learned_for_run(bench: BenchFile, path: Path, created: str, *, simulated: bool | None) -> LearnedTaken:
    """Return what a run begun at `created` uses of the learned file that the bench file at `path` names.

    If `path` is the run's own copy, later changes of the original files have no effect. Raises `FileMistakes`.
    """
    file = BenchTaken(bench, str(path), "", "").learned()
    return take_learned(file, datetime.datetime.fromisoformat(created).date(), VOLTS, simulated=simulated)


def with_effects(model: ForwardModel, effects: tuple[AppliedEffect, ...]) -> ForwardModel:
    """Add learned effects of the bench to a model; effects that the model already has stay unchanged."""
    there = {applied.effect.name for applied in model.effects}
    further = tuple(applied for applied in effects if applied.effect.name not in there)
    return replace(model, effects=(*model.effects, *further)) if further else model


def with_meters(
    found: LearnedTaken, file: LearnedFile, bench: BenchFile, day: datetime.date, meters: Mapping[str, str]
) -> LearnedTaken:
    """Return `found` with learned differences of voltmeters added; `meters` names the voltmeter of each channel."""
    if file.meters is None:
        return found
    if not meters:
        note = (
            "differences of the voltmeters were learned, but these readings do not name their voltmeters: "
            "not used"
        )
        return replace(found, notes=(*found.notes, note))
    names = [meters[meter.channels[0]] for meter in bench.instruments.voltmeters]
    known, notes = known_meters(bench, day, names, learned_meters(file.meters))
    return replace(found, meters=known, notes=(*found.notes, *notes), name=f"differences learned {file.made}")


def _known(file: LearnedFile, unit: str) -> KnownStand:
    stand, noise = file.stand, file.noise
    sizes = None
    if noise.unit == unit:
        channels = (noise.x, noise.y, noise.z)
        sizes = KnownNoise(
            np.array([one.size for one in channels]), np.array([one.dof for one in channels]),
            noise.setting.size, noise.setting.dof,
        )  # fmt: skip
    return KnownStand(
        tuple((mean.angle, mean.installation) for mean in stand.means),
        np.array([mean.value for mean in stand.means]),
        stand.covariance,
        dict(stand.remount.items()),
        sizes,
    )
