"""Checks of the power supply: limits by refused settings alone, what its outputs are; nothing is switched."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

from bench.commission.evening import Evening
from bench.commission.finding import Figure, Finding, State
from bench.commission.heads import LIMITS, refuse_or_say
from bench.devices.supplies import SupplyForm
from drivers.interfaces import OutputSettings, PowerSupply, SupplyLimits

OUTPUTS: Final = "outputs"
BEYOND_V: Final = 1.0
"""By so much the settings that must be refused lie beyond the limits."""


def check_limits(evening: Evening) -> None:
    """Demand what lies beyond the limits of each output while no wire is open."""
    supply = evening.instruments.power_supply
    if supply is None:
        return
    form = evening.section(supply.name)
    if isinstance(form, SupplyForm) and form.limits is not None:
        evening.carry_out(LIMITS, supply, partial(_refused_beyond, supply, form.limits), opened=False)


def _refused_beyond(supply: PowerSupply, limits: SupplyLimits) -> Finding:
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
        evening.carry_out(OUTPUTS, supply, partial(_read, supply))


def _read(supply: PowerSupply) -> Finding:
    states = supply.state("commission/outputs")
    if not states:
        return Finding(OUTPUTS, supply.name, State.WORKS, "is read by hand once it was set up")
    said = ", ".join(
        f"{output} {'on' if state.on else 'off'}, set to {state.settings}" for output, state in states.items()
    )
    figures = tuple(Figure(f"output {output}", state.voltage_v, "V") for output, state in states.items())
    return Finding(OUTPUTS, supply.name, State.WORKS, f"shows its outputs: {said}", figures)
