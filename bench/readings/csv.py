"""Readings files: CSV (RFC 4180, UTF-8, dot as decimal sign) to a table of readings and back; points above 1 g."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.base.files import read_given, remedy_for
from bench.base.languages import message
from bench.base.text import repeated, shortened
from bench.readings.columns import (
    LEVEL_COLUMNS,
    METER_C,
    MOUNTING,
    ROOM_C,
    SINCE_POWER_ON_S,
    BadCell,
    angle,
    as_cell,
    direction,
    integer,
    is_of_a_rail,
    number,
    of_cell,
    temperature,
    wrong_level_cell,
)
from bench.readings.table import (
    CHAMBER_C,
    FREE,
    REFERENCE,
    REFERENCE_SD_V,
    REFERENCE_V,
    SCAN_ORDER,
    SHORTED,
    TEMPERATURE_SOURCE,
    UNITS,
    UNORIENTED,
    VERIFICATION,
    Readings,
    make_readings,
    scan_order,
)

if TYPE_CHECKING:
    import pandas as pd

LISTED_AT_ONCE: Final = 20
REQUIRED: Final = ("installation", "pass", "point", "angle_deg")
OPTIONAL: Final = ("series", "target_deg", "direction", "time_s", "temperature_c", "samples")
AS_TEXT: Final = (
    "range_v",
    SCAN_ORDER,
    REFERENCE_V,
    REFERENCE_SD_V,
    TEMPERATURE_SOURCE,
    CHAMBER_C,
    METER_C,
    ROOM_C,
    SINCE_POWER_ON_S,
    MOUNTING,
    *LEVEL_COLUMNS,
)
"""Documented columns that are kept as text."""


_OTHER_UNIT: Final = re.compile(r"u[xyz]_(?!sd_)(\w+)")
"""Pattern of a column of a signal; its group is the suffix for the unit."""


class ReadingsError(ValueError):
    """A readings file that cannot be used; the message lists the mistakes, one per line."""


def read_csv(
    path: Path, installations: Collection[str], *, skip_bad_rows: bool = False, content: bytes | None = None
) -> Readings:
    """Return the table in a readings file; `content` is the file's bytes if they were read already.

    `installations` are the labels in the bench file; V, F, S and R are always known. Raises `ReadingsError` with
    file, line, column and the expected value for every bad row (the first 20, then a count). With
    `skip_bad_rows`, bad rows are instead left out and listed in `Readings.skipped`.
    """
    header, body = split_table(path, _example_header(), content)
    return _read(path, header, body, installations, skip_bad_rows=skip_bad_rows)


def read_frame(
    frame: pd.DataFrame, installations: Collection[str], *, skip_bad_rows: bool = False
) -> Readings:
    """Return the table in a pandas DataFrame with the columns of a readings file; missing values are empty cells.

    Raises `ReadingsError`, like `read_csv`; line numbers count as if the frame were written to a file.
    """
    path, header = Path("DataFrame"), _names(map(str, frame.columns))
    _refuse_header(path, header, _example_header())
    rows = frame.itertuples(index=False, name=None)
    body = _filled(((line, list(map(_cell, row))) for line, row in enumerate(rows, start=2)), len(header))
    return _read(path, header, body, installations, skip_bad_rows=skip_bad_rows)


def _cell(value: object) -> str:
    """Return a value of a frame as a cell; 3.0 gives "3", since pandas makes integers floats if one is missing."""
    if value is None or str(value) == "<NA>" or value != value:  # noqa: PLR0124 - NaN is not itself
        return ""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _read(
    path: Path,
    header: list[str],
    body: list[tuple[int, list[str]]],
    installations: Collection[str],
    *,
    skip_bad_rows: bool,
) -> Readings:
    numbers = {
        *REQUIRED,
        *OPTIONAL,
        *(f"u{axis}_{sd}{s}" for axis in "xyz" for sd in ("", "sd_") for s in UNITS),
    }
    text = [k for k, name in enumerate(header) if name not in numbers]
    for _, cells in body:
        for k in text:
            if k < len(cells):
                cells[k] = of_cell(cells[k])
    header, body, unused = _completed(header, body)
    suffix = _signal_suffix(path, header)
    signals = [f"u{axis}_{suffix}" for axis in "xyz"]
    known = {*REQUIRED, *OPTIONAL, *AS_TEXT, *signals, *(f"u{axis}_sd_{suffix}" for axis in "xyz")}
    labels = {*installations, VERIFICATION, FREE, SHORTED, REFERENCE}

    rows: list[dict[str, float]] = []
    kept: list[dict[str, str]] = []
    bad: list[str] = []
    verification_missing = 0
    seen: dict[tuple[float, str, float, float], int] = {}
    for line, cells in body:
        try:
            row = _row(header, cells, signals, labels, unused)
            key = (row["series"], cells[header.index("installation")].strip(), row["pass"], row["point"])
            if key in seen:
                raise BadCell(
                    "point",
                    f"series {key[0]:g}, installation {key[1]}, pass {key[2]:g}, point {key[3]:g} "
                    f"is already in line {seen[key]}; give a second visit another number in the column "
                    "'series'",
                )
        except BadCell as problem:
            bad.append(message(f"{path}, line {line}, column {problem.column}: {problem}"))
            verification_missing += VERIFICATION in (cell.strip() for cell in cells)
            continue
        seen[key] = line
        rows.append(row)
        kept.append(dict(zip(header, cells, strict=True)))

    if bad and not (skip_bad_rows and rows):
        raise ReadingsError(_listing(bad))
    if not rows:
        raise ReadingsError(f"{path}: no readings; expected a header line and a row for each reading")
    unknown = ", ".join(name for name in header if name not in known and not is_of_a_rail(name))
    notes = (message(f"columns kept but not used: {unknown}"),) if unknown else ()
    value: dict[str, Any] = {
        name: np.array([row[name] for row in rows], dtype=np.float64) for name in rows[0]
    }
    table = make_readings(
        [label for _, label, _, _ in seen],
        value["pass"],
        value["point"],
        np.radians(value["angle_deg"]),
        np.stack([value[name] for name in signals], axis=1),
        source=str(path),
        unit=UNITS[suffix],
        target_rad=np.radians(value["target_deg"]),
        signal_sd=np.stack([value[_sd(name)] for name in signals], axis=1),
        **{name: value[name] for name in ("series", "direction", "time_s", "temperature_c", "samples")},
    )
    lines = list(seen.values())
    texts = [name for name in header if name not in known or name in AS_TEXT]
    return replace(
        table,
        extra={name: np.array([cells[name] for cells in kept], dtype=np.str_) for name in texts},
        notes=(*notes, *_times_that_fall(table, lines), *_large_scatter(table, lines)),
        skipped=tuple(bad),
        verification_missing=verification_missing,
    )


def _completed(
    header: list[str], body: list[tuple[int, list[str]]]
) -> tuple[list[str], list[tuple[int, list[str]]], frozenset[str]]:
    """Return header and rows with missing columns added, and the names of the signal columns without values.

    Only in a record at a known input (rows R only) may columns be missing: pass, point, angle, and one or two of
    the three signals. Other tables are returned unchanged.
    """
    label = header.index("installation") if "installation" in header else len(header)
    if not body or any(cells[label : label + 1] != [REFERENCE] for _, cells in body):
        return header, body, frozenset()
    suffixes = [s for s in UNITS if any(f"u{axis}_{s}" in header for axis in "xyz")]
    signals = [f"u{axis}_{suffixes[0]}" for axis in "xyz"] if len(suffixes) == 1 else []
    added = [name for name in ("pass", "point", "angle_deg", *signals) if name not in header]
    whole = [*header, *added]
    rows = []
    for number_of_row, (line, cells) in enumerate(body, start=1):
        known = {"pass": "1", "point": str(number_of_row)}
        rest = [known.get(name, "") for name in added] if len(cells) == len(header) else []
        rows.append((line, [*cells, *rest]))
    full = [cells for _, cells in rows if len(cells) == len(whole)]
    blank = {name for name in signals if not any(cells[whole.index(name)].strip() for cells in full)}
    return whole, rows, frozenset(blank if len(blank) < len(signals) else ())


def split_table(
    path: Path, example: str, content: bytes | None = None
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header of a CSV file in lower case, and the rows that are not empty as (line number, cells).

    `example` is a valid header for the error message, `content` the file's bytes if they were read already.
    Raises `ReadingsError` if the file is not a CSV table.
    """
    try:
        text = (read_given(path) if content is None else content).decode("utf-8-sig")
    except OSError as error:
        remedy = remedy_for(error, "check the name")
        raise ReadingsError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    except UnicodeDecodeError as error:
        raise ReadingsError(f"{path}: not a UTF-8 text file; save it as CSV in UTF-8") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = _names(next(reader, []))
        body = _filled(_with_lines(reader), len(header))
    except csv.Error as error:
        raise ReadingsError(f"{path}, line {reader.line_num}: not CSV; save it as CSV ({error})") from error
    _refuse_header(path, header, example)
    return header, body


