"""Readings at several temperatures, sorted into plateaus, and the coefficients as functions of temperature.

A mounting has one set of stand angles. It lasts while the installation stays the same, at any temperature. If the
block is mounted again at the same temperature, a change of the column `series` marks the new mounting.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import Floats, HasCovariance, Ints, Mask, Singles
from bench.calibration.result import CalibrationError, LackOfFit, Noise
from bench.model.geometry import COEFFICIENTS, Block
from bench.readings import columns
from bench.readings.table import REFERENCE, SHORTED, UNORIENTED, VERIFICATION, JoinedPart, Readings, together

PLATEAU_K: Final = 2.0
"""Widest range of a plateau, K: chambers hold theirs to better than 1 K."""
RISING, FALLING, UNTOLD = 1, -1, 0


@dataclass(frozen=True)
class Plateau:
    """A temperature plateau that was reached from one side.

    `temperature_c` is the mean over its readings. `branch` is +1 if it was reached from below, -1 from above, 0 if
    it was the first after mounting. `rows` is a mask over the readings.
    """

    temperature_c: float
    branch: int
    rows: Mask


@dataclass(frozen=True)
class ThermalReadings:
    """The oriented rows of one or several tables, sorted into mountings, visits and plateaus.

    `mounting` (n,) numbers the mountings from 1. `visit` (n,) numbers the stays at one temperature in one mounting,
    from 0. `branch` (n,) and `level` (n,) belong to the plateau of each row.
    """

    rows: Readings
    mounting: Ints
    visit: Ints
    branch: Ints
    level: Ints

    @property
    def plateaus(self) -> tuple[Plateau, ...]:
        """The plateaus, from the lowest temperature; at one temperature the rising side first."""
        found = []
        for level in range(int(self.level.max()) + 1):
            for branch in (RISING, UNTOLD, FALLING):
                rows = (self.level == level) & (self.branch == branch)
                if np.any(rows):
                    mean = float(np.mean(self.rows.temperature_c[rows]))
                    found.append(Plateau(mean, branch, rows))
        return tuple(found)

    @property
    def levels(self) -> int:
        """Number of separate temperatures."""
        return int(self.level.max()) + 1

    @property
    def both_sides(self) -> Mask:
        """Mask (n,) of the rows whose temperature was reached both rising and falling."""
        sides = [set(self.branch[self.level == level].tolist()) for level in range(self.levels)]
        return np.array([{RISING, FALLING} <= sides[level] for level in self.level])


def separate_temperatures(readings: Readings) -> list[float]:
    """Return the separate temperatures of a table's oriented rows, °C, ascending; empty if one is unknown."""
    rows = readings.oriented()
    if not len(rows) or not np.isfinite(rows.temperature_c).all():
        return []
    found = sort_readings([readings])
    return [float(np.mean(found.rows.temperature_c[found.level == i])) for i in range(found.levels)]


def inner_range(low_c: float, high_c: float) -> str:
    """Return a temperature range in words; its ends are rounded inwards to 0.1 °C, to lie within it."""
    low, high = math.ceil(10.0 * low_c - 1e-9) / 10.0, math.floor(10.0 * high_c + 1e-9) / 10.0
    return f"{low:.1f} to {high:.1f} °C"


