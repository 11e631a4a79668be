"""Candidates and scatter of free positions."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import stats

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import (
    SCALE_BY_RUN,
    SLOW_IN_TIME,
    SUBSETS,
    WAVES,
    ZERO_BY_RUN,
    Candidates,
    Column,
    Variant,
)
from bench.diagnosis.free_records import FreeRows
from bench.diagnosis.noise_grid import NoiseGrid, Span, Whitener
from bench.model.effects import CATALOGUE, AppliedEffect, Effect, Parameter
from bench.model.effects.base import Subsystem

FINE_G: Final = 10e-6
"""Plausible sizes are those of a sensor with so much noise; of a coarser one they are larger in proportion."""
ZERO_OF_NOISE: Final = 3.0
"""Plausible change of a zero or a scale factor between records, in units of a position's noise."""
COMMON: Final = "common to the sensors"


class _Gathered:
    def __init__(self, rows: FreeRows, sigma: float) -> None:
        self.rows, self.sigma = rows, sigma
        self.columns: list[Floats] = []
        self.kinds: list[Column] = []
        self.scale: list[float] = []
        self.variants: list[Variant] = []

    def add(self, column: Floats, kind: Column, scale: float = 1.0) -> tuple[int, ...]:
        if not np.any(column):
            return ()
        self.columns.append(column)
        self.kinds.append(kind)
        self.scale.append(scale)
        return (len(self.columns) - 1,)

    def variant(
        self, family: str, columns: tuple[int, ...], channels: tuple[int, ...], **more: object
    ) -> None:
        if columns:
            self.variants.append(Variant(family, columns, channels, **more))  # type: ignore[arg-type]


def make_free_candidates(rows: FreeRows, sigma: float) -> Candidates:
    """Return the candidates for free positions; `sigma` is the noise of a position, g."""
    gathered = _Gathered(rows, sigma)
    for effect in CATALOGUE.values():
        if _may_be_seen(effect):
            _add_effect(gathered, effect)
    _add_by_record(gathered)
    _add_slow(gathered)
    return Candidates(
        np.stack(gathered.columns, axis=1),
        tuple(gathered.kinds),
        np.array(gathered.scale),
        tuple(gathered.variants),
    )


def _may_be_seen(effect: Effect) -> bool:
    return effect.subsystem is Subsystem.BLOCK and not (
        effect.needs_path or effect.per_mount or effect.per_pass
    )


def _add_effect(gathered: _Gathered, effect: Effect) -> None:
    linear = [p for p in effect.parameters if not p.is_shape]
    if not linear or not all(p.per_channel for p in linear):
        return
    shapes = [[(p.name, value) for value in p.grid] for p in effect.parameters if p.is_shape]
    coarse = max(1.0, gathered.sigma / FINE_G)
    for shape in itertools.product(*shapes):
        own = {p.name: _of_sensors(gathered.rows, effect, p, shape, coarse) for p in linear}
        for several, label in _groups(gathered.rows):
            places: dict[tuple[str, int], tuple[int, ...]] = {}
            for parameter in linear:
                for channel in range(3):
                    columns = own[parameter.name][:, :, channel]
                    found: tuple[int, ...] = ()
                    for of, mask in zip(label, several, strict=True):
                        kind = Column(parameter.name, channel, of)
                        found += gathered.add(
                            (columns * mask).sum(axis=0), kind, parameter.plausible * coarse
                        )
                    places[parameter.name, channel] = found
            names = [(p.name,) for p in linear] if len(linear) > 1 else []
            for chosen in (*names, tuple(p.name for p in linear)):
                for channels in SUBSETS:
                    keys = [(name, channel) for name in chosen for channel in channels]
                    if all(places[key] for key in keys):
                        whole = tuple(i for key in keys for i in places[key])
                        gathered.variant(effect.name, whole, channels, shape=shape)


def _of_sensors(
    rows: FreeRows, effect: Effect, parameter: Parameter, shape: tuple[tuple[str, float], ...], coarse: float
) -> Floats:
    """Return the change of each sensor's rows by a parameter of plausible size, (sensors, N, 3)."""
    values: dict[str, Floats] = {name: np.asarray(value) for name, value in shape}
    values[parameter.name] = np.full(3, parameter.plausible * coarse)
    columns = [rows.effect(sensor, AppliedEffect(effect, values)) for sensor in range(rows.sensors)]
    return np.nan_to_num(np.stack(columns))


