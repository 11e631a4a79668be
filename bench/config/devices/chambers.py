"""Thermal chambers (Espec, Thermotron, Watlow F4T) and power supplies (Aim-TTi, Keysight E36300 and E3631A)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from bench.base.units import TemperatureC
from bench.config.devices.device import (
    Device,
    IdentityPattern,
    PortSection,
    as_stated,
    resource_on,
    serial_or_socket,
)
from bench.config.devices.sections import (
    OF_THE_AIR,
    OF_THE_UNIT,
    ChamberTruth,
    ControlledChamberForm,
    SerialSection,
    WiredSupplyForm,
)
from drivers.facts import aim_tti as aim
from drivers.facts import espec, keysight_e3631a, thermotron
from drivers.facts import keysight_e36300 as keysight
from drivers.facts import watlow_f4t as f4t


class EspecSection(ControlledChamberForm):
    """A chamber with an Espec P300 or SCP-220; the controller's name must match the pattern `identity`."""

    facts: ClassVar = espec
    for_driver: ClassVar = ("identity",)

    driver: Literal["espec"]
    resource: Annotated[str, serial_or_socket("ttyUSB1", "192.0.2.50::10001")]
    identity: IdentityPattern = espec.IDENTITY
    serial: PortSection = PortSection.of(espec)

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return the simulation's options: limits (°C), sensor noise (K), name (if `identity` is a name)."""
        named = {"name": self.identity} if as_stated(self.identity) else {}
        return super().simulation_options(truth) | named | {"noise_c": truth.sensor_noise}


class ThermotronSection(ControlledChamberForm):
    """A Thermotron chamber that works in °C; the reply to IDEN? must contain the pattern `identity`."""

    facts: ClassVar = thermotron
    for_driver: ClassVar = ("identity",)

    driver: Literal["thermotron"]
    resource: Annotated[str, serial_or_socket("ttyUSB1", "192.0.2.52::8888")]
    identity: IdentityPattern = thermotron.IDENTITY
    serial: PortSection = PortSection.of(thermotron)

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return the simulation's options: temperature limits (°C), name (if `identity` is a name)."""
        named = {"identity": self.identity} if as_stated(self.identity) else {}
        return super().simulation_options(truth) | named


class WatlowF4TSection(ControlledChamberForm):
    """A chamber with a Watlow F4T controller.

    `output` is the number of the output that switches conditioning on. Without `output`, a run ends by setting the
    chamber to the temperature `safe`.
    """

    facts: ClassVar = f4t
    for_driver: ClassVar = ("loop", "output", "identity", ("safe_c", "safe"))

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

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return the simulation's options: temperature limits, °C, loop and output."""
        return super().simulation_options(truth) | {"loop": self.loop, "output": self.output or 1}


class AimTtiSection(WiredSupplyForm):
    """A PL303QMD-P, CPX200DP or CPX400DP with isolated outputs 1 and 2; a CPX has over-voltage protection.

    The serial port is its RS-232 port, or the one that the computer shows for its USB connection.
    """

    facts: ClassVar = aim
    for_driver: ClassVar = ("model",)
    for_simulation: ClassVar = ("model",)

    driver: Literal["aim-tti"]
    model: Literal["PL303QMD-P", "CPX200DP", "CPX400DP"]
    serial: PortSection = PortSection.of(aim)


class KeysightE36300Section(WiredSupplyForm):
    """A Keysight E36311A to E36313A: outputs 1, 2, 3, each with a switch and over-voltage protection."""

    facts: ClassVar = keysight
    for_driver: ClassVar = ("model",)
    for_simulation: ClassVar = ("model",)

    driver: Literal["keysight-e36300"]
    model: Literal["E36311A", "E36312A", "E36313A"]


class KeysightE3631ASection(WiredSupplyForm):
    """A Keysight E3631A with the outputs P6V, P25V and N25V (negative), which switch together.

    It has no over-voltage protection. `interface` is the interface selected at its front panel; over "rs232" the
    driver first puts the supply into remote mode.
    """

    facts: ClassVar = keysight_e3631a
    for_driver: ClassVar = ("interface",)
    for_simulation: ClassVar = ("interface",)

    driver: Literal["keysight-e3631a"]
    interface: Literal["gpib", "rs232"] = "gpib"
    serial: SerialSection = SerialSection()


DEVICE = (
    Device(
        "espec",
        EspecSection,
        driver="drivers.instruments.espec:EspecChamber",
        simulation="sim.chambers:EspecP300",
        example={
            "resource": "TCPIP0::192.0.2.50::10001::SOCKET",
            "minimum": "-40 degC",
            "maximum": "85 degC",
        },
        simulated=(*OF_THE_AIR, "sensor_noise"),
        place=1,
    ),
    Device(
        "thermotron",
        ThermotronSection,
        driver="drivers.instruments.thermotron:ThermotronChamber",
        simulation="sim.chambers:Thermotron8800",
        example={"resource": "TCPIP0::192.0.2.52::8888::SOCKET", "minimum": "-40 degC", "maximum": "85 degC"},
        simulated=OF_THE_AIR,
        place=3,
    ),
    Device(
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
    ),
    Device(
        "aim-tti",
        AimTtiSection,
        driver="drivers.instruments.aim_tti:AimTti",
        simulation="sim.aim_tti:AimTti",
        example={"model": "CPX400DP", "resource": "TCPIP0::192.0.2.71::9221::SOCKET"},
        simulated=OF_THE_UNIT,
        place=3,
    ),
    Device(
        "keysight-e36300",
        KeysightE36300Section,
        driver="drivers.instruments.keysight_e36300:KeysightE36300",
        simulation="sim.supply:KeysightE36300",
        example={"model": "E36312A", "resource": "TCPIP0::192.0.2.70::5025::SOCKET"},
        simulated=OF_THE_UNIT,
        place=2,
    ),
    Device(
        "keysight-e3631a",
        KeysightE3631ASection,
        driver="drivers.instruments.keysight_e3631a:KeysightE3631A",
        simulation="sim.supply:KeysightE3631A",
        example={"resource": "GPIB0::5::INSTR", "interface": "gpib"},
        simulated=OF_THE_UNIT,
        place=1,
    ),
)
