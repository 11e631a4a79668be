"""The thermal chamber of a bench file: one that a person sets, or one with a controller."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import Field, field_validator, model_validator

from bench.base.forms import FileModel
from bench.base.units import QuantityKind, TemperatureC, not_negative
from bench.devices.wires import IdentityPattern, PortSection, WiredForm, driver_of, resource_on

DIFFERENCE: Final = QuantityKind("a difference of temperatures", "2 K", "K", only=("K", "mK"))

SizeK = Annotated[float, not_negative(DIFFERENCE)]


class TemperatureRange(FileModel):
    """Lowest and highest temperature, °C."""

    minimum: TemperatureC
    maximum: TemperatureC

    @model_validator(mode="after")
    def _in_order(self) -> TemperatureRange:
        if self.minimum >= self.maximum:
            raise ValueError(f"the minimum {self.minimum:g} °C is not below the maximum {self.maximum:g} °C")
        return self

    def refuse_outside(self, temperature_c: float, what: str) -> None:
        """Raise `ValueError` for a temperature outside."""
        if not self.minimum <= temperature_c <= self.maximum:
            raise ValueError(
                f"{what} of {temperature_c:g} °C is outside {self.minimum:g} to {self.maximum:g} °C"
            )


class ManualChamberSection(TemperatureRange):
    """A chamber that a person sets and reads. `safe` is what it is set to after a run, off where left out."""

    driver: Literal["manual-chamber"]
    name: str = "chamber"
    safe: TemperatureC | None = None

    @model_validator(mode="after")
    def _can_be_safe(self) -> ManualChamberSection:
        if self.safe is not None:
            self.refuse_outside(self.safe, "the safe setting")
        return self


class ControlledChamberForm(TemperatureRange, WiredForm):
    """A chamber with a controller; at a reading its air is within `band` of the demand, where one is stated."""

    name: str = "chamber"
    band: SizeK | None = None

    @field_validator("band")
    @classmethod
    def _has_width(cls, band_k: float | None) -> float | None:
        if band_k == 0.0:
            raise ValueError("the band is more than nothing: no air keeps its temperature exactly")
        return band_k


class EspecSection(ControlledChamberForm):
    """A chamber with an Espec P300 or SCP-220; `identity` is the pattern of the controller's name."""

    driver: Literal["espec"]
    resource: Annotated[
        str,
        resource_on(
            "ASRL", "TCPIP", example="'ASRL/dev/ttyUSB1::INSTR' or 'TCPIP0::192.0.2.50::10001::SOCKET'"
        ),
    ]
    identity: IdentityPattern = r"[EP]S?-?[123]\d\d|SCP-?220"
    serial: PortSection = PortSection(baud_rate=19200)


class WatlowF4TSection(ControlledChamberForm):
    """A chamber with a Watlow F4T.

    `output` is the output that switches conditioning on; where it is left out, the chamber is set to `safe`
    after a run.
    """

    driver: Literal["watlow-f4t"]
    resource: Annotated[str, resource_on("TCPIP", example="'TCPIP0::192.0.2.51::5025::SOCKET'")]
    identity: IdentityPattern = r"F4T"
    loop: Annotated[int, Field(ge=1, le=4)] = 1
    output: Annotated[int, Field(ge=1, le=99)] | None = None
    safe: TemperatureC = 23.0

    @model_validator(mode="after")
    def _can_be_safe(self) -> WatlowF4TSection:
        if self.output is None:
            self.refuse_outside(self.safe, "the safe setting")
        return self


class ThermotronSection(ControlledChamberForm):
    """A chamber with a Thermotron controller, set to °C; `identity` is the pattern of its name."""

    driver: Literal["thermotron"]
    resource: Annotated[
        str,
        resource_on(
            "ASRL", "TCPIP", example="'ASRL/dev/ttyUSB1::INSTR' or 'TCPIP0::192.0.2.52::8888::SOCKET'"
        ),
    ]
    identity: IdentityPattern = r"2800|3800|8200|8800"
    serial: PortSection = PortSection(baud_rate=9600)


ChamberSection = Annotated[
    Annotated[
        ManualChamberSection | EspecSection | WatlowF4TSection | ThermotronSection,
        Field(discriminator="driver"),
    ],
    driver_of(ManualChamberSection, EspecSection, WatlowF4TSection, ThermotronSection),
]
