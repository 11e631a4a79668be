"""What might be missing where |a| = 1 g is all that is known: effects of the sensor, zeros and scale by record."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import (
    SCALE_BY_RUN,
    SLOW_IN_TIME,
    SUBSETS,
    WAVES,
    ZERO_BY_RUN,
    Candidates,
    Column,
    Variant,
)
from bench.analysis.diagnosis.free_records import FreeRows
from bench.base.arrays import CHANNELS, Floats
from bench.model import CATALOGUE, AppliedEffect, Effect, Parameter
from bench.model.effects import Subsystem

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
    """Collect all that might be missing in free positions; `sigma` is the noise of a position, g."""
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
    """Return what a plausible size of a parameter does to the rows of each sensor, (sensors, N, 3)."""
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