def sort_readings(tables: Sequence[Readings]) -> ThermalReadings:
    """Sort the oriented rows of tables into mountings, visits and plateaus.

    The rows of each table are in the order of measurement. Raises `CalibrationError` if the tables differ in unit,
    have no oriented row, or an oriented row has no temperature.
    """
    units = {table.unit: table.source for table in tables}
    if len(units) > 1:
        each = ", ".join(f"{source} in {unit}" for unit, source in sorted(units.items()))
        raise CalibrationError(
            f"the readings are in different units ({each}); leave out the files in other units"
        )
    parts, mountings, visits, branches, means = [], [], [], [], []
    last_mounting = last_visit = 0
    for table in tables:
        seen = table.select(~np.isin(table.installation, [SHORTED, REFERENCE]))
        mounting, visit, branch, mean = _walk(seen)
        kept = _oriented(seen)
        parts.append(seen.select(kept))
        mountings.append(mounting[kept] + last_mounting)
        visits.append(visit[kept] + last_visit)
        branches.append(branch[kept])
        means.append(mean[kept])
        last_mounting += int(mounting.max(initial=0))
        last_visit += int(visit.max(initial=-1)) + 1
    if not sum(len(part) for part in parts):
        raise CalibrationError(
            f"{', '.join(table.source for table in tables)}: no reading in an installation of known "
            "orientation; measure installations 1 and 2"
        )
    return ThermalReadings(
        parts[0] if len(parts) == 1 else together([JoinedPart(part) for part in parts]),
        np.concatenate(mountings),
        np.concatenate(visits),
        np.concatenate(branches),
        levels_of(np.concatenate(means)),
    )


def _walk(rows: Readings) -> tuple[Ints, Ints, Ints, Floats]:
    """Return, for each row in measurement order, its mounting, visit, branch, and the visit's mean temperature.

    Without the column `mounting_number`, the block stays mounted while the temperature changes.
    """
    unknown = _oriented(rows) & ~np.isfinite(rows.temperature_c)
    if np.any(unknown):
        i = int(np.argmax(unknown))
        raise CalibrationError(
            f"{rows.source}: {int(unknown.sum())} readings have no temperature_c (the first: installation "
            f"{rows.installation[i]}, series {rows.series[i]}, pass {rows.pass_number[i]}, point {rows.point[i]}); "
            "fill in the temperature of the block, or remove these readings"
        )
    n = len(rows)
    mounting, visit, branch = (np.zeros(n, dtype=np.int64) for _ in range(3))
    mean = np.full(n, np.nan)
    mounts, start, total = 0, 0, -1
    noted = columns.mountings(rows.extra)
    numbers = np.zeros(n, dtype=np.int64) if noted is None else noted
    for i in range(n):
        t = rows.temperature_c[i]
        remounted = i == 0 or rows.installation[i] != rows.installation[i - 1]
        here = float(np.mean(rows.temperature_c[start:i])) if i > start else t
        moved = bool(abs(t - here) > PLATEAU_K)
        again = i > 0 and rows.series[i] != rows.series[i - 1]
        known = i > 0 and min(numbers[i], numbers[i - 1]) > 0
        remounted = remounted or (bool(numbers[i] != numbers[i - 1]) if known else again and not moved)
        if remounted or moved:
            side = UNTOLD if remounted else RISING if t > here else FALLING
            mounts += remounted
            start, total = i, total + 1
        mounting[i], visit[i], branch[i] = mounts, total, side
    for number in range(total + 1):
        mean[visit == number] = np.mean(rows.temperature_c[visit == number])
    return mounting, visit, branch, mean


def _oriented(rows: Readings) -> Mask:
    return ~np.isin(rows.installation, [VERIFICATION, *UNORIENTED])


def levels_of(temperature_c: Floats) -> Ints:
    """Return the level of each temperature (n,), numbered from the lowest; no level is wider than `PLATEAU_K`."""
    level = np.zeros(len(temperature_c), dtype=np.int64)
    number, lowest = -1, -np.inf
    for i in np.argsort(temperature_c, kind="stable"):
        if temperature_c[i] - lowest > PLATEAU_K:
            number, lowest = number + 1, temperature_c[i]
        level[i] = number
    return level


# --- the coefficients as functions of temperature -------------------------------------------------


@dataclass(frozen=True)
class PlateauResult:
    """The coefficients from one plateau alone, with its temperature and `branch`, as in `Plateau`.

    `value` (12,) and `u` (12,) are None if the readings of this plateau alone do not determine all twelve.
    """

    temperature_c: float
    branch: int
    readings: int
    value: Floats | None
    u: Floats | None


