"""Facts about counters that send readings in the format of a Mitutoyo MUX-10 multiplexer.

Source: GageMux Operating Manual, page 7, "Mitutoyo Mux-10 Format": 0, channel, A, sign, eight characters of a
reading, CR, such as 01A-001.2340.

Not confirmed by a source: the request (assumed: the number of the channel and CR, as for other multiplexers); the
port as delivered; the codes of errors (the driver refuses every reply that is not a reading). The format has no
unit, reference mark or maker's name: the driver assumes degrees, and asks a person about the reference mark.
"""

from typing import Final

MAKER: Final = "Mitutoyo"
MODEL: Final = "MUX-10 format"
READ_TERMINATION: Final = "\r"
WRITE_TERMINATION: Final = "\r"
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip
"""Assumed settings of the port, not confirmed by a source."""
MOST_CHANNELS: Final = 4
VALUE_CHARACTERS: Final = 8
EXAMPLE: Final = "01A+045.0028"
