"""`bench check`: everything that is known of a run before it begins, told at once."""

import json
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.calibration import CalibrationError
from bench.calibration.observability import require_rank
from bench.config.bench_file.file import load_bench
from bench.config.procedure.check import check, disk_needed_bytes, operator_actions, undetermined
from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Mount, Plan, Read, Turn, Wait
from bench.config.shipped import find_bench, find_procedure
from bench.results.check import listing
from bench.services import until as command
from drivers.facts import agilent_34401a as facts
from drivers.instruments.agilent_34401a import Agilent34401A
from drivers.interfaces import VoltmeterLimits, VoltmeterSettings
from tests.support.procedure_texts import HEAD, load_steps

SHIPPED = find_bench("paper-stand")


def written(steps, head=HEAD):
    Path("p.yaml").write_text(head + steps, encoding="utf-8")
    return "p.yaml"


def edited(**changes):
    text = SHIPPED.read_text(encoding="utf-8")
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    Path("b.yaml").write_text(text, encoding="utf-8")
    return "b.yaml"


# --- what is told ------------------------------------------------------------------------------------


def test_a_calibration_is_told_whole_and_a_dry_run_offered(bench):
    status, out, err = bench("check", "calibration", "--bench", SHIPPED)
    assert (status, err) == (0, "")
    assert "determines all twelve coefficients" in out
    assert out.splitlines()[-1].endswith(f"bench run calibration --bench {SHIPPED} --dry-run")
    assert list(Path().iterdir()) == []
    summary = json.loads(bench("check", "calibration", "--json", "-")[1])
    plan = load_procedure(find_procedure("calibration")).plan
    assert summary["expected_s"] == pytest.approx(plan.expected_duration_s())
    assert summary["expected_s"] == summary["longest_s"]
    assert sum(summary["expected_by_kind_s"].values()) == pytest.approx(summary["expected_s"])
    assert sum(summary["expected_by_installation_s"].values()) == pytest.approx(summary["expected_s"])
    assert list(summary["expected_by_installation_s"]) == ["", "1", "2", "V"]
    assert summary["largest_signal_v"] == pytest.approx(2.18)
    assert summary["not_determined"] == [{"temperature_c": None, "coefficients": []}]
    assert summary["problems"] == summary["dry_run_refuses"] == []
    assert 0 < summary["disk"]["needed_bytes"] < summary["disk"]["free_bytes"]


def test_settling_is_told_at_its_shortest_and_its_longest(bench):
    steps = "  - temperature: {at: 40 degC, settle: {precision: 0.1 K, window: 30 min, timeout: 6 h}}\n"
    found = json.loads(bench("check", written(steps), "--json", "-")[1])
    assert found["longest_s"] - found["expected_s"] == pytest.approx(6 * 3600 - 31 * 60)
    assert "(at most 6 h" in bench("check", "p.yaml")[1]


def test_every_problem_is_told_at_once_and_the_status_says_so(bench):
    steps = """\
  - temperature: {at: 80 degC}
  - prompt: {kind: number, text: Supply voltage, unit: V}
  - input: {source: reference, voltage: 50 V}
  - installation: {label: 7, steps: [{turn: {angles: [0 deg], steps: [{read: {nplc: 5, samples: 1000}}]}}]}
"""
    status, out, err = bench("check", written(steps))
    assert (status, err) == (1, "")
    told = [line for line in out.splitlines() if line.startswith("cannot be done: ")]
    for words in (
        "mount/7: the bench file has no installation 7 (it has 1, 2, V, 1T90, 2T90, 1T180, 2T180)",
        "cannot integrate over 5 NPLC; choose from 0.02, 0.2, 1, 10, 100",
        "1000 samples exceed the 512 that a voltmeter stores",
        "the reference of 50 V",
        "80 °C exceeds the limits of the block",
    ):
        assert sum(words in line for line in told) == 1, words
    assert len(told) == 5
    assert "a dry run refuses it: step 0002/ask: the prompt 'Supply voltage' has no default" in out
    assert "try it" not in out


