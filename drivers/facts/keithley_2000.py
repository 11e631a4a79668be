"""Facts about the Keithley 2000.

Only the manual's pages on the serial port and on linearity, noise and overrange were available; commands and reply
formats follow public drivers of the meter. Numbers from other sources are marked.

Sources: Model 2000 User's Manual (2000-900-01), section 4 "RS-232 operation", section 5 "SCPI command reference",
appendix A "Specifications"; Model 2000 data sheet.
"""

from typing import Final

# --- identity and communication ---------------------------------------------------------------------

MAKERS: Final = r"KEITHLEY INSTRUMENTS( INC\.?)?"
MODELS: Final = ("MODEL 2000",)
IDENTITY: Final = "KEITHLEY INSTRUMENTS INC.,MODEL 2000,1308393,A20  /A02"
"""A reply to *IDN?: maker, model, serial number, and the firmware of digital board and display."""

INTERFACES: Final = ("gpib", "rs232")
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"
"""Line termination on GPIB, sent with EOI."""
TERMINATORS: Final = {"lf": "\n", "cr": "\r", "crlf": "\r\n", "lfcr": "\n\r"}
"""The line terminations that can be selected for RS-232 (SHIFT RS232, TX TERM)."""
BAUD_RATES: Final = (300, 600, 1200, 2400, 4800, 9600, 19200)
SERIAL: Final = {
    "baud_rate": 4800, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"\x03",
}  # fmt: skip
"""Factory settings of RS-232; the character format is fixed. Select no flow control at the meter."""

READING: Final = r"(?:[+-]\d\.\d{4,8}E[+-]\d\d|[+-]9\.9(?:0*E\+?37))"
"""One reading with FORMat:ELEMents READing. The manual shows 8 decimals; fewer are accepted, as the two digits of
the exponent end the reading. An overflow is shorter: `+9.9E37`."""
READING_EXAMPLE: Final = "+1.23456789E-03"
READING_CHARACTERS: Final = 16
"""Length of a reading in a reply: 15 characters and a separator."""
OVERLOAD_V: Final = 9.9e37
"""The reply for a reading outside the range."""
ERRORS_KEPT: Final = 10

# --- measurement ------------------------------------------------------------------------------------

RANGES_V: Final = (0.1, 1.0, 10.0, 100.0, 1000.0)
HIGHEST_V: Final = 1010.0
"""The largest expected signal that a command may state, V."""
OVER_RANGE: Final = 1.2
"""Largest reading as a fraction of the range, except in the highest range."""
UNDER_RANGE: Final = 0.1
"""Below this fraction of a range autorange selects the next lower range."""
NPLC: Final = (0.01, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""The integration times offered, in power-line cycles; the meter accepts any value from 0.01 to 10."""
LEAST_SAMPLES: Final = 2
MEMORY_READINGS: Final = 1024
"""The largest size of the buffer, in readings; the smallest is 2."""
RESOLUTION: Final = {1.0: 1e-6, 0.1: 1e-5, 0.01: 1e-4}
"""The resolution, a fraction of the range, from this NPLC on: 6 1/2, 5 1/2, 4 1/2 digits."""

SAMPLE_OVERHEAD_S: Final = 0.04
"""Time of a sample beyond its two integrations, s: the data sheet states 5 readings/s at 10 cycles of 60 Hz."""

ACCURACY_90_DAYS: Final = {
    0.1: (40e-6, 35e-6), 1.0: (25e-6, 7e-6), 10.0: (20e-6, 5e-6), 100.0: (30e-6, 6e-6), 1000.0: (35e-6, 6e-6),
}  # fmt: skip
"""Limits of error of DC volts by range, 1 or 10 cycles, at 23 ± 5 °C: fractions of the reading and of the range.

From the table of the Model 2016, which has the same converter; it agrees with the known part of the 2000's table.
"""
ACCURACY_1_YEAR: Final = {10.0: (30e-6, 5e-6)}
"""Limits of error within a year of calibration, known for one range only: from the service manual of the Model
2015, which has the same converter.
"""
TEMPERATURE_COEFFICIENT: Final = {
    0.1: (2e-6, 6e-6), 1.0: (2e-6, 1e-6), 10.0: (2e-6, 1e-6), 100.0: (5e-6, 1e-6), 1000.0: (5e-6, 1e-6),
}  # fmt: skip
"""Increase of the 90-day limits for each °C outside 23 ± 5 °C, from the table of the Model 2016."""
REFERENCE_C: Final = 23.0
REFERENCE_WIDTH_C: Final = 5.0
LINEARITY: Final = (2e-6, 1e-6)
"""Limits of nonlinearity of the 10 V range, fractions of the reading and of the range (a later data sheet of the
2000 prints the two numbers in the opposite order)."""
