"""Keysight Truevolt 34460A, 34461A, 34465A, 34470A, under their own identity or that of a 34401A.

They measure DC volts into memory. Unlike a 34401A, they have the headers of autozero and input impedance below the
function's header, and a larger memory; a reading has the same 15 characters. SYSTem:IDENtify makes them report the
identity of a 34401A. Sources: see `drivers.facts.keysight_34461a`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from drivers.facts import keysight_34461a as facts
from drivers.instruments.agilent_34401a import DIALECT_34401A, Agilent34401A, SingleChannelDialect
from drivers.interfaces import VoltmeterLimits, message

DIALECTS: Final = {
    model: SingleChannelDialect(
        "VOLT:DC:ZERO:AUTO", "VOLT:DC:IMP:AUTO", replace(VoltmeterLimits.of(facts), most_samples=samples)
    )
    for model, samples in facts.MEMORY_OF_MODEL.items()
} | {"34401A": DIALECT_34401A}


class Keysight34461A(Agilent34401A):
    """A `Voltmeter` with one signal. `interface` is "lan" (also for USB) or "gpib"; there is no RS-232."""

    dialects = DIALECTS
    models = tuple(DIALECTS)
    called = message("34460A, 34461A, 34465A or 34470A, nor one that emulates a 34401A")
    hint = "the meter's own is under Utility, I/O Config"
