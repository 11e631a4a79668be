"""Bench files (`config/*.yaml`), and the certificates of their instruments as they apply on a day."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Iterator, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field, field_validator

from bench.base.arrays import ARCSEC, CHANNELS
from bench.base.units import FrequencyHz
from bench.base.yaml_files import (
    FileMistakes,
    FileModel,
    Place,
    load_document,
    load_validated,
    part,
    sha256_of_file,
    validated,
)
from bench.config.bench_file.crosschecks import FURTHER, mistakes_between_parts
from bench.config.bench_file.sections import (
    SURROUNDINGS,
    CheckBlockSection,
    InstrumentForm,
    InstrumentsSection,
    SimulationSection,
)
from bench.config.bench_file.stand import (
    Gravity,
    InstallationSection,
    Location,
    MeasuredGravity,
    StandSection,
    UncertaintySection,
    UnitUnderTest,
    VerificationSection,
)
from bench.config.devices.device import Certificate, ChamberCertificate, HeadCertificate
from bench.config.devices.registry import RECORDED, devices, unknown_drivers
from bench.config.devices.sections import MotorisedHeadForm, VoltmeterForm
from bench.config.formulas import FormulaEntry, effects_as_written
from bench.config.model_file import EffectEntry, mistakes_with_formulas
from bench.model import CATALOGUE, STAND_ANGLES, AppliedEffect, Block, Distribution, Effect, Installation
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2, normal_gravity_m_s2
from bench.readings.corrected import Corrections

__all__ = ["BenchFile", "FileMistakes", "load_bench", "load_recorded_bench", "sha256_of_file"]

STAND_ERRORS: Final = (*STAND_ANGLES, "setting_error", "voltmeter_error")
"""The names of all stand errors."""


class BenchFile(FileModel):
    """A validated bench file: numbers in SI, angles in rad, temperatures in °C."""

    name: str
    description: str = ""
    gravity: Gravity | None = None
    line_frequency: FrequencyHz = 50.0
    instruments: InstrumentsSection
    stand: StandSection
    installations: Annotated[dict[str, InstallationSection], Field(default_factory=dict)]
    unit_under_test: UnitUnderTest
    verification: VerificationSection
    uncertainty: UncertaintySection = UncertaintySection()
    check_block: CheckBlockSection | None = None
    formulas: tuple[FormulaEntry, ...] = ()
    effects: tuple[EffectEntry, ...] = ()
    learned: str | None = None
    simulation: SimulationSection = SimulationSection()
    require_validation: bool = False
    expired: Literal["refuse", "ask", "say"] = "ask"

    @field_validator("line_frequency")
    @classmethod
    def _of_the_mains(cls, line_hz: float) -> float:
        if line_hz not in {50.0, 60.0}:
            raise ValueError(f"state 50 Hz or 60 Hz for the mains, not {line_hz:g} Hz")
        return line_hz

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield the mistakes between parts of the file: channels, resources, ranges, labels, effects, faults."""
        yield from mistakes_between_parts(data)
        stated = part(data, "installations")
        labels = {"1", "2", *(map(str, stated) if isinstance(stated, dict) else ())}
        yield from mistakes_with_formulas(data, labels)
        simulation = part(data, "simulation")
        if part(simulation, "effects") and part(data, "effects"):
            yield (
                ("effects",),
                "the simulated bench has effects here and in 'simulation'; move all of them there",
            )
        wrong: list[tuple[Place, str]] = []
        # effects of the simulation may use the file's top-level formulas; duplicate names are reported above
        with suppress(ValueError), CATALOGUE.also(effects_as_written(part(data, "formulas"))):
            wrong = list(mistakes_with_formulas(simulation, labels, ("simulation",)))
        yield from wrong

    @property
    def gravity_m_s2(self) -> float | None:
        """Local gravity, m/s², stated or from the location (WGS 84 formula); None if neither is stated."""
        if isinstance(self.gravity, Location):
            return normal_gravity_m_s2(self.gravity.latitude, self.gravity.height)
        return self.gravity.value if isinstance(self.gravity, MeasuredGravity) else self.gravity

    @property
    def voltmeter_range_v(self) -> float:
        """The fixed range that all voltmeters share, V."""
        return self.instruments.voltmeters[0].range

    @property
    def nplc_supported(self) -> tuple[float, ...]:
        """The integration times, in power-line cycles, that all voltmeters support, ascending."""
        kinds = [meter.kind.limits.nplc for meter in self.instruments.voltmeters]
        return tuple(sorted(set(kinds[0]).intersection(*kinds)))

    @property
    def most_samples(self) -> int:
        """The greatest number of samples of a channel in a reading; channels of a multiplexer share its memory."""
        meters = self.instruments.voltmeters
        return min(meter.kind.limits.of_channels(len(meter.channels)).most_samples for meter in meters)

    @property
    def least_samples(self) -> int:
        """The smallest number of samples in a reading that all voltmeters accept."""
        return max(meter.kind.limits.least_samples for meter in self.instruments.voltmeters)

    @property
    def head_limits_rad(self) -> tuple[float, float] | None:
        """The lowest and highest angle of a motorised head, rad; None for a head that a person turns."""
        head = self.instruments.head
        return (head.minimum, head.maximum) if isinstance(head, MotorisedHeadForm) else None

    @property
    def head_backoff_rad(self) -> float:
        """The least rotation, rad, by which a motorised head approaches an angle; 0 for any other head."""
        head = self.instruments.head
        return head.backoff if isinstance(head, MotorisedHeadForm) else 0.0

    def installation_models(self) -> dict[str, Installation]:
        """Return the installations by label: 1 and 2 of the paper, and those that the file states."""
        stated = {label: section.to_model(label) for label, section in self.installations.items()}
        return {"1": INSTALLATION_1, "2": INSTALLATION_2} | stated

    def stand_distributions(self) -> dict[str, Distribution]:
        """Return the distributions of the stand errors (rad, V) by their names in `STAND_ERRORS`.

        An angle that the file omits has the distribution of an exact zero.
        """
        sections = {name: getattr(self.stand, name) for name in STAND_ERRORS}
        return {name: s.to_distribution() if s else Distribution(0.0) for name, s in sections.items()}

    def applied_effects(self) -> tuple[AppliedEffect, ...]:
        """Return the effects that the simulated bench has; calibrations do not use them.

        Files of earlier versions list them as `effects` at the top level instead of under `simulation`.
        """
        with CATALOGUE.also(self.own_effects()):
            before = tuple(entry.applied() for entry in self.effects)
            return before + self.simulation.applied_effects()

    def own_effects(self) -> tuple[Effect, ...]:
        """Return the effects that the file defines by formulas; a diagnosis considers them as candidates."""
        return tuple(entry.effect() for entry in self.formulas)

    def nominal_block(self) -> Block:
        """Return the block with nominal scale factors, no cross-axis terms and no bias."""
        return Block(np.diag(self.unit_under_test.scale_factors.values), np.zeros(3))

    def simulated_block(self) -> Block:
        """Return the block of the simulated bench as stated; by default the nominal block."""
        truth = self.simulation.block
        if truth is None:
            return self.nominal_block()
        return Block(np.array(truth.K, dtype=np.float64), np.array(truth.U0, dtype=np.float64))


