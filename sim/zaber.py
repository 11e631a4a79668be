"""A simulated rotary stage with a Zaber controller, in its ASCII protocol, on the head of the world.

Source: Zaber ASCII Protocol Manual: message format, commands (home, move, stop, get, set, warnings), device
settings, warning flags, checksumming.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from drivers.facts.zaber import MOST_STEPS, RESOLUTION, SPEED_UNITS, checksum
from sim.wires.session import PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.world.world import World

_INTEGER: Final = re.compile(r"-?\d{1,10}\Z")
_NUMBER: Final = re.compile(r"\d{1,2}\Z")
_PRIORITY: Final = ("FD", "FS", "WR", "NC", "NI")
"""Warning flags in descending priority; a reply shows only the first active flag."""


class _Rejected(Exception):
    """A command that is rejected (RJ); the text is the reason in the reply."""


class ZaberStage(PlainDialect):
    """One Zaber device whose axis `axis` is the head; `steps_per_degree` microsteps turn it by 1°.

    With `homed` False the stage has just been switched on without an absolute encoder and must be homed first.
    With `encoder` the stage detects that it is stuck (flag FS); without an encoder it only counts steps. It sends
    no alerts.
    """

    def __init__(
        self,
        world: World,
        *,
        steps_per_degree: float,
        device: int = 1,
        axis: int = 1,
        resolution: int = RESOLUTION,
        device_id: int = 50952,
        speed_deg_s: float = 10.0,
        lowest_deg: float = -400.0,
        highest_deg: float = 400.0,
        homed: bool = True,
        encoder: bool = True,
    ) -> None:
        self._world = world
        self._steps_per_degree = steps_per_degree
        self._device = device
        self._axis = axis
        self._encoder = encoder
        self._limits = sorted(round(deg * steps_per_degree) for deg in (lowest_deg, highest_deg))
        self._read_only = {"deviceid": device_id, "system.serial": 73021, "version": "7.38"}
        self._read_only["resolution"] = resolution
        speed = round(speed_deg_s * abs(steps_per_degree) * SPEED_UNITS)
        self._settings = {"comm.alert": 0, "comm.checksum": 0, "maxspeed": speed}
        self._warnings: set[str] = set() if homed else {"WR"}
        self._homing = False
        self._commands: dict[str, Callable[[list[str]], str]] = {
            "get": self._get,
            "set": self._set,
            "home": self._home,
            "move": self._move,
            "stop": self._stop,
            "warnings": self._tell_warnings,
        }

    # --- called by the wire and the bench -----------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Answer one command line; a malformed line, or one for another device, has no reply."""
        text = message.decode("ascii", "replace")
        if not text.startswith("/"):
            return None
        body, colon, sent = text[1:].rpartition(":")
        if colon and checksum(body) != sent:
            return None
        words = (body if colon else text[1:]).split()
        numbers: list[int] = []
        while words and _NUMBER.match(words[0]) and len(numbers) < 3:
            numbers.append(int(words.pop(0)))
        device, axis, *number = (*numbers, *(0, 0)[len(numbers) :]) if len(numbers) < 2 else numbers
        if device not in (0, self._device):
            return None
        return self._reply(axis, number, words).encode("ascii")

    def power_cycle(self) -> None:
        """Switch off and on: the motion ends and the reference is lost, but settings are kept."""
        self._world.stop_head()
        self._homing = False
        self._warnings = {"WR"}

    def turn_knob(self, angle_rad: float) -> None:
        """Turn the stage by its manual knob to `angle_rad`."""
        self._world.move_head(angle_rad, self._speed_rad_s)
        self._warnings.add("NC")

    # --- messages -----------------------------------------------------------------------------------

    def _reply(self, axis: int, number: list[int], words: list[str]) -> str:
        try:
            if axis not in (0, self._axis):
                raise _Rejected("BADAXIS")
            if words and words[0] not in self._commands:
                raise _Rejected("BADCOMMAND")
            data = self._commands[words[0]](words[1:]) if words else "0"
            verdict = "OK"
        except _Rejected as rejection:
            verdict, data = "RJ", str(rejection)
        # Status and flag are evaluated after the command, whose effect they show.
        status = "BUSY" if self._busy else "IDLE"
        shown = "".join(f" {n:02d}" for n in number)
        text = f"{self._device:02d} {axis}{shown} {verdict} {status} {self._flag} {data}"
        return f"@{text}:{checksum(text)}" if self._settings["comm.checksum"] else f"@{text}"

    # --- state --------------------------------------------------------------------------------------

    @property
    def _busy(self) -> bool:
        busy = self._world.head_rate_rad_s != 0.0
        if self._homing and not busy and not self._world.head_stuck:
            self._homing = False
            self._warnings.discard("WR")
        return busy

    @property
    def _flag(self) -> str:
        if self._encoder and self._world.head_stuck:
            self._warnings.add("FS")
        return next((flag for flag in _PRIORITY if flag in self._warnings), "--")

    @property
    def _speed_rad_s(self) -> float:
        return math.radians(self._settings["maxspeed"] / SPEED_UNITS / abs(self._steps_per_degree))

    @property
    def _position(self) -> int:
        return round(math.degrees(self._world.scale_angle_rad) * self._steps_per_degree)

    # --- commands -----------------------------------------------------------------------------------

    def _get(self, words: list[str]) -> str:
        name = words[0] if len(words) == 1 else ""
        if name == "pos":
            return str(self._position)
        value = self._read_only.get(name, self._settings.get(name))
        if value is None:
            raise _Rejected("BADCOMMAND")
        return str(value)

    def _set(self, words: list[str]) -> str:
        if len(words) != 2 or words[0] not in self._settings:
            raise _Rejected("BADCOMMAND")
        least, most = {"maxspeed": (1, MOST_STEPS), "comm.alert": (0, 0)}.get(words[0], (0, 1))
        self._settings[words[0]] = _integer(words[1], least, most)
        return "0"

    def _move(self, words: list[str]) -> str:
        """Start a movement to a position; it interrupts a movement in progress."""
        if words[:1] != ["abs"] or len(words) != 2:
            raise _Rejected("BADCOMMAND")
        target = _integer(words[1], *self._limits)
        if "WR" in self._warnings:
            raise _Rejected("BADDATA")
        self._begin(target)
        return "0"

    def _home(self, words: list[str]) -> str:
        if words:
            raise _Rejected("BADCOMMAND")
        self._begin(0)
        self._homing = True
        return "0"

    def _stop(self, words: list[str]) -> str:
        self._interrupt()
        self._world.stop_head()
        return "0"

    def _begin(self, target: int) -> None:
        self._interrupt()
        self._warnings -= {"FS", "NC"}
        self._world.move_head(math.radians(target / self._steps_per_degree), self._speed_rad_s)

    def _interrupt(self) -> None:
        if self._busy:
            self._warnings.add("NI")
            self._homing = False

    def _tell_warnings(self, words: list[str]) -> str:
        """Return the list of warnings; `warnings clear` then clears all except WR."""
        _ = self._flag
        shown = [flag for flag in _PRIORITY if flag in self._warnings]
        if words == ["clear"]:
            self._warnings &= {"WR"}
        return " ".join([f"{len(shown):02d}", *shown])


def _integer(text: str, least: int, most: int) -> int:
    if _INTEGER.match(text) is None or not least <= int(text) <= most:
        raise _Rejected("BADDATA")
    return int(text)
