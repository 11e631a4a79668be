"""Simulated climatic chambers around the block of the world: Espec P300, Thermotron 8800, Watlow F4T."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final, Literal

from drivers.facts.thermotron import BUSY_S, MANUAL, STOPPED
from drivers.facts.watlow_f4t import FAHRENHEIT_AT_0_C, FAHRENHEIT_PER_C
from sim.scpi import Command, ScpiInstrument
from sim.scpi_values import Boolean, Choice, Number, ScpiError
from sim.wires.session import PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.world.world import World

# --- Espec P300 -------------------------------------------------------------------------------------
# Source: Espec P300 communication manual as read in ChamberConnectLibrary (`especinteract.py`, `p300.py`).

_NUMBER: Final = r"[+-]?\d+(?:\.\d+)?"
_TEMP: Final = re.compile(rf"TEMP,((?: ?[SHL]{_NUMBER})+)\Z")
_MODE: Final = re.compile(r"MODE,(OFF|STANDBY|CONSTANT|RUN\d+)\Z")
_PROTECT: Final = re.compile(r"KEYPROTECT,(ON|OFF)\Z")


class EspecP300(PlainDialect):
    """An Espec P300 controller: at first in standby, with a set point of 23 °C.

    `name` is the controller's name in the reply to TYPE?. The set point is limited to `lowest_c` … `highest_c`, °C.
    `noise_c` is the standard deviation of the sensor's noise, °C. `alarms`, the numbers of the present alarms, may
    be set from outside.
    """

    def __init__(
        self,
        world: World,
        *,
        name: str = "P300",
        lowest_c: float = -50.0,
        highest_c: float = 140.0,
        noise_c: float = 0.0,
    ) -> None:
        self._world = world
        self._name = name
        self._noise_c = noise_c
        self._set = {"S": 23.0, "H": highest_c, "L": lowest_c}
        self._range = (lowest_c, highest_c)
        self._mode = "STANDBY"
        self.alarms: tuple[int, ...] = ()

    # --- called by the wire and the bench -----------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Answer one command; every command has exactly one reply."""
        command = message.decode("ascii", "replace").strip()
        return self._answer(re.sub(r"\s*,\s*", ",", command.upper())).encode("ascii")

    def power_cycle(self) -> None:
        """Switch off and on: the controller is then in standby, with its set point and limits unchanged."""
        self._change_mode("STANDBY")

    def _answer(self, command: str) -> str:
        queries: dict[str, Callable[[], str]] = {
            "TEMP?": self._temperatures,
            "MON?": lambda: f"{self._air_c():.1f},,{self._operation},{len(self.alarms)}",
            "MODE?": lambda: self._operation,
            "ALARM?": lambda: ",".join(str(number) for number in (len(self.alarms), *self.alarms)),
            "TYPE?": lambda: f"T,T,{self._name},{self._range[1]:.1f}",
            "ROM?": lambda: "P30012.03",
        }
        if command in queries:
            return queries[command]()
        if match := _TEMP.match(command):
            return self._demand(command, match[1])
        if match := _MODE.match(command):
            self._change_mode(match[1])
            return f"OK:{command}"
        if command in ("POWER,ON", "POWER,OFF"):
            self._change_mode("CONSTANT" if command.endswith("ON") else "OFF")
            return f"OK:{command}"
        if _PROTECT.match(command):
            return f"OK:{command}"
        return "NA:PARA ERR" if command.startswith(("TEMP,", "MODE,", "POWER,")) else "NA:CMD ERR"

    # --- state --------------------------------------------------------------------------------------

    @property
    def _operation(self) -> str:
        """The operating mode in replies: a program is shown without its number."""
        return "RUN" if self._mode.startswith("RUN") else self._mode

    def _air_c(self) -> float:
        if not self._noise_c:
            return self._world.chamber_c
        generator = self._world.random("chamber sensor", self._world.count("chamber sensor"))
        return self._world.chamber_c + float(generator.normal(0.0, self._noise_c))

    def _temperatures(self) -> str:
        return f"{self._air_c():.1f},{self._set['S']:.1f},{self._set['H']:.1f},{self._set['L']:.1f}"

    def _demand(self, command: str, text: str) -> str:
        """Change the set point and both limits together; refuse the whole command if one is out of range."""
        wanted = {
            **self._set,
            **{key: float(value) for key, value in re.findall(rf"([SHL])({_NUMBER})", text)},
        }
        lowest_c, highest_c = self._range
        if not lowest_c <= wanted["L"] <= wanted["S"] <= wanted["H"] <= highest_c:
            return "NA:DATA OUT OF RANGE"
        self._set = {key: round(value, 1) for key, value in wanted.items()}
        if self._mode == "CONSTANT":
            self._world.ramp_chamber(self._set["S"])
        return f"OK:{command}"

    def _change_mode(self, mode: str) -> None:
        self._mode = mode
        if mode == "CONSTANT":
            self._world.ramp_chamber(self._set["S"])
        elif mode in ("OFF", "STANDBY"):
            self._world.switch_chamber_off()


