"""The readings file: every mistake named with its place, and a round trip that loses nothing.

Source of the format: RFC 4180 and the promises on the columns in `bench.readings.csv`.
"""

import csv
import io
import math
import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.readings.csv import ReadingsError, format_csv, read_csv, write_csv
from bench.readings.table import UNITS, Readings

HEADER = "installation,pass,point,angle_deg,ux_v,uy_v,uz_v"
GOOD = ["1,1,1,0,0.1,0.2,0.3", "1,1,2,45,0.4,0.5,0.6", "2,1,1,0,0.7,0.8,0.9"]


@pytest.fixture
def read(tmp_path):
    """Write text (or bytes) to readings.csv and read it with installations 1 and 2."""

    def go(content, **options):
        path = tmp_path / "readings.csv"
        if isinstance(content, list):
            content = "\n".join(content) + "\n"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_csv(path, ("1", "2"), **options)

    return go


def refusal(read, content, **options):
    with pytest.raises(ReadingsError) as caught:
        read(content, **options)
    return str(caught.value)


def test_a_minimal_file(read):
    table = read([HEADER, *GOOD])
    assert table.unit == "V"
    assert table.installation.tolist() == ["1", "1", "2"]
    assert table.point.tolist() == [1, 2, 1]
    np.testing.assert_allclose(table.angle_rad, [0.0, np.pi / 4, 0.0])
    np.testing.assert_array_equal(table.signal, np.arange(1, 10).reshape(3, 3) / 10)
    assert table.series.tolist() == [1, 1, 1]
    assert table.direction.tolist() == [0, 0, 0]
    assert table.samples.tolist() == [1, 1, 1]
    assert np.isnan([*table.time_s, *table.temperature_c, *table.target_rad]).all()
    assert (table.notes, table.skipped) == ((), ())


def test_columns_in_any_order_and_all_the_optional_ones(read):
    table = read(
        [
            "uz_v,UX_V, uy_v ,temperature_c,time_s,direction,samples,target_deg,angle_deg,point,pass,series,"
            "installation,ux_sd_v",
            "3,1,2,21.5,60,-1,10,90,90.01,3,2,4,2,1e-5",
            "3,1,2,,,+1,,,90,4,2,,2,",
        ]
    )
    assert table.signal.tolist() == [[1, 2, 3], [1, 2, 3]]
    assert table.temperature_c[0] == 21.5
    assert table.time_s[0] == 60
    assert table.direction.tolist() == [-1, 1]
    assert table.samples.tolist() == [10, 1]
    assert table.series.tolist() == [4, 1]
    assert np.degrees(table.target_rad[0]) == pytest.approx(90)
    assert table.signal_sd[0, 0] == 1e-5
    assert np.isnan(table.signal_sd[1]).all()
    assert table.notes == ()


@pytest.mark.parametrize(("suffix", "unit"), [("v", "V"), ("counts", "counts"), ("g", "g"), ("ms2", "m/s^2")])
def test_units_by_suffix(read, suffix, unit):
    table = read([HEADER.replace("_v", f"_{suffix}"), *GOOD])
    assert table.unit == unit
    assert f"ux_{suffix}" in format_csv(table)


@pytest.mark.parametrize("label", ["S", "R", "F"])
def test_rows_without_orientation_need_no_angle(read, label):
    table = read([HEADER, f"{label},1,1,,0.1,0.2,0.3", *GOOD])
    assert np.isnan(table.angle_rad[0])
    assert len(table.oriented()) == 3


def test_verification_rows_need_an_angle(read):
    assert "line 2, column angle_deg" in refusal(read, [HEADER, "V,1,1,,0.1,0.2,0.3"])
    table = read([HEADER, "V,1,1,45,0.1,0.2,0.3", *GOOD])
    assert len(table.verification()) == 1
    assert len(table.oriented()) == 3


