"""The block's supply in a run: switched, watched, recorded, left as is safe, found again when a run goes on."""

import contextlib
import math
from dataclasses import replace

import pytest

from bench.config.procedure.plan import Mount, Plan, Power, Read, Turn, Wait
from bench.run.events import RunState, Wish
from bench.run.person import Controls, RunControl
from bench.run.power import SET_AGAIN, RailFault
from bench.run.record import Record, resume_point
from bench.run.runner import RunAborted
from drivers.interfaces import BenchError, NoAnswer, OutputSettings
from drivers.person import Answer
from sim.world.clock import VirtualClock
from tests.run.test_way_out import Deciding, in_doubt_at
from tests.support.fed_runs import Supply, fed_runner, found_on
from tests.support.runner_bench import NOON, PLAN, READS, STOP, Bench, Meter, Wishing, new_record, recorded

ON = [("P25V", True), ("N25V", True)]
OFF = [("N25V", False), ("P25V", False)]


def switched(supply):
    return [(output, on) for _, output, on in supply.done]


def powers(history):
    return [event.data["power"] for event in history.events if event.type == "power"]


def sag(output="P25V", volts=12.0):
    return lambda supply: supply.befall(output, voltage_v=volts)


@pytest.fixture
def run(tmp_path):
    """Carry out a run; return history, readings and what stopped it."""

    def carried_out(supply, plan=PLAN, bench=None, name="run", **options):
        record = new_record(tmp_path, name)
        stopped = None
        runner = fed_runner(bench or Bench(), record, supply, plan, **options)
        try:
            runner.run()
        except (BenchError, RunAborted, KeyboardInterrupt) as error:
            stopped = error
        record.close()
        history, _, readings = recorded(tmp_path / name)
        return history, readings, stopped

    return carried_out


def test_a_run_switches_the_block_on_in_order_and_off_in_reverse(run):
    supply = Supply(VirtualClock())
    history, readings, stopped = run(supply, feed={"pause": "3 s"})
    assert stopped is None
    assert switched(supply) == ON + OFF
    (first_s, _, _), (second_s, _, _) = supply.done[:2]
    assert second_s - first_s == 3.0
    assert powers(history) == ["on", "off"]
    assert [state for _, state in history.power] == ["on", "off"]
    assert len(readings) == len(READS)


def test_each_reading_has_voltage_and_current_of_each_rail(run):
    _, readings, _ = run(Supply(VirtualClock()))
    expected = {
        "p15": {"voltage_v": 15.0, "nominal_v": 15.0, "current_a": 0.05},
        "n15": {"voltage_v": -15.0, "nominal_v": -15.0, "current_a": 0.05},
    }
    assert all(reading["rails"] == expected for reading in readings)


def test_the_block_is_warm_before_the_first_step(run):
    supply = Supply(VirtualClock())
    history, _, _ = run(supply)
    (warm,) = [event for event in history.events if event.type == "warmed_up"]
    assert warm.data["after_s"] == pytest.approx(1200.0)
    first = next(event for event in history.events if event.type == "step_started")
    assert warm.number < first.number


def test_how_long_it_was_off_before_is_not_known_so_the_least_time_off_passes(run):
    supply = Supply(VirtualClock())
    run(supply, feed={"least_off": "45 s"})
    assert supply.done[0][0] == pytest.approx(45.0)


@pytest.mark.parametrize("look", [3, 6, 200, 300])
@pytest.mark.parametrize(
    ("befalls", "said"),
    [
        (sag(), "rail p15 has 12 V, not 14.8 to 15.2 V"),
        (lambda s: s.befall("N25V", on=False, tripped=True), "rail n15 was switched off by a protection"),
        (lambda s: s.befall("P25V", limiting=True, voltage_v=9.0), "rail p15 is in current limit"),
        (lambda s: s.befall("P25V", current_a=0.3), "rail p15 gives 0.3 A, not 0.02 to 0.12 A"),
        (lambda s: s.befall("N25V", on=False), "rail n15 is off"),
        (
            lambda s: s.befall("P25V", settings=OutputSettings(15.0, 1.0)),
            "the current limit is 1 A, not 0.15 A",
        ),
    ],
)
def test_a_rail_that_is_not_as_it_should_be_stops_the_run_and_switches_the_block_off(
    run, look, befalls, said
):
    supply = Supply(VirtualClock(), at={look: befalls})
    history, readings, stopped = run(supply)
    assert supply.looks >= look
    assert isinstance(stopped, RailFault)
    assert said in str(stopped)
    assert not supply.is_on
    assert history.state is RunState.FAILED
    assert powers(history)[-2:] in (["fault", "off"], ["fault"])
    assert len(readings) < len(READS)


