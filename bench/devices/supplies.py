"""The form of the power supplies of a bench file: one that a person works, or one with a wire."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final

from pydantic import AfterValidator, Field, field_validator

from bench.base.forms import FileModel
from bench.base.units import QuantityKind, Ratio, SizeA, SpanS, VoltageV, reads
from bench.devices.device import DeviceSection, Role
from bench.devices.wires import WiredForm, any_resource
from drivers.interfaces import SupplyLimits

SUPPLY_FACTS: Final = ("OUTPUTS", "SWITCHED_TOGETHER")
"""What the facts of a power supply must say (see those of an E3631A); with a serial port `BAUD_RATES`, too."""

OF_CURRENT: Final = QuantityKind("a rate of a current", "0.2 percent/K", "1/K")


class SupplyTruth(FileModel):
    """What the simulated unit takes from its supply, and how it is without.

    Each rail takes `current` at 23 degC (where it is left out the middle of its window), more by
    `current_by_temperature` for each kelvin, and `in_rush` times as much at switching on, dying away with the time
    constant `in_rush_time`. Below the part `brown_out` of a rail's voltage it works no more; `dead_offset` and
    `dead_noise` are the standard deviations, over channels and over readings, of what its signals then show.
    """

    current: SizeA | None = None
    current_by_temperature: Annotated[float, reads(OF_CURRENT)] = 2e-3
    in_rush: Annotated[Ratio, Field(ge=1.0)] = 3.0
    in_rush_time: SpanS = 0.05
    brown_out: Annotated[Ratio, Field(gt=0.0, lt=1.0)] = 0.8
    dead_offset: VoltageV = 2e-3
    dead_noise: VoltageV = 5e-4

    @field_validator("in_rush_time")
    @classmethod
    def _takes_time(cls, in_rush_time_s: float) -> float:
        if in_rush_time_s == 0.0:
            raise ValueError("expected more than nothing: no capacitor is charged at once")
        return in_rush_time_s


OF_THE_UNIT: Final = tuple(SupplyTruth.model_fields)
"""What the simulated world does with the unit behind any supply."""


class SupplyForm(DeviceSection):
    """What every power supply is told: nothing but its name. What it is set to is the unit's to say."""

    role: ClassVar[Role] = "power_supply"

    certificate: ClassVar[None] = None
    """No reading hangs on what it shows."""

    name: str = "power_supply"

    @property
    def limits(self) -> SupplyLimits | None:
        """What it can do, None where nobody knows."""
        raise NotImplementedError


class WiredSupplyForm(SupplyForm, WiredForm):
    """A power supply with a wire; `interface` says how it is set, apart from the wire that carries its messages."""

    resource: Annotated[str, AfterValidator(any_resource)]

    @property
    def limits(self) -> SupplyLimits | None:
        """What it can do: what its facts say of its model."""
        return SupplyLimits.of(self.facts, getattr(self, "model", None))

    def driver_options(self) -> dict[str, Any]:
        """Return what it can do."""
        return {"limits": self.limits}

    def simulation_options(self, truth: SupplyTruth) -> dict[str, Any]:
        """Return the model, where there are several."""
        model = getattr(self, "model", None)
        return {} if model is None else {"model": model}
