"""Conversion of quantities with units in files ("90 arcsec", "0.3 mV", "-2.18 V/g") to SI floats.

`g` is the unit of local gravity, never the gram. Temperatures are in degrees Celsius and stay so; `K` is
only for temperature differences, as in "60 ug/K".
"""

from __future__ import annotations

import difflib
import inspect
import math
import re
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Final, Union, get_args, get_origin

from pydantic import AfterValidator, BeforeValidator

from bench.base.languages import message
from bench.base.text import shortened

if TYPE_CHECKING:
    from pint import UnitRegistry

_DEFINITIONS: Final = (
    "nano- = 1e-9 = n-",
    "micro- = 1e-6 = u-",
    "milli- = 1e-3 = m-",
    "meter = [length] = m",
    "second = [time] = s",
    "minute = 60 second = min",
    "hour = 3600 second = h",
    "day = 86400 second = d",
    "year = 365.25 day",
    "hertz = 1 / second = Hz",
    "volt = [voltage] = V",
    "ampere = [current] = A",
    "radian = [angle] = rad",
    f"degree = {math.pi!r} / 180 radian = deg",
    f"arcminute = {math.pi!r} / 10800 radian = arcmin",
    f"arcsecond = {math.pi!r} / 648000 radian = arcsec",
    f"revolution = {math.tau!r} radian = rev",
    "degree_Celsius = [celsius] = degC",
    "kelvin = degree_Celsius = K",
    "local_gravity = [gravity] = g",
    "percent = 0.01",
    "ppm = 1e-6",
)
"""Definitions of the units that a bench needs; any other unit (kg, mT) is rejected as a typing error."""

_UNITS: Final = ("V", "mV", "uV", "A", "mA", "uA", "deg", "arcmin", "arcsec", "rad", "mrad", "urad", "rev", "s",
                 "ms", "min", "h", "d", "year", "Hz", "m", "mm", "degC", "K", "g", "mg", "ug", "ppm",
                 "percent")  # fmt: skip

_QUANTITY: Final = re.compile(
    r"\s*(?P<number>[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*(?P<unit>.*?)\s*"
)
_UNIT: Final = re.compile(r"(?:1|[A-Za-z_]+(?:\^-?[0-9])?)(?:\s*[*/ ]\s*[A-Za-z_]+(?:\^-?[0-9])?)*")
_SPELLINGS: Final = (
    ("°C", "degC"), ("℃", "degC"), ("°", "deg"), ("″", "arcsec"), ("′", "arcmin"), ("%", "percent"),
    ("µ", "u"), ("μ", "u"), ("²", "^2"), ("³", "^3"), ("·", "*"), ("**", "^"),
)  # fmt: skip


