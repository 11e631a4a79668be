"""How the block is fed: rails, switching order, warm-up, safe state; mistakes between them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, ValidationError, model_validator

from bench.base.units import (
    CURRENT,
    DURATION,
    VOLTAGE,
    DurationS,
    QuantityKind,
    SizeA,
    SizeV,
    SpanS,
    VoltageV,
    parse_quantity,
)
from bench.base.yaml_files import FileModel, Place, part, unknown_word
from bench.config.devices.registry import devices
from bench.config.devices.sections import SupplyForm
from drivers.interfaces import OutputSettings, SupplyLimits

_NAME: Final = re.compile(r"[a-z][a-z0-9]{0,30}")


def _names_a_column(name: str) -> str:
    if _NAME.fullmatch(name) is None:
        raise ValueError(
            f"a rail names columns of the readings: a small letter, then small letters and digits, such as "
            f"'p15', not '{name}'"
        )
    return name


class CurrentWindow(FileModel):
    """What a rail draws in operation, A."""

    minimum: SizeA
    maximum: SizeA


class RailLimits(FileModel):
    """What the block may never be given on a rail: absolute limits of its data sheet."""

    minimum: VoltageV
    maximum: VoltageV
    current: SizeA


class RailSection(FileModel):
    """A rail: the supply's output that feeds it, its voltage with the tolerance it is kept within, its current.

    `limits` are the block's own; `current_limit` and `over_voltage` are what the supply's output is set to before
    it is switched on. A negative rail has negative voltages throughout. What these must be to one another is
    checked with the supply (`bench.config.bench_file.rails`).
    """

    name: Annotated[str, AfterValidator(_names_a_column)]
    output: str
    voltage: VoltageV
    tolerance: SizeV
    current: CurrentWindow
    limits: RailLimits
    current_limit: SizeA
    over_voltage: VoltageV | None = None

    @property
    def settings(self) -> OutputSettings:
        """What the supply's output is set to."""
        return OutputSettings(self.voltage, self.current_limit, self.over_voltage)

    @property
    def window_v(self) -> tuple[float, float]:
        """Lowest and highest voltage that is as it should be, V."""
        return self.voltage - self.tolerance, self.voltage + self.tolerance


MOST_SAMPLES: Final = 1_000_000
"""Of a warm-up that is waited for."""


class DriftForm(FileModel):
    """Warm once each signal has moved by no more than `drift` for the time `per`; looked at each `interval`.

    What has not come to that within `timeout` is a failure.
    """

    drift: SizeV
    per: DurationS
    timeout: DurationS
    interval: DurationS = 10.0

    @model_validator(mode="after")
    def _can_come_about(self) -> DriftForm:
        if self.drift == 0.0:
            raise ValueError("the drift is more than nothing: no two samples are ever the same")
        if not 0.0 < self.interval <= self.per:
            raise ValueError(
                "the interval is longer than nothing and no longer than the time that the drift is per"
            )
        if self.timeout > MOST_SAMPLES * self.interval:
            raise ValueError(f"an interval so short takes more than {MOST_SAMPLES} samples until the timeout")
        if self.timeout < self.per + self.interval:
            raise ValueError("the timeout is at least the time that the drift is per and one interval")
        return self


def _form_of_warm_up(written: Any) -> str:
    return "warm-up until settled" if isinstance(written, dict | DriftForm) else "time to warm up"


WarmUp = Annotated[
    Annotated[SpanS, Tag("time to warm up")] | Annotated[DriftForm, Tag("warm-up until settled")],
    Discriminator(_form_of_warm_up),
]


class UnitSupplySection(FileModel):
    """The block's supply. Rails are switched on in the order in which they stand, `pause` apart, off in reverse.

    Once off, the block stays off for `least_off`. `warm_up` is a time, or until the signals have settled, from
    switching on. `when_unsafe` says what is safe for the block on every way out of a run: that it stays on, or
    that it is switched off.
    """

    rails: Annotated[tuple[RailSection, ...], Field(min_length=1)]
    pause: SpanS = 0.0
    least_off: SpanS = 0.0
    warm_up: WarmUp
    when_unsafe: Literal["stay-on", "off"]

    @property
    def switching_s(self) -> float:
        """How long it takes to switch all rails on, or off, s."""
        return self.pause * (len(self.rails) - 1)

    @property
    def warm_up_s(self) -> float:
        """The shortest warm-up, s."""
        return self.warm_up if isinstance(self.warm_up, float) else self.warm_up.per + self.warm_up.interval

    @property
    def longest_warm_up_s(self) -> float:
        """The longest warm-up, s."""
        return self.warm_up if isinstance(self.warm_up, float) else self.warm_up.timeout


_UNIT: Final[Place] = ("unit_under_test", "supply")
_INSTRUMENT: Final[Place] = ("instruments", "power_supply")

_V: Final[tuple[Place, ...]] = (
    ("voltage",), ("tolerance",), ("limits", "minimum"), ("limits", "maximum"), ("over_voltage",),
)  # fmt: skip
_A: Final[tuple[Place, ...]] = (
    ("current", "minimum"), ("current", "maximum"), ("limits", "current"), ("current_limit",),
)  # fmt: skip


