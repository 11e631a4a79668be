"""The check of each morning on simulated benches: a good one, what is wrong with its remedy, the check block."""

import json
import math
from contextlib import contextmanager
from pathlib import Path

import pytest

import bench.services.instruments as command
from bench.config.shipped import find_bench
from bench.run.assembly.served import dry_evening
from bench.run.commission.session import CommissioningPerson
from bench.run.events import Wish
from bench.run.person import OperatorWish, RunControl
from drivers.interfaces import InstrumentLost
from tests.support.check_runs import measured, write_bench
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to


@pytest.fixture
def morning(bench):
    """Carry out a dry morning; return its findings by check and the last line."""

    def call(file, *more, status=0):
        arguments = ("--morning", "--bench", file, "--dry-run", "--out", "m", "--json", "m.json", *more)
        out = printed(bench("check", *arguments), status=status)
        result = json.loads(Path("m.json").read_text(encoding="utf-8"))
        keeps_to("commission", result)
        by_check = {one["check"]: one for one in result["findings"]}
        return result, by_check, out

    return call


@pytest.mark.slow
def test_a_good_morning_is_one_green_line_within_five_minutes(morning):
    result, by_check, out = morning("bench-motorised", "--reference", "2")
    assert out.splitlines()[-1].startswith("✓ bench-motorised is ready, ")
    assert {
        "identity", "self-test", "noise, inputs shorted", "reference", "home and back", "check block",
    } == by_check.keys()  # fmt: skip
    assert out.splitlines()[-1].endswith("check block not checked: the bench file states none")
    assert result["took_s"] < 300.0
    assert "<title>Morning check of" in Path("m/commissioning.html").read_text(encoding="utf-8")


BY_HAND = {"check block",
    "identity", "home", "self-test", "away and back", "noise, inputs shorted", "reference", "home and back",
}  # fmt: skip


def by_hand(turn_s: int) -> str:
    """Write a bench file whose person needs `turn_s` for each turn; return its name."""
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    assert "turn_time: [60 s, 180 s]" in text
    text = text.replace("turn_time: [60 s, 180 s]", f"turn_time: [{turn_s} s, {turn_s} s]")
    Path("hand.yaml").write_text(text, encoding="utf-8")
    return "hand.yaml"


@pytest.fixture
def evenings(monkeypatch):
    """Yield the dry sessions that begin; `prepare` of the list is called with each of them."""

    class Evenings(list):
        prepare = staticmethod(lambda evening: None)

    seen = Evenings()

    @contextmanager
    def evening(*arguments):
        with dry_evening(*arguments) as made:
            seen.append(made)
            seen.prepare(made)
            yield made

    monkeypatch.setattr(command, "dry_evening", evening)
    return seen


@pytest.mark.slow
def test_by_hand_even_a_slow_turn_leaves_the_check_within_five_minutes(morning):
    result, by_check, out = morning(by_hand(165), "--reference", "2")
    assert out.splitlines()[-1].startswith("✓ paper-stand is ready, ")
    assert by_check.keys() == BY_HAND
    assert result["took_s"] < 300.0


@pytest.mark.slow
def test_a_quick_turn_does_not_shorten_the_wait_with_shorted_inputs(morning):
    quick, _, _ = morning(by_hand(60))
    Path("m").rename("quick")
    slower, _, _ = morning(by_hand(100))
    assert quick["took_s"] == pytest.approx(slower["took_s"], abs=1.0)


@pytest.mark.slow
def test_a_head_that_was_left_elsewhere_is_turned_home_first(morning, evenings):
    turns = []

    def elsewhere(evening):
        world = evening.person._world
        world.turn(math.radians(90.0), 1)
        turn = world.turn
        world.turn = lambda angle_rad, direction: (turns.append(angle_rad), turn(angle_rad, direction))

    evenings.prepare = elsewhere
    result, by_check, _ = morning(by_hand(60))
    assert by_check["home and back"]["state"] == "works"
    assert [round(math.degrees(angle_rad), 1) for angle_rad in turns] == [0.0, 5.0, 0.0]
    assert result["took_s"] < 300.0


