"""Quantities on the command line: with a unit, or as a plain number in the unit that the help names."""

from __future__ import annotations

from bench.base.numbers import read_number
from bench.base.units import QuantityKind, parse_quantity
from bench.services.errors import Refused


def quantity(option: str, text: str, kind: QuantityKind, *, plain: bool = True) -> float:
    """Return the SI value of an option; a `plain` number is in the SI unit already.

    Raises `Refused` with the option for anything else.
    """
    if plain:
        try:
            return read_number(text)
        except ValueError:
            pass
    try:
        return parse_quantity(text, kind)
    except ValueError as error:
        raise Refused(f"{option} {text}: {error}") from None


def named(option: str, text: str, example: str) -> tuple[str, str]:
    """Return name and value of an option "NAME=VALUE". Raises `Refused` with an example for another."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip() or not value.strip():
        raise Refused(f"{option} {text}: a name and its value, such as {example}")
    return name.strip(), value.strip()
