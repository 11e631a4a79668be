"""Checks of the level and of the thermometer at the block: each is read; nothing is set."""

from __future__ import annotations

from functools import partial
from typing import Final

from bench.base.arrays import ARCSEC
from bench.commission.evening import Evening
from bench.commission.finding import Figure, Finding, State
from drivers.interfaces import Inclination, Level, Thermometer

REVERSED: Final = "half a turn"
BLOCK: Final = "temperature of the block"


def check_level(evening: Evening) -> None:
    """Read the level in two positions half a turn apart: its zero, and how the platform stands."""
    level = evening.instruments.level
    if level is not None:
        head = evening.instruments.head
        evening.carry_out(REVERSED, level, partial(_reversed, evening, level), also=[head])


def _reversed(evening: Evening, level: Level) -> Finding:
    if not evening.section(evening.instruments.head.name).by_hand:
        evening.confirm("The head will turn to 0°. Is the way clear?", action={"do": "stand_clear"})
    evening.instruments.head.move(0.0, 1, "commission/level")
    first = _read(evening, level, turned=False)
    second = _read(evening, level, turned=True)
    pairs = (("along", first.along_rad, second.along_rad), ("across", first.across_rad, second.across_rad))
    u = level.sizes.reading_rad / ARCSEC
    figures = [Figure(f"its zero {axis}", (a + b) / 2.0 / ARCSEC, "arcsec") for axis, a, b in pairs]
    figures += [
        Figure(f"the platform {axis}", (a - b) / 2.0 / ARCSEC, "arcsec", f"a reading has u of {u:.2g} arcsec")
        for axis, a, b in pairs
    ]
    said = "was read in both positions: its own zero drops out of half the difference"
    return Finding(REVERSED, level.name, State.WORKS, said, tuple(figures))


def _read(evening: Evening, level: Level, *, turned: bool) -> Inclination:
    if not level.asks_person:
        how = "half a turn from its first position" if turned else "in its first position, along the shaft"
        evening.confirm(
            f"Put the level on the platform {how}. Does it lie there?",
            default="yes",
            action={"do": "place_level", "turned": turned},
        )
    return level.inclination(f"commission/level{int(turned)}", turned=turned)


def check_thermometer(evening: Evening) -> None:
    """Read the thermometer at the block."""
    thermometer = evening.instruments.thermometer
    if thermometer is not None:
        evening.carry_out(BLOCK, thermometer, partial(_temperature, thermometer))


def _temperature(thermometer: Thermometer) -> Finding:
    shown_c = thermometer.block_c("commission/temperature")
    figures = (Figure("temperature", shown_c, "°C"),)
    return Finding(BLOCK, thermometer.name, State.WORKS, f"shows it ({thermometer.sensor})", figures)
