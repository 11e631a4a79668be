"""A simulated Leica Nivel210 or Nivel220 on the platform of the world.

Source: NIVEL200 Technical Reference Manual 1.0. The real sensor returns the mean of one measurement per second
since it was placed; here each request draws the noise of such a mean again. Adjustment and saving
of parameters are not simulated.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from drivers.facts import leica_nivel as facts
from sim.wires.session import LineEnds, PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.interfaces import LevelAxis
    from sim.world.world import World

_REQUEST: Final = re.compile(rf"{facts.START}N([0-9A-Z])(C[0-9A-Z]) (.{{1,200}}){facts.END}", re.DOTALL)


_FIXED: Final = {"RB D": "000005 1.0", "RS C": "ON", "RS M": "CONT"}
"""Queries with replies that never change: serial number and firmware, corrected values, continuous measurement."""
_SET_AVERAGES: Final = re.compile(r"W N (\d{3})")


class LeicaNivel(PlainDialect):
    """A Nivel sensor with the address N`sensor`; `along` and `across` name its axes with sign, such as "+Y"."""

    model = "Nivel210"

    def __init__(self, world: World, *, sensor: str = "1", along: str = "+Y", across: str = "+X") -> None:
        self._world = world
        self._sensor = sensor
        self._axes: dict[str, tuple[LevelAxis, float]] = {
            along[1]: ("along", float(f"{along[0]}1")),
            across[1]: ("across", float(f"{across[0]}1")),
        }
        self.line_ends = LineEnds((b"\r\n",), frame=self._framed, clears=False)
        self.power_cycle()

    # --- called by the wire and the bench -----------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Answer a query block; commands, malformed blocks and blocks for another sensor have no reply."""
        request = _REQUEST.fullmatch(message.decode("latin-1"))
        if request is None or request[1] not in (self._sensor, "0"):
            return None
        said = self._answer(request[3])
        return None if said is None else f"{request[2]}N{self._sensor} {said}".encode("ascii")

    def power_cycle(self) -> None:
        """Switch off and on, which restores the default settings."""
        self._averages = facts.AVERAGES

    @staticmethod
    def _framed(said: bytes) -> bytes:
        return b"\x16\x02" + said + b"\x03" + (sum(said) & 0xFFFF).to_bytes(2, "big")

    # --- queries and commands -----------------------------------------------------------------------

    def _answer(self, command: str) -> str | None:
        asked = " ".join(command.split())
        if asked == "G A":
            axes = " ".join(f"{axis}:{self._mrad(axis):+.3f}" for axis in "XY")
            return f"{axes} T:{self._world.room_c():+.1f}"
        if asked == "G P":
            within = all(abs(self._mrad(axis)) <= facts.RANGE_RAD / facts.MRAD for axis in "XY")
            return "OK" if within else "F"
        if (wanted := _SET_AVERAGES.fullmatch(asked)) and 1 <= int(wanted[1]) <= facts.MOST_AVERAGES:
            self._averages = int(wanted[1])
        return {"R N": f"{self._averages:03d}", **_FIXED}.get(asked)

    def _mrad(self, axis: str) -> float:
        way, sign = self._axes[axis]
        shown = sign * self._world.level_shows_rad(way) / facts.MRAD
        return math.copysign(min(abs(shown), 9.999), shown)
