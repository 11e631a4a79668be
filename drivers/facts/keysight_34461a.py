"""Facts about the Keysight Truevolt 34460A, 34461A, 34465A, 34470A where they differ from a 34401A.

The integration times of the 34465A and 34470A are limited to those that all models share.
Sources: Truevolt Series Operating and Service Guide, "CONFigure", "SENSe:VOLTage", "FETCh?", "SYSTem:IDENtify",
"Measurement specifications".
"""

from typing import Final

from drivers.facts import agilent_34401a as line

MODEL: Final = "34461A"
IDENTITY: Final = "Keysight Technologies,34461A,MY53200001,A.02.17-02.40-02.17-00.52-04-01"
"""A reply to *IDN?."""
INTERFACES: Final = ("lan", "gpib")
"""The meters have no RS-232; "lan" includes USB."""

MEMORY_OF_MODEL: Final = {"34461A": 10_000, "34460A": 1_000, "34465A": 50_000, "34470A": 50_000}
"""The memory of each model without the memory option, in readings; later readings overwrite the oldest."""
MEMORY_READINGS: Final = MEMORY_OF_MODEL[MODEL]
MOST_SAMPLES: Final = 1_000_000
"""The most samples per trigger, even if the memory cannot hold them all."""

READ_TERMINATION: Final = line.READ_TERMINATION
WRITE_TERMINATION: Final = line.WRITE_TERMINATION
RANGES_V: Final = line.RANGES_V
OVER_RANGE: Final = line.OVER_RANGE
NPLC: Final = line.NPLC
RESOLUTION: Final = line.RESOLUTION
LEAST_SAMPLES: Final = line.LEAST_SAMPLES
ACCURACY_90_DAYS: Final = line.ACCURACY_90_DAYS
ACCURACY_1_YEAR: Final = line.ACCURACY_1_YEAR
LINEARITY: Final = line.LINEARITY