@pytest.mark.parametrize(
    ("row", "column", "says"),
    [
        ("1,1,9,0,abc,0.2,0.3", "ux_v", "expected a number with a dot as decimal sign, got 'abc'"),
        ("1,1,9,0,0.1,,0.3", "uy_v", "got ''"),
        ("1,1,9,0,0.1,0.2,NaN", "uz_v", "got 'NaN'"),
        ("1,1,9,0,inf,0.2,0.3", "ux_v", "got 'inf'"),
        ("1,1,9,0,1_000,0.2,0.3", "ux_v", "got '1_000'"),
        ("1,1,9,0,9.9E37,0.2,0.3", "ux_v", "overloaded"),
        ("1,1,9,0,0.1,-9.90000000E+37,0.3", "uy_v", "overloaded"),
        ('1,1,9,0,"0,1",0.2,0.3', "ux_v", "dot as decimal sign, got '0,1'"),
        (
            "1,1,9,0,0,1,0,2,0,3",
            "uz_v",
            "expected 7 cells as in the header, got 10 (use a dot, not a decimal comma)",
        ),
        ("1,1,9,0,0.1", "uy_v", "expected 7 cells as in the header, got 5"),
        ("3,1,9,0,0.1,0.2,0.3", "installation", "expected one of 1, 2, F, R, S, V"),
        ("1,0,9,0,0.1,0.2,0.3", "pass", "whole number, 1 or more, got '0'"),
        ("1,1.5,9,0,0.1,0.2,0.3", "pass", "got '1.5'"),
        ("1,1,1e30,0,0.1,0.2,0.3", "point", "got '1e30'"),
        ("1,1,,0,0.1,0.2,0.3", "point", "got ''"),
        ("1,1,9,,0.1,0.2,0.3", "angle_deg", "expected an angle in degrees, got ''"),
        ("1,1,9,721,0.1,0.2,0.3", "angle_deg", "between -720 and 720"),
        ("1,1,2,45,0.1,0.2,0.3", "point", "is already in line 3"),
    ],
)
def test_each_mistake_names_file_line_column_and_what_was_expected(read, row, column, says):
    message = refusal(read, [HEADER, *GOOD, row])
    assert message.splitlines()[0].split(": ")[0].endswith(f"readings.csv, line 5, column {column}")
    assert says in message
    assert "--skip-bad-rows" in message


@pytest.mark.parametrize(
    ("column", "cell", "says"),
    [
        ("ux_sd_v", "-1e-6", "expected a standard deviation, 0 or more, got '-1e-6'"),
        ("temperature_c", "-273.2", "°C from -273.15 to 200, got '-273.2'"),
        ("temperature_c", "293.15", "got '293.15'; perhaps it is in kelvin or °F; use °C"),
        ("chamber_c", "296", "perhaps it is in kelvin"),
        (
            "temperature_c",
            "9.9E+37",
            "for an overload or an open sensor; correct this cell or leave it empty",
        ),
        ("reference_v", "five", "the voltage at the inputs in V, got 'five'"),
        ("pass", "1000000000", "got '1000000000'; is it from another column?"),
        ("point", "20261123", "is it from another column?"),
        ("series", "1e7", "is it from another column?"),
        ("pass", "\u0661", "a whole number, 1 or more, got '\u0661'"),
        ("ux_v", "\uff11.5", "a dot as decimal sign, got '\uff11.5'"),
        ("angle_deg", "\u0664\u0665", "an angle in degrees"),
        ("alpha1_arcsec", "\u0665", "a number of arcsec"),
        ("rail_p15_v", "\u0661\u0665", "of a rail in V or A"),
        ("ux_v", "7" * 100_000, f"got '{'7' * 80}…'"),
        ("uy_v", "x" * 100_000, f"got '{'x' * 80}…'"),
        ("installation", "9" * 100_000, f"got '{'9' * 80}…'"),
        ("scan_order", "x" * 100_000, f"got '{'x' * 80}…'"),
    ],
)
def test_what_cannot_be_is_refused_in_a_short_line(read, column, cell, says):
    names = HEADER.split(",")
    row = dict(zip(names, GOOD[0].split(","), strict=True)) | {column: cell}
    message = refusal(read, [",".join(row), ",".join(row.values())])
    assert f"line 2, column {column}: " in message
    assert says in message
    assert len(message) < 500


def test_what_can_hardly_be_is_doubted_in_a_note(read):
    rows = [f"{row},{time},{sd}" for row, time, sd in zip(GOOD, (0, 60, 50), ("0.1", "0.7", ""), strict=True)]
    table = read([f"{HEADER},time_s,ux_sd_v", *rows])
    assert table.notes == (
        "time_s runs backwards (line 4): put the rows back in the order of measurement",
        "the standard deviation of ux in line 3, 0.7 V, exceeds the spread of all its readings, 0.6 V: "
        "check its unit",
    )


@pytest.mark.parametrize("direction", ["0", "2", "up"])
def test_a_direction_is_plus_or_minus_one(read, direction):
    message = refusal(read, [HEADER + ",direction", GOOD[0] + "," + direction])
    assert "line 2, column direction: expected +1 (rising), -1 (falling) or nothing" in message


def test_the_same_point_in_another_series_is_no_duplicate(read):
    table = read([HEADER + ",series", GOOD[0] + ",1", GOOD[0] + ",2"])
    assert table.series.tolist() == [1, 2]


def test_all_bad_rows_at_once_the_first_twenty_then_a_count(read):
    rows = [f"1,1,{i},0,bad,0.2,0.3" for i in range(1, 26)]
    lines = refusal(read, [HEADER, *rows]).splitlines()
    assert len(lines) == 22
    assert "line 21, column ux_v" in lines[19]
    assert lines[20] == "… and 5 more bad rows (25 in all)"
    assert "nothing was used" in lines[21]


