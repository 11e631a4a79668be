"""Facts about chambers with a Thermotron 8800, 8200, 3800 or 2800 controller.

Source: Thermotron 8800 computer interface manual, as quoted in public drivers.
"""

from typing import Final

MAKER: Final = "Thermotron"
IDENTITY: Final = r"2800|3800|8200|8800"
"""Pattern searched for in the reply to IDEN?."""

TCP_PORT: Final = 8888
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"
"""The line termination; that of an 8200 is CR."""
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip

BUSY_S: Final = 1.0
"""Time after a command without reply during which the controller ignores commands, s."""
RESOLUTION_C: Final = 0.1

# bits of MODE?
STOPPED: Final = 2
MANUAL: Final = 16
