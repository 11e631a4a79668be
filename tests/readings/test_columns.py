"""Text in CSV cells: a spreadsheet keeps it as text, a terminal does not obey it, our import has it back."""

import csv
import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.arrays import ARCSEC, HOUR
from bench.base.text import visible
from bench.model.geometry import STAND_ANGLES
from bench.readings.columns import (
    Rail,
    as_cell,
    between,
    columns_of,
    drift_rad_s,
    of_cell,
    ranges_in_words,
    since_power_on_cells,
)
from bench.readings.corrected import FOUNDATION_ARCSEC_H, LevelReading, with_levels
from bench.readings.csv import ReadingsError, format_csv, read_csv, write_csv
from bench.readings.table import Reading, make_readings, readings_of

HEADER = "installation,pass,point,angle_deg,ux_v,uy_v,uz_v"


@pytest.mark.parametrize(
    "text",
    ["=1+1", "+A1", "-A1", "@SUM(A1)", "\t=1", "\n=1", " =1", "＝1", "'=1", "-", "-inf", "+1,5", "=-1"],
)
def test_what_a_spreadsheet_would_compute_is_text(text):
    assert as_cell(text).startswith("'")
    assert of_cell(as_cell(text)) == text


@pytest.mark.parametrize(
    "text", ["-1.5", "+3", "1e-3", " -0.25 ", "-.5E+3", "", "Li, M.", "a=b", "it's", "'"]
)
def test_numbers_stay_numbers_and_plain_text_stays_as_it_is(text):
    assert as_cell(text) == text == of_cell(text)


@pytest.mark.parametrize("cell", [r"C:\x1bfoo\bar", "'plain", r"C:\data", r"\U00110000"])
def test_cells_of_others_come_back_as_they_are(cell):
    assert of_cell(cell) == cell


awkward = st.text(st.sampled_from("\\\\'=+-@\t\r\nxu1b0a2\x1b\x9b\u202e\u2028\ud800 "), max_size=12)


@given(awkward | st.text(st.characters(exclude_categories=())))
def test_every_text_comes_back_and_none_acts(text):
    cell = as_cell(text)
    assert of_cell(cell) == text
    assert visible(cell) == cell
    cell.encode()


def test_a_file_of_readings_is_safe_and_reads_back(tmp_path):
    note = '=HYPERLINK("http://a")\x1b[2J'
    out = io.StringIO()
    csv.writer(out).writerows(
        [[*HEADER.split(","), "=note"], ["1", "1", "1", "-45", "-0.1", "0.2", "0.3", note]]
    )
    (tmp_path / "r.csv").write_text(out.getvalue(), encoding="utf-8", newline="")
    table = read_csv(tmp_path / "r.csv", ["1", "2"])
    written = format_csv(table)
    head, cells = csv.reader(io.StringIO(written, newline=""))
    assert "'=note" in head
    assert not any(cell.startswith(("=", "+", "@", "\t")) for cell in cells if cell != "+0")
    assert "\x1b" not in written
    assert float(cells[head.index("ux_v")]) == -0.1
    (tmp_path / "again.csv").write_text(written, encoding="utf-8", newline="")
    again = read_csv(tmp_path / "again.csv", ["1", "2"])
    assert again.extra["=note"].tolist() == [note]
    assert np.array_equal(again.signal, table.signal)


# --- levelled ---------------------------------------------------------------------------------------
# What the level showed beside the readings: by mounting, in a readings file and back, refused where it is half.


def table():
    n = 4
    return make_readings(
        ["1", "1", "2", "2"], [1] * n, [1, 2, 1, 2], np.zeros(n), np.zeros((n, 3)), time_s=np.arange(n)
    )


def seen(time_s, label, alpha, u=(0.5, 2.0), *, levelled=True):
    return LevelReading(time_s, (1, label), levelled, alpha, u)


def test_each_mounting_has_what_was_measured_for_it_and_no_other():
    found = with_levels(table(), [seen(0.0, "2", (1.0, -2.0))]).conditions()
    assert found.levels() == {
        (1, 0): pytest.approx((1.0 * ARCSEC, 0.5 * ARCSEC)),
        (1, 1): pytest.approx((-2.0 * ARCSEC, 2.0 * ARCSEC)),
    }
    assert STAND_ANGLES[:2] == ("axis_tilt", "zero_offset")
    assert table().conditions().levels() == {}


def test_a_levelling_that_was_done_again_counts_and_not_the_first():
    found = with_levels(table(), [seen(0.0, "1", (9.0, 9.0)), seen(60.0, "1", (1.0, 1.0))]).conditions()
    assert found.levels()[0, 0][0] == pytest.approx(ARCSEC)