def load_bench(path: Path) -> BenchFile:
    """Read a bench file. Raises `FileMistakes` with every mistake in the file."""
    return load_validated(path, BenchFile)


class _WithUnknownInstruments(BenchFile):
    """A recorded bench file that names unknown drivers; it was checked when its run began."""

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield nothing: without the drivers, the parts cannot be checked against each other."""
        return ()


def load_recorded_bench(path: Path) -> BenchFile:
    """Read the bench file of a recorded run for evaluation, without the effects of the simulation.

    Evaluations do not use these effects, and the catalogue may no longer contain them. If a plug-in is missing, the
    section of its instrument is kept as written, and no parts are checked against each other. Raises `FileMistakes`
    with every other mistake.
    """
    document = load_document(path)
    if isinstance(document.data, dict):
        for section in (document.data, part(document.data, "simulation")):
            for key in ("effects", "left_open") if isinstance(section, dict) else ():
                section.pop(key, None)
    known = not unknown_drivers(_sections_of(document.data))
    return validated(document, BenchFile if known else _WithUnknownInstruments, RECORDED)


def missing_drivers(path: Path) -> list[str]:
    """Return the unknown drivers that a bench file names. Raises `FileMistakes` if it cannot be read."""
    return unknown_drivers(_sections_of(load_document(path).data))


def foreign_drivers(bench: BenchFile) -> dict[str, str]:
    """Return the drivers of a bench that are plug-ins: driver name -> file or distribution of the plug-in."""
    origins = {section.driver: devices().origin(section.driver) for section in bench.instruments.all()}
    return {name: origin for name, origin in origins.items() if origin}


def _sections_of(data: Any) -> list[Any]:
    meters = part(data, "instruments", "voltmeters")
    sections = [part(data, "instruments", role) for role in (*FURTHER, *SURROUNDINGS)]
    return [*(meters if isinstance(meters, list) else []), *sections]


_MICRO: Final = 1e-6


@dataclass(frozen=True)
class Standing:
    """The certificate of an instrument as it applies to readings of a certain day.

    `answered` is the serial number that the instrument reported. It is empty if the instrument has none, and None
    if no report is known, as for readings from a file.
    """

    section: InstrumentForm
    certificate: Certificate
    day: datetime.date
    answered: str | None = None

    @property
    def instrument(self) -> str:
        """The name of the instrument."""
        return self.section.name

    @property
    def expired(self) -> bool:
        """Whether the certificate had expired on the day of the readings."""
        until = self.certificate.valid_until
        return until is not None and self.day > until

    @property
    def later(self) -> bool:
        """Whether the certificate is dated after the day of the readings."""
        return self.day < self.certificate.date

    @property
    def foreign(self) -> bool:
        """Whether the instrument reported a serial number other than that of its certificate."""
        stated = self.certificate.serial
        return bool(
            stated and self.answered and stated.strip().casefold() != self.answered.strip().casefold()
        )

    @property
    def correction(self) -> str:
        """The corrections that the certificate states, in words; empty if it states none."""
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
        """Yield the caveats on the certificate, one sentence each."""
        certificate = self.certificate
        which = f"{self.instrument}: its {certificate.words}"
        if self.foreign:
            yield (
                f"{which}, is for serial number {certificate.serial}, but the connected instrument has "
                f"{self.answered}: the certificate's values are not used; connect the right instrument, or state "
                "the certificate of the connected one in the bench file"
            )
            return
        if self.expired:
            until = certificate.valid_until
            allowed = "with" if isinstance(self.section, VoltmeterForm) else "without"
            yield (
                f"{which}, expired on {until}: its values are used {allowed} an allowance for drift since then; "
                "have the instrument calibrated"
            )
        if self.later:
            yield (
                f"{which}, is dated after the readings ({self.day}): its values are used for earlier days "
                "as for later ones"
            )
        if isinstance(self.section, VoltmeterForm):
            range_v = self.section.range
            if self.section.certificate is not None and self.section.certificate.of_range(range_v) is None:
                yield f"{which}, does not cover the {range_v:g} V range: the data sheet's limits apply there"


def standings(
    bench: BenchFile, day: datetime.date, answered: Mapping[str, str] | None = None
) -> tuple[Standing, ...]:
    """Return the certificates of the instruments of a bench as they apply on a day.

    `answered` maps instrument names to the serial numbers that the instruments reported.
    """
    serials = answered or {}
    return tuple(
        Standing(section, section.certificate, day, None if section.by_hand else serials.get(section.name))
        for section in bench.instruments.all()
        if section.certificate is not None
    )


def without(bench: BenchFile, names: Set[str]) -> BenchFile:
    """Return a copy of a bench without the certificates of the named instruments.

    Thermometers away from the block keep their certificates, even if they are named.
    """
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
    """Return the corrections of readings that the certificates of a bench state.

    Gain and offset are the corrections of each channel's voltmeter on its range. Temperatures are corrected by the
    certificate of the thermometer at the block, or, without such a thermometer, of the chamber.
    """
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
