"""How the block is fed, in a bench file: what it says, and all that is wrong with it at once."""

import copy
import json

import pytest
import yaml

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.bench_file.stand import DriftForm, UnitSupplySection
from bench.config.shipped import find_bench
from tests.support.fed_bench import FEED, MANUAL, N15, P15, fed_bench, write_fed
from tests.support.pages import DOCS, blocks


def told(folder, feed):
    with pytest.raises(FileMistakes) as error:
        load_bench(write_fed(folder, feed))
    return error.value.mistakes


def with_rail(**changes):
    """The feeding with a first rail that has these parts, those inside others merged."""
    rail = copy.deepcopy(P15)
    for key, value in changes.items():
        rail[key] = {**rail[key], **value} if isinstance(value, dict) else value
    return {**FEED, "rails": [rail, N15]}


def test_rails_are_read_in_volts_and_amperes_in_the_order_of_switching(tmp_path):
    supply = fed_bench(tmp_path, pause="500 ms").unit_under_test.supply
    assert [rail.name for rail in supply.rails] == ["p15", "n15"]
    assert supply.rails[1].window_v == pytest.approx((-15.2, -14.8))
    assert supply.rails[0].current_limit == pytest.approx(0.15)
    assert (supply.switching_s, supply.least_off, supply.warm_up_s, supply.longest_warm_up_s) == (
        0.5,
        10.0,
        1200.0,
        1200.0,
    )


def test_a_warm_up_may_be_until_the_signals_have_settled(tmp_path):
    stated = {"drift": "0.1 mV", "per": "10 min", "timeout": "2 h", "interval": "30 s"}
    supply = fed_bench(tmp_path, warm_up=stated).unit_under_test.supply
    assert supply.warm_up == DriftForm(drift="0.1 mV", per="10 min", timeout="2 h", interval="30 s")
    assert (supply.warm_up_s, supply.longest_warm_up_s) == (630.0, 7200.0)


@pytest.mark.parametrize(
    ("changes", "place", "text"),
    [
        ({"voltage": "17.9 V"}, "voltage", "17.7 to 18.1 V, but the block tolerates -0.5 to 18 V only"),
        ({"voltage": "-15 V"}, "voltage", "the block tolerates -0.5 to 18 V only"),
        ({"voltage": "0 V"}, "voltage", "remove rails that do not feed the block"),
        ({"tolerance": "0 V"}, "tolerance", "no supply keeps a voltage exactly"),
        ({"tolerance": "15 V"}, "tolerance", "lets a rail of 15 V be none"),
        ({"current_limit": "250 mA"}, "current_limit", "exceeds the 0.2 A that the block may draw"),
        ({"current_limit": "120 mA"}, "current_limit", "is not above the 0.12 A of operation"),
        ({"current": {"minimum": "130 mA"}}, "current", "0.13 A is not below the largest of 0.12 A"),
        ({"limits": {"minimum": "19 V"}}, "limits", "19 V is not below the maximum of 18 V"),
        (
            {"over_voltage": "15.1 V"},
            "over_voltage",
            "within the rail's own tolerance; state one beyond 15.2 V",
        ),
        ({"over_voltage": "-16 V"}, "over_voltage", "within the rail's own tolerance"),
        ({"over_voltage": "19 V"}, "over_voltage", "the block tolerates -0.5 to 18 V only"),
        ({"name": "+15 V"}, "name", "a small letter, then small letters and digits"),
    ],
)
def test_a_rail_that_could_harm_the_block_is_refused(tmp_path, changes, place, text):
    by_place = {mistake.place: mistake for mistake in told(tmp_path, with_rail(**changes))}
    mistake = by_place[f"unit_under_test.supply.rails[1].{place}"]
    assert text in mistake.text
    assert mistake.line > 0


def test_all_mistakes_are_told_at_once_with_their_lines(tmp_path):
    twice = {**P15, "current_limit": "1 A", "over_voltage": "20 V"}
    found = told(tmp_path, {**FEED, "rails": [P15, twice], "warm_up": "20 V", "when_unsafe": "maybe"})
    assert [mistake.place.removeprefix("unit_under_test.supply.") for mistake in found] == [
        "rails[2].name",
        "rails[2].output",
        "rails[2].current_limit",
        "rails[2].over_voltage",
        "warm_up",
        "when_unsafe",
    ]
    assert len({mistake.line for mistake in found}) == len(found)


@pytest.mark.parametrize(
    ("warm_up", "text"),
    [
        ({"drift": "0 V", "per": "10 min", "timeout": "2 h"}, "no two samples are equal"),
        ({"drift": "1 mV", "per": "10 min", "timeout": "10 min"}, "at least the time of the drift"),
        (
            {"drift": "1 mV", "per": "10 s", "timeout": "1 h", "interval": "1 min"},
            "at most the time of the drift",
        ),
    ],
)
def test_a_warm_up_that_cannot_come_about_is_refused(tmp_path, warm_up, text):
    (mistake,) = told(tmp_path, {**FEED, "warm_up": warm_up})
    assert text in mistake.text


def refused_by_supply(folder, feed, **supply):
    with pytest.raises(FileMistakes) as error:
        load_bench(write_fed(folder, feed, supply={**MANUAL, **supply}))
    return [
        (mistake.place.removeprefix("unit_under_test.supply."), mistake.text)
        for mistake in error.value.mistakes
    ]


def test_rails_beyond_what_the_supply_can_do_are_refused_all_at_once(tmp_path):
    weak = {"P25V": {"maximum": "12 V", "current": "100 mA"}}
    found = refused_by_supply(tmp_path, with_rail(over_voltage="16 V"), outputs=weak)
    assert [place for place, _ in found] == ["rails[1].output"] * 3 + ["rails[2].output"]
    for (_, text), said in zip(
        found,
        ("15 V (it has 0 to 12 V)", "limit of 0.15 A", "protection (it has none)", "'N25V'"),
        strict=True,
    ):
        assert said in text


def test_a_block_that_is_fed_has_a_power_supply_on_its_bench(tmp_path):
    path = write_fed(tmp_path)
    text = path.read_text(encoding="utf-8")
    head, _, rest = text.partition("  power_supply:")
    path.write_text(head + rest[rest.index("stand:") :], encoding="utf-8")
    with pytest.raises(FileMistakes, match="the bench has no power supply"):
        load_bench(path)


@pytest.mark.parametrize("name", ["bench-gpib", "bench-lan"])
def test_the_supply_that_a_shipped_bench_file_shows_in_comments_is_one(tmp_path, name):
    lines = find_bench(name).read_text(encoding="utf-8").splitlines()
    supply = next(i for i, line in enumerate(lines) if line.startswith("  # supply:"))
    end = next(i for i in range(supply, len(lines)) if not lines[i].startswith("  #"))
    for i in (next(i for i, x in enumerate(lines) if "# power_supply:" in x), *range(supply, end)):
        lines[i] = lines[i].replace("# ", "", 1)
    (tmp_path / "bench.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    bench = load_bench(tmp_path / "bench.yaml")
    assert [rail.name for rail in bench.unit_under_test.supply.rails] == ["p15", "n15"]
    assert load_bench(find_bench(name)).unit_under_test.supply is None


def test_the_supply_that_the_page_shows_is_one():
    (shown,) = [b.text for b in blocks(DOCS / "real-bench.md") if b.marked("file") == "fed-part.yaml"]
    stated = yaml.safe_load(shown)["unit_under_test"]["supply"]
    as_text = json.loads(json.dumps(stated), parse_int=str, parse_float=str)
    assert UnitSupplySection.model_validate({**as_text, "when_unsafe": "off"}).least_off == 10.0
