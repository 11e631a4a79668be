"""The interfaces of instruments for the application, and the errors of instruments and persons.

Small one-verb protocols: the application knows these and never a concrete driver. What a person is asked is in
`drivers.person`.
Angles are radians, voltages volts, currents amperes, temperatures degrees Celsius, times seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Final, Literal, Protocol, runtime_checkable

# --- failures ---------------------------------------------------------------------------------------


class BenchError(Exception):
    """Something went wrong that a person can do something about.

    `instrument` is the name on the bench ("voltmeter.x"), `cause` what happened, `remedy` what to do.
    The text is one sentence with all three.
    """

    def __init__(self, instrument: str, cause: str, remedy: str) -> None:
        super().__init__(f"{instrument}: {cause}; {remedy}")
        self.instrument = instrument
        self.cause = cause
        self.remedy = remedy


class InstrumentLost(BenchError):
    """The instrument does not answer: absent, refused, cut off, or silent past its timeout."""


class InstrumentRefused(BenchError):
    """The instrument answered, and said no: wrong identity, an error in its queue, a setting not taken."""


class BadReading(BenchError):
    """An answer that is not a reading: overload, a cut or garbled reply."""


class LimitExceeded(BenchError):
    """A demand outside the limits of the instrument or of the unit under test."""


class WentAstray(BenchError):
    """A head that did not go where it was sent. It was stopped, and is not to be sent again before it is mended."""


class NotConnected(BenchError):
    """One or more instruments could not be opened; `failures` holds all of them."""

    def __init__(self, failures: Sequence[BenchError]) -> None:
        self.failures = tuple(failures)
        super().__init__(
            ", ".join(f.instrument for f in failures),
            "not connected: " + " | ".join(str(f) for f in failures),
            "mend these and start again",
        )


class NoAnswer(BenchError):
    """The person (or the script that stands for one) gave no answer to a prompt."""


# --- instruments ------------------------------------------------------------------------------------

Channel = Literal["x", "y", "z"]
CHANNELS: tuple[Channel, Channel, Channel] = ("x", "y", "z")

Direction = Literal[1, -1]
"""Approach to an angle: +1 rising, -1 falling."""


NO_SERIAL: Final = frozenset({"", "0", "-"})
"""Answers of instruments without a serial number: every 34401A answers 0."""


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

    def close(self) -> str | None:
        """Leave the instrument safe and in local, and let it go. Never raises, may be called twice.

        Each command that makes it safe is tried, whatever became of those before (`drivers.making_safe`).
        Returns what a person must still do where one failed, nothing where all is safe.
        """


@runtime_checkable
class SelfTesting(Protocol):
    """An instrument that can test itself."""

    def self_test(self) -> str:
        """Have the instrument test itself; return what it finds wrong, empty for nothing.

        What was set before is to be set anew. Raises `InstrumentLost`, `BadReading`.
        """


@dataclass(frozen=True, slots=True)
class VoltmeterSettings:
    """Settings of a voltmeter: range in volts, integration in power-line cycles, samples per reading."""

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
        """Return the settings that the model cannot do, one phrase for each."""
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

    def start(self) -> None:
        """Begin one reading of `samples` samples."""

    def fetch(self) -> dict[Channel, tuple[float, ...]]:
        """Wait for the reading and return the samples in volts, `{"x": (1.2, 1.2)}`.

        Raises `BadReading` for an overload or anything that is not a number, `InstrumentLost`.
        """


@dataclass(frozen=True, slots=True)
class HeadPosition:
    """The position of the head by its own scale, and the side of its approach."""

    angle_rad: float
    direction: Direction


@runtime_checkable
class DividingHead(Instrument, Protocol):
    """A shaft that is turned to an angle from a stated side."""

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Turn to `target_rad`, arriving with rising (+1) or falling (-1) angle; return the angle read back.

        `key` names the step that asks. Raises `LimitExceeded`, `InstrumentLost`, `NoAnswer`.
        """


@runtime_checkable
class ThermalChamber(Instrument, Protocol):
    """A chamber that holds a temperature."""

    asks_person: bool
    """Whether `temperature` costs a person an answer: then it is asked at each mounting only."""

    def set_temperature(self, target_c: float, key: str) -> None:
        """Demand a temperature, °C. Raises `LimitExceeded` before anything is sent, `InstrumentLost`."""

    def make_safe(self) -> str:
        """Go to the safe setting; return what a person must still do, empty for nothing.

        Raises `BenchError` where the chamber does not obey; it is called on every way out of a run.
        """

    def temperature(self, key: str, *, settling: bool = False) -> float:
        """Return the temperature at the block (or of the air, where that is all there is), °C.

        While it is `settling` it may still be far from what was demanded; else that is an error where the
        bench file states a band. Raises `InstrumentRefused`, `InstrumentLost`, `BadReading`.
        """


