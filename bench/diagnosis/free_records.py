"""Free positions as one linear system, the change of zeros between records, and the diagnosis classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.calibration.design import UPPER, EffectUnknown, make_problem
from bench.calibration.free import first_guess_free
from bench.calibration.result import CalibrationError
from bench.calibration.verification import modulus_slopes
from bench.diagnosis.gap import Gap
from bench.diagnosis.result import EffectValue, Verdict
from bench.model import CATALOGUE, AppliedEffect, Block
from bench.model.forward import ForwardModel
from bench.readings.table import JoinedPart, Readings, together

SAME_TIME_S: Final = 1.0
"""Two tables whose times agree within this belong to sensors measured side by side."""
SCALE_BETWEEN: Final = 1e-3
ZERO_BETWEEN_G: Final = 5e-3
"""Typical changes of a sensor's scale factors and zeros between records: the units for sensor distances."""
ANOTHER: Final = 4.0
"""A larger distance, in these units, is another sensor where the times do not identify it."""
ROUNDS: Final = 6
AT_REST_G: Final = 0.1
"""Largest root mean square of |a| - 1 g, after the fit, of positions at rest. Sensors cause a tenth of it."""
OWN: Final = len(UPPER)
ZEROS: Final = (6, 7, 8)
SCALES: Final = (0, 3, 5)
"""Places of the zeros and of the diagonal of K among the nine coefficients."""


@dataclass(frozen=True)
class FreeRows:
    """The free positions of all sensors as one linear system for |a| - 1.

    `tables` (sensors) hold the positions of each sensor; `sensor` and `record` (N,) are the indices of each
    row. `block` (sensors) are the coefficients that fit each sensor's positions best, all records together.
    `origin` (N, 2) is the index of the input table and the row in it. `effects` are the effects of the given
    model: subtracted at their values, and estimated again with the coefficients.
    """

    tables: tuple[Readings, ...]
    sensor: Ints
    record: Ints
    block: tuple[Block, ...]
    origin: Ints
    effects: tuple[AppliedEffect, ...] = ()

    def __len__(self) -> int:
        return len(self.sensor)

    @property
    def sensors(self) -> int:
        """The number of sensors."""
        return len(self.tables)

    @cached_property
    def direction(self) -> Floats:
        """The specific force of each position over its modulus, (N, 3)."""
        return np.asarray(self._force / np.linalg.norm(self._force, axis=1)[:, None])

    @cached_property
    def _force(self) -> Floats:
        force = [b.specific_force(t.signal) for b, t in zip(self.block, self.tables, strict=True)]
        return np.concatenate(force)

    @cached_property
    def response(self) -> Floats:
        """|a| - 1 (N,) in g, less the effects of the given model."""
        by_model = [self.effect(s, one).sum(axis=1) for s in range(self.sensors) for one in self.effects]
        return np.asarray(np.linalg.norm(self._force, axis=1) - 1.0 - sum(by_model, np.zeros(len(self))))

    @cached_property
    def unknowns(self) -> tuple[EffectUnknown, ...]:
        """The parameters of the effects of the given model."""
        model = ForwardModel({}, self.effects)
        return make_problem(model, self.tables[0].conditions(), {}).effects

    @cached_property
    def of_model(self) -> Floats:
        """Change of the response by a plausible size of each of the `unknowns`, shape (N, m)."""
        columns = np.zeros((len(self), len(self.unknowns)))
        for place, unknown in enumerate(self.unknowns):
            applied = self.effects[unknown.effect]
            parameter = next(p for p in applied.effect.parameters if p.name == unknown.parameter)
            of = (unknown.channel is None) | (np.arange(3) == unknown.channel)
            size = parameter.plausible * of if parameter.per_channel else np.asarray(parameter.plausible)
            values = applied.complete_values()
            shapes = {p.name: values[p.name] for p in applied.effect.parameters if p.is_shape}
            one = replace(applied, values={**shapes, parameter.name: size}, u={})
            columns[:, place] = sum(self.effect(s, one).sum(axis=1) for s in range(self.sensors))
        return columns

    @cached_property
    def fixed(self) -> Floats:
        """Columns that are always estimated: coefficients (N, 9 of each sensor), the model's effects."""
        return np.column_stack([self.coefficients, self.of_model])

    @cached_property
    def coefficients(self) -> Floats:
        """Derivatives of the response by the coefficients, shape (N, 9 of each sensor)."""
        columns = np.zeros((len(self), OWN * self.sensors))
        for number, (block, table) in enumerate(zip(self.block, self.tables, strict=True)):
            slopes, _ = modulus_slopes(block.specific_force(table.signal), block)
            columns[self.sensor == number, OWN * number : OWN * (number + 1)] = -slopes[:, UPPER]
        return columns

    def zero(self, sensor: int, channel: int) -> Floats:
        """Return the change of the rows (N,) by a zero of a sensor that is larger by 1 g."""
        scale = abs(float(self.block[sensor].K[channel, channel]))
        return -scale * self.coefficients[:, OWN * sensor + ZEROS[channel]]

    def scale(self, sensor: int, channel: int) -> Floats:
        """Return the change of the rows (N,) per relative change of a sensor's scale factor."""
        size = abs(float(self.block[sensor].K[channel, channel]))
        return -size * self.coefficients[:, OWN * sensor + SCALES[channel]]

    def effect(self, sensor: int, applied: AppliedEffect) -> Floats:
        """Return the change of a sensor's rows by an effect in each channel, shape (N, 3)."""
        table, block = self.tables[sensor], self.block[sensor]
        force = block.specific_force(table.signal)
        unit = force / np.linalg.norm(force, axis=1, keepdims=True)
        change = ForwardModel({}, (applied,)).readings_at(unit, table.conditions(), block) - block.output(
            unit
        )
        _, by_signal = modulus_slopes(force, block)
        columns = np.zeros((len(self), 3))
        columns[self.sensor == sensor] = by_signal * change
        return columns

    def without(self, rows: Mask) -> FreeRows:
        """Return the positions without `rows` (N,), with the coefficients fitted again."""
        tables = [t.select(~rows[self.sensor == i]) for i, t in enumerate(self.tables)]
        blocks = tuple(fit_sensor(t.signal) for t in tables)
        kept = (self.sensor[~rows], self.record[~rows])
        return FreeRows(tuple(tables), *kept, blocks, self.origin[~rows], self.effects)


