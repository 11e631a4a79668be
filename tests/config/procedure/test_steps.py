"""The procedure language: settling, inputs, temperatures, what becomes of a failure."""

import pytest

from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import check
from bench.config.procedure.plan import (
    Mount,
    OnFailure,
    Read,
    SelectInput,
    SetTemperature,
    Settle,
    Turn,
    Wait,
)
from bench.config.shipped import find_bench


def test_settling_is_a_time_or_says_when(load):
    head = (
        "procedure: p\nreading: {settle: {precision: 50 uV, window: 10 s, timeout: 2 min}}\nsteps:\n"
        "  - settle: {what: temperature, precision: 0.1 K, window: 30 min, timeout: 6 h}\n"
    )
    body = """\
  - temperature: {at: 40 degC, soak: 1 h, settle: {precision: 50 mK, window: 20 min, timeout: 3 h, interval: 2 min}}
  - installation:
      label: 1
      steps:
        - settle: {precision: 1 mV, window: 5 s, timeout: 1 min, interval: 500 ms}
        - turn: {angles: [0 deg]}
"""
    plan = load(body, head).plan
    assert [(type(s), s.key) for s in plan.steps] == [
        (Settle, "0001/settle"),
        (SetTemperature, "0002/temperature"),
        (Settle, "0003/settle"),
        (Wait, "0004/wait"),
        (Mount, "0005/mount/1"),
        (Settle, "0006/settle"),
        (Turn, "0007/turn/1.1.1"),
        (Settle, "0008/settle"),
        (Read, "0009/read/1.1.1"),
    ]
    settled = [s for s in plan.steps if isinstance(s, Settle)]
    assert [(s.what, s.window_s, s.timeout_s, s.interval_s) for s in settled] == [
        ("temperature", 1800.0, 21600.0, 60.0),
        ("temperature", 1200.0, 10800.0, 120.0),
        ("signals", 5.0, 60.0, 0.5),
        ("signals", 10.0, 120.0, 1.0),
    ]
    assert [s.precision for s in settled] == pytest.approx([0.1, 0.05, 1e-3, 50e-6])


def test_what_can_never_settle_is_a_mistake(mistakes):
    told = mistakes(
        """\
  - settle: {precision: 0 V, window: 10 s, timeout: 1 min}
  - settle: {precision: 1 mV, window: 10 s, timeout: 10 s}
  - settle: {precision: 1 mV, window: 10 s, timeout: 1 min, interval: 20 s}
  - settle: {precision: 0.1 K, window: 10 s, timeout: 1 min}
  - temperature: {at: 20 degC, settle: {precision: 0.1 degC, window: 30 min, timeout: 6 h}}
  - settle: {what: humidity, precision: 1 mV, window: 10 s, timeout: 1 min}
  - settle: 10 s
"""
    )
    expected = [
        "4 steps[1].settle: the precision is not above 0",
        "5 steps[2].settle: the timeout is too short; state at least the window plus one interval",
        "6 steps[3].settle: the interval is not between 0 and the window",
        "7 steps[4].settle.precision: expected a voltage such as '0.3 mV', got '0.1 K'",
        "8 steps[5].temperature.settle.precision: expected a difference of temperatures such as '0.1 K', got",
        "9 steps[6].settle.what: expected signals, got 'humidity'",
        "10 steps[7].settle: expected keys with values, got '10 s'",
    ]
    for start in expected:
        assert any(mistake.startswith(start) for mistake in told), (start, told)
    assert len(told) == len(expected)


def test_inputs_are_switched_there_and_back_and_their_points_counted(load):
    plan = load(
        """\
  - input: {source: short}
  - installation:
      label: 1
      steps:
        - repeat:
            times: 2
            steps:
              - input: {source: reference, voltage: 2 V, steps: [{read: {times: 2, pause: 3 s, samples: 7}}]}
              - turn: {angles: [0 deg]}
  - installation: {label: 1, steps: [{input: {source: short}}]}
"""
    ).plan
    assert [s.key for s in plan.steps] == [
        "0001/input", "0002/wait", "0003/read/S.1.1", "0004/input", "0005/mount/1",
        "0006/input", "0007/read/R.1.1", "0008/wait", "0009/read/R.1.2", "0010/input",
        "0011/turn/1.1.1", "0012/wait", "0013/read/1.1.1",
        "0014/input", "0015/read/R.2.1", "0016/wait", "0017/read/R.2.2", "0018/input",
        "0019/turn/1.2.1", "0020/wait", "0021/read/1.2.1", "0022/mount/1s2",
        "0023/input", "0024/wait", "0025/read/Ss2.1.1", "0026/input",
    ]  # fmt: skip
    assert plan.steps[5] == SelectInput("0006/input", "reference", 2.0)
    assert plan.steps[9] == SelectInput("0010/input", "signal")
    read = plan.steps[6]
    assert (read.target_rad, read.direction, read.samples) == (None, None, 7)


