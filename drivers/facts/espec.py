"""Facts about Espec chambers with a P300 or SCP-220 controller.

Sources: Espec P300 and SCP-220 communication manuals, as quoted in ChamberConnectLibrary (`especinteract.py`,
`p300.py`).
"""

from typing import Final

MAKER: Final = "ESPEC"
IDENTITY: Final = r"[EP]S?-?[123]\d\d|SCP-?220"
"""The pattern of the controller's name in the reply to TYPE?."""

TCP_PORT: Final = 10001
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r\n"
SERIAL: Final = {
    "baud_rate": 19200, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip
"""Factory settings of a P300's serial port; an SCP-220 has 9600 baud."""

RESOLUTION_C: Final = 0.1