def _groups(rows: FreeRows) -> Iterator[tuple[list[Floats], list[tuple[str, ...]]]]:
    """Yield masks (sensors or 1, N) and what they are called: the same in all, of each sensor its own."""
    yield [np.ones((1, len(rows)))], [()]
    if rows.sensors > 1:
        own = [(rows.sensor == s)[None].astype(np.float64) for s in range(rows.sensors)]
        yield own, [(f"sensor {s + 1}",) for s in range(rows.sensors)]


def _add_by_record(gathered: _Gathered) -> None:
    """Add zeros and scale factors of their own in each record: of each sensor, in common, and both."""
    rows = gathered.rows
    records = np.unique(rows.record)
    size = ZERO_OF_NOISE * gathered.sigma
    for family, column_of in ((ZERO_BY_RUN, rows.zero), (SCALE_BY_RUN, rows.scale)):
        own: dict[int, tuple[int, ...]] = {}
        common: dict[int, tuple[int, ...]] = {}
        for channel in range(3):
            each = [size * column_of(sensor, channel) for sensor in range(rows.sensors)]
            several = [s for s in range(rows.sensors) if len(np.unique(rows.record[rows.sensor == s])) > 1]
            own[channel] = tuple(
                i
                for s in several
                for r in records
                for i in gathered.add(each[s] * (rows.record == r), _kind(family, channel, r, s))
            )
            common[channel] = tuple(
                i
                for r in records
                if len(several) > 1
                for i in gathered.add(
                    np.sum([each[s] for s in several], axis=0) * (rows.record == r), _kind(family, channel, r)
                )
            )
        for channels in SUBSETS:
            in_common = tuple(i for c in channels for i in common[c])
            of_each = tuple(i for c in channels for i in own[c])
            gathered.variant(family, of_each, channels)
            gathered.variant(family, in_common, channels, where=COMMON)
            if in_common:
                gathered.variant(family, in_common + of_each, channels, where=COMMON)


def _kind(family: str, channel: int, record: int, sensor: int | None = None) -> Column:
    of = (f"record {record + 1}",) if sensor is None else (f"record {record + 1}", f"sensor {sensor + 1}")
    return Column(f"{family} {CHANNELS[channel]}", channel, of)


def _add_slow(gathered: _Gathered) -> None:
    """Add a zero that wanders slowly in every record, of each channel and sensor."""
    rows = gathered.rows
    time = np.concatenate([table.conditions().elapsed_s for table in rows.tables])
    for channel in range(3):
        zero = np.sum([rows.zero(sensor, channel) for sensor in range(rows.sensors)], axis=0)
        columns: tuple[int, ...] = ()
        for record in np.unique(rows.record):
            mine = rows.record == record
            phase = (time - time[mine].min()) / max(float(np.ptp(time[mine])), 1e-300)
            for wave in range(1, WAVES // 2 + 1):
                column = gathered.sigma * zero * mine * np.cos(np.pi * wave * phase)
                columns += gathered.add(column, Column(SLOW_IN_TIME, channel))
        gathered.variant(SLOW_IN_TIME, columns, (channel,))


OUTLIER: Final = 1e-4
"""A position is an outlier where its p-value, all positions counted, is below this,"""
FAR: Final = 12.0
"""and it is at least this many standard deviations off, as real sensors have heavier tails than normal."""
DOUBT: Final = 0.05
"""A position that stays in is reported where its p-value, all positions counted, is below this."""
LEAST_FREEDOM: Final = 3
AT_ONCE: Final = 32
"""Positions weighed at once; each has noise of its own."""
MOST_APART: Final = 0.1
"""At most this fraction of the positions is left out."""


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
class OutlyingPositions:
    """The positions that stay; a sentence for each that is left out (`origin`, (k, 2)), and for each in doubt."""

    rows: FreeRows
    apart: tuple[str, ...]
    origin: Ints
    doubtful: tuple[str, ...]


def without_outliers(rows: FreeRows) -> OutlyingPositions:
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
    return OutlyingPositions(
        kept, tuple(apart), np.array(origin, dtype=np.int64).reshape(-1, 2), tuple(doubtful)
    )


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
