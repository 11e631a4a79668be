"""A simulated Espec chamber with a P300 controller, around the block of the world.

Source: Espec P300 communication manual as read in ChamberConnectLibrary (`especinteract.py`, `p300.py`).
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sim.wires.session import PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.world.world import World

_NUMBER: Final = r"[+-]?\d+(?:\.\d+)?"
_TEMP: Final = re.compile(rf"TEMP,((?: ?[SHL]{_NUMBER})+)\Z")
_MODE: Final = re.compile(r"MODE,(OFF|STANDBY|CONSTANT|RUN\d+)\Z")
_PROTECT: Final = re.compile(r"KEYPROTECT,(ON|OFF)\Z")


class EspecP300(PlainDialect):
    """The controller; `noise_c` is the standard deviation of its sensor, `name` what it calls itself.

    `alarms` may be set from outside.

    Switched on, it is in standby with 23 °C demanded.
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

    # --- what the wire and the bench do -------------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Answer one command: there is one reply to each."""
        command = message.decode("ascii", "replace").strip()
        return self._answer(re.sub(r"\s*,\s*", ",", command.upper())).encode("ascii")

    def power_cycle(self) -> None:
        """Switch off and on: it comes back in standby, its set point and limits are kept."""
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
        """The operation as the queries show it: a program without its number."""
        return "RUN" if self._mode.startswith("RUN") else self._mode

    def _air_c(self) -> float:
        if not self._noise_c:
            return self._world.chamber_c
        generator = self._world.random("chamber sensor", self._world.count("chamber sensor"))
        return self._world.chamber_c + float(generator.normal(0.0, self._noise_c))

    def _temperatures(self) -> str:
        return f"{self._air_c():.1f},{self._set['S']:.1f},{self._set['H']:.1f},{self._set['L']:.1f}"

    def _demand(self, command: str, text: str) -> str:
        """Set point, upper and lower limit at once; nothing is taken when one of them is out of range."""
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