# --- Thermotron 8800 --------------------------------------------------------------------------------
# As on the real controller, messages within a second after a setting are lost.
# Source: Thermotron 8800 computer interface manual as read in public drivers.

THERMOTRON_IDENTITY: Final = "8800 V3.12"

_SET_POINT: Final = re.compile(r"SETP1,([+-]?\d+(?:\.\d+)?)\Z")


class Thermotron8800(PlainDialect):
    """A Thermotron 8800 controller, stopped after switch-on. A set point takes effect only at RUNM.

    `identity` is the reply to IDEN?.
    """

    def __init__(
        self,
        world: World,
        *,
        identity: str = THERMOTRON_IDENTITY,
        lowest_c: float = -70.0,
        highest_c: float = 180.0,
    ) -> None:
        self._world = world
        self._identity = identity
        self._range = (lowest_c, highest_c)
        self._set_point_c = 23.0
        self._mode = STOPPED
        self._wrote_s = -math.inf

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Answer a query or carry out a setting; an unknown message has no reply.

        For `BUSY_S`, s, after a setting or an unknown message, every message is ignored.
        """
        now_s = self._world.clock.now_s()
        if now_s - self._wrote_s < BUSY_S:
            return None
        command = message.decode("ascii", "replace").strip().upper()
        answers: dict[str, Callable[[], str]] = {
            "IDEN?": lambda: self._identity,
            "PVAR1?": lambda: f"{self._world.chamber_c:.3f}",
            "SETP1?": lambda: f"{self._set_point_c:.3f}",
            "MODE?": lambda: str(self._mode),
        }
        if command in answers:
            return answers[command]().encode("ascii")
        self._wrote_s = now_s
        self._carry_out(command)
        return None

    def power_cycle(self) -> None:
        """Switch off and on: the controller is then stopped, with its set point unchanged."""
        self._stop()

    def _carry_out(self, command: str) -> None:
        if match := _SET_POINT.match(command):
            lowest_c, highest_c = self._range
            if lowest_c <= float(match[1]) <= highest_c:
                self._set_point_c = float(match[1])
        elif command == "RUNM":
            self._mode = MANUAL
            self._world.ramp_chamber(self._set_point_c)
        elif command in ("STOP", "INIT"):
            self._stop()

    def _stop(self) -> None:
        self._mode = STOPPED
        self._world.switch_chamber_off()


# --- Watlow F4T -------------------------------------------------------------------------------------
# Source: Watlow F4T User's Guide, "SCPI commands"; TestEquity F4T manuals.

F4T_IDENTITY: Final = "Watlow Electric,F4T,12345,04:07:0011"
OLD_F4T_IDENTITY: Final = "Watlow Electric,F4T,12345,03:01:0004"


class WatlowF4T(ScpiInstrument):
    """A Watlow F4T controller with the control loop `loop`; the output `output` switches conditioning on.

    `unit` is its temperature unit; `old_firmware` uses °F and has no query for the unit. Set `error` to simulate an
    error of the loop, such as a broken sensor.
    """

    def __init__(
        self,
        world: World,
        *,
        unit: Literal["C", "F"] = "C",
        old_firmware: bool = False,
        output_on: bool = True,
        loop: int = 1,
        output: int = 1,
        lowest_c: float = -70.0,
        highest_c: float = 180.0,
    ) -> None:
        super().__init__(OLD_F4T_IDENTITY if old_firmware else F4T_IDENTITY)
        self._world = world
        self._unit = "F" if old_firmware else unit
        self._set_point_c = 23.0
        self._output_on = output_on
        self._range = (lowest_c, highest_c)
        self._ramp = {"RACTION": "OFF", "RSCALE": "MINUTES", "RRATE": "3.0"}
        self.error = False
        self.add(self._loop_commands(f"SOURce:CLOop{loop}", f"OUTPut{output}"))
        if not old_firmware:
            self.add(self._unit_commands())

    def power_cycle(self) -> None:
        """Switch off and on: the set point and the unit are kept, the output is off."""
        self._switch("0")

    def _common_commands(self) -> list[Command]:
        return [Command("*IDN?", lambda: self.identity)]

    def _loop_commands(self, loop: str, output: str) -> list[Command]:
        return [
            Command(f"{loop}:PVALue?", lambda: self._shown(self._world.chamber_c)),
            Command(f"{loop}:SPOint", self._demand, (Number(words=()),)),
            Command(f"{loop}:SPOint?", lambda: self._shown(self._set_point_c)),
            Command(f"{loop}:ERRor?", lambda: "ERROR" if self.error else "NONE"),
            Command(
                f"{loop}:RACTion",
                lambda word: self._ramp.update(RACTION=word),
                (Choice(("OFF", "STARTUP", "SETPOINT", "BOTH")),),
            ),
            Command(f"{loop}:RACTion?", lambda: self._ramp["RACTION"]),
            Command(
                f"{loop}:RSCAle", lambda word: self._ramp.update(RSCALE=word), (Choice(("MINUTES", "HOURS")),)
            ),
            Command(f"{loop}:RSCAle?", lambda: self._ramp["RSCALE"]),
            Command(f"{loop}:RRATe", lambda rate: self._ramp.update(RRATE=f"{rate:g}"), (Number(words=()),)),
            Command(f"{loop}:RRATe?", lambda: self._ramp["RRATE"]),
            Command(f"{output}:STATe", self._switch, (Boolean(),)),
            Command(f"{output}:STATe?", lambda: "ON" if self._output_on else "OFF"),
        ]

    def _unit_commands(self) -> list[Command]:
        return [
            Command("UNIT:TEMPerature", self._set_unit, (Choice(("C", "F")),)),
            Command("UNIT:TEMPerature?", lambda: self._unit),
            Command("UNIT:TEMPerature:DISPlay?", lambda: self._unit),
        ]

    def _shown(self, temperature_c: float) -> str:
        fahrenheit = self._unit == "F"
        value = temperature_c * FAHRENHEIT_PER_C + FAHRENHEIT_AT_0_C if fahrenheit else temperature_c
        return f"{value:.2f}"

    def _demand(self, value: float) -> None:
        target_c = (value - FAHRENHEIT_AT_0_C) / FAHRENHEIT_PER_C if self._unit == "F" else value
        lowest_c, highest_c = self._range
        if not lowest_c <= target_c <= highest_c:
            raise ScpiError(-222)
        self._set_point_c = target_c
        self._condition()

    def _switch(self, flag: str) -> None:
        self._output_on = flag == "1"
        self._condition()

    def _set_unit(self, unit: str) -> None:
        self._unit = "C" if unit == "C" else "F"

    def _condition(self) -> None:
        if self._output_on:
            self._world.ramp_chamber(self._set_point_c)
        else:
            self._world.switch_chamber_off()
