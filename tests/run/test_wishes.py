"""What an operator wishes during a run: again, left out, a pause, the end."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from bench.config.procedure.plan import Plan, SetTemperature, Wait
from bench.run.events import Event, RunState, Wish
from bench.run.folder import Run
from bench.run.listening import Asker
from bench.run.person import NOBODY_KNOWN, OperatorWish, RunControl
from bench.run.record import resume_point
from bench.run.runner import RunAborted
from drivers.instruments.manual import ManualThermometer
from drivers.interfaces import Identity
from drivers.person import Answer, PromptKind
from sim.world.clock import VirtualClock
from tests.support.runner_bench import PLAN, READS, Bench, Person, changed, make_runner, new_record, recorded


class Said:
    """Wishes that are left at the n-th time the runner listens."""

    def __init__(self, wishes):
        self.wishes = dict(wishes)
        self.count = -1
        self.stopped = None

    def poll(self):
        self.count += 1
        return self.wishes.pop(self.count, None)


def listening(tmp_path, wishes, person=None, **options):
    """Run with wishes; return the history, the keys read, and the bench."""
    bench = Bench()
    record = new_record(tmp_path)
    runner = make_runner(bench, record, controls=Said(wishes), patience=VirtualClock(), **options)
    if person is not None:
        runner = changed(runner, person=person)
    try:
        runner.run()
    finally:
        record.close()
        history, keys, _ = recorded(tmp_path / "run")
    return history, keys, bench


def poll_at(key, kind="step_done"):
    """Which time the runner listens right after a step of the plan (naps listen, too)."""
    said = Said({})
    at = []
    runner = make_runner(
        Bench(), FakeRecord(lambda k, d: k == kind and d["key"] == key and at.append(said.count))
    )
    runner = changed(runner, controls=said)
    runner.run()
    return at[0] + 1


class FakeRecord:
    def __init__(self, see):
        self.see = see
        self.number = 0

    def append(self, kind, bench_s, **data):
        self.number += 1
        self.see(kind, data)
        return Event(self.number, "", bench_s, kind, data)


def test_redo_takes_the_last_point_again_and_its_last_reading_counts(tmp_path):
    history, keys, bench = listening(tmp_path, {poll_at("r12"): RunControl(Wish.REPEAT_POINT)})
    assert keys == ["r11", "r12", "r12", "r13", "r21", "r22", "r23"]
    attempts = [e.data["attempt"] for e in history.events if e.type == "step_done" and "reading" in e.data]
    assert attempts == [1, 1, 2, 1, 1, 1, 1]
    assert [w[1] for w in bench.done if w[0] == "move"][:4] == ["t11", "t12", "t12", "t13"]


def test_a_reading_whose_repetition_was_asked_for_does_not_count_if_the_run_ends_first(tmp_path):
    at = poll_at("r12")
    with pytest.raises(RunAborted):
        listening(tmp_path, {at: RunControl(Wish.REPEAT_POINT), at + 1: RunControl(Wish.ABORT)})
    history, keys, _ = recorded(tmp_path / "run")
    assert keys == ["r11", "r12"]
    run = Run(tmp_path / "run")
    vars(run)["plan"] = PLAN
    counted = run.readings()
    assert (len(counted), len(history.readings)) == (1, 1)
    assert counted.notes == (
        "the run is aborted: 1 of 6 planned readings were taken",
        "readings that do not count, because their repetition was asked for and not taken: 1",
    )


def test_redo_pass_goes_back_to_its_first_turn(tmp_path):
    _, keys, _ = listening(tmp_path, {poll_at("r22"): RunControl(Wish.REPEAT_PASS)})
    assert keys == ["r11", "r12", "r13", "r21", "r22", "r21", "r22", "r23"]


def test_redo_with_nothing_measured_since_the_mounting_is_refused(tmp_path):
    history, keys, _ = listening(tmp_path, {poll_at("m2"): RunControl(Wish.REPEAT_POINT)})
    assert keys == READS
    refused = [e for e in history.events if e.type == "wish_refused"]
    assert refused[0].data["why"] == "no point was measured since the block was mounted or switched"


def test_skip_leaves_the_point_out_with_its_reason(tmp_path):
    history, keys, bench = listening(tmp_path, {poll_at("r11"): RunControl(Wish.SKIP, "cable loose")})
    assert keys == ["r11", "r13", "r21", "r22", "r23"]
    assert ("move", "t12") not in bench.done
    skipped = [e.data for e in history.events if e.type == "skipped"]
    assert skipped[0]["reason"] == "cable loose"
    assert history.state == "finished"


def test_a_mounting_cannot_be_skipped_as_the_readings_after_it_rely_on_it(tmp_path):
    history, keys, _ = listening(tmp_path, {poll_at("r13"): RunControl(Wish.SKIP, "later")})
    assert keys == READS
    (refused,) = (e for e in history.events if e.type == "wish_refused")
    assert "must be mounted" in refused.data["why"]
    assert not [e for e in history.events if e.type == "skipped"]


def test_abort_ends_the_run_for_good_with_the_bench_closed(tmp_path):
    with pytest.raises(RunAborted):
        listening(tmp_path, {poll_at("r11"): RunControl(Wish.ABORT, "wrong block")})
    history, keys, _ = recorded(tmp_path / "run")
    assert keys == ["r11"]
    assert history.state is RunState.ABORTED
    assert resume_point(PLAN, history).step > 0


def test_a_pause_lasts_until_somebody_wishes_something_else(tmp_path):
    at = poll_at("r11")
    history, keys, _ = listening(tmp_path, {at: RunControl(Wish.PAUSE), at + 5: RunControl(Wish.CONTINUE)})
    assert keys == READS
    changes = [e.type for e in history.events if e.type.startswith("run_")]
    assert changes == ["run_started", "run_paused", "run_continued", "run_finished"]


def test_redo_out_of_a_pause(tmp_path):
    at = poll_at("r12")
    wishes = {at: RunControl(Wish.PAUSE), at + 3: RunControl(Wish.REPEAT_POINT)}
    history, keys, _ = listening(tmp_path, wishes)
    assert keys == ["r11", "r12", "r12", "r13", "r21", "r22", "r23"]
    assert history.state == "finished"


def test_a_pause_typed_at_the_head_is_asked_how_to_go_on(tmp_path):
    class Typist(Person):
        def ask(self, prompt):
            if prompt.id.startswith("m2") and "typed" not in self.__dict__:
                self.typed = True
                raise OperatorWish(RunControl(Wish.PAUSE, by_person=True))
            return super().ask(prompt)

    bench = Bench()
    history, keys, _ = listening(tmp_path, {}, person=Typist(bench))
    assert keys == READS
    assert [e.type for e in history.events if e.type.startswith("run_")][1:3] == [
        "run_paused",
        "run_continued",
    ]
    assert [w[1].partition("@")[0] for w in bench.done if w[0] == "ask" and "pause" in w[1]] == ["pause"]


class Chosen:
    """Points 1 and 3 of installation 1 are chosen; after them point 2 is taken up again."""

    def __init__(self):
        self.place = {step.key: number for number, step in enumerate(PLAN.steps)}

    def __call__(self, index, progress):
        told = {"visit": 0, "stop": ""}
        left = [[self.place["t12"], self.place["r12"]]]
        if index == self.place["m1"] and not progress.chosen:
            return {**told, "left_out": left, "next": {"first": index}}
        if index == self.place["r13"] + 1 and len(progress.chosen) == 1:
            return {**told, "left_out": [], "taken_up": left, "next": {"first": self.place["t12"]}}
        return None


@pytest.mark.parametrize(
    ("after", "wish", "read"),
    [
        ("r13", Wish.REPEAT_POINT, ["r11", "r13", "r12", "r13"]),
        ("t12", Wish.REPEAT_POINT, ["r11", "r13", "r12"]),
        ("r12", Wish.REPEAT_POINT, ["r11", "r13", "r12", "r12"]),
        ("r12", Wish.REPEAT_PASS, ["r11", "r13", "r12", "r11", "r12", "r13"]),
    ],
)
def test_where_points_are_chosen_redo_takes_what_was_measured_last_in_time(tmp_path, after, wish, read):
    heard = []

    class Once:
        stopped = None

        def poll(self):
            return RunControl(wish) if heard and heard.pop() else None

    def see(event):
        if event.type == "step_done" and event.data["key"] == after and event.data["attempt"] == 1:
            heard.append(True)

    record = new_record(tmp_path)
    chooses = {"controls": Once(), "patience": VirtualClock(), "choose": Chosen(), "observers": [see]}
    runner = make_runner(Bench(), record, **chooses)
    runner.run()
    record.close()
    history, keys, _ = recorded(tmp_path / "run")
    assert keys == [*read, "r21", "r22", "r23"]
    assert len(history.readings) == 6


@pytest.mark.parametrize("wish", [Wish.REPEAT_POINT, Wish.MOUNT_AGAIN, Wish.CONTINUE])
def test_a_wish_that_is_refused_does_not_begin_a_soak_again(tmp_path, wish):
    """A soak of hours began anew, although nothing was done."""
    history, keys, _ = listening(tmp_path, {poll_at("w", "step_started") + 3: RunControl(wish)})
    assert keys == READS
    told = [e.type for e in history.events if e.type == "wish_refused" or e.data.get("key") == "w"]
    assert told == ["step_started", "wish_refused", "step_done"]


def test_a_wish_refused_at_a_later_question_of_a_mounting_does_not_ask_to_mount_again(tmp_path):
    """The block was mounted, and its temperature asked: a refused ":redo" began with the clamping again."""
    asked, wished = [], []
    record = new_record(tmp_path)
    asker = Asker(tmp_path / "run", record, lambda kind, data: None, clock=VirtualClock())

    class Typist:
        meanwhile, who, by_hand, wishes = None, NOBODY_KNOWN, False, None

        def ask(self, prompt):
            asked.append(prompt.id.partition("#")[0])
            if prompt.kind is PromptKind.NUMBER and prompt.unit == "°C" and not wished:
                wished.append(prompt.id)
                raise OperatorWish(RunControl(Wish.REPEAT_POINT))
            return Answer(prompt.id, "yes" if prompt.kind is PromptKind.CONFIRM else "23")

    asker.terminal = Typist()
    runner = changed(make_runner(Bench(), record), person=asker, asker=asker)
    having = replace(
        runner.bench.instruments,
        thermometer=ManualThermometer("thermometer", asker, minimum_c=0, maximum_c=50, sensor=""),
    )
    runner = replace(runner, bench=replace(runner.bench, instruments=having))
    runner.run()
    record.close()
    history, keys, _ = recorded(tmp_path / "run")
    assert keys == READS
    assert [e.data["wish"] for e in history.events if e.type == "wish_refused"] == ["redo"]
    assert wished
    assert asked.count("m1") == 1


def test_a_pause_while_a_soak_is_repeated_does_not_begin_it_again(tmp_path):
    """Nothing moves during it; the pause was not even obeyed."""
    steps = [*PLAN.steps]
    at = [step.key for step in steps].index("t13")
    steps[at:at] = [SetTemperature("temperature", 40.0), Wait("soak", 60.0, "soak")]
    plan = Plan("test", tuple(steps), "")
    bench, record, left = Bench(), new_record(tmp_path), [Wish.MOUNT_AGAIN, Wish.PAUSE]

    class Controls(Said):
        def poll(self):
            soaks = [k for k in begun if k == "soak"]
            if (("move", "t13") in bench.done and len(left) == 2) or (len(soaks) == 2 and len(left) == 1):
                return RunControl(left.pop(0))
            return None

    begun = []

    def see(event):
        if event.type == "step_started":
            begun.append(event.data["key"])

    runner = make_runner(bench, record, plan, controls=Controls({}), observers=[see], patience=VirtualClock())
    chamber = SimpleNamespace(
        name="chamber",
        asks_person=False,
        open=lambda: Identity("Espec", "P300"),
        close=lambda: None,
        make_safe=lambda: "",
        set_temperature=lambda target_c, key: None,
        temperature=lambda key, settling=False: 40.0,
    )
    replace(
        runner, bench=replace(runner.bench, instruments=replace(runner.bench.instruments, chamber=chamber))
    ).run()
    record.close()
    history, _, _ = recorded(tmp_path / "run")
    assert begun.count("soak") == 2
    (refused,) = (e.data for e in history.events if e.type == "wish_refused")
    assert refused["wish"] == "pause"
    assert refused["why"] == "a wait before the next step is repeated; pause after it, or stop the run"
