"""The wire log: what a line holds, a disk that is full, several threads, and a whole dry run."""

from __future__ import annotations

import re
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from bench.cli.app import main
from drivers.wire.replay import WireLog, escaped, logged_wire

FULL = Path("/dev/full")
LINE = re.compile(
    r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}\+00:00 voltmeter\.[xyz] [<>] [^\x00-\x1f\x7f]+", re.ASCII
)


class Now:
    """A clock that goes on by half a second each time it is asked."""

    def __init__(self) -> None:
        self.time = datetime(2026, 11, 21, 9, 15, 41, 500000, tzinfo=UTC)

    def __call__(self) -> datetime:
        self.time += timedelta(seconds=0.5)
        return self.time


def test_a_line_is_time_instrument_direction_text(tmp_path: Path) -> None:
    file = tmp_path / "wire.log"
    log = WireLog(file, Now())
    log("voltmeter.x", ">", "*IDN?")
    log("voltmeter.x", "<", "HEWLETT-PACKARD,34401A,0,11-5-2")
    assert file.read_text() == (  # before it is closed: each line is written at once
        "2026-11-21T09:15:42.000000+00:00 voltmeter.x > *IDN?\n"
        "2026-11-21T09:15:42.500000+00:00 voltmeter.x < HEWLETT-PACKARD,34401A,0,11-5-2\n"
    )
    log.close()
    log.close()
    log("voltmeter.x", ">", "after the end")
    assert len(file.read_text().splitlines()) == 2


def test_control_characters_do_not_break_a_line(tmp_path: Path) -> None:
    assert escaped("a\r\nb\x03\x1b[31m\u2028é µ") == "a\\r\\nb\\x03\\x1b[31m\\u2028é µ"
    log = WireLog(tmp_path / "wire.log", Now())
    log("head", "<", "@01 0\n2026 forged > line\x7f")
    log.close()
    (line,) = (tmp_path / "wire.log").read_text(encoding="utf-8").splitlines()
    assert line.endswith("head < @01 0\\n2026 forged > line\\x7f")


def test_a_log_that_is_there_is_added_to(tmp_path: Path) -> None:
    for text in ("first", "second"):
        with logged_wire(tmp_path / "wire.log") as log:
            assert log is not None
            log("head", ">", text)
    assert [line.split()[-1] for line in (tmp_path / "wire.log").read_text().splitlines()] == [
        "first",
        "second",
    ]
    with logged_wire(None) as none:
        assert none is None


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_a_full_disk_ends_the_log_with_one_note_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    log = WireLog(FULL, Now())
    for _ in range(3):
        log("voltmeter.x", ">", "*IDN?")
    log.close()
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "note: the wire log /dev/full ends here (No space left on device); the run goes on\n"


def test_lines_of_several_threads_stay_whole(tmp_path: Path) -> None:
    log = WireLog(tmp_path / "wire.log")
    threads = [
        threading.Thread(target=lambda c=c: [log(f"voltmeter.{c}", ">", c * 200) for _ in range(50)])
        for c in "xyz"
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    lines = (tmp_path / "wire.log").read_text().splitlines()
    assert len(lines) == 150
    assert all(LINE.fullmatch(line) for line in lines)


def command(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(str(ended.value.code))


@pytest.mark.slow
def test_a_dry_run_logs_every_exchange_of_every_meter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.yaml").write_text(
        "procedure: short\nreading: {samples: 2, nplc: 1, settle: 0 s}\nsteps:\n"
        "  - installation: {label: 1, steps: [turn: {angles: [0 deg, 90 deg]}]}\n"
    )
    run = ("run", "short.yaml", "--dry-run", "--name", "one", "--bench", "paper-stand")
    assert command(*run, "--wire-log", "wire.log") == 0
    lines = (tmp_path / "wire.log").read_text(encoding="utf-8").splitlines()
    assert all(LINE.fullmatch(line) for line in lines)
    for channel in "xyz":
        own = [line.split(" ", 2)[2] for line in lines if f" voltmeter.{channel} " in line]
        assert own[:2] == ["> *IDN?", "< HEWLETT-PACKARD,34401A,0,11-5-2"]
        assert own.count("> FETC?") == 2
        after = [own[index + 1] for index, text in enumerate(own) if text == "> FETC?"]
        assert all(re.fullmatch(r"< [+-]\d\.\d{8}E[+-]\d\d,[+-]\d\.\d{8}E[+-]\d\d", text) for text in after)
    assert not list((tmp_path / "runs" / "one").glob("*wire*"))


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_a_run_outlives_its_log_and_a_log_that_cannot_be_is_said_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.yaml").write_text(
        "procedure: short\nreading: {samples: 1, nplc: 1, settle: 0 s}\nsteps:\n"
        "  - installation: {label: 1, steps: [turn: {angles: [0 deg]}]}\n"
    )
    run = ("run", "short.yaml", "--dry-run", "--bench", "paper-stand")
    assert command(*run, "--name", "full", "--wire-log", FULL) == 0
    assert capsys.readouterr().err.count("note: the wire log") == 1
    assert command(*run, "--name", "nowhere", "--wire-log", "no-folder/wire.log") == 2
    err = capsys.readouterr().err
    assert "no-folder/wire.log: No such file or directory" in err
    assert "Traceback" not in err
    assert not (tmp_path / "runs" / "nowhere").exists()
