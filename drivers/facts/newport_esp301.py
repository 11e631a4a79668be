"""Facts about the Newport ESP301 motion controller; an ESP300 uses the same commands.

Sources: commands and error table from the public clients InstrumentKit (`newportesp301.py`) and pymeasure
(`esp300.py`). Public programs for an ESP301, which quote its replies (`113, 314883, AXIS-1 MOTOR NOT ENABLED`
to `TB?`), show the terminations (CR after a command, CR LF after a reply) and that commands joined by `;`
have one reply line each. An ESP300 replied `ESP300 Version 3.04 07/27/01` to `*IDN?`, over RS-232 only with
RTS/CTS. From memory of the ESP301 User's Manual, so confirm on the first instrument: the motors are off after
power-on, a unit is only a label, the error buffer holds ten messages.
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
"""Factory settings of RS-232; the protocol has no device clear."""
BAUD_RATES: Final = (19200, 921600)
"""The baud rates of RS-232, and of USB, which appears as a serial port."""

MOST_AXES: Final = 3
DEGREES: Final = 7
"""The code of the unit degree (`SN?`). It is only a label: changing it converts no speed and no limit."""
DEMAND_DECIMALS: Final = 6
MOST_ERRORS: Final = 10
"""Size of the error buffer; `TB?` removes the oldest message."""
NO_ERROR: Final = 0
AXIS_ERRORS: Final = 100
"""The number of an axis error is `AXIS_ERRORS` times the number of the axis, plus one of the codes below."""

# errors of the controller
UNKNOWN_COMMAND: Final = 6
BAD_PARAMETER: Final = 7
NO_SUCH_AXIS: Final = 9
AXIS_MISSING: Final = 37
PARAMETER_MISSING: Final = 38

# errors of an axis
FOLLOWING_ERROR: Final = 3
LIMITS: Final = (4, 5, 6, 7)
"""Error codes of limits: positive and negative hardware limit, positive and negative software limit."""
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
