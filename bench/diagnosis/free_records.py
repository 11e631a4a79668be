"""Free positions as one linear system, the change of biases between records, and the diagnosis of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.base.languages import message
from bench.calibration.design import UPPER, make_problem
from bench.calibration.free import effects_without_data, first_guess_free
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.levels import CLEARLY_LARGER, MOSTLY, STEPS
from bench.diagnosis.linear import MODULUS, LinearSystem, Rows, View, own_column
from bench.diagnosis.mistakes.gross import ERRORS_G
from bench.diagnosis.multi_run_system import OTHER_BLOCK
from bench.diagnosis.naming import Naming
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.result import Findings
from bench.model import AppliedEffect, Block
from bench.model.effects import CATALOGUE, Subsystem
from bench.model.forward import ForwardModel
from bench.model.geometry import modulus_slopes
from bench.readings.table import JoinedPart, Readings, together
from bench.stats.repeats import Repeats, compare_repeats

SAME_TIME_S: Final = 1.0
"""Two tables whose times agree within this, s, belong to sensors measured side by side."""
OWN: Final = len(UPPER)
ZEROS: Final = (6, 7, 8)
SCALES: Final = (0, 3, 5)
"""Indices of the diagonal of K among the nine coefficients; those of the zeros are `ZEROS`."""


@dataclass(frozen=True)
class FreeRows:
    """All N free positions of all sensors, one row each, sorted by sensor.

    `tables` and `block` have, for each sensor, its positions and the coefficients that fit them best. `sensor`
    and `record` (N,) are indices; `origin` (N, 2) are the index of the given table and the row in it. `effects`
    are those of the model.
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
        """The unit vector along the specific force of each position, in the axes of its sensor, (N, 3)."""
        return np.concatenate([view.force for view in self.views])

    @cached_property
    def views(self) -> tuple[View, ...]:
        """For each sensor, the conversion of changes of its signals to changes of |a| in g."""
        return tuple(_view(block, table) for block, table in zip(self.block, self.tables, strict=True))

    @cached_property
    def coefficients(self) -> Floats:
        """The derivatives of -|a| by the coefficients, (N, 9 × sensors); 0 in other sensors' rows."""
        columns = np.zeros((len(self), OWN * self.sensors))
        for number, (block, table) in enumerate(zip(self.block, self.tables, strict=True)):
            slopes, _ = modulus_slopes(block.specific_force(table.signal), block)
            columns[self.sensor == number, place_of(number)] = -slopes[:, UPPER]
        return columns

    def change(self, of: Sequence[int], sensor: int, channel: int) -> Floats:
        """Return the change (N,) of |a|, g, if `of[channel]` grows by the absolute scale factor of the channel."""
        size = abs(float(self.block[sensor].K[channel, channel]))
        return -size * self.coefficients[:, OWN * sensor + of[channel]]

    def place(self, row: int) -> str:
        """Return "sensor 1, record 2, " for a row, without the sensor or record if there is only one."""
        sensor, record = int(self.sensor[row]), int(self.record[row])
        of = f"sensor {sensor + 1}, " if self.sensors > 1 else ""
        return of + (f"record {record + 1}, " if len(np.unique(self.record)) > 1 else "")

    def without(self, rows: Mask) -> FreeRows:
        """Return the positions that are not in the mask `rows` (N,), with the coefficients fitted again."""
        tables = [t.select(~rows[self.sensor == i]) for i, t in enumerate(self.tables)]
        blocks = tuple(fit_sensor(t.signal) for t in tables)
        kept = (self.sensor[~rows], self.record[~rows])
        return FreeRows(tuple(tables), *kept, blocks, self.origin[~rows], self.effects)


@dataclass(frozen=True)
class FreeSystem(LinearSystem):
    """Free positions as a linear system: |a| - 1 in g, with nine coefficients for each sensor.

    The model's effects are subtracted, and `random` columns estimate them again. In place of mountings, an
    effect names the sensors on which it acts ("sensor 1"); without a name, it acts on all.
    """

    positions: FreeRows

    @property
    def g_per_signal(self) -> Floats:
        """Factors (N,) that convert the rows to g: all 1, as the rows are in g already."""
        return np.ones(len(self))

    def rows_in(self, mounts: Sequence[str]) -> Mask:
        """Return the mask (N,) of the positions of the sensors with these labels."""
        mine = [f"sensor {number + 1}" in mounts for number in range(self.positions.sensors)]
        return np.array(mine, dtype=bool)[self.positions.sensor]

    def effect_columns(self, applied: AppliedEffect) -> Floats:
        """Return the change of the rows by an effect, split by the channel in which it acts, (N, 3)."""
        everywhere = replace(applied, installations=())
        changes = []
        for view, block in zip(self.positions.views, self.positions.block, strict=True):
            change = view.own(self.model, (everywhere,), block)
            changes.append(view.rows_of(change[:, :, None] * np.eye(3)))
        # an effect is zero where the time or temperature that it needs is missing
        whole = np.nan_to_num(np.concatenate(changes))
        return whole * self.rows_in(applied.installations)[:, None] if applied.installations else whole


