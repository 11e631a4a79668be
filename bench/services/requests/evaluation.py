"""Requests that evaluate readings."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated

from bench.base.requests import Option
from bench.services.requests.shared import Data, OnReadings


@dataclass(frozen=True)
class Confirm(OnReadings):
    """Whether new readings confirm a model that was found in others."""

    source: Annotated[
        Data,
        Option(
            "New readings: a run or a readings file.",
            metavar="NEW",
            argument=True,
            completes="sources",
            typed=str,
        ),
    ]
    _: KW_ONLY
    model: Annotated[
        str | Path,
        Option("Model file of 'diagnose', found in other readings.", metavar="FOUND", typed=Path),
    ]
