"""The protocols through which the application uses instruments, and the errors that drivers raise.

The application depends on these small protocols, never on a concrete driver. Prompts to a person are in
`drivers.person`.
Angles are radians, voltages volts, currents amperes, temperatures degrees Celsius, times seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Final, Literal, Protocol, runtime_checkable

# --- failures ---------------------------------------------------------------------------------------


def message(text: str, context: str = "") -> str:
    """Return a text unchanged; the call marks it for translation in pages and prompts.

    `text` is a literal or an f-string. `context` distinguishes texts that are equal in English but not in another
    language.
    """
    return text


class BenchError(Exception):
    """A failure that a person can remedy.

    `instrument` is the instrument's name on the bench ("voltmeter.x"). `cause` says what happened, `remedy`
    what to do. The message combines all three in one sentence.
    """

    def __init__(self, instrument: str, cause: str, remedy: str) -> None:
        super().__init__(f"{instrument}: {cause}; {remedy}")
        self.instrument = instrument
        self.cause = cause
        self.remedy = remedy


class InstrumentLost(BenchError):
    """The instrument does not respond: it is absent, refuses the connection, was cut off, or timed out."""


class InstrumentRefused(BenchError):
    """The instrument responds but does not comply: wrong identity, a queued error, a setting not applied."""


class BadReading(BenchError):
    """A reply that is not a valid reading: an overload, or a truncated or garbled text."""


class LimitExceeded(BenchError):
    """A value, requested or read, outside the limits of an instrument, the stand or the unit under test."""


class WentAstray(BenchError):
    """The head moved in the wrong direction or left its limits. It was stopped; repair it before the next move."""


class NotConnected(BenchError):
    """Several instruments could not be opened; `failures` holds all errors. The message gives each remedy once."""

    def __init__(self, failures: Sequence[BenchError]) -> None:
        self.failures = tuple(failures)
        causes: dict[str, list[str]] = {}
        for one in failures:
            causes.setdefault(one.remedy, []).append(f"{one.instrument}: {one.cause}")
        each = " | ".join(f"{', '.join(whose)}; {remedy}" for remedy, whose in causes.items())
        cause, _, remedy = each.rpartition("; ")
        super().__init__(f"{len(failures)} instruments", f"not connected: {cause}", remedy)
        self.instrument = ", ".join(one.instrument for one in failures)


class NoAnswer(BenchError):
    """The person, or the script in their place, gave no answer to a prompt."""


# --- instruments ------------------------------------------------------------------------------------

Channel = Literal["x", "y", "z"]
CHANNELS: tuple[Channel, Channel, Channel] = ("x", "y", "z")

Direction = Literal[1, -1]
"""Direction of approach to an angle: +1 with rising, -1 with falling angle."""


NO_SERIAL: Final = frozenset({"", "0", "-"})
"""Serial-number fields that mean "no serial number": every 34401A reports 0."""


@dataclass(frozen=True, slots=True)
class Identity:
    """The identity that an instrument reports, for the record: maker "HEWLETT-PACKARD", model "34401A", …"""

    maker: str
    model: str
    serial: str = ""
    firmware: str = ""

    def __str__(self) -> str:
        return " ".join(part for part in (self.maker, self.model, self.serial, self.firmware) if part)

    def refuse_other(self, name: str, now: Identity) -> None:
        """Raise `InstrumentRefused` if the instrument called `name` is another one now.

        A missing firmware says nothing: some instruments report it in a separate answer, which may be lost.
        """
        same = replace(now, firmware=now.firmware if self.firmware and now.firmware else self.firmware)
        if same != self:
            raise InstrumentRefused(
                name,
                f"was {self} and is now {now}",
                "connect the first one again; if that is impossible, stop the run and resume it with the other",
            )


class Instrument(Protocol):
    """An instrument on the bench: `open` connects and identifies it, `close` leaves it safe."""

    name: str

    def open(self) -> Identity:
        """Verify and return the identity. Raises `InstrumentLost`, `InstrumentRefused`, `BadReading`."""

    def close(self) -> str | None:
        """Make the instrument safe, return it to local control and disconnect. Never raises, may be called twice.

        Each command is sent even if earlier commands failed (`drivers.making_safe`). Returns what a person
        must still do if a command failed; else None or an empty string.
        """


@runtime_checkable
class SelfTesting(Protocol):
    """An instrument that can test itself."""

    def self_test(self) -> str:
        """Run the instrument's self-test; return the faults found, an empty string for none.

        The test loses the settings: configure the instrument again. Raises `InstrumentLost`, `BadReading`.
        """


@dataclass(frozen=True, slots=True)
class VoltmeterSettings:
    """Settings of a voltmeter: range in volts, integration in power-line cycles, samples per reading."""

    range_v: float
    nplc: float
    samples: int


@dataclass(frozen=True, slots=True)
class VoltmeterLimits:
    """The settings that a model supports: ranges in volts, integration in power-line cycles, samples per reading.

    They are read from the meter's module in `drivers.facts`; bench files and procedures are checked against them.
    """

    ranges_v: tuple[float, ...]
    nplc: tuple[float, ...]
    most_samples: int
    least_samples: int = 1

    @classmethod
    def of(cls, facts: ModuleType) -> VoltmeterLimits:
        """Return the limits for reading one channel, from a voltmeter's module in `drivers.facts`."""
        return cls(facts.RANGES_V, facts.NPLC, facts.MEMORY_READINGS, facts.LEAST_SAMPLES)

    def of_channels(self, count: int) -> VoltmeterLimits:
        """Return the limits for reading `count` channels, whose samples share the memory."""
        return replace(self, most_samples=self.most_samples // count)

    def transgressions(self, settings: VoltmeterSettings) -> list[str]:
        """Return one phrase for each setting that the model does not support."""
        wrong = []
        if settings.range_v not in self.ranges_v:
            wrong.append(message(f"a range of {settings.range_v:g} V (it has {_listed(self.ranges_v)} V)"))
        if settings.nplc not in self.nplc:
            wrong.append(message(f"an integration of {settings.nplc:g} NPLC (it has {_listed(self.nplc)})"))
        if not self.least_samples <= settings.samples <= self.most_samples:
            held = message(f"{self.least_samples} to {self.most_samples}")
            wrong.append(message(f"{settings.samples} samples (its memory holds {held})"))
        return wrong


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)


