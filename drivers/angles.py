"""Angles and numbers as an operator reads and types them."""

from __future__ import annotations

import math
import re
from typing import Final, Literal, NamedTuple

EXAMPLE: Final = "45 00 10 or 45°00′10″ or 45.0028"

ROUNDING_RAD: Final = 1e-10
"""Keeps a reading exactly at the tolerance from being refused for the last bit of a float."""

_MARKS: Final = (("°", "°º˚:"), ("′", "′'’´`:"), ("″", '″"”“'))
"""For each place (degrees, minutes, seconds) its mark and the substitutes on keyboards."""

_PART: Final = re.compile(r"(?P<number>[0-9]+(?P<decimals>\.[0-9]+)?)(?P<mark>\s*[^\s0-9.]*)\s*")


class Slip(NamedTuple):
    """A common slip in reading a scale: its error as written and in degrees, and its description."""

    size: str
    degrees: float
    words: str


SLIPS: Final = (
    Slip("10°", 10.0, "the tens of degrees are one off"),
    Slip("1°", 1.0, "the degree line is one off"),
    Slip("10′", 10.0 / 60.0, "the tens of minutes are one off"),
    Slip("1′", 1.0 / 60.0, "the minute line is one off"),
    Slip("180°", 180.0, "the opposite side of the circle was read"),
)


