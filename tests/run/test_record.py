"""The record of a run: whole, chained, believed only when nothing in it was changed."""

import errno
import hashlib
import json
import math
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from bench.config.procedure.plan import Plan, Wait
from bench.run.events import EVENTS, MANIFEST, RecordError
from bench.run.folder import Run
from bench.run.record import Record, read_history, resume_point

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def make(folder, events=3):
    record = Record.create(folder, {"name": folder.name}, {"plan.json": b"{}"}, lambda: NOON)
    record.append("run_started", 0.0, step=0, instruments={})
    for index in range(events):
        record.append("step_done", float(index), step=index)
    record.close()
    return folder


def test_events_come_back_as_written(tmp_path):
    history = read_history(make(tmp_path / "run"))
    assert [e.type for e in history.events] == ["run_started", "step_done", "step_done", "step_done"]
    assert [e.data.get("step") for e in [*history.events][1:]] == [0, 1, 2]
    assert history.problems == ()
    assert history.state == "running"


def test_a_new_run_is_on_the_disk_with_the_names_of_its_files(tmp_path, monkeypatch):
    """A power cut in the first hour would else leave a folder without its record, or no folder."""
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_ino))
    folder = make(tmp_path / "run")
    assert {place.stat().st_ino for place in (tmp_path, folder, *folder.iterdir())} <= {*synced}


@pytest.mark.parametrize("line", [0, 1, 3])
def test_a_changed_line_is_found(tmp_path, line):
    path = make(tmp_path / "run") / EVENTS
    lines = path.read_text().splitlines(keepends=True)
    lines[line] = lines[line].replace('"bench_s": ', '"bench_s": 1')
    path.write_text("".join(lines))
    problems = read_history(tmp_path / "run").problems
    # the last line has no successor: its change cannot be seen in the chain
    assert bool(problems) == (line < 3)


def test_a_removed_line_is_found(tmp_path):
    path = make(tmp_path / "run") / EVENTS
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:1] + lines[2:]))
    assert "line 2: the chain is broken" in read_history(tmp_path / "run").problems[0]


def test_a_changed_input_is_found(tmp_path):
    folder = make(tmp_path / "run")
    (folder / "plan.json").write_text('{"other": 1}')
    assert read_history(folder).problems == ("plan.json was changed since the run began",)
    with pytest.raises(RecordError, match="cannot be trusted"):
        Record.reopen(folder, lambda: NOON)


def test_a_plan_of_another_version_of_the_program_is_intact_and_needs_no_copy(tmp_path):
    folder, plan = tmp_path / "run", b'{"name": "p", "steps": [{"step": "humidity"}]}'
    versions = {"triaxial-bench": "9.9"}
    Record.create(folder, {"name": "run", "versions": versions}, {"plan.json": plan}, lambda: NOON).close()
    with pytest.raises(
        RecordError,
        match=r"'humidity' is not a known .*\); the file is intact: use the program .* version 9\.9$",
    ):
        _ = Run(folder).plan
    (folder / "plan.json").write_bytes(plan[:-1])
    with pytest.raises(RecordError, match=r"restore it from a copy$"):
        _ = Run(folder).plan


def test_a_changed_manifest_breaks_the_chain(tmp_path):
    folder = make(tmp_path / "run")
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["name"] = "another"
    (folder / MANIFEST).write_text(json.dumps(manifest))
    assert "line 1: the chain is broken" in read_history(folder).problems[0]


def test_a_torn_last_line_is_cut_off_when_the_run_goes_on(tmp_path):
    folder = make(tmp_path / "run")
    with (folder / EVENTS).open("ab") as file:
        file.write(b'{"n": 5, "time": "2026')
    record, history = Record.reopen(folder, lambda: NOON)
    record.append("run_resumed", 9.0, step=2, instruments={})
    record.close()
    assert history.torn.startswith('{"n": 5')
    again = read_history(folder)
    assert again.problems == ()
    assert [e.number for e in again.events] == [1, 2, 3, 4, 5]
    assert again.events.last.type == "run_resumed"


def test_a_second_writer_is_refused(tmp_path):
    folder = make(tmp_path / "run")
    record, _ = Record.reopen(folder, lambda: NOON)
    with pytest.raises(RecordError, match="another program"):
        Record.reopen(folder, lambda: NOON)
    record.close()
    Record.reopen(folder, lambda: NOON)[0].close()


