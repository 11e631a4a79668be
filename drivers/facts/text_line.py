"""Facts about instruments that answer a request with one line of text; the bench file states all else.

The port has the settings of most serial adapters: set the instrument to these, or state its baud rate.
"""

from typing import Final

MODEL: Final = "a line of text"
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r\n"
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip
ANGLE: Final = "angle"
TEMPERATURE: Final = "temperature"
"""The named group of a pattern for the number: `ANGLE` for a counter, `TEMPERATURE` for a thermometer."""
ENDS: Final = {"CR": "\r", "LF": "\n", "CR LF": "\r\n"}
PER_TURN: Final = {"degrees": 360.0, "arcsec": 1296000.0}
"""Number of each unit in a turn; for counts the bench file states it."""
