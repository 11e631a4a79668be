"""Motorised heads, encoders of heads that a person turns, and a level on the platform.

Heads: ACUTROL, Newport ESP301, Zaber. Encoders: Heidenhain ND 28x, MUX-10, a line of text. Level: Leica Nivel.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from bench.base.arrays import ARCSEC
from bench.base.units import DurationS
from bench.config.devices.device import (
    Device,
    IdentityPattern,
    LineForm,
    PortSection,
    Printable,
    WiredForm,
    any_resource,
    as_stated,
    resource_on,
    serial_or_socket,
)
from bench.config.devices.sections import HeadTruth, LevelForm, MotorisedHeadForm, ReadOutHeadForm, SpeedRadS
from drivers.facts import acutrol, mitutoyo_mux10, text_line, zaber
from drivers.facts import heidenhain_nd28x as nd
from drivers.facts import leica_nivel as nivel
from drivers.facts import newport_esp301 as newport


class AcutrolSection(MotorisedHeadForm):
    """One axis of a rate table with an ACUTROL controller; below `still_rate` the axis counts as stationary."""

    facts: ClassVar = acutrol
    scale_on_axis: ClassVar[bool] = True
    for_driver: ClassVar = ("axis", ("still_rad_s", "still_rate"))
    for_simulation: ClassVar = ("axis",)

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
                f"the controller rounds a demand by up to {acutrol.FINEST_DEMAND_DEG:g}° "
                f"({finest_rad / ARCSEC:.1f} arcsec), which is more than this tolerance; widen the tolerance"
            )
        return tolerance_rad


_TURN: Final = {"minimum": "-5 deg", "maximum": "365 deg", "tolerance": "5 arcsec", "speed": "10 deg/s"}
"""Keys of the examples of motorised heads."""


_BEYOND_DEG: Final = 5.0
"""Travel of a simulated stage beyond the limits in the bench file, degrees."""


def _on_a_wire_it_has(resource: str) -> str:
    if not resource.startswith(("ASRL", "GPIB", "TCPIP")):
        raise ValueError(
            "expected a VISA resource such as 'ASRL/dev/ttyUSB0::INSTR', 'GPIB0::1::INSTR' or, behind a serial "
            f"gateway, 'TCPIP0::192.0.2.41::4001::SOCKET', got '{resource}'"
        )
    return any_resource(resource)


class NewportSection(MotorisedHeadForm):
    """A rotary stage on one axis of a Newport ESP301, configured in degrees, with 0° at its home position.

    The serial port is the controller's RS-232 port, or the one that the computer shows for its USB connection.
    Homing turns the stage to its sensor and ignores all limits; it therefore requires `allow_homing`.
    """

    facts: ClassVar = newport
    for_driver: ClassVar = ("axis", "identity", "allow_homing")
    for_simulation: ClassVar = ("axis",)

    driver: Literal["newport-esp301"]
    resource: Annotated[str, AfterValidator(_on_a_wire_it_has)]
    axis: Annotated[int, Field(ge=1, le=newport.MOST_AXES)] = 1
    identity: IdentityPattern = newport.IDENTITY
    allow_homing: bool = False
    serial: PortSection = PortSection.of(newport)

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the simulation's options: speed, axis, travel, homed state, name (if `identity` is a name)."""
        named = {"model": self.identity} if as_stated(self.identity) else {}
        return {
            **super().simulation_options(truth),
            "lowest_deg": math.degrees(self.minimum) - _BEYOND_DEG,
            "highest_deg": math.degrees(self.maximum) + _BEYOND_DEG,
            "homed": truth.homed,
            **named,
        }


