"""Facts about the Leica Nivel210 (RS-232) and Nivel220 (RS-485) two-axis inclination sensors.

Sources: NIVEL200 Technical Reference Manual 1.0 (748340), chapters 2 (blocks, check sum, worked examples), 3,
4 and 6, appendix A; NIVEL200 User Manual, chapters 4.2 (offset by half a turn) and 8 (technical data). The
public program DfAC/Nivel includes both manuals and a log of a real sensor; the public library
applied-geodesy/nivel sends the same commands. `G P` reports a sensor out of range; the manuals do not state
which X and Y such a sensor sends.
"""

from typing import Final

MAKER: Final = "Leica"
MODEL: Final = "Nivel200"

# --- blocks -----------------------------------------------------------------------------------------

START: Final = "\x16\x02"
"""The beginning of a block: <SYN><STX>."""
END: Final = "\x03"
"""The end of a block's text: <ETX>. The two bytes of the check sum follow."""
READ_TERMINATION: Final = END
READ_TAIL: Final = 2
WRITE_TERMINATION: Final = "\r\n"
"""Two characters sent in place of a check sum, because the sensor accepts any."""
HOST: Final = "C1"
"""The address of the computer."""
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip
BAUD_RATES: Final = (1200, 2400, 9600, 19200, 38400)
SLOWEST_REPLY_S: Final = 2.0
"""The sensor replies within 0.1 to 2 s; send nothing before its reply."""

# --- measurement ------------------------------------------------------------------------------------

MRAD: Final = 1e-3
RESOLUTION_RAD: Final = 1e-6
RANGE_RAD: Final = 3.00e-3
"""Measuring range, rad: range C, the widest."""
ACCURACY_RAD: Final = ((1.51e-3, 4.7e-6), (2.51e-3, 14.1e-6), (3.00e-3, 47.1e-6))
"""Upper ends of the ranges A, B and C, rad, each with the standard deviation of an angle in this range, rad."""
SCALE_ERROR: Final = 0.005
DIRECTION_ERROR_DEG: Final = 1.0
ORTHOGONAL_ERROR_DEG: Final = 2.0
"""Limits of error: of the scale, of the axes against the edge of the case, of one axis against the other."""
ZERO_RAD_PER_K: Final = 4.71e-6
AVERAGES: Final = 8
MOST_AVERAGES: Final = 128
"""Number of measurements, one per second, averaged in each value: factory setting and maximum."""


def check_sum(said: str) -> bytes:
    """Return the 16-bit check sum of a block, high byte first.

    `said` is the text of the block between <STX> and <ETX>.
    """
    return (sum(said.encode("ascii", "replace")) & 0xFFFF).to_bytes(2, "big")