@pytest.mark.slow
def test_fewer_samples_than_a_voltmeter_takes_are_refused_as_its_driver_would(bench, monkeypatch):
    monkeypatch.setattr(facts, "LEAST_SAMPLES", 2)
    limits = VoltmeterLimits.of(facts)
    monkeypatch.setattr(Agilent34401A, "limits", limits)
    quick = find_procedure("quick").read_text(encoding="utf-8")
    for samples, status in ((1, 1), (2, 0)):
        Path("p.yaml").write_text(quick.replace("samples: 5", f"samples: {samples}"), encoding="utf-8")
        checked, out, err = bench("check", "p.yaml")
        assert checked == status, (samples, out, err)
        assert (f"{samples} samples are fewer than the 2 that a voltmeter needs" in out + err) == bool(status)
        assert bool(limits.transgressions(VoltmeterSettings(10.0, 10.0, samples))) == bool(status)
    settling = quick.replace("settle: 5 s", "settle: {precision: 1 mV, window: 5 s, timeout: 1 min}")
    Path("p.yaml").write_text(settling, encoding="utf-8")
    assert bench("run", "p.yaml", "--dry-run", "--name", "settled")[0] == 0


def test_a_prompt_without_default_is_no_mistake_but_a_dry_run_is_not_offered(bench):
    status, out, _ = bench("check", written("  - prompt: {kind: confirm, text: Ready}\n"))
    assert status == 0
    assert "a dry run refuses it" in out
    assert "--dry-run" not in out
    assert "no calibration: the procedure has no reading" in out


def test_the_mistakes_of_both_files_are_told_together(bench):
    status, out, err = bench(
        "check", written("  - wait: {for: 1 V}\n"), "--bench", edited(**{"limit: 5 arcsec": "limit: 5 V"})
    )
    assert (status, out) == (2, "")
    assert "p.yaml:4: steps[1].wait.for" in err
    assert "b.yaml:" in err
    assert "Traceback" not in err


