"""An Aim-TTi PL-P or CPX over LAN, USB (a serial port to the computer) or RS-232.

It does not use SCPI: `V1 5.0` sets, `V1?` returns `V1 5.000`, `V1O?` measures. Reading the supply's limit
event register clears the register, so the driver remembers a trip until the output is switched on again.
Sources: see `drivers.facts.aim_tti`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from drivers.facts import aim_tti as facts
from drivers.interfaces import InstrumentRefused, OutputSettings, OutputState, SupplyLimits, message
from drivers.supplies import WiredSupply

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_NUMBER: Final = r"-?\d{1,3}\.\d{1,4}"
_TRIPPED: Final = facts.OVER_VOLTAGE | facts.OVER_CURRENT
_NEAR_STEPS: Final = 3.0
"""A current this many steps from its limit, or a voltage from its setting, still counts as equal to it."""


class AimTti(WiredSupply):
    """A `PowerSupply` with the outputs 1 and 2; `model` is the model that the identity must have."""

    def __init__(
        self, name: str, session: MessageSession, clock: Clock, *, limits: SupplyLimits, model: str
    ) -> None:
        super().__init__(name, session, clock, limits=limits)
        self._model = model
        self._has_tripped: dict[str, bool] = {}

    def _prove(self) -> None:
        self._identify(facts.MAKERS, (self._model,), self._model)
        self._session.ask(
            "*ESR?", r"\d{1,3}", message("a register such as 0")
        )  # reading the register clears events from before the connection

    def _states(self) -> dict[str, OutputState]:
        return {output: self._state(output) for output in self.outputs}

    def _state(self, output: str) -> OutputState:
        on = self._session.ask(f"OP{output}?", "[01]", "0 or 1") == "1"
        settings = OutputSettings(
            self._setting(f"V{output}", f"V{output}"),
            self._setting(f"I{output}", f"I{output}"),
            self._setting(f"OVP{output}", f"VP{output}") if self._protects(output) else None,
        )
        given_v, given_a = self._measured(f"V{output}O?", "V"), self._measured(f"I{output}O?", "A")
        event = int(self._session.ask(f"LSR{output}?", r"\d{1,3}", message("a register such as 1")))
        if event & _TRIPPED and not on:
            self._has_tripped[output] = True
        return OutputState(
            on,
            settings,
            given_v,
            given_a,
            tripped=not on and self._has_tripped.get(output, False),
            limiting=on and self._limits_current(output, settings, given_v, given_a),
        )

    def _limits_current(self, output: str, settings: OutputSettings, given_v: float, given_a: float) -> bool:
        """Return whether an output that measures `given_v` and `given_a` now limits its current.

        The event register does not show this: it holds past events only.
        """
        steps = self._limits.outputs[output]
        at_limit = given_a >= settings.current_limit_a - _NEAR_STEPS * steps.current_step_a
        return at_limit and given_v < settings.voltage_v - _NEAR_STEPS * steps.voltage_step_v

    def _protects(self, output: str) -> bool:
        return self._limits.outputs[output].over_voltage_v is not None

    def _setting(self, command: str, named: str) -> float:
        reply = self._session.ask(
            f"{command}?", rf"{named} {_NUMBER}", message(f"a setting such as {named} 5.000")
        )
        return float(reply.split()[1])

    def _measured(self, question: str, unit: str) -> float:
        reply = self._session.ask(question, rf"{_NUMBER}{unit}", message(f"a reading such as 5.000{unit}"))
        return float(reply.removesuffix(unit))

    def _refuse_unready(
        self, states: Mapping[str, OutputState], settings: Mapping[str, OutputSettings]
    ) -> None:
        if self._model not in facts.TRACKS:
            return
        if self._session.ask("CONFIG?", r"\d", message("a digit such as 2")) != facts.INDEPENDENT:
            raise InstrumentRefused(
                self.name,
                "its outputs follow each other (tracking)",
                "set them to independent at its front panel",
            )

    def _apply(self, output: str, wanted: OutputSettings) -> None:
        if wanted.over_voltage_v is not None:
            self._session.write(f"OVP{output} {wanted.over_voltage_v:.1f}")
        self._session.write(f"I{output} {wanted.current_limit_a:.3f}")
        self._session.write(f"V{output} {wanted.voltage_v:.3f}")

    def _switch(self, output: str, on: bool) -> None:
        if on:
            self._has_tripped[output] = False
        self._session.write(f"OP{output} {int(on)}")

    def _switch_all_off(self) -> None:
        self._session.write("OPALL 0")

    def _errors(self) -> list[str]:
        """Return the errors of rejected commands, from the event registers."""
        event = int(self._session.ask("*ESR?", r"\d{1,3}", message("a register such as 0")))
        errors = []
        if event & facts.COMMAND_ERROR:
            errors.append(message("a command that it does not know"))
        if event & facts.QUERY_ERROR:
            errors.append(message("a query error"))
        if event & facts.EXECUTION_ERROR:
            number = int(self._session.ask("EER?", r"\d{1,3}", message("a number such as 100")))
            errors.append(
                message(f"execution error {number} ({facts.EXECUTION_ERRORS.get(number, 'see its manual')})")
            )
        return errors

    def _go_to_local(self) -> None:
        self._session.write("LOCAL")