@dataclass(frozen=True)
class ThermalHysteresis(HasCovariance):
    """Thermal hysteresis of the coefficients: rising minus falling at one temperature.

    `size` (12,) are the differences with their `covariance` (12, 12). The fit assumes the same differences at
    all temperatures that were reached from both sides. `p` is the p-value of all twelve differences together
    (F test); `p_each` (12,) are those of the single coefficients, multiplied by twelve (Bonferroni).
    """

    size: Floats
    covariance: Floats
    p: float
    p_each: Floats

    @property
    def scatter(self) -> Floats:
        """Covariance (12, 12) of the coefficients due to the hysteresis, if the branch is unknown.

        The coefficients then deviate by half the hysteresis in either direction. The part that noise explains
        is subtracted: noise alone gives a chi-square of twelve on average.
        """
        chi2 = float(self.size @ np.linalg.solve(self.covariance, self.size))
        real = max(1.0 - len(self.size) / chi2, 0.0) if chi2 > 0 else 0.0
        return np.asarray(real * np.outer(self.size, self.size) / 4.0, dtype=np.float64)


@dataclass(frozen=True)
class Compensated:
    """Specific forces (n, 3), in local g; `covariance` (n, 3, 3), g², is from the temperature model only."""

    specific_force: Floats
    covariance: Floats

    @property
    def u(self) -> Floats:
        """Standard uncertainties, g, shape (n, 3)."""
        return np.asarray(np.sqrt(np.einsum("nii->ni", self.covariance)))


