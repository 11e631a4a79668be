"""The scatter of free positions beside anything that may differ between records, and what stands apart from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import stats

from bench.analysis.calibration.result import CalibrationError
from bench.analysis.diagnosis.free_records import FreeRows
from bench.analysis.diagnosis.noise_grid import NoiseGrid, Span, Whitener
from bench.base.arrays import Floats, Ints, Mask

OUTLIER: Final = 1e-4
"""Chance, all positions counted, below which one stands apart."""
FAR: Final = 12.0
"""And so many standard deviations at the least: tails of real sensors are heavier than the normal's."""
DOUBT: Final = 0.05
"""Chance, all positions counted, below which one is told that stays in."""
LEAST_FREEDOM: Final = 3
AT_ONCE: Final = 32
"""Positions weighed at once; each has noise of its own."""
MOST_APART: Final = 0.1
"""No more than this part of the positions is left out."""


def grid_of(rows: FreeRows, sigma: float, kept: Mask | None = None) -> NoiseGrid:
    """Return the noise of positions, all of one size `sigma`, beside what is estimated in any case."""
    mine = np.ones(len(rows), dtype=bool) if kept is None else kept
    basis, size, _ = np.linalg.svd(rows.fixed[mine] / sigma, full_matrices=False)
    basis = basis[:, size > 1e-10 * size[0]]
    parts = np.array_split(np.arange(len(basis)), max(len(basis) // AT_ONCE, 1))
    each = tuple((part, np.eye(len(part))) for part in parts)
    white = Whitener(each, (Span(slice(None), basis, np.zeros(basis.shape[1])),))
    return NoiseGrid((white,), np.zeros(1), np.zeros(1), np.zeros(1), sigma, len(basis) - basis.shape[1])


def loose(rows: FreeRows, *, drifting: bool = False) -> Floats:
    """Return the columns of coefficients, zeros and scale factors free in every record, zeros also `drifting`."""
    more = [
        of(sensor, channel) * (rows.record == record)
        for of in (rows.zero, rows.scale)
        for sensor in range(rows.sensors)
        for channel in range(3)
        for record in np.unique(rows.record[rows.sensor == sensor])[1:]
    ]
    if drifting:
        late = np.concatenate([np.arange(len(table)) / len(table) for table in rows.tables])
        more += [
            rows.zero(sensor, channel) * (rows.record == record) * late
            for sensor in range(rows.sensors)
            for channel in range(3)
            for record in np.unique(rows.record[rows.sensor == sensor])
        ]
    return np.column_stack([rows.fixed, *more])


def scatter(rows: FreeRows) -> float:
    """Return the noise of a position, g: what is left where every record has zeros and scale of its own."""
    columns = loose(rows)
    u, size, _ = np.linalg.svd(columns, full_matrices=False)
    u = u[:, size > 1e-9 * size[0]]
    freedom = len(rows) - u.shape[1]
    if freedom < LEAST_FREEDOM:
        raise CalibrationError(
            f"{len(rows)} free positions leave {max(freedom, 0)} to tell the noise, beside coefficients, and "
            f"zeros and scale factors of each record; measure {LEAST_FREEDOM - freedom} more, all round"
        )
    left = rows.response - u @ (u.T @ rows.response)
    return max(float(np.sqrt(left @ left / freedom)), 1e-9)


@dataclass(frozen=True)
class Apart:
    """The positions that stay; a sentence for each that is left out (`origin`, (k, 2)), and for each in doubt."""

    rows: FreeRows
    apart: tuple[str, ...]
    origin: Ints
    doubtful: tuple[str, ...]


def without_outliers(rows: FreeRows) -> Apart:
    """Leave out positions that stand apart from all others, the worst first."""
    apart: list[str] = []
    origin: list[Ints] = []
    doubtful: list[str] = []
    kept = rows
    for _ in range(int(MOST_APART * len(rows))):
        worst = _worst(rows)
        if worst is None or worst.p > DOUBT:
            break
        if worst.p < OUTLIER and worst.t >= FAR and not doubtful:
            apart.append(f"{worst.words}; not at rest? It is left out")
            origin.append(rows.origin[worst.row])
        else:
            why = f"by chance in {100 * worst.p:.2g} %" if worst.p >= OUTLIER else f"fewer than {FAR:g}"
            doubtful.append(f"{worst.words}: {why}, so that it stays in")
        rows = rows.without(np.arange(len(rows)) == worst.row)
        kept = kept if doubtful else rows
    return Apart(kept, tuple(apart), np.array(origin, dtype=np.int64).reshape(-1, 2), tuple(doubtful))


@dataclass(frozen=True)
class _Worst:
    row: int
    t: float
    p: float
    words: str


def _worst(rows: FreeRows) -> _Worst | None:
    """Return the position that lies furthest off what the others let expect; None where they are too few."""
    u, size, _ = np.linalg.svd(loose(rows, drifting=True), full_matrices=False)
    u = u[:, size > 1e-9 * size[0]]
    left = rows.response - u @ (u.T @ rows.response)
    free = np.maximum(1.0 - np.sum(u**2, axis=1), 1e-9)
    freedom = len(rows) - u.shape[1] - 1
    if freedom < LEAST_FREEDOM:
        return None
    without = np.maximum(left @ left - left**2 / free, 1e-300) / freedom
    t = np.abs(left) / np.sqrt(free * without)
    row = int(np.argmax(t))
    p = 2.0 * float(stats.t.sf(t[row], freedom)) * len(rows)
    sensor = int(rows.sensor[row])
    at = int(np.count_nonzero(rows.sensor[:row] == sensor))
    table = rows.tables[sensor]
    words = (
        f"{_of(rows, sensor, int(rows.record[row]))}pass {table.pass_number[at]}, point {table.point[at]}: |a| is "
        f"{left[row] / free[row] * 1e3:+.3g} mg off what the others let expect ({t[row]:.1f} standard deviations)"
    )
    return _Worst(row, float(t[row]), p, words)


def _of(rows: FreeRows, sensor: int, record: int) -> str:
    which = f"sensor {sensor + 1}, " if rows.sensors > 1 else ""
    return which + (f"record {record + 1}, " if len(np.unique(rows.record)) > 1 else "")


def stated(rows: FreeRows) -> float:
    """Return the noise of a position, g, that independent samples with their scatter imply; NaN where not given."""
    sizes = []
    for block, table in zip(rows.block, rows.tables, strict=True):
        scale = np.abs(np.diag(block.K))
        variance = np.mean((table.signal_sd / scale) ** 2, axis=1) / np.maximum(table.samples, 1)
        sizes.append(variance)
    return float(np.sqrt(np.mean(np.concatenate(sizes))))
