"""Logs of others as readings files, by a mapping of their columns."""

import re
from pathlib import Path

import pytest

from bench.base.yaml_files import FileMistakes, load_validated
from bench.config.foreign_log import LogColumns, convert_log
from bench.readings.csv import ReadingsError

DOCS = Path(__file__).parents[2] / "docs"
LOG = """# made by some program
when;a/mV;b/mV;dut;bath
2024-10-01 12:00:00;1000,001;1000,003;999999,5;296,15
2024-10-01 12:00:30;1000,003;1000,001;1000000,5;297,15
"""
MAPPING = """
log_columns: 1
separator: ";"
decimal: ","
time_format: "%Y-%m-%d %H:%M:%S"
columns:
  time_s: when
  reference_v: {columns: [a/mV, b/mV], unit: mV}
  ux_v: {columns: dut, unit: uV}
  meter_temperature_c: {columns: bath, unit: K}
constants: {installation: R}
"""


def mapping(tmp_path, text=MAPPING):
    file = tmp_path / "columns.yaml"
    file.write_text(text)
    return load_validated(file, LogColumns)


def test_units_times_and_means_are_converted(tmp_path):
    made = convert_log(Path("log"), LOG.encode(), mapping(tmp_path))
    header, first, second = (line.split(",") for line in made.text.split())
    assert header == [
        "installation",
        "time_s",
        "reference_v",
        "ux_v",
        "meter_temperature_c",
        "reference_sd_v",
    ]
    assert [first[0], float(first[1]), float(second[1])] == ["R", 0.0, 30.0]
    assert float(first[2]) == pytest.approx(1.000002, abs=1e-12)
    assert float(first[3]) == pytest.approx(0.9999995, abs=1e-12)
    assert float(second[4]) == pytest.approx(24.0, abs=1e-9)
    assert float(first[5]) == pytest.approx(2e-6 / 2**0.5, rel=1e-6)


def test_all_bad_rows_are_told_at_once_and_can_be_left_out(tmp_path):
    bad = LOG + "2024-10-01 12:01:00;broken;1;2;3\nyesterday;1;1;1;1\n1;2\n"
    with pytest.raises(ReadingsError) as told:
        convert_log(Path("log"), bad.encode(), mapping(tmp_path))
    lines = str(told.value).splitlines()
    assert "log, line 5, column a/mV: expected a number, got 'broken'" in lines[0]
    assert "line 6, column when: expected a time" in lines[1]
    assert "line 7, expected 5 cells" in lines[2]
    left = convert_log(Path("log"), bad.encode(), mapping(tmp_path), skip_bad_rows=True)
    assert (left.rows, len(left.skipped)) == (2, 3)


def test_a_row_keeps_the_line_that_it_has_in_the_log(tmp_path):
    made = convert_log(Path("log"), LOG.replace("bath\n", "bath\n\n").encode(), mapping(tmp_path))
    lines = made.text.splitlines()
    assert [number for number, line in enumerate(lines, start=1) if line] == [1, 4, 5]
    assert made.preview().splitlines() == [line for line in lines if line]


def test_a_missing_column_is_named_with_those_that_are_there(tmp_path):
    with pytest.raises(
        ReadingsError,
        match=r"lacks the columns dut that the mapping names; correct the mapping \(the log has when, a/mV, ",
    ):
        convert_log(Path("log"), LOG.replace(";dut;", ";other;").encode(), mapping(tmp_path))


def test_a_unit_of_another_quantity_is_a_mistake_at_its_line(tmp_path):
    with pytest.raises(FileMistakes, match=r"columns.yaml:9: columns\.ux_v\.unit: the unit min of ux_v"):
        mapping(tmp_path, MAPPING.replace("unit: uV", "unit: min").replace("unit: mV", "unit: V"))