class Fetching(Bench):
    """Keeps how often the supply had been looked at when the meters were fetched."""

    def __init__(self, supply):
        super().__init__()
        self.supply, self.looks = supply, []

    def act(self, *what):
        super().act(*what)
        if what[0] == "fetch":
            self.looks.append(self.supply.looks)


def looks_at_fetching(run):
    """How often the supply had been looked at when the first, the second … meter was fetched."""
    supply = Supply(VirtualClock())
    bench = Fetching(supply)
    run(supply, bench=bench, name="whole")
    return bench.looks


def test_a_rail_that_goes_while_the_meters_sample_is_seen_before_the_reading_is_believed(run):
    before = looks_at_fetching(run)[0]
    supply = Supply(VirtualClock(), at={before + 1: sag()})
    bench = Fetching(supply)
    _, readings, stopped = run(supply, bench=bench)
    assert isinstance(stopped, RailFault)
    assert bench.looks == [before] * 3
    assert readings == []


@pytest.mark.parametrize(
    ("controls", "state"),
    [
        (None, RunState.FINISHED),
        (Wishing(KeyboardInterrupt(), 2000), RunState.INTERRUPTED),
        (Wishing(BenchError("chamber", "alarm", "look"), 2000), RunState.FAILED),
        (Wishing(RunControl(Wish.ABORT, "wrong block"), 2000), RunState.ABORTED),
        (Wishing(KeyboardInterrupt(), 5), RunState.INTERRUPTED),
        (Wishing(RunControl(Wish.ABORT), 100), RunState.ABORTED),
    ],
)
@pytest.mark.parametrize("unsafe", ["off", "stay-on"])
def test_every_way_out_leaves_the_block_as_is_safe_for_it(run, controls, state, unsafe):
    supply = Supply(VirtualClock())
    again = controls and Wishing(controls.what, controls.left)
    options = {"controls": again} if again else {}
    history, _, _ = run(supply, feed={"when_unsafe": unsafe}, **options)
    assert history.state is state
    begun = ("P25V", True) in switched(supply)
    assert supply.is_on == (unsafe == "stay-on" and begun)
    if begun:
        assert (powers(history)[-1] == "off") == (unsafe == "off")


def test_a_supply_that_does_not_obey_on_the_way_out_is_told(run):
    def sticks(supply):
        supply.stuck = True
        sag()(supply)

    history, _, _ = run(Supply(VirtualClock(), at={50: sticks}))
    (to_do,) = [*history.events][-1].data["to_do"].values()
    assert to_do.startswith("could not switch the block off: switch it off by hand")


def test_a_block_that_is_on_as_it_is_to_be_is_not_switched_at_the_start(run):
    supply = Supply(VirtualClock(), found_on())
    history, _, stopped = run(supply, feed={"when_unsafe": "stay-on"})
    assert stopped is None
    assert switched(supply) == []
    assert powers(history) == ["found on"]


class Answering:
    def __init__(self, *answers):
        self.answers, self.asked = list(answers), []

    def ask(self, prompt):
        self.asked.append(prompt.text)
        if "its settings differ from the bench file" in prompt.text:
            return Answer(prompt.id, self.answers.pop(0))
        given = prompt.default or (prompt.choices[0] if prompt.choices else "yes")
        return Answer(prompt.id, "7" if prompt.unit else given)


@pytest.mark.parametrize("partly", [False, True])
def test_a_supply_that_is_on_and_set_otherwise_is_asked_about_and_never_changed_silently(run, partly):
    found = found_on()
    if partly:
        found["N25V"] = replace(found["N25V"], on=False)
    else:
        found["P25V"] = replace(found["P25V"], settings=OutputSettings(12.0, 0.5))
    left = Supply(VirtualClock(), found)
    _, _, stopped = run(left, person=Answering("leave it"))
    assert "with other settings than the bench file states" in str(stopped)
    assert switched(left) == []


def test_with_leave_it_is_switched_off_and_set_as_the_bench_file_says(run):
    found = found_on()
    found["P25V"] = replace(found["P25V"], settings=OutputSettings(12.0, 0.5))
    supply = Supply(VirtualClock(), found)
    _, _, stopped = run(supply, person=Answering(SET_AGAIN))
    assert stopped is None
    assert switched(supply) == OFF + ON + OFF
    assert supply.done[2][0] - supply.done[1][0] >= 10.0


def test_a_rail_that_is_refused_leaves_none_on(run):
    supply = Supply(VirtualClock())
    supply.at = {2: sag("N25V", -20.0)}
    _, _, stopped = run(supply, feed={"when_unsafe": "stay-on"})
    assert "rail n15 has -20 V" in str(stopped)
    assert not supply.is_on


# --- warm-up -----


SETTLED = {"drift": "0.1 mV", "per": "10 min", "timeout": "1 h", "interval": "30 s"}


