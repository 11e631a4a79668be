"""Facts about Aim-TTi (Thurlby Thandar) supplies with the command dialect `V1 5.0;OP1 1;V1O?`.

Sources: CPX400DP and PL & PL-P Series Instruction Manuals, "Remote commands", as quoted in three drivers:
libsigrok (`src/hardware/aim-tti-dps`) for the CPX (ranges, steps, format of the replies, bits of LSR),
PyMeasure (`aimttiPL.py`) and QCoDeS (`_AimTTi_PL_P.py`) for the PL-P. None of the three covers the
over-voltage protection of the PL-P. Not in these sources, so check on your instrument: the range of the CPX's
protection, the error numbers of EER.
"""

from typing import Final

MAKERS: Final = r"THURLBY[ -]THANDAR|AIM[ -]TTI"
MODELS: Final = ("PL303QMD-P", "CPX200DP", "CPX400DP")
IDENTITY: Final = "THURLBY THANDAR,{model},000000,1.02-1.02"
"""Template of the reply to *IDN?."""

INTERFACES: Final = ("lan", "usb", "rs232")
TCP_PORT: Final = 9221
READ_TERMINATION: Final = "\r\n"
WRITE_TERMINATION: Final = "\n"
BAUD_RATES: Final = (600, 1200, 2400, 4800, 9600, 19200)
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 1, "flow": "xon_xoff", "device_clear": b"",
}  # fmt: skip

SWITCHED_TOGETHER: Final = False
_CPX200 = {
    "voltage_v": (0.0, 60.0), "current_a": (0.0, 10.0), "voltage_step_v": 0.01, "current_step_a": 0.001,
    "over_voltage_v": (1.0, 66.0), "over_voltage_step_v": 0.1,
}  # fmt: skip
_CPX400 = {**_CPX200, "current_a": (0.0, 20.0)}
_PL303 = {"voltage_v": (0.0, 30.0), "current_a": (0.0, 3.0), "voltage_step_v": 0.001, "current_step_a": 0.001}
OUTPUTS: Final = {
    "PL303QMD-P": {"1": _PL303, "2": _PL303},
    "CPX200DP": {"1": _CPX200, "2": _CPX200},
    "CPX400DP": {"1": _CPX400, "2": _CPX400},
}
"""Limits of the outputs, by model and output number. The outputs are floating: for a negative rail, ground the +
terminal and state the voltage as positive.
"""
TRACKS: Final = ("CPX200DP", "CPX400DP")
"""The models that report by CONFIG? whether their outputs are independent or track each other."""
INDEPENDENT: Final = "2"

REGULATING: Final = 1
LIMITING: Final = 2
OVER_VOLTAGE: Final = 4
OVER_CURRENT: Final = 8
"""The four constants above are bits of the limit event register (LSR<n>?); it holds the events since its last
reading.
"""

POWER_ON: Final = 128
QUERY_ERROR: Final = 4
EXECUTION_ERROR: Final = 16
COMMAND_ERROR: Final = 32
"""The four constants above are bits of the standard event register (*ESR?)."""
EXECUTION_ERRORS: Final = {
    100: "out of range",
    103: "no such output",
    104: "not while an output is on",
    200: "read only",
}
"""The meanings of error numbers in the reply to EER?."""
