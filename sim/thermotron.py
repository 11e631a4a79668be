"""A simulated Thermotron 8800, around the block of the world: plain commands, no reply to a setting.

It wants to be left alone for a second after a setting: what comes sooner is lost, as on the real controller.
Source: Thermotron 8800 computer interface manual as read in public drivers.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from drivers.facts.thermotron import BUSY_S, MANUAL, STOPPED
from sim.wires.session import PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.world.world import World

IDENTITY: Final = "8800 V3.12"

_SET_POINT: Final = re.compile(r"SETP1,([+-]?\d+(?:\.\d+)?)\Z")


class Thermotron8800(PlainDialect):
    """The controller; stopped when it is switched on. A set point is acted on at RUNM only.

    `identity` is what it answers to IDEN?.
    """

    def __init__(
        self, world: World, *, identity: str = IDENTITY, lowest_c: float = -70.0, highest_c: float = 180.0
    ) -> None:
        self._world = world
        self._identity = identity
        self._range = (lowest_c, highest_c)
        self._set_point_c = 23.0
        self._mode = STOPPED
        self._wrote_s = -math.inf

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Answer a query, carry out a setting; anything else, or what comes too soon, is passed over."""
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
        """Switch off and on: it comes back stopped, the set point is kept."""
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
