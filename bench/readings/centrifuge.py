"""Points above 1 g from a centrifuge: signals of a block at stated specific forces with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.readings.columns import BadCell, number
from bench.readings.csv import LISTED_AT_ONCE, ReadingsError, split_table

FORCES: Final = ("ax_ms2", "ay_ms2", "az_ms2")
UNCERTAIN: Final = ("u_ms2", "u_relative")
SIGNALS: Final = ("ux_v", "uy_v", "uz_v")
EXAMPLE: Final = ",".join((*FORCES, *UNCERTAIN, *SIGNALS))


@dataclass(frozen=True)
class CentrifugePoints:
    """Signals (n, 3), V, at specific forces (n, 3) on the block's axes, m/s^2; NaN where no signal was read.

    Only the magnitudes of the forces are uncertain. Their u has two parts: `u_ms2` (n,), m/s², is independent
    between points; the fraction `u_relative` (n,) comes from an error common to all points, such as the radius.
    """

    source: str
    force_ms2: Floats
    u_ms2: Floats
    u_relative: Floats
    signal: Floats


def read_centrifuge(path: Path) -> CentrifugePoints:
    """Return the points above 1 g in a CSV file with the columns of `EXAMPLE`; cells of signals not read are empty.

    Raises `ReadingsError` for missing columns, rows without a signal, and cells that are not numbers.
    """
    header, body = split_table(path, EXAMPLE)
    names = (*FORCES, *UNCERTAIN, *SIGNALS)
    missing = [name for name in names if name not in header]
    if missing:
        raise ReadingsError(f"{path}, line 1: the header lacks {', '.join(missing)}; points have {EXAMPLE}")
    rows, bad = [], []
    for line, cells in body:
        text = dict(zip(header, cells, strict=False))
        try:
            row = [number(text, name, "a force in m/s²") for name in FORCES]
            row += [number(text, name, "a standard uncertainty", least=0.0) for name in UNCERTAIN]
            row += [number(text, name, "a signal in V", optional=True) for name in SIGNALS]
        except BadCell as wrong:
            bad.append(f"{path}, line {line}, column {wrong.column}: {wrong}")
            continue
        if np.all(np.isnan(row[5:])):
            bad.append(f"{path}, line {line}: no signal; give one or more of {', '.join(SIGNALS)}")
        rows.append(row)
    if bad or not rows:
        raise ReadingsError(
            "\n".join(bad[:LISTED_AT_ONCE]) or f"{path}: has no points; add rows of {EXAMPLE}"
        )
    table = np.array(rows)
    return CentrifugePoints(str(path), table[:, :3], table[:, 3], table[:, 4], table[:, 5:])
