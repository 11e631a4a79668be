"""What the level showed beside the readings: by mounting, in a readings file and back, refused where it is half."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.arrays import ARCSEC, HOUR
from bench.model.geometry import STAND_ANGLES
from bench.readings.columns import drift_rad_s
from bench.readings.corrected import FOUNDATION_ARCSEC_H, Seen, with_levels
from bench.readings.csv import ReadingsError, read_csv, write_csv
from bench.readings.table import make_readings


def table():
    n = 4
    return make_readings(
        ["1", "1", "2", "2"], [1] * n, [1, 2, 1, 2], np.zeros(n), np.zeros((n, 3)), time_s=np.arange(n)
    )


def seen(time_s, label, alpha, u=(0.5, 2.0), *, levelled=True):
    return Seen(time_s, (1, label), levelled, alpha, u)


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
