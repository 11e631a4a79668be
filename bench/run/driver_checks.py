"""Checks of what drivers return and raise, so that a driver's defect is named and never becomes a reading."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from traceback import walk_tb
from types import FrameType
from typing import Any, Final

from bench.base.languages import message
from drivers.interfaces import (
    BadReading,
    BenchError,
    Channel,
    HeadPosition,
    Identity,
    Inclination,
    Instrument,
    OutputState,
    Voltmeter,
    VoltmeterSettings,
)

_CORRECT: Final = message("correct the driver, or report this with a wire log (--wire-log FILE)")

OVER_RANGE: Final = 2.0
"""No meter shows more than this multiple of its range: such a value has another unit, or is an overload code."""
PLAUSIBLE_C: Final = (-100.0, 200.0)
"""Temperatures of a bench, °C; the limits exclude a room temperature in kelvin and codes of an open sensor."""


def named_fault(error: Exception, instruments: Sequence[Instrument]) -> BenchError | None:
    """Return an error that names the driver in which `error` arose, with file and line; None for any other error.

    The error arose in a driver if its traceback leads through a method of one of the `instruments` and does not
    return to this program from there, as it does when a person is asked.
    """
    if isinstance(error, BenchError):
        return None
    found: tuple[Instrument, str] | None = None
    last: tuple[FrameType, int] | None = None
    for frame, line in walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__"))
        if not module.startswith("drivers.wire."):  # the driver's call says more than the line of the session
            last = frame, line
        own = next((one for one in instruments if one is frame.f_locals.get("self")), None)
        if own is not None:
            found = own, found[1] if found is not None and found[0] is own else frame.f_code.co_name
        elif module.startswith("bench."):
            found = None
    if found is None or last is None:
        lacking = getattr(error, "obj", None) if isinstance(error, AttributeError) else None
        own = next((one for one in instruments if one is lacking), None)
        return None if own is None else _fault(own, message(f"its driver has no {_method(error)}"), error)
    file = Path(last[0].f_code.co_filename)
    place = f"{file.parent.name}/{file.name}:{last[1]}"
    what = f"{type(error).__name__}: {error}".removesuffix(": ")
    return _fault(found[0], message(f"its driver failed in {found[1]} ({place}) with {what}"), error)


def _method(error: Exception) -> str:
    return str(getattr(error, "name", ""))


def _fault(instrument: Instrument, cause: str, error: Exception | None = None) -> BenchError:
    fault = BenchError(instrument.name, cause, _CORRECT)
    fault.__cause__ = error
    return fault


def _returns(instrument: Instrument, method: str, value: object, wanted: str) -> BenchError:
    """Return the error for a method of a driver that returned `value`; the message shows 40 characters of it."""
    text = " ".join(repr(value).split())
    shown = text if len(text) <= 40 else f"{text[:39]}…"
    return _fault(instrument, message(f"its driver returns {shown} from {method}, not {wanted}"))


def checked_identity(instrument: Instrument, identity: Identity) -> Identity:
    """Return the result of `open`. Raises `BenchError` if it is no `Identity` of texts."""
    given: Identity = _of_type(instrument, "open", identity, Identity)
    if not all(isinstance(part, str) for part in (given.maker, given.model, given.serial, given.firmware)):
        raise _returns(instrument, "open", identity, message("an Identity of texts"))
    return given


def checked_samples(
    meter: Voltmeter, fetched: Mapping[Channel, Iterable[float]], settings: VoltmeterSettings
) -> dict[Channel, tuple[float, ...]]:
    """Return the result of `fetch`, in volts, as plain floats.

    Raises `BenchError` if it does not hold the number of samples that was set for each channel; `BadReading` for
    a value that a meter cannot show on this range.
    """
    if not isinstance(fetched, Mapping) or set(fetched) != set(meter.channels):
        raise _returns(meter, "fetch", fetched, message(f"samples of {', '.join(meter.channels)}"))
    samples = {}
    for channel in meter.channels:
        values = fetched[channel]
        if isinstance(values, str) or not isinstance(values, Iterable):
            raise _returns(meter, "fetch", values, message(f"samples of {channel}"))
        samples[channel] = tuple(_number(meter, "fetch", value) for value in values)
        if len(samples[channel]) != settings.samples:
            got, set_to = len(samples[channel]), settings.samples
            raise _fault(meter, message(f"its driver returns {got} instead of {set_to} samples of {channel}"))
        for value in samples[channel]:
            if not abs(value) <= OVER_RANGE * settings.range_v:
                raise BadReading(
                    meter.name,
                    f"channel {channel} reads {value:g} V on the {settings.range_v:g} V range",
                    "check the wiring, and the unit and the overload codes in its driver",
                )
    return samples


def checked_temperature(instrument: Instrument, method: str, shown_c: float) -> float:
    """Return a temperature that `method` returned, °C.

    Raises `BenchError` if it is no number, `BadReading` outside `PLAUSIBLE_C`.
    """
    shown_c = _number(instrument, method, shown_c)
    low_c, high_c = PLAUSIBLE_C
    if low_c <= shown_c <= high_c:
        return shown_c
    raise BadReading(
        instrument.name,
        f"shows {shown_c:g} °C, and only {low_c:g} to {high_c:g} °C are plausible",
        "check its sensor and its unit (°C, K or °F)",
    )


def checked_position(head: Instrument, position: HeadPosition) -> HeadPosition:
    """Return the result of `move`. Raises `BenchError` if it has no finite angle or no direction."""
    given: HeadPosition = _of_type(head, "move", position, HeadPosition)
    angle_rad = _number(head, "move", given.angle_rad)
    if not math.isfinite(angle_rad) or given.direction not in (1, -1):
        raise _returns(head, "move", position, message("an angle and a direction"))
    return HeadPosition(angle_rad, 1 if given.direction == 1 else -1)


def checked_inclination(level: Instrument, inclination: Inclination) -> Inclination:
    """Return the result of `inclination`. Raises `BenchError` if it has no finite angles."""
    given: Inclination = _of_type(level, "inclination", inclination, Inclination)
    angles = [_number(level, "inclination", rad) for rad in (given.along_rad, given.across_rad)]
    if not all(map(math.isfinite, angles)):
        raise _returns(level, "inclination", inclination, message("two angles"))
    return Inclination(*angles)


def checked_states(supply: Instrument, states: Mapping[str, OutputState]) -> Mapping[str, OutputState]:
    """Return the result of `state` with plain floats. Raises `BenchError` if it is no dict of `OutputState`s."""
    if not isinstance(states, Mapping):
        raise _returns(supply, "state", states, message("the state of each output"))
    checked = {}
    for output, state in states.items():
        given: OutputState = _of_type(supply, "state", state, OutputState)
        voltage_v, current_a = (_number(supply, "state", one) for one in (given.voltage_v, given.current_a))
        checked[output] = replace(given, voltage_v=voltage_v, current_a=current_a)
    return checked


def _of_type(instrument: Instrument, method: str, value: Any, kind: type[Any]) -> Any:
    if isinstance(value, kind):
        return value
    raise _returns(instrument, method, value, kind.__name__)


def _number(instrument: Instrument, method: str, value: Any) -> float:
    if isinstance(value, Real) and not isinstance(value, bool):
        return float(value)
    raise _returns(instrument, method, value, message("a number"))
