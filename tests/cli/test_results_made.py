"""The results of a finished run: made by `resume` where a signal, a kill or a full disk left them out."""

import contextlib
import io
import json
import shutil
from pathlib import Path

import pytest

from bench.cli.app import main
from bench.run.events import RunState
from bench.run.folder import RESULTS, Run
from bench.run.interrupts import Interrupts
from bench.services import conclusion
from tests.support.commands import printed

pytestmark = pytest.mark.slow

RUN = Path("runs/one")
MADE = ("calibrate.json", "verify.json", "report.html")


def stopped(*given, **named):
    raise KeyboardInterrupt


def complete():
    return all((RUN / name).is_file() for name in MADE) and not Run(RUN).results_missing


@pytest.fixture(scope="module")
def stopped_run(tmp_path_factory):
    """The folder of a run that was stopped by Ctrl-C before its results were made, its exit status and words."""
    said = io.StringIO()
    folder = tmp_path_factory.mktemp("stopped")
    with contextlib.chdir(folder), contextlib.redirect_stderr(said), pytest.MonkeyPatch.context() as patch:
        patch.setattr(conclusion, "calibration_of", stopped)
        with pytest.raises(SystemExit) as ended:
            main(["run", "quick", "--dry-run", "--name", "one", "--runs", "runs"])
    return folder / RUN, ended.value.code, said.getvalue()


@pytest.fixture
def finished(stopped_run, empty_folder):
    """A copy of that run as `runs/one`."""
    folder, status, err = stopped_run
    assert status == 2
    assert err == (
        "bench: stopped before the results were ready; all readings are kept in runs/one, and "
        "'bench resume one' computes the results\n"
    )
    shutil.copytree(folder, RUN)
    assert Run(RUN).history.state is RunState.FINISHED
    record = (RUN / "events.jsonl").read_bytes()
    yield
    assert (RUN / "events.jsonl").read_bytes() == record


@pytest.mark.usefixtures("finished")
@pytest.mark.parametrize("named", [["one"], []])
def test_resume_makes_the_results_that_a_run_lacks_and_no_others(bench, named):
    (listed,) = json.loads(bench("runs", "--json", "-")[1])["runs"]
    assert (listed["state"], listed["to_go_on"]) == ("finished", "bench resume one")
    status, _, err = bench("resume", *named)
    assert (status, err, complete()) == (0, "", True)
    (listed,) = json.loads(bench("runs", "--json", "-")[1])["runs"]
    assert listed["to_go_on"] == ""
    again = bench("resume", *named)
    assert again[0] == 2
    assert ("the run is finished and cannot be resumed" if named else "no unfinished run there") in again[2]
    assert bench("abort", *named)[0] == 2


@pytest.mark.usefixtures("finished")
def test_killed_between_two_results_it_lacks_the_others(bench, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("bench.services.conclusion.charted", stopped)  # the page is there, the verdict just so
        assert bench("resume", "one")[0] == 2
    assert Run(RUN).results_missing
    assert bench("resume", "one")[0] == 0
    assert complete()


@pytest.mark.usefixtures("finished")
def test_stopped_when_all_was_made_it_says_so_and_needs_no_more(bench, monkeypatch):
    def late(run):
        (RUN / RESULTS).write_text('{"made": []}')
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("bench.services.conclusion.charted", late)
        status, _, err = bench("resume", "one")
    assert (status, err) == (2, "bench: stopped; all readings are kept in runs/one with their results\n")


@pytest.mark.usefixtures("finished")
def test_a_signal_on_the_way_out_of_a_finished_run_leaves_its_results_to_resume(bench, monkeypatch):
    hold = Interrupts.hold

    def held(interrupts):
        hold(interrupts)
        interrupts._handle(15, None)

    monkeypatch.setattr(Interrupts, "hold", held)
    status, _, err = bench("run", "quick", "--dry-run", "--name", "two")
    assert status == 2
    assert err.endswith("'bench resume two' computes the results\n")
    assert Run(Path("runs/two")).results_missing


@pytest.mark.usefixtures("finished")
def test_a_run_that_is_no_calibration_has_all_its_results_when_that_is_said(bench, tmp_path):
    (tmp_path / "one.yaml").write_text(
        "procedure: one\ntitle: One\nreading: {samples: 2, nplc: 1, settle: 1 s}\n"
        "steps: [installation: {label: 1, steps: [turn: {angles: [10 deg]}]}]\n"
    )
    printed(bench("run", "one.yaml", "--dry-run", "--name", "short"), "no calibration from it")
    assert not Run(Path("runs/short")).results_missing


def test_a_run_of_a_version_that_named_no_results_has_them_where_its_page_is(tmp_path):
    run = Run(tmp_path)
    assert run.results_missing
    (tmp_path / "report.html").touch()
    assert not run.results_missing
    (tmp_path / RESULTS).write_text("[]")
    assert run.results_missing
