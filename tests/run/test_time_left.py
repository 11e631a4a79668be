"""The time left in a run: no step that is carried out again counts as progress, and no estimate is absurd."""

import pytest

from bench.run.events import Event
from bench.run.terminal import TimeLeft

STEP_S = [3600.0, 7200.0, *[60.0] * 600]
"""A mounting, a soak, and readings of ten hours."""
WHOLE_S = sum(STEP_S)


def told(left, *events):
    for kind, bench_s, data in events:
        left.take(Event(1, "t", bench_s, kind, data))


def carried_out(first, last, bench_s):
    """Return the events of steps that take as long as expected, and the bench time after them, s."""
    events = []
    for step in range(first, last):
        events += [("step_started", bench_s, {"step": step})]
        bench_s += STEP_S[step]
        events += [("step_done", bench_s, {"step": step})]
    return events, bench_s


@pytest.mark.parametrize("from_s", [None, 0.0], ids=["real", "dry"])
def test_a_soak_repeated_after_a_stop_only_delays_the_rest(from_s):
    """The estimate took it for the progress of the whole run: minutes were left of a day, or less than none."""
    left = TimeLeft(STEP_S)
    half, bench_s = carried_out(0, 302, 0.0)
    told(left, *half)
    rest_s = WHOLE_S - sum(STEP_S[:302])
    assert left.at(302) == pytest.approx(rest_s, rel=0.01)
    told(left, ("run_resumed", bench_s, {"step": 302}), ("step_started", bench_s, {"step": 1}))
    assert left.at(1) == pytest.approx(7200.0 + rest_s)
    bench_s = from_s if from_s is not None else bench_s + 7200.0  # the clock of a dry run is set back
    told(left, ("step_done", bench_s, {"step": 1}), ("step_started", bench_s, {"step": 302}))
    assert left.at(302) == pytest.approx(rest_s, rel=0.01)


def test_a_block_mounted_again_soaks_and_the_pass_is_to_be_done():
    left = TimeLeft(STEP_S)
    half, bench_s = carried_out(0, 302, 0.0)
    told(left, *half, ("redo", bench_s, {"first": 202, "last": 301, "wish": "remount"}))
    rest_s = WHOLE_S - sum(STEP_S[:202])
    told(left, ("step_started", bench_s, {"step": 1}))
    assert left.at(1) == pytest.approx(7200.0 + rest_s, rel=0.01)
    told(
        left, ("step_done", bench_s + 7200.0, {"step": 1}), ("step_started", bench_s + 7200.0, {"step": 202})
    )
    assert left.at(202) == pytest.approx(rest_s, rel=0.01)


def test_a_slow_person_makes_the_rest_longer():
    left = TimeLeft(STEP_S)
    events, _ = carried_out(0, 302, 0.0)
    told(left, *[(kind, 2.0 * bench_s, data) for kind, bench_s, data in events])
    assert left.at(302) == pytest.approx(2.0 * (WHOLE_S - sum(STEP_S[:302])), rel=0.05)
