"""Several tables as one body of data: what stays, what is renumbered, where the times go."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration import calibrate
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.table import JoinedPart, together
from tests.support.paper_bench import STAND_U, simulate

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})


def table(seed, source, times=True):
    made = simulate(np.random.default_rng(seed), 1e-4)
    return replace(made, source=source, time_s=5.0 + 120.0 * np.arange(54) if times else made.time_s)


def test_no_mounting_of_one_table_is_one_of_another():
    second = table(2, "b")
    second = replace(second, series=np.where(second.installation == "2", 2, 1))
    both = together([JoinedPart(table(1, "a")), JoinedPart(second), JoinedPart(table(3, "c"))])
    mounts = [str(mount) for mount in both.conditions().mounts]
    assert mounts == ["1", "2", "1/2", "2/3", "1/4", "2/4"]
    assert len(both) == 162
    assert both.source == "a + b + c"
    assert np.array_equal(both.signal[54:108], second.signal)


def test_real_beginnings_order_the_tables_and_set_them_apart():
    early, late = JoinedPart(table(1, "early"), 1000.0), JoinedPart(table(2, "late"), 1000.0 + 86400.0)
    both = together([late, early])
    assert both.source == "early + late"
    assert both.time_s[0] == 0.0
    assert both.time_s[54] - both.time_s[0] == 86400.0
    assert np.all(np.diff(both.time_s) > 0)


@pytest.mark.parametrize("began", [(None, None), (0.0, None), (0.0, 60.0)])
def test_without_beginnings_or_with_impossible_ones_an_hour_lies_between(began):
    both = together([JoinedPart(table(1, "a"), began[0]), JoinedPart(table(2, "b"), began[1])])
    assert both.time_s[54] - both.time_s[53] == 3600.0
    assert "set, not measured" in both.notes[1]


def test_a_table_without_times_gets_those_of_the_usual_pace():
    both = together([JoinedPart(table(1, "a", times=False)), JoinedPart(table(2, "b"))])
    assert np.all(np.isfinite(both.time_s))
    # the pace of a run without times: 120 s a setting, 1200 s more for the remount
    assert both.time_s[53] == 53 * 120.0 + 1200.0


def test_columns_of_one_table_alone_are_empty_in_the_other():
    first = replace(table(1, "a"), extra={"range_v": np.full(54, "10")}, verification_missing=1)
    both = together([JoinedPart(first), JoinedPart(replace(table(2, "b"), notes=("a comment",)))])
    assert set(both.extra["range_v"][:54]) == {"10"}
    assert set(both.extra["range_v"][54:]) == {""}
    assert both.verification_missing == 1
    assert "b: a comment" in both.notes


def test_units_must_agree():
    with pytest.raises(ValueError, match="a in V, b in counts"):
        together([JoinedPart(table(1, "a")), JoinedPart(replace(table(2, "b"), unit="counts"))])


def test_two_runs_of_one_block_halve_the_variance_of_what_noise_alone_makes_uncertain():
    # without stand errors and settings all uncertainty is noise: 2 x the data, sqrt(2) less u
    tables = [
        simulate(np.random.default_rng(s), 1e-4, stand_u=dict.fromkeys(STAND_U, 0.0), setting_u_rad=0.0)
        for s in (1, 2)
    ]
    u_one = calibrate(tables[0], MODEL, {}, 9.81).u
    u_both = calibrate(together([JoinedPart(t) for t in tables]), MODEL, {}, 9.81).u
    # the noise is estimated from 96 and 192 signals: sd of the ratio about 9 %
    assert np.allclose(u_one / u_both, np.sqrt(2), rtol=0.3)