@dataclass(frozen=True)
class TemperatureModel:
    """The coefficients as polynomials in temperature, valid from `minimum_c` to `maximum_c`.

    Coefficient j at temperature T is the sum over d of `values[j, d]` (T - `reference_c`)^d.

    `values` (12, D + 1) are in unit/g/K^d and unit/K^d; those above the degree in `degrees` (12,) are zero.
    `covariance` (12 (D + 1), 12 (D + 1)) is the covariance of `values`, row after row. It includes the uncertainty
    due to terms that the data did not support, if the data chose the degrees. `of_assumed` is its part due to stand
    angles of merely assumed size. `growth` (3,) is the noise per signal, divided by `noise`, the noise at zero
    signal; None if it does not grow. `fitted` tests the fit against the noise. `curve` tests the polynomials
    against coefficients that are free at each plateau (None if a plateau alone does not determine them).
    """

    unit: str
    g_m_s2: float
    reference_c: float
    minimum_c: float
    maximum_c: float
    degrees: Ints
    values: Floats
    covariance: Floats
    of_assumed: Floats
    hysteresis: ThermalHysteresis | None
    plateaus: tuple[PlateauResult, ...]
    noise: Noise
    growth: Floats | None
    fitted: LackOfFit
    curve: LackOfFit | None
    readings: int
    skipped: int
    notes: tuple[str, ...] = ()

    @property
    def constant(self) -> Ints:
        """The places (12,) of the coefficients at the reference temperature, in `covariance`."""
        return np.asarray(np.arange(len(self.values)) * self.values.shape[1], dtype=np.int64)

    def powers(self, temperature_c: float | Floats) -> Floats:
        """Return (T - reference)^d for d = 0…D, shape (…, D + 1)."""
        offset = np.asarray(temperature_c, dtype=np.float64) - self.reference_c
        return np.asarray(offset[..., None] ** np.arange(self.values.shape[1]), dtype=np.float64)

    def coefficients(self, temperature_c: float | Floats) -> Floats:
        """Return the coefficients at temperatures (…), shape (…, 12), in the order of `COEFFICIENTS`."""
        return self.powers(temperature_c) @ self.values.T

    def block(self, temperature_c: float) -> Block:
        """Return the block at a temperature."""
        return Block.from_vector(self.coefficients(temperature_c))

    def covariance_at(self, temperature_c: float) -> Floats:
        """Return the covariance (12, 12) of the coefficients at a temperature, hysteresis included."""
        spread = np.kron(np.eye(len(COEFFICIENTS)), self.powers(temperature_c))
        covariance: Floats = spread @ self.covariance @ spread.T
        return covariance if self.hysteresis is None else covariance + self.hysteresis.scatter

    @property
    def per_kelvin_g(self) -> float:
        """The most that an error of 1 K of the temperature changes a at 1 g, in g, over the valid range."""
        t = np.linspace(self.minimum_c, self.maximum_c, LOOKS + 1)
        degree = np.arange(1, self.values.shape[1])
        slope = (degree * self.powers(t)[:, :-1]) @ self.values[:, 1:].T
        inverse = np.linalg.inv(self.coefficients(t)[:, :9].reshape(-1, 3, 3))
        scale = np.linalg.norm(inverse @ slope[:, :9].reshape(-1, 3, 3), 2, axis=(1, 2))
        bias = np.linalg.norm(np.einsum("nij,nj->ni", inverse, slope[:, 9:]), axis=1)
        return float(np.max(scale + bias))

    @property
    def largest_u_g(self) -> float:
        """The largest u of a component of a, in g, at 1 g along an axis, over the valid range."""
        at, axes = np.linspace(self.minimum_c, self.maximum_c, 9).tolist(), np.vstack([np.eye(3), -np.eye(3)])
        return max(float(np.max(self.compensate(self.block(t).output(axes), t).u)) for t in at)

    def outside(self, temperature_c: float | Floats) -> Mask:
        """Return whether temperatures (…) lie outside the valid range, where no reading supports the model."""
        t = np.asarray(temperature_c, dtype=np.float64)
        return ~((t >= self.minimum_c) & (t <= self.maximum_c))

    def compensate(self, signal: Floats, temperature_c: float | Floats) -> Compensated:
        """Return the specific forces for signals (n, 3) measured at one temperature or at temperatures (n,).

        The covariance includes the coefficients and the hysteresis. It excludes the thermometer and the noise of
        the signals. Raises `CalibrationError` for a temperature outside the valid range.
        """
        rows = np.asarray(signal, dtype=np.float64).reshape(-1, 3)
        temperature = np.broadcast_to(np.asarray(temperature_c, dtype=np.float64), (len(rows),))
        if np.any(self.outside(temperature)):
            worst = temperature[self.outside(temperature)][0]
            raise CalibrationError(
                f"{worst:g} °C is outside the range of the temperature model, "
                f"{inner_range(self.minimum_c, self.maximum_c)}; measure at that temperature; polynomials must "
                "not be extrapolated"
            )
        force = np.empty_like(rows)
        covariance = np.empty((len(rows), 3, 3))
        for i, t in enumerate(temperature):
            block = self.block(float(t))
            inverse = np.linalg.inv(block.K)
            force[i] = inverse @ (rows[i] - block.U0)
            # da = -K^-1 (dK a + dU0), dK, dU0 in the order of the coefficients
            by_output = np.hstack([np.kron(np.eye(3), force[i]), np.eye(3)])
            by_coefficient = -inverse @ by_output
            covariance[i] = by_coefficient @ self.covariance_at(float(t)) @ by_coefficient.T
        return Compensated(force, covariance)


MOST_STEPS: Final = 1024
SMALL: Final = 0.1
"""A table is fine enough if its error at 1 g is below this fraction of the least u of an acceleration."""
ROUNDING: Final = 1e-12
"""Error, g, below which a table error is only the rounding of double precision."""
LOOKS: Final = 16
"""Number of temperatures between two nodes at which the table is tested."""


@dataclass(frozen=True)
class TableError:
    """The largest errors, g, of a force component from a compensation table, compared with the polynomials.

    `bias` is the interpolation error at 0 g, `per_g` its increase per g of acceleration. `single` is the
    additional error of single precision at accelerations up to `reach_g`. The comparison is at `looks`
    temperatures.
    """

    bias: float
    per_g: float
    single: float
    reach_g: float
    looks: int


