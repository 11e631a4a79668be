"""Compensation tables for a navigation computer: N and U0 at equal steps; as C, CSV, JSON."""

from __future__ import annotations

import csv
import io
import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Singles
from bench.base.text import comment, one_line, single
from bench.calibration.result import INVERSE, CalibrationError
from bench.calibration.temperature.model import TemperatureModel

MOST_STEPS: Final = 1024
SMALL: Final = 0.1
"""The table is fine enough when its error at 1 g is below this part of the least standard uncertainty there."""
ROUNDING: Final = 1e-12
"""An error below this, g, is that of double precision in computing it."""
LOOKS: Final = 16
"""Temperatures looked at between two nodes."""


@dataclass(frozen=True)
class TableError:
    """The most by which the table was found to differ from the polynomials, g.

    `bias` at 0 g, `per_g` in addition for each g, along any axis, both from the steps; `single` is what single
    precision adds at any acceleration up to `reach_g`; `looks` counts the temperatures looked at.
    """

    bias: float
    per_g: float
    single: float
    reach_g: float
    looks: int


@dataclass(frozen=True)
class CompensationTable:
    """N (1/(unit/g), row after row) and U0 (unit) at temperatures `first_c` + k `step_k`, shape (nodes, 12)."""

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
        """The temperatures of the nodes."""
        return np.asarray(self.first_c + self.step_k * np.arange(self.nodes), dtype=np.float64)

    def specific_force(self, signal: Floats, temperature_c: Floats) -> Singles:
        """Return specific forces (n, 3) in g as a computer with single precision finds them."""
        single = np.float32
        place = (temperature_c.astype(single) - single(self.first_c)) * single(1.0 / self.step_k)
        low = np.clip(place.astype(np.int64), 0, self.nodes - 2)
        part = (place - low.astype(single))[:, None]
        row = self.entries[low] + part * (self.entries[low + 1] - self.entries[low])
        left = signal.astype(single) - row[:, 9:]
        n = row[:, :9].reshape(-1, 3, 3)
        return n[:, :, 0] * left[:, :1] + n[:, :, 1] * left[:, 1:2] + n[:, :, 2] * left[:, 2:]