def make_system(rows: FreeRows) -> FreeSystem:
    """Return the linear system of free positions, linearised at the coefficients that fit them best."""
    model = ForwardModel({}, rows.effects)
    problem = make_problem(model, rows.tables[0].conditions(), {})
    effects = problem.effects_at(problem.prior_mean)

    response, random = [], []
    for view, block, table in zip(rows.views, rows.block, rows.tables, strict=True):
        modulus = np.linalg.norm(block.specific_force(table.signal), axis=1)
        response.append(modulus - 1.0 - view.rows_of(view.own(model, effects, block)))
        own = [own_column(problem, block, view, number) for number in range(len(problem.prior_u))]
        nothing = np.zeros((len(table), 0))
        random.append(np.column_stack([nothing, *(view.rows_of(change) for change in own)]))
    readings = together([JoinedPart(table) for table in rows.tables])
    where = np.array([f"F, {rows.place(row)}".removesuffix(", ") for row in range(len(rows))])
    return FreeSystem(
        # the rows are in g, whatever the unit of the signals
        readings=replace(readings, unit="g", installation=where),
        model=model,
        block=rows.block[0],
        rows=Rows(np.arange(len(rows)), np.full(len(rows), MODULUS)),
        response=np.concatenate(response),
        fixed=rows.coefficients,
        random=np.concatenate(random),
        slope=np.zeros(len(rows)),
        setting=np.full(len(rows), -1),
        moved=readings.conditions(),
        view=rows.views[0],
        problem=problem,
        orientation=None,
        positions=rows,
    )


def _view(block: Block, table: Readings) -> View:
    force = block.specific_force(table.signal)
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    nothing, none = np.full(force.shape, np.nan), np.zeros(0, dtype=np.int64)
    by_signal = modulus_slopes(force, block)[1]
    return View(table.conditions(), unit, nothing, none, np.arange(len(table)), none, by_signal)


def fit_sensor(signal: Floats) -> Block:
    """Return the coefficients, K upper triangular, for which the signals (m, 3) best give |a| = 1 g.

    Raises `CalibrationError` if the positions are too few, or if |a| deviates more than it can in readings at rest.
    """
    block = first_guess_free(signal)
    for _ in range(STEPS):
        force = block.specific_force(signal)
        slopes, _ = modulus_slopes(force, block)
        step = np.linalg.lstsq(slopes[:, UPPER], 1.0 - np.linalg.norm(force, axis=1), rcond=None)[0]
        vector = block.vector.copy()
        vector[UPPER] += step
        block = Block.from_vector(vector)
    off = float(np.sqrt(np.mean((np.linalg.norm(block.specific_force(signal), axis=1) - 1.0) ** 2)))
    if not off < max(ERRORS_G):  # errors of sensors cause a tenth of this
        raise CalibrationError(
            f"{len(signal)} free positions deviate from |a| = 1 g by {off:.2g} g (root mean square), too much for "
            "readings at rest; leave out readings in motion or of another sensor"
        )
    return block


