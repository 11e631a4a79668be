"""Steps that switch the block: written, checked, expanded, timed, listed."""

from dataclasses import replace
from pathlib import Path

import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.procedure.check import check, switched_before
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Mount, Plan, Power, Read, Turn
from bench.config.shipped import find_bench, find_procedure
from bench.results.check import listing
from tests.support.fed_bench import fed_bench
from tests.support.procedure_texts import load_steps

CYCLES = """\
  - power: on
  - installation:
      label: 1
      steps:
        - repeat:
            times: 3
            steps:
              - turn: {angles: [0 deg, 90 deg]}
              - power: {switch: cycle, off_for: 10 min, warm_up: 0 s}
  - power: off
"""


def plan_of(folder: Path, steps: str) -> Plan:
    return load_steps(folder, steps, "procedure: p\nsteps:\n").expand()


def test_switching_is_a_step_of_the_plan(tmp_path):
    powers = [step for step in plan_of(tmp_path, CYCLES).steps if isinstance(step, Power)]
    assert [(p.switch, p.off_s, p.warm_up_s) for p in powers] == [
        ("on", 0.0, None),
        *[("cycle", 600.0, 0.0)] * 3,
        ("off", 0.0, None),
    ]
    assert Plan.from_json(plan_of(tmp_path, CYCLES).to_json()) == plan_of(tmp_path, CYCLES)


def test_after_each_switching_on_the_same_mounting_is_another_series(tmp_path):
    steps = plan_of(tmp_path, CYCLES).steps
    assert [s.series for s in steps if isinstance(s, Mount)] == [1]
    assert [s.series for s in steps if isinstance(s, Turn)] == [1, 1, 2, 2, 3, 3]
    assert [s.series for s in steps if isinstance(s, Read)] == [1, 1, 2, 2, 3, 3]
    later = plan_of(
        tmp_path, CYCLES + "  - power: on\n  - installation: {label: 1, steps: [{turn: {angles: [0 deg]}}]}\n"
    )
    assert [s.series for s in later.steps if isinstance(s, Read)][-1] == 4


@pytest.mark.parametrize(
    ("steps", "text"),
    [
        ("  - power: onn\n", "onn"),
        ("  - power: {switch: on, off_for: 1 min}\n", "only a cycle has 'off_for'"),
        ("  - power: {switch: off, warm_up: 1 min}\n", "does not warm up"),
        ("  - input: {source: short, steps: [{power: off}, {read: {}}]}\n", "is inside an input"),
    ],
)
def test_a_switching_that_makes_no_sense_is_refused(tmp_path, steps, text):
    with pytest.raises(FileMistakes, match=text):
        plan_of(tmp_path, steps)


def test_a_bench_that_does_not_say_how_the_block_is_fed_cannot_switch_it(tmp_path):
    plan = plan_of(tmp_path, CYCLES)
    (problem,) = check(plan, load_bench(find_bench("bench-gpib")))
    assert "does not say how it is supplied" in problem
    assert check(plan, fed_bench(tmp_path)) == []


@pytest.mark.parametrize("first", ["", "  - power: off\n"])
def test_a_block_that_is_off_is_not_read(tmp_path, first):
    inside = "[{turn: {angles: [0 deg]}}, {power: off}, {turn: {angles: [90 deg], first_point: 2}}]"
    steps = f"{first}  - installation: {{label: 1, steps: {inside}}}\n"
    (problem,) = check(plan_of(tmp_path, steps), fed_bench(tmp_path))
    assert "the block is off here" in problem


def test_what_switching_takes_is_in_the_time_of_the_plan(tmp_path):
    supply = fed_bench(tmp_path, pause="5 s").unit_under_test.supply
    plan = plan_of(tmp_path, CYCLES)
    assert plan.duration_by_kind_s(50.0, supply)["power"] == pytest.approx(
        (10.0 + 5.0 + 1200.0) + 3 * (600.0 + 10.0) + 5.0
    )
    assert plan.duration_by_kind_s()["power"] == pytest.approx(3 * 600.0)


def test_a_procedure_of_today_is_switched_on_before_it_begins_and_its_plan_stays_the_same(tmp_path):
    plan = load_procedure(find_procedure("quick")).expand()
    warm = {"drift": "0.1 mV", "per": "10 min", "timeout": "2 h"}
    bench = fed_bench(tmp_path, warm_up=warm)
    supply = bench.unit_under_test.supply
    assert switched_before(plan, bench) == "switch the block on, let it warm up (until settled, 610 s to 2 h)"
    assert switched_before(plan, load_bench(find_bench("bench-gpib"))) is None
    assert plan.expected_duration_s(50.0, supply) - plan.expected_duration_s() == pytest.approx(620.0)
    assert plan.longest_duration_s(50.0, supply) - plan.longest_duration_s() == pytest.approx(7210.0)
    assert sum(plan.duration_by_mount_s(50.0, supply).values()) == pytest.approx(
        plan.expected_duration_s(50.0, supply)
    )
    assert plan.hash.startswith("e9855d5645de")


def test_switching_is_listed(tmp_path):
    told = [line.text for line in listing(plan_of(tmp_path, CYCLES), every_step=True)]
    assert told[0] == "switch the block on, let it warm up"
    assert "switch the block off for 10 min and on again, without warm-up" in told
    assert told[-1] == "switch the block off"


def test_a_step_that_repeats_is_one_line(tmp_path):
    plan = plan_of(tmp_path, CYCLES)
    many = replace(plan, steps=plan.steps[:1] * 4)
    assert [line.text for line in listing(many)] == ["4 times: switch the block on, let it warm up"]
