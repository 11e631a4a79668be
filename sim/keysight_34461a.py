"""A simulated Keysight 34461A in its own identity: the 34401A's engine, commands and memory of a Truevolt meter.

Source: Truevolt Series Operating and Service Guide, "SCPI programming reference": CONFigure, SENSe:VOLTage,
SAMPle:COUNt, FETCh?, READ?, SYSTem:IDENtify.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from sim.agilent_34401a.meter import IDENTITY as IDENTITY_34401A
from sim.agilent_34401a.meter import Agilent34401A
from sim.agilent_34401a.trigger import Trigger
from sim.scpi.instrument import Command
from sim.scpi.values import Boolean, Choice

if TYPE_CHECKING:
    from drivers.clock import Clock
    from sim.agilent_34401a.converter import Accuracy, MeteredSignal

IDENTITY: Final = "Keysight Technologies,34461A,MY53200001,A.02.17-02.40-02.17-00.52-04-01"


class TruevoltTrigger(Trigger):
    """The trigger system of a 34461A: 10,000 readings are kept, the latest, those of READ? too."""

    memory_depth = 10_000
    most_readings = 1_000_000
    keeps_latest = True


class Keysight34461A(Agilent34401A):
    """The meter (see `Agilent34401A` for the rest). SYSTem:IDENtify HP34401A gives it the older identity.

    Autozero and input impedance stand under the function that they belong to; the 34401A's headers are
    taken as well. It has no RS-232, and a LAN in place of it.
    """

    model = "34461A"
    _trigger_type = TruevoltTrigger

    def __init__(
        self,
        source: MeteredSignal,
        clock: Clock,
        *,
        interface: Literal["gpib", "lan"] = "lan",
        noise: bool = True,
        accuracy: Accuracy | None = None,
        line_hz: float = 50.0,
        terminals: Literal["front", "rear"] = "front",
    ) -> None:
        super().__init__(
            source,
            clock,
            interface=interface,
            noise=noise,
            accuracy=accuracy,
            line_hz=line_hz,
            terminals=terminals,
        )
        self.identity = IDENTITY
        self.add(self._truevolt_commands())

    def _truevolt_commands(self) -> list[Command]:
        configuration = self.configuration
        return [
            Command("[SENSe:]VOLTage[:DC]:ZERO:AUTO", self._set_autozero, (Boolean(("ONCE",)),)),
            Command("[SENSe:]VOLTage[:DC]:ZERO:AUTO?", lambda: str(int(configuration.autozero))),
            Command("[SENSe:]VOLTage[:DC]:IMPedance:AUTO", self._set_high_impedance, (Boolean(),)),
            Command("[SENSe:]VOLTage[:DC]:IMPedance:AUTO?", lambda: str(int(configuration.high_impedance))),
            Command("SYSTem:IDENtify", self._identify, (Choice(("DEFault", "HP34401A")),)),
            Command("SYSTem:IDENtify?", lambda: "DEF" if self.identity == IDENTITY else "HP34401A"),
        ]

    def _set_autozero(self, flag: str) -> None:
        # ONCE takes one zero reading and then leaves autozero off.
        self.configuration.autozero = flag == "1"
        self._configuration_changed()

    def _set_high_impedance(self, flag: str) -> None:
        self.configuration.high_impedance = flag == "1"

    def _identify(self, word: str) -> None:
        self.identity = IDENTITY if word == "DEF" else IDENTITY_34401A