@runtime_checkable
class Voltmeter(Instrument, Protocol):
    """One or more signals in volts, sampled on command.

    `start` and `fetch` are separate so that all meters can be started before the first is awaited:
    the three signals are then sampled together.
    """

    channels: tuple[Channel, ...]
    """The signals that this instrument measures, in the order in which it scans them."""

    def configure(self, settings: VoltmeterSettings) -> None:
        """Apply and verify the settings. Raises a `BenchError`; `LimitExceeded` before anything is sent."""

    def start(self) -> None:
        """Start one reading with the configured number of samples; return without waiting for it."""

    def fetch(self) -> dict[Channel, tuple[float, ...]]:
        """Wait for the reading and return the samples in volts, `{"x": (1.2, 1.2)}`.

        Raises `BadReading` for an overload or malformed reply, `InstrumentLost`, `InstrumentRefused`.
        """


@dataclass(frozen=True, slots=True)
class HeadPosition:
    """The angle read from the head's scale or encoder, rad, and the direction in which it was approached."""

    angle_rad: float
    direction: Direction


@runtime_checkable
class DividingHead(Instrument, Protocol):
    """A dividing head: it turns its shaft to an angle, approached in a given direction."""

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Turn to `target_rad`, arriving with rising (+1) or falling (-1) angle; return the angle read back.

        `key` names the step of the procedure. Raises a `BenchError` if the head does not arrive.
        """


@runtime_checkable
class ThermalChamber(Instrument, Protocol):
    """A chamber that controls the temperature of the block."""

    asks_person: bool
    """Whether a person must read the temperature; `temperature` is then called once per mounting only."""

    def set_temperature(self, target_c: float, key: str) -> None:
        """Set the temperature, °C. Raises `LimitExceeded` before anything is set; other `BenchError`s."""

    def make_safe(self) -> str:
        """Put the chamber into its safe state; return what a person must still do, an empty string for nothing.

        Called at every end of a run, also after a failure. Raises `BenchError` if the chamber does not comply.
        """

    def temperature(self, key: str, *, settling: bool = False) -> float:
        """Return the temperature at the block or, without a sensor there, of the air, °C.

        The bench file may state a band around the set point. Raises `InstrumentRefused` if the temperature is
        outside this band, unless `settling` is true; also `InstrumentLost`, `BadReading`.
        """


LevelAxis = Literal["along", "across"]
"""Axes of the level for an observer who faces the end of the shaft: "along" the shaft is positive when the far
end is higher, "across" the shaft when the right end is higher."""


@dataclass(frozen=True, slots=True)
class Inclination:
    """An inclination read from a level, rad, including the level's zero error; signs as in `LevelAxis`."""

    along_rad: float
    across_rad: float


