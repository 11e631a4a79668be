"""Checks of the chamber, the level, the thermometer and the power supply."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

from bench.base.arrays import ARCSEC
from bench.config.devices.sections import ChamberForm, SupplyForm
from bench.run.commission.heads import LIMITS, refuse_or_say
from bench.run.commission.session import Evening, Figure, Finding, State
from drivers.interfaces.instruments import Inclination, Level, ThermalChamber, Thermometer
from drivers.interfaces.supply import OutputSettings, PowerSupply, SupplyLimits

READ: Final = "temperature"
STANDBY: Final = "standby"
BEYOND_K: Final = 1.0
"""By so much the demands that must be refused lie beyond the limits."""


def check_chamber_limits(evening: Evening) -> None:
    """Demand what lies beyond the chamber's limits while no wire is open."""
    chamber = evening.instruments.chamber
    if chamber is None:
        return
    form = evening.section(chamber.name)
    if isinstance(form, ChamberForm):
        evening.carry_out(LIMITS, chamber, partial(_temperature_refused_beyond, chamber, form), opened=False)


def _temperature_refused_beyond(chamber: ThermalChamber, form: ChamberForm) -> Finding:
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
    evening.carry_out(READ, chamber, partial(_read_temperature, chamber, by_hand))
    evening.carry_out(STANDBY, chamber, partial(_standby, evening, chamber, by_hand))


def _read_temperature(chamber: ThermalChamber, by_hand: bool) -> Finding:
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
    first = _read_platform(evening, level, turned=False)
    second = _read_platform(evening, level, turned=True)
    pairs = (("along", first.along_rad, second.along_rad), ("across", first.across_rad, second.across_rad))
    u = level.sizes.reading_rad / ARCSEC
    figures = [Figure(f"its zero {axis}", (a + b) / 2.0 / ARCSEC, "arcsec") for axis, a, b in pairs]
    figures += [
        Figure(f"the platform {axis}", (a - b) / 2.0 / ARCSEC, "arcsec", f"a reading has u of {u:.2g} arcsec")
        for axis, a, b in pairs
    ]
    said = "was read in both positions: its own zero drops out of half the difference"
    return Finding(REVERSED, level.name, State.WORKS, said, tuple(figures))


def _read_platform(evening: Evening, level: Level, *, turned: bool) -> Inclination:
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


OUTPUTS: Final = "outputs"
BEYOND_V: Final = 1.0
"""By so much the settings that must be refused lie beyond the limits."""


def check_supply_limits(evening: Evening) -> None:
    """Demand what lies beyond the limits of each output while no wire is open."""
    supply = evening.instruments.power_supply
    if supply is None:
        return
    form = evening.section(supply.name)
    if isinstance(form, SupplyForm) and form.limits is not None:
        evening.carry_out(LIMITS, supply, partial(_voltage_refused_beyond, supply, form.limits), opened=False)


def _voltage_refused_beyond(supply: PowerSupply, limits: SupplyLimits) -> Finding:
    for output, limit in limits.outputs.items():
        far_v = max(limit.voltage_v, key=abs)
        settings = OutputSettings(far_v + math.copysign(BEYOND_V, far_v), limit.current_a[0])
        refuse_or_say(
            supply.name,
            f"{settings.voltage_v:g} V on output {output}",
            partial(supply.set_up, {output: settings}, "commission/limits"),
        )
    said = f"what leads beyond the limits of {', '.join(limits.outputs)} is refused before it is sent"
    return Finding(LIMITS, supply.name, State.WORKS, said)


def check_outputs(evening: Evening) -> None:
    """Read how every output is."""
    supply = evening.instruments.power_supply
    if supply is not None:
        evening.carry_out(OUTPUTS, supply, partial(_read_outputs, supply))


def _read_outputs(supply: PowerSupply) -> Finding:
    states = supply.state("commission/outputs")
    if not states:
        return Finding(OUTPUTS, supply.name, State.WORKS, "is read by hand once it was set up")
    said = ", ".join(
        f"{output} {'on' if state.on else 'off'}, set to {state.settings}" for output, state in states.items()
    )
    figures = tuple(Figure(f"output {output}", state.voltage_v, "V") for output, state in states.items())
    return Finding(OUTPUTS, supply.name, State.WORKS, f"shows its outputs: {said}", figures)
