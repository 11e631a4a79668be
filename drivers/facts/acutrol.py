"""Facts about rate tables with an ACUTROL controller.

Sources: the public ACUTROL client of the maker's robotics group (`acutrol.py`, `ac117.json`), and its GPIB version.
"""

from typing import Final

MAKER: Final = "Acutronic"
MODEL: Final = "ACUTROL"
"""The controller has no identity query; the format of its replies identifies it."""

TCP_PORT: Final = 9888
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r\n"
PREFIX_CHARACTERS: Final = 8
"""Length of the prefix of every reply; its characters are arbitrary."""

STARTUP_GAP_S: Final = 0.25
"""Pause that the controller needs after each command of its start-up, s."""
MODE_GAP_S: Final = 0.5
"""Pause that the controller needs after it has entered the position mode, s."""

DEMAND_DECIMALS: Final = 3
FINEST_DEMAND_DEG: Final = 0.5 * 10.0**-DEMAND_DECIMALS
"""Largest rounding error of a demand, which has three decimals of a degree."""
STILL_DEG_S: Final = 0.005
"""A table slower than this rate counts as at rest, unless the bench file states another rate."""
