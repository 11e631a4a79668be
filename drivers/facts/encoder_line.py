"""What is true of a counter that answers a request with one line of text: nothing but what its bench file says.

The port is that of most serial adapters; a counter that is set otherwise is set to it, or has its baud rate stated.
"""

from typing import Final

MODEL: Final = "a line of text"
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r\n"
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip
ANGLE: Final = "angle"
"""The named group of a pattern that holds the number."""
ENDS: Final = {"CR": "\r", "LF": "\n", "CR LF": "\r\n"}
PER_TURN: Final = {"degrees": 360.0, "arcsec": 1296000.0}
"""How many of a unit are a turn; of counts the bench file says it."""