def test_a_name_is_not_used_twice(tmp_path):
    make(tmp_path / "run")
    with pytest.raises(RecordError, match="choose another with --name"):
        make(tmp_path / "run")


@pytest.mark.parametrize("as_run", [True, False], ids=["run", "folder"])
def test_a_folder_that_another_program_made_meanwhile_is_told_as_one(tmp_path, monkeypatch, as_run):
    def made_meanwhile(part, target):
        monkeypatch.undo()
        if as_run:
            make(target)
        else:
            (target / "own").mkdir(parents=True)
        return part.rename(target)

    monkeypatch.setattr(Path, "rename", made_meanwhile)
    kind = "run" if as_run else "file or folder"
    with pytest.raises(RecordError, match=f"a {kind} of that name exists; choose another with --name"):
        make(tmp_path / "run")
    assert [found.name for found in tmp_path.iterdir()] == ["run"]


def test_an_event_that_cannot_follow_is_not_written(tmp_path):
    record = Record.create(tmp_path / "run", {"name": "run"}, {}, lambda: NOON)
    record.append("run_aborted", 0.0)
    with pytest.raises(ValueError, match="run_failed cannot follow on aborted"):
        record.append("run_failed", 0.0)
    record.append("left_safe", 0.0, to_do={})
    record.close()
    history = read_history(tmp_path / "run")
    assert (history.problems, len(history.events)) == ((), 2)


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "free disk space"),
        (errno.EFBIG, "raise the limit of a file's size"),
        (errno.EROFS, "make the folder writable"),
    ],
)
def test_a_disk_that_takes_nothing_more_loses_nothing_and_says_so(tmp_path, monkeypatch, number, remedy):
    folder = tmp_path / "run"
    record = Record.create(folder, {}, {}, lambda: NOON)
    record.append("run_started", 0.0, step=0, instruments={})

    def full(descriptor):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RecordError, match=rf"{os.strerror(number)}.*; {remedy}, then continue$"):
        record.append("step_done", 1.0, step=0)
    monkeypatch.undo()
    record.append("step_done", 1.0, step=0)
    record.close()
    history = read_history(folder)
    assert history.problems == ()
    assert [e.type for e in history.events] == ["run_started", "step_done"]


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordError, match=r"cannot be written .*; choose another folder with --runs$"):
        Record.create(tmp_path / "file" / "run", {}, {}, lambda: NOON)
    with pytest.raises(RecordError, match="not a run"):
        read_history(tmp_path)


def test_what_a_deleted_folder_would_lose_is_told(tmp_path):
    record = Record.create(tmp_path / "run", {}, {}, lambda: NOON)
    shutil.rmtree(tmp_path / "run")
    with pytest.raises(RecordError, match="was deleted during the run"):
        record.append("run_started", 0.0, step=0, instruments={})
    record.close()


def forged(folder, **event):
    """A record of one event, in which the chain is whole and the event is any."""
    line = {"n": 1, "time": "t", "bench_s": 0.0, "type": "run_paused", "reason": ""} | event
    Record.create(folder, {}, {}, lambda: NOON).close()
    line["prev"] = hashlib.sha256((folder / MANIFEST).read_bytes()).hexdigest()
    (folder / EVENTS).write_text(json.dumps(line) + "\n")
    return read_history(folder)


READING = {"installation": "1", "series": 1, "pass": 1, "point": 1, "angle_deg": 0.0, "mean": [0.0, 0.0, 1.0]}


