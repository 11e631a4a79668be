"""Bench files, `config/*.yaml`: the instruments, the stand's errors, the block, what is accepted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field, field_validator

from bench.bench_instruments import VOLTMETERS, InstrumentsSection
from bench.bench_sections import (
    Gravity,
    InstallationSection,
    Location,
    SimulationSection,
    StandSection,
    UnitUnderTest,
    VerificationSection,
)
from bench.gravity import normal_gravity_m_s2
from bench.model import STAND_ANGLES, AppliedEffect, Block, Distribution, Installation
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.model_file import EffectEntry, effect_mistakes
from bench.readings import UNORIENTED
from bench.units import SCALE_FACTOR, VOLTAGE, FrequencyHz, Kind, parse_quantity
from bench.yaml_file import FileMistakes, FileModel, load_validated, part, sha256_of_file
from bench.yaml_mistakes import Place
from drivers.interfaces import CHANNELS

__all__ = ["BenchFile", "FileMistakes", "load_bench", "sha256_of_file"]

STAND_ERRORS: Final = (*STAND_ANGLES, "setting_error", "voltmeter_error")
"""Names of all stand errors."""

_OVER_RANGE: Final = 1.2
"""A 34401A reads up to 120 % of its range (User's Guide, chapter 8)."""


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
    effects: tuple[EffectEntry, ...] = ()
    simulation: SimulationSection = SimulationSection()

    @field_validator("line_frequency")
    @classmethod
    def _of_the_mains(cls, line_hz: float) -> float:
        if line_hz not in {50.0, 60.0}:
            raise ValueError(f"the mains have 50 Hz or 60 Hz, not {line_hz:g} Hz")
        return line_hz

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield mistakes between parts of the file: channels, resources, ranges, labels, effects."""
        yield from _channel_mistakes(part(data, "instruments", "voltmeters"))
        yield from _range_mistakes(data)
        yield from _label_mistakes(part(data, "installations"))
        yield from effect_mistakes(part(data, "effects"), ("effects",))

    @property
    def gravity_m_s2(self) -> float | None:
        """Local gravity as stated or by the WGS 84 formula, None where the file gives neither."""
        if isinstance(self.gravity, Location):
            return normal_gravity_m_s2(self.gravity.latitude, self.gravity.height)
        return self.gravity

    @property
    def voltmeter_range_v(self) -> float:
        """The fixed range of the voltmeters: the same for all."""
        return self.instruments.voltmeters[0].range

    @property
    def verification_limit_g(self) -> float:
        """Delta g_A, in local g."""
        return self.verification.limit

    @property
    def nplc_supported(self) -> tuple[float, ...]:
        """Integration times that every voltmeter of the bench has, in power-line cycles, rising."""
        kinds = [VOLTMETERS[meter.driver].nplc for meter in self.instruments.voltmeters]
        return tuple(sorted(set(kinds[0]).intersection(*kinds)))

    @property
    def most_samples(self) -> int:
        """Samples that one reading may have."""
        return min(VOLTMETERS[meter.driver].most_samples for meter in self.instruments.voltmeters)

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
        return tuple(entry.applied() for entry in self.effects)

    def simulated_block(self) -> Block:
        """Return the block of the simulated bench: as stated, else nominal scale factors and no bias."""
        truth = self.simulation.block
        if truth is None:
            return Block(np.diag(self.unit_under_test.scale_factors.values), np.zeros(3))
        return Block(np.array(truth.K, dtype=np.float64), np.array(truth.U0, dtype=np.float64))


def load_bench(path: Path) -> BenchFile:
    """Read a bench file. Raises `FileMistakes` with every mistake in it."""
    return load_validated(path, BenchFile)


# --- mistakes between parts of the file -------------------------------------------------------------


def _channel_mistakes(voltmeters: Any) -> Iterator[tuple[Place, str]]:
    """Each of x, y, z is carried once; each resource is one meter; all read on one range."""
    place: Place = ("instruments", "voltmeters")
    if not isinstance(voltmeters, list):
        return
    carried: dict[str, int] = {}
    resources: dict[str, int] = {}
    first_range = _value(part(voltmeters, 0, "range") or "10 V", VOLTAGE)
    unreadable = False
    for index, meter in enumerate(voltmeters):
        channels = part(meter, "channels")
        unreadable |= not isinstance(channels, list)
        for channel in channels if isinstance(channels, list) else []:
            unreadable |= channel not in CHANNELS
            if channel in carried:
                text = f"channel {channel} is carried by voltmeter {carried[channel] + 1} already"
                yield (*place, index, "channels"), text
            carried.setdefault(str(channel), index)
        resource = part(meter, "resource")
        if isinstance(resource, str) and resource in resources:
            yield (*place, index, "resource"), f"'{resource}' is voltmeter {resources[resource] + 1} already"
        resources.setdefault(str(resource), index)
        own_range = _value(part(meter, "range") or "10 V", VOLTAGE)
        if None not in {own_range, first_range} and own_range != first_range:
            text = (
                f"all voltmeters read on one range: this one has {own_range:g} V, the first {first_range:g} V"
            )
            yield (*place, index, "range"), text
    missing = [channel for channel in CHANNELS if channel not in carried]
    if missing and not unreadable:
        yield place, f"no voltmeter carries channel {', '.join(missing)}; each of x, y, z is carried once"


def _range_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """The block's signals at 1 g stay within what the voltmeters read."""
    range_v = _value(part(data, "instruments", "voltmeters", 0, "range") or "10 V", VOLTAGE)
    if range_v is None:
        return
    full_scale_v = _OVER_RANGE * range_v
    limit = f"the voltmeters read no more than {full_scale_v:g} V on their {range_v:g} V range"
    for channel in CHANNELS:
        place: Place = ("unit_under_test", "scale_factors", channel)
        scale = _value(part(data, *place), SCALE_FACTOR)
        if scale is not None and abs(scale) > full_scale_v:
            yield place, f"1 g gives {abs(scale):g} V, but {limit}; take a higher range"
    for row, channel in enumerate(CHANNELS):
        truth: Place = ("simulation", "block")
        terms = [_value(part(data, *truth, "K", row, column), SCALE_FACTOR) for column in range(3)]
        bias = _value(part(data, *truth, "U0", row), VOLTAGE)
        known = [term for term in terms if term is not None]
        if len(known) == 3 and bias is not None:
            peak_v = float(np.linalg.norm(known)) + abs(bias)
            if peak_v > full_scale_v:
                yield (*truth, "K", row), f"channel {channel} reaches {peak_v:.3g} V in a turn, but {limit}"


def _label_mistakes(installations: Any) -> Iterator[tuple[Place, str]]:
    for label in installations if isinstance(installations, dict) else {}:
        if label in UNORIENTED:
            text = "F (free), S (shorted), R (reference) are readings without orientation; take another label"
            yield ("installations", label), text
        elif not label.isalnum():
            yield (
                ("installations", label),
                f"a label is letters and digits such as '3' or 'U1', not '{label}'",
            )


def _value(written: Any, kind: Kind) -> float | None:
    """Return a quantity as written, None where it cannot be read (which is told elsewhere)."""
    try:
        return parse_quantity(written, kind)
    except ValueError:
        return None
