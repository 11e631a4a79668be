"""Angles and numbers as an operator reads and types them."""

from __future__ import annotations

import math
import re
from typing import Final, Literal

from drivers.interfaces import message

EXAMPLE: Final = message("45 00 10 or 45°00′10″ or 45.0028")

ROUNDING_RAD: Final = 1e-10
"""Tolerance for floating-point rounding, rad, so that a reading exactly at the limit is accepted."""

_MARKS: Final = (("°", "°º˚:"), ("′", "′'’´`:"), ("″", '″"”“'))
"""The marks for degrees, minutes and seconds, each with the characters that people type in its place."""

_DEVIATION: Final = re.compile(r"(?P<sign>[+-])\s*(?P<seconds>[0-9]{1,4}(?:[.,][0-9]+)?)\s*[″\"”“]")
"""A reading typed as its deviation from the commanded angle, such as `+5"`: sign and mark are needed."""

_PART: Final = re.compile(r"(?P<number>[0-9]+(?P<decimals>\.[0-9]+)?)(?P<mark>\s*[^\s0-9.]*)\s*")


SLIPS: Final[tuple[tuple[str, float, str], ...]] = (
    ("10°", 10.0, message("the tens of degrees are one off")),
    ("1°", 1.0, message("the degree line is one off")),
    ("10′", 10.0 / 60.0, message("the tens of minutes are one off")),
    ("1′", 1.0 / 60.0, message("the minute line is one off")),
    ("180°", 180.0, "the opposite side of the circle was read"),
)
"""Common mistakes in reading a scale: size as text, size in degrees, description."""


