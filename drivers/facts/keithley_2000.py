"""What is true of a Keithley 2000.

Of the sources the pages on the serial port and on linearity, noise and overrange were at hand; commands and forms
of replies are as public drivers of the meter have them. Where a number comes from elsewhere, it says so.

Sources: Model 2000 User's Manual (2000-900-01), section 4 "RS-232 operation", section 5 "SCPI command reference",
appendix A "Specifications"; Model 2000 data sheet.
"""

from typing import Final

# --- who it is, and how it speaks -------------------------------------------------------------------

MAKERS: Final = r"KEITHLEY INSTRUMENTS( INC\.?)?"
MODELS: Final = ("MODEL 2000",)
IDENTITY: Final = "KEITHLEY INSTRUMENTS INC.,MODEL 2000,1308393,A20  /A02"
"""What one answers to *IDN?: the serial number, the firmware of the digital board and of the display."""

INTERFACES: Final = ("gpib", "rs232")
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"
"""On GPIB, with EOI."""
TERMINATORS: Final = {"lf": "\n", "cr": "\r", "crlf": "\r\n", "lfcr": "\n\r"}
"""What its RS-232 may be set to end its lines with (SHIFT RS232, TX TERM)."""
BAUD_RATES: Final = (300, 600, 1200, 2400, 4800, 9600, 19200)
SERIAL: Final = {
    "baud_rate": 4800, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"\x03",
}  # fmt: skip
"""As shipped; the format is fixed. The flow may be XON/XOFF or none, and is to be set to none."""

READING: Final = r"(?:[+-]\d\.\d{4,8}E[+-]\d\d|[+-]9\.9(?:0*E\+?37))"
"""One reading with FORMat:ELEMents READing. The manual shows 8 decimals; fewer are taken, too: the two digits of
the exponent are its end. An overflow is printed short."""
READING_EXAMPLE: Final = "+1.23456789E-03"
READING_CHARACTERS: Final = 16
"""The 15 of a reading and its separator."""
OVERLOAD_V: Final = 9.9e37
"""The reply for a reading outside the range."""
ERRORS_KEPT: Final = 10

# --- what it measures -------------------------------------------------------------------------------

RANGES_V: Final = (0.1, 1.0, 10.0, 100.0, 1000.0)
HIGHEST_V: Final = 1010.0
"""The largest expected signal that may be stated."""
OVER_RANGE: Final = 1.2
"""It reads up to 120 % of its range, but of the highest."""
UNDER_RANGE: Final = 0.1
"""Below this part of its range autorange takes the next lower one."""
NPLC: Final = (0.01, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Integration in power-line cycles: it takes any from 0.01 to 10; these are to choose from."""
LEAST_SAMPLES: Final = 2
MEMORY_READINGS: Final = 1024
"""The buffer holds 2 to 1024 readings."""
RESOLUTION: Final = {1.0: 1e-6, 0.1: 1e-5, 0.01: 1e-4}
"""Resolution, a fraction of the range, from an integration on: 6 1/2, 5 1/2, 4 1/2 digits."""

SAMPLE_OVERHEAD_S: Final = 0.04
"""Around a sample beside its two integrations: the data sheet has 5 readings a second of 10 cycles of 60 Hz."""

ACCURACY_90_DAYS: Final = {
    0.1: (40e-6, 35e-6), 1.0: (25e-6, 7e-6), 10.0: (20e-6, 5e-6), 100.0: (30e-6, 6e-6), 1000.0: (35e-6, 6e-6),
}  # fmt: skip
"""Limits of error of DC volts by range, 1 or 10 cycles, at 23 ± 5 °C: parts of the reading and of the range.

Read in the table of the Model 2016, which has the same converter; that of the 2000 agrees as far as it was known.
"""
ACCURACY_1_YEAR: Final = {10.0: (30e-6, 5e-6)}
"""Within a year of its calibration, of the range that was at hand: from the service manual of the Model 2015, which
has the same converter."""
TEMPERATURE_COEFFICIENT: Final = {
    0.1: (2e-6, 6e-6), 1.0: (2e-6, 1e-6), 10.0: (2e-6, 1e-6), 100.0: (5e-6, 1e-6), 1000.0: (5e-6, 1e-6),
}  # fmt: skip
"""Increase of the limits for each °C outside 23 ± 5 °C, in the same units; from the same table."""
REFERENCE_C: Final = 23.0
REFERENCE_WIDTH_C: Final = 5.0
LINEARITY: Final = (2e-6, 1e-6)
"""Limits of nonlinearity of the 10 V range, parts of the reading and of the range (a later data sheet of the 2000
prints these two numbers the other way round)."""