@pytest.mark.slow
def test_a_block_that_moved_in_its_clamp_on_the_way_is_reported(morning, evenings):
    def loose(evening):
        world = evening.person._world
        turn = world.turn

        def slipped(angle_rad, direction):
            turn(angle_rad, direction)
            if angle_rad > 0.01:
                world.mount("1", 2)

        world.turn = slipped

    evenings.prepare = loose
    text = Path(by_hand(60)).read_text(encoding="utf-8")
    Path("hand.yaml").write_text(
        text.replace("axis_tilt: {limit: 5 arcsec", "axis_tilt: {limit: 1 deg"), encoding="utf-8"
    )
    _, by_check, out = morning("hand.yaml", status=1)
    assert by_check["home and back"]["state"] == "other"
    assert "check the clamping of block and head" in out.splitlines()[-1]


@pytest.mark.slow
def test_skipped_inputs_end_no_other_check(morning, evenings):
    def without_shorts(evening):
        scripted = evening.person

        class Person:
            meanwhile = None

            def ask(self, prompt):
                if "short their inputs" in prompt.text:
                    raise OperatorWish(RunControl(Wish.SKIP, "no shorts here"))
                return scripted.ask(prompt)

        evening.person = CommissioningPerson(Person())

    evenings.prepare = without_shorts
    result, by_check, out = morning(by_hand(60))
    assert result["ended"] == ""
    assert by_check["inputs"]["said"] == "no shorts here"
    assert by_check.keys() == (BY_HAND | {"inputs"}) - {"noise, inputs shorted"}
    assert by_check["reference"]["said"] == "no --reference is given"
    assert "inputs not checked: no shorts here" in out.splitlines()[-1]


def test_nobody_is_asked_for_anything_if_no_voltmeter_responds(morning, evenings):
    def unplugged(evening):
        for meter in evening.instruments.voltmeters:
            meter.open = lambda name=meter.name: (_ for _ in ()).throw(
                InstrumentLost(name, "no answer", "plug it in")
            )
        evening.person = None

    evenings.prepare = unplugged
    result, by_check, out = morning(by_hand(60), status=2)
    assert by_check.keys() == {"identity"}
    assert result["ended"] == (
        "no voltmeter responds, so nothing else was checked; check the meters' power, cables and addresses"
    )
    assert "voltmeter.z: identity: no answer; plug it in" in out.splitlines()[-1]


@pytest.mark.slow
def test_what_is_wrong_is_said_with_its_remedy(morning):
    text = find_bench("bench-motorised").read_text(encoding="utf-8")
    effects = "effects:\n  - name: voltmeter_offset\n    parameters: {offset: 5 mV}\n"
    Path("bad.yaml").write_text(f"{text}\n{effects}", encoding="utf-8")
    _, by_check, out = morning("bad.yaml", status=1)
    assert by_check["noise, inputs shorted"]["state"] == "other"
    assert "✗ bench-motorised is not ready" in out
    assert "short the input at the meter's own terminals" in out.splitlines()[-1]


@pytest.mark.slow
def test_one_setting_of_the_check_block_is_held_against_its_chart(morning):
    write_bench()
    _, by_check, out = morning("my.yaml")
    assert by_check["check block"]["state"] == "skipped"
    assert "check block not checked" in out.splitlines()[-1]
    for day in range(3):
        measured(f"check-{day}", seed=10 + day)
    Path("m").rename("first")
    result, by_check, _ = morning("my.yaml", "--seed", "5")
    assert by_check["check block"]["state"] == "works"
    assert "installation 1 at 0° agrees" in by_check["check block"]["said"]
    assert result["took_s"] < 300.0
    text = Path("my.yaml").read_text(encoding="utf-8")
    moved = "effects:\n  - name: scale_asymmetry\n    channels: [z]\n    parameters: {Kabs: 1000 ug/g}\n"
    Path("my.yaml").write_text(f"{text}\n{moved}", encoding="utf-8")
    Path("m").rename("second")
    _, by_check, out = morning("my.yaml", "--seed", "5", status=1)
    assert by_check["check block"]["state"] == "other"
    assert "differs from its control chart (p = " in out


def test_it_asks_a_person_or_is_dry(bench):
    assert "start it in a terminal, or add --dry-run" in refused(
        bench("check", "--morning", "--bench", "bench-lan")
    )
    assert "no procedure is named" in refused(bench("check"))