def test_a_log_is_previewed_and_imported_with_its_mapping(bench, tmp_path):
    (tmp_path / "log.txt").write_text(LOG)
    mapping(tmp_path)
    command = ("import", "log.txt", "--columns", "columns.yaml", "--name", "bath")
    status, out, _ = bench(*command, "--preview")
    assert status in (0, None)
    assert "2 rows, 0 left out; nothing was imported" in out
    assert not (tmp_path / "runs").exists()
    assert bench(*command)[0] in (0, None)
    folder = tmp_path / "runs/bath"
    assert (folder / "columns.yaml").read_text() == MAPPING
    assert "reference_sd_v" in (folder / "readings.csv").read_text()


BLOCK = """
log_columns: 1
separator: ";"
columns:
  installation: Pos
  pass: Pass
  point: Pass
  angle_deg: Angle
  ux_v: {columns: Ax, unit: mV}
  uy_v: {columns: Ay, unit: mV}
  uz_v: {columns: Az, unit: mV}
"""


def of_block(tmp_path, *labels):
    rows = "".join(f"{label};1;{45 * k};96.4;-163.6;-2556.2\n" for k, label in enumerate(labels))
    (tmp_path / "log.csv").write_text("Pos;Pass;Angle;Ax;Ay;Az\n" + rows)
    mapping(tmp_path, BLOCK)
    return "import", "log.csv", "--columns", "columns.yaml", "--name", "block"


def test_a_column_of_installations_is_taken_as_it_is_written(bench, tmp_path):
    command = of_block(tmp_path, "1", "1.0", "2", "2,00", "V", "1T180")
    (tmp_path / "log.csv").write_text((tmp_path / "log.csv").read_text().replace(";1;", ";{};"))
    lines = (tmp_path / "log.csv").read_text().split("\n")
    (tmp_path / "log.csv").write_text("\n".join(line.format(k) for k, line in enumerate(lines)))
    status, out, _ = bench(*command, "--preview")
    assert status in (0, None)
    assert "6 rows, 0 left out; nothing was imported" in out
    assert bench(*command)[0] in (0, None)
    rows = (tmp_path / "runs/block/readings.csv").read_text().splitlines()[1:]
    assert [row.split(",")[0] for row in rows] == ["1", "1", "2", "2", "V", "1T180"]


def test_the_documented_table_of_a_block_is_converted():
    page = (DOCS / "real-records.md").read_text(encoding="utf-8")
    table = "\n".join(re.findall(r"^    ((?:inst,|1,1,).*)$", page, re.M)) + "\n"
    made = convert_log(Path("log"), table.encode(), load_validated(DOCS / "examples/block.yaml", LogColumns))
    header, first, second = (line.split(",") for line in made.text.split())
    assert header == ["installation", "pass", "point", "angle_deg", "ux_v", "uy_v", "uz_v", "temperature_c"]
    assert [float(cell) for cell in first[3:]] == pytest.approx([0.0008, 0.096392, -0.16362, -2.556161, 23.0])
    assert (second[0], float(second[2]), float(second[3])) == ("1", 2, 45.0006)


def test_a_preview_shows_what_the_import_would_refuse(bench, tmp_path):
    command = of_block(tmp_path, "1", "upside down")
    status, out, told = bench(*command, "--preview")
    assert status == 2
    assert "\nupside down,1.0,1.0,45.0," in out.replace("\r", "")
    assert "column installation: expected one of 1, " in told
    assert bench(*command)[2] == told


@pytest.mark.parametrize("column", ["[Pos, Pass]", "{columns: Pos, unit: V}", "{columns: Pos, add: 1}"])
def test_an_installation_is_no_mean_and_has_no_unit(tmp_path, column):
    with pytest.raises(FileMistakes, match=r"columns.yaml:5: columns\.installation: installation is a text"):
        mapping(tmp_path, BLOCK.replace("installation: Pos", f"installation: {column}"))