def fit_sensor(signal: Floats) -> Block:
    """Return the block that fits free positions (m, 3) best.

    Raises `CalibrationError` where the positions are too few, or are not readings at rest.
    """
    block = first_guess_free(signal)
    for _ in range(ROUNDS):
        force = block.specific_force(signal)
        slopes, _ = modulus_slopes(force, block)
        step = np.linalg.lstsq(slopes[:, UPPER], 1.0 - np.linalg.norm(force, axis=1), rcond=None)[0]
        vector = block.vector.copy()
        vector[UPPER] += step
        block = Block.from_vector(vector)
    off = float(np.sqrt(np.mean((np.linalg.norm(block.specific_force(signal), axis=1) - 1.0) ** 2)))
    if not off < AT_REST_G:
        raise CalibrationError(
            f"{len(signal)} free positions are {off:.2g} g off |a| = 1 g even with the coefficients that fit them "
            "best (root mean square), as no readings at rest are; leave out those in motion, or of another sensor"
        )
    return block


def make_rows(
    tables: Sequence[Readings], one_sensor: bool | None = None, model: ForwardModel | None = None
) -> FreeRows:
    """Return the rows of tables of free positions, each table from one sensor in one record.

    Tables with the same times are sensors side by side in one record. `one_sensor` states that all tables are
    of one sensor, or each of its own; if None, the coefficients identify the sensors. Raises
    `CalibrationError` where a sensor's positions do not determine its coefficients, the units differ, or an
    effect of the model given needs what free positions lack.
    """
    if len({table.unit for table in tables}) > 1:
        raise CalibrationError("signals in different units cannot be taken together")
    # of one sensor no two are side by side, whatever their times
    records = list(range(len(tables))) if one_sensor else _records(tables)
    sensors = _sensors(tables, records, one_sensor)
    names = list(dict.fromkeys(sensors))
    order = [i for name in names for i in range(len(tables)) if sensors[i] == name]
    whole, record, sensor, origin = [], [], [], []
    for number, name in enumerate(names):
        mine = [i for i in order if sensors[i] == name]
        whole.append(_one(tables, mine))
        record += [np.full(len(tables[i]), records[i]) for i in mine]
        origin += [np.column_stack([np.full(len(tables[i]), i), np.arange(len(tables[i]))]) for i in mine]
        sensor.append(np.full(len(whole[-1]), number))
    blocks = tuple(fit_sensor(table.signal) for table in whole)
    effects = () if model is None else model.effects
    numbers = (np.concatenate(sensor), np.concatenate(record))
    rows = FreeRows(tuple(whole), *numbers, blocks, np.concatenate(origin), effects)
    if model is not None and not np.all(np.isfinite(rows.response)):
        raise CalibrationError(
            f"model {model.name}: an effect in it needs what free positions lack (a head angle, a time or a "
            "temperature); leave --model out"
        )
    return rows


