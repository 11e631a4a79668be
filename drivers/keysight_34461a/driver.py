"""Keysight Truevolt 34460A, 34461A, 34465A, 34470A: DC volts into memory, in their own identity or the 34401A's.

Over the 34401A's commands they take (SYSTem:IDENtify makes them answer as one), only autozero and input
impedance have moved under the function and the memory is larger; a reading has the same 15 characters.
Of the integration times of the 34465A and 34470A those are used that all models share.
Sources: Truevolt Series Operating and Service Guide, "CONFigure", "SENSe:VOLTage", "FETCh?", "SYSTem:IDENtify",
"Measurement specifications".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

from drivers.agilent_34401a.driver import DIALECT_34401A, NPLC, RANGES_V, Agilent34401A, SingleChannelDialect
from drivers.scpi_voltmeter import Limits

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.interfaces import Channel
    from drivers.wire.visa import MessageSession

MEMORY_SAMPLES: Final = {"34461A": 10_000, "34460A": 1_000, "34465A": 50_000, "34470A": 50_000}
"""Readings that each model keeps, without the option of a larger memory; beyond, the oldest are lost."""


def _truevolt(memory_samples: int) -> SingleChannelDialect:
    return SingleChannelDialect(
        "VOLT:DC:ZERO:AUTO", "VOLT:DC:IMP:AUTO", Limits(RANGES_V, NPLC, memory_samples)
    )


DIALECTS: Final = {model: _truevolt(samples) for model, samples in MEMORY_SAMPLES.items()} | {
    "34401A": DIALECT_34401A
}


class Keysight34461A(Agilent34401A):
    """A `Voltmeter` with one signal. `interface` is "lan" (also for USB) or "gpib": it has no RS-232."""

    dialects = DIALECTS
    _called = "a 34460A, 34461A, 34465A or 34470A, nor one that emulates a 34401A"
    _hint = "the meter's own is under Utility, I/O Config"

    def __init__(
        self,
        name: str,
        channel: Channel,
        session: MessageSession,
        clock: Clock,
        *,
        interface: Literal["lan", "gpib"] = "lan",
        line_hz: float = 50.0,
    ) -> None:
        super().__init__(name, channel, session, clock, interface=interface, line_hz=line_hz)