def test_skip_bad_rows_keeps_the_rest_and_lists_them(read):
    table = read([HEADER, "1,1,7,0,bad,0.2,0.3", *GOOD, GOOD[1]], skip_bad_rows=True)
    assert len(table) == 3
    assert len(table.skipped) == 2
    assert "line 2, column ux_v" in table.skipped[0]
    assert "line 6, column point" in table.skipped[1]


def test_a_file_of_bad_rows_only_is_refused_with_the_reasons(read):
    assert "line 2, column ux_v" in refusal(read, [HEADER, "1,1,7,0,bad,1,1"], skip_bad_rows=True)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "empty; expected a header line such as installation,pass,point,angle_deg,ux_v"),
        (b"\n\n", "empty; expected a header line"),
        (HEADER, "no readings"),
        (HEADER.replace(",", ";") + "\n1;1;1;0;0,1;0,2;0,3\n", "the columns are not separated by commas"),
        (HEADER.replace("uy_v", "uy_g"), "signal columns in different units (v, g)"),
        (HEADER.replace(",point", ""), "the header lacks point"),
        (HEADER.replace(",uy_v", ""), "the header lacks uy_v"),
        ("installation,pass,point,angle_deg", "the header lacks ux_v, uy_v, uz_v"),
        (HEADER + ",pass", "column pass appears more than once; keep one"),
        ([HEADER, '1,1,1,0,0.1,0.2,"0.3'], "line 2: not CSV"),
        ("Läufe\n".encode("latin-1"), "not a UTF-8 text file"),
        ((HEADER + "\n").encode("utf-16"), "not a UTF-8 text file"),
    ],
)
def test_files_that_cannot_be_read(read, content, says):
    message = refusal(read, content)
    assert "readings.csv" in message
    assert says in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("suffix", "says"),
    [
        ("mv", "not as ux_mv: convert them, or let 'bench import --columns MAP.yaml' convert them, by ux_v: "
               "{columns: ux_mv, unit: mV} in MAP.yaml"),
        ("raw", "only, not as ux_raw: convert them"),
    ],
)  # fmt: skip
def test_signals_in_another_unit_are_refused_with_the_units_that_are_read(read, suffix, says):
    told = refusal(read, HEADER.replace("_v", f"_{suffix}"))
    assert "the header lacks ux_v, uy_v, uz_v; " in told
    assert "signals are read in V (ux_v), counts (ux_counts), g (ux_g), m/s^2 (ux_ms2) only" in told
    assert told.endswith(says)


def test_signals_in_millivolts_are_imported_by_the_mapping_that_their_refusal_names(bench, tmp_path):
    (tmp_path / "mv.csv").write_text(
        "installation,pass,point,angle_deg,ux_mv,uy_mv,uz_mv\n1,1,1,0,96.4,-163,-2556\n"
    )
    told = bench("calibrate", "mv.csv")[2]
    column = re.search(r"ux_v: \{columns: ux_mv, unit: mV\}", told)[0]
    columns = [column, column.replace("ux", "uy"), column.replace("ux", "uz")]
    columns += [f"{name}: {name}" for name in ("installation", "pass", "point", "angle_deg")]
    (tmp_path / "map.yaml").write_text(
        "log_columns: 1\ncolumns:\n" + "".join(f"  {one}\n" for one in columns)
    )
    assert bench("import", "mv.csv", "--columns", "map.yaml")[0] in (0, None)
    row = (tmp_path / "runs/mv/readings.csv").read_text().splitlines()[1]
    assert [float(cell) for cell in row.split(",")[:3]] == pytest.approx([0.0964, -0.163, -2.556])


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ReadingsError, match=r"none\.csv: cannot be read \(No such file.*check the name"):
        read_csv(tmp_path / "none.csv", ("1",))


def test_byte_order_mark_and_crlf(read):
    plain = read([HEADER, *GOOD])
    windows = read(b"\xef\xbb\xbf" + "\r\n".join([HEADER, *GOOD, ""]).encode())
    np.testing.assert_array_equal(windows.signal, plain.signal)


def test_padding_of_spreadsheets(read):
    """Trailing empty cells and empty lines are nobody's mistake."""
    table = read([HEADER + ",,", *(row + ",," for row in GOOD), ",,,,,,,,", ""])
    assert len(table) == 3
    assert table.notes == ()


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_line_numbers_after_a_cell_with_line_breaks(read, end):
    """The quoted note of line 2 runs to line 4; the next rows are lines 5 and 6."""
    note = f'"first{end}second{end}third"'
    text = end.join(
        [HEADER + ",note", f"1,1,1,0,0.1,0.2,0.3,{note}", "1,1,2,45,0,0,0,", "1,1,3,x,0,0,0,", ""]
    )
    assert "line 6, column angle_deg" in refusal(read, text)
    kept = read(text, skip_bad_rows=True)
    assert kept.extra["note"][0] == f"first{end}second{end}third"
    # a bad row is named by its first line
    assert "line 2, column ux_v" in refusal(read, text.replace("0,0.1,0.2", "0,x,0.2"))


