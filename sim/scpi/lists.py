"""Channel lists of instruments whose channels are numbered from 1: `(@1,3)`, `(@1:3)`."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from sim.scpi.status import ScpiError

if TYPE_CHECKING:
    from sim.scpi.values import Value

_LIST: Final = re.compile(r"\(\s*@\s*([0-9:,\s]*)\)")
_ITEM: Final = re.compile(r"(\d)(?::(\d))?")
_MISSING: Final = -109
_OUT_OF_RANGE: Final = -222


class OutputList:
    """A list of outputs as a parameter; its value is its text, of which `listed` makes the numbers."""

    def __init__(self, optional: bool = True) -> None:
        self.optional = optional

    def parse(self, text: str) -> Value:
        """Return the text. Raises `ScpiError` for what is no list."""
        if _LIST.fullmatch(text) is None:
            raise ScpiError(-104)
        return text


def listed(text: str, count: int) -> tuple[int, ...]:
    """Return the numbers of a list in its order. Raises `ScpiError` for none, or one beyond `count`."""
    match = _LIST.fullmatch(text)
    inner = "" if match is None else match.group(1).replace(" ", "")
    if not inner:
        raise ScpiError(_MISSING)
    numbers: list[int] = []
    for item in inner.split(","):
        ends = _ITEM.fullmatch(item)
        if ends is None:
            raise ScpiError(-104)
        numbers += range(int(ends.group(1)), int(ends.group(2) or ends.group(1)) + 1)
    if not all(1 <= number <= count for number in numbers):
        raise ScpiError(_OUT_OF_RANGE)
    return tuple(numbers)
