"""What is true of a Leica Nivel210 (RS-232) or Nivel220 (RS-485) two-axis inclination sensor.

Sources: NIVEL200 Technical Reference Manual 1.0 (748340), chapters 2 (blocks, check sum, worked examples), 3, 4
and 6, appendix A; NIVEL200 User Manual, chapters 4.2 (offset by half a turn) and 8 (technical data). Both and a log
of a real one stand with the public program DfAC/Nivel; the public library applied-geodesy/nivel sends the same.
Not in them: what a sensor that is out of its range puts into X and Y; that is asked by `G P`.
"""

from typing import Final

MAKER: Final = "Leica"
MODEL: Final = "Nivel200"

# --- blocks -----------------------------------------------------------------------------------------

START: Final = "\x16\x02"
"""<SYN><STX> begins a block."""
END: Final = "\x03"
"""<ETX> ends what is said; the two bytes of the check sum follow."""
READ_TERMINATION: Final = END
READ_TAIL: Final = 2
WRITE_TERMINATION: Final = "\r\n"
"""It takes any two characters for a check sum."""
HOST: Final = "C1"
"""The address of the computer."""
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip
BAUD_RATES: Final = (1200, 2400, 9600, 19200, 38400)
SLOWEST_REPLY_S: Final = 2.0
"""It answers within 0.1 to 2 s, and is not to be spoken to before."""

# --- what it measures -------------------------------------------------------------------------------

MRAD: Final = 1e-3
RESOLUTION_RAD: Final = 1e-6
RANGE_RAD: Final = 3.00e-3
"""Range C, the widest."""
ACCURACY_RAD: Final = ((1.51e-3, 4.7e-6), (2.51e-3, 14.1e-6), (3.00e-3, 47.1e-6))
"""Ranges A, B, C with the standard deviation of an angle in each."""
SCALE_ERROR: Final = 0.005
DIRECTION_ERROR_DEG: Final = 1.0
ORTHOGONAL_ERROR_DEG: Final = 2.0
"""Limits: of the scale, of the axes against the edge of the case, of one axis against the other."""
ZERO_RAD_PER_K: Final = 4.71e-6
AVERAGES: Final = 8
MOST_AVERAGES: Final = 128
"""Of so many measurements, one a second, each value is the mean: as delivered, and at most."""


def check_sum(said: str) -> bytes:
    """Return the sum of the characters from the addressee to the end of what is said, 16 bits, high byte first."""
    return (sum(said.encode("ascii", "replace")) & 0xFFFF).to_bytes(2, "big")