def _names(cells: Iterable[str]) -> list[str]:
    return _without_empty_end([of_cell(name).strip().lower() for name in cells], 0)


def _with_lines(reader: Any) -> Iterator[tuple[int, list[str]]]:
    """Yield each row of a CSV reader with the line in which it begins."""
    line = reader.line_num + 1
    for cells in reader:
        yield line, cells
        line = reader.line_num + 1


def _filled(rows: Iterable[tuple[int, list[str]]], columns: int) -> list[tuple[int, list[str]]]:
    """Return the rows that are not empty, without empty cells beyond the header."""
    return [(line, _without_empty_end(cells, columns)) for line, cells in rows if any(map(str.strip, cells))]


def _refuse_header(path: Path, header: list[str], example: str) -> None:
    """Raise `ReadingsError` for a header that is empty, not separated by commas, or has a column twice."""
    if not header:
        raise ReadingsError(f"{path}: empty; expected a header line such as {example}")
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        raise ReadingsError(
            f"{path}, line 1: the columns are not separated by commas; separate them by commas, and write "
            "decimals with a dot ('bench import --columns MAP.yaml' reads other logs)"
        )
    twice = sorted(map(shortened, repeated(header)))
    if twice:
        raise ReadingsError(f"{path}, line 1: column {', '.join(twice)} appears more than once; keep one")


