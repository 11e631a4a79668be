"""JSON read fast: by the parser that pydantic brings, and by the standard library's where that refuses."""

from __future__ import annotations

import json
from typing import Any, Final, NoReturn

from pydantic_core import from_json


def read_json(content: bytes) -> Any:
    """Return what a text in UTF-8 says. Raises `ValueError` for what is no JSON, as NaN and Infinity are none."""
    try:
        return from_json(content, allow_inf_nan=False)
    except ValueError:
        return _DECODER.decode(content.decode())  # it takes more, such as half of a surrogate pair


def _no_number(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")


_DECODER: Final = json.JSONDecoder(parse_constant=_no_number)
