"""Check vectors of exported files, the tests by which files check themselves, and the drawing of signs and axes.

    $ python -c "$(sed -n 's/^# test: //p' unit-17.csv)" unit-17.csv

A test is three lines of Python that need no package except a reader of the form. The test computes the
corrected accelerations of the check vectors from the numbers in the file. The test fails if one acceleration
is off by more than `TOLERANCE` of 1 g. Numbers that are not used to compute accelerations, such as u and
covariances, are not tested.

The compensation table over temperature, as C source and as CSV, is such a file.
"""

from __future__ import annotations

import csv
import io
from itertools import cycle, product
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.text import comment, double, one_line, single
from bench.calibration.result import INVERSE
from bench.calibration.temperature import CompensationTable, TemperatureModel

TOLERANCE: Final = 1e-12
"""Largest accepted error of a corrected acceleration in a test, as a fraction of 1 g."""
COUNT: Final = 20
MARK: Final = "test: "
"""First word of each line of a file's own test, after the comment sign."""

GOLDEN: Final = (1.0 + 5.0**0.5) / 2.0
_CORNERS: Final = [
    *product((-1.0, 1.0), repeat=3),
    *(
        tuple(np.roll([0.0, p / GOLDEN, q * GOLDEN], turn).tolist())
        for turn in range(3)
        for p, q in product((-1.0, 1.0), repeat=2)
    ),
]
POSITIONS: Final[Floats] = np.array(_CORNERS) / np.sqrt(3.0)
"""Specific forces (20, 3) of the check vectors, 1 g each: the corners of a dodecahedron."""


def picture(unit: str) -> list[str]:
    """Return lines that draw the axes, and state signs, order and units of `a` and `U`."""
    return [
        "        +z    up     at rest the axis that points up reads +1 g:",
        "         |   ^       z up:     a = ( 0,  0, +1)   z down: a = ( 0,  0, -1)",
        "         |   |       x up:     a = (+1,  0,  0)   y up:   a = ( 0, +1,  0)",
        "         o------ +y  right-handed axes of the block; a: specific force in local g",
        "        /            order everywhere: x, y, z",
        f"      +x             U = (Ux, Uy, Uz) in {unit}",
    ]


def own_test(name: str, test: tuple[str, str, str], needs: str = "") -> list[str]:
    """Return comment lines with the test of an exported file `name`.

    They state how to run the test and what it `needs`; the three lines of the test follow, each after `MARK`.
    """
    of = "the numbers that give a, and of the check vectors (not of u and covariances)"
    how = f"""test of {of}: python -c "$(sed -n 's/^# {MARK}//p' {name})" {name}"""
    return [f"{how}{needs}", *(f"{MARK}{line}" for line in test)]


def check_lines(raw: Floats, corrected: Floats, names: str, unit: str) -> list[str]:
    """Return check vectors as lines: signals `raw` (n, 3), accelerations `corrected` (n, 3) in `unit`."""
    rows = np.hstack([raw, corrected]).tolist()
    return [f"check vectors: {names} in {unit}", *(f"check: {' '.join(map(repr, row))}" for row in rows)]


READ_CHECKS: Final = (
    "c = [[float(x) for x in l[9:].split()] for l in open(sys.argv[1]) if l.startswith('# check: ')]"
)
"""The statement of a test that reads the lines of `check_lines`."""


def judged(g: str = "1.0", at: int = 3, count: int = COUNT) -> str:
    """Return the last line of a test, which asserts that the accelerations agree with the check vectors.

    The test has a function `a`, which maps the first `at` numbers of a check vector to an acceleration; `g`
    is 1 g in the unit of that acceleration. `count` is the number of check vectors that the file must have.
    """
    worst = (
        f"max([abs(p - q) for r in c for p, q in zip(a(r[:{at}]), r[{at}:])] + [9e9] * (len(c) != {count}))"
    )
    failed = "FAILED: numbers that give a, or check vectors, are not as written"
    return f"assert {worst} <= {TOLERANCE:g} * {g}, {failed!r}"


