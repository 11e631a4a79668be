"""Control of a simulated bench from outside: turn the head, change the world, inject faults.

Each line of text has one line of JSON as reply: `turn 45 deg` gives `{"ok": true, …}` with the state, a mistake
gives `{"ok": false, "error": "…"}`. The control is served like an instrument, by `sim.wires.server.TcpServer`.
"""

from __future__ import annotations

import json
import math
import re
import shlex
from typing import TYPE_CHECKING, Final, cast

from sim.counters import Counter
from sim.wires.faults import Fault
from sim.wires.session import PlainDialect
from sim.world.pose import HeadFault
from sim.world.power import DISTURBANCES, Disturbance

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.interfaces import Direction
    from sim.bench import SimulatedBench
    from sim.wires.server import TcpServer, TerminalServer
    from sim.world.power import DisturbanceKind

HELP: Final = {
    "state": "what is true: angle, installation, temperatures, time, faults",
    "mount INSTALLATION [SERIES]": "mount the block",
    "turn ANGLE [rising|falling]": "turn the head until its scale shows the angle: 45 deg, -30 arcsec, 0.1 rad; "
    "where an encoder watches, the head turns there from where it is, at 20 deg/s",
    "chamber TEMPERATURE": "set the air of the chamber at once: 50 degC",
    "fault [INSTRUMENT] KIND [KEY=VALUE …]": "arm a fault: fault voltmeter.x late seconds=2 matching=READ?; "
    "without probability, at or matching it strikes the next exchange",
    "clear [INSTRUMENT]": "disarm faults, and mend head and chamber",
    "drop|refuse|accept|power-cycle|local INSTRUMENT": "do it at once",
    "head stuck [ANGLE] | head off ANGLE | head away | head ok": "a motorised head sticks, stops beside, runs away",
    "chamber-off DIFFERENCE": "the chamber's controller misses its demand: 3 degC; 0 mends it",
    "rail KIND [OUTPUT] [size=SIZE] [seconds=TIME]": "disturb what feeds the block: sag, drift, load, "
    "open, off, cut",
    "help": "this list",
}

_RADIANS: Final = {
    "": math.pi / 180.0,
    "deg": math.pi / 180.0,
    "°": math.pi / 180.0,
    "arcmin": math.pi / 10800.0,
    "arcsec": math.pi / 648000.0,
    "rad": 1.0,
}
_CELSIUS: Final = ("", "degC", "°C")
_QUANTITY: Final = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S*)")
_DIRECTIONS: Final[dict[str, Direction]] = {"rising": 1, "falling": -1}


CRANK_RAD_S: Final = math.radians(20.0)
"""The rate at which a head with an encoder is turned, rad/s."""


class ControlError(Exception):
    """A command that cannot be carried out; the text gives the reason."""


