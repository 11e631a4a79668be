"""A compensation table as files: a C header that stands alone, CSV, and its part in the JSON result."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from bench.analysis.calibration.derived import INVERSE
from bench.analysis.temperature.model import TemperatureModel
from bench.analysis.temperature.table import CompensationTable
from bench.base.c_source import comment, one_line, single


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


def table_json(table: CompensationTable) -> dict[str, Any]:
    """Return the table and what it adds in error."""
    return {
        "first_c": table.first_c,
        "step_k": table.step_k,
        "entries": list(INVERSE),
        "rows": table.entries.astype(np.float64).tolist(),
        "approximation": approximation(table),
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
