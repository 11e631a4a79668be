"""What is true of a Newport ESP301 motion controller; an ESP300 speaks the same.

Sources: commands and table of errors as in the public clients InstrumentKit (`newportesp301.py`) and pymeasure
(`esp300.py`). That a command ends in CR and a reply in CR LF, and that commands joined by `;` answer a line each,
is from public programs for an ESP301 with its replies noted beside (`113, 314883, AXIS-1 MOTOR NOT ENABLED` to
`TB?`). An ESP300 was seen to answer `ESP300 Version 3.04 07/27/01` to `*IDN?`, over RS-232 only with RTS/CTS.
Of none of them, but of the ESP301 User's Manual as it is remembered, and so to be confirmed at the first one: the
motors are off after it was switched on, a unit is a label alone, the error buffer holds ten messages.
"""

from typing import Final

MAKER: Final = "Newport"
IDENTITY: Final = r"ESP30[01]"
"""The pattern of the model in the reply to *IDN?."""

READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\r"
SERIAL: Final = {
    "baud_rate": 19200, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "rts_cts",
    "device_clear": b"",
}  # fmt: skip
"""How RS-232 speaks as delivered; the protocol knows no device clear."""
BAUD_RATES: Final = (19200, 921600)
"""RS-232; USB, which the computer has as a serial port."""

MOST_AXES: Final = 3
DEGREES: Final = 7
"""The code of the unit degree (`SN?`). It is a label: to change it converts no speed and no limit."""
DEMAND_DECIMALS: Final = 6
MOST_ERRORS: Final = 10
"""So many messages its error buffer holds; `TB?` takes the oldest out."""
NO_ERROR: Final = 0
AXIS_ERRORS: Final = 100
"""An error of an axis is the number of the axis times this, and one of its codes below."""

# errors of the controller
UNKNOWN_COMMAND: Final = 6
BAD_PARAMETER: Final = 7
NO_SUCH_AXIS: Final = 9
AXIS_MISSING: Final = 37
PARAMETER_MISSING: Final = 38

# errors of an axis
FOLLOWING_ERROR: Final = 3
LIMITS: Final = (4, 5, 6, 7)
"""The hardware's, positive and negative, the software's."""
NOT_CONNECTED: Final = 8
TOO_FAST: Final = 10
MOTOR_OFF: Final = 13

MESSAGES: Final = {
    NO_ERROR: "NO ERROR DETECTED",
    UNKNOWN_COMMAND: "COMMAND DOES NOT EXIST",
    BAD_PARAMETER: "PARAMETER OUT OF RANGE",
    NO_SUCH_AXIS: "AXIS NUMBER OUT OF RANGE",
    AXIS_MISSING: "AXIS NUMBER MISSING",
    PARAMETER_MISSING: "COMMAND PARAMETER MISSING",
}
AXIS_MESSAGES: Final = {
    FOLLOWING_ERROR: "FOLLOWING ERROR THRESHOLD EXCEEDED",
    LIMITS[2]: "POSITIVE SOFTWARE LIMIT DETECTED",
    LIMITS[3]: "NEGATIVE SOFTWARE LIMIT DETECTED",
    TOO_FAST: "MAXIMUM VELOCITY EXCEEDED",
    MOTOR_OFF: "MOTOR NOT ENABLED",
}