LevelAxis = Literal["along", "across"]
"""Along the shaft, positive where the end is the higher one that is away from whoever looks at the end of the
shaft; across it, positive where the end to the right is."""


@dataclass(frozen=True, slots=True)
class Inclination:
    """An inclination shown by a level, its own zero included, rad; signs as in `LevelAxis`."""

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
        """The standard uncertainties of the level."""

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Return what it shows at rest in its first position, or `turned` half a turn from it, with its own signs.

        Raises `BadReading` for what is out of its range, `InstrumentRefused`, `InstrumentLost`, `NoAnswer`.
        """


@runtime_checkable
class Thermometer(Instrument, Protocol):
    """A thermometer at the block, of its own: not that of the chamber's controller."""

    asks_person: bool
    """Whether a reading costs a person an answer: then it is read at each mounting only."""

    sensor: str
    """The sensor and its place, as in the record: "Pt100, four wires, channel 104"."""

    def block_c(self, key: str) -> float:
        """Return the temperature that it shows, °C; `key` names the step that asks.

        Raises `BadReading` for an open sensor or what no block has, `InstrumentRefused`, `InstrumentLost`,
        `NoAnswer`.
        """


# --- power supplies ---------------------------------------------------------------------------------
# A voltage has the sign of its output: a negative one is set to -12 V, its protection to -13 V. A current is what
# the output gives, never negative.

_HALF_STEP: Final = 0.51
"""A setting read back may differ by half a step and a little more, for the rounding."""


class SetOtherwise(InstrumentRefused):
    """A supply was found switched on and set otherwise than demanded; it was left so: a person is to be asked."""


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """What an output is set to: V, current limit in A, over-voltage protection in V (None: it is set to none)."""

    voltage_v: float
    current_limit_a: float
    over_voltage_v: float | None = None

    def __str__(self) -> str:
        protection = "" if self.over_voltage_v is None else f", protected at {self.over_voltage_v:g} V"
        return f"{self.voltage_v:g} V up to {self.current_limit_a:g} A{protection}"


@dataclass(frozen=True, slots=True)
class OutputState:
    """The state of an output: on or off, its settings, and its measured voltage (V) and current (A).

    `tripped`: a protection of its own has switched it off, and keeps it so until somebody clears it.
    `limiting`: it is on and gives the current of its limit, not the voltage that it is set to.
    """

    on: bool
    settings: OutputSettings
    voltage_v: float
    current_a: float
    tripped: bool = False
    limiting: bool = False


@dataclass(frozen=True, slots=True)
class OutputLimits:
    """The limits of an output: lowest and highest voltage (V) and current limit (A), and the steps of both.

    `over_voltage_v` are lowest and highest setting of its over-voltage protection, None where it has none.
    """

    voltage_v: tuple[float, float]
    current_a: tuple[float, float]
    voltage_step_v: float
    current_step_a: float
    over_voltage_v: tuple[float, float] | None = None
    over_voltage_step_v: float = 0.1

    def transgressions(self, settings: OutputSettings) -> list[str]:
        """Return the settings that the output cannot do, one phrase for each."""
        wrong = []
        if not _inside(settings.voltage_v, self.voltage_v):
            wrong.append(f"{settings.voltage_v:g} V (it has {_span(self.voltage_v)} V)")
        if not _inside(settings.current_limit_a, self.current_a):
            wrong.append(
                f"a current limit of {settings.current_limit_a:g} A (it has {_span(self.current_a)} A)"
            )
        protection_v = settings.over_voltage_v
        if protection_v is not None and self.over_voltage_v is None:
            wrong.append("an over-voltage protection (it has none)")
        elif protection_v is not None and self.over_voltage_v is not None:
            if not _inside(protection_v, self.over_voltage_v):
                has = _span(self.over_voltage_v)
                wrong.append(f"an over-voltage protection at {protection_v:g} V (it has {has} V)")
            elif abs(protection_v) <= abs(settings.voltage_v):
                at = f"{protection_v:g} V with {settings.voltage_v:g} V set"
                wrong.append(f"an over-voltage protection at {at} (it would trip at once)")
        return wrong

    def differences(self, shown: OutputSettings, wanted: OutputSettings) -> list[str]:
        """Return in what the settings shown are not those wanted, one phrase each; half a step does not count.

        Where no protection is wanted, one that is set is no difference: it can but switch off.
        """
        pairs = [
            ("the voltage", shown.voltage_v, wanted.voltage_v, self.voltage_step_v, "V"),
            ("the current limit", shown.current_limit_a, wanted.current_limit_a, self.current_step_a, "A"),
        ]
        if wanted.over_voltage_v is not None:
            if shown.over_voltage_v is None:
                return [
                    *_different(pairs),
                    f"the over-voltage protection is off, not {wanted.over_voltage_v:g} V",
                ]
            protections = (shown.over_voltage_v, wanted.over_voltage_v)
            pairs.append(("the over-voltage protection", *protections, self.over_voltage_step_v, "V"))
        return _different(pairs)


