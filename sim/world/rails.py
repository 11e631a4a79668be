"""The rails of the block, the outputs that feed them, and what happens to these, as values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

REFERENCE_C: Final = 23.0
"""The temperature at which a rail takes the current that is stated for it, °C."""

Trip = Literal["voltage", "current"]
DisturbanceKind = Literal["sag", "drift", "load", "open", "off", "cut"]
DISTURBANCES: Final[Mapping[DisturbanceKind, str]] = {
    "sag": "the output gives less than it is set to, by `size` of it",
    "drift": "its voltage runs away by `size`, V/h",
    "load": "the rail takes `size` times its current",
    "open": "a contact between output and block opens",
    "off": "somebody switches the output off at the front panel",
    "cut": "the mains fail; afterwards the supply is as it is when it is switched on",
}


@dataclass(frozen=True)
class Rail:
    """A rail of the block: by which output it is fed, its nominal voltage (V), the current that it takes then (A).

    Within `working_v` the block works; never may it be outside of `absolute_v`, nor take more than `absolute_a`.
    """

    name: str
    output: str
    nominal_v: float
    working_v: tuple[float, float]
    absolute_v: tuple[float, float]
    current_a: float
    absolute_a: float = math.inf


@dataclass(frozen=True)
class PowerSettings:
    """What the block takes, and what its signals show without power (standard deviations, V).

    The current grows by `current_by_temperature` of it for each kelvin; at switching on it is `in_rush` times as
    large, which dies away with `in_rush_time_s`.
    """

    rails: tuple[Rail, ...] = ()
    current_by_temperature: float = 2e-3
    in_rush: float = 3.0
    in_rush_time_s: float = 0.2
    dead_offset_v: float = 2e-3
    dead_noise_v: float = 5e-4


@dataclass(frozen=True)
class Disturbance:
    """Something that happens to an output (all of them, where it names none) from `at_s` of the clock on."""

    kind: DisturbanceKind
    at_s: float
    output: str = ""
    size: float = 0.0
    lasts_s: float = math.inf


@dataclass(frozen=True)
class Stage:
    """An output from `since_s` on: switched on or not (`on_since_s`), set to V, limited to A, protected.

    It trips at `trip_v`, and where `trip_after_s` is not None when its current is limited for so long. The rest
    is what disturbs it.
    """

    since_s: float
    on: bool = False
    on_since_s: float = -math.inf
    set_v: float = 0.0
    limit_a: float = 0.0
    trip_v: float | None = None
    trip_after_s: float | None = None
    tripped: Trip | None = None
    sag: float = 0.0
    offset_v: float = 0.0
    drift_v_s: float = 0.0
    load: float = 1.0
    open: bool = False


@dataclass(frozen=True)
class Shown:
    """What is at the terminals of an output: V, A, and whether the current is limited."""

    voltage_v: float
    current_a: float
    limiting: bool


@dataclass(frozen=True)
class Violation:
    """A rail was outside of what the block may be given: from when to when, in V or A how far at the farthest."""

    rail: str
    from_s: float
    to_s: float
    value: float
    unit: Literal["V", "A"]
