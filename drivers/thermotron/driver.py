"""A Thermotron chamber (8800, 8200, 3800, 2800): plain commands over TCP or a serial port.

A command has no reply, and the controller wants a second after each; a set point is not acted on until RUNM.
The controller cannot be asked for its unit: it must be set to °C. Sources: Thermotron 8800 computer interface
manual, as read in public drivers: IDEN, PVAR, SETP, RUNM, STOP, MODE.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from drivers.chambers import NUMBER, ChamberLimits, refuse_other_set_point
from drivers.interfaces import Identity, InstrumentRefused
from drivers.wire.proving import ProvedSession
from drivers.wire.visa import SerialSettings

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

PORT: Final = 8888
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"
"""An 8200 wants and sends CR."""
SERIAL: Final = SerialSettings(
    baud_rate=9600, data_bits=8, parity="none", stop_bits=1, flow="none", device_clear=b""
)

_WRITE_GAP_S: Final = 1.1
_RESOLUTION_C: Final = 0.1

# bits of MODE?
_STOPPED: Final = 2
_MANUAL: Final = 16


class ThermotronChamber:
    """A `ThermalChamber` run in manual mode; `temperature` is that of process variable 1, its air.

    `identity` is searched for in the reply to IDEN?.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        limits: ChamberLimits,
        *,
        identity: str = r"2800|3800|8200|8800",
    ) -> None:
        self.name = name
        self.asks_person = False
        self._session = ProvedSession(session, clock, self._prove, write_gap_s=_WRITE_GAP_S)
        self._limits = limits
        self._identity_pattern = identity
        self._identity = Identity("Thermotron", "")
        self._target_c: float | None = None

    def open(self) -> Identity:
        """Connect and prove the identity; the chamber goes on as it is.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        self._session.open()
        return self._identity

    def close(self) -> None:
        """Let the chamber go; it holds its temperature. Never raises, may be called twice."""
        self._session.close()

    def make_safe(self) -> str:
        """Stop the chamber, as at the end of a run; nothing is left for a person to do.

        Raises as `set_temperature`.
        """
        self._target_c = None
        self._session.write("STOP")
        self._refuse_mode(_STOPPED, "stopped")
        return ""

    def set_temperature(self, target_c: float, key: str) -> None:
        """Demand a temperature, read it back, and run in manual mode.

        Raises `LimitExceeded` before anything is sent, `InstrumentRefused` for a running program or a
        demand not taken, `InstrumentLost`, `BadReading`.
        """
        self._limits.check(self.name, target_c)
        mode = self._mode()
        if not mode & (_STOPPED | _MANUAL):
            raise self._other_mode(mode, "stopped or manual")
        self._target_c = None
        self._session.write(f"SETP1,{target_c:.1f}")
        refuse_other_set_point(self.name, self._number("SETP1?"), target_c, _RESOLUTION_C)
        self._session.write("RUNM")
        self._refuse_mode(_MANUAL, "manual")
        self._target_c = target_c

    def temperature(self, key: str, *, settling: bool = False) -> float:
        """Return the temperature of the air, °C.

        Raises `InstrumentRefused` for a mode or set point that somebody changed, or air out of band;
        `BadReading`, `InstrumentLost`.
        """
        if self._target_c is not None:
            self._refuse_mode(_MANUAL, "manual")
            refuse_other_set_point(self.name, self._number("SETP1?"), self._target_c, _RESOLUTION_C)
        return self._limits.in_band(self.name, self._number("PVAR1?"), None if settling else self._target_c)

    def _prove(self) -> None:
        reply = self._session.ask("IDEN?", r"[\x20-\x7e]+", "an identity")
        match = re.search(self._identity_pattern, reply)
        if match is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} is {reply!r}, not a Thermotron {self._identity_pattern}",
                "check address and identity in the bench file",
            )
        self._identity = Identity("Thermotron", match[0], firmware=reply.replace(match[0], "").strip(" ,-"))

    def _number(self, command: str) -> float:
        return float(self._session.ask(command, NUMBER, "a temperature such as 22.000"))

    def _mode(self) -> int:
        return int(self._session.ask("MODE?", r"\d{1,5}", "a mode such as 16"))

    def _refuse_mode(self, bit: int, wanted: str) -> None:
        mode = self._mode()
        if not mode & bit:
            raise self._other_mode(mode, wanted)

    def _other_mode(self, mode: int, wanted: str) -> InstrumentRefused:
        return InstrumentRefused(
            self.name,
            f"its mode is {mode}, not {wanted}",
            "end programs, check alarms and that nobody else controls the chamber, then take this step again",
        )