def make_rows(
    tables: Sequence[Readings], one_sensor: bool | None = None, model: ForwardModel | None = None
) -> FreeRows:
    """Return the free positions of several tables, assigned to sensors and records.

    Tables with the same times are of one record. If `one_sensor` is True, all tables are of one sensor; if False,
    each is of another; if None, the coefficients decide. Raises `CalibrationError` if positions do not determine
    the coefficients, units differ, or an effect of `model` needs an angle, time or temperature that is missing.
    """
    units = {table.unit: table.source for table in tables}
    if len(units) > 1:
        each = ", ".join(f"{source} in {unit}" for unit, source in sorted(units.items()))
        raise CalibrationError(
            f"the signals are in different units ({each}); evaluate the files of each unit separately"
        )
    # tables of one sensor are different records, even if their times agree
    records = list(range(len(tables))) if one_sensor else _records(tables)
    sensors = _sensors(tables, records, one_sensor)
    names = list(dict.fromkeys(sensors))
    order = [i for name in names for i in range(len(tables)) if sensors[i] == name]
    whole, record, sensor, origin = [], [], [], []
    for number, name in enumerate(names):
        mine = [i for i in order if sensors[i] == name]
        alone = len(mine) == 1
        whole.append(tables[mine[0]] if alone else together([JoinedPart(tables[i]) for i in mine]))
        record += [np.full(len(tables[i]), records[i]) for i in mine]
        origin += [np.column_stack([np.full(len(tables[i]), i), np.arange(len(tables[i]))]) for i in mine]
        sensor.append(np.full(len(whole[-1]), number))
    blocks = tuple(fit_sensor(table.signal) for table in whole)
    effects = () if model is None else model.effects
    numbers = (np.concatenate(sensor), np.concatenate(record))
    rows = FreeRows(tuple(whole), *numbers, blocks, np.concatenate(origin), effects)
    if model is not None and not np.all(np.isfinite(make_system(rows).response)):
        table = rows.tables[0]
        lacking = effects_without_data(model, rows.views[0].force, table.conditions(), blocks[0])
        raise CalibrationError(
            f"{lacking}; remove the effect from the model file, or diagnose without --model"
        )
    return rows


def _records(tables: Sequence[Readings]) -> list[int]:
    first: list[Floats] = []
    numbers = []
    for table in tables:
        time_s = table.time_s
        same = [
            i
            for i, other in enumerate(first)
            if len(other) == len(time_s) and np.all(np.abs(other - time_s) < SAME_TIME_S)
        ]
        first += [] if same else [time_s]
        numbers.append(same[0] if same else len(first) - 1)
    return numbers


def _sensors(tables: Sequence[Readings], records: Sequence[int], one_sensor: bool | None) -> list[int]:
    """Return the index of the sensor of each table, by its coefficients; a record has a sensor only once."""
    if len(tables) == 1 or one_sensor is not None:
        return [0 if one_sensor or len(tables) == 1 else i for i in range(len(tables))]
    own, _, zero = OTHER_BLOCK
    blocks = [fit_sensor(table.signal) for table in tables]
    scales = [np.diag(block.K) for block in blocks]
    features = np.stack(
        [np.append(np.log(np.abs(s)) / own, b.U0 / s / zero) for b, s in zip(blocks, scales, strict=True)]
    )
    groups = [[i for i, r in enumerate(records) if r == number] for number in dict.fromkeys(records)]
    groups.sort(key=len, reverse=True)
    known = [[i] for i in groups[0]]
    sensors = {i: n for n, i in enumerate(groups[0])}
    for group in groups[1:]:
        means = np.stack([features[members].mean(axis=0) for members in known])
        far = np.sqrt(np.mean((features[group][:, None] - means) ** 2, axis=2))
        # assign all tables of a record at once: each is of a different sensor
        for row, column in zip(*linear_sum_assignment(far), strict=True):
            number = int(column)
            if far[row, column] > CLEARLY_LARGER and len(groups[0]) == 1:
                known.append([])
                number = len(known) - 1
            known[number].append(group[row])
            sensors[group[row]] = number
        for i in (i for i in group if i not in sensors):
            known.append([i])
            sensors[i] = len(known) - 1
    return [sensors[i] for i in range(len(tables))]


