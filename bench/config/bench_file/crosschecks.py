"""Mistakes between the parts of a bench file: what each part by itself cannot know."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from bench.base.arrays import CHANNELS
from bench.base.units import SCALE_FACTOR, VOLTAGE, QuantityKind, parse_quantity
from bench.base.yaml_files import Place, part, unknown_word
from bench.config.bench_file.rails import supply_mistakes
from bench.config.bench_file.sections import InstrumentsSection
from bench.config.devices.device import Role, bus_place
from bench.config.devices.registry import devices
from bench.config.devices.voltmeters import CERTIFICATE, VoltmeterForm, written_channels
from bench.readings.table import UNORIENTED

_OVER_RANGE: Final = 1.2
"""Up to which part of its range a voltmeter reads whose driver cannot be read."""

_LACKS: Final = {"sensor_noise": "a sensor without noise"}


FURTHER: Final[tuple[Role, ...]] = ("head", "chamber", "level", "thermometer", "power_supply")
"""The roles of which a bench has one instrument at most."""


def mistakes_between_parts(data: Any) -> Iterable[tuple[Place, str]]:
    """Yield every mistake with its place; `data` is the file as written, whatever else is wrong in it."""
    voltmeters = part(data, "instruments", "voltmeters")
    yield from _channel_mistakes(voltmeters)
    yield from _resource_mistakes(data)
    yield from _one_range_mistakes(voltmeters)
    yield from _signal_mistakes(data)
    yield from _label_mistakes(part(data, "installations"))
    yield from _name_mistakes(data)
    yield from _simulation_mistakes(data)
    yield from supply_mistakes(data)


def _channel_mistakes(voltmeters: Any) -> Iterator[tuple[Place, str]]:
    """Each of x, y, z is carried once."""
    place: Place = ("instruments", "voltmeters")
    if not isinstance(voltmeters, list):
        return
    carried: dict[str, int] = {}
    unreadable = False
    for index, meter in enumerate(voltmeters):
        key, channels = written_channels(meter) or ("", ())
        unreadable |= not key
        for channel in channels:
            unreadable |= channel not in CHANNELS  # a list, too, which pydantic tells
            if not isinstance(channel, str):
                continue
            if channel in carried:
                text = f"channel {channel} is carried by voltmeter {carried[channel] + 1} already"
                yield (*place, index, key), text
            carried.setdefault(channel, index)
    missing = [channel for channel in CHANNELS if channel not in carried]
    if missing and not unreadable:
        yield place, f"no voltmeter carries channel {', '.join(missing)}; each of x, y, z is carried once"


def _one_range_mistakes(voltmeters: Any) -> Iterator[tuple[Place, str]]:
    """All voltmeters read on one range."""
    ranges = [_value(part(meter, "range") or "10 V", VOLTAGE) for meter in _items(voltmeters)]
    for index, range_v in enumerate(ranges):
        if range_v is not None and ranges[0] is not None and range_v != ranges[0]:
            text = f"all voltmeters read on one range: this one has {range_v:g} V, the first {ranges[0]:g} V"
            yield ("instruments", "voltmeters", index, "range"), text


def _resource_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Each resource is one instrument."""
    meters = enumerate(_items(part(data, "instruments", "voltmeters")))
    places: list[tuple[str, Place]] = [(f"voltmeter {i + 1}", ("voltmeters", i)) for i, _ in meters]
    places += [(f"the {role.replace('_', ' ')}", (role,)) for role in FURTHER]
    known: dict[object, str] = {}
    for called, inside in places:
        place: Place = ("instruments", *inside, "resource")
        resource = part(data, *place)
        if not isinstance(resource, str):
            continue
        where = bus_place(resource) or resource
        if where in known and not (inside == ("thermometer",) and _is_beside_signals(data, resource)):
            yield place, f"'{resource}' is {known[where]} already"
        known.setdefault(where, called)


def _is_beside_signals(data: Any, resource: str) -> bool:
    """Whether the thermometer is on a channel of the multiplexer at this address that has no signal."""
    section = part(data, "instruments", "thermometer")
    meters = [m for m in _items(part(data, "instruments", "voltmeters")) if part(m, "resource") == resource]
    taken = [str(part(meter, "inputs", channel)) for meter in meters for channel in CHANNELS]
    own = str(part(section, "channel"))
    return (
        part(section, "driver") == "keysight-34970a-thermometer"
        and all(part(meter, "driver") == "keysight-34970a" for meter in meters)
        and bool(meters)
        and not {own, str(int(own) + 10) if own.isdecimal() else own} & set(taken)
    )


def _signal_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """The block's signals at 1 g stay within what the voltmeters read."""
    range_v = _value(part(data, "instruments", "voltmeters", 0, "range") or "10 V", VOLTAGE)
    if range_v is None:
        return
    meter = devices().get(part(data, "instruments", "voltmeters", 0, "driver"))
    over_range = _OVER_RANGE
    if meter is not None and issubclass(meter.section, VoltmeterForm):
        over_range = meter.section.facts.OVER_RANGE
    full_scale_v = over_range * range_v
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


def _name_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Names are given once, and a fault names an instrument with a wire."""
    instruments = _instruments(data)
    if instruments is None:
        return
    seen: set[str] = set()
    for name in instruments.names():
        if name in seen:
            yield ("instruments",), f"two instruments are called '{name}'; give one of them another name"
        seen.add(name)
    by_hand = {section.name for section in instruments.all() if section.by_hand}
    wired = [name for name in instruments.names() if name not in by_hand]
    for index, fault in enumerate(_items(part(data, "simulation", "faults"))):
        named = part(fault, "instrument")
        if isinstance(named, str) and named not in wired:
            yield ("simulation", "faults", index, "instrument"), unknown_word(named, wired, "instrument")


def _simulation_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """What is said of a simulated instrument is there to be simulated."""
    accuracy: Place = ("simulation", "voltmeter", "accuracy")
    if part(data, *accuracy) == CERTIFICATE:
        meters = enumerate(_items(part(data, "instruments", "voltmeters")), start=1)
        without = [str(number) for number, meter in meters if part(meter, "certificate") is None]
        if without:
            text = f"voltmeter {', '.join(without)} has no certificate whose errors it could have"
            yield accuracy, text
    for role in FURTHER:
        stated = part(data, "simulation", role)
        section = part(data, "instruments", role)
        driver = part(section, "driver")
        if stated is None or not (section is None or isinstance(driver, str)):
            continue
        able = {device.name: device.simulated for device in devices().of(role) if device.simulated}
        if driver not in able:
            there = "none" if driver is None else driver
            text = (
                f"only a {role.replace('_', ' ')} of the driver {' or '.join(able)} has this, "
                f"and this bench has {there}; "
                "leave it out"
            )
            yield ("simulation", role), text
            continue
        elsewhere = set().union(*able.values()) - set(able[driver])
        for key in sorted(key for key in elsewhere if part(stated, key) is not None):
            lacking = _LACKS.get(key, f"no '{key}'")
            yield ("simulation", role, key), f"the simulated {driver} has {lacking}; leave it out"


def _instruments(data: Any) -> InstrumentsSection | None:
    """Return the section on instruments when there is nothing wrong with it."""
    try:
        return InstrumentsSection.model_validate(part(data, "instruments"))
    except ValidationError:
        return None


def _items(written: Any) -> list[Any]:
    return written if isinstance(written, list) else []


def _value(written: Any, kind: QuantityKind) -> float | None:
    """Return a quantity as written, None where it cannot be read (which is told elsewhere)."""
    try:
        return parse_quantity(written, kind)
    except ValueError:
        return None
