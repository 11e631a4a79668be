"""The common part of simulated voltmeters: the converter, the measuring cycle, remote and local mode."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

from drivers.facts.agilent_34401a import OVERLOAD_V
from sim.scpi import Command, DeviceClear, Interface, RemoteInstrument, never
from sim.scpi_values import DEF, MAX, MIN, ScpiError, Value, next_above
from sim.world.clock import VirtualClock, wait_until

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from types import ModuleType

    import numpy as np

    from drivers.clock import Clock

# --- measuring functions ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Function:
    """A measuring function of a meter; its `ranges` ascend, in `unit`.

    Replies call it `name`, commands `notation`. `integration` maps each resolution (fraction of the range) to
    the integration time in power-line cycles, or to the gate time in s. `keyword` is the SENSe node that sets
    this time, or empty. `settings_of` names the function whose range and resolution this function uses, too.
    A `fixed` function has no settings.
    """

    name: str
    notation: str
    unit: str
    ranges: tuple[float, ...]
    integration: Mapping[float, float]
    keyword: str = "NPLCycles"
    settings_of: str = ""
    fixed: bool = False

    @property
    def has_nplc(self) -> bool:
        """Whether the function integrates over power-line cycles; autozero doubles its measuring time."""
        return self.keyword == "NPLCycles"

    @property
    def has_aperture(self) -> bool:
        """Whether the function counts during a gate time."""
        return self.keyword == "APERture"

    @property
    def default_resolution(self) -> float:
        """The resolution for DEF: that of 10 power-line cycles, or of a gate time of 0.1 s."""
        return 1e-5 if self.has_aperture else 1e-6


@dataclass
class FunctionSettings:
    """Range (in the function's unit), autorange and resolution (fraction of the range) of one function."""

    range_value: float
    resolution: float
    autorange: bool = True


def chosen_range(function: Function, value: Value) -> float:
    """Return the smallest range that holds `value`; for MIN the lowest, for any other word the highest.

    Raises `ScpiError` -222 for a value outside all ranges.
    """
    if isinstance(value, str):
        return function.ranges[0] if value == MIN else function.ranges[-1]
    return next_above(value, function.ranges)


def chosen_resolution(function: Function, value: Value, full_scale: float) -> float:
    """Return the coarsest resolution, a fraction of the range, that is at least as fine as `value`.

    `value` and the range `full_scale` are in the function's unit. Raises `ScpiError` 532 if even the finest
    resolution is too coarse, -222 if `value` is not positive.
    """
    steps = function.integration
    if isinstance(value, str):
        return {MIN: min(steps), MAX: max(steps), DEF: function.default_resolution}[value]
    if value <= 0.0:
        raise ScpiError(-222)
    fitting = [step for step in steps if step * full_scale <= value * (1.0 + 1e-6)]
    if not fitting:
        raise ScpiError(532)
    return max(fitting)


# --- the converter ----------------------------------------------------------------------------------
# Source: 34401A User's Guide (34401-90004), chapter 8, specifications; noise per integration time as
# measured on meters of this class.

Accuracy = Literal["90 days"] | Mapping[float, tuple[float, float]]
"""Errors of a simulated meter: drawn within ± half its 90-day limits, or {range: (gain, offset in V)}."""

_NOISE_OF_RANGE: Final = {
    200.0: 0.8e-7, 100.0: 1e-7, 20.0: 2e-7, 10.0: 2.5e-7, 2.0: 6e-7, 1.0: 8e-7, 0.2: 3e-6, 0.02: 3e-5,
}  # fmt: skip
"""Standard deviation of one sample's noise, a fraction of the range, by integration time in NPLC."""

_NOISE_OF_INPUT_V: Final = 0.4e-6
"""Standard deviation of the input amplifier's noise at 1 NPLC, V; it dominates in the 100 mV range."""

_FAST_INTEGRATION_S: Final = {0.02: 400e-6, 0.2: 3e-3}
_AC_SETTLING_S: Final = {3.0: 7.0, 20.0: 1.0, 200.0: 0.6}
_COUNTER_SETTLING_S: Final = 1.0
_DC_SETTLING_S: Final = 1.5e-3
_DC_FAST_SETTLING_S: Final = 1.0e-3
_QUICK_TEST_S: Final = 3e-3


class MeteredSignal(Protocol):
    """The signal at a meter's terminals: one channel of the world."""

    @property
    def place(self) -> int:
        """The index of the meter on the bench, from 0, which determines its serial number."""

    @property
    def temperature_c(self) -> float:
        """The temperature at the meter, °C."""

    def signal_v(self, time_s: float | None = None) -> float:
        """Return the voltage at the terminals at `time_s` of the clock (default: now), V."""

    def new_reading(self) -> None:
        """Begin a new reading; called when the meter is triggered."""

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for one purpose within the present reading."""

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for a permanent property of the meter."""


class Measurement(Protocol):
    """The settings of a meter that its converter needs for a sample."""

    @property
    def function(self) -> Function:
        """The measuring function."""

    @property
    def settings(self) -> FunctionSettings:
        """The range, which autorange may change, and the resolution of the function."""

    @property
    def nplc(self) -> float:
        """The integration time in power-line cycles, or the gate time in s of a counting function."""

    @property
    def autozero(self) -> bool:
        """Whether the zero is measured together with each sample."""

    @property
    def bandwidth_hz(self) -> float:
        """The lowest AC frequency that is measured correctly, Hz."""


@dataclass(frozen=True)
class InputFlaws:
    """Errors that real wiring and a real input add to a signal; all zero for an ideal input.

    `source_ohm` is the resistance of the source; an input of 10 MOhm (10 GOhm at high impedance) loads it.
    `mains_v` is the amplitude of the mains voltage on the signal; an integration over whole cycles cancels it. With
    autozero off, the zero drifts by `zero_drift_v_s`, V/s, from time 0 of the clock.
    `flicker_v` is the standard deviation, V, of the input's 1/f noise per decade of frequency; `reference_flicker`
    is that of the meter's reference, as a fraction of the signal.
    Sources: 34401A User's Guide, chapter 7, "Loading errors", "Rejecting power-line noise voltages"; E1412A data
    sheet (autozero off).
    """

    source_ohm: float = 0.0
    mains_v: float = 0.0
    zero_drift_v_s: float = 0.0
    flicker_v: float = 0.0
    reference_flicker: float = 0.0

    def loading(self, input_ohm: float) -> float:
        """Return the fraction of the source's voltage that remains at an input of the resistance `input_ohm`."""
        return 1.0 / (1.0 + self.source_ohm / input_ohm)

    def pick_up_v(self, aperture_s: float, line_hz: float, phase_rad: float) -> float:
        """Return the mean of the mains voltage over an integration whose middle is at `phase_rad`, V."""
        cycles = aperture_s * line_hz
        if not self.mains_v or math.isclose(cycles, round(cycles), abs_tol=1e-9):
            return 0.0
        return self.mains_v * math.sin(math.pi * cycles) / (math.pi * cycles) * math.sin(phase_rad)


_FLICKER_DECADES: Final = (-5, -4, -3, -2, -1)
"""The decades of frequency, as log10 of Hz, of the 1/f noise of an input or a reference."""
_INPUT_OHM: Final = 10e6
_HIGH_IMPEDANCE_OHM: Final = 10e9


class Converter:
    """The converter from the voltage at the terminals to readings; `facts` has the ranges and error limits.

    With `noise`, each sample has white noise that depends on its integration time, and is rounded to the
    resolution. Without `noise`, samples are exact (a reply still has only 8 decimals).
    With `accuracy` "90 days", each range gets random errors once: gain, offset and their temperature
    coefficients, uniform within ± half the limit. A mapping {range: (gain error, offset in V)} states the
    errors instead; a range that it lacks has none. None means no errors. `flaws` are the fields of
    `InputFlaws`; None means an ideal input.
    The terminals carry only a DC voltage: AC functions, current, frequency and period read zero; resistance,
    continuity, diode and ratio give an overload. While `overloaded` is set, every sample is an overload.
    """

    def __init__(
        self,
        source: MeteredSignal,
        facts: ModuleType,
        *,
        noise: bool,
        accuracy: Accuracy | None,
        line_hz: float,
        flaws: Mapping[str, float] | None = None,
    ) -> None:
        self._source = source
        self._flaws = None if flaws is None else InputFlaws(**flaws)
        self._facts = facts
        self._noise = noise
        self._accuracy = accuracy
        self._line_hz = line_hz
        self._errors: dict[float, tuple[float, float, float, float]] = {}
        self._generator: np.random.Generator | None = None
        self.overloaded = False

    # --- time ---------------------------------------------------------------------------------------

    def integration_s(self, configuration: Measurement) -> float:
        """Return the integration time of one sample, s."""
        function = configuration.function
        if function.has_aperture:
            return configuration.nplc
        if not function.has_nplc:
            return _QUICK_TEST_S
        return _FAST_INTEGRATION_S.get(configuration.nplc, configuration.nplc / self._line_hz)

    def sample_s(self, configuration: Measurement) -> float:
        """Return the duration of one sample without its delay, s; autozero doubles the duration."""
        doubled = configuration.function.has_nplc and configuration.autozero
        return self.integration_s(configuration) * (2.0 if doubled else 1.0)

    def settling_s(self, configuration: Measurement) -> float:
        """Return the automatic trigger delay, s."""
        function = configuration.function
        if function.name.endswith(":AC"):
            return _AC_SETTLING_S[configuration.bandwidth_hz]
        if function.has_aperture:
            return _COUNTER_SETTLING_S
        return _DC_SETTLING_S if configuration.nplc >= 1.0 else _DC_FAST_SETTLING_S

    # --- value --------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Begin a measurement: announce a new reading to the source and get the generator of its noise."""
        self._source.new_reading()
        self._generator = self._source.random("voltmeter noise") if self._noise else None

    def sample(self, configuration: Measurement, time_s: float) -> float:
        """Return one sample of the selected function at `time_s`, in its unit; ±`OVERLOAD_V` outside the range.

        As on the meter, autorange changes the range in the settings.
        """
        if self.overloaded:
            return OVERLOAD_V
        match configuration.function.name:
            case "VOLT":
                return self._volts(configuration, self._at_input_v(configuration, time_s))
            case "RES" | "FRES" | "CONT" | "DIOD" | "VOLT:RAT":
                return OVERLOAD_V
            case _:
                return 0.0

    def _at_input_v(self, configuration: Measurement, time_s: float) -> float:
        """Return the voltage to be converted, V: the signal under the input's load, plus input errors."""
        signal_v, flaws = self._source.signal_v(time_s), self._flaws
        if flaws is None:
            return signal_v
        high = getattr(configuration, "high_impedance", True) and configuration.settings.range_value <= 10.0
        signal_v *= flaws.loading(_HIGH_IMPEDANCE_OHM if high else _INPUT_OHM)
        if configuration.function.has_nplc:
            phase_rad = 2.0 * math.pi * math.fmod(self._line_hz * time_s, 1.0)
            signal_v += flaws.pick_up_v(self.integration_s(configuration), self._line_hz, phase_rad)
        if not configuration.autozero:
            signal_v += flaws.zero_drift_v_s * time_s
        signal_v *= 1.0 + self._flicker("voltmeter reference", flaws.reference_flicker, time_s)
        return signal_v + self._flicker("voltmeter flicker", flaws.flicker_v, time_s)

    def _flicker(self, purpose: str, deviation: float, time_s: float) -> float:
        """Return 1/f noise at `time_s`, with the standard deviation `deviation` per decade of frequency.

        It is a sum of sines with fixed phases: four of equal power in each decade.
        """
        if not deviation:
            return 0.0
        drawn = self._source.fixed_random(purpose).random((len(_FLICKER_DECADES), 4, 2))
        return (
            deviation
            * math.sqrt(2.0 / 4.0)
            * sum(
                math.sin(2.0 * math.pi * (10.0 ** (decade + float(where)) * time_s + float(phase)))
                for decade, sines in zip(_FLICKER_DECADES, drawn, strict=True)
                for where, phase in sines
            )
        )

    def step(self, configuration: Measurement) -> float:
        """Return the rounding step of samples, in the function's unit, or 0 without rounding."""
        settings = configuration.settings
        return settings.range_value * settings.resolution if self._noise else 0.0

    def _volts(self, configuration: Measurement, signal_v: float) -> float:
        settings = configuration.settings
        if settings.autorange:
            settings.range_value = self._autorange(signal_v, settings.range_value)
        range_v = settings.range_value
        if abs(signal_v) > self._full_scale(range_v):
            return math.copysign(OVERLOAD_V, signal_v)
        value_v = self._with_errors(signal_v, range_v)
        if self._generator is None:
            return value_v
        nplc = configuration.nplc
        sigma_v = math.hypot(_noise_of_range(nplc) * range_v, _NOISE_OF_INPUT_V / math.sqrt(nplc))
        step_v = self.step(configuration)
        return round((value_v + sigma_v * float(self._generator.standard_normal())) / step_v) * step_v

    def _with_errors(self, signal_v: float, range_v: float) -> float:
        if self._accuracy is None:
            return signal_v
        if not isinstance(self._accuracy, str):
            known_gain, known_v = self._accuracy.get(range_v, (0.0, 0.0))
            return signal_v * (1.0 + known_gain) + known_v
        if range_v not in self._errors:
            draws = self._source.fixed_random(f"voltmeter accuracy {range_v:g} V").uniform(-0.5, 0.5, 4)
            limits = (*self._facts.ACCURACY_90_DAYS[range_v], *self._facts.TEMPERATURE_COEFFICIENT[range_v])
            gain, offset, gain_per_c, offset_per_c = (
                float(d * m) for d, m in zip(draws, limits, strict=True)
            )
            self._errors[range_v] = (gain, offset, gain_per_c, offset_per_c)
        gain, offset, gain_per_c, offset_per_c = self._errors[range_v]
        from_reference_c = self._source.temperature_c - self._facts.REFERENCE_C
        beyond_c = max(0.0, abs(from_reference_c) - self._facts.REFERENCE_WIDTH_C)
        outside_c = math.copysign(beyond_c, from_reference_c)
        gain += gain_per_c * outside_c
        offset += offset_per_c * outside_c
        return signal_v * (1.0 + gain) + range_v * offset

    def _full_scale(self, range_v: float) -> float:
        highest_v: float = self._facts.RANGES_V[-1]
        return range_v if range_v == highest_v else range_v * float(self._facts.OVER_RANGE)

    def _autorange(self, signal_v: float, range_v: float) -> float:
        """Return a higher range if the signal exceeds the present range, a lower one if it is far below it."""
        ranges: tuple[float, ...] = self._facts.RANGES_V
        if abs(signal_v) > self._full_scale(range_v):
            return next((r for r in ranges if abs(signal_v) <= self._full_scale(r)), ranges[-1])
        index = ranges.index(range_v)
        while index > 0 and abs(signal_v) < self._facts.UNDER_RANGE * ranges[index]:
            index -= 1
        return ranges[index]


def _noise_of_range(nplc: float) -> float:
    """Return the noise as a fraction of the range, interpolated log-log between tabulated values of NPLC."""
    if nplc in _NOISE_OF_RANGE:
        return _NOISE_OF_RANGE[nplc]
    points = sorted((math.log(n), math.log(noise)) for n, noise in _NOISE_OF_RANGE.items())
    upper = next((i for i, (x, _) in enumerate(points) if x > math.log(nplc)), len(points) - 1)
    (x0, y0), (x1, y1) = points[max(0, upper - 1)], points[max(1, upper)]
    return math.exp(y0 + (y1 - y0) * (math.log(nplc) - x0) / (x1 - x0))


def reading_text(value: float, step: float) -> str:
    """Format a reading as `+1.23456789E+00`; a zero has the exponent of the rounding step `step`."""
    if value == 0.0:
        exponent = math.floor(math.log10(step) + 1e-9) if step else 0
        return f"+0.00000000E{exponent:+03d}"
    return f"{value:+.8E}"


# --- the line ---------------------------------------------------------------------------------------

_ERRORS: Final = {522: "Output buffer overflow", 532: "Cannot achieve requested resolution"}
_SCPI_VERSION: Final = "1994.0"


class LineMeter(RemoteInstrument):
    """The base of simulated meters with local and remote mode; `errors` are the model's own error texts."""

    beside_measuring: tuple[str, ...] = ()
    """The commands that do not wait for a measurement in progress."""

    def __init__(self, identity: str, errors: Mapping[int, str], interface: Interface) -> None:
        super().__init__(identity, {**_ERRORS, **errors}, interface)
        self.add([Command("SYSTem:VERSion?", lambda: _SCPI_VERSION)])

    # --- defined by each model ----------------------------------------------------------------------

    @property
    @abstractmethod
    def cycle(self) -> MeasuringCycle:
        """The trigger system."""

    @property
    @abstractmethod
    def converters(self) -> Sequence[Converter]:
        """The converters, one for each input."""

    # --- called by the wire and the bench -----------------------------------------------------------

    def admit(self, command: Command) -> None:
        """Refuse what the interface forbids; all but `beside_measuring` wait while the meter measures."""
        super().admit(command)
        if command.notation not in self.beside_measuring:
            self.cycle.complete()

    def device_clear(self) -> None:
        """Stop measuring, discard the readings and become idle; keep settings and errors."""
        self.cycle.abort()

    @property
    def overloaded(self) -> bool:
        """Whether samples of any input are overloads, whatever the voltage; setting it acts on all inputs."""
        return any(converter.overloaded for converter in self.converters)

    @overloaded.setter
    def overloaded(self, overloaded: bool) -> None:
        for converter in self.converters:
            converter.overloaded = overloaded


class TriggerState(Enum):
    """State of the trigger system."""

    IDLE = "idle"
    WAITING = "waiting for a trigger"
    MEASURING = "measuring"


class MeasuringCycle(ABC):
    """The trigger system of a meter, which is idle, waits for a trigger, or measures.

    `source` is the trigger source. The memory keeps the latest `memory_depth` readings. `interrupted` returns
    whether a device clear has arrived. If the client that started a measurement has disconnected, the
    measurement is aborted as soon as another client would have to wait for it. On a virtual clock it is
    completed instead, because the wait takes no real time.
    """

    memory_depth: int
    after_last = ""
    """What is printed after the last of several readings."""

    def __init__(self, clock: Clock, interrupted: Callable[[], bool]) -> None:
        self._clock = clock
        self._interrupted = interrupted
        self._sender_left = self._beginner_left = never
        self.source = "IMM"
        self.preset()
        self.abort()

    @abstractmethod
    def preset(self) -> None:
        """Set the defaults of *RST, CONFigure and MEASure."""

    def abort(self) -> None:
        """Become idle; discard stored readings and the measurement in progress."""
        self.state = TriggerState.IDLE
        self._due: list[Any] = []
        self._memory: list[str] = []
        self._readings: list[str] = []
        self._finish_s = 0.0
        self._keeps = False

    def sent_by(self, left: Callable[[], bool]) -> None:
        """Store `left`, which returns whether the client of the following commands has disconnected.

        Also abort a measurement in progress whose own client has disconnected, except on a virtual clock.
        """
        if self._client_has_left:
            self.abort()
        self._sender_left = left

    def fetch(self) -> str:
        """FETCh?: return the readings in memory. Raises `ScpiError` -230 if there are none."""
        if not self._memory:
            raise ScpiError(-230)
        return ",".join(self._memory) + self.after_last

    def complete(self) -> None:
        """Wait until a measurement in progress ends; abort it if its client leaves meanwhile.

        Raises `DeviceClear` if a device clear arrives meanwhile.
        """
        if self.state is not TriggerState.MEASURING:
            return
        if wait_until(self._clock, self._finish_s, lambda: self._interrupted() or self._client_has_left):
            self._collect()
        elif self._interrupted():
            raise DeviceClear
        else:
            self.abort()

    @property
    def in_progress(self) -> bool:
        """Whether a measurement is still in progress."""
        return self.state is TriggerState.MEASURING and self._clock.now_s() < self._finish_s

    @property
    def _client_has_left(self) -> bool:
        """Whether a measurement is in progress for a client that has left; always False on a virtual clock."""
        return self._beginner_left() and self.in_progress and not isinstance(self._clock, VirtualClock)

    @abstractmethod
    def _schedule(self, triggers: int) -> None:
        """Schedule the samples of the next triggers in `_due`, and call `_measures_until` with their end."""

    @abstractmethod
    def _sampled(self, due: Any) -> str:
        """Return the text of one scheduled sample, an element of `_due`."""

    def _require_idle(self) -> None:
        """Raise `ScpiError` -213 if a measurement is in progress or waits for a trigger."""
        if self.state is TriggerState.MEASURING and not self.in_progress:
            self._collect()
        if self.state is not TriggerState.IDLE:
            raise ScpiError(-213)

    def _start(self, triggers: float, *, keeps: bool) -> None:
        """Start a measurement; with `keeps` its readings are stored in memory."""
        self._memory, self._readings = [], []
        self._keeps = keeps
        if self.source == "IMM":
            self._schedule(int(triggers))
        else:
            self.state = TriggerState.WAITING

    def _measures_until(self, finish_s: float) -> None:
        self._finish_s = finish_s
        self._beginner_left = self._sender_left
        self.state = TriggerState.MEASURING

    def _outcome(self) -> str | None:
        """Return the readings for READ? once complete; None (no reply) while an external trigger is missing."""
        if self.state is TriggerState.WAITING:
            return None
        self.complete()
        return ",".join(self._readings) + self.after_last

    def _collect(self) -> None:
        self._readings += map(self._sampled, self._due)
        self._due = []
        if self._keeps:
            self._memory = self._readings[-self.memory_depth :]
        self.state = TriggerState.IDLE
