"""How a channel of a simulated 34970A measures a temperature: its settings, and the commands that set them.

Source: 34970A User's Guide (34970-90003), chapter 4 "Temperature Measurements"; chapter 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from drivers.keysight_34970a import facts
from drivers.keysight_34970a.sensors import PAIRED
from sim.agilent_34401a.functions import Function
from sim.scpi.status import ScpiError
from sim.scpi.values import DEF, Value

TEMPERATURE: Final = Function("TEMP", "TEMPerature", "C", (1.0,), facts.NPLC_BY_RESOLUTION, "TEMPerature")
KINDS: Final = ("TCouple", "RTD", "FRTD", "THERmistor")
_TYPES: Final = {"RTD": (85, 91), "FRTD": (85, 91), "THER": (2252, 5000, 10000)}
_ILLEGAL: Final = -224
_NOT_HERE: Final = 305


@dataclass(frozen=True, slots=True)
class Transducer:
    """The probe that a channel is set to: its kind as in replies, and its type."""

    kind: str = "TC"
    type: int = 85

    @property
    def configured(self) -> str:
        """As CONFigure:TEMPerature names it: "FRTD,85"."""
        return f"{self.kind},{self.type}"

    @classmethod
    def of(cls, kind: str, written: Value, channel: int) -> Transducer:
        """Return the probe of a command. Raises `ScpiError` -224, 305 for four wires on the second bank."""
        known = _TYPES.get(kind)
        if known is None:
            raise ScpiError(_ILLEGAL)
        if kind == "FRTD" and channel % 100 not in PAIRED:
            raise ScpiError(_NOT_HERE)
        number = known[-2] if written == DEF else int(float(written))
        if number not in known:
            raise ScpiError(_ILLEGAL)
        return cls(kind, number)
