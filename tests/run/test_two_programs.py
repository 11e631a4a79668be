"""Two programs at one record: real processes, which meet at barriers of lines over pipes."""

import os
import subprocess
import sys
from datetime import UTC, datetime

import pytest

from bench.run.events import EVENTS, RecordError
from bench.run.record import Record, is_being_written, read_history

pytest.importorskip("fcntl")
pytestmark = pytest.mark.slow

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)

REOPENS = """
import sys
from datetime import UTC, datetime
from pathlib import Path
from bench.run import record

lock = record._lock

def at_the_lock(descriptor):
    print("at the lock", flush=True)
    sys.stdin.readline()
    return lock(descriptor)

record._lock = at_the_lock
for line in iter(sys.stdin.readline, ""):
    try:
        reopened, history = record.Record.reopen(Path(line.strip()), lambda: datetime(2026, 1, 1, 12, tzinfo=UTC))
    except record.RecordError as error:
        print(error, flush=True)
    else:
        reopened.append("run_aborted", 9.0)
        reopened.close()
        print(len(history.events), repr(history.torn), flush=True)
"""


@pytest.fixture
def record(tmp_path):
    record = Record.create(tmp_path / "run", {"name": "run"}, {}, lambda: NOON)
    record.append("run_started", 0.0, step=0, instruments={})
    yield record
    record.close()


@pytest.fixture(scope="module")
def program():
    """Another program, which reopens the records that it is told of."""
    process = subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-c", REOPENS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    yield process
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()


def told(process, line):
    process.stdin.write(f"{line}\n")
    process.stdin.flush()
    return process.stdout.readline().strip()


@pytest.fixture
def other(record, program):
    """The other program, about to lock the record; it goes on at `go`."""
    assert told(program, record.folder) == "at the lock"
    return program


def go(process):
    return told(process, "go")


def test_what_was_written_until_the_lock_is_part_of_what_is_gone_on_with(record, other):
    record.append("step_done", 1.0, step=0)
    record.close()
    assert go(other) == "2 ''"
    history = read_history(record.folder)
    assert history.problems == ()
    assert [event.type for event in history.events] == ["run_started", "step_done", "run_aborted"]


def test_a_line_that_another_is_writing_is_not_cut_off(record, other, monkeypatch):
    """The other program comes to the lock while half a line stands in the file, and is refused."""
    told = []

    def in_two(self, data):
        self._file.write(data[:20])
        told.append(go(other))
        self._file.write(data[20:])

    monkeypatch.setattr(Record, "_write", in_two)
    record.append("step_done", 1.0, step=0)
    assert "another program is writing this run" in told[0]
    assert read_history(record.folder).problems == ()
    assert len(read_history(record.folder).events) == 2


def test_a_torn_line_of_a_program_that_died_is_cut_off_under_the_lock(record, other):
    record.close()
    with (record.folder / EVENTS).open("ab") as file:
        file.write(b'{"n": 2, ')
    assert go(other) == "1 '{\"n\": 2, '"
    assert read_history(record.folder).problems == ()


def test_to_look_whether_a_run_is_being_written_opens_nothing_for_writing(record, monkeypatch):
    events, modes = record.folder / EVENTS, []

    opened = os.open

    def noted(path, flags, *options):
        modes.append(flags & os.O_ACCMODE)
        return opened(path, flags, *options)

    monkeypatch.setattr(os, "open", noted)
    assert is_being_written(record.folder)
    record.close()
    assert not is_being_written(record.folder)
    assert modes == [os.O_RDONLY, os.O_RDONLY]
    events.unlink()
    assert not is_being_written(record.folder)
    assert not events.exists()


def test_who_only_looks_does_not_keep_a_writer_out(record, monkeypatch):
    """The file is held by somebody who looks, and let go while the writer tries."""
    import fcntl

    record.close()
    with (record.folder / EVENTS).open("rb") as looking:
        fcntl.flock(looking.fileno(), fcntl.LOCK_SH)
        flock, tries = fcntl.flock, []

        def counted(descriptor, how):
            tries.append(how)
            if len(tries) == 7:
                looking.close()
            flock(descriptor, how)

        monkeypatch.setattr(fcntl, "flock", counted)
        reopened, _ = Record.reopen(record.folder, lambda: NOON)
        reopened.close()
    assert len(tries) >= 7


def test_a_record_that_somebody_else_wrote_into_is_written_no_further(record):
    with (record.folder / EVENTS).open("ab") as file:
        file.write(b"what no lock kept out\n")
    with pytest.raises(RecordError, match="another program wrote into"):
        record.append("run_finished", 1.0)
