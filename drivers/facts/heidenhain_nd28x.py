"""Facts about a Heidenhain ND 281B or ND 287 display unit at its RS-232-C port (X31).

Sources: ND 281B User's Manual, pages 47 (data format, control characters), 61 and 62 (commands); ND 287 User's
Manual, pages 102 (control characters) and 108 (commands); ND 287 Operating Instructions 07/2016, page 6 (status
display). The codes of the commands and the status bar of the ND 287 are from two public programs that agree, one
for the ND 287, one for the ND 760 and ND 780; the manuals describe the commands in the same order.

Not confirmed by a source:
- the baud rate as delivered, and the list of rates (38400 is in the manual of the ND 221B);
- the length of the indicators of an ND 287 and which of them is REF (so none of them may blink);
- whether REF of an ND 281B that waits for its reference mark is dark, blinks or glows (so the driver requires that
  it glows and that the display shows a number; after switch-on the unit displays and sends a question);
- the texts that the unit displays and sends in place of a value after errors of signal or count;
- the sign of a positive value, + or a blank;
- a command that shows whether an ND 281B measures in degrees or millimetres (only inches are indicated).
STX (Ctrl B) requests the measured value in a form that depends on unit, sorting and series. ENQ (Ctrl E) requests
an error message in a form that is not confirmed. The driver uses neither; it queries the display.
"""

from typing import Final

MAKER: Final = "HEIDENHAIN"
MODELS: Final = ("ND-281B", "ND-287")

# --- messages ---------------------------------------------------------------------------------------

STX: Final = "\x02"
"""The first character of each reply."""
NAK: Final = "\x15"
"""The reply to an unknown command."""
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r"
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 7, "parity": "even", "stop_bits": 2, "flow": "xon_xoff", "device_clear": b"",
}  # fmt: skip
"""Settings of the port; the baud rate is not confirmed by a source. The unit sends XOFF when its buffer holds 100
characters.
"""
BAUD_RATES: Final = (110, 150, 300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)

ASK_DEVICE: Final = "\x1bA0000"
ASK_DISPLAY: Final = "\x1bA0100"
ASK_SOFTWARE: Final = "\x1bA0400"
ASK_STATUS_BAR: Final = "\x1bA0800"
"""Request for the status bar (ND 287 only); the reply has eight digits."""
ASK_INDICATORS: Final = "\x1bA0900"

DEVICE_LINES: Final = 3
"""Lines in the reply to `ASK_DEVICE`: name, software number, and date (ND 281B) or version (ND 287)."""

# --- what is shown ----------------------------------------------------------------------------------

SHORTEST_VALUE: Final = 10
LONGEST_VALUE: Final = 13
"""Shortest and longest length of a value in characters, with sign and decimal point."""
DARK: Final = "0"
GLOWS: Final = "1"
BLINKS: Final = "2"
"""The three constants above are the states of an indicator in the reply to `ASK_INDICATORS`."""
INDICATORS_281B: Final = 14
REF_281B: Final = 0
INCH_281B: Final = 6
"""Number of indicators of an ND 281B, and the positions of two of them in the reply to `ASK_INDICATORS`."""
MODE: Final = 0
SCALING: Final = 2
UNIT: Final = 5
"""The three constants above are positions of digits in the status bar of an ND 287."""
ACTUAL_VALUE: Final = "0"
UNSCALED: Final = "0"
DEGREES: Final = "2"
"""The digit `UNIT` for decimal degrees; 3 means degrees, minutes and seconds."""
