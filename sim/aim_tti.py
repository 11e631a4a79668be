"""A simulated Aim-TTi PL-P or CPX supply, whose outputs feed the block of the world. Its dialect is not SCPI.

The commands of a message are separated by semicolons; each reply is a line of its own. A refused command shows
only in the registers *ESR? and EER?. The simulation covers setting, protecting, switching and monitoring the
outputs. The over-current trip accepts only its highest setting, at which it never trips.
Sources: as in the facts; PL & PL-P Series Instruction Manual, "Remote commands".
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from drivers.facts import aim_tti as facts
from sim.supply import Outputs
from sim.wires.session import LineEnds, PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.world.power import OutputPhase
    from sim.world.world import World

_COMMAND: Final = re.compile(
    r"(?P<name>\*?[A-Z]+?)(?:(?P<output>\d)(?P<kind>[VO])?)?(?P<ask>\?)?"
    r"(?:\s+(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:E[+-]?\d+)?))?"
)
_OUT_OF_RANGE: Final = 100
_EMPTY_STORE: Final = 102
_NO_OUTPUT: Final = 103
_WHILE_ON: Final = 104
_STORES: Final = 10
_LOW_RANGE_A: Final = 0.5
_OF_HIGHEST: Final = 1.1
_STEPS: Final = {"V": 0.01, "I": 0.01}
_ADDRESSES: Final = {"ADDRESS": "11", "IPADDR": "127.0.0.1", "NETMASK": "255.255.255.0", "NETCONFIG": "DHCP"}


class _Refused(Exception):
    """A refused command, with the bit for *ESR? and the error number for EER? (0: none)."""

    def __init__(self, bit: int, number: int = 0) -> None:
        super().__init__(number)
        self.bit = bit
        self.number = number


@dataclass(frozen=True)
class _Command:
    """A parsed command: `V1O?` has name V, output 1, kind O, and is a query (`asks`)."""

    name: str
    output: str
    kind: str
    asks: bool
    text: str

    @property
    def number(self) -> float:
        if not self.text:
            raise _Refused(facts.COMMAND_ERROR)
        return float(self.text)

    @property
    def flag(self) -> bool:
        if self.number not in (0.0, 1.0):
            raise _Refused(facts.EXECUTION_ERROR, _OUT_OF_RANGE)
        return self.number == 1.0


class AimTti(PlainDialect):
    """An Aim-TTi supply; `model` is a key of `OUTPUTS` in its facts. Messages end in LF, replies in CR LF."""

    line_ends = LineEnds((b"\n",), reply=b"\r\n")

    def __init__(self, world: World, *, model: str = "PL303QMD-P") -> None:
        self.model = model
        self._limits: dict[str, dict[str, Any]] = facts.OUTPUTS[model]
        self._event, self._error = facts.POWER_ON, 0
        self._config = int(facts.INDEPENDENT)
        self._locked = False
        self._low_range: set[str] = set()
        self._steps: dict[tuple[str, str], float] = {}
        self._stored: dict[tuple[str, int], tuple[float, float]] = {}
        self._told_trips: set[str] = set()
        self._outputs = Outputs(world, self._limits, self._preset, self.power_cycle)
        self._of_output: dict[str, Callable[[_Command, OutputPhase], str | None]] = {
            "V": self._voltage, "I": self._current, "OVP": self._over_voltage, "OCP": self._over_current,
            "OP": self._switch, "LSR": self._limit_events, "IRANGE": self._range, "SAV": self._save,
            "RCL": self._recall, "DAMPING": lambda command, stage: None,
            **dict.fromkeys(("DELTAV", "DELTAI"), self._step),
            **dict.fromkeys(("INCV", "INCI", "DECV", "DECI"), self._count),
        }  # fmt: skip
        self._of_supply: dict[str, Callable[[_Command], str | None]] = {
            "OPALL": self._switch_all, "CONFIG": self._configure, "TRIPRST": lambda _: self._reset_trips(),
            "LOCAL": lambda _: None, "IFLOCK": self._lock, "IFUNLOCK": lambda _: self._unlock(),
            "EER": lambda _: self._take_error(), "QER": lambda _: "0",
            "*ESR": lambda _: self._take_event(),
            "*STB": lambda _: "0", "*IDN": lambda _: facts.IDENTITY.format(model=self.model),
            "*OPC": lambda command: "1" if command.asks else None, "*TST": lambda _: "0", "*WAI": lambda _: None,
            "*CLS": lambda _: self._clear(), "*RST": lambda _: self._outputs.reset(),
            **dict.fromkeys(_ADDRESSES, lambda command: _ADDRESSES[command.name]),
        }  # fmt: skip

    # --- called by the wire and the bench -----------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Carry out a message; without mains there is no reply."""
        if not self._outputs.has_mains:
            return None
        units = message.decode("ascii", "replace").upper().split(";")
        lines = [
            reply for unit in units if unit.strip() and (reply := self._carry_out(unit.strip())) is not None
        ]
        return "\r\n".join(lines).encode("ascii") if lines else None

    def input_overflow(self) -> None:
        """Report an overlong line as a command error."""
        self._event |= facts.COMMAND_ERROR

    def press_local(self) -> None:
        """Press LOCAL on the front panel; no effect here, because the next command returns to remote."""

    def power_cycle(self) -> None:
        """Switch off and on: settings are kept, all outputs are off."""
        self._event, self._error, self._locked = facts.POWER_ON, 0, False
        for name in self._outputs.names:
            self._outputs.change(name, on=False, tripped=None)

    def _preset(self, name: str) -> dict[str, Any]:
        limits = self._limits[name]
        protection = limits.get("over_voltage_v")
        return {
            "set_v": 1.0,
            "limit_a": 1.0,
            "trip_v": None if protection is None else protection[1],
            "trip_after_s": None,
        }

    def _carry_out(self, unit: str) -> str | None:
        match = _COMMAND.fullmatch(unit)
        try:
            if match is None:
                raise _Refused(facts.COMMAND_ERROR)
            command = _Command(
                match["name"],
                match["output"] or "",
                match["kind"] or "",
                bool(match["ask"]),
                match["number"] or "",
            )
            if command.output and command.name in self._of_output:
                if command.output not in self._outputs.names:
                    raise _Refused(facts.EXECUTION_ERROR, _NO_OUTPUT)
                return self._of_output[command.name](command, self._outputs.stage(command.output))
            if not command.output and command.name in self._of_supply:
                return self._of_supply[command.name](command)
            raise _Refused(facts.COMMAND_ERROR)
        except _Refused as refusal:
            self._event |= refusal.bit
            self._error = refusal.number or self._error
            return None

    # --- an output ----------------------------------------------------------------------------------

    def _voltage(self, command: _Command, stage: OutputPhase) -> str | None:
        """Set or query the voltage of an output: V1 5, V1V 5 (with verify), V1? (setting), V1O? (measured)."""
        if command.asks and command.kind == "O":
            return f"{self._outputs.shown(command.output).voltage_v:.3f}V"
        if command.asks:
            return f"V{command.output} {stage.set_v:.3f}"
        self._outputs.change(command.output, set_v=self._within(command, "voltage_v"))
        return None

    def _current(self, command: _Command, stage: OutputPhase) -> str | None:
        """Set or query the current limit of an output: I1 0.5, I1? (setting), I1O? (measured)."""
        if command.asks and command.kind == "O":
            return f"{self._outputs.shown(command.output).current_a:.3f}A"
        if command.asks:
            return f"I{command.output} {stage.limit_a:.3f}"
        wanted_a = self._within(command, "current_a")
        if command.output in self._low_range and wanted_a > _LOW_RANGE_A:
            raise _Refused(facts.EXECUTION_ERROR, _OUT_OF_RANGE)
        self._outputs.change(command.output, limit_a=wanted_a)
        return None

    def _over_voltage(self, command: _Command, stage: OutputPhase) -> str | None:
        if "over_voltage_v" not in self._limits[command.output]:
            raise _Refused(facts.COMMAND_ERROR)
        if command.asks:
            return f"VP{command.output} {stage.trip_v or 0.0:.2f}"
        self._outputs.change(command.output, trip_v=self._within(command, "over_voltage_v"))
        return None

    def _over_current(self, command: _Command, stage: OutputPhase) -> str | None:
        if "over_voltage_v" not in self._limits[command.output]:
            raise _Refused(facts.COMMAND_ERROR)
        highest_a = _OF_HIGHEST * self._limits[command.output]["current_a"][1]
        if command.asks:
            return f"CP{command.output} {highest_a:.2f}"
        if command.number < highest_a - 1e-9:
            raise _Refused(facts.EXECUTION_ERROR, _OUT_OF_RANGE)
        return None

    def _switch(self, command: _Command, stage: OutputPhase) -> str | None:
        if command.asks:
            return str(int(stage.on))
        self._outputs.switch(command.output, command.flag)
        return None

    def _limit_events(self, command: _Command, stage: OutputPhase) -> str:
        """Return the regulation mode of an output, or its trip if that was not yet reported."""
        if stage.on:
            self._told_trips.discard(command.output)
            limits = self._outputs.shown(command.output).limiting
            return str(facts.LIMITING if limits else facts.REGULATING)
        if stage.tripped is None or command.output in self._told_trips:
            return "0"
        self._told_trips.add(command.output)
        return str(facts.OVER_VOLTAGE if stage.tripped == "voltage" else facts.OVER_CURRENT)

    def _range(self, command: _Command, stage: OutputPhase) -> str | None:
        """Set or query the current range: IRANGE1 1 is low, 2 is high; refused while the output is on."""
        if command.asks:
            return "1" if command.output in self._low_range else "2"
        if command.number not in (1.0, 2.0):
            raise _Refused(facts.EXECUTION_ERROR, _OUT_OF_RANGE)
        if stage.on:
            raise _Refused(facts.EXECUTION_ERROR, _WHILE_ON)
        if command.number == 1.0:
            self._low_range.add(command.output)
            self._outputs.change(command.output, limit_a=min(stage.limit_a, _LOW_RANGE_A))
        else:
            self._low_range.discard(command.output)
        return None

    def _step(self, command: _Command, stage: OutputPhase) -> str | None:
        """Set or query the step of INCV1 and DECV1: DELTAV1 0.1 (likewise for current)."""
        what = command.name[-1]
        if command.asks:
            return (
                f"{command.name}{command.output} {self._steps.get((what, command.output), _STEPS[what]):.3f}"
            )
        self._steps[what, command.output] = command.number
        return None

    def _count(self, command: _Command, stage: OutputPhase) -> None:
        what = command.name[-1]
        step = self._steps.get((what, command.output), _STEPS[what]) * (
            1 if command.name.startswith("INC") else -1
        )
        wanted = (stage.set_v if what == "V" else stage.limit_a) + step
        {"V": self._voltage, "I": self._current}[what](
            _Command(what, command.output, "", False, f"{wanted:.4f}"), stage
        )

    def _save(self, command: _Command, stage: OutputPhase) -> None:
        self._stored[command.output, self._store(command)] = (stage.set_v, stage.limit_a)

    def _recall(self, command: _Command, stage: OutputPhase) -> None:
        stored = self._stored.get((command.output, self._store(command)))
        if stored is None:
            raise _Refused(facts.EXECUTION_ERROR, _EMPTY_STORE)
        self._outputs.change(command.output, set_v=stored[0], limit_a=stored[1])

    @staticmethod
    def _store(command: _Command) -> int:
        if command.number not in range(_STORES):
            raise _Refused(facts.EXECUTION_ERROR, _OUT_OF_RANGE)
        return round(command.number)

    def _within(self, command: _Command, what: str) -> float:
        low, high = self._limits[command.output][what]
        if not low <= command.number <= high:
            raise _Refused(facts.EXECUTION_ERROR, _OUT_OF_RANGE)
        return command.number

    # --- the supply ---------------------------------------------------------------------------------

    def _switch_all(self, command: _Command) -> None:
        for name in self._outputs.names:
            self._outputs.switch(name, command.flag)

    def _configure(self, command: _Command) -> str | None:
        if command.asks:
            return str(self._config)
        if command.number not in (0.0, 2.0):
            raise _Refused(facts.EXECUTION_ERROR, _OUT_OF_RANGE)
        self._config = round(command.number)
        return None

    def _reset_trips(self) -> None:
        self._outputs.clear_trips()
        self._told_trips.clear()

    def _lock(self, command: _Command) -> str:
        """Take the interface lock (IFLOCK) or query it (IFLOCK?); return "1" if the lock is held."""
        self._locked |= not command.asks
        return str(int(self._locked))

    def _unlock(self) -> str:
        self._locked = False
        return "0"

    def _take_error(self) -> str:
        error, self._error = self._error, 0
        return str(error)

    def _take_event(self) -> str:
        event, self._event = self._event, 0
        return str(event)

    def _clear(self) -> None:
        self._event, self._error = 0, 0