def test_read_again_the_middle_counts_by_weight_and_the_drift_is_known():
    again = [
        seen(0.0, "1", (1.0, 0.0), (0.1, 3.0)),
        seen(5 * HOUR, "1", (2.0, 6.0), (0.1, 3.0), levelled=False),
    ]
    readings = with_levels(table(), again)
    alpha1, u1 = (size / ARCSEC for size in readings.conditions().levels()[0, 0])
    assert alpha1 == pytest.approx(1.5)
    assert u1 == pytest.approx(0.1 / np.sqrt(2.0), rel=0.2)
    along, across = (rate * HOUR / ARCSEC for rate in drift_rad_s(readings.extra))
    assert along == pytest.approx(0.2, rel=0.02), "an arcsecond in five hours, which no usual foundation does"
    assert across == pytest.approx(FOUNDATION_ARCSEC_H, rel=0.1), (
        "6″ that the head's settings explain are none"
    )


def test_a_readings_file_keeps_it(tmp_path):
    readings = with_levels(
        table(), [seen(0.0, "1", (1.25, -2.5)), seen(9.0, "1", (1.0, -2.0), levelled=False)]
    )
    write_csv(readings, tmp_path / "readings.csv")
    back = read_csv(tmp_path / "readings.csv", ["1", "2"])
    assert back.notes == ()
    assert back.conditions().levels() == readings.conditions().levels()
    assert drift_rad_s(back.extra) == drift_rad_s(readings.extra)


@pytest.mark.parametrize(
    ("cells", "column"),
    [("1.0,,0.5,2.0", "alpha2_arcsec"), ("1.0,2.0,0,2.0", "u_alpha1_arcsec"), ("level,,,", "alpha1_arcsec")],
)
def test_half_of_it_is_a_mistake_of_its_line(tmp_path, cells, column):
    header = "installation,pass,point,angle_deg,ux_v,uy_v,uz_v"
    levels = "alpha1_arcsec,alpha2_arcsec,u_alpha1_arcsec,u_alpha2_arcsec"
    (tmp_path / "readings.csv").write_text(f"{header},{levels}\n1,1,1,0,1,1,1,{cells}\n", encoding="utf-8")
    with pytest.raises(ReadingsError, match=f"line 2, column {column}: expected"):
        read_csv(tmp_path / "readings.csv", ["1", "2"])


# --- rails ------------------------------------------------------------------------------------------
# The columns of the rails, against numbers typed here.

RAIL_COLUMNS = "rail_n15_v,rail_n15_nominal_v,rail_n15_a,rail_p15_v,rail_p15_nominal_v,rail_raw_v"


def write(folder, *rows, header=f"{HEADER},{RAIL_COLUMNS}"):
    path = folder / "readings.csv"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_rails_count_from_their_nominal_voltage_and_survive_a_round_trip(tmp_path):
    """An empty cell is not known, and so is a rail of which nobody says what it should have."""
    path = write(
        tmp_path,
        "1,1,1,0,0.1,0.2,0.3,-15.02,-15,0.021,15.10,15,27.9",
        "1,1,2,45,0.1,0.2,0.3,,-15,,14.95,15,28.0",
    )
    table = read_csv(path, ["1"])
    assert table.notes == ()
    expected = [[-0.02, 0.10, np.nan], [np.nan, -0.05, np.nan]]
    np.testing.assert_allclose(table.conditions().supply_v, expected, atol=1e-12)
    again = tmp_path / "again.csv"
    again.write_text(format_csv(table), encoding="utf-8")
    np.testing.assert_array_equal(read_csv(again, ["1"]).conditions().supply_v, table.conditions().supply_v)


def test_a_table_without_rails_knows_nothing_of_a_supply(tmp_path):
    conditions = read_csv(write(tmp_path, "1,1,1,0,0.1,0.2,0.3", header=HEADER), ["1"]).conditions()
    assert conditions.supply_v is None
    assert conditions.above_nominal_v.shape == (1, 0)


def test_the_time_since_power_came_on_is_that_of_the_last_time_it_did():
    power = [
        (0.0, "found on"),
        (100.0, "off"),
        (130.0, "on"),
        (500.0, "found on"),
        (600.0, "fault"),
        (700.0, "on"),
    ]
    read_s = [50.0, 110.0, 130.0, 330.5, 550.0, 650.0, 701.25, None]
    expected = ["", "", "0.000", "200.500", "420.000", "", "1.250", ""]
    assert since_power_on_cells(read_s, power) == expected
    assert since_power_on_cells(read_s, []) == [""] * len(read_s)


