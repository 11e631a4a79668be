"""A computer that slept, or whose civil time was set, is told of; the run goes on and its own time is whole."""

from contextlib import closing
from datetime import UTC, datetime, timedelta

import pytest

from bench.run.listening import ClockWatch
from bench.run.sentences import sentence
from sim.world.clock import VirtualClock
from tests.support.runner_bench import READS, Bench, changed, make_runner, new_record, recorded


class Civil:
    """Civil time that goes with a clock, and `jumps` by so much at the n-th look."""

    def __init__(self, clock, at, jumps_s):
        self.clock, self.at, self.jumps_s, self.looks = clock, at, jumps_s, 0

    def __call__(self):
        self.looks += 1
        ahead_s = self.jumps_s if self.looks >= self.at else 0.0
        return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=self.clock.now_s() + ahead_s)


def jumps_of(tmp_path, jumps_s):
    clock = VirtualClock()
    with closing(new_record(tmp_path)) as record:
        runner = make_runner(Bench(), record)
        runner = changed(runner, clock=clock)
        runner.recorder.clocks = ClockWatch(Civil(clock, 9, jumps_s), clock.now_s)
        runner.run()
    history, keys, readings = recorded(tmp_path / "run")
    assert keys == READS
    assert [reading["time_s"] for reading in readings] == sorted(reading["time_s"] for reading in readings)
    return [event for event in history.events if event.type == "clock_jumped"]


@pytest.mark.parametrize(
    ("jumps_s", "words"), [(8 * 3600.0, "went 8 h 00 min ahead"), (-3600.0, "went 1 h 00 min back")]
)
def test_a_jump_is_told_once_and_every_reading_is_taken(tmp_path, jumps_s, words):
    (event,) = jumps_of(tmp_path, jumps_s)
    assert event.data["ahead_s"] == pytest.approx(jumps_s, abs=0.1)
    assert words in sentence(event)


@pytest.mark.parametrize("jumps_s", [0.0, 5.0, -29.0])
def test_a_clock_that_is_set_by_little_is_none(tmp_path, jumps_s):
    assert jumps_of(tmp_path, jumps_s) == []