def c_self_test(prefix: str, rows: Floats, call: str) -> str:
    """Return the check vectors `rows` (n, m) and the function `<prefix>_self_test` in C.

    The last three columns of `rows` are the corrected accelerations; the statement `call` computes `a` from `row`.
    """
    listed = ",\n".join("    {" + ", ".join(double(value) for value in row) + "}" for row in rows)
    at = rows.shape[1] - 3
    upper = prefix.upper()
    return f"""#define {upper}_CHECKS {len(rows)}

/* check vectors: {"temperature in deg C, " if at > 3 else ""}Ux, Uy, Uz, then ax, ay, az in local g */
static const double {prefix}_check[{upper}_CHECKS][{rows.shape[1]}] = {{
{listed}
}};

/* Returns how many check vectors are not met to {TOLERANCE:g} g: 0 when all numbers for a are as written. */
static inline int {prefix}_self_test(void)
{{
    int i, k, wrong, failed = 0;

    for (i = 0; i < {upper}_CHECKS; i++) {{
        const double *row = {prefix}_check[i];
        double a[3];

        {call}
        wrong = 0;
        for (k = 0; k < 3; k++)
            if (!(a[k] - row[{at} + k] <= {TOLERANCE:g} && row[{at} + k] - a[k] <= {TOLERANCE:g}))
                wrong = 1;
        failed += wrong;
    }}
    return failed;
}}
"""


def facts(model: TemperatureModel, table: CompensationTable, of: str) -> list[str]:
    """Return the header lines of an exported file: block (`of`), valid range, and errors of interpolation."""
    error = table.error
    return [
        f"Compensation of {of}",
        f"a = N(T) (U - U0(T)): a in local g ({model.g_m_s2!r} m/s^2), U in {model.unit}, T in deg C.",
        f"Valid from {model.minimum_c:.2f} to {model.maximum_c:.2f} deg C; {table.nodes} temperatures, "
        "linear between them.",
        f"Found against the polynomials at {error.looks} temperatures: interpolation adds at most "
        f"{error.bias:.2g} g,",
        f"and {error.per_g:.2g} for each g of acceleration; single precision at most {error.single:.2g} g up to "
        f"{error.reach_g:g} g.",
        f"u of a from the calibration (k = 1): at most {model.largest_u_g:.2g} g at 1 g; the JSON result has the "
        "covariance.",
        "Above 1 g the block's nonlinearity K2 a^2 and K3 a^3 adds to it ('bench budget').",
        "It excludes the noise of U and the error of the later T, 1 K of which changes a at 1 g by up to "
        f"{model.per_kelvin_g:.2g} g.",
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

/* The same in double precision. */
static inline int compensation_specific_force_double(const double u[3], double t_c, double a[3])
{{
    double row[12], part;
    int low, k, outside = 0;

    if (t_c != t_c)
        return -1;
    if (t_c < {table.first_c!r}) {{
        t_c = {table.first_c!r};
        outside = 1;
    }}
    if (t_c > {model.maximum_c!r}) {{
        t_c = {model.maximum_c!r};
        outside = 1;
    }}
    part = (t_c - {table.first_c!r}) / {table.step_k!r};
    low = (int)part;
    if (low > COMPENSATION_NODES - 2)
        low = COMPENSATION_NODES - 2;
    part -= low;
    for (k = 0; k < 12; k++)
        row[k] = (double)compensation_table[low][k]
            + part * ((double)compensation_table[low + 1][k] - (double)compensation_table[low][k]);
    for (k = 0; k < 3; k++)
        a[k] = row[3 * k] * (u[0] - row[9]) + row[3 * k + 1] * (u[1] - row[10])
            + row[3 * k + 2] * (u[2] - row[11]);
    return outside;
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