def wrapped_rad(angle_rad: float) -> float:
    """Return the same place of the circle in (-π, π], rad."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


def parse_angle(text: str) -> float:
    """Return the angle in rad that a person typed, such as `45 00 10`, `45°00'10"`, `45:00:10`, `45,0028`.

    Only the last of the parts may have decimals, with a dot or a comma; minutes and seconds stay below 60
    and the angle within one turn. Raises `ValueError` with one sentence and an example.
    """
    stripped = text.strip().replace("−", "-").replace("''", "″").replace("′′", "″")
    sign, body = (stripped[0], stripped[1:].lstrip()) if stripped[:1] in {"-", "+"} else ("+", stripped)
    body = re.sub(r"(?<=[0-9]),(?=[0-9])", ".", body)
    parts = _parts(body)
    if parts is None:
        raise ValueError(f"{text!r} is not an angle: type degrees, minutes, seconds such as {EXAMPLE}")
    if any(part >= 60.0 for part in parts[1:]):
        raise ValueError(
            f"{text!r} has minutes or seconds of 60 or more: type them below 60, such as {EXAMPLE}"
        )
    degrees = math.fsum(part / scale for part, scale in zip(parts, (1.0, 60.0, 3600.0), strict=False))
    if degrees >= 361.0:
        raise ValueError(f"{text!r} is more than one turn: type what the scale shows, such as {EXAMPLE}")
    return math.radians(-degrees if sign == "-" else degrees)


def _parts(body: str) -> tuple[float, ...] | None:
    """Return one to three numbers with fitting marks, or None where the text is anything else."""
    numbers: list[float] = []
    position = 0
    while position < len(body):
        match = _PART.match(body, position)
        if match is None or len(numbers) == 3:
            return None
        mark = match["mark"].strip()
        last = match.end() == len(body)
        if mark and (len(mark) > 1 or mark not in _MARKS[len(numbers)][1] or (mark == ":" and last)):
            return None
        if match["decimals"] and not last:
            return None
        if not last and not mark and match.end() == match.end("number"):
            return None  # "1.5.2": two numbers run into each other
        numbers.append(float(match["number"]))
        position = match.end()
    return tuple(numbers) or None


def read_angle(text: str, target_rad: float, tolerance_rad: float) -> float:
    """Return the angle that a person read from a scale and typed, rad, on the turn on which `target_rad` lies.

    Raises `ValueError` with the trouble in a sentence: nothing, no angle, or one that is further than
    `tolerance_rad` from the target, then by how much and, where one explains it, by which slip.
    """
    if not text.strip():
        raise ValueError("Nothing was typed: read the scale and type what it shows.")
    try:
        read_rad = parse_angle(text)
    except ValueError as error:
        raise ValueError(f"{error}.") from None
    difference_rad = wrapped_rad(read_rad - target_rad)
    if abs(difference_rad) > tolerance_rad + ROUNDING_RAD:
        raise ValueError(_disagreement(read_rad, target_rad, difference_rad, tolerance_rad))
    # The scale ends at 360°: 0°00′03″ read for a target of 360° is 360°00′03″.
    turns = round((target_rad + difference_rad - read_rad) / math.tau)
    return read_rad + turns * math.tau


def _disagreement(read_rad: float, target_rad: float, difference_rad: float, tolerance_rad: float) -> str:
    read = f"{format_dms(read_rad)} is {format_dms(abs(difference_rad))}"
    side = "above" if difference_rad > 0.0 else "below"
    slip = classic_slip(read_rad, target_rad, tolerance_rad)
    if slip is not None:
        return f"{read} {side} the target: probably {slip}."
    return (
        f"{read} {side} the target, outside the {format_dms(tolerance_rad)} allowed: "
        "turn the head until it agrees."
    )


def format_dms(angle_rad: float, decimals: int = 0) -> str:
    """Return the angle as `45°00′10″`, with `decimals` digits after the seconds; never prints 60″."""
    scale = 10**decimals
    ticks = round(abs(math.degrees(angle_rad)) * 3600.0 * scale)
    seconds, fraction = divmod(ticks, scale)
    minutes, seconds = divmod(seconds, 60)
    degrees, minutes = divmod(minutes, 60)
    sign = "-" if angle_rad < 0.0 and ticks else ""
    tail = f".{fraction:0{decimals}d}" if decimals else ""
    return f"{sign}{degrees}°{minutes:02d}′{seconds:02d}{tail}″"


def classic_slip(read_rad: float, target_rad: float, tolerance_rad: float) -> str | None:
    """Return in words the classic slip that explains `read_rad` where `target_rad` was set, or None.

    A slip explains a reading that lies within `tolerance_rad` of where the slip would put it, and there much
    rather than at the target: a line of
    the scale one off (10°, 1°, 10′, 1′), the opposite side, 360° - x, two digits swapped.
    """
    difference = wrapped_rad(read_rad - target_rad)
    if abs(difference) <= tolerance_rad:
        return None
    candidates = [
        (abs(abs(difference) - math.radians(slip.degrees)), f"{slip.words} ({slip.size})") for slip in SLIPS
    ]
    candidates.append((abs(wrapped_rad(read_rad + target_rad)), "360° - x was read instead of x"))
    miss, words = min(candidates, key=lambda candidate: candidate[0])
    # a miss of 31″ lies within 30″ of a whole minute, too, but is no slip of one
    if miss <= min(tolerance_rad, abs(difference) / 3):
        return words
    return "two digits are swapped" if _digits_swapped(read_rad, target_rad) else None


def _digits_swapped(read_rad: float, target_rad: float) -> bool:
    """Return whether one part (degrees, minutes) has two neighbouring digits swapped and the other agrees."""
    read, target = (
        re.findall(r"[0-9]+", format_dms(angle)) for angle in (read_rad % math.tau, target_rad % math.tau)
    )
    for place in (0, 1):
        rest_agrees = read[1 - place] == target[1 - place]
        a, b = read[place].zfill(3), target[place].zfill(3)
        swaps = {b[:i] + b[i + 1] + b[i] + b[i + 2 :] for i in (0, 1)}
        if rest_agrees and a != b and a in swaps:
            return True
    return False


_ARCSEC: Final = math.pi / 648000.0
_NUMBER: Final = r"([+-]?[0-9]{1,4}(?:[.,][0-9]+)?)\s*"
_TEMPERATURE: Final = re.compile(_NUMBER + r"°?\s*[cC]?")
_DIVISIONS: Final = re.compile(_NUMBER + r"(arcsec|sec|\"|''|″)?")
_SUPPLY: Final = re.compile(_NUMBER + r"(?:V|A)?", re.IGNORECASE)

SupplyUnit = Literal["V", "A"]


def typed_temperature(text: str) -> float:
    """Return the temperature, °C, that a person typed, such as `23.5` or `23,5 °C`. Raises `ValueError`."""
    match = _TEMPERATURE.fullmatch(_plain(text))
    if match is None:
        raise ValueError("That was not a temperature such as 23.5.")
    return _value(match)


def typed_bubble(text: str, division_rad: float, most_divisions: float) -> float:
    """Return by how much a bubble is off the middle, rad, typed in divisions or with `arcsec`.

    Raises `ValueError` for what is no number, or off the vial's scale of ± `most_divisions`.
    """
    typed = _plain(text).lower()
    match = _DIVISIONS.fullmatch(typed.removesuffix("divisions").strip())
    if match is None:
        raise ValueError("That was not a number of divisions such as -1.5.")
    read_rad = _value(match) * (_ARCSEC if match[2] else division_rad)
    if abs(read_rad) > (most_divisions + 1e-9) * division_rad:
        raise ValueError(
            f"{typed} is off the vial's scale of ±{most_divisions:g} divisions: level the platform, or read again."
        )
    return read_rad


def typed_supply(text: str, unit: SupplyUnit) -> float:
    """Return what a person read from a power supply, in `unit`. Raises `ValueError`."""
    match = _SUPPLY.fullmatch(_plain(text))
    if match is None:
        raise ValueError(f"That was not a number such as 15.0 {unit}.")
    return _value(match)


def _plain(text: str) -> str:
    return text.strip().replace("−", "-")


def _value(match: re.Match[str]) -> float:
    return float(match[1].replace(",", "."))