def _one(tables: Sequence[Readings], mine: Sequence[int]) -> Readings:
    """Return the records of a sensor as one table, each with a clock of its own."""
    if len(mine) == 1:
        return tables[mine[0]]
    return together([JoinedPart(tables[i]) for i in mine])


def _records(tables: Sequence[Readings]) -> list[int]:
    """Return the index of the record of each table."""
    kinds: list[Floats] = []
    numbers = []
    for table in tables:
        time_s = table.time_s
        same = [
            i
            for i, other in enumerate(kinds)
            if len(other) == len(time_s)
            and np.all(np.isfinite(time_s))
            and np.all(np.abs(other - time_s) < SAME_TIME_S)
        ]
        if not same:
            kinds.append(time_s)
        numbers.append(same[0] if same else len(kinds) - 1)
    return numbers


def _sensors(tables: Sequence[Readings], records: Sequence[int], one_sensor: bool | None) -> list[int]:
    """Return the index of the sensor of each table, by its coefficients; a record has a sensor only once."""
    if len(tables) == 1 or one_sensor is not None:
        return [0 if one_sensor or len(tables) == 1 else i for i in range(len(tables))]
    features = np.stack([_feature(table) for table in tables])
    groups = [[i for i, r in enumerate(records) if r == number] for number in dict.fromkeys(records)]
    groups.sort(key=len, reverse=True)
    known = [[i] for i in groups[0]]
    sensors = {i: n for n, i in enumerate(groups[0])}
    for group in groups[1:]:
        means = np.stack([features[members].mean(axis=0) for members in known])
        far = np.sqrt(np.mean((features[group][:, None] - means) ** 2, axis=2))
        # side by side: who is who is settled by all of them at once
        for row, column in zip(*linear_sum_assignment(far), strict=True):
            number = int(column)
            if far[row, column] > ANOTHER and len(groups[0]) == 1:
                known.append([])
                number = len(known) - 1
            known[number].append(group[row])
            sensors[group[row]] = number
        for i in (i for i in group if i not in sensors):
            known.append([i])
            sensors[i] = len(known) - 1
    return [sensors[i] for i in range(len(tables))]


def _feature(table: Readings) -> Floats:
    block = fit_sensor(table.signal)
    scale = np.diag(block.K)
    return np.concatenate([np.log(np.abs(scale)) / SCALE_BETWEEN, block.U0 / scale / ZERO_BETWEEN_G])


MUCH: Final = 0.8
SOME: Final = 0.5
"""Fractions of shared variance above which changes are common to the sensors, fully or in part."""


@dataclass(frozen=True)
class BetweenRecords:
    """Change of the zeros between records: zeros (sensors, records, 3) in g with their u, fitted by record.

    Zeros are NaN where a record does not determine them. `ratio` is the scatter of the zeros about their mean
    over the stated u, and `scatter` (3,) this scatter in g. `common` (3,) is the fraction of the variance
    that the sensors share, NaN for one sensor. `held_before` and `held_after` are the ratio for records held
    out and predicted from the others. Before, the zeros are constant; after, they scatter as in the other
    records and follow the other sensors in the same record.
    """

    zero: Floats
    u: Floats
    ratio: float
    scatter: Floats
    common: Floats
    held_before: float
    held_after: float

    def in_words(self) -> str:
        """Return a text on the size of the changes, their common part and the held-out records."""
        sizes = ", ".join(f"{c} {size * 1e3:.2g} mg" for c, size in zip(CHANNELS, self.scatter, strict=True))
        text = f"scatter {sizes}, {self.ratio:.3g} times the stated u"
        shares = [c for c, part in zip(CHANNELS, self.common, strict=True) if part >= MUCH]
        partly = [c for c, part in zip(CHANNELS, self.common, strict=True) if SOME <= part < MUCH]
        if np.all(np.isnan(self.common)):
            text += "; of one sensor nothing says whether others would change alike"
        elif shares or partly:
            parts = [f"{c} {100 * self.common[CHANNELS.index(c)]:.0f} %" for c in (*shares, *partly)]
            text += f"; the change is common to the sensors ({', '.join(parts)} of its variance)"
        else:
            text += "; each sensor changes by itself"
        return (
            f"{text}; the cause is not determined; held out by record the ratio is {self.held_before:.3g} with "
            f"zeros that stay and {self.held_after:.2g} with zeros of each record"
        )


