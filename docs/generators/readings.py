"""The page on readings files: the columns that the reader knows."""

from __future__ import annotations

from typing import Final

from pydantic import BaseModel

from bench.config.foreign_log import LogColumn, LogColumns
from bench.readings import csv
from bench.readings.table import UNITS
from docs.generators.forms import sections
from docs.generators.markdown import code, table

COLUMNS: Final[dict[str, tuple[str, str]]] = {
    "installation": (
        "–",
        "`1`, `2` (the paper's Fig. 2) or a label of the bench file; `V` a verification point, in the fit only on "
        "request; `F` a free position, of which only |a| = 1 g is known; `S` inputs shorted; `R` a reference "
        "voltage at the input",
    ),
    "pass": ("–", "1, 2, …: number of the round through all points"),
    "point": ("–", "number of the test point; a setting has the same number in each pass"),
    "angle_deg": ("°", "angle of the head as read back from its scale; empty for `F`, `S`, `R`"),
    "series": (
        "–",
        "another number for a further visit to an installation (a return, another temperature); default 1",
    ),
    "mounting_number": (
        "–",
        "the same number in all series during which the block stayed mounted, as when it was only switched on "
        "again: these series share the errors of the stand; empty if each series is a mounting",
    ),
    "target_deg": ("°", "commanded angle"),
    "direction": ("–", "+1 approached with rising angle, −1 with falling; may be empty"),
    "time_s": ("s", "since the start of the run; may be empty"),
    "temperature_c": ("°C", "temperature at the block; may be empty"),
    "samples": ("–", "number of the meter's samples in the mean"),
    "range_v": ("V", "range of the meter"),
    "since_power_on_s": ("s", "since the block was switched on, for `warm_up`; may be empty"),
    "scan_order": ("–", "order in which the channels were read, such as `xyz`"),
    "reference_v": ("V", "voltage at a reference input, for `R`"),
    "reference_sd_v": ("V", "scatter of the meters that read `reference_v`, counts as its u; may be empty"),
    "temperature_source": (
        "–",
        "the thermometer at the block that measured `temperature_c`, if there is one",
    ),
    "chamber_c": ("°C", "air temperature of the chamber"),
    "meter_temperature_c": (
        "°C",
        "temperature of the voltmeters, for `voltmeter_thermal_gain` and `_offset`; may be empty",
    ),
    "room_c": ("°C", "temperature of the room; used for the voltmeters if theirs is not recorded"),
    "alpha1_arcsec": ("″", "tilt of the shaft's axis in this mounting, measured by a level"),
    "alpha2_arcsec": ("″", "tilt about the shaft, measured by a level: the head's zero against the vertical"),
    "u_alpha1_arcsec": ("″", "standard uncertainty of `alpha1_arcsec`"),
    "u_alpha2_arcsec": (
        "″",
        "standard uncertainty of `alpha2_arcsec`; a file has all four or none",
    ),
    "drift_alpha1_arcsec_h": (
        "″/h",
        "rate of the platform's tilt along the shaft, if the level was read again; the same in all rows",
    ),
    "drift_alpha2_arcsec_h": ("″/h", "as `drift_alpha1_arcsec_h`, about the shaft"),
}
"""What each column means; `page` refuses to be written where the reader knows others."""

