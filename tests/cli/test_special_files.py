"""What is no file in the place of one: a pipe to which nobody writes hangs no command, whatever it stands for."""

import os
import shutil
import signal
from pathlib import Path

import pytest

from bench.cli.app import main
from bench.run.person import ANSWERS, CONTROL
from bench.services.bench_selection import SUFFIX

RECORD = Path(__file__).parents[1] / "data" / "records"
COMMANDS = {
    "show": ["show", "run", "--verify"],
    "runs": ["runs"],
    "export": ["export", "run", "--csv", "out.csv"],
    "abort": ["abort", "run"],
    "resume": ["resume", "run"],
    "seal": ["seal", "run"],
    "calibrate": ["calibrate", "run"],
    "catalogue": ["catalogue", "sync", "runs"],
}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Work in an empty folder; what hangs is interrupted."""

    def hung(number, frame):
        raise AssertionError("it hangs")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = signal.signal(signal.SIGALRM, hung)
    signal.alarm(60)
    yield tmp_path
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def refused(capsys, *command):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, command)])
    err = capsys.readouterr().err
    assert "Traceback" not in err
    assert "error of the program" not in err
    return ended.value.code, err


BESIDE = (ANSWERS, CONTROL, "seal.json", "calibrate.json", "verify.json")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["events.jsonl", "run.json", "plan.json", "bench.yaml", *BESIDE])
def test_a_pipe_in_the_place_of_a_part_of_a_record_or_of_what_is_written_beside_it(place, capsys, name):
    for told, command in COMMANDS.items():
        if name in BESIDE and told not in {"show", "runs", "seal"}:
            continue
        shutil.rmtree(place / "runs", ignore_errors=True)
        shutil.copytree(RECORD / "interrupted", place / "runs" / "run")
        (place / "runs" / "run" / name).unlink(missing_ok=name in BESIDE)
        os.mkfifo(place / "runs" / "run" / name)
        status, err = refused(capsys, *command)
        assert status in {0, 2} or told == "show", (command, err)
        assert status in {0, 1} or err.count("\n") == 1, (command, err)


@pytest.mark.parametrize(
    "command",
    [
        ["calibrate", "pipe"],
        ["import", "pipe", "--name", "x"],
        ["check", "pipe"],
        ["check", "paper", "--bench", "pipe"],
        ["calibrate", "r.csv", "--model", "pipe"],
        ["calibrate", "r.csv", "--effects", "pipe"],
        ["calibrate", "r.csv", "--prior", "pipe"],
        ["verify", "r.csv", "--coefficients", "pipe"],
        ["coefficients", "pipe"],
        ["compare", "pipe", "pipe"],
        ["stability", "pipe"],
        ["tumble", "pipe"],
        ["certificate", "verify", "pipe"],
        ["certificate", "read", "pipe"],
        ["certificate", "register", "--register", "pipe"],
        ["catalogue", "units", "--catalogue", "pipe"],
        ["fleet", "prior", "pipe"],
        ["batch", "run", "pipe"],
        ["batch", "show", "pipe"],
        ["seal", "pipe"],
        ["show", "pipe"],
        ["learn", "pipe"],
        ["diagnose", "pipe"],
        ["accept", "pipe", "--name", "x", "--sentence", "y"],
        ["budget", "--bench", "pipe"],
        ["panel", "--runs", "pipe"],
        ["validate", "--against", "pipe"],
    ],
    ids=" ".join,
)
def test_a_pipe_in_the_place_of_an_input(place, capsys, command):
    shutil.copy(RECORD / "readings.csv", place / "r.csv")
    os.mkfifo(place / "pipe")
    assert refused(capsys, *command)[0] == 2


def test_a_pipe_beside_a_readings_file(place, capsys):
    shutil.copy(RECORD / "readings.csv", place / "r.csv")
    os.mkfifo(place / f"r.csv{SUFFIX}")
    refused(capsys, "calibrate", "r.csv")