def between_records(rows: FreeRows, tables: Sequence[Readings]) -> BetweenRecords | None:
    """Return the change of zeros between records; None where no sensor has them from two records."""
    records = np.unique(rows.record)
    zero = np.full((rows.sensors, len(records), 3), np.nan)
    u = np.full_like(zero, np.nan)
    for sensor, table in enumerate(rows.tables):
        record = rows.record[rows.sensor == sensor]
        for number, one in enumerate(records):
            estimate = _zeros(table.signal[record == one])
            if estimate is not None:
                zero[sensor, number], u[sensor, number] = estimate
    full = np.isfinite(zero).all(axis=2)
    usable = full.sum(axis=1) > 1
    if not usable.any():
        return None
    change = zero - np.nanmean(zero, axis=1, keepdims=True)
    degrees = (full.sum(axis=1, keepdims=True) - 1)[:, :, None] / np.maximum(full.sum(axis=1), 1)[
        :, None, None
    ]
    ratio = float(np.sqrt(np.nanmean(change[usable] ** 2 / u[usable] ** 2 / degrees[usable])))
    scatter = np.sqrt(np.nanmean(change[usable] ** 2 / degrees[usable], axis=(0, 1)))
    common = _common(change, full)
    before, after = _held_out(zero, u, full)
    return BetweenRecords(zero, u, ratio, scatter, common, before, after)


def _zeros(signal: Floats) -> tuple[Floats, Floats] | None:
    """Return the zeros (3,) of a sensor in one record, g, with u; None where they are not determined."""
    try:
        block = fit_sensor(signal)
    except CalibrationError:
        return None
    force = block.specific_force(signal)
    slopes, _ = modulus_slopes(force, block)
    freedom = len(signal) - OWN
    if freedom < 1:
        return None
    left = 1.0 - np.linalg.norm(force, axis=1)
    covariance = np.linalg.inv(slopes[:, UPPER].T @ slopes[:, UPPER]) * float(left @ left) / freedom
    scale = np.abs(np.diag(block.K))
    return block.U0 / scale, np.sqrt(np.diag(covariance)[list(ZEROS)]) / scale


def _common(change: Floats, full: Floats) -> Floats:
    """Return the fraction (3,) of the variance of the changes (sensors, records, 3) that sensors share."""
    whole = full.all(axis=0)
    sensors = len(change)
    if sensors < 2 or whole.sum() < 2:
        return np.full(3, np.nan)
    own = change[:, whole]
    total = np.mean(own**2, axis=(0, 1))
    # the mean of independent changes would have 1/sensors of the variance
    mean = np.mean(np.mean(own, axis=0) ** 2, axis=0)
    part = (mean - total / sensors) / (total * (1.0 - 1.0 / sensors))
    return np.asarray(np.clip(part, 0.0, 1.0))


def _held_out(zero: Floats, u: Floats, full: Floats) -> tuple[float, float]:
    """Return the root mean square error, over its u, of predicting a record's zeros, before and after.

    Before, the zeros of a sensor are constant, and the mean of the other records has its u. After, they
    scatter as in the other records, and follow the common change of other sensors measured in the same
    record.
    """
    before, after = [], []
    for record in range(zero.shape[1]):
        others = np.arange(zero.shape[1]) != record
        for sensor in np.flatnonzero(full[:, record]).tolist():
            known = others & full[sensor]
            if known.sum() < 2:
                continue
            past = zero[sensor, known]
            mean, count = past.mean(axis=0), len(past)
            off = zero[sensor, record] - mean
            stated = u[sensor, record] ** 2 + np.sum(u[sensor, known] ** 2, axis=0) / count**2
            before.append(off**2 / stated)
            off, spread = _with_scatter(zero, full, sensor, record, known, off)
            after.append(off**2 / (stated + spread))
    if not before:
        return float("nan"), float("nan")
    return float(np.sqrt(np.mean(before))), float(np.sqrt(np.mean(after)))