@dataclass(frozen=True, slots=True)
class LevelSizes:
    """Standard uncertainties of a level: one reading (rad), the scale (relative) and the cross-sensitivity.

    The cross-sensitivity is the fraction of the other axis's inclination that enters a reading, because the axes
    are misaligned or the half turn is inexact.
    """

    reading_rad: float
    scale: float
    cross: float


@runtime_checkable
class Level(Instrument, Protocol):
    """A two-axis level on the platform; its zero error is unknown."""

    asks_person: bool
    """Whether a person reads the level, in prompts that also say how to place it. Otherwise a person only places
    it.
    """

    @property
    def sizes(self) -> LevelSizes:
        """The standard uncertainties of the level."""

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Return the inclination that the level shows, in its first position or `turned` by half a turn.

        Raises `BadReading` if the level is out of range, `InstrumentRefused`, `InstrumentLost`, `NoAnswer`.
        """


@runtime_checkable
class Thermometer(Instrument, Protocol):
    """A separate thermometer at the block, at the voltmeters or in the room, not a chamber's sensor."""

    asks_person: bool
    """Whether a person must read the thermometer; it is then read once per mounting only."""

    sensor: str
    """The sensor and its place, as recorded: "Pt100, four wires, channel 104"."""

    def block_c(self, key: str) -> float:
        """Return the temperature at the thermometer's place, °C; `key` names the step of the procedure.

        Raises `BadReading` for an open sensor or an implausible temperature, `InstrumentRefused`,
        `InstrumentLost`, `NoAnswer`.
        """


# --- power supplies ---------------------------------------------------------------------------------
# A voltage has the sign of its output: a negative output is set to -12 V, its protection to -13 V. A current is
# never negative.

_HALF_STEP: Final = 0.51
"""A setting read back may differ by half a step; the excess over 0.5 allows for floating-point rounding."""


class SetOtherwise(InstrumentRefused):
    """An output was found on with other settings than requested. Nothing was changed: ask a person."""


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """The settings of an output: voltage (V), current limit (A), over-voltage protection (V; None for none)."""

    voltage_v: float
    current_limit_a: float
    over_voltage_v: float | None = None

    def __str__(self) -> str:
        protection = "" if self.over_voltage_v is None else f", protected at {self.over_voltage_v:g} V"
        return f"{self.voltage_v:g} V up to {self.current_limit_a:g} A{protection}"


@dataclass(frozen=True, slots=True)
class OutputState:
    """The state of an output: on or off, its settings, and its measured voltage (V) and current (A).

    With `tripped`, a protection has switched the output off and keeps it off until the trip is cleared. With
    `limiting`, the output is on, its current is at the limit, and its voltage is below the set voltage.
    """

    on: bool
    settings: OutputSettings
    voltage_v: float
    current_a: float
    tripped: bool = False
    limiting: bool = False


@dataclass(frozen=True, slots=True)
class OutputLimits:
    """The lowest and highest voltage (V) and current limit (A) of an output, and the steps of these settings.

    `over_voltage_v` is the lowest and highest setting of the over-voltage protection, None if there is none.
    """

    voltage_v: tuple[float, float]
    current_a: tuple[float, float]
    voltage_step_v: float
    current_step_a: float
    over_voltage_v: tuple[float, float] | None = None
    over_voltage_step_v: float = 0.1

    def transgressions(self, settings: OutputSettings) -> list[str]:
        """Return one phrase for each setting that the output does not support."""
        wrong = []
        if not _inside(settings.voltage_v, self.voltage_v):
            wrong.append(message(f"{settings.voltage_v:g} V (it has {_span(self.voltage_v)} V)"))
        if not _inside(settings.current_limit_a, self.current_a):
            wrong.append(
                message(
                    f"a current limit of {settings.current_limit_a:g} A (it has {_span(self.current_a)} A)"
                )
            )
        protection_v = settings.over_voltage_v
        if protection_v is not None and self.over_voltage_v is None:
            wrong.append(message("an over-voltage protection (it has none)"))
        elif protection_v is not None and self.over_voltage_v is not None:
            if not _inside(protection_v, self.over_voltage_v):
                has = _span(self.over_voltage_v)
                wrong.append(message(f"an over-voltage protection at {protection_v:g} V (it has {has} V)"))
            elif abs(protection_v) <= abs(settings.voltage_v):
                at = f"{protection_v:g} V with {settings.voltage_v:g} V set"
                wrong.append(message(f"an over-voltage protection at {at} (it would trip at once)"))
        return wrong

    def differences(self, shown: OutputSettings, wanted: OutputSettings) -> list[str]:
        """Return one phrase for each setting in `shown` that differs from `wanted` by more than half a step.

        If no protection is wanted, any protection is accepted: it can only switch the output off.
        """
        volts, limit_a = (shown.voltage_v, wanted.voltage_v), (shown.current_limit_a, wanted.current_limit_a)
        found = []
        if _differ(*volts, self.voltage_step_v):
            found.append(message(f"the voltage is {volts[0]:g} V, not {volts[1]:g} V"))
        if _differ(*limit_a, self.current_step_a):
            found.append(message(f"the current limit is {limit_a[0]:g} A, not {limit_a[1]:g} A"))
        given_v, wanted_v = shown.over_voltage_v, wanted.over_voltage_v
        if wanted_v is None:
            return found
        if given_v is None:
            found.append(message(f"the over-voltage protection is off, not {wanted_v:g} V"))
        elif _differ(given_v, wanted_v, self.over_voltage_step_v):
            found.append(message(f"the over-voltage protection is {given_v:g} V, not {wanted_v:g} V"))
        return found


