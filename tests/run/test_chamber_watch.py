"""A chamber that hardly moves after a demand is told of; one that moves, or was asked for little, is not."""

import pytest

from bench.config.procedure.plan import Plan, SetTemperature, Settle, Wait
from bench.run.samples import SLOW_AFTER_S, ChamberWatch
from bench.run.sentences import sentence
from drivers.interfaces import InstrumentLost
from sim.world.clock import VirtualClock
from tests.run.test_way_out import Chamber, with_chamber
from tests.support.runner_bench import Bench, make_runner, new_record, recorded


class Drifting(Chamber):
    """Its air goes from 20 °C by `rate_k_min` on the clock of the run."""

    def __init__(self, bench, rate_k_min):
        super().__init__(bench)
        self.rate_k_min = rate_k_min
        self.clock = None
        self.asked = 0

    def temperature(self, key, *, settling=False):
        self.asked += 1
        return 20.0 + self.rate_k_min * self.clock.now_s() / 60.0


SOAK = Wait("2/soak", 3600.0, "soak")
SETTLE = Settle("2/settle", "temperature", 1000.0, 600.0, 3600.0, 30.0)


def events_of(tmp_path, rate_k_min, after, target_c=60.0, **options):
    chamber = Drifting(Bench(), rate_k_min)
    record = new_record(tmp_path)
    plan = Plan("test", (SetTemperature("1/temperature", target_c), after), "")
    runner = with_chamber(make_runner(chamber.bench, record, plan, **options), chamber)
    chamber.clock = runner.bench.clock
    runner.run()
    record.close()
    history, _, _ = recorded(tmp_path / "run")
    return [event for event in history.events if event.type == "chamber_slow"]


@pytest.mark.parametrize("after", [SOAK, SETTLE], ids=["soak", "settle"])
@pytest.mark.parametrize("rate_k_min", [0.0, -1.0, 1.59])
def test_a_chamber_short_of_a_fifth_of_its_way_is_told_of_once_and_the_run_goes_on(
    tmp_path, after, rate_k_min
):
    (event,) = events_of(tmp_path, rate_k_min, after)
    assert event.data["after_s"] == pytest.approx(SLOW_AFTER_S, abs=30.0)
    assert "sent to 60 °C: see that it conditions and is shut" in sentence(event)


@pytest.mark.parametrize("after", [SOAK, SETTLE], ids=["soak", "settle"])
@pytest.mark.parametrize(("rate_k_min", "target_c"), [(1.7, 60.0), (0.0, 21.0)])
def test_one_on_its_way_or_asked_for_little_is_not(tmp_path, after, rate_k_min, target_c):
    assert events_of(tmp_path, rate_k_min, after, target_c) == []


def test_the_bench_file_says_when_it_is_looked_at(tmp_path):
    (event,) = events_of(tmp_path, 0.5, SOAK, slow_chamber_s=900.0)
    assert event.data["after_s"] == pytest.approx(900.0, abs=1.0)
    assert event.data["air_c"] == pytest.approx(27.5, abs=0.1)


def test_a_chamber_that_is_lost_meanwhile_is_left_to_the_step_that_needs_it():
    clock = VirtualClock()
    chamber = Drifting(Bench(), 0.0)
    chamber.clock = clock
    watch = ChamberWatch(clock, SLOW_AFTER_S, lambda kind, data: pytest.fail("it is not known to be slow"))
    watch.begin(chamber, 60.0, "1/temperature")
    clock.sleep(SLOW_AFTER_S)

    def lost(key, *, settling=False):
        raise InstrumentLost("chamber", "it is gone", "check the cable")

    chamber.temperature = lost
    watch.look(chamber, "2/soak")
    assert not watch.due