def _with_scatter(
    zero: Floats, full: Floats, sensor: int, record: int, known: Floats, off: Floats
) -> tuple[Floats, Floats]:
    """Return `off` corrected for the other sensors' change in this record, and its variance."""
    past = zero[sensor, known]
    own = past - past.mean(axis=0)
    fellows = [s for s in range(len(zero)) if s != sensor and full[s, record] and np.all(full[s, known])]
    fellows = fellows if len(past) > 2 else []
    if not fellows:
        return off, own.var(axis=0, ddof=1) * (1.0 + 1.0 / len(past))
    means = zero[fellows][:, known].mean(axis=1, keepdims=True)
    theirs = (zero[fellows][:, known] - means).mean(axis=0)
    now = (zero[fellows, record] - means[:, 0]).mean(axis=0)
    slope = np.sum(own * theirs, axis=0) / np.maximum(np.sum(theirs**2, axis=0), 1e-300)
    left = own - slope * theirs
    variance = np.sum(left**2, axis=0) / (len(past) - 2)
    leverage = 1.0 + 1.0 / len(past) + now**2 / np.maximum(np.sum(theirs**2, axis=0), 1e-300)
    return off - slope * now, variance * leverage


# --- what is found out about free positions -------------------------------------------------------


OUTLIER: Final = "outlier"


@dataclass(frozen=True)
class FreeFound:
    """A find: an effect of the catalogue, or an unnamed family. The fields are those of `NamedEffect`.

    `applied` has one entry for all sensors, or one for each sensor with its own values.
    """

    name: str
    channels: tuple[str, ...]
    cannot_tell_from: tuple[str, ...]
    parameters: tuple[EffectValue, ...]
    p: float
    p_all_looks: float
    rho: float
    words: str
    applied: tuple[AppliedEffect, ...] = ()

    @property
    def in_catalogue(self) -> bool:
        """Whether the find is an effect of the catalogue."""
        return self.name in CATALOGUE


@dataclass(frozen=True)
class FreeFit:
    """Fit of a model: `block` of each sensor, its `u` (sensors, 12), residuals `left` (N,) of |a| - 1, g."""

    block: tuple[Block, ...]
    u: Floats
    left: Floats


@dataclass(frozen=True)
class FreeDiagnosis:
    """The diagnosis of free positions.

    `noise_g` is the noise of a position with all finds in the model. `stated_g` is the noise that the scatter
    of the samples implies, NaN where it is not given. `columns` holds the columns of each find in |a|, (N,
    p). `apart` is the reason for each position left out, `left_out` (k, 2) its table and row. `before` is the
    fit of the given model, and `after` the fit with all finds.
    """

    source: str
    rows: FreeRows
    apart: tuple[str, ...]
    left_out: Ints
    found: tuple[FreeFound, ...]
    columns: tuple[Floats, ...]
    gap: Gap
    noise_g: float
    stated_g: float
    freedom: int
    threshold: float
    before: FreeFit
    after: FreeFit
    between: BetweenRecords | None
    where: tuple[Mapping[str, Any], ...]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """One of agrees, mistake, named, confounded, unknown."""
        return "mistake" if self.apart else self.of_rest

    @property
    def of_rest(self) -> Verdict:
        """The verdict on the positions that are not left out."""
        if not all(one.in_catalogue for one in self.found):
            return "unknown"
        if not self.found:
            return "agrees"
        tied = any(one.cannot_tell_from for one in self.found)
        return "named" if not tied and self.gap.shrinks else "confounded"

    @property
    def records(self) -> int:
        """The number of records."""
        return len(np.unique(self.rows.record))

    def applied_to(self, sensor: int) -> tuple[AppliedEffect, ...]:
        """Return the effects found for a sensor, counted from 0: those of all sensors and its own."""
        mine = ((), (f"sensor {sensor + 1}",))
        return tuple(a for one in self.found for a in one.applied if a.installations in mine)

    @property
    def alike(self) -> bool:
        """Whether all effects found are the same in all sensors."""
        return not any(a.installations for one in self.found for a in one.applied)


def place_of(sensor: int) -> slice:
    """Return the slice of the nine coefficients of a sensor among those of all sensors."""
    return slice(OWN * sensor, OWN * (sensor + 1))
