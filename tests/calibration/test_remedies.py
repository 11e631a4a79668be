"""What planned readings leave open, and which of the things that could be added would show it."""

import json

import numpy as np
import pytest

from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_bench, find_procedure
from bench.model import ForwardModel
from bench.planning.settings import MOST_MOUNTINGS, Cost, fitted, outlook, settings_of

BENCH = load_bench(find_bench("paper-stand"))
MODEL = ForwardModel(BENCH.installation_models())


def looked_at(procedure, verified=True):
    plan = load_procedure(find_procedure(procedure)).plan
    settings = settings_of(plan)
    return outlook(
        settings if verified else fitted(settings), MODEL, BENCH.simulated_block(), Cost.of_plan(plan)
    )


@pytest.mark.parametrize(
    ("procedure", "rank", "unknowns", "left"),
    [
        ("paper", 16, 20, 1),
        ("calibration", 16, 20, 1),
        ("turn-24", 16, 20, 1),
        ("return", 20, 24, 1),
        ("remount-180", 24, 28, 1),
        ("remount-90", 25, 28, 0),
    ],
)
def test_three_turns_stay_open_always_and_the_third_mounting_angle_until_another_axis_lies_along_the_shaft(
    procedure, rank, unknowns, left
):
    found = looked_at(procedure)
    assert (found.found.rank, found.found.columns) == (rank, unknowns)
    assert found.turns == ["x", "y", "z"]
    assert len(found.open) == left
    assert bool(found.remedies) == bool(left)


def test_the_cheapest_remedy_costs_no_reading_where_there_are_verification_points():
    with_points, without = looked_at("paper"), looked_at("paper", verified=False)
    assert with_points.remedies[0].text.startswith("let the verification points join the fit")
    assert with_points.remedies[0].cost_s == 0.0
    first = without.remedies[0]
    assert first.text == "four verification points (installation V) that join the fit by |a| = 1 g"
    # a mounting of 20 min; four settings of 2 min, 10 s settling and 10 samples of 0.41 s
    assert first.cost_s == pytest.approx(1200 + 4 * (120 + 10 + 4.1))
    texts = [remedy.text for remedy in without.remedies]
    assert any("'remount-90'" in text for text in texts)
    assert any(text.startswith("one pass in installation 3 (axes [y, z, x]") for text in texts)
    # what turns the block about the platform's normal by half a turn, or repeats a mounting, shows nothing new
    assert not any("180" in text or "return" in text for text in texts)
    assert [r.cost_s for r in without.remedies] == sorted(r.cost_s for r in without.remedies)


def test_of_very_many_mountings_the_first_of_each_installation_are_looked_at():
    many = [
        s._replace(mount=s.mount._replace(series=visit))
        for visit in range(1, MOST_MOUNTINGS)
        for s in fitted(settings_of(load_procedure(find_procedure("quick")).plan))
    ]
    found = outlook(many, MODEL, BENCH.simulated_block(), Cost(120.0, 1200.0))
    assert found.found.columns == 20


def test_check_says_it_before_the_run_and_in_json(bench):
    status, out, _ = bench("check", "calibration")
    assert status == 0
    told = [line for line in out.splitlines() if "leaves open" in line or "shown by" in line]
    assert told[0].startswith(
        "leaves open: alpha5[1], alpha5[2] as (1, 1): goes into coefficients without a trace"
    )
    assert told[1].startswith(
        "would be shown by: let the verification points join the fit by |a| = 1 g (no further"
    )
    assert "common turn of the block's axes (about x, y, z)" in told[2]
    found = json.loads(bench("check", "calibration", "--json", "-")[1])["observability"]
    assert (found["rank"], found["unknowns"]) == (16, 20)
    assert {d["kind"] for d in found["directions"]} == {"turn", "mixed"}
    assert found["remedies"][0]["cost_s"] == 0.0
    assert {"Kxx", "alpha1[1]"} <= set(found["determined"])


def test_no_observability_is_told_of_what_calibrates_nothing(bench):
    assert json.loads(bench("check", "stability", "--json", "-")[1])["observability"] is None
    assert "leaves open:" not in bench("check", "stability")[1]


def test_a_setting_of_a_plan_costs_its_turn_its_settling_and_its_reading():
    for name in ("paper", "quick", "temperature", "stability"):
        cost = Cost.of_plan(load_procedure(find_procedure(name)).plan)
        reading = {"quick": 5 * 0.41, "stability": 4.1}.get(name, 4.1)
        settle = {"quick": 5.0, "stability": 30.0}.get(name, 10.0)
        assert cost.setting_s == pytest.approx(120 + settle + reading)
    assert Cost(100.0, 1000.0, 10.0).settings_within(1510.0, 1) == 5
    assert Cost(100.0, 1000.0, 10.0).settings_within(1509.0, 1) == 4
    assert Cost(100.0, 1000.0).settings_within(0.0, 1) == 0
    assert np.isclose(Cost(100.0, 1000.0, 10.0).total_s(3, 2), 2310.0)