class BenchControl(PlainDialect):
    """A `Dialect` that carries out on a simulated bench the commands that `HELP` lists."""

    model = "control"

    def __init__(self, bench: SimulatedBench) -> None:
        self._bench = bench
        self._commands: dict[str, Callable[[list[str]], object]] = {
            "state": self._state,
            "mount": self._mount,
            "turn": self._turn,
            "chamber": self._chamber,
            "chamber-off": self._chamber_off,
            "head": self._head,
            "rail": self._rail,
            "fault": self._fault,
            "clear": self._clear,
            "help": lambda _words: {"commands": HELP},
        }
        for word in ("drop", "refuse", "accept", "power-cycle", "local"):
            self._commands[word] = lambda words, word=word: self._at_once(word, words)  # type: ignore[misc]

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Carry out one line and return the reply at once; an empty line has no reply."""
        try:
            words = shlex.split(message.decode("utf-8"))
            if not words:
                return None
            command = self._commands.get(words[0].lower())
            if command is None:
                raise ControlError(f"there is no command '{words[0]}'; say help")
            answer = command(words[1:])
            told = {"ok": True} | (answer if isinstance(answer, dict) else self._state([]))
        except (ControlError, ValueError) as error:
            told = {"ok": False, "error": str(error)}
        return json.dumps(told, ensure_ascii=False).encode("utf-8")

    # --- the world ----------------------------------------------------------------------------------

    def _state(self, words: list[str]) -> dict[str, object]:
        _no_more(words)
        world = self._bench.world
        return {
            "time_s": world.clock.now_s(),
            "installation": world.installation,
            "series": world.series,
            "scale_angle_deg": math.degrees(world.scale_angle_rad),
            "true_angle_deg": math.degrees(world.true_angle_rad),
            "direction": world.direction,
            "chamber_c": world.chamber_c,
            "block_c": world.block_c,
            "signals_v": {name: world.signal_v(name) for name in ("x", "y", "z")},
            "faults": [
                fault.told() | {"instrument": name}
                for name, faulty in self._bench.faulty.items()
                for fault in faulty.faults
            ],
        }

    def _mount(self, words: list[str]) -> None:
        if not 1 <= len(words) <= 2 or not words[-1].isalnum():
            raise ControlError(
                "name the installation, then the series unless it is 1: 'mount 2' or 'mount 2 3'"
            )
        if len(words) == 2 and not words[1].isdigit():
            raise ControlError(f"give a series such as 2, not '{words[1]}'")
        try:
            self._bench.world.mount(words[0], int(words[1]) if len(words) == 2 else 1)
        except KeyError as error:
            raise ControlError(str(error.args[0])) from error

    def _turn(self, words: list[str]) -> None:
        direction: Direction | None = _DIRECTIONS.get(words[-1]) if words else None
        angle_rad = _angle_rad(words if direction is None else words[:-1])
        if direction is None:
            direction = 1 if angle_rad >= self._bench.world.scale_angle_rad else -1
        if any(isinstance(dialect, Counter) for dialect in self._bench.dialects.values()):
            self._bench.world.move_head(angle_rad, CRANK_RAD_S)
        else:
            self._bench.world.turn(angle_rad, direction)

    def _chamber(self, words: list[str]) -> None:
        self._bench.world.set_chamber(_celsius(words))

    def _chamber_off(self, words: list[str]) -> None:
        self._bench.world.disturb_chamber(_celsius(words))

    def _head(self, words: list[str]) -> None:
        match words:
            case ["ok"]:
                fault = HeadFault()
            case ["stuck"]:
                fault = HeadFault(sticks_after_rad=0.0)
            case ["stuck", *angle]:
                fault = HeadFault(sticks_after_rad=abs(_angle_rad(angle)))
            case ["off", *angle]:
                fault = HeadFault(stops_off_rad=_angle_rad(angle))
            case ["away"]:
                fault = HeadFault(runs_away=True)
            case _:
                raise ControlError(
                    "type head stuck, head stuck 10 deg, head off 30 arcsec, head away, or head ok"
                )
        self._bench.world.head_fault = fault

    def _rail(self, words: list[str]) -> None:
        """Disturb the named output, or all outputs that feed the block: `sag P25V size=0.3 seconds=20`."""
        named = [word for word in words if "=" not in word]
        values = dict(word.split("=", 1) for word in words if "=" in word)
        if not 1 <= len(named) <= 2 or named[0] not in DISTURBANCES or values.keys() - {"size", "seconds"}:
            kinds = "; ".join(f"{kind}: {what}" for kind, what in DISTURBANCES.items())
            raise ControlError(
                f"say rail off P25V, rail sag P25V size=0.3 seconds=20, rail cut seconds=60 ({kinds})"
            )
        world = self._bench.world
        if not world.power.outputs():
            raise ControlError("no supply feeds the block of this bench; add one to its file")
        world.power.disturb(
            Disturbance(
                cast("DisturbanceKind", named[0]),
                world.clock.now_s(),
                named[1] if len(named) == 2 else "",
                float(values.get("size", "0")),
                float(values.get("seconds", "inf")),
            )
        )

    # --- faults -------------------------------------------------------------------------------------

    def _fault(self, words: list[str]) -> None:
        """Arm a fault: `[INSTRUMENT] KIND [KEY=VALUE …]`."""
        named = [word for word in words if "=" not in word]
        pairs = [word.partition("=") for word in words if "=" in word]
        data: dict[str, object] = {key: value for key, _, value in pairs}
        if len(named) == 2:
            data["instrument"] = self._known(named.pop(0))
        if len(named) != 1:
            raise ControlError("say which fault: fault voltmeter.x cut at=3")
        if not data.keys() & {"probability", "at", "matching"}:
            data["at"] = 1
        self._bench.arm(Fault.parse(data | {"fault": named[0]}))

    def _clear(self, words: list[str]) -> None:
        for name in [self._known(words[0])] if words else list(self._bench.faulty):
            self._bench.faulty[name].clear()
            self._accept(name)
        if not words:
            self._bench.world.head_fault = HeadFault()
            self._bench.world.disturb_chamber(0.0)

    def _at_once(self, what: str, words: list[str]) -> None:
        if len(words) != 1:
            raise ControlError(f"name the instrument: {what} {next(iter(self._bench.servers))}")
        name = self._known(words[0])
        wires: list[TcpServer | TerminalServer] = [self._bench.servers[name]]
        if name in self._bench.terminals:
            wires.append(self._bench.terminals[name])
        match what:
            case "drop":
                for wire in wires:
                    wire.drop_connections()
            case "refuse":
                for wire in wires:
                    wire.refuse()
                    wire.drop_connections()
            case "accept":
                self._accept(name)
            case "power-cycle":
                with self._bench.wired[name].held():
                    self._bench.faulty[name].power_cycle()
            case _:
                with self._bench.wired[name].held():
                    self._bench.faulty[name].press_local()

    def _accept(self, name: str) -> None:
        try:
            self._bench.servers[name].accept_again()
        except OSError as error:
            raise ControlError(f"the port of {name} was taken by another program; start again") from error
        if name in self._bench.terminals:
            self._bench.terminals[name].accept_again()

    def _known(self, name: str) -> str:
        if name not in self._bench.servers:
            raise ControlError(f"there is no instrument '{name}'; there are {', '.join(self._bench.servers)}")
        return name


def _no_more(words: list[str]) -> None:
    if words:
        raise ControlError(f"'{' '.join(words)}' is not expected at the end; leave it out")


def _quantity(words: list[str]) -> tuple[float, str]:
    match = _QUANTITY.fullmatch(" ".join(words))
    if match is None or not math.isfinite(float(match.group(1))):
        raise ControlError(f"expected a number with its unit, got '{' '.join(words)}'")
    return float(match.group(1)), match.group(2)


def _angle_rad(words: list[str]) -> float:
    """Return an angle in rad; the default unit is the degree."""
    number, unit = _quantity(words)
    if unit not in _RADIANS:
        raise ControlError(f"give an angle in deg, arcmin, arcsec or rad, not '{unit}'")
    return number * _RADIANS[unit]


def _celsius(words: list[str]) -> float:
    """Return a temperature or a temperature difference in °C."""
    number, unit = _quantity(words)
    if unit not in _CELSIUS:
        raise ControlError(f"give a temperature in degC, not '{unit}'")
    return number
