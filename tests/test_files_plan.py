"""Plans: hash, JSON, expected time."""

import json
import math
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.plan import Ask, Mount, OperatorTime, Plan, Read, SetTemperature, Turn, Wait
from drivers.interfaces import PromptKind

STEPS = (
    SetTemperature("0001/temperature", 40.0),
    Wait("0002/wait", 5400.0, "soak"),
    Mount("0003/mount/1s2", "1", 2),
    Turn("0004/turn/1s2.1.2", "1", 2, 1, 2, math.pi / 4, -1),
    Read("0005/read/1s2.1.2", "1", 2, 1, 2, math.pi / 4, -1, 10, 10.0),
    Ask("0006/ask", PromptKind.CHOOSE, "Which?", "a", "", ("a", "b"), None, None),
    Ask("0007/ask", PromptKind.NUMBER, "Supply", None, "V", (), 10.0, 30.0),
)
PLAN = Plan("p", STEPS, "ab" * 32, OperatorTime(100.0, 900.0, 20.0))

texts = st.text(max_size=8)
numbers = st.floats(allow_nan=False, allow_infinity=False)
wholes = st.integers(1, 10**6)
directions = st.sampled_from([1, -1])
steps = st.one_of(
    st.builds(Mount, texts, texts, wholes),
    st.builds(Turn, texts, texts, wholes, wholes, wholes, numbers, directions),
    st.builds(Read, texts, texts, wholes, wholes, wholes, numbers, directions, wholes, numbers),
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
    assert PLAN.counts() == {"mount": 1, "turn": 1, "wait": 1, "read": 1, "ask": 2, "temperature": 1}
    assert PLAN.operator_actions() == 5
    reading_s = 10 * (2 * 10 / 50)
    times = PLAN.duration_by_kind_s(line_hz=50.0)
    assert list(times) == list(PLAN.counts())
    assert times["read"] == pytest.approx(reading_s, rel=0.05)
    assert PLAN.duration_by_kind_s(line_hz=60.0)["read"] < times["read"]
    assert {k: v for k, v in times.items() if k != "read"} == {
        "mount": 900.0,
        "turn": 100.0,
        "wait": 5400.0,
        "ask": 40.0,
        "temperature": 20.0,
    }
    assert PLAN.expected_duration_s() == pytest.approx(sum(PLAN.step_duration_s(step) for step in STEPS))


def test_steps_say_what_they_are():
    assert [step.describe() for step in STEPS] == [
        "set the chamber to 40 °C",
        "wait 90 min: soak",
        "mount the block in installation 1 (series 2)",
        "turn the head to 45°, falling, for installation 1 (series 2), pass 1, point 2",
        "read installation 1 (series 2), pass 1, point 2 at 45°: 10 samples of 10 power-line cycles",
        "ask: Which? [a]",
        "ask: Supply",
    ]


def test_what_is_no_plan_is_refused():
    good = PLAN.to_json()
    with pytest.raises(ValueError, match="unknown kind 'jump'"):
        Plan.from_json(good | {"steps": [{"step": "jump"}]})
    with pytest.raises(TypeError):
        Plan.from_json(good | {"steps": [{"step": "wait", "key": "1"}]})
    with pytest.raises(KeyError):
        Plan.from_json({})