@dataclass(frozen=True)
class QuantityKind:
    """A kind of physical quantity in files: its name, an example, the SI unit of the converted float.

    `only` lists the permitted spellings of units; if empty, every unit of the dimension is permitted.
    """

    called: str
    example: str
    si: str
    only: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The kind and an example in words, for messages: "an angle such as '90 arcsec'"."""
        return message(f"{self.called} such as '{self.example}'")


ANGLE: Final = QuantityKind(message("an angle"), "90 arcsec", "rad")
VOLTAGE: Final = QuantityKind(message("a voltage"), "0.3 mV", "V")
CURRENT: Final = QuantityKind(message("a current"), "200 mA", "A")
DURATION: Final = QuantityKind(message("a duration"), "30 s", "s")
TEMPERATURE: Final = QuantityKind(message("a temperature"), "23 degC", "degC", only=("degC",))
DIFFERENCE: Final = QuantityKind(message("a difference of temperatures"), "2 K", "K", only=("K", "mK"))
SCALE_FACTOR: Final = QuantityKind(message("a scale factor with its sign"), "-2.18 V/g", "V/g")
ACCELERATION: Final = QuantityKind(message("an acceleration in local gravity"), "3e-4 g", "g")
GRAVITY: Final = QuantityKind(message("an acceleration"), "9.81 m/s^2", "m/s^2")
LENGTH: Final = QuantityKind(message("a length"), "180 m", "m")
FREQUENCY: Final = QuantityKind(message("a frequency"), "50 Hz", "Hz")
RATIO: Final = QuantityKind(message("a plain number"), "0.01", "")


@cache
def _registry() -> UnitRegistry[float]:
    """Return the unit registry, built on first use because importing pint is slow."""
    from pint import UnitRegistry

    registry: UnitRegistry[float] = UnitRegistry(None)
    for definition in _DEFINITIONS:
        registry.define(definition)
    return registry


@lru_cache(maxsize=256)
def _factor(unit: str, si: str) -> float | None:
    """Return the value of one `unit` in the unit `si`, or None if their dimensions differ.

    Raises `ValueError` for an unknown unit.
    """
    registry = _registry()
    for name in re.findall(r"[A-Za-z_]+", unit):
        if name not in registry:
            near = difflib.get_close_matches(name, _UNITS, n=1)
            hint = (
                message(f", did you mean '{near[0]}'?")
                if near
                else message(f"; known are {', '.join(_UNITS)}")
            )
            raise ValueError(f"unknown unit '{name}'{hint}")
    one = registry.Quantity(1.0, registry.parse_units(unit))
    wanted = registry.parse_units(si)
    return float(one.to(wanted).magnitude) if one.is_compatible_with(wanted) else None


def parse_quantity(text: object, kind: QuantityKind) -> float:
    """Return the value of a text such as "90 arcsec" in the SI unit of `kind`.

    Raises `ValueError` with one sentence if the number or the unit is missing, the unit is unknown or of
    another dimension, or the number overflows.
    """
    if not isinstance(text, str):
        got = {dict: "a mapping", list: "a list", type(None): "nothing"}.get(type(text), repr(text))
        raise ValueError(f"expected {kind.words}, got {got}")
    return _parsed(text, kind)


def number_and_unit(text: str) -> tuple[float, str] | None:
    """Return number and unit (in the spelling of `plain_unit`) of a text; None if the text is not a quantity."""
    match = _QUANTITY.fullmatch(text.replace("−", "-"))
    return None if match is None else (float(match["number"]), plain_unit(match["unit"]))


@lru_cache(maxsize=4096)
def _parsed(text: str, kind: QuantityKind) -> float:
    """Return what `parse_quantity` returns for a text; cached, because a long procedure repeats its texts."""
    read = number_and_unit(text)
    if read is None:
        raise ValueError(f"expected {kind.words}, got '{shortened(text)}'")
    number, unit = read
    if not unit and kind.si:
        raise ValueError(f"expected {kind.words}, got '{shortened(text)}' without a unit; add one")
    factor = _factor_of(unit, kind, text)
    if factor is None or (kind.only and unit not in kind.only):
        raise ValueError(f"expected {kind.words}, got '{shortened(text)}'")
    value = number * factor
    if not math.isfinite(value):
        raise ValueError(f"expected {kind.words}, got '{shortened(text)}', which is too large")
    return value


def _factor_of(unit: str, kind: QuantityKind, text: str) -> float | None:
    if not unit:
        return 1.0
    if _UNIT.fullmatch(unit) is None:
        return None
    try:
        return _factor(unit, kind.si)
    except ValueError as error:
        raise ValueError(f"expected {kind.words}, got '{shortened(text)}' ({error})") from None


Dimension = tuple[tuple[str, float], ...]
"""SI units with their powers, sorted; angles and local gravity count as dimensionless."""


def plain_unit(unit: str) -> str:
    """Return a unit in ASCII letters: "µV/°" gives "uV/deg"."""
    for written, plain in _SPELLINGS:
        unit = unit.replace(written, plain)
    return unit


@lru_cache(maxsize=256)
def unit_of(unit: str) -> tuple[float, Dimension]:
    """Return the SI value of one `unit`, and its dimension: "mV" gives (0.001, (("V", 1.0),)).

    `unit` has the spelling of `plain_unit`, empty for a plain number. Raises `ValueError` for an unknown unit.
    """
    if not unit:
        return 1.0, ()
    if _UNIT.fullmatch(unit) is None:
        raise ValueError(message(f"'{unit}' is not a unit; known are {', '.join(_UNITS)}"))
    _factor(unit, "")
    dimensionality: Mapping[str, Any] = (
        _registry().Quantity(1.0, _registry().parse_units(unit)).dimensionality
    )
    powers = [(_SI_OF[name], float(power)) for name, power in dimensionality.items()]
    factor = _factor(unit, " * ".join(f"{si} ** {power:g}" for si, power in powers))
    kept = tuple(sorted((si, power) for si, power in powers if si not in _PLAIN))
    return (1.0 if factor is None else factor), kept


_SI_OF: Final = {
    "[time]": "s", "[length]": "m", "[voltage]": "V", "[current]": "A", "[celsius]": "K", "[angle]": "rad",
    "[gravity]": "g",
}  # fmt: skip
_PLAIN: Final = ("rad", "g")


def reads(kind: QuantityKind) -> BeforeValidator:
    """Return a validator that parses a quantity: `Annotated[float, reads(VOLTAGE)]`."""
    return BeforeValidator(lambda text: parse_quantity(text, kind))


def not_negative(kind: QuantityKind) -> BeforeValidator:
    """Return a validator that parses a quantity of 0 or more: `Annotated[float, not_negative(DURATION)]`."""

    def read(value: object) -> float:
        number = parse_quantity(value, kind)
        if number < 0.0:
            raise ValueError(f"expected {kind.words}, not negative, got '{shortened(str(value))}'")
        return number

    return BeforeValidator(read)


def above_zero(why: str) -> AfterValidator:
    """Return a validator that rejects 0 or less with the sentence `why`, such as "state a drift above 0"."""

    def check(size: float) -> float:
        if not size > 0.0:
            raise ValueError(why.format(size))
        return size

    return AfterValidator(check)


AngleRad = Annotated[float, reads(ANGLE)]
VoltageV = Annotated[float, reads(VOLTAGE)]
DurationS = Annotated[float, reads(DURATION)]
TemperatureC = Annotated[float, reads(TEMPERATURE)]
ScaleFactor = Annotated[float, reads(SCALE_FACTOR)]
AccelerationG = Annotated[float, reads(ACCELERATION)]
AccelerationMS2 = Annotated[float, reads(GRAVITY)]
LengthM = Annotated[float, reads(LENGTH)]
FrequencyHz = Annotated[float, reads(FREQUENCY)]
Ratio = Annotated[float, reads(RATIO)]
SizeV = Annotated[float, not_negative(VOLTAGE)]
SizeRad = Annotated[float, not_negative(ANGLE)]
SpanS = Annotated[float, not_negative(DURATION)]
SizeA = Annotated[float, not_negative(CURRENT)]


# --- quantities of models ---------------------------------------------------------------------------


def quantity_of(annotation: Any, metadata: Sequence[Any]) -> QuantityKind | None:
    """Return the kind of quantity of a model's field from its annotation and metadata; None for a plain number."""
    for entry in metadata:
        read = getattr(entry, "func", None)
        if read is None or not inspect.isfunction(read):
            continue
        known = inspect.getclosurevars(read)
        for value in (*known.nonlocals.values(), *known.globals.values()):
            if isinstance(value, QuantityKind):
                return value
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        return quantity_of(inner, more)
    if get_origin(annotation) in {Union, types.UnionType}:
        return next((kind for part in get_args(annotation) if (kind := quantity_of(part, ()))), None)
    return None


_WRITTEN_UNITS: Final[Mapping[str, tuple[str, float]]] = {
    "rad": ("arcsec", 206264.80624709636),
    "rad/s": ("deg/s", 57.29577951308232),
}
"""For each SI unit, the unit that people write instead, and how many of it make one SI unit."""


def written_quantity(value: float, kind: QuantityKind) -> str:
    """Return a value in SI units as people write it in files: "30 arcsec", "5 min"."""
    unit, factor = _WRITTEN_UNITS.get(kind.si, (kind.si, 1.0))
    if kind.si == "rad" and abs(value * factor) >= 3600.0 - 1e-6:
        unit, factor = "deg", 57.29577951308232
    if kind.si == "s" and value >= 60.0 and value % 60.0 == 0.0:
        unit, factor = "min", 1.0 / 60.0
    return f"{value * factor:.10g} {unit}".rstrip()