def _without_empty_end(cells: list[str], least: int) -> list[str]:
    """Return the cells without empty ones at the end (as spreadsheets add), but at least `least` cells."""
    while len(cells) > least and not cells[-1].strip():
        cells = cells[:-1]
    return cells


def _signal_suffix(path: Path, header: list[str]) -> str:
    """Return the unit suffix shared by the three signal columns, such as "v".

    Raises `ReadingsError` if a required column is missing or the units differ.
    """
    present = [s for s in UNITS if any(f"u{axis}_{s}" in header for axis in "xyz")]
    missing = [name for name in REQUIRED if name not in header]
    if len(present) > 1:
        raise ReadingsError(
            f"{path}, line 1: signal columns in different units ({', '.join(present)}); convert them to one "
            "unit, such as ux_v, uy_v, uz_v"
        )
    suffix = present[0] if present else "v"
    missing += [f"u{axis}_{suffix}" for axis in "xyz" if f"u{axis}_{suffix}" not in header]
    if missing:
        hint = "" if present else _on_units(header)
        if not hint and not set(REQUIRED) & set(header):
            hint = message(" ('bench import --columns MAP.yaml' reads other logs)")
        raise ReadingsError(
            f"{path}, line 1: the header lacks {', '.join(missing)}; expected at least {_example_header()}{hint}"
        )
    return suffix


def _on_units(header: Iterable[str]) -> str:
    """Return what to do about a signal in a unit that readings files do not accept; "" if there is none."""
    found = next(filter(None, map(_OTHER_UNIT.fullmatch, header)), None)
    if found is None:
        return ""
    read = ", ".join(f"{unit} (ux_{suffix})" for suffix, unit in UNITS.items())
    mapped = f"{{columns: {found[0]}, unit: {found[1][:-1]}V}}"
    by_map = message(
        f", or let 'bench import --columns MAP.yaml' convert them, by {found[0][:3]}v: {mapped} in MAP.yaml"
    )
    return message(
        f"; signals are read in {read} only, not as {found[0]}: convert them"
        f"{by_map if found[1].endswith('v') else ''}"
    )


def _example_header() -> str:
    return ",".join([*REQUIRED, "ux_v", "uy_v", "uz_v"])


