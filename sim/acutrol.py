"""A simulated rate table with an ACUTROL controller, on the head of the world.

The words of a command may be abbreviated (`:M:P 1`). Each reply is a prefix of eight characters, then OK, ERR or a
number. Source: the public ACUTROL client of the maker's robotics group, and its GPIB version.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from sim.wires.session import PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.world.world import World

_PREFIX: Final = "ACUTROL>"
_COMMAND: Final = re.compile(r":([a-z]+):([a-z]+)((?:[ ,]+\S+)*)\s*\Z", re.IGNORECASE)
_WORDS: Final = {
    "utility": ("lockout", "format"),
    "interlock": ("open", "reset", "close"),
    "mode": ("position", "rate", "off"),
    "demand": ("position", "rate", "acceleration"),
    "read": ("position", "rate"),
}
_FAR_RAD: Final = 1e4
"""The target of a table at a constant rate, rad: so far away that it is never reached."""


class _Refused(Exception):
    """A refused command, answered with ERR."""


class AcutrolTable(PlainDialect):
    """One axis of a rate table, whose modes can be entered only while its interlock is closed.

    `speed_deg_s` is the speed of moves in the position mode. A demand for the present mode takes effect at
    once, a demand for another mode as soon as that mode is entered.
    """

    def __init__(self, world: World, *, speed_deg_s: float = 10.0, axis: int = 1) -> None:
        self._world = world
        self._speed_rad_s = math.radians(speed_deg_s)
        self._axis = axis
        self._interlock = "open"
        self._mode = "off"
        self._demand_deg = {"position": 0.0, "rate": 0.0, "acceleration": 0.0}

    # --- called by the wire and the bench -----------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Answer one line; of commands joined by `;` only the last is answered, or the first refused (ERR)."""
        answer = ""
        for part in message.decode("ascii", "replace").split(";"):
            try:
                answer = self._execute(part.strip())
            except _Refused:
                answer = "ERR"
                break
        return f"{_PREFIX}{answer}".encode("ascii")

    def power_cycle(self) -> None:
        """Open the interlock and stop the table, as both a power cycle and the emergency stop do."""
        self._world.stop_head()
        self._interlock, self._mode = "open", "off"
        self._demand_deg = dict.fromkeys(self._demand_deg, 0.0)

    # --- commands -----------------------------------------------------------------------------------

    def _execute(self, command: str) -> str:
        match = _COMMAND.match(command)
        if match is None:
            raise _Refused
        group = _full(match[1], tuple(_WORDS))
        verb = _full(match[2], _WORDS[group])
        values = match[3].replace(",", " ").split()
        if group == "utility":
            return "OK"
        if not values or values[0] != str(self._axis):
            raise _Refused
        if group == "read":
            return self._read(verb)
        if group == "demand":
            self._demand(verb, values[1:])
        elif group == "mode":
            self._enter(verb)
        else:
            self._set_interlock(verb)
        return "OK"

    def _read(self, what: str) -> str:
        angle_rad = self._world.scale_angle_rad if what == "position" else self._world.head_rate_rad_s
        return f"{math.degrees(angle_rad):.6f}"

    def _demand(self, what: str, values: list[str]) -> None:
        try:
            (demand,) = (float(value) for value in values)
        except ValueError as error:
            raise _Refused from error
        if not math.isfinite(demand):
            raise _Refused
        self._demand_deg[what] = demand
        if what == self._mode:
            self._follow()

    def _enter(self, mode: str) -> None:
        if mode != "off" and self._interlock != "close":
            raise _Refused
        self._mode = mode
        if mode == "off":
            self._world.stop_head()
        else:
            self._follow()

    def _follow(self) -> None:
        """Start the motion that the present mode demands: to a position, or at a rate."""
        if self._mode == "position":
            self._world.move_head(math.radians(self._demand_deg["position"]), self._speed_rad_s)
            return
        rate_rad_s = math.radians(self._demand_deg["rate"])
        self._world.stop_head()
        if rate_rad_s:
            self._world.move_head(math.copysign(_FAR_RAD, rate_rad_s), abs(rate_rad_s))

    def _set_interlock(self, verb: str) -> None:
        """Carry out open, reset or close; closing is refused unless the interlock was reset since it opened."""
        if verb == "close" and self._interlock == "open":
            raise _Refused
        if verb == "open":
            self._mode = "off"
            self._world.stop_head()
        self._interlock = verb


def _full(word: str, known: tuple[str, ...]) -> str:
    """Return the first known word that `word` abbreviates. Raises `_Refused` if there is none."""
    for full in known:
        if full.startswith(word.lower()):
            return full
    raise _Refused
