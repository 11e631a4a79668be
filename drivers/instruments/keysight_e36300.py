"""A Keysight E36311A, E36312A or E36313A over LAN or USB.

The outputs are switched one by one; each has an over-voltage protection that is always active. The driver does not
change the over-current protection, which may trip at the current limit; such a trip is reported like any other.
Sources: see `drivers.facts.keysight_e36300`; VOLTage, CURRent, VOLTage:PROTection, OUTPut with channel lists,
STATus:QUEStionable.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from drivers.facts import keysight_e36300 as facts
from drivers.interfaces import OutputSettings, OutputState, SupplyLimits, message
from drivers.supplies import NUMBER, WiredSupply

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_SWITCHES: Final = ("OUTP", "VOLT:PROT:TRIP", "CURR:PROT:TRIP")
_NUMBERS: Final = ("VOLT", "CURR", "VOLT:PROT", "MEAS:VOLT", "MEAS:CURR")


class KeysightE36300(WiredSupply):
    """A `PowerSupply` with the outputs 1, 2 and 3; `model` is the model that the identity must have."""

    def __init__(
        self, name: str, session: MessageSession, clock: Clock, *, limits: SupplyLimits, model: str
    ) -> None:
        super().__init__(name, session, clock, limits=limits)
        self._model = model
        self._listed = ",".join(self.outputs)

    def _prove(self) -> None:
        self._identify(facts.MAKERS, (self._model,), self._model)
        self._session.write("*CLS")

    def _states(self) -> dict[str, OutputState]:
        """Query the state of all outputs in one message; the replies have the order of the queries."""
        questions = [f"{header}? (@{self._listed})" for header in (*_SWITCHES, *_NUMBERS)]
        questions += [f"STAT:QUES:INST:ISUM{output}:COND?" for output in self.outputs]
        switches, numbers = self._row("[01]"), self._row(NUMBER)
        pattern = ";".join(
            [
                *([switches] * len(_SWITCHES)),
                *([numbers] * len(_NUMBERS)),
                *([r"[+-]?\d+"] * len(self.outputs)),
            ]
        )
        reply = self._session.ask(";:".join(questions), pattern, message("the state of all outputs"))
        rows = reply.split(";")
        columns = [row.split(",") for row in rows[: len(_SWITCHES) + len(_NUMBERS)]]
        conditions = rows[len(columns) :]
        return {
            output: self._state_of([column[index] for column in columns], int(conditions[index]))
            for index, output in enumerate(self.outputs)
        }

    def _row(self, pattern: str) -> str:
        return rf"{pattern}(?:, ?{pattern}){{{len(self.outputs) - 1}}}"

    @staticmethod
    def _state_of(values: list[str], condition: int) -> OutputState:
        on, over_voltage, over_current = (value.strip() == "1" for value in values[: len(_SWITCHES)])
        voltage_v, limit_a, protection_v, given_v, given_a = (
            float(value) for value in values[len(_SWITCHES) :]
        )
        return OutputState(
            on,
            OutputSettings(voltage_v, limit_a, protection_v),
            given_v,
            given_a,
            tripped=over_voltage or over_current,
            limiting=on and bool(condition & facts.LIMITING),
        )

    def _apply(self, output: str, wanted: OutputSettings) -> None:
        place = f"(@{output})"
        if wanted.over_voltage_v is not None:
            self._session.write(f"VOLT:PROT {wanted.over_voltage_v:.3f},{place}")
        self._session.write(f"CURR {wanted.current_limit_a:.4f},{place}")
        self._session.write(f"VOLT {wanted.voltage_v:.4f},{place}")

    def _switch(self, output: str, on: bool) -> None:
        self._session.write(f"OUTP {'ON' if on else 'OFF'},(@{output})")

    def _switch_all_off(self) -> None:
        self._session.write(f"OUTP OFF,(@{self._listed})")

    def _errors(self) -> list[str]:
        return self._scpi_errors()
