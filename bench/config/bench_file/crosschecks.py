"""Checks between the parts of a bench file: the mistakes that no section can detect by itself."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from bench.base.arrays import CHANNELS
from bench.base.languages import message
from bench.base.units import CURRENT, DURATION, SCALE_FACTOR, VOLTAGE, QuantityKind, parse_quantity
from bench.base.yaml_files import Place, part, unknown_word
from bench.config.bench_file.sections import SURROUNDINGS, InstrumentsSection
from bench.config.devices.device import Role, bus_place
from bench.config.devices.registry import devices
from bench.config.devices.sections import CERTIFICATE, SupplyForm, VoltmeterForm, written_channels
from bench.readings.table import UNORIENTED
from drivers.interfaces import OutputSettings, SupplyLimits

_OVER_RANGE: Final = 1.2
"""Largest reading that a voltmeter with an unknown driver is assumed to support, as a fraction of its range."""

_LACKS: Final = {"sensor_noise": "a sensor without noise"}


FURTHER: Final[tuple[Role, ...]] = ("head", "chamber", "level", "thermometer", "power_supply")
"""The roles of which a bench has at most one instrument; thermometers away from the block are not included."""
_THERMOMETERS: Final = ("thermometer", *SURROUNDINGS)


def mistakes_between_parts(data: Any) -> Iterable[tuple[Place, str]]:
    """Yield the place and the text of every mistake between the parts of a bench file.

    `data` is the file as written; any part of it may be missing or malformed.
    """
    voltmeters = part(data, "instruments", "voltmeters")
    yield from _channel_mistakes(voltmeters)
    yield from _resource_mistakes(data)
    yield from _one_range_mistakes(voltmeters)
    yield from _signal_mistakes(data)
    yield from _label_mistakes(part(data, "installations"))
    yield from _name_mistakes(data)
    yield from _surrounding_mistakes(data)
    yield from _simulation_mistakes(data)
    yield from supply_mistakes(data)


def _channel_mistakes(voltmeters: Any) -> Iterator[tuple[Place, str]]:
    """Yield a mistake unless exactly one voltmeter carries each of x, y and z."""
    place: Place = ("instruments", "voltmeters")
    if not isinstance(voltmeters, list):
        return
    carried: dict[str, int] = {}
    unreadable = False
    for index, meter in enumerate(voltmeters):
        key, channels = written_channels(meter) or ("", ())
        unreadable |= not key
        for channel in channels:
            unreadable |= channel not in CHANNELS  # pydantic reports these
            if not isinstance(channel, str):
                continue
            if channel in carried:
                text = f"channel {channel} is carried by voltmeter {carried[channel] + 1} already"
                yield (*place, index, key), text
            carried.setdefault(channel, index)
    missing = [channel for channel in CHANNELS if channel not in carried]
    if missing and not unreadable:
        yield (
            place,
            message(
                f"no voltmeter reads channel {', '.join(missing)}; give each of x, y, z to one voltmeter"
            ),
        )


def _one_range_mistakes(voltmeters: Any) -> Iterator[tuple[Place, str]]:
    ranges = [_value(part(meter, "range") or "10 V", VOLTAGE) for meter in _items(voltmeters)]
    for index, range_v in enumerate(ranges):
        if range_v is not None and ranges[0] is not None and range_v != ranges[0]:
            text = f"this voltmeter has the range {range_v:g} V, the first {ranges[0]:g} V; give all the same range"
            yield ("instruments", "voltmeters", index, "range"), text


def _resource_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Check that no two instruments have the same resource, unless they are inputs of one multiplexer."""
    meters = enumerate(_items(part(data, "instruments", "voltmeters")))
    places: list[tuple[str, Place]] = [(f"voltmeter {i + 1}", ("voltmeters", i)) for i, _ in meters]
    places += [(f"the {role.replace('_', ' ')}", (role,)) for role in (*FURTHER, *SURROUNDINGS)]
    known: dict[object, str] = {}
    for called, inside in places:
        place: Place = ("instruments", *inside, "resource")
        resource = part(data, *place)
        if not isinstance(resource, str):
            continue
        where = bus_place(resource) or resource
        if where in known and not (inside[0] in _THERMOMETERS and _is_on_a_free_channel(data, inside[0])):
            yield place, message(f"'{resource}' is {known[where]} already")
        known.setdefault(where, called)


def _is_on_a_free_channel(data: Any, key: str) -> bool:
    """Return whether the thermometer `key` has a multiplexer channel that no instrument before it uses."""
    section = part(data, "instruments", key)
    resource = part(section, "resource")
    meters = [m for m in _items(part(data, "instruments", "voltmeters")) if part(m, "resource") == resource]
    before = [part(data, "instruments", other) for other in _THERMOMETERS[: _THERMOMETERS.index(key)]]
    sensors = [other for other in before if part(other, "resource") == resource]
    taken = {str(part(meter, "inputs", channel)) for meter in meters for channel in CHANNELS}
    return (
        all(part(one, "driver") == "keysight-34970a-thermometer" for one in (section, *sensors))
        and all(part(meter, "driver") == "keysight-34970a" for meter in meters)
        and bool(meters or sensors)
        and not _with_pair(section) & taken.union(*map(_with_pair, sensors))
    )


