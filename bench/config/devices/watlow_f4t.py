"""A chamber with a Watlow F4T."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from bench.base.units import TemperatureC
from bench.config.devices.device import Device, IdentityPattern, resource_on
from bench.config.devices.sections import OF_THE_AIR, ChamberTruth, ControlledChamberForm
from drivers.facts import watlow_f4t as f4t


class WatlowF4TSection(ControlledChamberForm):
    """A chamber with a Watlow F4T.

    `output` is the output that switches conditioning on; where it is left out, the chamber is set to `safe`
    after a run.
    """

    facts: ClassVar = f4t

    driver: Literal["watlow-f4t"]
    resource: Annotated[str, resource_on("TCPIP", example="'TCPIP0::192.0.2.51::5025::SOCKET'")]
    identity: IdentityPattern = f4t.IDENTITY
    loop: Annotated[int, Field(ge=1, le=f4t.MOST_LOOPS)] = 1
    output: Annotated[int, Field(ge=1, le=f4t.MOST_OUTPUTS)] | None = None
    safe: TemperatureC = f4t.SAFE_C

    @model_validator(mode="after")
    def _can_be_safe(self) -> WatlowF4TSection:
        if self.output is None:
            self.refuse_outside(self.safe, "the safe setting")
        return self

    def driver_options(self) -> dict[str, Any]:
        """Return loop and output, what is safe, and the pattern of its identity."""
        return {"loop": self.loop, "output": self.output, "safe_c": self.safe, "identity": self.identity}

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return its limits, loop and output."""
        return super().simulation_options(truth) | {"loop": self.loop, "output": self.output or 1}


DEVICE = Device(
    "watlow-f4t",
    WatlowF4TSection,
    driver="drivers.instruments.watlow_f4t:WatlowF4TChamber",
    simulation="sim.chambers:WatlowF4T",
    example={
        "resource": "TCPIP0::192.0.2.51::5025::SOCKET",
        "minimum": "-40 degC",
        "maximum": "85 degC",
        "output": "1",
    },
    simulated=OF_THE_AIR,
    place=2,
)
