"""The file formats of an exported calibration: JSON, CSV, C header, Excel workbook, files for autopilots."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.base.arrays import ARCSEC, CHANNELS, Floats
from bench.base.files import to_text
from bench.base.languages import HEADING, message, translated
from bench.base.numbers import fixed, places, uncertainty
from bench.base.tables import table
from bench.base.text import comment, double, visible
from bench.calibration.result import INVERSE, NOT_DETERMINED
from bench.exchange.autopilots import ARDUPILOT, PX4, kalibr_notes, kalibr_yaml
from bench.exchange.checks import TOLERANCE, c_self_test, judged, own_test, picture
from bench.exchange.result import CONVENTION, NINE, BlockResult, ReportedNumber

if TYPE_CHECKING:
    from openpyxl import Workbook
    from openpyxl.worksheet.worksheet import Worksheet


def csv_text(result: BlockResult) -> str:
    """Return CSV text: a table of all numbers (name, value, u, U, unit), then each covariance with a title.

    Comment lines begin with #; a covariance has its names in the first row and the first column. Each number has
    enough digits to be read back exactly.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")

    def told(*lines: str) -> None:
        out.writelines(f"# {line}\r\n" for line in lines)

    told(*result.head(), "U = K a + U0; a = N (U - U0)", CONVENTION, NINE, *picture(result.unit))
    told(*own_test("FILE.csv", _CSV_TEST))
    writer.writerow(["name", "value", "u", "U", "unit"])
    alone = result.inverse.rows[:9]
    for row in (*result.coefficients.rows, *alone, *result.misalignments.rows, *result.intrinsic.rows):
        writer.writerow([row.name, repr(row.value), *_cells(row, repr), row.unit])
    for of, title in (
        (result.coefficients, "covariance of the coefficients"),
        (result.inverse, "covariance of N and U0"),
        (result.misalignments, "covariance of the misalignment angles, rad^2"),
        (result.intrinsic, "covariance of the nine, in their units"),
    ):
        told(title)
        writer.writerow(["covariance", *of.names])
        writer.writerows(
            [name, *map(repr, row)] for name, row in zip(of.names, of.covariance.tolist(), strict=True)
        )
    told("check vectors: signals, and the accelerations N (U - U0) in g that must follow")
    writer.writerow(["check", "Ux", "Uy", "Uz", "ax", "ay", "az"])
    rows = np.hstack(result.check).tolist()
    writer.writerows([str(number), *map(repr, row)] for number, row in enumerate(rows, 1))
    return out.getvalue()


def _cells(row: ReportedNumber, shown: Callable[[float], Any] = float) -> list[Any]:
    """Return u and U of a number as `shown`, or words for a number that is zero by convention."""
    return [shown(size) if row.determined else NOT_DETERMINED for size in (row.u, row.U)]


_CSV_TEST: Final = (
    "import csv, sys; rows = [r for r in csv.reader(open(sys.argv[1], newline='')) if r[0][:1] != '#']; "
    "n = {r[0]: float(r[1]) for r in rows[1:37]}; c = [[float(x) for x in r[1:]] for r in rows if r[0].isdigit()]",
    "def a(u): return [sum(n['N' + i + j] * (u[k] - n['U0' + j]) for k, j in enumerate('xyz')) for i in 'xyz']",
    judged(),
)


def c_header(result: BlockResult) -> str:
    """Return a self-contained C99 header: N, U0, their covariance, functions for force and its covariance."""
    numbers = result.inverse
    rows = ",\n".join(f"    {_row(row)}" for row in numbers.covariance)
    n = ",\n".join(
        f"    {_row(row)}{_open([one.name for one in numbers.rows[3 * i : 3 * i + 3] if not one.determined])}"
        for i, row in enumerate(numbers.values[:9].reshape(3, 3))
    )
    head = comment(
        [
            *result.head(),
            f"a = N (U - U0): a in local g, U in {result.unit}.",
            *picture(result.unit),
            "coefficients_self_test() returns 0 when N, U0 and the check vectors are as they were written.",
            "U of N and U0: "
            + ", ".join(f"{row.name} {uncertainty(row.U)}" for row in numbers.rows if row.determined),
        ]
    )
    tested = c_self_test("coefficients", np.hstack(result.check), "coefficients_specific_force(row, a);")
    return f"""/*
{head}
 */
#ifndef BENCH_COEFFICIENTS_H
#define BENCH_COEFFICIENTS_H

#define COEFFICIENTS_SIMULATED {int(result.simulated)}
#define COEFFICIENTS_ACCEPTED {int(result.fits)}
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

/*
 * Covariance c[3][3] of that a, in g^2, from the covariance of N and U0. It holds up to 1 g: noise of u and, above
 * 1 g, nonlinearity of the block are not in it (see "range" in the head of this file).
 */
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

{tested}
#endif
"""


