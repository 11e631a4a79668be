"""A plan against a motorised head: every place on the way must lie within its limits."""

from pathlib import Path

import numpy as np

from bench.config.bench_file.file import load_bench
from bench.config.procedure.check import check
from bench.config.procedure.plan import Plan, Turn

MOTORISED = Path(__file__).parents[3] / "config" / "bench-motorised.yaml"


def turn(degrees, direction):
    return Turn(f"t{degrees}", "1", 1, 1, 1, float(np.radians(degrees)), direction)


def problems(*steps):
    return check(Plan("p", steps, ""), load_bench(MOTORISED))


def test_turns_within_the_limits_are_no_problem():
    assert problems(turn(0, 1), turn(45, -1), turn(360, 1), turn(360, -1)) == []


def test_a_turn_whose_way_leads_out_of_the_limits_is_refused_once():
    bench = load_bench(MOTORISED)
    highest = float(np.degrees(bench.head_limits_rad[1]))
    found = problems(turn(highest, -1), turn(highest, -1), turn(highest, 1))
    assert len(found) == 1
    assert f"falling to {highest:g}°" in found[0]
    assert problems(turn(highest + 1, 1))