def _different(pairs: Iterable[tuple[str, float, float, float, str]]) -> list[str]:
    return [
        f"{what} is {shown:g} {unit}, not {wanted:g} {unit}"
        for what, shown, wanted, step, unit in pairs
        if not abs(shown - wanted) <= _HALF_STEP * step
    ]


def _inside(value: float, span: tuple[float, float]) -> bool:
    return span[0] <= value <= span[1]


def _span(span: tuple[float, float]) -> str:
    return f"{span[0]:g} to {span[1]:g}"


@dataclass(frozen=True, slots=True)
class SupplyLimits:
    """The limits of a supply: its outputs by name. `together`: one switch is for all of its outputs.

    Its facts state them once: what a bench file may ask is held against the same ones.
    """

    outputs: Mapping[str, OutputLimits] = field(default_factory=dict)
    together: bool = False

    @classmethod
    def of(cls, facts: ModuleType, model: str | None = None) -> SupplyLimits:
        """Return the limits of a model, of the only one where the `facts` have one; they are those of a supply.

        Raises `KeyError` for a model that they do not know.
        """
        outputs = next(iter(facts.OUTPUTS.values())) if model is None else facts.OUTPUTS[model]
        limits = {name: OutputLimits(**stated) for name, stated in outputs.items()}
        return cls(limits, facts.SWITCHED_TOGETHER)

    def transgressions(self, settings: Mapping[str, OutputSettings]) -> list[str]:
        """Return the settings that the supply cannot do, one phrase for each, with its output."""
        wrong = []
        for name, wanted in settings.items():
            if name not in self.outputs:
                wrong.append(f"an output {name} (it has {', '.join(self.outputs)})")
            else:
                wrong += [
                    f"on its output {name} {what}" for what in self.outputs[name].transgressions(wanted)
                ]
        return wrong


@runtime_checkable
class PowerSupply(Instrument, Protocol):
    """A power supply of the unit under test, with one or more outputs.

    It goes on as it is when it is opened and when it is closed: a unit that is switched on stays so.
    """

    outputs: tuple[str, ...]
    """Its outputs by the names that the make gives them."""

    asks_person: bool
    """Whether `state` costs a person answers: then it is asked at each mounting only."""

    def state(self, key: str) -> dict[str, OutputState]:
        """Return the present state of every output, as the supply reports it; nothing is changed.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused` (errors that it reports), `NoAnswer`.
        """

    def set_up(self, settings: Mapping[str, OutputSettings], key: str) -> None:
        """Set outputs, protections first, and read everything back. None is switched.

        An output that is on must be set so already. Raises `LimitExceeded` before anything is sent,
        `SetOtherwise` with what is set before anything is changed, `InstrumentRefused` for a setting not taken
        or a protection that has tripped, `InstrumentLost`, `BadReading`, `NoAnswer`.
        """

    def switch(self, output: str, on: bool, key: str) -> None:
        """Switch an output on or off and read it back; with it all others, where the supply has one switch.

        Raises `InstrumentRefused` for one that was never set up, was not taken, or has tripped since;
        `InstrumentLost`, `BadReading`, `NoAnswer`.
        """

    def switch_all_off(self) -> str:
        """Switch every output off and read it back; return what a person must still do, empty for nothing.

        Raises `BenchError` where the supply does not obey; it may be called on every way out of a run.
        """
