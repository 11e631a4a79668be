"""The front panel of a power supply that a person works: what is set, switched and read there."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.interfaces import ReadSupply, SetSupply, SwitchSupply
    from sim.world.world import World


def work_supply(world: World, action: SetSupply | SwitchSupply | ReadSupply) -> str:
    """Do what is asked at the supply; return what its display shows where that is asked, else nothing."""
    power, now_s = world.power, world.clock.now_s()
    if action["do"] == "set_supply":
        for output, (voltage_v, limit_a, over_voltage_v) in action["outputs"].items():
            power.change(output, now_s, set_v=voltage_v, limit_a=limit_a, trip_v=over_voltage_v)
        return ""
    output = action["output"]
    if action["do"] == "switch_supply":
        power.change(output, now_s, on=action["on"], tripped=None)
        return ""
    stage, shown = power.stage(output, now_s), power.shown(output, now_s)
    return {
        "switch": "on" if stage.on else "off",
        "set_voltage": f"{stage.set_v:.3f}",
        "current_limit": f"{stage.limit_a:.4f}",
        "voltage": f"{shown.voltage_v:.2f}",
        "current": f"{shown.current_a:.3f}",
    }[action["what"]]
