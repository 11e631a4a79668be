"""What every instrument is asked: voltmeters, heads, chambers, levels, thermometers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import Literal, Protocol, runtime_checkable

Channel = Literal["x", "y", "z"]
CHANNELS: tuple[Channel, Channel, Channel] = ("x", "y", "z")

Direction = Literal[1, -1]
"""Approach to an angle: +1 rising, -1 falling."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Who an instrument says it is, for the record: `{"maker": "HEWLETT-PACKARD", "model": "34401A", …}`."""

    maker: str
    model: str
    serial: str = ""
    firmware: str = ""

    def __str__(self) -> str:
        return " ".join(part for part in (self.maker, self.model, self.serial, self.firmware) if part)


class Instrument(Protocol):
    """Anything on the bench that is opened, identified, and left safe."""

    name: str

    def open(self) -> Identity:
        """Connect, prove the identity and return it. Raises `InstrumentLost` or `InstrumentRefused`."""
        ...

    def close(self) -> str | None:
        """Leave the instrument safe and in local, and let it go. Never raises, may be called twice.

        Each command that makes it safe is tried, whatever became of those before (`drivers.making_safe`).
        Returns what a person must still do where one failed, nothing where all is safe.
        """
        ...


@runtime_checkable
class SelfTesting(Protocol):
    """An instrument that can test itself."""

    def self_test(self) -> str:
        """Have the instrument test itself; return what it finds wrong, empty for nothing.

        What was set before is to be set anew. Raises `InstrumentLost`, `BadReading`.
        """
        ...


@dataclass(frozen=True, slots=True)
class VoltmeterSettings:
    """How a voltmeter reads: range in volts, integration in power-line cycles, samples per reading."""

    range_v: float
    nplc: float
    samples: int


@dataclass(frozen=True, slots=True)
class VoltmeterLimits:
    """What a model can do: ranges in volts, integration in power-line cycles, samples in one reading.

    Its facts state them once: what a bench file and a procedure may ask is held against the same ones.
    """

    ranges_v: tuple[float, ...]
    nplc: tuple[float, ...]
    most_samples: int
    least_samples: int = 1

    @classmethod
    def of(cls, facts: ModuleType) -> VoltmeterLimits:
        """Return the limits of a reading of one channel; the `facts` are those of a voltmeter."""
        return cls(facts.RANGES_V, facts.NPLC, facts.MEMORY_READINGS, facts.LEAST_SAMPLES)

    def of_channels(self, count: int) -> VoltmeterLimits:
        """Return the limits of a reading of so many channels, whose samples share the memory."""
        return replace(self, most_samples=self.most_samples // count)

    def transgressions(self, settings: VoltmeterSettings) -> list[str]:
        """Return what of the settings the model cannot do, one phrase for each."""
        wrong = []
        if settings.range_v not in self.ranges_v:
            wrong.append(f"a range of {settings.range_v:g} V (it has {_listed(self.ranges_v)} V)")
        if settings.nplc not in self.nplc:
            wrong.append(f"an integration of {settings.nplc:g} NPLC (it has {_listed(self.nplc)})")
        if not self.least_samples <= settings.samples <= self.most_samples:
            held = f"{self.least_samples} to {self.most_samples}"
            wrong.append(f"{settings.samples} samples (its memory holds {held})")
        return wrong


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)


@runtime_checkable
class Voltmeter(Instrument, Protocol):
    """One or more signals in volts, sampled on command.

    `start` and `fetch` are apart so that several meters are started before the first is waited for:
    the three signals are then sampled together.
    """

    channels: tuple[Channel, ...]
    """The signals that this instrument carries, in the order in which it scans them."""

    def configure(self, settings: VoltmeterSettings) -> None:
        """Apply the settings and prove that they were taken. Raises `InstrumentRefused`, `InstrumentLost`."""
        ...

    def start(self) -> None:
        """Begin one reading of `samples` samples."""
        ...

    def fetch(self) -> dict[Channel, tuple[float, ...]]:
        """Wait for the reading and return the samples in volts, `{"x": (1.2, 1.2)}`.

        Raises `BadReading` for an overload or anything that is not a number, `InstrumentLost`.
        """
        ...


@dataclass(frozen=True, slots=True)
class HeadPosition:
    """Where the head stands by its own scale, and from which side it came."""

    angle_rad: float
    direction: Direction


@runtime_checkable
class DividingHead(Instrument, Protocol):
    """A shaft that is turned to an angle from a stated side."""

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Turn to `target_rad`, arriving with rising (+1) or falling (-1) angle; return the angle read back.

        `key` names the step that asks. Raises `LimitExceeded`, `InstrumentLost`, `NoAnswer`.
        """
        ...


@runtime_checkable
class ThermalChamber(Instrument, Protocol):
    """A chamber that holds a temperature."""

    asks_person: bool
    """Whether `temperature` costs a person an answer: then it is asked at each mounting only."""

    def set_temperature(self, target_c: float, key: str) -> None:
        """Demand a temperature, °C. Raises `LimitExceeded` before anything is sent, `InstrumentLost`."""
        ...

    def make_safe(self) -> str:
        """Go to the safe setting; return what a person must still do, empty for nothing.

        Raises `BenchError` where the chamber does not obey; it is called on every way out of a run.
        """
        ...

    def temperature(self, key: str, *, settling: bool = False) -> float:
        """Return the temperature at the block (or of the air, where that is all there is), °C.

        While it is `settling` it may still be far from what was demanded; else that is an error where the
        bench file states a band. Raises `InstrumentRefused`, `InstrumentLost`, `BadReading`.
        """
        ...


LevelAxis = Literal["along", "across"]
"""Along the shaft, positive where the end is the higher one that is away from whoever looks at the end of the
shaft; across it, positive where the end to the right is."""


@dataclass(frozen=True, slots=True)
class Inclination:
    """What a level shows, its own zero included, rad; the signs are those of `LevelAxis`."""

    along_rad: float
    across_rad: float


@dataclass(frozen=True, slots=True)
class LevelSizes:
    """How exact a level is: standard uncertainties of one reading (rad), of its scale, and of what it leaks.

    `cross` is the part of the inclination about the other axis that a reading may hold: axes that are not where
    they should be, a half turn that is none.
    """

    reading_rad: float
    scale: float
    cross: float


@runtime_checkable
class Level(Instrument, Protocol):
    """A level of two axes on the platform; its own zero is not known."""

    asks_person: bool
    """Whether a person reads it, and is told by it how to place it; else a person is only to place it."""

    @property
    def sizes(self) -> LevelSizes:
        """How exact it is."""
        ...

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Return what it shows at rest in its first position, or `turned` half a turn from it, with its own signs.

        Raises `BadReading` for what is out of its range, `InstrumentRefused`, `InstrumentLost`, `NoAnswer`.
        """
        ...


@runtime_checkable
class Thermometer(Instrument, Protocol):
    """A thermometer at the block, of its own: not that of the chamber's controller."""

    asks_person: bool
    """Whether a reading costs a person an answer: then it is read at each mounting only."""

    sensor: str
    """What measures, and where, as it stands in the record: "Pt100, four wires, channel 104"."""

    def block_c(self, key: str) -> float:
        """Return the temperature that it shows, °C; `key` names the step that asks.

        Raises `BadReading` for an open sensor or what no block has, `InstrumentRefused`, `InstrumentLost`,
        `NoAnswer`.
        """
        ...
