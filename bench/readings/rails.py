"""The columns of the rails that feed the block: voltage, nominal voltage and current beside each reading.

Of a rail `p15` they are `rail_p15_v`, `rail_p15_nominal_v` and `rail_p15_a`: text columns of the table, empty where
nothing was measured.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Labels

_COLUMN: Final = re.compile(r"rail_(?P<rail>[a-z][a-z0-9_]*?)_(?P<what>nominal_v|v|a)")


def voltage_column(rail: str) -> str:
    """Return the column of the measured voltage of a rail, V."""
    return f"rail_{rail}_v"


def nominal_column(rail: str) -> str:
    """Return the column of the nominal voltage of a rail, V."""
    return f"rail_{rail}_nominal_v"


def current_column(rail: str) -> str:
    """Return the column of the measured current of a rail, A."""
    return f"rail_{rail}_a"


def is_of_a_rail(column: str) -> bool:
    """Whether a column is one of these."""
    return _COLUMN.fullmatch(column) is not None


def rails_of(columns: Iterable[str]) -> tuple[str, ...]:
    """Return the rails that have a voltage among these columns, in their order."""
    matches = [_COLUMN.fullmatch(column) for column in columns]
    return tuple(match["rail"] for match in matches if match is not None and match["what"] == "v")


def above_nominal_v(extra: Mapping[str, Labels]) -> Floats | None:
    """Return the voltages of the rails less their nominal ones, V, shape (n, rails), NaN where one is not given.

    None where there is no rail. A rail without its nominal voltage has nothing to count from: it is NaN throughout.
    """
    rails = rails_of(extra)
    if not rails:
        return None
    columns = [
        _numbers(extra[voltage_column(rail)])
        - (_numbers(extra[nominal_column(rail)]) if nominal_column(rail) in extra else np.nan)
        for rail in rails
    ]
    return np.stack(columns, axis=1)


def _numbers(cells: Labels) -> Floats:
    return np.array([float(cell) if cell.strip() else np.nan for cell in cells.tolist()], dtype=np.float64)
