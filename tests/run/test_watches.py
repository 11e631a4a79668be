"""What is watched during a run: the chamber, the clocks, the thermometer at the block."""

import json
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from bench.base.yaml_files import FileMistakes
from bench.calibration.budget.meters import thermometer_size
from bench.config.bench_file.file import corrections_of, load_bench
from bench.config.procedure.plan import Plan, SetTemperature, Settle, Wait
from bench.config.shipped import find_bench
from bench.readings.csv import read_csv
from bench.run.folder import Run
from bench.run.listening import ClockWatch
from bench.run.samples import SLOW_AFTER_S, ChamberWatch
from bench.run.sentences import sentence
from drivers.instruments.keysight_34970a import Keysight34970AThermometer
from drivers.interfaces import InstrumentLost, LimitExceeded
from sim.world.clock import VirtualClock
from tests.run.test_way_out import Chamber, with_chamber
from tests.support.runner_bench import READS, Bench, changed, make_runner, new_record, recorded


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
    assert "sent to 60 °C: check that it conditions and is closed" in sentence(event)


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


BESIDE = '{driver: keysight-34970a-thermometer, resource: "%s", interface: gpib, channel: %s}'
CERTIFICATE = (
    ", certificate: {number: T-1, laboratory: somebody, date: 2026-01-01, "
    "values: [{temperature: 20 degC, correction: 0.15 K, U: 0.04 K, k: 2}]}"
)


def with_thermometer(tmp_path, section, name="bench-multiplexer"):
    text = find_bench(name).read_text(encoding="utf-8")
    path = tmp_path / "own.yaml"
    path.write_text(text.replace("\n  head:", f"\n  thermometer: {section}\n  head:", 1), encoding="utf-8")
    return path


def meter_resource():
    return load_bench(find_bench("bench-multiplexer")).instruments.voltmeters[0].resource


@pytest.mark.slow
def test_beside_the_signals_it_tells_the_temperature_of_each_reading(bench, tmp_path, monkeypatch):
    monkeypatch.setattr("bench.results.page.render_report", lambda *_, **__: "")
    path = with_thermometer(tmp_path, BESIDE % (meter_resource(), 104))
    status, out, err = bench("run", "quick", "--dry-run", "--bench", path, "--name", "a", "--seed", "5")
    assert (status < 2, err) == (True, ""), out
    plain = bench("run", "quick", "--dry-run", "--bench", "bench-multiplexer", "--name", "b", "--seed", "5")
    assert plain[0] < 2
    own, other = (Run(Path("runs") / name).readings() for name in "ab")
    assert np.abs(own.temperature_c - 23.0).max() < 0.1
    assert set(own.extra["temperature_source"].tolist()) == {"Pt100, four wires, channel 104"}
    assert np.abs(own.signal - other.signal).max() < 1e-4, "the meter was set up again for the signals"
    assert "temperature_source" not in other.extra
    assert "temperature_source" not in Path("runs/b/events.jsonl").read_text(encoding="utf-8")
    assert bench("export", "a", "--csv", "a.csv")[0] == 0
    assert read_csv(Path("a.csv"), ["1", "2"]).notes == ()
    result = json.loads(Path("runs/a/calibrate.json").read_text(encoding="utf-8"))
    assert "thermometer" in json.dumps(result)


def test_a_channel_that_has_a_signal_is_refused(tmp_path):
    with pytest.raises(FileMistakes, match="is voltmeter 1 already"):
        load_bench(with_thermometer(tmp_path, BESIDE % (meter_resource(), 102)))
    with pytest.raises(FileMistakes, match=r"on its channels 01 to 10, such as 104, not 115"):
        load_bench(with_thermometer(tmp_path, BESIDE % ("GPIB0::10::INSTR", 115)))
    with pytest.raises(LimitExceeded, match="channel 115"):
        Keysight34970AThermometer("thermometer", None, None, channel=115)


def test_its_size_is_that_of_its_kind_or_certificate_with_the_gradient(tmp_path):
    section = BESIDE % ("GPIB0::10::INSTR", 104)
    kind = thermometer_size(load_bench(with_thermometer(tmp_path, section)))
    assert kind.distribution.u == pytest.approx(np.hypot(0.06 + 0.3 + 0.115, 0.2) / np.sqrt(3.0))
    assert kind.prior
    stated = section.replace("}", ", gradient: 0.05 K" + CERTIFICATE + "}", 1)
    file = load_bench(with_thermometer(tmp_path, stated))
    known = thermometer_size(file)
    assert known.distribution.u == pytest.approx(np.hypot(0.02, 0.05 / np.sqrt(3.0)))
    assert not known.prior
    assert corrections_of(file).thermometer == ((20.0, 0.15),)
    assert thermometer_size(load_bench(find_bench("bench-multiplexer"))) is None
