"""A compensation table over temperature as C source and as CSV, each with check vectors and its own test."""

from __future__ import annotations

import csv
import io
from itertools import cycle
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.text import comment, one_line, single
from bench.calibration.result import INVERSE
from bench.calibration.temperature import CompensationTable, TemperatureModel
from bench.exchange.checks import POSITIONS, READ_CHECKS, c_self_test, check_lines, judged, own_test, picture


def facts(model: TemperatureModel, table: CompensationTable, of: str) -> list[str]:
    """Return the header lines of an exported file: block (`of`), valid range, and errors of interpolation."""
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
        "The uncertainty of the calibration is not included; the JSON result has it.",
        *picture(model.unit),
    ]


def table_checks(model: TemperatureModel, table: CompensationTable) -> Floats:
    """Return check vectors (n, 7), n ≥ 20: temperature (deg C), signals (3), accelerations (3, in g)."""
    steps = table.nodes - 1
    even = np.linspace(model.minimum_c, model.maximum_c, len(POSITIONS))
    middles = table.first_c + table.step_k * (np.arange(steps) + 0.5)
    t = np.array(even if steps <= len(even) else middles, dtype=np.float64)
    forces = zip(t.tolist(), cycle(POSITIONS))
    signal = np.stack([model.block(at).output(a[None])[0] for at, a in forces])
    return np.column_stack([t, signal, table.double_force(signal, t)])


INTERPOLATED: Final = (
    "def a(r): k = max([i for i in range(len(t) - 1) if t[i][0] <= r[0]] or [0]); "
    "p = (r[0] - t[k][0]) / (t[k + 1][0] - t[k][0]); m = [x + p * (y - x) for x, y in zip(t[k], t[k + 1])][1:]; "
    "return [sum(m[3 * i + j] * (r[1 + j] - m[9 + j]) for j in range(3)) for i in range(3)]"
)
"""The line of a test that interpolates `t`, rows of temperature and twelve entries, and corrects a signal."""


def json_test(count: int) -> list[str]:
    """Return the three lines that test a result of `bench compensate --json` with `count` check vectors."""
    return [
        "import json, sys; d = json.load(open(sys.argv[1])); b = d['table']; c = d['check']; "
        "t = [[b['first_c'] + k * b['step_k'], *row] for k, row in enumerate(b['rows'])]",
        INTERPOLATED,
        judged(at=4, count=count),
    ]


def c_header(model: TemperatureModel, table: CompensationTable, of: str) -> str:
    """Return a self-contained C99 header: the table and a function that compensates a reading."""
    head = comment(facts(model, table, one_line(of)))
    rows = ",\n".join("    {" + ", ".join(single(entry) for entry in row) + "}" for row in table.entries)
    tested = c_self_test(
        "compensation", table_checks(model, table), "compensation_specific_force_double(row + 1, row[0], a);"
    )
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

/* The same in double precision, for a temperature within the table. */
static inline void compensation_specific_force_double(const double u[3], double t_c, double a[3])
{{
    double row[12], part = (t_c - {table.first_c!r}) / {table.step_k!r};
    int low = (int)part, k;

    if (low > COMPENSATION_NODES - 2)
        low = COMPENSATION_NODES - 2;
    part -= low;
    for (k = 0; k < 12; k++)
        row[k] = (double)compensation_table[low][k]
            + part * ((double)compensation_table[low + 1][k] - (double)compensation_table[low][k]);
    for (k = 0; k < 3; k++)
        a[k] = row[3 * k] * (u[0] - row[9]) + row[3 * k + 1] * (u[1] - row[10])
            + row[3 * k + 2] * (u[2] - row[11]);
}}

{tested}
#endif
"""


def table_csv(model: TemperatureModel, table: CompensationTable, of: str) -> str:
    """Return the table as CSV, with check vectors, headed by comment lines that begin with #."""
    rows = [
        [f"{t:.6f}", *(f"{entry:.9g}" for entry in row)]
        for t, row in zip(table.temperatures_c, table.entries, strict=True)
    ]
    written = np.array(rows, dtype=float)
    checks = table_checks(model, table)
    at = np.stack([np.interp(checks[:, 0], written[:, 0], column) for column in written[:, 1:].T], axis=1)
    checks[:, 4:] = np.einsum("nij,nj->ni", at[:, :9].reshape(-1, 3, 3), checks[:, 1:4] - at[:, 9:])
    read = (
        "import csv, sys; t = [[float(x) for x in r] for r in csv.reader(l for l in open(sys.argv[1]) "
        f"if l[0] != '#') if r[0] != 'temperature_c']; {READ_CHECKS}"
    )
    out = io.StringIO()
    told = [
        *facts(model, table, one_line(of)),
        *check_lines(checks[:, :4], checks[:, 4:], "T / deg C, U, then a = N (U - U0)", "g"),
        *own_test("FILE.csv", (read, INTERPOLATED, judged(at=4, count=len(checks)))),
    ]
    out.writelines(f"# {line}\r\n" for line in told)
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(["temperature_c", *INVERSE])
    writer.writerows(rows)
    return out.getvalue()