@pytest.mark.parametrize(
    "event",
    [
        {"n": math.inf},
        {"n": math.nan},
        {"n": 1.0},
        {"n": True},
        {"bench_s": math.inf},
        {"bench_s": None},
        {"time": 5},
        {"type": ["run_paused"]},
        {"type": "step_done"},
        {"type": "step_done", "step": -1},
        {"type": "step_started", "step": 10**300},
        {"type": "redo", "first": 0, "last": 10**12},
        {"type": "run_started", "step": 0, "instruments": None},
        {"type": "left_safe", "to_do": []},
        {"type": "step_done", "step": 0, "reading": []},
        {"type": "step_done", "step": 0, "reading": READING | {"mean": [1.0, 2.0]}},
        {"type": "step_done", "step": 0, "reading": READING | {"mean": ["1", "2", "3"]}},
        {"type": "step_done", "step": 0, "reading": READING | {"mean": [1.0, 2.0, None]}},
        {"type": "step_done", "step": 0, "reading": READING | {"series": 1.5}},
        {"type": "step_done", "step": 0, "reading": READING | {"angle_deg": 1e400}},
        {"type": "step_done", "step": 0, "reading": READING | {"outlier": [1, 2, 3]}},
        {"type": "run_finished"},
    ],
)
def test_what_is_no_event_is_told_with_its_line(tmp_path, event):
    assert forged(tmp_path / "run", type="run_started", step=0, instruments={}).problems == ()
    (problem,) = forged(tmp_path / "other", **event).problems
    assert problem.startswith("events.jsonl, line 1: not an event")


@pytest.mark.parametrize(
    "line", [b'{"n": Infinity}\n', b'{"n": 1e999, "prev": ""}\n', b"[" * 100_000 + b"\n", b"\xff\n", b"7\n"]
)
def test_a_line_that_is_no_event_of_json_is_told(tmp_path, line):
    folder = make(tmp_path / "run", events=0)
    with (folder / EVENTS).open("ab") as file:
        file.write(line)
    assert read_history(folder).problems == ("events.jsonl, line 2: not an event",)


def test_events_of_another_plan_are_told(tmp_path):
    folder = make(tmp_path / "run")
    with pytest.raises(RecordError, match="step 3, and the plan has 2"):
        resume_point(Plan("p", (Wait("a", 1.0, ""), Wait("b", 1.0, "")), ""), read_history(folder))


def test_a_history_keeps_what_going_on_needs_and_no_sample(tmp_path):
    record = Record.create(tmp_path / "run", {}, {}, lambda: NOON)
    record.append("run_started", 0.0, step=0, instruments={"head": "none"})
    record.append("step_done", 1.0, step=0, reading=READING | {"samples": {"x": [1.0] * 1000}})
    record.append("remounted", 2.0, installation="1", series=1, now_series=2)
    record.append("step_done", 3.0, step=0, reading=READING | {"point": 2, "temperature_c": 21.5})
    record.close()
    history = read_history(tmp_path / "run")
    steps = [taken and (taken[0], taken[1].point) for taken in history.taken]
    assert steps == [(0, 1), None, (0, 2)]
    assert history.readings[0].point == 2
    assert not any(taken and taken[1].samples for taken in history.taken)
    assert history.progress.temperature_c == 21.5
    assert history.identities == {"head": "none"}
    assert history.events.last.number == len(history.events) == 4
    assert [*history.events][1].data["reading"]["samples"]["x"] == [1.0] * 1000
    lines = (tmp_path / "run" / EVENTS).read_bytes()
    assert history.head == hashlib.sha256(lines.splitlines()[-1]).hexdigest()
    assert history.length == len(lines)


@pytest.mark.parametrize(("again", "left"), [((), 1), ((1,), 1), ((0,), 0), ((0, 1), 0)])
def test_a_sign_stands_until_the_reading_at_fault_was_taken_again(tmp_path, again, left):
    """The second reading shows that the first is wrong: taking the second one again mends nothing."""
    record = Record.create(tmp_path / "run", {}, {}, lambda: NOON)
    record.append("run_started", 0.0, step=0, instruments={})

    def read(step):
        record.append("step_done", 1.0, step=step, reading=READING | {"point": step + 1})

    read(0)
    read(1)
    sure = {"confident": True, "wrong": [1, "1", 1, 1]}
    record.append("early_sign", 2.0, step=1, sentence="x", causes=["slip"], **sure)
    record.append("early_sign", 2.0, step=1, sentence="noisy", causes=["noise"], confident=False, wrong=None)
    record.append("went_on", 3.0, step=1, causes=["slip"], reason="late")
    record.append("redo", 4.0, first=0, last=1)
    for step in again:
        read(step)
    record.close()
    signs, overruled = read_history(tmp_path / "run").not_repaired()
    assert [sign.data["sentence"] for sign in signs] == ["x"] * left + ["noisy"] * (1 not in again)
    assert len(overruled) == left
