"""The readings of a run say which mounting each is of, where this is not one mounting for each series."""

import json
from contextlib import closing, nullcontext
from dataclasses import replace

import pytest

from bench.config.procedure.load import load_procedure
from bench.config.procedure.plan import Mount, Plan, Power, Read, Turn
from bench.config.shipped import find_procedure
from bench.readings.columns import MOUNTING
from bench.readings.csv import format_csv, read_csv
from bench.run.events import Wish
from bench.run.folder import PLAN, Run
from bench.run.person import Controls, RunControl
from bench.run.record import Record, resume_point
from tests.support.runner_bench import NOON, STOP, Bench, Person, changed, make_runner


def read(installation, series, point=1):
    return Read(f"r{installation}/{series}/{point}", installation, series, 1, point, 0.0, 1, 1, 10.0, STOP)


TWICE_ON = Plan("twice on", (
    Mount("m1", "1", 1), read("1", 1), read("1", 1, 2), Power("p1", "cycle"), read("1", 2),
    Mount("m2", "2", 1), read("2", 1), Power("p2", "cycle"), read("2", 2), Mount("mV", "V", 1), read("V", 1),
), "")  # fmt: skip
EACH_MOUNTED = Plan("each mounted", (
    Mount("m1", "1", 1), read("1", 1), Mount("m2", "2", 1), read("2", 1), Mount("m3", "1", 2), read("1", 2),
), "")  # fmt: skip


@pytest.fixture
def carried_out(tmp_path):
    """Record the readings of a plan; return the run. `remounted` maps a step to the event before it."""

    def go(plan, remounted=None):
        inputs = {PLAN: json.dumps(plan.to_json()).encode()}
        record = Record.create(tmp_path / "run", {"name": "run"}, inputs, lambda: NOON)
        record.append("run_started", 0.0, step=0, instruments={})
        series = {}
        for index, step in enumerate(plan.steps):
            if index in (remounted or {}):
                event = {"installation": step.installation, "series": step.series} | remounted[index]
                series[event["series"], step.installation] = event["now_series"]
                record.append("remounted", float(index), **event)
            if isinstance(step, Read):
                now = series.get((step.series, step.installation), step.series)
                place = {"installation": step.installation, "series": now, "pass": 1, "point": step.point}
                reading = place | {"angle_deg": 0.0, "mean": [0.0, 0.0, 1.0]}
                record.append("step_done", float(index), step=index, key=step.key, reading=reading)
        record.close()
        return Run(tmp_path / "run")

    return go


def mountings(run):
    table = run.readings()
    return table.extra[MOUNTING].tolist() if MOUNTING in table.extra else None


def test_a_block_switched_on_again_is_still_mounted(carried_out, tmp_path):
    run = carried_out(TWICE_ON)
    assert mountings(run) == ["1", "1", "1", "2", "2", "3"]
    (tmp_path / "r.csv").write_text(format_csv(run.readings()), encoding="utf-8", newline="")
    table = read_csv(tmp_path / "r.csv", ["1", "2"])
    assert table.extra[MOUNTING].tolist() == mountings(run)
    assert table.conditions().clamped.tolist() == [0, 0, 2, 2, 4]


def test_a_run_whose_series_are_its_mountings_has_no_such_column(carried_out):
    assert mountings(carried_out(EACH_MOUNTED)) is None


@pytest.mark.parametrize(
    ("cause", "expected"),
    [({"why": "power"}, ["1", "1", "1", "2", "2", "3"]), ({}, ["1", "2", "2", "3", "3", "4"])],
)
def test_an_unplanned_remount_is_a_mounting_and_a_loss_of_power_is_none(carried_out, cause, expected):
    """Before the second reading of series 1, whose later readings are series 3 then."""
    run = carried_out(TWICE_ON, {2: {"now_series": 3} | cause})
    assert run.readings().series.tolist() == [1, 3, 2, 1, 2, 1]
    assert mountings(run) == expected