class Drifting(Bench):
    """Its signals come to rest with a time constant, s; infinite: they never do."""

    def __init__(self, clock, tau_s):
        super().__init__()
        self.clock, self.tau_s = clock, tau_s

    def volts(self):
        now_s = self.clock.now_s()
        return 1.0 + (math.exp(-now_s / self.tau_s) if math.isfinite(self.tau_s) else 1e-6 * now_s)


@pytest.fixture
def drifting(monkeypatch):
    """Let the meters of a bench show what it drifts to."""
    monkeypatch.setattr(Meter, "fetch", lambda meter: {meter.channel: (meter.bench.volts(),) * meter.samples})


def test_a_warm_up_lasts_until_the_signals_have_settled(run, drifting):
    supply = Supply(VirtualClock())
    told = []
    history, _, stopped = run(
        supply, bench=Drifting(supply.clock, 200.0), feed={"warm_up": SETTLED}, on_settling=told.append
    )
    assert stopped is None
    (warm,) = [event.data for event in history.events if event.type == "warmed_up"]
    # exp(-t/200 s) falls from 0.1 mV on: 1842 s after the beginning, and the window of 600 s has to fill
    assert 1842.0 - 15.0 <= warm["after_s"] + 12.0 - 600.0 <= 1842.0 + 60.0
    assert len(warm["at"]) == 3
    assert any(state.left_s for state in told)


def test_signals_that_never_settle_end_the_run_at_the_timeout_and_switch_the_block_off(run, drifting):
    supply = Supply(VirtualClock())
    _, readings, stopped = run(supply, bench=Drifting(supply.clock, math.inf), feed={"warm_up": SETTLED})
    assert "not warm 1 h after it was switched on" in str(stopped)
    assert readings == []
    assert not supply.is_on


# --- steps ------------------------------------------------------------------------------------------


def with_steps(*added):
    """The plan with steps before its first reading's turn, and one that cycles after the third reading."""
    return Plan("test", (*added, *PLAN.steps), "")


def test_a_procedure_may_switch_the_block_itself(run):
    supply = Supply(VirtualClock())
    plan = with_steps(Power("p1", "off"), Power("p2", "on", 0.0, 60.0), Power("p3", "cycle", 100.0, 0.0))
    history, _, stopped = run(supply, plan)
    assert stopped is None
    assert switched(supply) == OFF + ON + OFF + ON + OFF
    times = [time_s for time_s, _, _ in supply.done]
    assert times[6] - times[5] >= 100.0
    brought = [e.data for e in history.events if e.type == "step_done" and "switched" in e.data]
    assert [(b["switched"], b["warmed_up_s"]) for b in brought][:2] == [("off", None), ("on", 60.0)]


def test_what_is_off_on_purpose_is_not_watched_and_has_no_rails(run):
    where = ("S", 1, 1, 1, None, None)
    plan = Plan("off", (Power("p", "off"), Read("r", *where, 2, 10.0, STOP)), "")
    _, readings, stopped = run(Supply(VirtualClock()), plan)
    assert stopped is None
    assert "rails" not in readings[0]


# --- wishes while it is switched --------------------------------------------------------------------


def point(series, number):
    where = ("1", series, 1, number, 0.5 * number, 1)
    key = f"{series}.{number}"
    return (
        Turn(f"t{key}", *where, STOP),
        Wait(f"w{key}", 5.0, "settling"),
        Read(f"r{key}", *where, 2, 10.0, STOP),
    )


CYCLED = Plan(
    "cycled",
    (Mount("m", "1", 1), *point(1, 1), *point(1, 2), Power("p", "cycle", 600.0), *point(2, 1), *point(2, 2)),
    "",
)


class At(Controls):
    """One wish, as soon as `due` is true."""

    def __init__(self, wish, due):
        self.wishes, self.due = [RunControl(wish, "why")], due

    def poll(self):
        return self.wishes.pop() if self.wishes and self.due() else None


@pytest.mark.parametrize("wish", [Wish.REPEAT_POINT, Wish.REPEAT_PASS, Wish.MOUNT_AGAIN, Wish.SKIP])
@pytest.mark.parametrize("when", [ON + OFF, ON + OFF + ON], ids=["off", "cold"])
def test_no_wish_makes_a_reading_of_a_block_that_is_off_or_cold(run, wish, when):
    """The point measured before was repeated while the block was off, and replaced the good reading."""
    supply = Supply(VirtualClock())
    history, readings, stopped = run(supply, CYCLED, controls=At(wish, lambda: switched(supply) == when))
    assert stopped is None
    assert [(one["series"], one["point"]) for one in readings] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert all(one["rails"] for one in readings)
    answers = [event.type for event in history.events if event.type in {"wish_refused", "skipped"}]
    assert answers == (["skipped"] if wish is Wish.SKIP and when != ON + OFF else ["wish_refused"])
    assert switched(supply) == ON + OFF + ON + OFF  # what is refused switches the block no further time


