"""What is true of a rate table with an ACUTROL controller.

Sources: the public ACUTROL client of the maker's robotics group (`acutrol.py`, `ac117.json`), and its GPIB twin.
"""

from typing import Final

MAKER: Final = "Acutronic"
MODEL: Final = "ACUTROL"
"""It cannot be asked who it is: the form of its replies tells."""

TCP_PORT: Final = 9888
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r\n"
PREFIX_CHARACTERS: Final = 8
"""Every reply begins with a prefix of its own choice, so long."""

STARTUP_GAP_S: Final = 0.25
"""What the controller wants after each command of its start-up."""
MODE_GAP_S: Final = 0.5
"""What it wants after it has entered the position mode."""

DEMAND_DECIMALS: Final = 3
FINEST_DEMAND_DEG: Final = 0.5 * 10.0**-DEMAND_DECIMALS
"""How exactly a demand is taken: it has three decimals of a degree."""
STILL_DEG_S: Final = 0.005
"""Below this rate a table stands, unless a bench file says otherwise."""