def make_table(model: TemperatureModel, reach_g: float, step_k: float | None = None) -> CompensationTable:
    """Make the table over the model's valid range, for accelerations up to `reach_g`.

    Without `step_k` the steps are halved until the table's error at 1 g is a tenth of the least standard
    uncertainty of a compensated acceleration. Raises `CalibrationError` for a step that is no step, or too
    fine, and where K is singular at a temperature.
    """
    low, high = model.minimum_c, model.maximum_c
    span = high - low
    if step_k is not None:
        if not (np.isfinite(step_k) and span / MOST_STEPS <= step_k <= span):
            raise CalibrationError(
                f"a step of {step_k:g} K does not suit a table from {low:.1f} to {high:.1f} °C; state one "
                f"between {span / MOST_STEPS:.2g} and {span:.3g} K"
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
    """Return N (9) and U0 (3) at temperatures (n,), shape (n, 12). Raises `CalibrationError` for a singular K."""
    coefficients = model.coefficients(temperature_c)
    scale = coefficients[:, :9].reshape(-1, 3, 3)
    if not np.isfinite(scale).all() or np.any(np.linalg.cond(scale) > 1e8):
        raise CalibrationError("the matrix K is singular at some temperature; check the readings")
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
    """Return the errors of linear interpolation, and the interpolated entries (m, 12) in double precision."""
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
    """Return the largest difference of single from double precision, on 26 directions at 1 g and full reach."""
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
    """Least standard uncertainty of a compensated acceleration of 1 g along an axis, over the range."""
    least = np.inf
    for t in np.linspace(model.minimum_c, model.maximum_c, 9):
        signal = model.block(float(t)).output(np.eye(3))
        least = min(least, float(np.min(model.compensate(signal, float(t)).u)))
    return least


def approximation(table: CompensationTable) -> dict[str, float | int]:
    """Return what the table adds in error, in g."""
    error = table.error
    return {
        "interpolation_bias_g": error.bias,
        "interpolation_per_g": error.per_g,
        "single_precision_g": error.single,
        "up_to_g": error.reach_g,
        "temperatures_checked": error.looks,
    }


def facts(model: TemperatureModel, table: CompensationTable, of: str) -> list[str]:
    """Return the lines that head each file: what it is, where it holds, how far it is off."""
    error = table.error
    return [
        f"Compensation of {of}",
        f"a = N(T) (U - U0(T)): a in local g ({model.g_m_s2:.6g} m/s^2), U in {model.unit}, T in deg C.",
        f"Valid from {model.minimum_c:.2f} to {model.maximum_c:.2f} deg C; {table.nodes} temperatures, "
        "linear between them.",
        f"Found against the polynomials at {error.looks} temperatures: interpolation adds at most "
        f"{error.bias:.2g} g,",
        f"and {error.per_g:.2g} for each g of acceleration; single precision at most {error.single:.2g} g up to "
        f"{error.reach_g:g} g.",
        "The uncertainty of the calibration is not in these figures; it stands in the JSON result.",
    ]


def c_header(model: TemperatureModel, table: CompensationTable, of: str) -> str:
    """Return a C99 header that needs nothing else: the table and a function that compensates a reading."""
    head = comment(facts(model, table, one_line(of)))
    rows = ",\n".join("    {" + ", ".join(single(entry) for entry in row) + "}" for row in table.entries)
    return f"""/*
{head}
 */
#ifndef BENCH_COMPENSATION_H
#define BENCH_COMPENSATION_H

#define COMPENSATION_NODES {table.nodes}
#define COMPENSATION_LOCAL_GRAVITY_M_S2 {model.g_m_s2!r}

static const float compensation_first_c = {single(np.float32(table.first_c))};
static const float compensation_last_c = {single(np.float32(model.maximum_c))};
static const float compensation_steps_per_k = {single(np.float32(1.0 / table.step_k))};

/* {", ".join(INVERSE)} at each temperature */
static const float compensation_table[COMPENSATION_NODES][12] = {{
{rows}
}};

/*
 * Specific force a[3], in local g, from signals u[3] and the temperature of the block in deg C.
 * Returns 0; 1 when the temperature is outside the table (the nearest end is then taken);
 * -1 when it is not a number (a is then not written).
 */
static inline int compensation_specific_force(const float u[3], float t_c, float a[3])
{{
    float row[12], part, left[3];
    int low, k, outside = 0;

    if (t_c != t_c)
        return -1;
    if (t_c < compensation_first_c) {{
        t_c = compensation_first_c;
        outside = 1;
    }}
    if (t_c > compensation_last_c) {{
        t_c = compensation_last_c;
        outside = 1;
    }}
    part = (t_c - compensation_first_c) * compensation_steps_per_k;
    low = (int)part;
    if (low > COMPENSATION_NODES - 2)
        low = COMPENSATION_NODES - 2;
    part -= (float)low;
    for (k = 0; k < 12; k++)
        row[k] = compensation_table[low][k]
            + part * (compensation_table[low + 1][k] - compensation_table[low][k]);
    for (k = 0; k < 3; k++)
        left[k] = u[k] - row[9 + k];
    for (k = 0; k < 3; k++)
        a[k] = row[3 * k] * left[0] + row[3 * k + 1] * left[1] + row[3 * k + 2] * left[2];
    return outside;
}}

#endif
"""


def table_csv(model: TemperatureModel, table: CompensationTable, of: str) -> str:
    """Return the table as CSV, headed by comment lines that begin with #."""
    out = io.StringIO()
    out.writelines(f"# {line}\r\n" for line in facts(model, table, one_line(of)))
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(["temperature_c", *INVERSE])
    for t, row in zip(table.temperatures_c, table.entries, strict=True):
        writer.writerow([f"{t:.6f}", *(f"{entry:.9g}" for entry in row)])
    return out.getvalue()