_INTRODUCTION: Final = """\
# Readings files

A readings file is CSV (RFC 4180, UTF-8, dot as decimal sign): one row for each settled reading of the three
channels, in the order of measurement. `bench export RUN --csv FILE` makes one from a run; a laboratory that
measured by hand writes it.

```text
installation,pass,point,angle_deg,ux_v,uy_v,uz_v
1,1,1,0.000833333,0.096392,-0.163620,-2.556161
1,1,2,45.000555556,-1.450566,-0.154580,-1.923209
V,1,1,44.999722222,-0.990108,0.909860,-1.927747
```

Columns may be in any order, in small or large letters. Unknown columns are kept and ignored, with a note.
The program lists every row that it cannot read, with file, line, column and what it expected. It computes nothing
until you correct the row, or leave it out with `--skip-bad-rows`.

Each rail that feeds the block may have three columns. `rail_NAME_v` and `rail_NAME_a` are the measured voltage and
current, in V and A. `rail_NAME_nominal_v` is the voltage from which the effect `supply_sensitivity` counts. Leave
cells empty if nothing was measured.

A **record at a known input** has rows `R` alone: `installation,time_s,reference_v,ux_v,uy_v,uz_v`. `pass` and
`point` may be absent, and one or two of the signals may be absent or empty throughout.

If the text or the name of an unknown column begins like a formula (`=`, `+`, `-`, `@`, a tab or a line end), the
export puts an apostrophe before it, so that a spreadsheet keeps it as text. Control characters become escapes such
as `\\x1b`, and a backslash in such a cell is doubled. Reading the file undoes both. Numbers stay numbers.

`bench export RUN --csv NAME.csv` writes `NAME.csv.json` beside it: whether the instruments were simulated, the
run, the unit, the bench file with its SHA-256, the identities of the instruments, and the SHA-256 of the
readings file. As long as this hash fits the readings file, an analysis of the file is marked as simulated (or not)
exactly like the run, and uses the run's bench file (the copy in the run's folder, or the original) unless `--bench`
or `BENCH_FILE` names another. If the readings file changed since its export, a note says so, and the analysis
uses nothing from `NAME.csv.json`. The first line that an analysis prints names the bench file and the reason for
the choice; the result has it too (`bench`).
"""


_LOGS: Final = """\
## A log of another program

`bench import LOG --columns MAPPING.yaml` makes a readings file of a log
([example](../real-records.md#use-your-own-log)). The log is UTF-8 text with one header line and one line for
each row. Lines that begin with `comment` are ignored, also before the header. With `decimal: ","` numbers have
a decimal comma; the separator must then be another character. Numbers must not have separators of thousands: with
`decimal: ","` a point is refused, otherwise a comma. The program lists a cell that is no number with line and
column, and imports nothing; `--skip-bad-rows` leaves such rows out. An empty cell stays empty, but a time is
required. Without `time_format` times are numbers; with `iso` or a format of `strptime` they become seconds
since the first row. For a date and a time of day in two columns write `time_s: [date, time]`. Times without a
UTC offset are taken as UTC. If the clock was changed during the log, write times in UTC or with their offset
(`%z`): an hour that is repeated is refused, but an hour that is left out cannot be distinguished from a pause.
"""


def known_columns() -> tuple[str, ...]:
    """Return the columns that the reader knows, the signals apart."""
    return (*csv.REQUIRED, *csv.OPTIONAL, *csv.AS_TEXT)


def page() -> str:
    """Return the page. Raises `ValueError` where a column is not described or described and not known."""
    known = known_columns()
    if set(known) != COLUMNS.keys():
        raise ValueError(
            f"columns of readings files: {sorted(set(known) ^ COLUMNS.keys())} in one place only"
        )
    rows = [
        (code(name), COLUMNS[name][0], "required" if name in csv.REQUIRED else "optional", COLUMNS[name][1])
        for name in known
    ]
    signals = [
        (f"`ux_{suffix}`, `uy_{suffix}`, `uz_{suffix}`", unit, f"`ux_sd_{suffix}` …")
        for suffix, unit in UNITS.items()
    ]
    return f"""{_INTRODUCTION}
## Columns

{table(("column", "unit", "", "meaning"), rows)}

## Signals

The suffix is the unit; all three signals have the same unit, and results are in it. Each signal may have a column
with the standard deviation of the samples of the reading.

{table(("signals", "unit", "standard deviations"), signals)}

## A static record

For `bench stability`: a CSV with `time_s` and the three signal columns only.

{_LOGS}
{sections(LogColumns, _title)}
"""


def _title(model: type[BaseModel]) -> str:
    return {LogColumns: "Keys of a mapping", LogColumn: "A column of a mapping"}[model]