def test_a_point_that_is_left_out_leaves_the_switching_after_it(run):
    """The readings of the next series were taken without the switching that is their purpose."""
    supply, bench = Supply(VirtualClock()), Bench()
    due = At(Wish.SKIP, lambda: ("move", "t1.2") in bench.done)
    history, readings, _ = run(supply, CYCLED, bench, controls=due)
    assert [(one["series"], one["point"]) for one in readings] == [(1, 1), (2, 1), (2, 2)]
    assert powers(history) == ["on", "off", "on", "off"]


def test_after_the_switching_no_point_of_the_series_before_it_is_repeated(run):
    """It would be a reading of the block as switched on again, among those before."""
    supply, done = Supply(VirtualClock()), []

    def note(event):
        done.extend([event.data["key"]] if event.type == "step_done" else [])

    due = At(Wish.REPEAT_POINT, lambda: done[-1:] == ["p"])
    _, readings, _ = run(supply, CYCLED, controls=due, observers=[note])
    assert due.wishes == []
    assert [(one["series"], one["point"]) for one in readings] == [(1, 1), (1, 2), (2, 1), (2, 2)]


# --- going on ---------------------------------------------------------------------------------------


@pytest.fixture
def taken_up(tmp_path):
    """Interrupt a run within installation 1, after two readings, and go on with another supply."""

    def go_on(first, then, feed=None, **options):
        record = new_record(tmp_path)
        bench = Bench(KeyboardInterrupt(), at=20)
        with contextlib.suppress(KeyboardInterrupt, BenchError):
            fed_runner(bench, record, first, feed=feed or {}).run()
        record.close()
        record, history = Record.reopen(tmp_path / "run", lambda: NOON)
        assert 0 < len(history.readings) < 3
        point = resume_point(PLAN, history)
        fed_runner(Bench(), record, then, feed=feed or {}, progress=history.progress.copy(), **options).run(
            point
        )
        record.close()
        return recorded(tmp_path / "run")

    return go_on


def test_a_run_that_goes_on_with_the_block_off_meanwhile_warms_it_up_as_another_visit(taken_up):
    again = Supply(VirtualClock())
    history, keys, readings = taken_up(Supply(VirtualClock()), again)
    assert keys == READS
    assert switched(again) == ON + OFF
    assert [event.type for event in history.events].count("warmed_up") == 2
    (visit,) = [event.data for event in history.events if event.type == "remounted"]
    assert visit["why"] == "power"
    series = [(reading["installation"], reading["series"]) for reading in readings]
    assert series[0] == ("1", 1)
    assert series[2] == ("1", visit["now_series"]) == ("1", 2)
    assert series[3:] == [("2", 1)] * 3


def test_a_run_that_goes_on_with_the_block_on_all_the_time_is_one_visit(taken_up):
    again = Supply(VirtualClock(), found_on())
    history, _, readings = taken_up(Supply(VirtualClock()), again, {"when_unsafe": "stay-on"})
    assert switched(again) == []
    assert {reading["series"] for reading in readings} == {1}
    assert not [event for event in history.events if event.type == "remounted"]


def test_a_reading_in_doubt_is_asked_about_before_the_block_is_warmed_up(run, tmp_path):
    """The question came after the warm-up."""
    supply, bench = Supply(VirtualClock()), Bench()
    _, _, stopped = run(supply, bench=bench, watch=in_doubt_at("r12"), decider=Deciding(bench))
    assert isinstance(stopped, NoAnswer)
    again, bench = Supply(VirtualClock()), Bench()
    record, history = Record.reopen(tmp_path / "run", lambda: NOON)
    options = {"progress": history.progress.copy(), "decider": Deciding(bench, "redo point")}
    with contextlib.closing(record):
        fed_runner(bench, record, again, **options).run(resume_point(PLAN, history))
    events = recorded(tmp_path / "run")[0].events
    told = [e.type for e in events if e.type in {"redo", "power", "warmed_up", "step_done"}]
    assert told[told.index("redo") :][:4] == ["redo", "power", "warmed_up", "step_done"]


def test_a_rail_that_came_back_by_itself_is_another_visit_all_the_same(run, taken_up):
    at_second = looks_at_fetching(run)[3]
    first = Supply(VirtualClock(), at={at_second: sag()})
    again = Supply(VirtualClock(), found_on())
    history, _, readings = taken_up(first, again, {"when_unsafe": "stay-on"})
    assert switched(again) == []
    assert powers(history) == ["on", "fault", "found on"]
    assert [reading["series"] for reading in readings] == [1, 2, 2, 1, 1, 1]


def test_the_least_time_off_is_kept_when_a_run_goes_on(taken_up):
    again = Supply(VirtualClock())
    taken_up(Supply(VirtualClock()), again, {"least_off": "10 min"})
    assert again.done[0][0] >= 590.0
