"""What is true of a chamber with a Watlow F4T controller.

Sources: Watlow F4T User's Guide, "SCPI commands"; TestEquity F4T manuals.
"""

from typing import Final

MAKER: Final = "Watlow"
MODEL: Final = "F4T"
IDENTITY: Final = r"F4T"
"""Searched for in the reply to *IDN?, any case."""

TCP_PORT: Final = 5025
"""SCPI; the port 502 that one edition of the guide prints is Modbus."""
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"

BUSY_S: Final = 1.0
"""Pause that the controller needs after a command without reply."""
RESOLUTION_C: Final = 0.1
MOST_LOOPS: Final = 4
MOST_OUTPUTS: Final = 99
SAFE_C: Final = 23.0
"""What a chamber without a switching output is set to after a run, unless a bench file says otherwise."""

FAHRENHEIT_PER_C: Final = 1.8
FAHRENHEIT_AT_0_C: Final = 32.0
