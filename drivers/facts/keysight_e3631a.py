"""Facts about the HP / Agilent / Keysight E3631A.

Sources: E3631A User's Guide (E3631-90002), chapter 3, "Remote interface configuration"; chapter 4, table 4-1
"Programming ranges and output identifiers", "Output setting and operation commands", "The SCPI status registers";
chapter 8, "Specifications" (resolution).
"""

from typing import Final

MAKERS: Final = r"HEWLETT-PACKARD|HP|Agilent( Technologies)?|Keysight( Technologies)?"
MODELS: Final = ("E3631A",)
IDENTITY: Final = "HEWLETT-PACKARD,E3631A,0,1.4-5.0-1.0"
"""A reply to *IDN?."""

INTERFACES: Final = ("gpib", "rs232")
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"
BAUD_RATES: Final = (300, 600, 1200, 2400, 4800, 9600)
SERIAL: Final = {
    "baud_rate": 9600, "data_bits": 8, "parity": "none", "stop_bits": 2, "flow": "dtr_dsr", "device_clear": b"\x03",
}  # fmt: skip
"""Factory settings of the RS-232 port, over which the first command must be SYSTem:REMote."""

SWITCHED_TOGETHER: Final = True
"""Whether one switch controls all outputs: OUTPut[:STATe] switches all three."""
_P6V = {
    "voltage_v": (0.0, 6.18),
    "current_a": (0.0, 5.15),
    "voltage_step_v": 0.0005,
    "current_step_a": 0.0005,
}
_P25V = {
    "voltage_v": (0.0, 25.75),
    "current_a": (0.0, 1.03),
    "voltage_step_v": 0.0015,
    "current_step_a": 0.0001,
}
_N25V = {**_P25V, "voltage_v": (-25.75, 0.0)}
OUTPUTS: Final = {"E3631A": {"P6V": _P6V, "P25V": _P25V, "N25V": _N25V}}
"""Limits of the outputs, by model and output identifier; no output has an over-voltage protection."""
DEFAULT_CURRENT_A: Final = {"P6V": 5.0, "P25V": 1.0, "N25V": 1.0}
"""The current limits after power-on and *RST, which also set 0 V and switch the outputs off."""

LIMITING: Final = 1
REGULATING: Final = 2
FAILED: Final = 3
"""The three constants above are replies to STATus:QUEStionable:INSTrument:ISUMmary<n>:CONDition?; 0 is off or
unregulated.
"""