def supply_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Yield every mistake with its place; `data` is the bench file as written, whatever else is wrong in it."""
    if part(data, *_UNIT) is None:
        return
    if part(data, *_INSTRUMENT) is None:
        yield (
            _UNIT,
            "the block is supplied, but the bench has no power supply; name it as 'power_supply' under instruments",
        )
    limits = _limits_of_supply(part(data, *_INSTRUMENT))
    seen: dict[tuple[str, str], int] = {}
    rails = part(data, *_UNIT, "rails")
    for index, written in enumerate(rails if isinstance(rails, list) else []):
        place: Place = (*_UNIT, "rails", index)
        for key, what in (("name", "is called"), ("output", "is fed by")):
            value = part(written, key)
            if not isinstance(value, str):
                continue
            if (key, value) in seen:
                yield (*place, key), f"rail {seen[key, value] + 1} {what} '{value}' already"
            seen.setdefault((key, value), index)
        rail = _Rail.of(written)
        supply = _against_supply(rail, part(written, "output"), limits)
        for inside, text in (*_against_block(rail), *supply):
            yield (*place, *inside), text
    pause_s = _value(part(data, *_UNIT, "pause"), DURATION)
    if pause_s and limits is not None and limits.together:
        yield (*_UNIT, "pause"), "this supply switches all of its outputs at once; leave 'pause' out"


@dataclass(frozen=True)
class _Rail:
    """The numbers of a rail as written, V and A; None where one cannot be read, which is told elsewhere."""

    numbers: dict[Place, float | None]

    @classmethod
    def of(cls, written: Any) -> _Rail:
        found = {key: _value(part(written, *key), VOLTAGE) for key in _V}
        return cls(found | {key: _value(part(written, *key), CURRENT) for key in _A})

    def get(self, *keys: str) -> float | None:
        return self.numbers[keys]

    def all(self, *keys: Place) -> tuple[float, ...] | None:
        """Return the numbers of places, None where one of them is not there."""
        found = [self.numbers[key] for key in keys]
        known = tuple(number for number in found if number is not None)
        return known if len(known) == len(found) else None


def _against_block(rail: _Rail) -> Iterator[tuple[Place, str]]:
    """A rail stays within what the block may be given, in what it is set to and in what it is protected at."""
    yield from _voltages_against_block(rail)
    if (window := rail.all(("current", "minimum"), ("current", "maximum"))) and window[0] >= window[1]:
        yield (
            ("current",),
            f"the least current of {window[0]:g} A is not below the largest of {window[1]:g} A",
        )
    most_a, limit_a = rail.get("limits", "current"), rail.get("current_limit")
    if limit_a is not None and most_a is not None and limit_a > most_a:
        yield (
            ("current_limit",),
            f"the current limit of {limit_a:g} A is beyond the {most_a:g} A that the block may draw",
        )
    largest_a = rail.get("current", "maximum")
    if largest_a is not None and limit_a is not None and largest_a >= limit_a:
        yield (
            ("current_limit",),
            f"the current limit of {limit_a:g} A is not above the {largest_a:g} A of operation",
        )


def _voltages_against_block(rail: _Rail) -> Iterator[tuple[Place, str]]:
    voltage_v, tolerance_v = rail.get("voltage"), rail.get("tolerance")
    if voltage_v == 0.0:
        yield ("voltage",), "a rail has a voltage; leave out what the block is not fed by"
        return
    if tolerance_v == 0.0:
        yield ("tolerance",), "the tolerance is more than nothing: no supply keeps a voltage exactly"
    span = rail.all(("limits", "minimum"), ("limits", "maximum"))
    if span and span[0] >= span[1]:
        yield ("limits",), f"the minimum of {span[0]:g} V is not below the maximum of {span[1]:g} V"
        return
    if voltage_v is None:
        return
    worst_v = [voltage_v - (tolerance_v or 0.0), voltage_v + (tolerance_v or 0.0)]
    if tolerance_v is not None and tolerance_v >= abs(voltage_v):
        yield ("tolerance",), f"a tolerance of {tolerance_v:g} V lets a rail of {voltage_v:g} V be none"
    elif span and not span[0] <= worst_v[0] <= worst_v[1] <= span[1]:
        yield (
            ("voltage",),
            f"within its tolerance the rail has {worst_v[0]:g} to {worst_v[1]:g} V, but the block may be given "
            f"{span[0]:g} to {span[1]:g} V only",
        )
    protection_v = rail.get("over_voltage")
    if protection_v is None:
        return
    if protection_v * voltage_v <= 0.0 or abs(protection_v) <= max(map(abs, worst_v)):
        end_v = worst_v[0] if voltage_v < 0.0 else worst_v[1]
        yield (
            ("over_voltage",),
            f"a protection at {protection_v:g} V would strike within the rail's own tolerance, which ends at "
            f"{end_v:g} V",
        )
    elif span and not span[0] <= protection_v <= span[1]:
        yield (
            ("over_voltage",),
            f"a protection at {protection_v:g} V does not protect: the block may be given {span[0]:g} to "
            f"{span[1]:g} V only",
        )


def _against_supply(rail: _Rail, output: Any, limits: SupplyLimits | None) -> Iterator[tuple[Place, str]]:
    """The supply has the output, and can do what it is to be set to."""
    if limits is None or not isinstance(output, str):
        return
    if output not in limits.outputs:
        yield ("output",), unknown_word(output, list(limits.outputs), "output of this supply")
        return
    voltage_v, limit_a = rail.get("voltage"), rail.get("current_limit")
    if voltage_v is None or limit_a is None:
        return
    settings = OutputSettings(voltage_v, limit_a, rail.get("over_voltage"))
    for what in limits.outputs[output].transgressions(settings):
        yield ("output",), f"the supply's output {output} cannot do {what}"


def _limits_of_supply(written: Any) -> SupplyLimits | None:
    """Return what the supply can do; None where it is not told, or not known."""
    device = devices().get(part(written, "driver"))
    if device is None or not issubclass(device.section, SupplyForm):
        return None
    try:
        return device.section.model_validate(written).limits
    except ValidationError:
        return None


def _value(written: Any, kind: QuantityKind) -> float | None:
    """Return a quantity as written, None where it cannot be read or is not there."""
    try:
        return parse_quantity(written, kind)
    except ValueError:
        return None
