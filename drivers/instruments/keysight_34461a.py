"""Keysight Truevolt 34460A, 34461A, 34465A, 34470A: DC volts into memory, in their own identity or the 34401A's.

Over the 34401A's commands they take (SYSTem:IDENtify makes them answer as one), only autozero and input
impedance have moved under the function and the memory is larger; a reading has the same 15 characters.
Sources: see its facts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from drivers.facts import keysight_34461a as facts
from drivers.instruments.agilent_34401a import DIALECT_34401A, Agilent34401A, SingleChannelDialect
from drivers.interfaces import VoltmeterLimits

DIALECTS: Final = {
    model: SingleChannelDialect(
        "VOLT:DC:ZERO:AUTO", "VOLT:DC:IMP:AUTO", replace(VoltmeterLimits.of(facts), most_samples=samples)
    )
    for model, samples in facts.MEMORY_OF_MODEL.items()
} | {"34401A": DIALECT_34401A}


class Keysight34461A(Agilent34401A):
    """A `Voltmeter` with one signal. `interface` is "lan" (also for USB) or "gpib": it has no RS-232."""

    dialects = DIALECTS
    models = tuple(DIALECTS)
    called = "a 34460A, 34461A, 34465A or 34470A, nor one that emulates a 34401A"
    hint = "the meter's own is under Utility, I/O Config"
