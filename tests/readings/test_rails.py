"""The columns of the rails, against numbers typed here."""

import numpy as np
import pytest

from bench.readings.columns import current_column, nominal_column, voltage_column
from bench.readings.csv import ReadingsError, format_csv, read_csv

HEADER = "installation,pass,point,angle_deg,ux_v,uy_v,uz_v"
RAILS = "rail_n15_v,rail_n15_nominal_v,rail_n15_a,rail_p15_v,rail_p15_nominal_v,rail_raw_v"


def write(folder, *rows, header=f"{HEADER},{RAILS}"):
    path = folder / "readings.csv"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_names_of_the_columns():
    assert (voltage_column("p15"), nominal_column("p15"), current_column("p15")) == (
        "rail_p15_v", "rail_p15_nominal_v", "rail_p15_a",
    )  # fmt: skip


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


def test_a_voltage_that_is_no_number_is_told_with_its_place(tmp_path):
    path = write(tmp_path, "1,1,1,0,0.1,0.2,0.3,-15.02,-15,0.021,on,15,28", header=f"{HEADER},{RAILS}")
    with pytest.raises(
        ReadingsError, match=r"line 2, column rail_p15_v: expected a voltage or a current of a"
    ):
        read_csv(path, ["1"])


def test_an_unknown_voltage_is_between_its_neighbours_in_time(tmp_path):
    rows = [
        f"1,1,{point},{45 * point},0.1,0.2,0.3,{time},{volts},15"
        for point, time, volts in ((1, 0, "15.0"), (2, 30, ""), (3, 120, "15.4"))
    ]
    path = write(tmp_path, *rows, header=f"{HEADER},time_s,rail_p15_v,rail_p15_nominal_v")
    np.testing.assert_allclose(
        read_csv(path, ["1"]).conditions().above_nominal_v[:, 0], [0, 0.1, 0.4], atol=1e-12
    )