class ZaberSection(MotorisedHeadForm):
    """A rotary stage with a Zaber controller.

    `steps_per_degree` is the number of microsteps at the setting `resolution`; it is negative if the angle falls as
    the step count rises. Homing turns the stage to its sensor and ignores all limits; it therefore requires
    `allow_homing`.
    """

    facts: ClassVar = zaber
    for_simulation: ClassVar = ("steps_per_degree", "resolution", "device", "axis")
    for_driver: ClassVar = (*for_simulation, "identity", "allow_homing", "checksums")

    driver: Literal["zaber"]
    resource: Annotated[str, serial_or_socket("ttyUSB0", "192.0.2.30::55550")]
    steps_per_degree: float
    resolution: Annotated[int, Field(ge=1, le=256)] = zaber.RESOLUTION
    device: Annotated[int, Field(ge=1, le=zaber.MOST_DEVICES)] = 1
    axis: Annotated[int, Field(ge=1, le=zaber.MOST_AXES)] = 1
    identity: IdentityPattern = zaber.IDENTITY
    allow_homing: bool = False
    checksums: bool = False
    serial: PortSection = PortSection.of(zaber)

    @model_validator(mode="after")
    def _steps_fit(self) -> ZaberSection:
        steps_per_degree = abs(self.steps_per_degree)
        if steps_per_degree == 0.0:
            raise ValueError("'steps_per_degree' is 0; state the number from the stage's data sheet")
        farthest_rad = max(abs(self.minimum), abs(self.maximum))
        if math.degrees(farthest_rad) * steps_per_degree > zaber.MOST_STEPS:
            raise ValueError("the limits of the head exceed the controller's range of steps; narrow them")
        half_deg = 0.5 / steps_per_degree
        if half_deg > math.degrees(self.tolerance):
            raise ValueError(
                "a step of the head is coarser than its tolerance; state a tolerance of at least "
                f"{math.ceil(half_deg * 3600.0)} arcsec"
            )
        return self

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the simulation's options: address, step scale, speed, travel, homed state, encoder, device."""
        named = {"device_id": int(self.identity)} if self.identity.isdecimal() else {}
        return {
            **super().simulation_options(truth),
            "lowest_deg": math.degrees(self.minimum) - _BEYOND_DEG,
            "highest_deg": math.degrees(self.maximum) + _BEYOND_DEG,
            "homed": truth.homed,
            "encoder": truth.encoder,
            **named,
        }


Axis = Literal["+X", "-X", "+Y", "-Y"]


class LeicaNivelSection(LevelForm, WiredForm):
    """A Leica Nivel210 (RS-232) or Nivel220 (RS-485), at a serial port or behind a terminal server.

    `sensor` is the address of the sensor without the N. The level is read in two positions half a turn apart.
    In the first position, its axis `along` points along the shaft, away from an observer who faces the end of
    the shaft. Its axis `across` points to the observer's right.
    """

    facts: ClassVar = nivel
    for_driver: ClassVar = ("sensor", "along", "across", "averages")
    for_simulation: ClassVar = ("sensor", "along", "across")

    driver: Literal["leica-nivel"]
    resource: Annotated[str, serial_or_socket("ttyUSB0", "192.0.2.50::4001")]
    timeout: DurationS = 5.0
    sensor: Annotated[str, Field(pattern=r"^[1-9A-Z]$")] = "1"
    along: Axis = "+Y"
    across: Axis = "+X"
    averages: Annotated[int, Field(ge=1, le=nivel.MOST_AVERAGES)] = nivel.AVERAGES
    serial: PortSection = PortSection.of(nivel)

    @model_validator(mode="after")
    def _two_axes(self) -> LeicaNivelSection:
        if self.along[1] == self.across[1]:
            raise ValueError(f"along and across are both axis {self.along[1]}; change one of them")
        return self


Wire = Annotated[str, serial_or_socket("ttyUSB0", "192.0.2.60::4001")]


class HeidenhainNd28xSection(ReadOutHeadForm):
    """A Heidenhain ND 281B or ND 287 that shows decimal degrees; 7 data bits, even parity, 2 stop bits."""

    facts: ClassVar = nd
    for_driver: ClassVar = ("model",)
    for_simulation: ClassVar = ("model",)

    driver: Literal["heidenhain-nd28x"]
    resource: Wire
    model: Literal["ND-281B", "ND-287"] = "ND-281B"
    serial: PortSection = PortSection.of(nd)


class MitutoyoMux10Section(ReadOutHeadForm):
    """A counter that shows degrees and sends its readings in the form of a Mitutoyo MUX-10."""

    facts: ClassVar = mitutoyo_mux10
    for_driver: ClassVar = ("channel",)
    for_simulation: ClassVar = ("channel",)

    driver: Literal["mitutoyo-mux10"]
    resource: Wire
    channel: Annotated[int, Field(ge=1, le=mitutoyo_mux10.MOST_CHANNELS)] = 1
    serial: PortSection = PortSection.of(mitutoyo_mux10)


