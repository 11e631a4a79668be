"""A simulated Aim-TTi PL-P or CPX supply, whose outputs feed the block of the world. Its dialect is not SCPI.

The commands of a message are separated by semicolons; each reply is a line of its own. A refused command
shows only in the registers *ESR? and EER?. The simulation covers setting, protecting against over-voltage,
switching and monitoring the outputs.
Sources: as in `drivers.facts.aim_tti`; PL & PL-P Series Instruction Manual, "Remote commands".
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
_NO_OUTPUT: Final = 103
_WHILE_ON: Final = 104
_LOW_RANGE_A: Final = 0.5


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
    """A supply of a `model` in `drivers.facts.aim_tti.OUTPUTS`; LF ends its messages, CR LF its replies."""

    line_ends = LineEnds((b"\n",), reply=b"\r\n")

    def __init__(self, world: World, *, model: str = "PL303QMD-P") -> None:
        self.model = model
        self._limits: dict[str, dict[str, Any]] = facts.OUTPUTS[model]
        self._event, self._error = facts.POWER_ON, 0
        self._low_range: set[str] = set()
        self._told_trips: set[str] = set()
        self._outputs = Outputs(world, self._limits, self._preset, self.power_cycle)
        self._of_output: dict[str, Callable[[_Command, OutputPhase], str | None]] = {
            "V": self._voltage, "I": self._current, "OVP": self._over_voltage, "OP": self._switch,
            "LSR": self._limit_events, "IRANGE": self._range,
        }  # fmt: skip
        self._of_supply: dict[str, Callable[[_Command], str | None]] = {
            "OPALL": self._switch_all, "CONFIG": lambda _: str(facts.INDEPENDENT),
            "TRIPRST": lambda _: self._reset_trips(), "LOCAL": lambda _: None,
            "EER": lambda _: self._take_error(), "*ESR": lambda _: self._take_event(), "*WAI": lambda _: None,
            "*IDN": lambda _: facts.IDENTITY.format(model=self.model), "*RST": lambda _: self._outputs.reset(),
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
        self._event, self._error = facts.POWER_ON, 0
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

    def _within(self, command: _Command, what: str) -> float:
        low, high = self._limits[command.output][what]
        if not low <= command.number <= high:
            raise _Refused(facts.EXECUTION_ERROR, _OUT_OF_RANGE)
        return command.number

    # --- the supply ---------------------------------------------------------------------------------

    def _switch_all(self, command: _Command) -> None:
        for name in self._outputs.names:
            self._outputs.switch(name, command.flag)

    def _reset_trips(self) -> None:
        self._outputs.clear_trips()
        self._told_trips.clear()

    def _take_error(self) -> str:
        error, self._error = self._error, 0
        return str(error)

    def _take_event(self) -> str:
        event, self._event = self._event, 0
        return str(event)
