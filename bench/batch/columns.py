"""The columns of a batch's table, by command: names and kinds, the same in every part."""

from __future__ import annotations

from typing import Any, Final

from bench.batch.job import CALIBRATE, DIAGNOSE, REPORT
from bench.model.block import COEFFICIENTS

TEXT, NUMBER, WHOLE, FLAG, NUMBERS = "text", "number", "whole", "flag", "numbers"

_COMMON: Final = {
    "run": TEXT,
    "name": TEXT,
    "unit_type": TEXT,
    "serial": TEXT,
    "bench": TEXT,
    "simulated": FLAG,
    "begun": TEXT,
    "measured_with": TEXT,
    "failed": TEXT,
    "verdict_stored": TEXT,
    "verdict": TEXT,
    "verdict_differs": FLAG,
}
_CALIBRATION: Final = {
    "estimator_stored": TEXT,
    "estimator": TEXT,
    "model_stored": TEXT,
    "model": TEXT,
    "signal_unit_stored": TEXT,
    "signal_unit": TEXT,
    "g_stored_m_s2": NUMBER,
    "g_m_s2": NUMBER,
    "worst_delta_g_stored": NUMBER,
    "worst_delta_g": NUMBER,
    "worst_delta_g_u_stored": NUMBER,
    "worst_delta_g_u": NUMBER,
    "limit_g_stored": NUMBER,
    "limit_g": NUMBER,
    "rule_stored": TEXT,
    "rule": TEXT,
    "fit_stored": TEXT,
    "fit": TEXT,
    "fit_differs": FLAG,
    "p_stored": NUMBER,
    "p": NUMBER,
    "readings_used": WHOLE,
    "largest_change_in_u": NUMBER,
    "largest_change_of": TEXT,
    "least_u_ratio": NUMBER,
    "most_u_ratio": NUMBER,
    **{
        column: NUMBER
        for name in COEFFICIENTS
        for column in (f"{name}_stored", name, f"u_{name}_stored", f"u_{name}", f"{name}_change_in_u")
    },
    "covariance": NUMBERS,
}
_DIAGNOSIS: Final = {
    "model": TEXT,
    "names_stored": TEXT,
    "names": TEXT,
    "names_differ": FLAG,
    "gap_before_stored": NUMBER,
    "gap_before": NUMBER,
    "gap_after_stored": NUMBER,
    "gap_after": NUMBER,
    "result": TEXT,
}
_AT_THE_END: Final = {"notes": TEXT, "fingerprint": TEXT}

COLUMNS: Final = {
    CALIBRATE: {**_COMMON, **_CALIBRATION, **_AT_THE_END},
    REPORT: {**_COMMON, **_CALIBRATION, "page": TEXT, **_AT_THE_END},
    DIAGNOSE: {**_COMMON, **_DIAGNOSIS, **_AT_THE_END},
}
"""Of each command: every column with what it holds."""

NOT_IN_TEXT: Final = ("covariance", "result", "fingerprint")
"""Columns that a table of text leaves out."""

Row = dict[str, Any]
"""What one run gives: a value for columns of its command; those that it lacks are unknown."""


def arrow_schema(command: str) -> Any:
    """Return the columns as the columnar files have them."""
    import pyarrow as arrow

    kinds = {
        TEXT: arrow.string(),
        NUMBER: arrow.float64(),
        WHOLE: arrow.int64(),
        FLAG: arrow.bool_(),
        NUMBERS: arrow.list_(arrow.float64()),
    }
    return arrow.schema([(name, kinds[kind]) for name, kind in COLUMNS[command].items()])