def test_a_disk_that_is_too_full_is_a_problem(bench, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(command.shutil, "disk_usage", lambda path: usage(1, 1, 1_000_000))
    status, out, _ = bench("check", "paper")
    assert status == 1
    assert "cannot be done: runs: a run needs about 1." in out
    assert "MB of disk, and 1 MB are free" in out


@pytest.mark.slow
def test_what_a_dry_run_wrote_is_within_what_was_foreseen(bench, dry_run_of_paper):
    plan = load_procedure(find_procedure("paper")).plan
    used = sum(file.stat().st_size for file in dry_run_of_paper.iterdir())
    assert used < disk_needed_bytes(plan) < 10 * used


# --- what the operator does --------------------------------------------------------------------------


def test_operator_actions_count_what_no_motor_does(tmp_path):
    plan = load_steps(
        tmp_path,
        """\
  - temperature: {at: 40 degC, soak: 1 h}
  - input: {source: short}
  - prompt: {kind: confirm, text: Ready}
  - installation: {label: 1, steps: [{turn: {angles: [0 deg, 1 deg, 2 deg]}}]}
""",
    ).plan
    manual = load_bench(SHIPPED)
    # a temperature, inputs there and back, a prompt, a mount with its thermometer, three turns
    assert operator_actions(plan, manual) == 1 + 2 + 1 + 2 + 3
    alone = manual.instruments.model_copy(update={"chamber": None})
    assert operator_actions(plan, manual.model_copy(update={"instruments": alone})) == 2 + 1 + 1 + 3
    motor = load_bench(find_bench("bench-motorised")).instruments.head
    turned = manual.instruments.model_copy(update={"head": motor})
    assert operator_actions(plan, manual.model_copy(update={"instruments": turned})) == 1 + 2 + 1 + 2


# --- what it determines ------------------------------------------------------------------------------


def forces(*rows):
    return np.array(rows, dtype=float)


def test_coefficients_along_an_axis_that_is_never_turned_stay_open():
    angle = np.radians(np.arange(0, 360, 45))
    first = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    second = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    assert undetermined(np.vstack([first, second])) == ()
    assert undetermined(first) == ("Kxy", "Kyy", "Kzy")
    assert undetermined(second) == ("Kxz", "Kyz", "Kzz")
    assert undetermined(forces([1, 0, 0], [-1, 0, 0])) == tuple(f"K{i}{j}" for i in "xyz" for j in "yz")
    assert len(undetermined(forces([0, 0, 1]))) == 12  # nothing was ever turned: bias and K_z are one


@pytest.mark.slow
@given(st.lists(st.sampled_from(["+x", "-x", "+y", "-y", "+z", "-z"]), min_size=1, max_size=8))
def test_it_refuses_what_a_calibration_refuses(ups):
    force = forces(*[[float(axis == up[1]) * float(up[0] + "1") for axis in "xyz"] for up in ups])
    try:
        require_rank(force)
    except CalibrationError:
        assert undetermined(force)
    else:
        assert undetermined(force) == ()


def test_open_coefficients_are_told_by_temperature(bench):
    steps = """\
  - installation: {label: 1, steps: [{turn: {angles: {from: 0 deg, step: 45 deg, count: 8}}}]}
  - temperature: {at: 50 degC}
  - installation: {label: 1, steps: [{turn: {angles: {from: 0 deg, step: 45 deg, count: 8}}}]}
  - installation: {label: 2, steps: [{turn: {angles: {from: 0 deg, step: 45 deg, count: 8}}}]}
"""
    status, out, _ = bench("check", written(steps))
    assert status == 0
    assert "at the first temperature: no calibration by itself" in out
    assert "leave Kxy, Kyy, Kzy open" in out
    assert "at 50 °C: determines all twelve coefficients" in out


# --- the list of steps -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["calibration", "temperature", "stability", "inputs", "repeatability"])
def test_the_lines_stand_for_every_step_once_in_order(name):
    plan = load_procedure(find_procedure(name)).plan
    lines = list(listing(plan))
    covered = [number for line in lines for number in range(line.first, line.last + 1)]
    assert covered == list(range(1, len(plan.steps) + 1))
    assert len(lines) < len(plan.steps) / 3


def test_a_pass_stands_in_one_line_that_says_where_it_goes():
    lines = [line.text for line in listing(load_procedure(find_procedure("calibration")).plan)]
    assert lines[4] == (
        "installation 1, pass 2, point 9 to 1, falling, 360° to 0°: turn, wait 10 s: settling, read 10 × 10 NPLC"
    )
    assert lines[1] == "mount the block in installation 1"


def test_what_differs_is_never_folded():
    """Steps that are alike but for samples, direction or installation stand in lines of their own."""
    turn = Turn("a", "1", 1, 1, 1, 0.0, 1)
    read = Read("b", "1", 1, 1, 1, 0.0, 1, 10, 10.0)
    other = Read("c", "1", 1, 1, 2, 0.0, 1, 20, 10.0)
    back = Turn("d", "1", 1, 1, 2, 0.0, -1)
    steps = (
        Mount("m", "1", 1),
        turn,
        read,
        turn,
        other,
        back,
        read,
        Wait("w", 1.0, "x"),
        Wait("v", 2.0, "x"),
    )
    lines = list(listing(Plan("p", steps, "")))
    assert [(line.first, line.last) for line in lines] == [(n, n) for n in range(1, 10)]


def test_many_passes_fold_once_more_and_all_prints_each_step(tmp_path, bench):
    steps = """\
  - installation:
      label: 1
      steps:
        - repeat:
            times: 50
            steps:
              - repeat: {directions: [rising, falling], steps: [{turn: {angles: [0 deg, 1 deg, 2 deg]}}]}
"""
    plan = load_steps(tmp_path, steps).plan
    lines = list(listing(plan))
    assert [(line.first, line.last) for line in lines] == [(1, 1), (2, 10), (11, 19), (20, 901)]
    assert lines[3].text == "the same 49 times more, to installation 1, pass 100, point 1"
    out = bench("check", "p.yaml", "--all")[1].splitlines()
    assert out[: len(plan.steps)] == [f"{n:>13}  {s.describe()}" for n, s in enumerate(plan.steps, start=1)]


# --- a motorised head: every place on the way must lie within its limits --------------------------------


def turn_to(degrees, direction):
    return Turn(f"t{degrees}", "1", 1, 1, 1, float(np.radians(degrees)), direction)


def on_the_motorised_head(*steps):
    return check(Plan("p", steps, ""), load_bench(find_bench("bench-motorised")))


def test_a_turn_whose_way_leads_out_of_the_limits_is_refused_once():
    bench = load_bench(find_bench("bench-motorised"))
    highest = float(np.degrees(bench.head_limits_rad[1]))
    found = on_the_motorised_head(turn_to(highest, -1), turn_to(highest, -1), turn_to(highest, 1))
    assert len(found) == 1
    assert f"falling to {highest:g}°" in found[0]
    assert on_the_motorised_head(turn_to(highest + 1, 1))