class EncoderLineSection(ReadOutHeadForm, LineForm):
    """A counter that answers `request` with one line of text, which holds the angle in the `unit`.

    `counts_per_turn` is required for the unit "counts", and refused for any other unit.
    """

    facts: ClassVar = text_line
    group: ClassVar = text_line.ANGLE
    for_driver: ClassVar = (*LineForm.for_driver, "per_turn")

    driver: Literal["encoder-line"]
    resource: Wire
    model: Printable = "encoder"
    unit: Literal["degrees", "arcsec", "counts"] = "degrees"
    counts_per_turn: Annotated[float, Field(gt=0.0)] | None = None

    @model_validator(mode="after")
    def _has_counts(self) -> EncoderLineSection:
        if self.unit == "counts" and self.counts_per_turn is None:
            raise ValueError("the unit 'counts' has no 'counts_per_turn'; add it")
        if self.unit != "counts" and self.counts_per_turn is not None:
            raise ValueError(f"the unit '{self.unit}' takes no 'counts_per_turn'; remove it")
        return self

    @property
    def per_turn(self) -> float:
        """The number of units in a turn."""
        return self.counts_per_turn or text_line.PER_TURN[self.unit]

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the options common to all simulated counters, and the request and form of the reply."""
        return super().simulation_options(truth) | self.line_options() | {"per_turn": self.per_turn}


_OWN: Final = {"tolerance": "30 arcsec"}


DEVICE = (
    Device(
        "acutrol",
        AcutrolSection,
        driver="drivers.instruments.acutrol:AcutrolHead",
        simulation="sim.acutrol:AcutrolTable",
        example={"resource": "TCPIP0::192.0.2.40::9888::SOCKET", **_TURN},
        place=2,
    ),
    Device(
        "newport-esp301",
        NewportSection,
        driver="drivers.instruments.newport_esp301:NewportHead",
        simulation="sim.newport_esp301:Esp301",
        example={"resource": "ASRL/dev/ttyUSB0::INSTR", **_TURN},
        simulated=("homed",),
    ),
    Device(
        "zaber",
        ZaberSection,
        driver="drivers.instruments.zaber:ZaberHead",
        simulation="sim.zaber:ZaberStage",
        example={
            "resource": "TCPIP0::192.0.2.30::55550::SOCKET",
            "steps_per_degree": "4266.6667",
            **_TURN,
        },
        simulated=("homed", "encoder"),
        place=1,
    ),
    Device(
        "leica-nivel",
        LeicaNivelSection,
        driver="drivers.instruments.leica_nivel:LeicaNivel",
        simulation="sim.leica_nivel:LeicaNivel",
        example={"resource": "ASRL/dev/ttyUSB1::INSTR"},
        simulated=("zero_along", "zero_across", "noise", "scale"),
        place=1,
    ),
    Device(
        "heidenhain-nd28x",
        HeidenhainNd28xSection,
        driver="drivers.instruments.heidenhain_nd28x:HeidenhainNd28x",
        simulation="sim.counters:HeidenhainNd28x",
        example={"resource": "ASRL/dev/ttyUSB0::INSTR", "model": "ND-287", **_OWN},
        simulated=("homed",),
        place=3,
    ),
    Device(
        "mitutoyo-mux10",
        MitutoyoMux10Section,
        driver="drivers.instruments.mitutoyo_mux10:MitutoyoMux10",
        simulation="sim.counters:MitutoyoMux10",
        example={"resource": "ASRL/dev/ttyUSB0::INSTR", **_OWN},
        simulated=("homed",),
        place=4,
    ),
    Device(
        "encoder-line",
        EncoderLineSection,
        driver="drivers.instruments.text_line:EncoderLine",
        simulation="sim.counters:EncoderLine",
        example={
            "resource": "ASRL/dev/ttyUSB0::INSTR",
            "request": "POS?",
            "pattern": r"POS=(?P<angle>[+-]\d{3}\.\d{5})",
            "example": "POS=+045.00278",
            "errors": {"ERR SIGNAL": "the encoder's signal is too small"},
            **_OWN,
        },
        simulated=("homed",),
        place=5,
    ),
)