def _with_pair(sensor: Any) -> set[str]:
    """Return the channel of a sensor and the channel ten higher, where its sense wires may be."""
    own = str(part(sensor, "channel"))
    return {own, str(int(own) + 10)} if own.isdecimal() else {own}


def _surrounding_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Check that thermometers of meters and room have no certificate or gradient, and no absent `chamber`."""
    for key in SURROUNDINGS:
        stated = part(data, "instruments", key)
        chamber = part(data, "instruments", "chamber")
        if stated == "chamber" and chamber is None:
            text = (
                "'chamber' takes the temperature from a chamber, but this bench has none; state a thermometer"
            )
            yield ("instruments", key), text
        elif stated == "chamber" and part(chamber, "driver") == "manual-chamber":
            text = message("a person reads this chamber once per mounting only; state a thermometer")
            yield ("instruments", key), text
        for unused in ("certificate", "gradient"):
            if part(stated, unused) is not None:
                text = message(f"only differences of this temperature count, and no '{unused}'; leave it out")
                yield ("instruments", key, unused), text


def _signal_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Check that the block's signals at 1 g stay within the voltmeters' range."""
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
            yield place, message(f"1 g gives {abs(scale):g} V, but {limit}; take a higher range")
    for row, channel in enumerate(CHANNELS):
        truth: Place = ("simulation", "block")
        terms = [_value(part(data, *truth, "K", row, column), SCALE_FACTOR) for column in range(3)]
        bias = _value(part(data, *truth, "U0", row), VOLTAGE)
        known = [term for term in terms if term is not None]
        if len(known) == 3 and bias is not None:
            peak_v = float(np.linalg.norm(known)) + abs(bias)
            if peak_v > full_scale_v:
                yield (
                    (*truth, "K", row),
                    message(f"channel {channel} reaches {peak_v:.3g} V in a turn, but {limit}"),
                )


def _label_mistakes(installations: Any) -> Iterator[tuple[Place, str]]:
    for label in installations if isinstance(installations, dict) else {}:
        if label in UNORIENTED:
            text = (
                "F (free), S (shorted), R (reference) mark readings without orientation; choose another label"
            )
            yield ("installations", label), text
        elif not label.isalnum():
            yield (
                ("installations", label),
                f"state a label of letters and digits such as '3' or 'U1', not '{label}'",
            )


def _name_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Yield mistakes: an instrument name used twice, a simulated fault that names no wired instrument."""
    instruments = _instruments(data)
    if instruments is None:
        return
    seen: set[str] = set()
    for name in instruments.names():
        if name in seen:
            yield (
                ("instruments",),
                message(f"two instruments are called '{name}'; give one of them another name"),
            )
        seen.add(name)
    by_hand = {section.name for section in instruments.all() if section.by_hand}
    wired = [name for name in instruments.names() if name not in by_hand]
    for index, fault in enumerate(_items(part(data, "simulation", "faults"))):
        named = part(fault, "instrument")
        if isinstance(named, str) and named not in wired:
            yield ("simulation", "faults", index, "instrument"), unknown_word(named, wired, "instrument")


def _simulation_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Check that the simulation section describes only what the named instruments can simulate."""
    accuracy: Place = ("simulation", "voltmeter", "accuracy")
    if part(data, *accuracy) == CERTIFICATE:
        meters = enumerate(_items(part(data, "instruments", "voltmeters")), start=1)
        without = [str(number) for number, meter in meters if part(meter, "certificate") is None]
        if without:
            text = f"voltmeter {', '.join(without)} has no certificate from which to draw errors"
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
            yield ("simulation", role, key), message(f"the simulated {driver} has {lacking}; leave it out")


def _instruments(data: Any) -> InstrumentsSection | None:
    try:
        return InstrumentsSection.model_validate(part(data, "instruments"))
    except ValidationError:
        return None


def _items(written: Any) -> list[Any]:
    return written if isinstance(written, list) else []


_UNIT: Final[Place] = ("unit_under_test", "supply")
_INSTRUMENT: Final[Place] = ("instruments", "power_supply")

_Rail = dict[str, float | None]
"""Numbers of a rail's section, V and A, by key."""
_V: Final = ("voltage", "tolerance", "limits.minimum", "limits.maximum", "over_voltage")
_A: Final = ("current.minimum", "current.maximum", "limits.current", "current_limit")