def _row(
    header: list[str], cells: list[str], signals: list[str], labels: Collection[str], unused: Collection[str]
) -> dict[str, float]:
    """Return the numbers of one row by column name; cells of the signals `unused` may be empty.

    Raises `BadCell` for the first invalid cell.
    """
    if len(cells) != len(header):
        raise BadCell(
            header[min(len(cells), len(header) - 1)],
            f"expected {len(header)} cells as in the header, got {len(cells)}"
            + (message(" (use a dot, not a decimal comma)") if len(cells) > len(header) else ""),
        )
    text = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
    label = text["installation"]
    if label not in labels:
        raise BadCell(
            "installation",
            f"expected one of {', '.join(sorted(labels))} (a bench file can define more), got {shortened(label)!r}",
        )
    row = {
        "series": integer(text, "series", default=1),
        "pass": integer(text, "pass"),
        "point": integer(text, "point"),
        "angle_deg": angle(text, "angle_deg", optional=label in UNORIENTED),
        "target_deg": angle(text, "target_deg", optional=True),
        "direction": direction(text),
        "time_s": number(text, "time_s", message("a time in seconds"), optional=True),
        "temperature_c": temperature(text, "temperature_c"),
        "samples": integer(text, "samples", default=1),
    }
    try:
        scan_order(text.get(SCAN_ORDER, ""))
    except ValueError as problem:
        raise BadCell(SCAN_ORDER, str(problem)) from None
    if wrong := wrong_level_cell(text):
        raise BadCell(*wrong)
    for name in (CHAMBER_C, METER_C, ROOM_C):
        temperature(text, name)
    integer(text, MOUNTING, default=0)
    number(text, SINCE_POWER_ON_S, message("a time in seconds, 0 or more"), optional=True, least=0.0)
    number(text, REFERENCE_V, message("the voltage at the inputs in V"), optional=True)
    number(text, REFERENCE_SD_V, message("the scatter of the meters that read it in V"), optional=True)
    for name in filter(is_of_a_rail, header):
        number(text, name, message("a voltage or a current of a rail in V or A"), optional=True)
    for name in signals:
        row[name] = number(
            text, name, message("a number with a dot as decimal sign"), optional=name in unused
        )
        row[_sd(name)] = number(
            text, _sd(name), message("a standard deviation, 0 or more"), optional=True, least=0.0
        )
    return row


def _sd(signal: str) -> str:
    """Return the column of the standard deviation of a signal: "ux_sd_v" for "ux_v"."""
    return f"{signal[:2]}_sd{signal[2:]}"


def _listing(bad: list[str]) -> str:
    lines = bad[:LISTED_AT_ONCE]
    if len(bad) > LISTED_AT_ONCE:
        lines.append(message(f"… and {len(bad) - LISTED_AT_ONCE} more bad rows ({len(bad)} in all)"))
    lines.append(message("nothing was used; correct the rows, or skip them with --skip-bad-rows"))
    return "\n".join(lines)


def write_csv(readings: Readings, path: Path) -> None:
    """Write a readings file with all columns of the table; `read_csv` returns its text columns unchanged."""
    path.write_text(format_csv(readings), encoding="utf-8", newline="")


def format_csv(readings: Readings, *, to_the_bit: bool = False) -> str:
    """Return the table as the text of a readings file.

    Numbers read back to the same value, and angles to within 1e-12 degrees. Without `to_the_bit`, signals are
    written without the rounding error that averaging caused: 0.91 for 0.9099999999999999.
    """
    signal = _text if to_the_bit else _signal
    suffix = next(s for s, unit in UNITS.items() if unit == readings.unit)
    table: dict[str, Iterable[str]] = {
        "series": (str(v) for v in readings.series),
        "installation": readings.installation.tolist(),
        "pass": (str(v) for v in readings.pass_number),
        "point": (str(v) for v in readings.point),
        "angle_deg": (_text(v) for v in _degrees(readings.angle_rad)),
        "target_deg": (_text(v) for v in _degrees(readings.target_rad)),
        "direction": ("" if v == 0 else f"{v:+d}" for v in readings.direction),
        "time_s": (_text(v) for v in readings.time_s),
        "temperature_c": (_text(v) for v in readings.temperature_c),
        "samples": (str(v) for v in readings.samples),
    }
    for i, axis in enumerate("xyz"):
        table[f"u{axis}_{suffix}"] = map(signal, readings.signal[:, i].tolist())
    for i, axis in enumerate("xyz"):
        table[f"u{axis}_sd_{suffix}"] = (_text(v) for v in readings.signal_sd[:, i])
    table.update({as_cell(name): map(as_cell, cells.tolist()) for name, cells in readings.extra.items()})
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    return out.getvalue()


def _degrees(angle_rad: Floats) -> Floats:
    # rounded, as 100.1 degrees would return from radians as 100.10000000000001
    return np.asarray(np.round(np.degrees(angle_rad), 12), dtype=np.float64)


