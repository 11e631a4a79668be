"""A rate table with an ACUTROL controller."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator

from bench.base.arrays import ARCSEC
from bench.config.devices.device import Device, resource_on
from bench.config.devices.sections import HeadTruth, MotorisedHeadForm, SpeedRadS
from drivers.facts import acutrol


class AcutrolSection(MotorisedHeadForm):
    """One axis of a rate table with an ACUTROL controller; below `still_rate` it stands."""

    facts: ClassVar = acutrol
    scale_on_axis: ClassVar[bool] = True

    driver: Literal["acutrol"]
    resource: Annotated[str, resource_on("TCPIP", example="'TCPIP0::192.0.2.40::9888::SOCKET'")]
    axis: Annotated[int, Field(ge=1, le=9)] = 1
    still_rate: SpeedRadS = math.radians(acutrol.STILL_DEG_S)

    @field_validator("tolerance")
    @classmethod
    def _as_fine_as_a_demand(cls, tolerance_rad: float) -> float:
        finest_rad = math.radians(acutrol.FINEST_DEMAND_DEG)
        if tolerance_rad < finest_rad:
            raise ValueError(
                f"the tolerance is finer than the {acutrol.FINEST_DEMAND_DEG:.4f}° "
                f"({finest_rad / ARCSEC:.1f} arcsec) to which it takes demands"
            )
        return tolerance_rad

    def driver_options(self) -> dict[str, Any]:
        """Return the axis, and when it stands."""
        return {"axis": self.axis, "still_rad_s": self.still_rate}

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the axis and the speed."""
        return super().simulation_options(truth) | {"axis": self.axis}


DEVICE = Device(
    "acutrol",
    AcutrolSection,
    driver="drivers.instruments.acutrol:AcutrolHead",
    simulation="sim.acutrol:AcutrolTable",
    example={
        "resource": "TCPIP0::192.0.2.40::9888::SOCKET",
        "minimum": "-5 deg",
        "maximum": "365 deg",
        "tolerance": "5 arcsec",
        "speed": "10 deg/s",
    },
    place=2,
)