def wrapped_rad(angle_rad: float) -> float:
    """Return the equivalent angle in (-π, π], rad."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


def parse_angle(text: str) -> float:
    """Return a typed angle in rad: `45 00 10`, `45°00'10"`, `45:00:10`, `45,0028`.

    Only the last part may have decimals, with a dot or a comma. Minutes and seconds must be below 60, the angle
    below 361°. Raises `ValueError` with a sentence that gives an example.
    """
    stripped = text.strip().replace("−", "-").replace("''", "″").replace("′′", "″")
    sign, body = (stripped[0], stripped[1:].lstrip()) if stripped[:1] in {"-", "+"} else ("+", stripped)
    body = re.sub(r"(?<=[0-9]),(?=[0-9])", ".", body)
    parts = _parts(body)
    if parts is None:
        raise ValueError(
            message(f"{text!r} is not an angle: type degrees, minutes, seconds such as {EXAMPLE}")
        )
    if any(part >= 60.0 for part in parts[1:]):
        raise ValueError(
            message(f"{text!r} has minutes or seconds of 60 or more: type them below 60, such as {EXAMPLE}")
        )
    degrees = math.fsum(part / scale for part, scale in zip(parts, (1.0, 60.0, 3600.0), strict=False))
    if degrees >= 361.0:
        raise ValueError(
            message(f"{text!r} is more than one turn: type what the scale shows, such as {EXAMPLE}")
        )
    return math.radians(-degrees if sign == "-" else degrees)


def typed_angle(text: str, target_rad: float) -> float:
    """Return a typed angle in rad; a text such as `+5"` or `-12″` states the deviation from `target_rad`.

    Raises the `ValueError` of `parse_angle`.
    """
    stripped = text.strip().replace("−", "-").replace("''", "″").replace("′′", "″")
    match = _DEVIATION.fullmatch(stripped)
    if match is None:
        return parse_angle(text)
    seconds = float(match["seconds"].replace(",", "."))
    return target_rad + math.radians((-seconds if match["sign"] == "-" else seconds) / 3600.0)


def _parts(body: str) -> tuple[float, ...] | None:
    """Return the one to three numbers (degrees, minutes, seconds) of a typed angle, None if it is malformed."""
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
    """Return the scale reading that a person typed, rad, shifted by whole turns to lie near `target_rad`.

    Raises `ValueError` with a sentence for the person if the text is empty or not an angle, or if the angle is more
    than `tolerance_rad` from the target. In the last case the sentence names the common mistake that explains the
    deviation, if there is one.
    """
    if not text.strip():
        raise ValueError(message("Nothing was typed: read the scale and type what it shows."))
    try:
        read_rad = typed_angle(text, target_rad)
    except ValueError as error:
        raise ValueError(f"{error}.") from None
    difference_rad = wrapped_rad(read_rad - target_rad)
    if abs(difference_rad) > tolerance_rad + ROUNDING_RAD:
        raise ValueError(_disagreement(read_rad, target_rad, difference_rad, tolerance_rad))
    # The scale wraps at 360°: 0°00′03″ read for a target of 360° means 360°00′03″.
    turns = round((target_rad + difference_rad - read_rad) / math.tau)
    return read_rad + turns * math.tau


def _disagreement(read_rad: float, target_rad: float, difference_rad: float, tolerance_rad: float) -> str:
    read, off = format_dms(read_rad), format_dms(abs(difference_rad))
    above = difference_rad > 0.0
    slip = classic_slip(read_rad, target_rad, tolerance_rad)
    if slip is not None:
        return message(f"{read} is {off} {'above' if above else 'below'} the target: probably {slip}.")
    return message(
        f"{read} is {off} {'above' if above else 'below'} the target, outside the "
        f"{format_dms(tolerance_rad)} allowed: "
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


def scale_text(angle_rad: float) -> str:
    """Return an angle, reduced to 0° to 360°, as scale text with 0 to 3 decimals of a second, as needed."""
    shown_rad = angle_rad if 0.0 <= angle_rad <= math.tau else angle_rad % math.tau
    for decimals in range(3):
        text = format_dms(shown_rad, decimals)
        if abs(parse_angle(text) - shown_rad) < ROUNDING_RAD:
            return text
    return format_dms(shown_rad, 3)


def classic_slip(read_rad: float, target_rad: float, tolerance_rad: float) -> str | None:
    """Return in words the common mistake that turns `target_rad` into `read_rad`, or None if none does.

    The mistakes are: one line of the scale off (10°, 1°, 10′, 1′), the opposite side of the circle, 360° - x,
    two neighbouring digits of the degrees or minutes swapped. Each mistake but the last predicts a reading.
    `read_rad` must agree with this prediction within `tolerance_rad` and within a third of the deviation from
    the target. A reading within `tolerance_rad` of the target is no mistake.
    """
    difference = wrapped_rad(read_rad - target_rad)
    if abs(difference) <= tolerance_rad:
        return None
    candidates = [
        (abs(abs(difference) - math.radians(degrees)), message(f"{words} ({size})"))
        for size, degrees, words in SLIPS
    ]
    candidates.append((abs(wrapped_rad(read_rad + target_rad)), message("360° - x was read instead of x")))
    miss, words = min(candidates, key=lambda candidate: candidate[0])
    # an error of 31″ is also within 30″ of a whole minute, yet is no misread minute line
    if miss <= min(tolerance_rad, abs(difference) / 3):
        return words
    return message("two digits are swapped") if _digits_swapped(read_rad, target_rad) else None


def _digits_swapped(read_rad: float, target_rad: float) -> bool:
    """Return whether two neighbouring digits of the degrees, or of the minutes, are swapped and all else agrees."""
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
        raise ValueError(message("That was not a temperature: type one such as 23.5."))
    return _value(match)


def typed_bubble(text: str, division_rad: float, most_divisions: float) -> float:
    """Return the offset of a bubble, rad, typed in divisions (`-1.5`) or in arcseconds (`3 arcsec`).

    Raises `ValueError` if the text is not a number or is off the vial's scale of ± `most_divisions`.
    """
    typed = _plain(text).lower()
    match = _DIVISIONS.fullmatch(typed.removesuffix("divisions").strip())
    if match is None:
        raise ValueError(message("That was not a number of divisions: type one such as -1.5."))
    read_rad = _value(match) * (_ARCSEC if match[2] else division_rad)
    if abs(read_rad) > (most_divisions + 1e-9) * division_rad:
        raise ValueError(
            message(
                f"{typed} is off the vial's scale of ±{most_divisions:g} divisions: level the platform, or "
                f"read again."
            )
        )
    return read_rad


def typed_supply(text: str, unit: SupplyUnit) -> float:
    """Return a typed voltage or current (`15.0`, `15.0 V`). Raises `ValueError`, with an example in `unit`."""
    match = _SUPPLY.fullmatch(_plain(text))
    if match is None:
        raise ValueError(message(f"That was not a number: type one such as 15.0 {unit}."))
    return _value(match)


def _plain(text: str) -> str:
    return text.strip().replace("−", "-")


def _value(match: re.Match[str]) -> float:
    return float(match[1].replace(",", "."))
