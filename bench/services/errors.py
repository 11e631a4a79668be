"""The one error of what is asked for and cannot be done."""

from __future__ import annotations

import re
from typing import Final

_OPTION: Final = re.compile(r"--([a-z][a-z-]*)( (?=[0-9.-]))?")


class Refused(Exception):
    """What was asked for cannot be done; the text says why and what to do.

    `typed` is the text for a person at the command line, where what is g=9.81 in Python is --g 9.81.
    """

    def __init__(self, typed: str) -> None:
        super().__init__(typed)
        self.typed = typed

    def __str__(self) -> str:
        """Return the text with the options written as in Python."""
        return _OPTION.sub(_in_python, self.typed)


def _in_python(option: re.Match[str]) -> str:
    name = option[1].replace("-", "_")
    return f"{name}=" if option[2] else name
