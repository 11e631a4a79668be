"""The record of a run: whole, chained, believed only when nothing in it was changed."""

import errno
import json
import os
from datetime import UTC, datetime

import pytest

from bench.run.record import EVENTS, MANIFEST, Record, RecordError, read_history

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def make(folder, events=3):
    record = Record.create(folder, {"name": folder.name}, {"plan.json": b"{}"}, lambda: NOON)
    record.append("run_started", 0.0)
    for index in range(events):
        record.append("step_done", float(index), step=index)
    record.close()
    return folder


def test_events_come_back_as_written(tmp_path):
    history = read_history(make(tmp_path / "run"))
    assert [e.type for e in history.events] == ["run_started", "step_done", "step_done", "step_done"]
    assert [e.data.get("step") for e in history.events[1:]] == [0, 1, 2]
    assert history.problems == ()
    assert history.state == "running"


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
    record.append("run_resumed", 9.0)
    record.close()
    assert history.torn.startswith('{"n": 5')
    again = read_history(folder)
    assert again.problems == ()
    assert [e.number for e in again.events] == [1, 2, 3, 4, 5]
    assert again.events[-1].type == "run_resumed"


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


def test_a_full_disk_loses_nothing_and_says_so(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    record = Record.create(folder, {}, {}, lambda: NOON)
    record.append("run_started", 0.0)

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RecordError, match="No space left"):
        record.append("step_done", 1.0, step=0)
    monkeypatch.undo()
    record.append("step_done", 1.0, step=0)
    record.close()
    history = read_history(folder)
    assert history.problems == ()
    assert [e.type for e in history.events] == ["run_started", "step_done"]


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordError, match="cannot be written"):
        Record.create(tmp_path / "file" / "run", {}, {}, lambda: NOON)
    with pytest.raises(RecordError, match="not a run"):
        read_history(tmp_path)
