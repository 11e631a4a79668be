"""Facts about rotary stages with a Zaber controller and its ASCII protocol.

Source: Zaber ASCII Protocol Manual, sections "Message Format", "Commands", "Device Settings", "Checksumming".
"""

from typing import Final

MAKER: Final = "Zaber"
IDENTITY: Final = r"\d+"
"""The pattern of a device id."""

TCP_PORT: Final = 55550
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\n"
SERIAL: Final = {
    "baud_rate": 115200, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip
"""Factory settings of a serial port; the protocol has no device clear."""

RESOLUTION: Final = 64
"""The setting `resolution`, in microsteps per full step; factory setting."""
MOST_STEPS: Final = 2**31 - 1
SPEED_UNITS: Final = 1.6384
"""The value of the setting `maxspeed` for a speed of 1 microstep/s."""
MOST_DEVICES: Final = 99
MOST_AXES: Final = 9
MOST_NUMBERS: Final = 99
"""The highest message number; the lowest is 1."""


def checksum(message: str) -> str:
    """Return the LRC of a message without its type character: two's complement of the sum, in hex."""
    return f"{-sum(message.encode('ascii', 'replace')) & 0xFF:02X}"
