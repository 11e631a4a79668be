"""The forms there are: by what name each is asked for, how its file ends, who writes it, what it loses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from bench.base.arrays import Floats
from bench.exchange.autopilots import (
    ardupilot_notes,
    ardupilot_param,
    kalibr_notes,
    kalibr_yaml,
    px4_notes,
    px4_params,
)
from bench.exchange.documents import c_header, csv_text, json_text, workbook
from bench.exchange.result import BlockResult


@dataclass(frozen=True)
class Form:
    """A form: its words for a person, the end of its file's name, who writes it.

    `loses` tells what the form cannot hold, a sentence each; None for one that holds everything. Both take the
    scale factors (3,) by which signals become m/s^2, unit/g, None for those of the block, rounded.
    """

    words: str
    suffix: str
    write: Callable[[BlockResult, Floats | None], str | bytes]
    loses: Callable[[BlockResult, Floats | None], list[str]] | None = None


FORMS: Final = {
    "json": Form("JSON", ".json", lambda result, _: json_text(result)),
    "csv": Form("CSV", ".csv", lambda result, _: csv_text(result)),
    "c": Form("C header", ".h", lambda result, _: c_header(result)),
    "excel": Form("Excel workbook", ".xlsx", lambda result, _: workbook(result)),
    "kalibr": Form("Kalibr YAML", "-kalibr.yaml", kalibr_yaml, kalibr_notes),
    "px4": Form("PX4 parameters", "-px4.params", px4_params, px4_notes),
    "ardupilot": Form("ArduPilot parameters", "-ardupilot.param", ardupilot_param, ardupilot_notes),
}
"""The forms by the names that `--as` takes."""
