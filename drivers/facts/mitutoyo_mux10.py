"""What is true of a counter whose reading comes as a Mitutoyo MUX-10 multiplexer sends it.

Source: GageMux Operating Manual, page 7, "Mitutoyo Mux-10 Format": 0, channel, A, sign, eight characters of a
reading, CR, such as 01A-001.2340.

Not confirmed by a source: the request (taken: the number of the channel and CR, as at other multiplexers); the
port as delivered; the codes of errors (any other reply is no reading). The form has no place for a unit, for a
reference mark or for the name of the maker: the driver assumes degrees, and a person is asked for the reference
mark.
"""

from typing import Final

MAKER: Final = "Mitutoyo"
MODEL: Final = "MUX-10 format"
READ_TERMINATION: Final = "\r"
WRITE_TERMINATION: Final = "\r"
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "none", "device_clear": b"",
}  # fmt: skip
"""Not confirmed by a source."""
MOST_CHANNELS: Final = 4
VALUE_CHARACTERS: Final = 8
EXAMPLE: Final = "01A+045.0028"