def test_a_loss_of_power_alone_makes_two_series_of_one_mounting(carried_out):
    plan = replace(EACH_MOUNTED, steps=(*EACH_MOUNTED.steps, read("1", 2, 2)))
    assert mountings(carried_out(plan, {6: {"now_series": 3, "why": "power"}})) == ["1", "2", "3", "3"]


def two_passes_switched_on_again():
    """Return a plan of one mounting: a pass in series 1, the block off and on again, two passes in series 2."""

    def of(series, number):
        where = ("1", series, number, 1, 0.5, 1)
        key = f"{series}.{number}"
        return Turn(f"t{key}", *where, STOP), Read(f"r{key}", *where, 1, 10.0, STOP)

    return Plan("test", (Mount("m", "1", 1), *of(1, 1), *of(2, 1), *of(2, 2)), "")


def test_two_mountings_that_an_earlier_version_recorded_as_one_series_are_two(carried_out):
    """It noted a remounting under the series of the mounting (1), while the block was in series 2."""
    plan = replace(TWICE_ON, steps=(*TWICE_ON.steps[:5], read("1", 2, 2), *TWICE_ON.steps[5:]))
    run = carried_out(plan, {5: {"series": 1, "now_series": 3}})
    assert [*run.history.readings.values()][3].series == 2
    assert run.readings().series.tolist() == [1, 1, 2, 3, 1, 2, 1]
    assert mountings(run) == ["1", "1", "1", "2", "3", "3", "4"]


class InLastPass(Controls):
    """At the last pass, once: the wish to mount the block again, or Ctrl-C."""

    def __init__(self, bench, what):
        self.bench, self.what = bench, [what]

    def poll(self):
        if ("move", "t2.2") not in self.bench.done or not self.what:
            return None
        if isinstance(what := self.what.pop(), BaseException):
            raise what
        return what


class Remounting(Person):
    """A person who mounted the block again while the run was stopped."""

    def ask(self, prompt):
        answer = super().ask(prompt)
        return replace(answer, text="mounted again") if "mounted again" in prompt.choices else answer


@pytest.mark.parametrize("resumed", [False, True])
def test_readings_after_a_remounting_are_a_series_of_their_own_also_in_a_later_series(tmp_path, resumed):
    """The stand angles are constant within a series: two mountings in one would be calibrated as one."""
    plan, bench = two_passes_switched_on_again(), Bench()
    inputs = {PLAN: json.dumps(plan.to_json()).encode()}
    what = KeyboardInterrupt() if resumed else RunControl(Wish.MOUNT_AGAIN)
    with closing(Record.create(tmp_path / "run", {"name": "run"}, inputs, lambda: NOON)) as record:
        runner = make_runner(bench, record, plan, controls=InLastPass(bench, what))
        with pytest.raises(KeyboardInterrupt) if resumed else nullcontext():
            runner.run()
    if resumed:
        record, history = Record.reopen(tmp_path / "run", lambda: NOON)
        with closing(record):
            runner = make_runner(bench, record, plan, progress=history.progress.copy())
            changed(runner, person=Remounting(bench)).run(resume_point(plan, history))
    run = Run(tmp_path / "run")
    assert run.readings().series.tolist() == [1, 2, 3]
    assert mountings(run) == ["1", "1", "2"]
    assert run.readings().conditions().clamped.tolist() == [0, 0, 2]


@pytest.mark.parametrize(("name", "series"), [("turn-on", 4), ("temperature", 9), ("calibration", 1)])
def test_shipped_procedures_mount_the_block_once_in_an_installation(name, series):
    plan = load_procedure(find_procedure(name)).expand()
    found = {}
    for step, mounting in zip(plan.steps, plan.mountings, strict=True):
        if isinstance(step, Read) and step.installation in ("1", "2"):
            found.setdefault((step.installation, mounting), set()).add(step.series)
    assert [(label, len(of)) for (label, _), of in found.items()] == [("1", series), ("2", series)]
