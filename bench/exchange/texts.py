"""The result as JSON, as CSV, and as a C header that stands alone."""

from __future__ import annotations

import csv
import io

from bench.analysis.calibration.derived import INVERSE, Derived
from bench.base.arrays import Floats
from bench.base.c_source import comment, double
from bench.base.whole import to_text
from bench.exchange.result import CONVENTION, BlockResult
from bench.model.block import COEFFICIENTS


def json_text(result: BlockResult) -> str:
    """Return the result as JSON."""
    return to_text(result.to_json())


def csv_text(result: BlockResult) -> str:
    """Return a table of every number (name, value, u, U, unit), then the covariances, each under a line of its own.

    Comment lines begin with #; a covariance has its names in the first row and the first column. Numbers are such
    that they read back to the same.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")

    def told(*lines: str) -> None:
        out.writelines(f"# {line}\r\n" for line in lines)

    told(*result.head(), "U = K a + U0; a = N (U - U0)", CONVENTION)
    writer.writerow(["name", "value", "u", "U", "unit"])
    inverse = result.inverse_rows[:9]
    for row in (*result.coefficient_rows, *inverse, *result.misalignment_rows):
        writer.writerow([row.name, repr(row.value), repr(row.u), repr(row.U), row.unit])
    own = Derived(COEFFICIENTS, result.block.vector, result.covariance)
    for of, title in (
        (own, "covariance of the coefficients"),
        (result.inverse, "covariance of N and U0"),
        (result.misalignments, "covariance of the misalignment angles, rad^2"),
    ):
        told(title)
        writer.writerow(["covariance", *of.names])
        writer.writerows(
            [name, *map(repr, row)] for name, row in zip(of.names, of.covariance.tolist(), strict=True)
        )
    return out.getvalue()


def c_header(result: BlockResult) -> str:
    """Return a C99 header that needs nothing else: N, U0, their covariance, functions for a and for its own."""
    numbers = result.inverse
    rows = ",\n".join(f"    {_row(row)}" for row in numbers.covariance)
    n = ",\n".join(f"    {_row(row)}" for row in numbers.values[:9].reshape(3, 3))
    head = comment(
        [
            *result.head(),
            f"a = N (U - U0): a in local g, U in {result.unit}.",
            "U of the coefficients: " + ", ".join(f"{row.name} {row.U:.2g}" for row in result.inverse_rows),
        ]
    )
    return f"""/*
{head}
 */
#ifndef BENCH_COEFFICIENTS_H
#define BENCH_COEFFICIENTS_H

#define COEFFICIENTS_SIMULATED {int(result.simulated)}
#define COEFFICIENTS_LOCAL_GRAVITY_M_S2 {double(result.g_m_s2)}

/* g per {result.unit} */
static const double coefficients_n[3][3] = {{
{n}
}};

/* {result.unit} */
static const double coefficients_u0[3] = {_row(numbers.values[9:])};

/* covariance of {", ".join(INVERSE)} */
static const double coefficients_covariance[12][12] = {{
{rows}
}};

/* Specific force a[3], in local g, from signals u[3]. */
static inline void coefficients_specific_force(const double u[3], double a[3])
{{
    int i, j;

    for (i = 0; i < 3; i++) {{
        a[i] = 0.0;
        for (j = 0; j < 3; j++)
            a[i] += coefficients_n[i][j] * (u[j] - coefficients_u0[j]);
    }}
}}

/* Covariance c[3][3] of that a, in g^2, from the covariance of N and U0; the noise of u is not in it. */
static inline void coefficients_force_covariance(const double u[3], double c[3][3])
{{
    double by[3][12], sum;
    int i, j, k, l;

    for (i = 0; i < 3; i++) {{
        for (k = 0; k < 12; k++)
            by[i][k] = 0.0;
        for (j = 0; j < 3; j++) {{
            by[i][3 * i + j] = u[j] - coefficients_u0[j];
            by[i][9 + j] = -coefficients_n[i][j];
        }}
    }}
    for (i = 0; i < 3; i++)
        for (j = 0; j < 3; j++) {{
            sum = 0.0;
            for (k = 0; k < 12; k++)
                for (l = 0; l < 12; l++)
                    sum += by[i][k] * coefficients_covariance[k][l] * by[j][l];
            c[i][j] = sum;
        }}
}}

#endif
"""


def _row(values: Floats) -> str:
    return "{" + ", ".join(double(value) for value in values) + "}"
