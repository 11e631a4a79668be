"""Facts about chambers with a Watlow F4T controller.

Sources: Watlow F4T User's Guide, "SCPI commands"; TestEquity F4T manuals.
"""

from typing import Final

MAKER: Final = "Watlow"
MODEL: Final = "F4T"
IDENTITY: Final = r"F4T"
"""Pattern searched for in the reply to *IDN?, in upper or lower case."""

TCP_PORT: Final = 5025
"""The SCPI port; port 502 in one edition of the guide is Modbus."""
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"

BUSY_S: Final = 1.0
"""Pause that the controller needs after a command without reply, s."""
RESOLUTION_C: Final = 0.1
MOST_LOOPS: Final = 4
MOST_OUTPUTS: Final = 99
SAFE_C: Final = 23.0
"""Set point after a run, °C, of a chamber without a switching output, unless the bench file states another."""

FAHRENHEIT_PER_C: Final = 1.8
FAHRENHEIT_AT_0_C: Final = 32.0