@pytest.mark.parametrize("column", ["time_s: t, ux_v: v", "time_s: v, ux_v: t"])
def test_a_point_in_a_number_with_decimal_comma_is_refused(tmp_path, column):
    rows = f'log_columns: 1\nseparator: ";"\ndecimal: ","\ncolumns: {{{column}}}\n'
    with pytest.raises(ReadingsError, match=r"line 3, column v: the point in '25\.340' may separate") as told:
        convert_log(Path("log"), b"t;v\n0;25338,0\n1;25.340\n", mapping(tmp_path, rows))
    assert "line 2" not in str(told.value)


def test_a_comma_in_a_number_with_decimal_point_is_refused(tmp_path):
    rows = 'log_columns: 1\nseparator: ";"\ncolumns: {time_s: t, ux_v: v}\n'
    with pytest.raises(ReadingsError, match="log, line 2, column v: expected a number, got '25,340'"):
        convert_log(Path("log"), b"t;v\n0;25,340\n", mapping(tmp_path, rows))


def test_two_columns_of_the_wanted_name_are_refused(tmp_path):
    log, rows = b"t,v,n,v,n\n0,1,2,3,4\n", "log_columns: 1\ncolumns: {time_s: t, ux_v: v}\n"
    with pytest.raises(ReadingsError, match="log, line 1: columns 2 and 4 have the same name v"):
        convert_log(Path("log"), log, mapping(tmp_path, rows))


@pytest.mark.parametrize("mean", ["[v, w, v]", "{columns: [v, w, v], unit: V}"])
def test_a_mean_with_a_column_twice_is_a_mistake_at_its_line(tmp_path, mean):
    rows = f"log_columns: 1\ncolumns:\n  time_s: t\n  ux_v: {mean}\n"
    with pytest.raises(FileMistakes, match=r"columns.yaml:4: columns\.ux_v: the mean has the column v twice"):
        mapping(tmp_path, rows)


def test_a_mean_of_thermometers_is_imported_and_only_signals_and_references_have_scatter(bench, tmp_path):
    (tmp_path / "log.csv").write_text("t,v,w,ta,tb,p,q\n0,1,3,20,22,15,16\n1,2,4,21,23,15,16\n")
    columns = "{time_s: t, ux_v: [v, w], meter_temperature_c: [ta, tb], rail_p15_v: [p, q]}"
    constants = "{installation: R, reference_v: 1}"
    mapping(tmp_path, f"log_columns: 1\ncolumns: {columns}\nconstants: {constants}\n")
    assert bench("import", "log.csv", "--columns", "columns.yaml", "--name", "two")[0] in (0, None)
    header, first, *_ = (tmp_path / "runs/two/readings.csv").read_text().splitlines()
    assert header == "installation,reference_v,time_s,ux_v,meter_temperature_c,rail_p15_v,ux_sd_v"
    assert first.startswith("R,1,0.0,2.0,21.0,15.5,1.414")


def log_in_kyiv(form, times=("03:54:00", "03:57:00", "03:00:00", "03:03:00"), offsets=("",) * 4):
    """Return a log of the night in which the clock of Kyiv is put back, and its mapping."""
    rows = [f"2026-10-25 {time}{at},1" for time, at in zip(times, offsets, strict=True)]
    columns = "columns: {time_s: t, ux_v: v}"
    return "\n".join(["t,v", *rows]).encode(), f"log_columns: 1\ntime_format: '{form}'\n{columns}\n"


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S", "iso"])
@pytest.mark.parametrize("skip", [False, True])
def test_an_hour_repeated_in_local_time_is_refused(tmp_path, form, skip):
    log, rows = log_in_kyiv(form)
    with pytest.raises(ReadingsError) as told:
        convert_log(Path("log"), log, mapping(tmp_path, rows), skip_bad_rows=skip)
    assert str(told.value) == (
        "log, line 4, column t: the time goes back by 57 min; if the clock was put back, write times with their "
        "UTC offset (%z), otherwise sort the rows"
    )


