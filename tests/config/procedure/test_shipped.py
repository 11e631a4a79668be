"""The shipped procedures: what they measure, and that every shipped bench can carry them out."""

import math
from itertools import pairwise

import numpy as np
import pytest

from bench.calibration.noise import LEAST_REPEATS
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import check, load_procedure
from bench.config.procedure.plan import Level, Mount, Power, Read, SelectInput, SetTemperature, Wait
from bench.config.shipped import find_bench, find_procedure
from bench.model import Installation
from tests.support.procedure_texts import reads

TURNED = """\
installations:
  1T180: {axes: [-x, -y, z]}
  2T180: {axes: [x, z, -y]}
  1T90: {axes: [y, -x, z]}
  2T90: {axes: [-y, z, -x]}
"""
"""What the procedures with a remount say that a bench file must define."""


def bench_with_turned_installations(path, tmp_path):
    """Return a bench with the turned installations, as its file has them or added to it."""
    text = path.read_text(encoding="utf-8")
    if "1T180" not in text:
        text = text.replace("installations:\n", TURNED)
    (tmp_path / path.name).write_text(text, encoding="utf-8")
    return load_bench(tmp_path / path.name)


@pytest.mark.slow
def test_every_shipped_procedure_runs_on_every_shipped_bench(tmp_path):
    procedures = {path.stem: load_procedure(path) for path in find_procedure("paper").parent.glob("*.yaml")}
    assert all(procedure.name == name for name, procedure in procedures.items())
    for bench_path in find_bench("paper-stand").parent.glob("*.yaml"):
        bench = bench_with_turned_installations(bench_path, tmp_path)
        assert bench.name == bench_path.stem
        for procedure in procedures.values():
            plan = procedure.expand()
            heats = any(isinstance(step, SetTemperature) for step in plan.steps)
            scans = any(isinstance(step, Read) and step.scan for step in plan.steps)
            if scans and bench.name == "bench-multiplexer":
                (problem,) = check(plan, bench, dry_run=True)
                assert "zyx, but this bench's multiplexer can only use xyz alone" in problem
            elif any(isinstance(step, Power) for step in plan.steps) and bench.unit_under_test.supply is None:
                (problem,) = check(plan, bench, dry_run=True)
                assert "the bench file does not say how it is supplied" in problem
            elif any(isinstance(step, Level) for step in plan.steps) and bench.instruments.level is None:
                assert all("the bench file has no level" in problem for problem in check(plan, bench))
                assert check(plan, bench, dry_run=True)
            elif heats and bench.instruments.chamber is None:
                assert all("no chamber" in problem for problem in check(plan, bench, dry_run=True))
            else:
                assert check(plan, bench, dry_run=True) == []


def test_the_papers_procedure_is_the_papers():
    plan = load_procedure(find_procedure("paper")).expand()
    angles = [45 * point for point in range(9)]
    expected = [
        (label, number, point, angle, 1)
        for label in "12"
        for number in (1, 2, 3)
        for point, angle in enumerate(angles, start=1)
    ]
    assert reads(plan) == expected + [("V", 1, j + 1, 45 + 90 * j, 1) for j in range(4)]
    assert isinstance(plan.steps[0], Wait)
    assert plan.steps[0].duration_s == 3600.0
    assert plan.counts() == {"mount": 3, "turn": 58, "wait": 59, "read": 58}
    assert sum(step.BY_OPERATOR for step in plan.steps) == 61


def test_the_second_pass_of_the_default_is_falling_and_points_keep_their_angles():
    plan = load_procedure(find_procedure("calibration")).expand()
    for label in "12":
        second = [row for row in reads(plan) if row[:2] == (label, 2)]
        assert second == [(label, 2, point, 45 * (point - 1), -1) for point in range(9, 0, -1)]
        assert {row[4] for row in reads(plan) if row[0] == label and row[1] != 2} == {1}
    assert {(s.samples, s.nplc) for s in plan.steps if isinstance(s, Read)} == {(10, 10.0)}


def test_quick_is_one_pass():
    assert {row[1] for row in reads(load_procedure(find_procedure("quick")).expand())} == {1}


