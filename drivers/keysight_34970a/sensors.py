"""Temperature sensors on a 34901A card: what each is called in commands, how exact it is with the meter.

Sources: 34970A User's Guide (34970-90003), chapter 4 "Temperature Measurements" (probe types; 4-wire: channel n
with n + 10), chapter 5 "CONFigure:TEMPerature", "[SENSe:]TEMPerature:TRANsducer"; chapter 8, specifications: RTD
±0.06 °C, thermistor ±0.08 °C beside the probe. Tolerances of probes: IEC 60751 class B, 0.30 °C + 0.005 |t|;
thermistors of the 44000 series, ±0.2 °C. The same commands stand in the 34980A's public help.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Sensor:
    """A probe: `configured` is what CONF:TEMP is told, `proved` are questions about a channel and their replies.

    `meter_c` and `probe_c` are limits of error, °C, the probe's grows by `probe_slope` with each degree from 0 °C.
    With four wires the second pair sits `pair` channels on.
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
"""By the name in a bench file."""
PAIRED: Final = range(1, 11)
"""The channels of a card that a four-wire measurement is named by; its sense wires are on those ten higher."""
OPEN_C: Final = 9.0e37