def test_what_stands_wrong_about_inputs_and_temperatures_is_told(mistakes):
    told = mistakes(
        """\
  - input: {source: reference}
  - input: {source: short, voltage: 2 V}
  - input: {source: open}
  - installation:
      label: 1
      steps:
        - input: {source: short, steps: [{turn: {angles: [0 deg]}}, {input: {source: short}}]}
        - turn: {angles: [0 deg], steps: [{temperatures: {at: [20 degC], steps: [{read: }]}}]}
        - read: {pause: 3 s}
  - temperatures: {at: [20 degC], steps: [{temperatures: {at: [], steps: [{wait: {for: 1 s}}]}}]}
"""
    )
    expected = [
        "4 steps[1].input: the source 'reference' has no 'voltage'; add it",
        "5 steps[2].input: the source 'short' takes no 'voltage'; remove it",
        "6 steps[3].input.source: expected short or reference, got 'open'",
        "10 steps[4].installation.steps[1].input.steps[1].turn: a turn is inside an input",
        "10 steps[4].installation.steps[1].input.steps[2].input: an input is inside an input",
        "11 steps[4].installation.steps[2].turn.steps[1].temperatures: a list of temperatures is inside the",
        "12 steps[4].installation.steps[3].read: 'pause' is between readings",
        "12 steps[4].installation.steps[3].read: a read is outside of a turn",
        "13 steps[5].temperatures.steps[1].temperatures.at: expected a list of at least 1",
        "13 steps[5].temperatures.steps[1].temperatures: a list of temperatures is inside another",
    ]
    for start in expected:
        assert any(mistake.startswith(start) for mistake in told), (start, told)
    assert len(told) == len(expected), told


def test_each_temperature_is_a_series_whether_the_block_stays_or_is_mounted_again(load):
    stays = """\
  - installation:
      label: 1
      steps: [{temperatures: {at: [20 degC, 40 degC, 20 degC], steps: [{turn: {angles: [0 deg]}}]}}]
"""
    again = """\
  - temperatures:
      at: [20 degC, 40 degC, 20 degC]
      soak: 1 h
      steps: [{installation: {label: 1, steps: [{turn: {angles: [0 deg]}}]}}]
"""
    visit = "  - installation: {label: 1, steps: [{turn: {angles: [0 deg]}}]}\n"
    for body, mounts in ((stays, [1, 4]), (again, [1, 2, 3, 4])):
        plan = load(body + visit).plan
        assert [s.series for s in plan.steps if isinstance(s, Read)] == [1, 2, 3, 4]
        assert [s.series for s in plan.steps if isinstance(s, Mount)] == mounts
        assert [s.target_c for s in plan.steps if isinstance(s, SetTemperature)] == [20.0, 40.0, 20.0]


def test_what_becomes_of_a_failure_is_said_at_the_nearest_place(load):
    own = "on_failure: {repeat: 5}\nsteps:\n  - turn: {angles: [9 deg], first_point: 9}\n"
    body = """\
  - installation:
      label: 1
      steps:
        - turn: {angles: [0 deg], steps: [{read: }]}
        - turn: {angles: [1 deg], first_point: 2, steps: [{read: {on_failure: {repeat: 0, then: stop}}}]}
        - include: own.yaml
"""

    def failures(head):
        plan = load(body, head + "steps:\n", own=own).plan
        return [(s.on_failure.repeats, s.on_failure.then) for s in plan.steps if isinstance(s, Turn | Read)]

    said = "procedure: p\non_failure: {repeat: 2, then: continue}\n"
    assert (
        failures("procedure: p\n") == [(1, "stop"), (1, "stop"), (1, "stop"), (0, "stop")] + [(5, "stop")] * 2
    )
    assert failures(said) == [(2, "continue")] * 3 + [(0, "stop")] + [(5, "stop")] * 2
    reading = said + "reading: {on_failure: {repeat: 3}}\n"
    assert failures(reading)[:2] == [(2, "continue"), (3, "stop")]
    assert OnFailure() == OnFailure(1, "stop")


def test_a_bench_refuses_what_its_instruments_cannot_do(load, tmp_path):
    plan = load(
        """\
  - settle: {what: temperature, precision: 0.1 K, window: 30 s, timeout: 1 h, interval: 10 s}
  - input: {source: reference, voltage: 20 V}
  - temperature: {at: 80 degC}
  - temperature: {at: 80 degC}
  - installation: {label: 1, steps: [{turn: {angles: [0 deg]}}]}
"""
    ).plan
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    assert "range: 10 g" in text
    path = tmp_path / "b.yaml"
    path.write_text(text.replace("range: 10 g", "range: 0.5 g"), encoding="utf-8")
    told = check(plan, load_bench(path))
    assert [sentence.partition(";")[0] for sentence in told] == [
        "step 0002/input: the reference of 20 V exceeds the voltmeters' range of 10 V",
        "the block is given 1 g along an axis, but measures no more than 0.5 g",
        "step 0006/temperature: 80 °C exceeds the limits of the block, -40 to 60 °C",
        "step 0001/settle: the procedure waits for a temperature, but a person reads it",
    ]
    chamber = next(line for line in text.splitlines() if line.startswith("  chamber:"))
    path.write_text(text.replace(chamber + "\n", ""), encoding="utf-8")
    assert (
        "step 0001/settle: the procedure waits for a temperature, but the bench file has no chamber; add one"
        in check(plan, load_bench(path))
    )