@dataclass(frozen=True)
class BetweenRecords:
    """The changes of biases between records of free positions; each record has a fit of its own.

    `zero` and `u` (sensors, records, 3), g, are the biases and their standard uncertainties, NaN where not
    determined. `scatter` (3,), g, is the standard deviation of the biases about the mean of their sensor. `common`
    (3,) is the fraction of this variance that all sensors share, NaN for one sensor. `repeats` compares scatter and
    u, and has the term that enlarges u.
    """

    zero: Floats
    u: Floats
    scatter: Floats
    common: Floats
    repeats: Repeats

    def term_sizes(self) -> list[str]:
        """Return, by channel, the term that enlarges u, as a bench file states it ("1.7 mg"); else empty."""
        term = self.repeats.term
        if term is None:
            return []
        return [
            f"{1e3 * size:.2g} mg" if term.name != "scale" else f"{size:.3g}" for size in term.size.tolist()
        ]

    def in_bench_file(self) -> str:
        """Return the line for a bench file that adds the term to the u of calibrations; "" without a term."""
        term = self.repeats.term
        return (
            ""
            if term is None
            else f"uncertainty: {{zero_repeats: {{{term.name}: [{', '.join(self.term_sizes())}]}}}}"
        )

    def in_words(self) -> str:
        """Return a sentence on how much the biases change, and whether the sensors change together."""
        sizes = ", ".join(f"{c} {size * 1e3:.2g} mg" for c, size in zip(CHANNELS, self.scatter, strict=True))
        text = message(f"repeats between records scatter {self.repeats.scatter:.3g} × u ({sizes})")
        shared = zip(CHANNELS, self.common, strict=True)
        parts = [f"{c} {100 * part:.0f} %" for c, part in shared if part >= MOSTLY]
        if np.all(np.isnan(self.common)):
            text = message(f"{text}; of one sensor nothing says whether others would change alike")
        elif parts:
            text = message(
                f"{text}; the change is common to the sensors ({', '.join(parts)} of its variance)"
            )
        else:
            text = message(f"{text}; each sensor changes by itself")
        return message(f"{text}; the cause is not determined")


def between_records(rows: FreeRows) -> BetweenRecords | None:
    """Return the changes of the biases between records; None unless a sensor has biases in two records."""
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
    count = full.sum(axis=1)[:, None, None]
    degrees = (count - 1) / np.maximum(count, 1)
    scatter = np.sqrt(np.nanmean(change[usable] ** 2 / degrees[usable], axis=(0, 1)))
    return BetweenRecords(zero, u, scatter, _common(change, full), compare_repeats(zero[usable], u[usable]))


def _zeros(signal: Floats) -> tuple[Floats, Floats] | None:
    """Return the zeros (3,) of a sensor in one record and their u (3,), g; None if they are not determined."""
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
    """Return the fraction (3,) of the variance of `change` that all sensors share.

    `full` (sensors, records) marks the known biases; only records in which those of all sensors are known count.
    """
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


OUTLIER: Final = "outlier"


@dataclass(frozen=True)
class FreeFit:
    """A fit to |a| = 1 g: coefficients of each sensor, their `u` (sensors, 12), and residuals `left` (N,), g."""

    block: tuple[Block, ...]
    u: Floats
    left: Floats


@dataclass(frozen=True)
class FreeDiagnosis(Findings):
    """The result of the diagnosis of free positions.

    `noise`, g, is the noise of |a| at a position about the model with all effects found. `stated_g`, g, is
    the u of |a| from the scatter of the samples, NaN if not stated. `apart` has a sentence for each position
    left out; `left_out` (k, 2) has its table and row. `before` and `after` are fits without and with the
    effects found. `between` has the changes of the biases between records, None if unknown.
    """

    source: str
    linear: FreeSystem
    candidates: Candidates
    naming: Naming
    apart: tuple[str, ...]
    left_out: Ints
    noise: NoiseSize
    stated_g: float
    threshold: float
    before: FreeFit
    after: FreeFit
    between: BetweenRecords | None

    @property
    def mistaken(self) -> bool:
        """Whether any position was left out."""
        return bool(self.apart)

    @property
    def rows(self) -> FreeRows:
        """The positions that remain after outliers are left out."""
        return self.linear.positions

    @property
    def records(self) -> int:
        """The number of records."""
        return len(np.unique(self.rows.record))

    @property
    def models(self) -> tuple[tuple[AppliedEffect, ...], ...]:
        """The effects for each sensor's model file; one tuple for all sensors if every effect acts on all."""
        sensors = self.rows.sensors if any(a.installations for a in self.applied) else 1
        return tuple(
            tuple(replace(a, installations=()) for a in self.applied if a.installations in ((), (label,)))
            for label in (f"sensor {number + 1}" for number in range(sensors))
        )

    @property
    def hidden(self) -> tuple[str, ...]:
        """The effects that free positions can never show, by name: all except those of the block itself."""
        return tuple(name for name, one in CATALOGUE.items() if one.subsystem is not Subsystem.BLOCK)


def place_of(sensor: int) -> slice:
    """Return the columns of a sensor's nine coefficients among those of all sensors, as a slice."""
    return slice(OWN * sensor, OWN * (sensor + 1))
