"""How a 34401A is set to measure: functions, ranges, resolution, and the commands that set them.

Source: 34401A User's Guide (34401-90004), chapter 4, CONFigure and SENSe; chapter 8, specifications.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from drivers.facts.agilent_34401a import NPLC_BY_RESOLUTION
from drivers.facts.agilent_34401a import RANGES_V as _DC_V
from sim.scpi import Command
from sim.scpi_values import (
    DEF,
    MAX,
    MIN,
    Boolean,
    Number,
    ScpiError,
    Text,
    Value,
    next_above,
    next_below,
    notation_pattern,
    quoted,
    within,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

_APERTURE_S_BY_RESOLUTION: Final = {1e-6: 1.0, 1e-5: 0.1, 1e-4: 0.01}
_DISPLAY_ONLY: Final = {1e-6: 0.0, 1e-5: 0.0, 1e-4: 0.0}
_BANDWIDTHS_HZ: Final = (3.0, 20.0, 200.0)
_DEFAULT_BANDWIDTH_HZ: Final = 20.0


@dataclass(frozen=True)
class Function:
    """A measuring function: its name in replies, its notation in commands, ranges in `unit` (rising).

    `subsystem` is the SENSe node under which its settings stand; `integration` gives what each resolution
    (fraction of the range) costs, in NPLC, or for frequency and period in seconds. `expected` bounds what
    CONFigure takes for a range where the range itself is that of the input voltage.
    """

    name: str
    notation: str
    unit: str
    ranges: tuple[float, ...]
    integration: Mapping[float, float]
    subsystem: str = ""
    keeps_range_of: str = ""
    expected: tuple[float, float] | None = None

    @property
    def has_nplc(self) -> bool:
        """Whether it integrates over power-line cycles and its autozero doubles the time."""
        return not self.has_aperture and self.integration is not _DISPLAY_ONLY

    @property
    def has_aperture(self) -> bool:
        """Whether it counts over a gate time."""
        return self.integration is _APERTURE_S_BY_RESOLUTION

    @property
    def default_resolution(self) -> float:
        """The resolution that DEF stands for: 10 power-line cycles, 0.1 s gate time."""
        return 1e-5 if self.has_aperture else 1e-6


_AC_V: Final = (0.1, 1.0, 10.0, 100.0, 750.0)
_OHM: Final = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)

FUNCTIONS: Final[dict[str, Function]] = {
    function.name: function
    for function in (
        Function("VOLT", "VOLTage[:DC]", "V", _DC_V, NPLC_BY_RESOLUTION, "VOLTage[:DC]"),
        Function("VOLT:RAT", "VOLTage[:DC]:RATio", "V", _DC_V, NPLC_BY_RESOLUTION, keeps_range_of="VOLT"),
        Function("VOLT:AC", "VOLTage:AC", "V", _AC_V, _DISPLAY_ONLY, "VOLTage:AC"),
        Function("CURR", "CURRent[:DC]", "A", (0.01, 0.1, 1.0, 3.0), NPLC_BY_RESOLUTION, "CURRent[:DC]"),
        Function("CURR:AC", "CURRent:AC", "A", (1.0, 3.0), _DISPLAY_ONLY, "CURRent:AC"),
        Function("RES", "RESistance", "OHM", _OHM, NPLC_BY_RESOLUTION, "RESistance"),
        Function("FRES", "FRESistance", "OHM", _OHM, NPLC_BY_RESOLUTION, "FRESistance"),
        Function(
            "FREQ", "FREQuency", "HZ", _AC_V, _APERTURE_S_BY_RESOLUTION, "FREQuency", expected=(3.0, 3e5)
        ),
        Function(
            "PER", "PERiod", "S", _AC_V, _APERTURE_S_BY_RESOLUTION, "PERiod", expected=(1 / 3e5, 1 / 3.0)
        ),
        Function("CONT", "CONTinuity", "OHM", (1e3,), _DISPLAY_ONLY),
        Function("DIOD", "DIODe", "V", (1.0,), _DISPLAY_ONLY),
    )
}


@dataclass
class FunctionSettings:
    """Range, autorange and resolution (fraction of the range) of one function; `expected` as in CONFigure."""

    range_value: float
    resolution: float
    expected: float
    autorange: bool = True


def _default_settings(function: Function) -> FunctionSettings:
    start = 10.0 if 10.0 in function.ranges else function.ranges[0]
    expected = function.expected[0] if function.expected else 0.0
    return FunctionSettings(start, function.default_resolution, expected)


class Configuration:
    """Everything about what is measured and how; `on_change` is called after a command changed it.

    Numbers that are not in a list are set to the accepted one that still does what was asked: the range
    and the integration above, the detector's bandwidth below, a resolution at least as fine.
    """

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self.preset()

    def preset(self) -> None:
        """Set what *RST sets."""
        self.function = FUNCTIONS["VOLT"]
        self.by_function = {name: _default_settings(function) for name, function in FUNCTIONS.items()}
        self.autozero = True
        self.high_impedance = False
        self.bandwidth_hz = _DEFAULT_BANDWIDTH_HZ

    def settings_of(self, function: Function) -> FunctionSettings:
        """Return the settings of a function; the ratio is measured with those of DC volts."""
        return self.by_function[function.keeps_range_of or function.name]

    @property
    def settings(self) -> FunctionSettings:
        """The settings of the function that is selected."""
        return self.settings_of(self.function)

    @property
    def nplc(self) -> float:
        """Integration of the selected function in power-line cycles (its gate time where it counts)."""
        return self.function.integration[self.settings.resolution]

    # --- CONFigure ----------------------------------------------------------------------------------

    def configure(self, function: Function, range_value: Value = DEF, resolution: Value = DEF) -> None:
        """Select a function with range and resolution, and the presets that CONFigure brings.

        Raises `ScpiError` -222 for a range that there is not, 532 for too fine a resolution, -221 for a
        number as resolution where the range is left to autorange; nothing is changed then.
        """
        fresh = _default_settings(function)
        if function.expected:
            low, high = function.expected
            fresh.expected = (
                low if range_value in (MIN, DEF) else high if range_value == MAX else float(range_value)
            )
            within(fresh.expected, low, high)
            full_scale = fresh.expected
        else:
            if range_value == DEF and not isinstance(resolution, str):
                raise ScpiError(-221)
            if range_value != DEF:
                fresh.range_value = chosen_range(function, range_value)
                fresh.autorange = False
            full_scale = fresh.range_value
        fresh.resolution = chosen_resolution(function, resolution, full_scale)
        self.function = function
        self.by_function[function.keeps_range_of or function.name] = fresh
        self.autozero = not function.has_nplc or self.nplc >= 1.0
        self.high_impedance = False
        self.bandwidth_hz = _DEFAULT_BANDWIDTH_HZ

    def description(self) -> str:
        """Return the reply to CONFigure?, such as `"VOLT +1.000000E+01,+1.000000E-05"` with its quotes."""
        function, settings = self.function, self.settings
        if not function.subsystem and not function.keeps_range_of:
            return quoted(function.name)
        full_scale = settings.expected if function.expected else settings.range_value
        return quoted(f"{function.name} {full_scale:+.6E},{full_scale * settings.resolution:+.6E}")

    # --- SENSe --------------------------------------------------------------------------------------

    def commands(self) -> list[Command]:
        """Return the lines of the command table that set and read the configuration."""
        lines = [
            Command("CONFigure?", self.description),
            Command("[SENSe:]FUNCtion", self._select, (Text(),)),
            Command("[SENSe:]FUNCtion?", lambda: quoted(self.function.name)),
            Command("[SENSe:]DETector:BANDwidth", self._set_bandwidth, (Number("HZ"),)),
            Command("[SENSe:]DETector:BANDwidth?", self._bandwidth, (Number(optional=True),)),
            Command("[SENSe:]ZERO:AUTO", self.set_autozero, (Boolean(("ONCE",)),)),
            Command("[SENSe:]ZERO:AUTO?", lambda: str(int(self.autozero))),
            Command("INPut:IMPedance:AUTO", self.set_high_impedance, (Boolean(),)),
            Command("INPut:IMPedance:AUTO?", lambda: str(int(self.high_impedance))),
        ]
        for function in FUNCTIONS.values():
            if function.subsystem:
                lines += self._range_lines(function) + self._resolution_lines(function)
        return lines

    def _range_lines(self, function: Function) -> list[Command]:
        input_node = ":VOLTage" if function.expected else ""
        node = f"[SENSe:]{function.subsystem}{input_node}:RANGe"
        unit = "V" if function.expected else function.unit
        settings = partial(self.settings_of, function)

        def set_range(value: Value) -> None:
            settings().range_value = chosen_range(function, value)
            settings().autorange = False
            self._on_change()

        def set_autorange(flag: str) -> None:
            settings().autorange = flag == "1"
            self._on_change()

        def read_range(word: str = "") -> str:
            limits = {MIN: function.ranges[0], MAX: function.ranges[-1]}
            return f"{limits.get(word, settings().range_value):+.6E}"

        return [
            Command(node, set_range, (Number(unit),)),
            Command(f"{node}?", read_range, (Number(optional=True),)),
            Command(f"{node}:AUTO", set_autorange, (Boolean(),)),
            Command(f"{node}:AUTO?", lambda: str(int(settings().autorange))),
        ]

    def _resolution_lines(self, function: Function) -> list[Command]:
        node = f"[SENSe:]{function.subsystem}"
        by_integration = {integration: resolution for resolution, integration in function.integration.items()}
        accepted = sorted(by_integration)
        settings = partial(self.settings_of, function)

        def set_resolution(value: Value) -> None:
            settings().resolution = chosen_resolution(function, value, settings().range_value)
            self._on_change()

        def read_resolution(word: str = "") -> str:
            limits = {MIN: min(function.integration), MAX: max(function.integration)}
            return f"{limits.get(word, settings().resolution) * settings().range_value:+.6E}"

        def set_integration(value: Value) -> None:
            limits = {MIN: accepted[0], MAX: accepted[-1]}
            wanted = limits[value] if isinstance(value, str) else within(value, accepted[0] * (1 - 1e-6), 1e9)
            settings().resolution = by_integration[next_above(wanted, accepted)]
            self._on_change()

        def read_integration(word: str = "") -> str:
            limits = {MIN: accepted[0], MAX: accepted[-1]}
            return f"{limits.get(word, function.integration[settings().resolution]):+.6E}"

        lines = []
        if not function.has_aperture:
            lines += [
                Command(f"{node}:RESolution", set_resolution, (Number(function.unit),)),
                Command(f"{node}:RESolution?", read_resolution, (Number(optional=True),)),
            ]
        if function.has_nplc or function.has_aperture:
            keyword, unit = ("NPLCycles", "") if function.has_nplc else ("APERture", "S")
            lines += [
                Command(f"{node}:{keyword}", set_integration, (Number(unit),)),
                Command(f"{node}:{keyword}?", read_integration, (Number(optional=True),)),
            ]
        return lines

    def _select(self, name: str) -> None:
        for function in FUNCTIONS.values():
            if notation_pattern(function.notation).match(name.strip()):
                self.function = function
                self._on_change()
                return
        raise ScpiError(-224)

    def _set_bandwidth(self, value: Value) -> None:
        limits = {MIN: _BANDWIDTHS_HZ[0], MAX: _BANDWIDTHS_HZ[-1]}
        wanted_hz = limits[value] if isinstance(value, str) else within(value, _BANDWIDTHS_HZ[0], 3e5)
        self.bandwidth_hz = next_below(wanted_hz, _BANDWIDTHS_HZ)
        self._on_change()

    def _bandwidth(self, word: str = "") -> str:
        limits = {MIN: _BANDWIDTHS_HZ[0], MAX: _BANDWIDTHS_HZ[-1]}
        return f"{limits.get(word, self.bandwidth_hz):+.6E}"

    def set_autozero(self, flag: str) -> None:
        """ZERO:AUTO."""
        # ONCE takes one zero reading and then leaves autozero off.
        self.autozero = flag == "1"
        self._on_change()

    def set_high_impedance(self, flag: str) -> None:
        """IMPedance:AUTO."""
        self.high_impedance = flag == "1"


def chosen_range(function: Function, value: Value) -> float:
    """Return the smallest range that holds `value`; MIN and MAX are the ends. Raises -222."""
    if isinstance(value, str):
        return function.ranges[0] if value == MIN else function.ranges[-1]
    return next_above(value, function.ranges)


def chosen_resolution(function: Function, value: Value, full_scale: float) -> float:
    """Return the coarsest resolution (fraction of the range) that is at least as fine as `value`.

    Raises `ScpiError` 532 when even the finest is too coarse, -222 for a resolution that is not positive.
    """
    if isinstance(value, str):
        words = {
            MIN: min(function.integration),
            MAX: max(function.integration),
            DEF: function.default_resolution,
        }
        return words[value]
    if value <= 0.0:
        raise ScpiError(-222)
    fitting = [r for r in function.integration if r * full_scale <= value * (1.0 + 1e-6)]
    if not fitting:
        raise ScpiError(532)
    return max(fitting)
