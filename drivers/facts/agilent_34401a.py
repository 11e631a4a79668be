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
"""The settings for 8 data bits; with parity the meter sends 7."""

READING: Final = r"[+-]\d\.\d{8}E[+-]\d\d"
READING_EXAMPLE: Final = "+1.23456780E+00"
READING_CHARACTERS: Final = 16
"""15 characters of a reading and a separator."""
OVERLOAD_V: Final = 9.9e37
"""The reply for a reading outside the range."""
ERRORS_KEPT: Final = 20
SELF_TEST_S: Final = 30.0
"""Timeout: the longest self-test of these meters takes some 15 s."""
STAYS_REMOTE_S: Final = 300.0
"""An idle RS-232 meter stays remote for longer than this (it was local again after some ten minutes)."""

# --- measurement ------------------------------------------------------------------------------------

RANGES_V: Final = (0.1, 1.0, 10.0, 100.0, 1000.0)
OVER_RANGE: Final = 1.2
"""Every range but the highest reads up to 120 % of its nominal value."""
UNDER_RANGE: Final = 0.1
"""Below this fraction of a range autorange selects the next lower range."""
NPLC_BY_RESOLUTION: Final = {3e-7: 100.0, 1e-6: 10.0, 3e-6: 1.0, 1e-5: 0.2, 1e-4: 0.02}
"""Integration in power-line cycles for each resolution, a fraction of the range."""
RESOLUTION: Final = {nplc: part for part, nplc in NPLC_BY_RESOLUTION.items()}
"""The inverse table: the resolution for each integration."""
NPLC: Final = tuple(sorted(RESOLUTION))
MEMORY_READINGS: Final = 512
LEAST_SAMPLES: Final = 1

SAMPLE_OVERHEAD_S: Final = 0.01
"""Overhead of a sample in addition to its two integrations (autozero), s."""

ACCURACY_90_DAYS: Final = {
    0.1: (40e-6, 35e-6), 1.0: (30e-6, 7e-6), 10.0: (20e-6, 5e-6), 100.0: (35e-6, 6e-6), 1000.0: (35e-6, 10e-6),
}  # fmt: skip
"""Limits of error of DC volts by range, at 23 ± 5 °C: fractions of the reading and of the range."""
ACCURACY_1_YEAR: Final = {
    0.1: (50e-6, 35e-6), 1.0: (40e-6, 7e-6), 10.0: (35e-6, 5e-6), 100.0: (45e-6, 6e-6), 1000.0: (45e-6, 10e-6),
}  # fmt: skip
"""The same within a year of calibration."""
TEMPERATURE_COEFFICIENT: Final = {
    0.1: (5e-6, 5e-6), 1.0: (5e-6, 1e-6), 10.0: (5e-6, 1e-6), 100.0: (5e-6, 1e-6), 1000.0: (5e-6, 1e-6),
}  # fmt: skip
"""Increase of the limits for each °C outside 23 ± 5 °C, in the same units."""
REFERENCE_C: Final = 23.0
REFERENCE_WIDTH_C: Final = 5.0
LINEARITY: Final = (2e-6, 1e-6)
"""Limits of the converter's integral nonlinearity, fractions of the reading and of the range."""