@dataclass(frozen=True)
class CompensationTable:
    """A compensation table: `entries` (nodes, 12) are N (g/unit) and U0 (unit) at `first_c` + k `step_k`."""

    first_c: float
    step_k: float
    entries: Singles
    error: TableError

    @property
    def nodes(self) -> int:
        """Number of temperatures in the table."""
        return len(self.entries)

    @property
    def temperatures_c(self) -> Floats:
        """The temperatures of the nodes, °C, shape (nodes,)."""
        return np.asarray(self.first_c + self.step_k * np.arange(self.nodes), dtype=np.float64)

    def specific_force(self, signal: Floats, temperature_c: Floats) -> Singles:
        """Return specific forces (n, 3) in g, computed from the table in single precision."""
        single = np.float32
        place = (temperature_c.astype(single) - single(self.first_c)) * single(1.0 / self.step_k)
        low = np.clip(place.astype(np.int64), 0, self.nodes - 2)
        part = (place - low.astype(single))[:, None]
        row = self.entries[low] + part * (self.entries[low + 1] - self.entries[low])
        left = signal.astype(single) - row[:, 9:]
        n = row[:, :9].reshape(-1, 3, 3)
        return n[:, :, 0] * left[:, :1] + n[:, :, 1] * left[:, 1:2] + n[:, :, 2] * left[:, 2:]

    def double_force(self, signal: Floats, temperature_c: Floats) -> Floats:
        """Return specific forces (n, 3) in g, computed from the table's entries in double precision."""
        place = (temperature_c - self.first_c) / self.step_k
        low = np.clip(place.astype(np.int64), 0, self.nodes - 2)
        entries = self.entries.astype(np.float64)
        row = entries[low] + (place - low)[:, None] * (entries[low + 1] - entries[low])
        return np.asarray(np.einsum("nij,nj->ni", row[:, :9].reshape(-1, 3, 3), signal - row[:, 9:]))


def make_table(model: TemperatureModel, reach_g: float, step_k: float | None = None) -> CompensationTable:
    """Return the compensation table over the model's valid range, for accelerations up to `reach_g`.

    Without `step_k` the step is halved until the table's error at 1 g is at most a tenth of the least
    standard uncertainty of a compensated acceleration, or `MOST_STEPS` are reached. Raises `CalibrationError`
    for an invalid or too fine step, and if K is singular at a temperature.
    """
    low, high = model.minimum_c, model.maximum_c
    span = high - low
    if step_k is not None:
        if not (np.isfinite(step_k) and span / MOST_STEPS <= step_k <= span):
            # rounded inwards, so that both are accepted
            least, most = np.ceil(1e3 * span / MOST_STEPS) / 1e3, np.floor(10 * span) / 10
            raise CalibrationError(
                f"a step of {step_k:g} K does not fit a table from {low:.1f} to {high:.1f} °C; give a step "
                f"between {least:g} and {most:g} K"
            )
        return _table(model, reach_g, int(np.ceil(span / step_k - 1e-9)))
    enough = SMALL * _least_u(model)
    steps = 4
    table = _table(model, reach_g, steps)
    while table.error.bias + table.error.per_g > enough and steps < MOST_STEPS:
        steps *= 2
        table = _table(model, reach_g, steps)
    return table


def inverse_entries(model: TemperatureModel, temperature_c: Floats) -> Floats:
    """Return N (nine elements, g/unit) and U0 (unit) at temperatures (n,), shape (n, 12).

    Raises `CalibrationError` for a singular K.
    """
    coefficients = model.coefficients(temperature_c)
    scale = coefficients[:, :9].reshape(-1, 3, 3)
    if not np.isfinite(scale).all() or np.any(np.linalg.cond(scale) > 1e8):
        raise CalibrationError(
            "the matrix K is singular at some temperature; check that all three channels "
            "respond at each temperature"
        )
    return np.hstack([np.linalg.inv(scale).reshape(-1, 9), coefficients[:, 9:]])