def _open(names: Sequence[str]) -> str:
    """Return a C comment that `names` are zero by convention; empty without names."""
    return f" /* {', '.join(names)}: {NOT_DETERMINED} */" if names else ""


def _row(values: Floats) -> str:
    return "{" + ", ".join(double(value) for value in values) + "}"


def workbook(result: BlockResult) -> bytes:
    """Return an .xlsx file: origin, all numbers, four covariances, conversion of signals, check vectors."""
    from openpyxl import Workbook

    book = Workbook()
    about = book.active
    about.title = "about"
    _write(about, [[name, text] for name, text in result.facts().items()])
    _write(
        about, [["model", "U = K a + U0; a = N (U - U0)"], ["misalignments", CONVENTION], ["intrinsic", NINE]]
    )
    _write(about, [["signs" if not k else "", line] for k, line in enumerate(picture(result.unit))])
    about.column_dimensions["A"].width, about.column_dimensions["B"].width = 18, 110
    tables = {
        "coefficients": ("K U0", result.coefficients),
        "inverse": ("N U0", result.inverse),
        "misalignments": ("alpha", result.misalignments),
        "intrinsic": ("intrinsic", result.intrinsic),
    }
    for title, (_, numbers) in tables.items():
        cells = [[row.name, row.value, *_cells(row), row.unit] for row in numbers.rows]
        _write(book.create_sheet(title), [["name", "value", "u", "U", "unit"], *cells])
    for of, numbers in tables.values():
        rows = [[name, *row] for name, row in zip(numbers.names, numbers.covariance.tolist(), strict=True)]
        _write(book.create_sheet(f"covariance {of}"), [["", *numbers.names], *rows])
    _conversion(book.create_sheet("a from U"), result)
    _checks(book.create_sheet("check"), result)
    return _saved(book, simulated=result.simulated)


def tables_workbook(tables: Mapping[str, Sequence[Sequence[Any]]], *, simulated: bool = False) -> bytes:
    """Return an .xlsx file with a sheet for each table; a text stays a text, even if it looks like a formula."""
    from openpyxl import Workbook

    book = Workbook()
    book.remove(book.active)
    for title, rows in tables.items():
        sheet = book.create_sheet(title)
        _write(sheet, rows)
        sheet.freeze_panes = "A2"
    return _saved(book, simulated=simulated)


def _saved(book: Workbook, *, simulated: bool) -> bytes:
    """Return the file of a workbook; with `simulated`, each printed page says so."""
    for sheet in book.worksheets if simulated else ():
        sheet.oddHeader.center.text = "SIMULATED"
    out = io.BytesIO()
    book.save(out)
    return out.getvalue()


def _write(sheet: Worksheet, rows: Sequence[Sequence[Any]]) -> None:
    """Append rows; text that begins like a formula is stored as text."""
    for row in rows:
        at = sheet.max_row + (sheet.cell(sheet.max_row, 1).value is not None)
        for column, value in enumerate(row, 1):
            cell = sheet.cell(at, column)
            cell.value = visible(value) if isinstance(value, str) else value
            if isinstance(value, str):
                cell.data_type = "s"


