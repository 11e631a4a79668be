"""A simulated Keysight 34461A under its own identity: the 34401A with the commands and memory of a Truevolt meter.

Source: Truevolt Series Operating and Service Guide, "SCPI programming reference": CONFigure, SENSe:VOLTage,
SAMPle:COUNt, FETCh?, READ?, SYSTem:IDENtify.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from drivers.facts.agilent_34401a import IDENTITY as IDENTITY_34401A
from drivers.facts.keysight_34461a import IDENTITY, INTERFACES, MEMORY_READINGS, MODEL, MOST_SAMPLES
from sim.agilent_34401a import Agilent34401A, Trigger
from sim.scpi import Command
from sim.scpi_values import Choice, numbered

if TYPE_CHECKING:
    from drivers.clock import Clock
    from sim.voltmeters import MeteredSignal


class TruevoltTrigger(Trigger):
    """The trigger system of a 34461A, whose memory keeps the latest 10,000 readings, including those of READ?."""

    memory_depth = MEMORY_READINGS
    most_readings = MOST_SAMPLES
    keeps_latest = True


class Keysight34461A(Agilent34401A):
    """A 34461A with the options of an `Agilent34401A`.

    SYSTem:IDENtify HP34401A switches to the identity of the older model. The headers for autozero and input
    impedance begin with [SENSe:]VOLTage[:DC]; those of the 34401A are accepted too. Raises `ValueError` for
    RS-232, because the 34461A has a LAN interface in its place.
    """

    model = MODEL
    _trigger_type = TruevoltTrigger

    def __init__(
        self,
        source: MeteredSignal,
        clock: Clock,
        *,
        interface: Literal["gpib", "lan"] = "lan",
        **options: Any,
    ) -> None:
        if interface not in INTERFACES:
            raise ValueError(f"a {MODEL} has no RS-232; choose from {', '.join(INTERFACES)}")
        super().__init__(source, clock, interface=interface, **options)
        self.identity = self._own_identity = numbered(IDENTITY, source.place)
        self.add(self._truevolt_commands())

    def _truevolt_commands(self) -> list[Command]:
        return [
            *self.configuration.autozero_lines("[SENSe:]VOLTage[:DC]:ZERO:AUTO"),
            *self.configuration.impedance_lines("[SENSe:]VOLTage[:DC]:IMPedance:AUTO"),
            Command("SYSTem:IDENtify", self._identify, (Choice(("DEFault", "HP34401A")),)),
            Command("SYSTem:IDENtify?", lambda: "DEF" if self.identity == self._own_identity else "HP34401A"),
        ]

    def _identify(self, word: str) -> None:
        self.identity = self._own_identity if word == "DEF" else IDENTITY_34401A