def test_unknown_columns_are_kept_with_a_note_and_written_back(read, tmp_path):
    table = read([HEADER + ",operator,scan_order", GOOD[0] + ',"Li, M.",xyz'])
    assert table.notes == ("columns kept but not used: operator",)
    assert table.extra["operator"].tolist() == ["Li, M."]
    assert table.extra["scan_order"].tolist() == ["xyz"]
    write_csv(table, tmp_path / "again.csv")
    again = read_csv(tmp_path / "again.csv", ("1", "2"))
    assert again.extra["operator"].tolist() == ["Li, M."]
    assert again.extra["scan_order"].tolist() == ["xyz"]


def test_select_takes_every_column_along(read):
    table = read([HEADER + ",note", *(f"{row},{i}" for i, row in enumerate(GOOD))])
    chosen = table.select(np.array([False, True, True]))
    assert chosen.extra["note"].tolist() == ["1", "2"]
    assert chosen.signal[:, 0].tolist() == [0.4, 0.7]
    assert chosen.conditions().mounts[1].installation == "2"


def test_written_angles_read_as_a_person_would_write_them(read):
    angles = ["0", "45", "100.1", "359.999999", "-33.333333333333"]
    table = read([HEADER, *(f"1,1,{i + 1},{a},0,0,0" for i, a in enumerate(angles))])
    rows = csv.DictReader(io.StringIO(format_csv(table)))
    assert [row["angle_deg"] for row in rows] == ["0.0", "45.0", "100.1", "359.999999", "-33.333333333333"]


def test_a_mean_of_samples_is_written_without_what_its_sum_has_rounded(read):
    """Five replies as a meter gave them; what differs by more than their sum can round stays as it is."""
    mean = float(np.mean([-1.48568] * 4 + [-1.48567]))
    near = 0.25 + 40 * math.ulp(0.25)
    table = read([HEADER, f"1,1,1,0,{mean!r},{near!r},{-mean!r}"])
    row = next(csv.DictReader(io.StringIO(format_csv(table))))
    assert repr(mean) == "-1.4856779999999998"
    assert [row[f"u{axis}_v"] for axis in "xyz"] == ["-1.485678", repr(near), "1.485678"]
    kept = next(csv.DictReader(io.StringIO(format_csv(table, to_the_bit=True))))
    assert float(kept["ux_v"]) == mean


finite = st.floats(-1e6, 1e6)
maybe = st.one_of(st.just(np.nan), finite)
size = st.one_of(st.just(np.nan), st.floats(0, 1e6))
degrees_c = st.one_of(st.just(np.nan), st.floats(-273.15, 200))
text = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)
row = st.tuples(
    st.sampled_from(["1", "2", "V"]),
    st.decimals(-720, 720, places=9).map(float),
    st.tuples(finite, finite, finite),
    st.tuples(size, size, size),
    maybe,
    degrees_c,
    st.sampled_from([-1, 0, 1]),
    text,
)


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows=st.lists(row, min_size=1, max_size=5), unit=st.sampled_from(list(UNITS.values())))
def test_round_trip_to_the_last_digit(tmp_path, rows, unit):
    """The very same numbers and texts, angles given to 1e-9 degrees too; signals but for what a sum can round."""
    labels, angles, signals, deviations, times, temperatures, directions, notes = zip(*rows, strict=True)
    n = len(rows)
    table = Readings(
        source="memory",
        unit=unit,
        series=np.arange(1, n + 1),
        installation=np.array(labels),
        pass_number=np.full(n, 2),
        point=np.arange(1, n + 1),
        angle_rad=np.radians(angles),
        target_rad=np.full(n, np.nan),
        direction=np.array(directions),
        time_s=np.array(times),
        temperature_c=np.array(temperatures),
        signal=np.array(signals),
        signal_sd=np.array(deviations),
        samples=np.full(n, 7),
        extra={"note": np.array(notes)},
    )
    write_csv(table, tmp_path / "round.csv")
    back = read_csv(tmp_path / "round.csv", ("1", "2"))
    assert back.unit == unit
    for name in ("series", "installation", "pass_number", "point", "angle_rad", "target_rad", "direction",
                 "time_s", "temperature_c", "signal_sd", "samples"):  # fmt: skip
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name), err_msg=name)
    assert np.all(np.abs(back.signal - table.signal) <= 16 * np.spacing(np.abs(table.signal)))
    assert back.extra["note"].tolist() == table.extra["note"].tolist()