def _conversion(sheet: Worksheet, result: BlockResult) -> None:
    """Fill in the sheet that computes a, |a| and the U of |a| from three signals that the user types.

    At first the sheet contains the signals that the model gives for +1 g on z. N is in B2:B10 of the sheet
    "inverse", U0 in B11:B13. U of |a| is computed to first order from the covariance of N and U0.
    """
    upright = result.block.output(np.array([[0.0, 0.0, 1.0]]))[0]
    _write(sheet, [["", *CHANNELS], [f"U / {result.unit}", *upright.tolist()]])
    _write(
        sheet,
        [
            ["U - U0"],
            ["a / g"],
            ["|a| / g"],
            [f"U of |a| / g (k = {result.k:g}) up to 1 g, without noise of U"],
        ],
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


def _checks(sheet: Worksheet, result: BlockResult) -> None:
    """Fill in the check vectors, formulas for them with the sheet "inverse", and (B1) the verdict."""
    _write(
        sheet,
        [
            ["N, U0 and these vectors are"],
            ["check", "Ux", "Uy", "Uz", "ax", "ay", "az", "ax here", "ay here", "az here", "off"],
        ],
    )
    for row, values in enumerate(np.hstack(result.check).tolist(), 3):
        _write(sheet, [[row - 2, *values]])
        for i, column in enumerate("HIJ"):
            terms = [
                f"inverse!$B${2 + 3 * i + j}*({u}{row}-inverse!$B${11 + j})" for j, u in enumerate("BCD")
            ]
            sheet[f"{column}{row}"] = "=" + "+".join(terms)
        off = [f"ABS({here}{row}-{told}{row})" for here, told in zip("HIJ", "EFG", strict=True)]
        sheet[f"K{row}"] = f"=MAX({','.join(off)})"
    sheet["B1"] = f'=IF(MAX(K3:K22)<={TOLERANCE:g},"as they were written","NOT AS THEY WERE WRITTEN")'


# --- for a person -------------------------------------------------------------------------------------


def print_coefficients(result: BlockResult, on: Console) -> None:
    """Print the facts in every file's header, N and U0, misalignment angles, and the intrinsic numbers."""
    for name, text in result.facts().items():
        lead = "" if name == "mark" else f"{translated(name, HEADING)}: "
        told = text if name in ("block", "source", "bench") else translated(text)
        on.print(Text(lead + told), style="bold" if name in ("mark", "fit") else None)
    on.print("a = N (U - U0), a the specific force in g of the place")
    on.print(_table(result.inverse.rows, result.k))
    on.print("misalignment angles of the input axes, K_ij = (-1)^n K_ii alpha_ji, n = 2 where j follows i")
    on.print(_table(result.misalignments.rows, result.k, 1.0 / ARCSEC, "arcsec"))
    on.print(NINE)
    on.print(_table(result.intrinsic.rows, result.k))


def _table(rows: Iterable[ReportedNumber], k: float, times: float = 1.0, unit: str = "") -> Table:
    """Return a table of numbers with u and U, multiplied by `times` (then in `unit`), to two digits of u."""
    shown = table("", ">value", ">u", f">U (k={k:g})", "")
    for row in rows:
        if not row.determined:
            shown.add_row(row.name, "0", "", "", NOT_DETERMINED)
            continue
        digits = places(times * row.u)
        cells = (fixed(times * size, digits) for size in (row.value, row.u, row.U))
        shown.add_row(row.name, *cells, unit or row.unit)
    return shown


# --- the forms by name ----------------------------------------------------------------------------


@dataclass(frozen=True)
class ExportForm:
    """A file format: its name in `words`, suffix of file names, and the function that returns the content.

    `loses` is a function that returns comment lines on the parts of a result that the format omits; it is
    None if the format omits nothing. Both functions accept the scale factors (3,) in unit/g by which signals
    were converted to m/s²; the default is as in `sensor_of`.
    """

    words: str
    suffix: str
    write: Callable[[BlockResult, Floats | None], str | bytes]
    loses: Callable[[BlockResult, Floats | None], list[str]] | None = None


FORMS: Final = {
    "json": ExportForm("JSON", ".json", lambda result, _: to_text(result.to_dict())),
    "csv": ExportForm("CSV", ".csv", lambda result, _: csv_text(result)),
    "c": ExportForm(message("C header"), ".h", lambda result, _: c_header(result)),
    "excel": ExportForm(message("Excel workbook"), ".xlsx", lambda result, _: workbook(result)),
    "kalibr": ExportForm("Kalibr YAML", "-kalibr.yaml", kalibr_yaml, kalibr_notes),
    "px4": ExportForm(message("PX4 parameters"), "-px4.params", PX4.text, PX4.notes),
    "ardupilot": ExportForm(
        message("ArduPilot parameters"), "-ardupilot.param", ARDUPILOT.text, ARDUPILOT.notes
    ),
}
"""The forms by the names that `--as` takes."""