def test_the_remounts_are_the_paper_installations_turned_about_the_platforms_normal(tmp_path):
    known = bench_with_turned_installations(find_bench("paper-stand"), tmp_path).installation_models()
    for angle in (90, 180):
        lines = find_procedure(f"remount-{angle}").read_text(encoding="utf-8")
        for label, axes in (("1", ("x", "y", "z")), ("2", ("-x", "z", "y"))):
            turned = Installation.from_axes("", axes, math.radians(angle), "z").block_from_platform
            there = known[f"{label}T{angle}"].block_from_platform
            assert np.allclose(there, turned, atol=1e-12)
            told = next(line for line in lines.splitlines() if line.startswith(f"#   {label}T{angle}: "))
            stated = told.partition("[")[2].partition("]")[0].split(", ")
            assert np.array_equal(Installation.from_axes("", stated).block_from_platform, there)


@pytest.mark.parametrize(
    "name",
    ["calibration", "return", "temperature", "turn-12", "turn-24", "remount-90", "remount-180", "inputs"],
)
def test_a_calibration_has_repeats_enough_to_tell_its_noise(name):
    """Same mounting, point and direction: without those there is no test of the fit."""
    points = [
        (r.installation, r.series, r.point, r.direction)
        for r in load_procedure(find_procedure(name)).plan.steps
        if isinstance(r, Read) and r.target_rad is not None
    ]
    assert len(points) - len(set(points)) >= LEAST_REPEATS


def test_the_temperature_procedure_reaches_each_temperature_from_both_sides_and_ends_where_it_began():
    plan = load_procedure(find_procedure("temperature")).plan
    soaked = {}
    at_c = None
    for step in plan.steps:
        if isinstance(step, SetTemperature):
            at_c = step.target_c
        elif isinstance(step, Read):
            soaked.setdefault(step.installation, {}).setdefault(step.series, at_c)
    assert soaked["1"] == soaked["2"]
    assert list(soaked["1"]) == list(range(1, 10))
    levels = list(soaked["1"].values())
    assert levels[0] == levels[-1] == at_c == 23.0
    reached = {(level, level > before) for before, level in pairwise(levels)}
    between = set(levels) - {max(levels), min(levels)}
    assert {level for level in between if {(level, True), (level, False)} <= reached} == between
    each = {(r.installation, r.series, r.pass_number, r.point) for r in plan.steps if isinstance(r, Read)}
    assert len(each) == plan.counts()["read"] == 2 * 9 * 27 + 4


def test_the_static_record_numbers_its_readings_at_one_setting():
    plan = load_procedure(find_procedure("stability")).plan
    assert [row[:4] for row in reads(plan)] == [("1", 1, n, 0) for n in range(1, 721)]
    assert plan.counts()["turn"] == 1
    spacing_s = plan.expected_duration_s() - sum(
        s for kind, s in plan.duration_by_kind_s().items() if kind in {"mount", "turn"}
    )
    assert spacing_s / 720 == pytest.approx(60.0, abs=1.0)


def test_shorted_and_reference_inputs_stand_before_each_pass_and_at_the_end():
    plan = load_procedure(find_procedure("inputs")).plan
    passes = [(r.installation, r.series, r.pass_number, r.point) for r in plan.steps
              if isinstance(r, Read) and r.target_rad is None]  # fmt: skip
    numbers = [(1, 1), (2, 1), (3, 1), (1, 2), (2, 2), (3, 2), (1, 3)]
    assert passes == [(label, 1, p, n) for p, n in numbers for label in "SR"]
    switched = [s.source for s in plan.steps if isinstance(s, SelectInput)]
    assert switched == ["short", "reference", "signal"] * 7


def test_returns_and_remounts_are_visits_of_their_own():
    mounts = {
        name: [(s.installation, s.series) for s in load_procedure(find_procedure(name)).plan.steps
               if isinstance(s, Mount)]
        for name in ("return", "repeatability")
    }  # fmt: skip
    assert mounts["return"] == [("1", 1), ("2", 1), ("V", 1), ("1", 2)]
    assert mounts["repeatability"] == [("1", series) for series in range(1, 6)]


@pytest.mark.parametrize("number", [12, 24])
def test_a_turn_has_so_many_angles_and_closes(number):
    rows = reads(load_procedure(find_procedure(f"turn-{number}")).plan)
    assert {row[3] % 360 for row in rows if row[0] != "V"} == set(range(0, 360, 360 // number))
    assert {row[4] for row in rows if row[0] == "1"} == {1, -1}
    assert max(row[3] for row in rows) == 360
