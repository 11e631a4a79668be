"""Bench files, `config/*.yaml`: the instruments, the stand's errors, the block, what is accepted."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field, field_validator

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
    CheckBlockSection,
    InstrumentsSection,
    RecordedInstruments,
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
from bench.config.devices.registry import devices, unknown_drivers
from bench.config.devices.sections import MotorisedHeadForm
from bench.config.devices.unknown import UnknownVoltmeter
from bench.config.formulas import FormulaEntry
from bench.config.model_file import EffectEntry, mistakes_with_formulas
from bench.model import CATALOGUE, STAND_ANGLES, AppliedEffect, Block, Distribution, Effect, Installation
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2, normal_gravity_m_s2

__all__ = ["BenchFile", "FileMistakes", "load_bench", "load_recorded_bench", "sha256_of_file"]

STAND_ERRORS: Final = (*STAND_ANGLES, "setting_error", "voltmeter_error")
"""Names of all stand errors."""


class BenchFile(FileModel):
    """A bench file, validated; numbers in SI, angles in rad, temperatures in °C."""

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

    @field_validator("line_frequency")
    @classmethod
    def _of_the_mains(cls, line_hz: float) -> float:
        if line_hz not in {50.0, 60.0}:
            raise ValueError(f"the mains have 50 Hz or 60 Hz, not {line_hz:g} Hz")
        return line_hz

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield mistakes between parts of the file: channels, resources, ranges, labels, effects, faults."""
        yield from mistakes_between_parts(data)
        stated = part(data, "installations")
        labels = {"1", "2", *(map(str, stated) if isinstance(stated, dict) else ())}
        yield from mistakes_with_formulas(data, labels)

    @property
    def gravity_m_s2(self) -> float | None:
        """Local gravity as stated or by the WGS 84 formula, None where the file gives neither."""
        if isinstance(self.gravity, Location):
            return normal_gravity_m_s2(self.gravity.latitude, self.gravity.height)
        return self.gravity.value if isinstance(self.gravity, MeasuredGravity) else self.gravity

    @property
    def voltmeter_range_v(self) -> float:
        """The fixed range of the voltmeters: the same for all."""
        return self.instruments.voltmeters[0].range

    @property
    def verification_limit_g(self) -> float:
        """Delta g_A, in local g."""
        return self.verification.limit

    @property
    def knows_its_meters(self) -> bool:
        """Whether what its voltmeters can do is known here: of a recorded run's it need not be."""
        return not any(isinstance(meter, UnknownVoltmeter) for meter in self.instruments.voltmeters)

    @property
    def nplc_supported(self) -> tuple[float, ...]:
        """Integration times that every voltmeter of the bench has, in power-line cycles, rising."""
        kinds = [meter.kind.limits.nplc for meter in self.instruments.voltmeters]
        return tuple(sorted(set(kinds[0]).intersection(*kinds)))

    @property
    def most_samples(self) -> int:
        """Samples that one reading may have: a multiplexer keeps those of all its channels."""
        meters = self.instruments.voltmeters
        return min(meter.kind.limits.of_channels(len(meter.channels)).most_samples for meter in meters)

    @property
    def least_samples(self) -> int:
        """Samples that one reading must have, so that every voltmeter takes it."""
        return max(meter.kind.limits.least_samples for meter in self.instruments.voltmeters)

    @property
    def head_limits_rad(self) -> tuple[float, float] | None:
        """Lowest and highest angle of the head, rad; None for one that a person turns."""
        head = self.instruments.head
        return (head.minimum, head.maximum) if isinstance(head, MotorisedHeadForm) else None

    @property
    def head_backoff_rad(self) -> float:
        """How far from an angle the head begins to come to it, within its limits too, rad; 0 by hand."""
        head = self.instruments.head
        return head.backoff if isinstance(head, MotorisedHeadForm) else 0.0

    @property
    def chamber_limits_c(self) -> tuple[float, float] | None:
        """Lowest and highest temperature of the chamber, °C; None where there is none."""
        chamber = self.instruments.chamber
        return None if chamber is None else (chamber.minimum, chamber.maximum)

    @property
    def block_limits_c(self) -> tuple[float, float]:
        """Lowest and highest temperature that the block may be given, °C."""
        allowed = self.unit_under_test.temperature
        return allowed.minimum, allowed.maximum

    def installation_models(self) -> dict[str, Installation]:
        """Return the installations by label: the paper's 1 and 2, and those that the file states."""
        stated = {label: section.to_model(label) for label, section in self.installations.items()}
        return {"1": INSTALLATION_1, "2": INSTALLATION_2} | stated

    def stand_distributions(self) -> dict[str, Distribution]:
        """Return the distribution of each stand error by its name in `STAND_ERRORS`, rad and V.

        An angle that the file does not state is zero.
        """
        sections = {name: getattr(self.stand, name) for name in STAND_ERRORS}
        return {name: s.to_distribution() if s else Distribution(0.0) for name, s in sections.items()}

    def applied_effects(self) -> tuple[AppliedEffect, ...]:
        """Return the effects that the simulated bench has; no calibration knows of them."""
        with CATALOGUE.also(self.own_effects()):
            return tuple(entry.applied() for entry in self.effects)

    def own_effects(self) -> tuple[Effect, ...]:
        """Return the effects whose formulas the file states: a diagnosis looks for them, too."""
        return tuple(entry.effect() for entry in self.formulas)

    def nominal_block(self) -> Block:
        """Return the block as it is announced: its nominal scale factors, nothing across, no bias."""
        return Block(np.diag(self.unit_under_test.scale_factors.values), np.zeros(3))

    def simulated_block(self) -> Block:
        """Return the block of the simulated bench: as stated, else nominal scale factors and no bias."""
        truth = self.simulation.block
        if truth is None:
            return self.nominal_block()
        return Block(np.array(truth.K, dtype=np.float64), np.array(truth.U0, dtype=np.float64))


def load_bench(path: Path) -> BenchFile:
    """Read a bench file. Raises `FileMistakes` with every mistake in it."""
    return load_validated(path, BenchFile)


class _WithUnknownInstruments(BenchFile):
    """A recorded bench file with instruments that nobody here knows; it was checked whole when its run began."""

    instruments: RecordedInstruments

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield nothing: what is between the parts cannot be told without the instruments."""
        return ()


def load_recorded_bench(path: Path) -> BenchFile:
    """Read the bench file of a run to evaluate it, without the effects that the simulation had.

    No evaluation knows of them, and a run may have had some that the catalogue no longer has. Of an instrument
    that came with a plug-in which is not here the section is kept as it is written. Raises `FileMistakes` with
    every mistake in all else.
    """
    document = load_document(path)
    if isinstance(document.data, dict):
        document.data.pop("effects", None)
    known = not unknown_drivers(_sections_of(document.data))
    return validated(document, BenchFile if known else _WithUnknownInstruments)


def missing_drivers(path: Path) -> list[str]:
    """Return the drivers that a bench file names and nobody here has. Raises `FileMistakes` where it is no file."""
    return unknown_drivers(_sections_of(load_document(path).data))


def foreign_drivers(bench: BenchFile) -> dict[str, str]:
    """Return by name where those drivers came from that are none of the bench's own."""
    origins = {section.driver: devices().origin(section.driver) for section in bench.instruments.all()}
    return {name: origin for name, origin in origins.items() if origin}


def _sections_of(data: Any) -> list[Any]:
    meters = part(data, "instruments", "voltmeters")
    sections = [part(data, "instruments", role) for role in FURTHER]
    return [*(meters if isinstance(meters, list) else []), *sections]