def test_a_readings_file_says_since_when_the_block_is_on(tmp_path):
    rows = ["1,1,1,0,0.1,0.2,0.3,900.5", "1,1,2,45,0.1,0.2,0.3,"]
    path = write(tmp_path, *rows, header=f"{HEADER},since_power_on_s")
    table = read_csv(path, ["1"])
    np.testing.assert_array_equal(table.conditions().on_s, [900.5, np.nan])
    path.write_text(format_csv(table), encoding="utf-8")
    np.testing.assert_array_equal(read_csv(path, ["1"]).conditions().on_s, [900.5, np.nan])
    with pytest.raises(ReadingsError, match="column since_power_on_s: expected a time in seconds"):
        read_csv(write(tmp_path, f"{rows[0][:-5]}-3", header=f"{HEADER},since_power_on_s"), ["1"])


def test_a_readings_file_says_in_which_series_the_block_stayed_mounted(tmp_path):
    rows = [f"1,1,{point},0,0.1,0.2,0.3,{series},{cell}" for point, series, cell in (
        (1, 1, "7"), (2, 1, "7"), (1, 2, "7"), (1, 3, ""), (1, 4, "8"), (1, 5, ""))]  # fmt: skip
    header = f"{HEADER},series,mounting_number"
    table = read_csv(write(tmp_path, *rows, header=header), ["1"])
    assert not table.notes
    np.testing.assert_array_equal(table.conditions().mounting, [7, 7, 7, 0, 8, 0])
    np.testing.assert_array_equal(table.conditions().clamped, [0, 0, 2, 3, 4])
    for cell in ("0", "1.5", "first"):
        with pytest.raises(ReadingsError, match="column mounting_number: expected a whole number, 1 or more"):
            read_csv(write(tmp_path, rows[0][:-1] + cell, header=header), ["1"])


def test_an_unknown_voltage_is_between_its_neighbours_in_time(tmp_path):
    rows = [
        f"1,1,{point},{45 * point},0.1,0.2,0.3,{time},{volts},15"
        for point, time, volts in ((1, 0, "15.0"), (2, 30, ""), (3, 120, "15.4"))
    ]
    path = write(tmp_path, *rows, header=f"{HEADER},time_s,rail_p15_v,rail_p15_nominal_v")
    np.testing.assert_allclose(
        read_csv(path, ["1"]).conditions().above_nominal_v[:, 0], [0, 0.1, 0.4], atol=1e-12
    )


# --- supplied ---------------------------------------------------------------------------------------
# What the supply measured at the rails: in the record, in the table, in a file and back.

RAILS = {"p15": Rail(15.01, 15.0, 0.061), "n15": Rail(-14.98, -15.0, 0.058)}


def reading(point, rails):
    return Reading(
        installation="1",
        series=1,
        pass_number=1,
        point=point,
        angle_deg=0.0,
        mean=(0.1, 0.2, 0.3),
        rails=rails,
    )


def test_a_reading_without_rails_is_recorded_as_before():
    assert "rails" not in reading(1, {}).to_json()
    assert Reading.from_json(reading(1, {}).to_json() | {"samples": {}}).rails == {}


def test_rails_come_back_from_the_record():
    assert Reading.from_json(reading(1, RAILS).to_json()).rails == RAILS


@pytest.mark.parametrize(
    "cell",
    [
        {"voltage_v": "15", "nominal_v": 15.0, "current_a": 0.1},
        {"voltage_v": 15.0},
        {"voltage_v": float("nan"), "nominal_v": 15.0, "current_a": 0.0},
    ],
)
def test_what_is_no_rail_is_refused(cell):
    with pytest.raises((ValueError, KeyError)):
        Reading.from_json(reading(1, {}).to_json() | {"rails": {"p15": cell}})


def test_what_is_recorded_is_the_mean_of_before_and_after():
    after = {"p15": Rail(15.03, 15.0, 0.063), "n15": Rail(-14.98, -15.0, 0.058)}
    assert between(RAILS, after)["p15"] == Rail(pytest.approx(15.02), 15.0, pytest.approx(0.062))


def test_rails_are_columns_of_the_table_and_of_its_file(tmp_path):
    table = readings_of([reading(1, RAILS), reading(2, {})], "here")
    (tmp_path / "r.csv").write_text(format_csv(table), encoding="utf-8", newline="")
    for known in (table, read_csv(tmp_path / "r.csv", ["1"])):
        assert known.extra["rail_p15_a"].tolist() == ["0.061", ""]
        assert known.extra["rail_n15_nominal_v"].tolist() == ["-15", ""]
        np.testing.assert_allclose(known.conditions().supply_v[0], [0.01, 0.02], atol=1e-12)


def test_the_ranges_of_a_run_are_told_in_words():
    later = {"p15": Rail(15.04, 15.0, 0.0655), "n15": Rail(-14.98, -15.0, 0.058)}
    assert (
        ranges_in_words(columns_of([RAILS, later, {}]))
        == "p15 15.01 to 15.04 V, 61 to 65.5 mA; n15 -14.98 V, 58 mA"
    )
    assert ranges_in_words({}) == ""
