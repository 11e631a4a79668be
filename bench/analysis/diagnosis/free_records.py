"""Records of free positions as one linear system in g: |a| = 1 g in every row, whatever the orientation.

Several records may be of one sensor, several sensors may have lain side by side in one record: those have the
same times. A sensor has nine coefficients (an upper triangular K and its zeros), the same in all its records.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.analysis.calibration.design import UPPER, EffectUnknown, make_problem
from bench.analysis.calibration.free import first_guess_free
from bench.analysis.calibration.result import CalibrationError
from bench.analysis.calibration.verification import modulus_slopes
from bench.base.arrays import Floats, Ints, Mask
from bench.model import Block, ForwardModel
from bench.model.effects import AppliedEffect
from bench.readings.joined import JoinedPart, together
from bench.readings.table import Readings

SAME_TIME_S: Final = 1.0
"""Positions of two tables at the same times, within this, are of sensors side by side."""
SCALE_BETWEEN: Final = 1e-3
ZERO_BETWEEN_G: Final = 5e-3
"""How far scale factors and zeros of a sensor go between records: to tell sensors apart by their distance."""
ANOTHER: Final = 4.0
"""Further than so many of these is another sensor, where times do not tell."""
ROUNDS: Final = 6
AT_REST_G: Final = 0.1
"""Further off 1 g, whatever the coefficients, are no positions at rest: what sensors do is a tenth of it."""
OWN: Final = len(UPPER)
ZEROS: Final = (6, 7, 8)
SCALES: Final = (0, 3, 5)
"""Places of the zeros and of the diagonal of K among the nine coefficients."""


@dataclass(frozen=True)
class FreeRows:
    """All positions of all sensors. `tables` (sensors) hold the rows of each, `sensor`, `record` number them (N,).

    `block` (sensors) are the coefficients that fit each sensor's positions best, all records taken together.
    `origin` (N, 2) says of which table each is that was given, and its row there. `effects` are those of the model
    given: taken off at their values, and estimated anew with the coefficients.
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
        """How many sensors there are."""
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
        """|a| - 1 (N,), g, by the model given."""
        by_model = [self.effect(s, one).sum(axis=1) for s in range(self.sensors) for one in self.effects]
        return np.asarray(np.linalg.norm(self._force, axis=1) - 1.0 - sum(by_model, np.zeros(len(self))))

    @cached_property
    def unknowns(self) -> tuple[EffectUnknown, ...]:
        """The parameters of the effects of the model given."""
        model = ForwardModel({}, self.effects)
        return make_problem(model, self.tables[0].conditions(), {}).effects

    @cached_property
    def of_model(self) -> Floats:
        """What a plausible size of each of these does to it, (N, m)."""
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
        """What is estimated in any case: coefficients (N, 9 of each sensor), effects of the model given."""
        return np.column_stack([self.coefficients, self.of_model])

    @cached_property
    def coefficients(self) -> Floats:
        """What the coefficients do to it, (N, 9 of each sensor)."""
        columns = np.zeros((len(self), OWN * self.sensors))
        for number, (block, table) in enumerate(zip(self.block, self.tables, strict=True)):
            slopes, _ = modulus_slopes(block.specific_force(table.signal), block)
            columns[self.sensor == number, OWN * number : OWN * (number + 1)] = -slopes[:, UPPER]
        return columns

    def zero(self, sensor: int, channel: int) -> Floats:
        """Return what 1 g of another zero of a sensor does to its rows, (N,)."""
        scale = abs(float(self.block[sensor].K[channel, channel]))
        return -scale * self.coefficients[:, OWN * sensor + ZEROS[channel]]

    def scale(self, sensor: int, channel: int) -> Floats:
        """Return what a scale factor larger by 1 does to a sensor's rows, (N,)."""
        size = abs(float(self.block[sensor].K[channel, channel]))
        return -size * self.coefficients[:, OWN * sensor + SCALES[channel]]

    def effect(self, sensor: int, applied: AppliedEffect) -> Floats:
        """Return what an effect of a sensor does to its rows for each channel, (N, 3)."""
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
        """Return the positions but for some (N,), with the coefficients fitted anew."""
        tables = [t.select(~rows[self.sensor == i]) for i, t in enumerate(self.tables)]
        blocks = tuple(fit_sensor(t.signal) for t in tables)
        kept = (self.sensor[~rows], self.record[~rows])
        return FreeRows(tuple(tables), *kept, blocks, self.origin[~rows], self.effects)


def fit_sensor(signal: Floats) -> Block:
    """Return the block that fits free positions (m, 3) best.

    Raises `CalibrationError` where they are too few, or are no readings at rest: whatever explains those, it is not
    what a sensor does.
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
    """Return the positions of tables of free positions, each of one sensor in one record.

    Tables with the same times are sensors side by side in one record. Which sensor it is, its coefficients tell,
    where nobody says (`one_sensor`: of all, or of each its own). Raises `CalibrationError` where a sensor's
    positions do not determine its coefficients, the units differ, or an effect of the model given needs what free
    positions lack.
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
    """Return the number of the record of each table."""
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
    """Return the number of the sensor of each table: by the coefficients, two of a record never the same."""
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
