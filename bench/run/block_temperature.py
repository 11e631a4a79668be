"""Who tells the temperature of the block: a thermometer there, else the chamber; a person at a mounting alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.run.workbench import Instruments


def told_at_mounting(instruments: Instruments, key: str) -> float | None:
    """Return what a person tells, °C; None where nobody is asked. Raises `BenchError`."""
    chamber, thermometer = instruments.chamber, instruments.thermometer
    if thermometer is not None:
        return thermometer.block_c(key) if thermometer.asks_person else None
    return chamber.temperature(key) if chamber is not None and chamber.asks_person else None


def told_at_reading(
    instruments: Instruments, known_c: float | None, key: str
) -> tuple[float | None, float | None]:
    """Return the temperature of the block and, beside a thermometer of its own, the air of the chamber, °C.

    A person is asked once after each mounting and each new temperature: after that it is `known_c`.
    Raises `BenchError`.
    """
    chamber, thermometer = instruments.chamber, instruments.thermometer
    by_controller = chamber is not None and not chamber.asks_person
    if thermometer is not None:
        air_c = chamber.temperature(key) if chamber is not None and by_controller else None
        asked = known_c is None or not thermometer.asks_person
        return thermometer.block_c(key) if asked else known_c, air_c
    if chamber is not None and (known_c is None or by_controller):
        return chamber.temperature(key), None
    return known_c, None
