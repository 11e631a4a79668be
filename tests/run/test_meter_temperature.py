"""The temperatures of voltmeters and room in a run: where they come from, the record, the file, the diagnosis."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.diagnosis.candidates import KnownBench
from bench.readings.csv import read_csv
from bench.run.folder import Run
from bench.run.instruments import Instruments, TemperatureCheck, told_around
from drivers.instruments.manual import ManualThermometer
from drivers.person import Answer

SENSOR = '{driver: keysight-34970a-thermometer, resource: "%s", interface: gpib, channel: %s}'
ON_SIGNALS = {
    "meter_thermometer": SENSOR % ("GPIB0::9::INSTR", 104),
    "room_thermometer": SENSOR % ("GPIB0::9::INSTR", 205),
}
BY_HAND = "{driver: manual-thermometer, minimum: 0 degC, maximum: 50 degC}"
SWING = "{swing: 2 K, period: 6 h, meter_lag: 60 min}"


def bench_file(tmp_path, around):
    lines = "".join(f"\n  {key}: {section}" for key, section in around.items())
    text = (
        find_bench("bench-multiplexer")
        .read_text(encoding="utf-8")
        .replace("\n  head:", f"{lines}\n  head:", 1)
    )
    path = tmp_path / "own.yaml"
    path.write_text(f"{text}\nsimulation: {{room: {SWING}}}\n", encoding="utf-8")
    return path


def column(readings, name):
    return np.array([float(cell) for cell in readings.extra[name]])


def swung(time_s, lag_s=0.0):
    """A first-order lag behind 23 °C + 2 K sin(2π t / 6 h), after the first swings."""
    rate = 2.0 * np.pi / 21600.0
    return 23.0 + 2.0 * np.imag(np.exp(1j * rate * time_s) / (1.0 + 1j * rate * lag_s))


@pytest.mark.slow
def test_two_channels_of_the_multiplexer_tell_meters_and_room(bench, tmp_path, monkeypatch):
    monkeypatch.setattr("bench.results.page.render_report", lambda *_, **__: "")
    path = bench_file(tmp_path, ON_SIGNALS)
    status, out, err = bench("run", "quick", "--dry-run", "--bench", path, "--name", "a", "--seed", "5")
    assert (status < 2, err) == (True, ""), out
    readings = Run(Path("runs/a")).readings()
    time_s = readings.time_s
    assert np.abs(column(readings, "meter_temperature_c") - swung(time_s, 3600.0)).max() < 0.05
    assert np.abs(column(readings, "room_c") - swung(time_s)).max() < 0.05
    assert np.ptp(column(readings, "meter_temperature_c")) > 0.5
    assert bench("export", "a", "--csv", "a.csv")[0] == 0
    back = read_csv(Path("a.csv"), ["1", "2"])
    assert back.notes == ()
    assert np.array_equal(back.conditions().meter_c, column(readings, "meter_temperature_c"))
    absent = KnownBench.of(load_bench(path)).absent(readings)
    assert not {"voltmeter_thermal_gain", "voltmeter_thermal_offset"} & set(absent)


def test_a_person_is_asked_once_per_mounting_and_the_chamber_is_read_already():
    asked = []

    def answer(prompt):
        asked.append((prompt.id, prompt.text, prompt.action))
        return Answer(prompt.id, "24.5")

    by_hand = ManualThermometer(
        "meter_thermometer",
        SimpleNamespace(ask=answer),
        minimum_c=0.0,
        maximum_c=50.0,
        sensor="glass",
        of="meter",
    )
    around = Instruments((), None, around={"meter_temperature_c": by_hand, "room_c": "chamber"})

    def check(column):
        return TemperatureCheck(SimpleNamespace(ask=answer))

    told = told_around(around, {}, None, "1/mount", check)
    assert told == {"meter_temperature_c": 24.5}
    assert told_around(around, told, 40.0, "1/read", check) == {"meter_temperature_c": 24.5, "room_c": 40.0}
    assert [(key, action) for key, _, action in asked] == [
        ("1/mount/meter_thermometer#1", {"do": "read_temperature", "of": "meter"})
    ]
    assert "at the voltmeters" in asked[0][1]


@pytest.mark.parametrize(
    ("around", "said"),
    [
        ({"meter_thermometer": SENSOR % ("GPIB0::9::INSTR", 102)}, "is voltmeter 1 already"),
        ({"thermometer": SENSOR % ("GPIB0::7::INSTR", 104), "meter_thermometer": SENSOR % ("GPIB0::7::INSTR", 104)},
         "is the thermometer already"),
        ({"meter_thermometer": "chamber"}, "a person reads this chamber once per mounting"),
        ({"room_thermometer": BY_HAND.replace("}", ", gradient: 1 K}")}, "no 'gradient'; leave it out"),
        ({"room_thermometer": BY_HAND.replace("}", ", name: head}")}, "two instruments are called 'head'"),
    ],
)  # fmt: skip
def test_mistakes_of_these_thermometers_are_told(tmp_path, around, said):
    with pytest.raises(FileMistakes, match=said):
        load_bench(bench_file(tmp_path, around))
