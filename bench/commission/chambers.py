"""Checks of the chamber: limits by refused commands alone, its temperature, its way into standby."""

from __future__ import annotations

from functools import partial
from typing import Final

from bench.commission.evening import Evening
from bench.commission.finding import Figure, Finding, State
from bench.commission.heads import LIMITS, refuse_or_say
from bench.devices.chambers import ChamberForm
from drivers.interfaces import ThermalChamber

READ: Final = "temperature"
STANDBY: Final = "standby"
BEYOND_K: Final = 1.0
"""By so much the demands that must be refused lie beyond the limits."""


def check_limits(evening: Evening) -> None:
    """Demand what lies beyond the chamber's limits while no wire is open."""
    chamber = evening.instruments.chamber
    if chamber is None:
        return
    form = evening.section(chamber.name)
    if isinstance(form, ChamberForm):
        evening.carry_out(LIMITS, chamber, partial(_refused_beyond, chamber, form), opened=False)


def _refused_beyond(chamber: ThermalChamber, form: ChamberForm) -> Finding:
    for target_c in (form.minimum - BEYOND_K, form.maximum + BEYOND_K):
        refuse_or_say(
            chamber.name, f"{target_c:g} °C", partial(chamber.set_temperature, target_c, "commission/limits")
        )
    said = f"what leads beyond {form.minimum:g} to {form.maximum:g} °C is refused before it is sent"
    return Finding(LIMITS, chamber.name, State.WORKS, said)


def check_standby(evening: Evening) -> None:
    """Read the chamber and put it into standby."""
    chamber = evening.instruments.chamber
    if chamber is None:
        return
    by_hand = evening.section(chamber.name).by_hand
    evening.carry_out(READ, chamber, partial(_read, chamber, by_hand))
    evening.carry_out(STANDBY, chamber, partial(_standby, evening, chamber, by_hand))


def _read(chamber: ThermalChamber, by_hand: bool) -> Finding:
    air_c = chamber.temperature("commission/temperature", settling=True)
    said = "was read on its thermometer" if by_hand else "shows the temperature of its air"
    return Finding(READ, chamber.name, State.WORKS, said, (Figure("temperature", air_c, "°C"),))


def _standby(evening: Evening, chamber: ThermalChamber, by_hand: bool) -> Finding:
    if by_hand:
        evening.confirm(
            "Switch the chamber to standby. Does it stand by?", action={"do": "answer"}, default="yes"
        )
        return Finding(STANDBY, chamber.name, State.WORKS, "was put into standby by hand")
    evening.confirm("The chamber will stop conditioning and stand by. May it?", action={"do": "stand_clear"})
    to_do = chamber.make_safe()
    if to_do:
        return Finding(STANDBY, chamber.name, State.OTHER, "needs a hand to stand by", remedy=to_do)
    return Finding(STANDBY, chamber.name, State.WORKS, "stopped conditioning, and its driver read that back")
