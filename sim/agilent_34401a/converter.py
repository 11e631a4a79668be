"""The analogue side of a simulated 34401A: range, gain, offset, noise, resolution, and how long it takes.

Source: 34401A User's Guide (34401-90004), chapter 8, specifications; noise per integration time as
measured on meters of this class.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Literal, Protocol

from drivers.agilent_34401a.facts import OVERLOAD_V

if TYPE_CHECKING:
    from types import ModuleType

    import numpy as np

    from sim.agilent_34401a.functions import Function, FunctionSettings

Accuracy = Literal["90 days"] | Mapping[float, tuple[float, float]]
"""The errors of a simulated meter: drawn within limits of 90 days, or by range a gain error and an offset, V."""

_NOISE_OF_RANGE: Final = {
    200.0: 0.8e-7, 100.0: 1e-7, 20.0: 2e-7, 10.0: 2.5e-7, 2.0: 6e-7, 1.0: 8e-7, 0.2: 3e-6, 0.02: 3e-5,
}  # fmt: skip
"""Standard deviation of one sample as a fraction of the range, for each NPLC."""

_NOISE_OF_INPUT_V: Final = 0.4e-6
"""Noise of the input amplifier at 1 NPLC, V: it decides on the 100 mV range."""

_FAST_INTEGRATION_S: Final = {0.02: 400e-6, 0.2: 3e-3}
_AC_SETTLING_S: Final = {3.0: 7.0, 20.0: 1.0, 200.0: 0.6}
_COUNTER_SETTLING_S: Final = 1.0
_DC_SETTLING_S: Final = 1.5e-3
_DC_FAST_SETTLING_S: Final = 1.0e-3
_QUICK_TEST_S: Final = 3e-3


class MeteredSignal(Protocol):
    """What a meter is wired to: one channel of the world."""

    @property
    def place(self) -> int:
        """Which of the bench's meters stands here, from 0: each has a serial number of its own."""
        ...

    @property
    def temperature_c(self) -> float:
        """The temperature at the meter, °C."""
        ...

    def signal_v(self, time_s: float | None = None) -> float:
        """Return the voltage at the terminals now, or as it was at `time_s` of the clock, V."""
        ...

    def new_reading(self) -> None:
        """Say that a reading was triggered."""
        ...

    def random(self, purpose: str) -> np.random.Generator:
        """Return the generator for a purpose within the present reading."""
        ...

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the generator for something that this meter has for good."""
        ...


class Measurement(Protocol):
    """How a sample is to be taken: what the converter has to know of a meter's settings."""

    @property
    def function(self) -> Function:
        """The measuring function."""
        ...

    @property
    def settings(self) -> FunctionSettings:
        """Its range, which autorange changes, and its resolution."""
        ...

    @property
    def nplc(self) -> float:
        """Integration in power-line cycles, or the gate time in s where it counts."""
        ...

    @property
    def autozero(self) -> bool:
        """Whether the zero is measured with each sample."""
        ...

    @property
    def bandwidth_hz(self) -> float:
        """The slowest alternating signal that is measured right, Hz."""
        ...


class Converter:
    """Turns the voltage at the terminals into readings, as the `facts` of a meter say of its ranges and errors.

    With `noise` a sample has white noise by its integration time and is rounded to the resolution; without,
    it is the exact value (a reply still carries 8 decimals). With `accuracy` the meter has a gain and an
    offset of its own for each range, drawn once within half the limits of error, and a temperature
    coefficient; or those errors that are given. The terminals carry a DC voltage and nothing else: AC functions,
    current, frequency and period read zero, resistance, continuity and diode see open leads, the ratio has no
    reference. While `overloaded` is set, every sample is beyond the range.
    """

    def __init__(
        self,
        source: MeteredSignal,
        facts: ModuleType,
        *,
        noise: bool,
        accuracy: Accuracy | None,
        line_hz: float,
    ) -> None:
        self._source = source
        self._facts = facts
        self._noise = noise
        self._accuracy = accuracy
        self._line_hz = line_hz
        self._errors: dict[float, tuple[float, float, float, float]] = {}
        self._generator: np.random.Generator | None = None
        self.overloaded = False

    # --- time ---------------------------------------------------------------------------------------

    def integration_s(self, configuration: Measurement) -> float:
        """Return how long the signal is integrated for one sample, s."""
        function = configuration.function
        if function.has_aperture:
            return configuration.nplc
        if not function.has_nplc:
            return _QUICK_TEST_S
        return _FAST_INTEGRATION_S.get(configuration.nplc, configuration.nplc / self._line_hz)

    def sample_s(self, configuration: Measurement) -> float:
        """Return how long one sample takes without its delay, s; autozero measures the zero as long again."""
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
        """A measurement was initiated: tell the source, and take the noise that belongs to it."""
        self._source.new_reading()
        self._generator = self._source.random("voltmeter noise") if self._noise else None

    def sample(self, configuration: Measurement, time_s: float) -> float:
        """Return one sample of the selected function, taken at `time_s`; ±`OVERLOAD_V` outside the range.

        Autorange changes the range in the settings, as on the meter.
        """
        if self.overloaded:
            return OVERLOAD_V
        match configuration.function.name:
            case "VOLT":
                return self._volts(configuration, self._source.signal_v(time_s))
            case "RES" | "FRES" | "CONT" | "DIOD" | "VOLT:RAT":
                return OVERLOAD_V
            case _:
                return 0.0

    def step(self, configuration: Measurement) -> float:
        """Return the step to which samples are rounded, 0 when they are not."""
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
        """Return the range for a signal: up where the present one is exceeded, down far below it."""
        ranges: tuple[float, ...] = self._facts.RANGES_V
        if abs(signal_v) > self._full_scale(range_v):
            return next((r for r in ranges if abs(signal_v) <= self._full_scale(r)), ranges[-1])
        index = ranges.index(range_v)
        while index > 0 and abs(signal_v) < self._facts.UNDER_RANGE * ranges[index]:
            index -= 1
        return ranges[index]


def _noise_of_range(nplc: float) -> float:
    """Return the noise as a fraction of the range; between the integration times of the table by its slope."""
    if nplc in _NOISE_OF_RANGE:
        return _NOISE_OF_RANGE[nplc]
    points = sorted((math.log(n), math.log(noise)) for n, noise in _NOISE_OF_RANGE.items())
    upper = next((i for i, (x, _) in enumerate(points) if x > math.log(nplc)), len(points) - 1)
    (x0, y0), (x1, y1) = points[max(0, upper - 1)], points[max(1, upper)]
    return math.exp(y0 + (y1 - y0) * (math.log(nplc) - x0) / (x1 - x0))


def reading_text(value: float, step: float) -> str:
    """Format a reading, `SD.DDDDDDDDESDD`; a zero carries the exponent of the step it was rounded to."""
    if value == 0.0:
        exponent = math.floor(math.log10(step) + 1e-9) if step else 0
        return f"+0.00000000E{exponent:+03d}"
    return f"{value:+.8E}"