def _text(value: float) -> str:
    """Return the shortest text that reads back to the same value, an empty text for NaN."""
    return "" if math.isnan(value) else repr(float(value))


ROUNDED: Final = 16
"""The largest rounding error of a mean of samples, in units in the last place (ulp)."""


def _signal(value: float) -> str:
    """Return a signal as text without the rounding error that averaging caused; an empty text for NaN."""
    short = float(f"{value:.12g}")
    return _text(short if abs(short - value) <= ROUNDED * math.ulp(value) else value)


# --- doubts about a table ---------------------------------------------------------------------------


def _times_that_fall(readings: Readings, lines: Sequence[int]) -> list[str]:
    """Return a sentence if a time is before that of an earlier row; `lines` are the line numbers of the rows."""
    known = np.flatnonzero(np.isfinite(readings.time_s))
    back = known[1:][np.diff(readings.time_s[known]) < 0.0]
    if not len(back):
        return []
    where = message(f"line {lines[back[0]]}") + (
        message(f" and {len(back) - 1} more") if len(back) > 1 else ""
    )
    return [message(f"time_s runs backwards ({where}): put the rows back in the order of measurement")]


def _large_scatter(readings: Readings, lines: Sequence[int]) -> list[str]:
    """Return a sentence for each channel with a standard deviation above the range of all its readings."""
    told = []
    for i, axis in enumerate(CHANNELS):
        sd, span = readings.signal_sd[:, i], float(np.ptp(readings.signal[:, i]))
        if len(readings) > 2 and np.nanmax(np.append(sd, 0.0)) > span > 0.0:
            worst = int(np.nanargmax(sd))
            told.append(
                message(
                    f"the standard deviation of u{axis} in line {lines[worst]}, {sd[worst]:.3g} {readings.unit}, "
                    f"exceeds the spread of all its readings, {span:.3g} {readings.unit}: check its unit"
                )
            )
    return told


# --- points above 1 g, from a centrifuge -------------------------------------------------------------

FORCES: Final = ("ax_ms2", "ay_ms2", "az_ms2")
UNCERTAIN: Final = ("u_ms2", "u_relative")
SIGNALS: Final = ("ux_v", "uy_v", "uz_v")
EXAMPLE: Final = ",".join((*FORCES, *UNCERTAIN, *SIGNALS))


@dataclass(frozen=True)
class CentrifugePoints:
    """Signals (n, 3), V, at specific forces (n, 3) on the block's axes, m/s^2; NaN where no signal was read.

    Only the magnitudes of the forces are uncertain. Their u has two parts: `u_ms2` (n,), m/s², is independent
    between points; the fraction `u_relative` (n,) comes from an error common to all points, such as the radius.
    """

    source: str
    force_ms2: Floats
    u_ms2: Floats
    u_relative: Floats
    signal: Floats


def read_centrifuge(path: Path) -> CentrifugePoints:
    """Return the points above 1 g in a CSV file with the columns of `EXAMPLE`; cells of signals not read are empty.

    Raises `ReadingsError` for missing columns, rows without a signal, and cells that are not numbers.
    """
    header, body = split_table(path, EXAMPLE)
    names = (*FORCES, *UNCERTAIN, *SIGNALS)
    missing = [name for name in names if name not in header]
    if missing:
        raise ReadingsError(
            f"{path}, line 1: the header lacks {', '.join(missing)}; add these columns: points have {EXAMPLE}"
        )
    rows, bad = [], []
    for line, cells in body:
        text = dict(zip(header, cells, strict=False))
        try:
            row = [number(text, name, "a force in m/s²") for name in FORCES]
            row += [number(text, name, "a standard uncertainty", least=0.0) for name in UNCERTAIN]
            row += [number(text, name, "a signal in V", optional=True) for name in SIGNALS]
        except BadCell as wrong:
            bad.append(message(f"{path}, line {line}, column {wrong.column}: {wrong}"))
            continue
        if np.all(np.isnan(row[5:])):
            bad.append(message(f"{path}, line {line}: no signal; give one or more of {', '.join(SIGNALS)}"))
        rows.append(row)
    if bad or not rows:
        raise ReadingsError(
            "\n".join(bad[:LISTED_AT_ONCE]) or f"{path}: has no points; add rows of {EXAMPLE}"
        )
    table = np.array(rows)
    return CentrifugePoints(str(path), table[:, :3], table[:, 3], table[:, 4], table[:, 5:])