@pytest.mark.parametrize(
    ("rows", "skip", "remedy"),
    [("x", True, "no row is left; mend the rows or the mapping"), ("x\n1", False, "or add --skip-bad-rows")],
)
def test_skipping_bad_rows_is_proposed_only_if_a_row_remains(tmp_path, rows, skip, remedy):
    of = mapping(tmp_path, "log_columns: 1\ncolumns: {ux_v: v}\n")
    with pytest.raises(ReadingsError, match=f"nothing was imported; .*{remedy}$"):
        convert_log(Path("log"), f"v\n{rows}\n".encode(), of, skip_bad_rows=skip)


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S%z", "iso"])
def test_an_hour_repeated_is_resolved_by_the_utc_offset(tmp_path, form):
    log, rows = log_in_kyiv(form, offsets=("+03:00", "+03:00", "+02:00", "+02:00"))
    made = convert_log(Path("log"), log, mapping(tmp_path, rows))
    assert [float(row.split(",")[0]) for row in made.text.splitlines()[1:]] == [0.0, 180.0, 360.0, 540.0]


@pytest.mark.parametrize("third", ["03:56:59", "02:30:00", "03:58:00"])
def test_a_clock_that_is_set_or_an_older_row_is_no_change_of_the_clock(tmp_path, third):
    log, rows = log_in_kyiv("iso", times=("03:54:00", "03:57:00", third, "04:00:00"))
    assert convert_log(Path("log"), log, mapping(tmp_path, rows)).rows == 4


@pytest.mark.parametrize("unit", ["degF", "°F"])
def test_a_temperature_in_fahrenheit_is_converted(tmp_path, unit):
    rows = f"log_columns: 1\ncolumns:\n  time_s: t\n  room_c: {{columns: [a, b], unit: {unit}, add: 0.5}}\n"
    made = convert_log(Path("log"), b"t,a,b\n0,31,33\n1,211,213\n", mapping(tmp_path, rows))
    assert [float(row.split(",")[1]) for row in made.text.splitlines()[1:]] == pytest.approx([0.5, 100.5])


def test_a_temperature_in_another_unit_is_refused_with_the_units_there_are(tmp_path):
    with pytest.raises(
        FileMistakes, match="of meter_temperature_c is no unit of temperature; state degC, K or degF"
    ):
        mapping(tmp_path, MAPPING.replace("unit: K", "unit: mV"))


@pytest.mark.parametrize("form", ["%d.%m.%Y %H:%M", "iso"])
def test_date_and_time_of_day_in_two_columns_are_one_time(tmp_path, form):
    rows = f"log_columns: 1\ntime_format: '{form}'\ncolumns: {{time_s: [day, time], ux_v: v}}\n"
    days = ("2024-12-31", "2025-01-01") if form == "iso" else ("31.12.2024", "01.01.2025")
    log = f"time,v,day\n23:59,1,{days[0]}\n00:01,2,{days[1]}\n".encode()
    made = convert_log(Path("log"), log, mapping(tmp_path, rows))
    assert [float(row.split(",")[0]) for row in made.text.splitlines()[1:]] == [0.0, 120.0]
    with pytest.raises(ReadingsError, match="log, line 2, column day and time: expected a time as"):
        convert_log(Path("log"), b"time,v,day\n,1,\n", mapping(tmp_path, rows))


def test_a_log_without_rows_is_refused(tmp_path):
    with pytest.raises(ReadingsError, match="log: the log has a header but no row; give a log with rows"):
        convert_log(Path("log"), LOG[: LOG.index("2024")].encode(), mapping(tmp_path))


def test_a_mean_with_an_empty_cell_is_empty(tmp_path):
    text = LOG.replace("1000,003;999999,5", ";999999,5")
    made = convert_log(Path("log"), text.encode(), mapping(tmp_path))
    first = dict(zip(*(line.split(",") for line in made.text.split()[:2]), strict=True))
    assert (first["reference_v"], first["reference_sd_v"]) == ("", "")
    assert float(first["ux_v"]) == pytest.approx(0.9999995, rel=1e-12)
