"""A run's folder that is not what it was: renamed or deleted in mid-run, or not to be written to at the end."""

import errno
import os
import shutil
from pathlib import Path

import pytest

from bench.run.folder import Run
from bench.run.record import Record

RECORDS = Path(__file__).parents[1] / "data" / "records"


@pytest.fixture
def in_mid_run(monkeypatch):
    """Do something to the folder when the tenth event is written."""

    def later(what):
        append = Record.append

        def and_then(self, *given, **data):
            event = append(self, *given, **data)
            if event.number == 10:
                what(self.folder)
            return event

        monkeypatch.setattr(Record, "append", and_then)

    return later


def run_on(bench):
    return bench("run", "quick", "--dry-run", "--name", "one")


@pytest.mark.slow
def test_a_folder_renamed_in_mid_run_keeps_the_whole_record_and_is_named(bench, in_mid_run):
    in_mid_run(lambda folder: folder.rename(folder.with_name("two")))
    status, _, err = run_on(bench)
    assert status == 2
    assert "the run is finished, but its folder was moved" in err
    assert "'bench resume runs/two' computes its results there" in err
    assert Run(Path("runs/two")).history.state == "finished"
    assert bench("resume", "runs/two")[0] == 0
    assert not Run(Path("runs/two")).results_missing


@pytest.mark.slow
def test_a_folder_moved_elsewhere_is_told(bench, in_mid_run):
    in_mid_run(lambda folder: folder.rename("elsewhere"))
    assert "it is no longer beside the other runs" in run_on(bench)[2]
    assert Run(Path("elsewhere")).history.state == "finished"


@pytest.mark.slow
def test_a_folder_deleted_in_mid_run_stops_the_run(bench, in_mid_run):
    in_mid_run(shutil.rmtree)
    status, _, err = run_on(bench)
    assert status == 2
    assert "was deleted during the run, and its readings are lost; run it again" in err
    assert "resume" not in err


def refused(path, *given, **options):
    raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))


def test_results_that_cannot_be_written_leave_the_run_resumable_and_say_what_to_do(bench, monkeypatch):
    """A folder that is not writable is not cured by disk space, which was the remedy."""
    shutil.copytree(RECORDS / "finished", "runs/one")
    with monkeypatch.context() as read_only:
        read_only.setattr("bench.base.files.write_synced", refused)
        assert bench("resume", "one")[2] == (
            "bench: runs/one: cannot be written (Read-only file system); what was recorded is kept; make the "
            "folder writable, then continue\n"
        )
    with monkeypatch.context() as read_only:
        read_only.setattr("bench.services.conclusion.write_whole", refused)
        assert (
            "; the run is finished and kept; free disk space or make the folder writable, then 'bench resume one' "
            "computes its results\n"
        ) in bench("resume", "one")[2]
    assert Run(Path("runs/one")).results_missing


def test_a_page_that_cannot_be_written_is_told_with_what_to_do(bench, monkeypatch):
    shutil.copytree(RECORDS / "finished", "runs/one")

    monkeypatch.setattr("bench.services.calibration.report_page", lambda *_: ("<html>", None))
    monkeypatch.setattr("bench.base.files.write_synced", refused)
    monkeypatch.setattr(Path, "unlink", refused)
    status, _, err = bench("report", "one")
    assert status == 2
    assert err == (
        "bench: runs/one/report.html: cannot be written (Read-only file system); choose another place "
        "with --out DIR\n"
    )
