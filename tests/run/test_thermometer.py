"""The thermometer at the block: beside the signals, in the record, in the budget; without one as before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bench.base.yaml_files import FileMistakes
from bench.calibration.budget.meters import thermometer_size
from bench.config.bench_file.file import corrections_of, load_bench
from bench.config.shipped import find_bench
from bench.readings.csv import read_csv
from bench.run.folder import Run
from drivers.instruments.keysight_34970a import Keysight34970AThermometer
from drivers.instruments.manual import ManualThermometer
from drivers.interfaces import BadReading, LimitExceeded
from drivers.person import Answer

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
    monkeypatch.setattr("bench.results.page.render_report", lambda _content: "")
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


def test_a_person_is_asked_again_for_what_the_thermometer_cannot_show():
    class Answers:
        def __init__(self, *texts):
            self.texts = list(texts)

        def ask(self, prompt):
            return Answer(prompt.id, self.texts.pop(0))

    person = Answers("-", "999", "23,4 °C", *["hot"] * 5)
    thermometer = ManualThermometer("thermometer", person, minimum_c=-50.0, maximum_c=120.0, sensor="glass")
    assert thermometer.block_c("1/mount") == 23.4
    with pytest.raises(BadReading, match="within its range"):
        thermometer.block_c("1/mount")
