"""Plans: hash, JSON, expected time."""

import hashlib
import json
import math
from dataclasses import fields, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.config.procedure.plan import (
    Ask,
    Mount,
    OnFailure,
    OperatorTime,
    Plan,
    Read,
    SelectInput,
    SetTemperature,
    Settle,
    Turn,
    Wait,
)
from drivers.person import PromptKind

STEPS = (
    SetTemperature("0001/temperature", 40.0),
    Wait("0002/wait", 5400.0, "soak"),
    Mount("0003/mount/1s2", "1", 2),
    Turn("0004/turn/1s2.1.2", "1", 2, 1, 2, math.pi / 4, -1),
    Read("0005/read/1s2.1.2", "1", 2, 1, 2, math.pi / 4, -1, 10, 10.0),
    Ask("0006/ask", PromptKind.CHOOSE, "Which?", "a", "", ("a", "b"), None, None),
    Ask("0007/ask", PromptKind.NUMBER, "Supply", None, "V", (), 10.0, 30.0),
    Settle("0008/settle", "signals", 50e-6, 10.0, 120.0, 1.0),
    Settle("0009/settle", "temperature", 0.1, 1800.0, 21600.0, 60.0),
    SelectInput("0010/input", "reference", 2.0),
    Read("0011/read/R.1.3", "R", 1, 1, 3, None, None, 5, 10.0, OnFailure(2, "continue")),
    SelectInput("0012/input", "signal"),
)
PLAN = Plan("p", STEPS, "ab" * 32, OperatorTime(100.0, 900.0, 20.0))

# without an alphabet, hypothesis takes seconds to find the same characters
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
numbers = st.floats(allow_nan=False, allow_infinity=False)
wholes = st.integers(1, 10**6)
directions = st.sampled_from([1, -1])
failures = st.builds(OnFailure, st.integers(0, 100), st.sampled_from(["stop", "continue"]))
steps = st.one_of(
    st.builds(Mount, texts, texts, wholes),
    st.builds(Turn, texts, texts, wholes, wholes, wholes, numbers, directions, failures),
    st.builds(
        Read,
        texts,
        texts,
        wholes,
        wholes,
        wholes,
        st.none() | numbers,
        st.none() | directions,
        wholes,
        numbers,
        failures,
    ),
    st.builds(Settle, texts, st.sampled_from(["signals", "temperature"]), numbers, numbers, numbers, numbers),
    st.builds(SelectInput, texts, st.sampled_from(["signal", "short", "reference"]), st.none() | numbers),
    st.builds(Wait, texts, numbers, texts),
    st.builds(SetTemperature, texts, numbers),
    st.builds(
        Ask,
        texts,
        st.sampled_from(PromptKind),
        texts,
        st.none() | texts,
        texts,
        st.lists(texts, max_size=3).map(tuple),
        st.none() | numbers,
        st.none() | numbers,
    ),
)


@pytest.mark.slow
@settings(max_examples=20)
@given(texts, st.lists(steps, max_size=6).map(tuple), texts)
def test_a_plan_survives_json(name, some_steps, sha256):
    plan = Plan(name, some_steps, sha256)
    again = Plan.from_json(json.loads(json.dumps(plan.to_json())))
    assert again == plan
    assert again.hash == plan.hash


def changed(value):
    """Return another value of the same type."""
    match value:
        case PromptKind():
            return PromptKind.ANGLE
        case str():
            return value + "x"
        case tuple():
            return (*value, "c")
        case None:
            return "1"
        case OnFailure():
            return OnFailure(value.repeats + 1, value.then)
        case float():
            return math.nextafter(value, math.inf)
        case _:
            return -value


def test_any_change_changes_the_hash():
    seen = {PLAN.hash}
    for index, step in enumerate(STEPS):
        for field in fields(step):
            other = replace(step, **{field.name: changed(getattr(step, field.name))})
            seen.add(
                Plan(
                    "p",
                    (*STEPS[:index], other, *STEPS[index + 1 :]),
                    PLAN.procedure_sha256,
                    PLAN.operator_time,
                ).hash
            )
    changes = sum(len(fields(step)) for step in STEPS)
    others = [
        replace(PLAN, name="q"),
        replace(PLAN, procedure_sha256="cd"),
        replace(PLAN, steps=STEPS[::-1]),
        replace(PLAN, operator_time=OperatorTime(101.0, 900.0, 20.0)),
    ]
    seen |= {plan.hash for plan in others}
    assert len(seen) == 1 + changes + len(others)