def supply_mistakes(data: Any) -> Iterator[tuple[Place, str]]:
    """Yield the place and text of every mistake in the section on the block's supply.

    `data` is the bench file as written, however incomplete. A missing power supply is a mistake, too, and so
    are settings beyond the limits of the block or of the power supply.
    """
    if part(data, *_UNIT) is None:
        return
    if part(data, *_INSTRUMENT) is None:
        yield (
            _UNIT,
            "the block is supplied, but the bench has no power supply; add 'power_supply' under instruments",
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
        rail = _numbers(written)
        supply = _against_supply(rail, part(written, "output"), limits)
        for inside, text in (*_against_block(rail), *supply):
            yield (*place, *inside), text
    pause_s = _value(part(data, *_UNIT, "pause"), DURATION)
    if pause_s and limits is not None and limits.together:
        yield (*_UNIT, "pause"), message("this supply switches all outputs together; remove 'pause'")


def _numbers(written: Any) -> _Rail:
    """Return the numbers of a rail's section by key; None for an unreadable number, which pydantic reports."""
    kinds = dict.fromkeys(_V, VOLTAGE) | dict.fromkeys(_A, CURRENT)
    return {key: _value(part(written, *key.split(".")), kind) for key, kind in kinds.items()}


def _span(rail: _Rail, key: str) -> tuple[float, float] | None:
    least, most = rail[f"{key}.minimum"], rail[f"{key}.maximum"]
    return None if least is None or most is None else (least, most)


def _against_block(rail: _Rail) -> Iterator[tuple[Place, str]]:
    """Check that a rail's settings and protections stay within the limits of the block."""
    yield from _voltages_against_block(rail)
    if (window := _span(rail, "current")) and window[0] >= window[1]:
        yield (
            ("current",),
            f"the least current of {window[0]:g} A is not below the largest of {window[1]:g} A",
        )
    most_a, limit_a = rail["limits.current"], rail["current_limit"]
    if limit_a is not None and most_a is not None and limit_a > most_a:
        yield (
            ("current_limit",),
            f"the current limit of {limit_a:g} A exceeds the {most_a:g} A that the block may draw; lower it",
        )
    largest_a = rail["current.maximum"]
    if largest_a is not None and limit_a is not None and largest_a >= limit_a:
        yield (
            ("current_limit",),
            f"the current limit of {limit_a:g} A is not above the {largest_a:g} A of operation",
        )


def _voltages_against_block(rail: _Rail) -> Iterator[tuple[Place, str]]:
    voltage_v, tolerance_v = rail["voltage"], rail["tolerance"]
    if voltage_v == 0.0:
        yield ("voltage",), message("a rail needs a voltage above 0; remove rails that do not feed the block")
        return
    if tolerance_v == 0.0:
        yield ("tolerance",), message("state a tolerance above 0 V: no supply keeps a voltage exactly")
    span = _span(rail, "limits")
    if span and span[0] >= span[1]:
        yield ("limits",), message(f"the minimum of {span[0]:g} V is not below the maximum of {span[1]:g} V")
        return
    if voltage_v is None:
        return
    worst_v = [voltage_v - (tolerance_v or 0.0), voltage_v + (tolerance_v or 0.0)]
    if tolerance_v is not None and tolerance_v >= abs(voltage_v):
        yield (
            ("tolerance",),
            message(f"a tolerance of {tolerance_v:g} V lets a rail of {voltage_v:g} V be none"),
        )
    elif span and not span[0] <= worst_v[0] <= worst_v[1] <= span[1]:
        yield (
            ("voltage",),
            f"within its tolerance the rail has {worst_v[0]:g} to {worst_v[1]:g} V, but the block tolerates "
            f"{span[0]:g} to {span[1]:g} V only",
        )
    protection_v = rail["over_voltage"]
    if protection_v is None:
        return
    if protection_v * voltage_v <= 0.0 or abs(protection_v) <= max(map(abs, worst_v)):
        end_v = worst_v[0] if voltage_v < 0.0 else worst_v[1]
        yield (
            ("over_voltage",),
            f"a protection at {protection_v:g} V would strike within the rail's own tolerance; state one beyond "
            f"{end_v:g} V",
        )
    elif span and not span[0] <= protection_v <= span[1]:
        yield (
            ("over_voltage",),
            f"a protection at {protection_v:g} V does not protect: the block tolerates {span[0]:g} to "
            f"{span[1]:g} V only",
        )


def _against_supply(rail: _Rail, output: Any, limits: SupplyLimits | None) -> Iterator[tuple[Place, str]]:
    """Check that the supply has the output stated for a rail, and that this output supports the rail's settings."""
    if limits is None or not isinstance(output, str):
        return
    if output not in limits.outputs:
        yield ("output",), unknown_word(output, list(limits.outputs), "output of this supply")
        return
    voltage_v, limit_a = rail["voltage"], rail["current_limit"]
    if voltage_v is None or limit_a is None:
        return
    protection_v = rail["over_voltage"]
    if protection_v is not None and abs(protection_v) <= abs(voltage_v):
        protection_v = None  # reported at 'over_voltage' already: it would trip at once
    settings = OutputSettings(voltage_v, limit_a, protection_v)
    for what in limits.outputs[output].transgressions(settings):
        yield ("output",), message(f"the supply's output {output} cannot do {what}")


def _limits_of_supply(written: Any) -> SupplyLimits | None:
    device = devices().get(part(written, "driver"))
    if device is None or not issubclass(device.section, SupplyForm):
        return None
    try:
        return device.section.model_validate(written).limits
    except ValidationError:
        return None


def _value(written: Any, kind: QuantityKind) -> float | None:
    try:
        return parse_quantity(written, kind)
    except ValueError:
        return None