def _differ(shown: float, wanted: float, step: float) -> bool:
    return not abs(shown - wanted) <= _HALF_STEP * step


def _inside(value: float, span: tuple[float, float]) -> bool:
    return span[0] <= value <= span[1]


def _span(span: tuple[float, float]) -> str:
    return message(f"{span[0]:g} to {span[1]:g}")


@dataclass(frozen=True, slots=True)
class SupplyLimits:
    """The limits of a supply's outputs, by name; with `together`, one switch controls all outputs.

    They are read from the supply's module in `drivers.facts`; bench files are checked against them.
    """

    outputs: Mapping[str, OutputLimits] = field(default_factory=dict)
    together: bool = False

    @classmethod
    def of(cls, facts: ModuleType, model: str | None = None) -> SupplyLimits:
        """Return the limits of `model`, or of the first model for None, from a module in `drivers.facts`.

        Raises `KeyError` for an unknown model.
        """
        outputs = next(iter(facts.OUTPUTS.values())) if model is None else facts.OUTPUTS[model]
        limits = {name: OutputLimits(**stated) for name, stated in outputs.items()}
        return cls(limits, facts.SWITCHED_TOGETHER)

    def transgressions(self, settings: Mapping[str, OutputSettings]) -> list[str]:
        """Return one phrase, naming the output, for each setting that the supply does not support."""
        wrong = []
        for name, wanted in settings.items():
            if name not in self.outputs:
                wrong.append(message(f"an output {name} (it has {', '.join(self.outputs)})"))
            else:
                wrong += [
                    message(f"on its output {name} {what}")
                    for what in self.outputs[name].transgressions(wanted)
                ]
        return wrong


@runtime_checkable
class PowerSupply(Instrument, Protocol):
    """A power supply of the unit under test, with one or more outputs.

    Opening and closing the supply leave its outputs unchanged: a unit that is switched on stays on.
    """

    outputs: tuple[str, ...]
    """The manufacturer's names of the outputs."""

    asks_person: bool
    """Whether a person must read the supply; `state` is then called once per mounting only."""

    def state(self, key: str) -> dict[str, OutputState]:
        """Return the state of every output as reported by the supply; nothing is changed.

        Raises `InstrumentRefused` for errors that the supply reports, `InstrumentLost`, `BadReading`,
        `NoAnswer`.
        """

    def set_up(self, settings: Mapping[str, OutputSettings], key: str) -> None:
        """Set outputs, protections first, and read everything back. No output is switched.

        An output that is on must already have these settings. Raises `LimitExceeded` before anything is sent,
        `SetOtherwise` with the differences before anything is changed, `InstrumentRefused` for a setting not
        applied or a tripped protection, `InstrumentLost`, `BadReading`, `NoAnswer`.
        """

    def switch(self, output: str, on: bool, key: str) -> None:
        """Switch an output (all outputs, if they share one switch) on or off and read its state back.

        Raises `InstrumentRefused` if an output that was not set up is to be switched on, or if the output did
        not switch or has tripped; `InstrumentLost`, `BadReading`, `NoAnswer`.
        """

    def switch_all_off(self) -> str:
        """Switch every output off and verify; return what a person must still do, an empty string for nothing.

        May be called after any end of a run, also a failure. Raises `BenchError` if the supply does not comply.
        """
