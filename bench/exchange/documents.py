"""A calibration as JSON, CSV, C header and Excel workbook."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.base.arrays import Floats
from bench.base.files import to_text
from bench.base.text import comment, double, visible
from bench.calibration.result import INVERSE, Derived
from bench.exchange.result import CONVENTION, BlockResult, Row
from bench.model.geometry import COEFFICIENTS

if TYPE_CHECKING:
    from openpyxl.worksheet.worksheet import Worksheet


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


AXES = "xyz"


def workbook(result: BlockResult) -> bytes:
    """Return an .xlsx file: the facts, every number, three covariances, and a sheet that converts signals."""
    from openpyxl import Workbook

    book = Workbook()
    about = book.active
    about.title = "about"
    _write(about, [[name, text] for name, text in result.facts().items()])
    _write(about, [["model", "U = K a + U0; a = N (U - U0)"], ["misalignments", CONVENTION]])
    about.column_dimensions["A"].width, about.column_dimensions["B"].width = 18, 110
    _numbers(book.create_sheet("coefficients"), result.coefficient_rows)
    _numbers(book.create_sheet("inverse"), result.inverse_rows)
    _numbers(book.create_sheet("misalignments"), result.misalignment_rows)
    for title, names, covariance in (
        ("covariance K U0", [row.name for row in result.coefficient_rows], result.covariance),
        ("covariance N U0", result.inverse.names, result.inverse.covariance),
        ("covariance alpha", result.misalignments.names, result.misalignments.covariance),
    ):
        rows = [[name, *row] for name, row in zip(names, covariance.tolist(), strict=True)]
        _write(book.create_sheet(title), [["", *names], *rows])
    _conversion(book.create_sheet("a from U"), result)
    if result.simulated:
        for sheet in book.worksheets:
            sheet.oddHeader.center.text = "SIMULATED"
    out = io.BytesIO()
    book.save(out)
    return out.getvalue()


def _numbers(sheet: Worksheet, rows: Iterable[Row]) -> None:
    _write(sheet, [["name", "value", "u", "U", "unit"], *([r.name, r.value, r.u, r.U, r.unit] for r in rows)])


def _write(sheet: Worksheet, rows: Sequence[Sequence[Any]]) -> None:
    """Append rows; a text is a text, also one that begins like a formula."""
    for row in rows:
        at = sheet.max_row + (sheet.cell(sheet.max_row, 1).value is not None)
        for column, value in enumerate(row, 1):
            cell = sheet.cell(at, column)
            cell.value = visible(value) if isinstance(value, str) else value
            if isinstance(value, str):
                cell.data_type = "s"


def _conversion(sheet: Worksheet, result: BlockResult) -> None:
    """Fill in the sheet in which three signals are typed and a, |a| and its U come out.

    It begins with what the model gives for +1 g on z. N stands in B2:B10 of the sheet "inverse", U0 in B11:B13;
    U of |a| is first order, from their covariance.
    """
    upright = result.block.output(np.array([[0.0, 0.0, 1.0]]))[0]
    _write(sheet, [["", *AXES], [f"U / {result.unit}", *upright.tolist()]])
    _write(
        sheet, [["U - U0"], ["a / g"], ["|a| / g"], [f"U of |a| / g (k = {result.k:g}), without noise of U"]]
    )
    columns = "BCD"
    for j, column in enumerate(columns):
        sheet[f"{column}3"] = f"={column}2-inverse!$B${11 + j}"
        terms = [f"inverse!$B${2 + 3 * j + m}*{other}3" for m, other in enumerate(columns)]
        sheet[f"{column}4"] = "=" + "+".join(terms)
    sheet["B5"] = "=SQRT(B4^2+C4^2+D4^2)"
    # d|a| by N_ij is a_i (U - U0)_j / |a|, by U0_j minus the sum of a_i N_ij / |a|: twelve numbers, then their U
    _write(sheet, [["derivative of |a| by", *result.inverse.names]])
    sheet["A8"] = "is"
    letters = "BCDEFGHIJKLM"
    for i in range(3):
        for j in range(3):
            sheet[f"{letters[3 * i + j]}8"] = f"=${columns[i]}$4*${columns[j]}$3/$B$5"
    for j in range(3):
        terms = [f"${columns[i]}$4*inverse!$B${2 + 3 * i + j}" for i in range(3)]
        sheet[f"{letters[9 + j]}8"] = "=-(" + "+".join(terms) + ")/$B$5"
    rows = [f"B8:M8,'covariance N U0'!B{2 + k}:M{2 + k}" for k in range(12)]
    inner = "+".join(f"{letters[k]}8*SUMPRODUCT({row})" for k, row in enumerate(rows))
    sheet["B6"] = f"={result.k!r}*SQRT({inner})"
    sheet.column_dimensions["A"].width = 44