def test_the_hash_is_the_same_in_every_process():
    assert replace(PLAN).hash == PLAN.hash
    plan = Plan("p", (Wait("0001/wait", 1.5, "µ"),), "00")
    assert plan.hash[:12] == "f2e3bc2e8ba5"


def test_counts_and_times():
    assert PLAN.counts() == {
        "mount": 1, "turn": 1, "wait": 1, "settle": 2, "read": 2, "input": 2, "ask": 2, "temperature": 1,
    }  # fmt: skip
    assert sum(step.BY_OPERATOR for step in PLAN.steps) == 7
    reading_s = (10 + 5) * (2 * 10 / 50)
    times = PLAN.duration_by_kind_s(line_hz=50.0)
    assert list(times) == list(PLAN.counts())
    assert times["read"] == pytest.approx(reading_s, rel=0.05)
    assert PLAN.duration_by_kind_s(line_hz=60.0)["read"] < times["read"]
    assert {k: v for k, v in times.items() if k != "read"} == {
        "mount": 900.0,
        "turn": 100.0,
        "wait": 5400.0,
        "settle": 11.0 + 1860.0,
        "input": 120.0,
        "ask": 40.0,
        "temperature": 20.0,
    }
    assert PLAN.expected_duration_s() == pytest.approx(sum(PLAN.step_duration_s(step) for step in STEPS))
    assert PLAN.longest_duration_s() - PLAN.expected_duration_s() == pytest.approx(109.0 + 19740.0)
    by_mount = PLAN.duration_by_mount_s()
    assert by_mount[""] == 20.0 + 5400.0
    assert list(by_mount) == ["", "1 (series 2)"]
    assert sum(by_mount.values()) == pytest.approx(PLAN.expected_duration_s())


def test_steps_say_what_they_are():
    assert [step.describe() for step in STEPS] == [
        "set the chamber to 40 °C",
        "wait 90 min: soak",
        "mount the block in installation 1 (series 2)",
        "turn the head to 45°, falling, for installation 1 (series 2), pass 1, point 2",
        "read installation 1 (series 2), pass 1, point 2 at 45°: 10 samples of 10 power-line cycles",
        "ask: Which? [a]",
        "ask: Supply",
        "wait until the signals stay within 50 µV for 10 s, at most 2 min",
        "wait until the temperature stays within 0.1 K for 30 min, at most 6 h",
        "switch the three inputs to the reference of 2 V",
        "read the reference input, pass 1, point 3: 5 samples of 10 power-line cycles",
        "switch the three inputs back to the signals",
    ]
    assert SelectInput("1", "short").describe() == "short the three inputs"


def test_what_is_no_plan_is_refused():
    good = PLAN.to_json()
    with pytest.raises(ValueError, match="'jump' is not a known kind of step"):
        Plan.from_json(good | {"steps": [{"step": "jump"}]})
    with pytest.raises(TypeError):
        Plan.from_json(good | {"steps": [{"step": "wait", "key": "1"}]})
    with pytest.raises(KeyError):
        Plan.from_json({})


def test_a_plan_from_before_there_was_more_to_say_is_read_and_keeps_its_hash():
    old = {
        "name": "p",
        "procedure_sha256": "00",
        "operator_time": {"turn_s": 120.0, "mount_s": 1200.0, "answer_s": 30.0},
        "steps": [
            {"step": "turn", "key": "0001/turn/1.1.1", "installation": "1", "series": 1, "pass_number": 1,
             "point": 1, "target_rad": 0.5, "direction": 1},
            {"step": "read", "key": "0002/read/1.1.1", "installation": "1", "series": 1, "pass_number": 1,
             "point": 1, "target_rad": 0.5, "direction": 1, "samples": 10, "nplc": 10.0},
        ],
    }  # fmt: skip
    plan = Plan.from_json(old)
    assert [step.on_failure for step in plan.steps] == [OnFailure(1, "stop")] * 2
    assert plan.operator_time.input_s > 0
    assert plan.to_json() == old
    text = json.dumps(old, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert plan.hash == hashlib.sha256(text.encode()).hexdigest()
