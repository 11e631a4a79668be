"""Facts about the HP / Agilent / Keysight 34970A and 34972A with 34901A cards where they differ from a 34401A.

Sources: 34970A User's Guide (34970-90003), chapter 4 "Scanning", "DC Voltage"; chapter 5, "The CONFigure
Command", "Scanning Commands", "Reading Format Commands", "SYSTem:CTYPe?"; chapter 8, specifications; data sheet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from drivers.facts import agilent_34401a as line

# --- identity and communication ---------------------------------------------------------------------

MODELS: Final = ("34970A", "34972A")
IDENTITIES: Final = {
    "34970A": "HEWLETT-PACKARD,34970A,0,13-2-2",
    "34972A": "Agilent Technologies,34972A,MY49000001,1.16-1.12-02-02",
}
"""Replies to *IDN?; only the 34972A has a LAN interface."""
INTERFACES: Final = line.INTERFACES
READ_TERMINATION: Final = line.READ_TERMINATION
WRITE_TERMINATION: Final = line.WRITE_TERMINATION
SERIAL: Final = line.SERIAL
BAUD_RATES: Final = (1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)

# --- measurement ------------------------------------------------------------------------------------

RANGES_V: Final = (0.1, 1.0, 10.0, 100.0, 300.0)
OVER_RANGE: Final = line.OVER_RANGE
UNDER_RANGE: Final = line.UNDER_RANGE
NPLC_BY_RESOLUTION: Final = {
    2.2e-7: 200.0, 3e-7: 100.0, 8e-7: 20.0, 1e-6: 10.0, 2.2e-6: 2.0, 3e-6: 1.0, 1e-5: 0.2, 1e-4: 0.02,
}  # fmt: skip
RESOLUTION: Final = {nplc: part for part, nplc in NPLC_BY_RESOLUTION.items()}
NPLC: Final = tuple(sorted(RESOLUTION))
MEMORY_READINGS: Final = 50_000
"""Size of the memory, in readings; all channels share it."""
LEAST_SAMPLES: Final = line.LEAST_SAMPLES

SAMPLE_OVERHEAD_S: Final = 0.03
"""Time of a sample beyond its integrations, s: relay and meter; a card scans at most 60 channels/s."""

_SHARED: Final = RANGES_V[:-1]
ACCURACY_90_DAYS: Final = {r: line.ACCURACY_90_DAYS[r] for r in _SHARED} | {300.0: (35e-6, 20e-6)}
ACCURACY_1_YEAR: Final = {r: line.ACCURACY_1_YEAR[r] for r in _SHARED}
"""Limits of error within a year of calibration; those of the 300 V range were not available."""
TEMPERATURE_COEFFICIENT: Final = {r: line.TEMPERATURE_COEFFICIENT[r] for r in _SHARED} | {300.0: (5e-6, 3e-6)}
REFERENCE_C: Final = line.REFERENCE_C
REFERENCE_WIDTH_C: Final = line.REFERENCE_WIDTH_C
LINEARITY: Final = line.LINEARITY

# --- its cards --------------------------------------------------------------------------------------

CARD: Final = "34901A"
SLOTS: Final = (1, 2, 3)
CARD_CHANNELS: Final = tuple(range(1, 21))
CURRENT_CHANNELS: Final = (21, 22)
CHANNELS_TEXT: Final = "101 to 120, 201 to 220, 301 to 320"
"""The channels for volts of a 34901A in slots 1, 2 and 3."""
LONGEST_CHANNEL_DELAY_S: Final = 60.0
CHANNEL_DELAY_STEP_S: Final = 1e-3
"""Resolution of the channel delay, the time from the closing of a relay to its sample."""
CHANNEL_DELAY_S: Final = 0.1
"""The default channel delay of a bench file."""


# --- temperature sensors ----------------------------------------------------------------------------
# Sources: 34970A User's Guide (34970-90003), chapter 4 "Temperature Measurements" (probe types; 4-wire: channel n
# with n + 10), chapter 5 "CONFigure:TEMPerature", "[SENSe:]TEMPerature:TRANsducer"; chapter 8, specifications: RTD
# ±0.06 °C, thermistor ±0.08 °C, without the probe. Tolerances of probes: IEC 60751 class B, 0.30 °C + 0.005 |t|;
# thermistors of the 44000 series, ±0.2 °C. The 34980A's public help documents the same commands.


@dataclass(frozen=True, slots=True)
class Sensor:
    """A temperature sensor: `configured` is the argument of CONF:TEMP that selects it.

    `proved` lists queries with the replies that confirm this configuration. The limit of error, °C, is
    `meter_c` for the meter. For the sensor it is `probe_c`, plus `probe_slope` per degree from 0 °C. A
    four-wire sensor has its sense wires `pair` channels higher; for two wires `pair` is 0.
    """

    words: str
    configured: str
    proved: tuple[tuple[str, str | float], ...]
    range_c: tuple[float, float]
    meter_c: float
    probe_c: float
    probe_slope: float = 0.0
    pair: int = 0


def _thermistor(ohms: int) -> Sensor:
    return Sensor(
        f"thermistor of {ohms / 1000:g} kΩ", f"THER,{ohms}",
        (("TEMP:TRAN:TYPE?", "THER"), ("TEMP:TRAN:THER:TYPE?", float(ohms))), (-80.0, 150.0), 0.08, 0.2,
    )  # fmt: skip


def _resistance(kind: str, words: str, pair: int) -> Sensor:
    proved = (("TEMP:TRAN:TYPE?", kind), (f"TEMP:TRAN:{kind}:TYPE?", 85.0), (f"TEMP:TRAN:{kind}:RES?", 100.0))
    return Sensor(words, f"{kind},85", proved, (-200.0, 600.0), 0.06, 0.3, 0.005, pair)


SENSORS: Final = {
    "pt100": _resistance("FRTD", "Pt100, four wires", 10),
    "pt100-two-wire": _resistance("RTD", "Pt100, two wires", 0),
    "thermistor-2252": _thermistor(2252),
    "thermistor-5k": _thermistor(5000),
    "thermistor-10k": _thermistor(10000),
}
"""The probes by their names in a bench file."""
PAIRED: Final = range(1, 11)
"""The channels of a card that may measure with four wires; the sense wires are ten channels higher."""
OPEN_C: Final = 9.0e37
