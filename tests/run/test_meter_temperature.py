"""Temperatures of the meters, and temperatures typed far from what is expected."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.diagnosis.known_bench import KnownBench
from bench.readings.csv import read_csv
from bench.run.folder import Run
from bench.run.instruments import (
    Instruments,
    TemperatureCheck,
    told_around,
    told_at_mounting,
    told_at_reading,
)
from drivers.instruments.manual import ManualChamber, ManualThermometer
from drivers.interfaces import BenchError
from drivers.person import ATTEMPTS, Answer, PromptKind

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


class Typing:
    """A person who types these answers, one after the other; `asked` are the questions."""

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)
        self.asked = []

    def ask(self, prompt):
        self.asked.append(prompt)
        return Answer(prompt.id, self.answers.pop(0))

    @property
    def doubts(self) -> list[str]:
        """The questions whether a temperature is right."""
        return [prompt.text for prompt in self.asked if prompt.kind is PromptKind.CONFIRM]


def chamber(person: Typing) -> Instruments:
    return Instruments((), None, chamber=ManualChamber("chamber", person, minimum_c=-40.0, maximum_c=85.0))


def thermometer(person: Typing, of: str = "block") -> ManualThermometer:
    return ManualThermometer("t", person, minimum_c=-40.0, maximum_c=85.0, sensor="glass", of=of)


@pytest.mark.parametrize(
    ("typed", "before", "doubt"),
    [
        ("44", {}, "44 °C: 21 °C from the 23 °C of a usual room. Is that right?"),
        ("-23", {"last_c": 23.2}, "-23 °C: 46.2 °C from the 23.2 °C read before. Is that right?"),
        ("44", {"demanded_c": 55.0}, "44 °C: 11 °C from the 55 °C set. Is that right?"),
        (
            "28,4", {"last_c": 23.0, "demanded_c": 40.0},
            "28.4 °C: 5.4 °C from the 23 °C read before. Is that right?",
        ),
    ],
)  # fmt: skip
def test_an_unexpected_temperature_is_asked_about_once(typed, before, doubt):
    person = Typing(typed, "yes")
    found_c = told_at_mounting(chamber(person), "3/mount", TemperatureCheck(person, **before))
    assert found_c == float(typed.replace(",", "."))
    assert person.doubts == [doubt]
    assert person.asked[1].default is None  # Enter alone confirms nothing


def test_a_temperature_that_the_person_takes_back_is_never_used():
    person = Typing(*["44", "no"] * ATTEMPTS)
    with pytest.raises(BenchError, match="answered no several times to: 44 °C: 21 °C from"):
        told_at_mounting(chamber(person), "3/mount", TemperatureCheck(person))


@pytest.mark.parametrize(
    ("typed", "before"),
    [("31", {}), ("13.5", {}), ("27.9", {"last_c": 23.0}), ("-22", {"demanded_c": -20.0})],
)  # fmt: skip
def test_an_expected_temperature_is_not_asked_about(typed, before):
    person = Typing(typed)
    assert told_at_reading(chamber(person), None, "4/read", TemperatureCheck(person, **before)) == (
        float(typed),
        None,
    )
    assert person.doubts == []


def test_after_no_the_temperature_is_typed_again():
    person = Typing("44", "no", "33.2", "no", "23.2")
    block = Instruments((), None, thermometer=thermometer(person))
    assert told_at_mounting(block, "3/mount", TemperatureCheck(person, 23.0)) == 23.2
    assert len(person.doubts) == 2
    ids = [prompt.id for prompt in person.asked]
    assert ids[0] == "3/mount/thermometer#1"
    assert len(set(ids)) == len(ids)


def test_room_and_meters_are_compared_with_what_was_typed_before():
    person = Typing("32", "no", "23", "24")
    around = {"meter_temperature_c": thermometer(person, "meter"), "room_c": thermometer(person, "room")}
    before = {"meter_temperature_c": 23.5}
    told = told_around(
        Instruments((), None, around=around),
        {},
        None,
        "5/mount",
        lambda c: TemperatureCheck(person, before.get(c)),
    )
    assert told == {"meter_temperature_c": 23.0, "room_c": 24.0}
    assert person.doubts == ["32 °C: 8.5 °C from the 23.5 °C read before. Is that right?"]
