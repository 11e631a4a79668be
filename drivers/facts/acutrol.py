"""What is true of a rate table with an ACUTROL controller.

Sources: the public ACUTROL client of the maker's robotics group (`acutrol.py`, `ac117.json`), and its GPIB twin.
"""

from typing import Final

MAKER: Final = "Acutronic"
MODEL: Final = "ACUTROL"
"""The controller has no query of its identity; the form of its replies identifies it."""

TCP_PORT: Final = 9888
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r\n"
PREFIX_CHARACTERS: Final = 8
"""Every reply begins with a prefix of its own choice, so long."""

STARTUP_GAP_S: Final = 0.25
"""Pause that the controller needs after each command of its start-up, s."""
MODE_GAP_S: Final = 0.5
"""Pause that the controller needs after it has entered the position mode, s."""

DEMAND_DECIMALS: Final = 3
FINEST_DEMAND_DEG: Final = 0.5 * 10.0**-DEMAND_DECIMALS
"""Resolution of a demand: three decimals of a degree."""
STILL_DEG_S: Final = 0.005
"""Below this rate a table stands, unless a bench file says otherwise."""
