"""Facts about the HP / Agilent / Keysight 34401A; the modules of related meters refer to them.

Sources: 34401A User's Guide (34401-90004), chapter 4, "SCPI command summary", "Output data formats",
"Triggering", "RS-232 interface configuration"; chapter 8, "DC characteristics".
"""

from typing import Final

# --- identity and communication ---------------------------------------------------------------------

MAKERS: Final = r"HEWLETT-PACKARD|HP|Agilent( Technologies)?|Keysight( Technologies)?"
MODELS: Final = ("34401A",)
IDENTITY: Final = "HEWLETT-PACKARD,34401A,0,11-5-2"
"""A reply to *IDN?."""

INTERFACES: Final = ("lan", "gpib", "rs232")
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"
BAUD_RATES: Final = (300, 600, 1200, 2400, 4800, 9600)
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 2, "flow": "dtr_dsr", "device_clear": b"\x03",
}  # fmt: skip
"""Settings of the serial port for 8 data bits; with parity the meter uses 7."""

READING: Final = r"[+-]\d\.\d{8}E[+-]\d\d"
READING_EXAMPLE: Final = "+1.23456780E+00"
READING_CHARACTERS: Final = 16
"""Length of a reading in a reply: 15 characters and a separator."""
OVERLOAD_V: Final = 9.9e37
"""The reply for a reading outside the range."""
ERRORS_KEPT: Final = 20
SELF_TEST_S: Final = 30.0
"""Timeout of a self-test, s; the longest of these meters takes some 15 s."""
STAYS_REMOTE_S: Final = 300.0
"""Idle time after which an RS-232 meter is set to remote again, s; after some ten minutes it returns to local."""

# --- measurement ------------------------------------------------------------------------------------

RANGES_V: Final = (0.1, 1.0, 10.0, 100.0, 1000.0)
OVER_RANGE: Final = 1.2
"""Largest reading as a fraction of the range, except in the highest range."""
UNDER_RANGE: Final = 0.1
"""Below this fraction of a range autorange selects the next lower range."""
NPLC_BY_RESOLUTION: Final = {3e-7: 100.0, 1e-6: 10.0, 3e-6: 1.0, 1e-5: 0.2, 1e-4: 0.02}
"""The integration time in power-line cycles by resolution, a fraction of the range."""
RESOLUTION: Final = {nplc: part for part, nplc in NPLC_BY_RESOLUTION.items()}
"""The resolution, a fraction of the range, by integration time in power-line cycles."""
NPLC: Final = tuple(sorted(RESOLUTION))
MEMORY_READINGS: Final = 512
LEAST_SAMPLES: Final = 1

SAMPLE_OVERHEAD_S: Final = 0.01
"""Time that a sample takes in addition to its two integrations (autozero), s."""

ACCURACY_90_DAYS: Final = {
    0.1: (40e-6, 35e-6), 1.0: (30e-6, 7e-6), 10.0: (20e-6, 5e-6), 100.0: (35e-6, 6e-6), 1000.0: (35e-6, 10e-6),
}  # fmt: skip
"""Limits of error of DC volts within 90 days at 23 ± 5 °C, by range: fractions of the reading and of the range."""
ACCURACY_1_YEAR: Final = {
    0.1: (50e-6, 35e-6), 1.0: (40e-6, 7e-6), 10.0: (35e-6, 5e-6), 100.0: (45e-6, 6e-6), 1000.0: (45e-6, 10e-6),
}  # fmt: skip
"""Limits of error as in `ACCURACY_90_DAYS`, within a year of calibration."""
TEMPERATURE_COEFFICIENT: Final = {
    0.1: (5e-6, 5e-6), 1.0: (5e-6, 1e-6), 10.0: (5e-6, 1e-6), 100.0: (5e-6, 1e-6), 1000.0: (5e-6, 1e-6),
}  # fmt: skip
"""Increase of these limits for each °C outside 23 ± 5 °C: fractions of the reading and of the range."""
REFERENCE_C: Final = 23.0
REFERENCE_WIDTH_C: Final = 5.0
LINEARITY: Final = (2e-6, 1e-6)
"""Limits of the converter's integral nonlinearity, fractions of the reading and of the range."""