def _table(model: TemperatureModel, reach_g: float, steps: int) -> CompensationTable:
    nodes_c = np.linspace(model.minimum_c, model.maximum_c, steps + 1)
    exact = inverse_entries(model, nodes_c)
    nothing = TableError(0.0, 0.0, 0.0, reach_g, 0)
    step_k = (model.maximum_c - model.minimum_c) / steps
    table = CompensationTable(model.minimum_c, step_k, exact.astype(np.float32), nothing)
    between = np.linspace(model.minimum_c, model.maximum_c, LOOKS * steps + 1)
    bias, per_g, entries = _by_steps(model, nodes_c, exact, between)
    single = _by_rounding(model, table, entries, between, reach_g)
    error = TableError(bias, per_g, single, reach_g, len(between))
    return CompensationTable(table.first_c, step_k, table.entries, error)


def _by_steps(
    model: TemperatureModel, nodes_c: Floats, exact: Floats, between: Floats
) -> tuple[float, float, Floats]:
    """Return the largest interpolation error of the force at 0 g, in g, its increase per g of |a|, and the entries.

    `exact` (n, 12) are the entries of N and U0 at the nodes (n,), °C; the returned entries (m, 12) are
    interpolated at the temperatures `between` (m,), °C. The errors are those of one component of the force;
    up to `ROUNDING` they count as zero.
    """
    entries = np.stack([np.interp(between, nodes_c, column) for column in exact.T], axis=1)
    truth = model.coefficients(between)
    inverse = entries[:, :9].reshape(-1, 3, 3)
    bias = np.einsum("nij,nj->ni", inverse, truth[:, 9:] - entries[:, 9:])
    scale = inverse @ truth[:, :9].reshape(-1, 3, 3) - np.eye(3)
    errors = (float(np.max(np.abs(bias))), float(np.max(np.linalg.norm(scale, axis=2))))
    at_zero, per_g = (error if error > ROUNDING else 0.0 for error in errors)
    return at_zero, per_g, entries


def _by_rounding(
    model: TemperatureModel, table: CompensationTable, entries: Floats, between: Floats, reach_g: float
) -> float:
    """Return the largest error, g, that single precision adds to a component of the force.

    It is the maximum over the temperatures `between` (m,), °C, and over 26 directions, at 1 g and at `reach_g`.
    `entries` (m, 12) are the interpolated entries of N and U0 in double precision.
    """
    whole = [np.array(d) for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)]
    worst = 0.0
    truth = model.coefficients(between)
    for direction in whole:
        for size in {1.0, reach_g}:
            force = size * direction / np.linalg.norm(direction)
            signal = truth[:, :9].reshape(-1, 3, 3) @ force + truth[:, 9:]
            double = np.einsum("nij,nj->ni", entries[:, :9].reshape(-1, 3, 3), signal - entries[:, 9:])
            single = table.specific_force(signal, between).astype(np.float64)
            worst = max(worst, float(np.max(np.abs(single - double))))
    return worst


def _least_u(model: TemperatureModel) -> float:
    """Return the least standard uncertainty, g, of a compensated component at 1 g along an axis."""
    least = np.inf
    for t in np.linspace(model.minimum_c, model.maximum_c, 9):
        signal = model.block(float(t)).output(np.eye(3))
        least = min(least, float(np.min(model.compensate(signal, float(t)).u)))
    return least


def approximation(table: CompensationTable) -> dict[str, float | int]:
    """Return the errors of the table by their names in the result, with the number of temperatures compared."""
    error = table.error
    return {
        "interpolation_bias_g": error.bias,
        "interpolation_per_g": error.per_g,
        "single_precision_g": error.single,
        "up_to_g": error.reach_g,
        "temperatures_checked": error.looks,
    }
