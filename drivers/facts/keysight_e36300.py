"""Facts about the Keysight E36300 series: E36311A, E36312A, E36313A.

Sources: E36300 Series data sheet 5992-2124EN (ratings); E36300 Series Programming Guide, "OUTPut subsystem",
"[SOURce] subsystem", "STATus subsystem", as quoted in PyMeasure (`keysightE36311A.py`, `keysightE36312A.py`)
and other published drivers. The 3 % margin above the ratings is assumed from the E3631A. Check on your instrument:
this margin, the range of the protection (110 % of the rating), the steps and the bits of ISUMmary.
"""

from typing import Final

MAKERS: Final = r"Keysight( Technologies)?|Agilent( Technologies)?"
MODELS: Final = ("E36311A", "E36312A", "E36313A")
IDENTITY: Final = "Keysight Technologies,{model},MY00000000,1.0.4-1.0.0-1.00"
"""Template of the reply to *IDN?."""

INTERFACES: Final = ("lan", "usb")
TCP_PORT: Final = 5025
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"

SWITCHED_TOGETHER: Final = False


def _output(highest_v: float, highest_a: float, *, negative: bool = False) -> dict[str, object]:
    voltage, protection = 1.03 * highest_v, 1.1 * highest_v
    return {
        "voltage_v": (-voltage, 0.0) if negative else (0.0, voltage),
        "current_a": (0.002, 1.03 * highest_a),
        "voltage_step_v": 0.001,
        "current_step_a": 0.001,
        "over_voltage_v": (-protection, 0.0) if negative else (0.0, protection),
        "over_voltage_step_v": 0.01,
    }


OUTPUTS: Final = {
    "E36311A": {"1": _output(6.0, 5.0), "2": _output(25.0, 1.0), "3": _output(25.0, 1.0, negative=True)},
    "E36312A": {"1": _output(6.0, 5.0), "2": _output(25.0, 1.0), "3": _output(25.0, 1.0)},
    "E36313A": {"1": _output(6.0, 10.0), "2": _output(25.0, 2.0), "3": _output(25.0, 2.0)},
}
"""Limits of the outputs, by model and output number; output 3 of an E36311A is negative."""

LIMITING: Final = 1
REGULATING: Final = 2
OVER_VOLTAGE: Final = 512
OVER_CURRENT: Final = 1024
"""The four constants above are bits of STATus:QUEStionable:INSTrument:ISUMmary<n>:CONDition?."""
