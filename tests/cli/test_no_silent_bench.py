"""Which bench file an analysis takes is said first; an exported readings file is as marked as its run."""

import json
import os
import shutil
from pathlib import Path

import pytest

import bench as face
from bench.cli.commands import COMMANDS
from tests.support.pages import ROOT

RECORDS = ROOT / "tests" / "data" / "records"
SHIPPED = ROOT / "config" / "paper-stand.yaml"


@pytest.fixture
def exported(bench):
    """A run `finished`, and its readings as f.csv."""
    shutil.copytree(RECORDS / "finished", "runs/finished")
    status, out, err = bench("export", "finished", "--csv", "f.csv")
    assert (status, err) == (0, "")
    assert "f.csv.json" in out
    return bench


def told():
    return json.loads(Path("f.csv.json").read_text(encoding="utf-8"))


def result_of(bench, *arguments):
    status, out, err = bench(*arguments, "--json", "-")
    assert status < 2, err
    return json.loads(out)


# --- said first, and in the result ------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("command", ["calibrate", "verify"])
def test_the_bench_file_and_why_stand_in_the_first_line_and_in_the_result(bench, monkeypatch, command):
    assert command in COMMANDS
    shutil.copy(RECORDS / "readings.csv", "r.csv")
    shutil.copy(SHIPPED, "mine.yaml")
    for given, variable, why in (
        (["--bench", "mine.yaml"], "paper-stand", "as asked for"),
        ([], "mine.yaml", "named by BENCH_FILE"),
        ([], None, "the shipped one, because no file was named"),
    ):
        if variable:
            monkeypatch.setenv("BENCH_FILE", variable)
        else:
            monkeypatch.delenv("BENCH_FILE", raising=False)
        first = bench(command, "r.csv", *given, "--json", "j.json")[1].splitlines()[0]
        assert first.startswith(f"bench file: paper-stand, {why} (")
        taken = json.loads(Path("j.json").read_text(encoding="utf-8"))["bench"]
        assert taken["why"] == why
        assert taken["file"] in first
        assert Path(taken["file"]).name == ("mine.yaml" if given or variable else SHIPPED.name)
        assert len(taken["sha256"]) == 64


@pytest.mark.slow
def test_several_sources_with_several_bench_files_have_a_line_each(exported):
    shutil.copy(RECORDS / "readings.csv", "r.csv")
    lines = exported("verify", "r.csv", "finished")[1].splitlines()
    assert lines[0].startswith("bench file of r.csv: ")
    assert lines[1].startswith("bench file of finished: paper-stand, as the run recorded it (")


def test_results_in_python_say_it_too(exported):
    result = face.calibrate("f.csv")
    assert result.bench == "paper-stand, as f.csv.json names it, of run finished"
    assert result.to_dict()["bench"]["file"].endswith("finished/bench.yaml")
    assert (
        face.budget(procedure="quick", trials=0).to_dict()["bench_file"]["why"]
        == "the shipped one, because no file was named"
    )


def test_a_run_keeps_why_its_bench_file_was_taken(empty_folder):
    from bench.services.execution import new_run
    from bench.services.requests.measuring import RunRequest

    new = new_run(RunRequest("quick", None, runs=Path("runs"), dry_run=True, seed=1, name="one"))
    assert new.manifest["bench_why"] == "the shipped one, because no file was named"


# --- an exported readings file ----------------------------------------------------------------------


def test_what_is_exported_tells_where_it_comes_from(exported):
    about = told()
    assert about["simulated"] is True
    assert about["run"] == "finished"
    assert about["operator"] == "A. Person"
    assert about["unit_under_test"]["serial"] == "1"
    assert "34401A" in about["instruments"]["voltmeter.x"]
    assert about["bench"]["sha256"] == result_of(exported, "verify", "finished")["bench"]["sha256"]


def test_an_analysis_of_it_is_as_marked_as_the_runs(exported):
    own, of_file = (result_of(exported, "calibrate", source) for source in ("finished", "f.csv"))
    for key in ("simulated", "unit_under_test", "made_at", "g_m_s2"):
        assert of_file[key] == own[key], key
    assert of_file["bench"]["sha256"] == own["bench"]["sha256"]
    assert of_file["simulated"] is True


@pytest.mark.slow
def test_a_report_of_it_is_as_marked_as_the_runs(exported):
    assert exported("report", "f.csv")[0] == 0
    page = Path("report/f.html").read_text(encoding="utf-8")
    for words in ("SIMULATED", "A. Person", "exported from run", "34401A", "triaxial block of the paper 1"):
        assert words in page, words


def test_a_bench_file_that_is_asked_for_goes_before_the_one_that_is_told(exported, monkeypatch):
    Path("mine.yaml").write_text(SHIPPED.read_text(encoding="utf-8") + "# mine\n", encoding="utf-8")
    result = result_of(exported, "verify", "f.csv", "--bench", "mine.yaml")
    assert result["bench"]["file"] == "mine.yaml"
    monkeypatch.setenv("BENCH_FILE", "mine.yaml")
    result = result_of(exported, "calibrate", "f.csv")
    assert result["bench"]["why"] == "named by BENCH_FILE"
    assert any(
        "mine.yaml instead of the bench file that f.csv was measured with" in n for n in result["notes"]
    )


def test_both_may_be_moved_together_and_a_bench_file_that_is_lost_is_told(exported):
    Path("elsewhere").mkdir()
    for name in ("runs", "f.csv", "f.csv.json"):
        shutil.move(name, "elsewhere")
    taken = result_of(exported, "calibrate", "elsewhere/f.csv")
    assert taken["bench"]["file"] == os.path.join("elsewhere", "runs/finished/bench.yaml")  # noqa: PTH118
    shutil.rmtree("elsewhere/runs")
    lost = result_of(exported, "calibrate", "elsewhere/f.csv")
    assert lost["bench"]["why"] == "the shipped one, because no file was named"
    assert lost["simulated"] is True
    assert any("was moved or changed" in note and "--bench" in note for note in lost["notes"])


def test_a_file_that_was_changed_is_told_and_nothing_is_taken_over(exported):
    text = Path("f.csv").read_text(encoding="utf-8")
    Path("f.csv").write_text(text + "\r\n", encoding="utf-8")
    result = result_of(exported, "calibrate", "f.csv")
    assert result["simulated"] is False
    assert result["unit_under_test"] is None
    assert result["bench"]["why"] == "the shipped one, because no file was named"
    (note,) = [note for note in result["notes"] if "SHA-256" in note]
    assert "f.csv was changed after it was exported" in note
    assert "run finished on SIMULATED instruments" in note


@pytest.mark.parametrize(
    "text",
    [
        '{"sha256": 1}',
        '{"format": 1, "sha256": "a", "run": "\\u001b[31m"}',
        '{"sha256": ' + "[" * 5000,
        '"sha256"',
    ],
)
def test_what_is_none_of_ours_is_not_believed(exported, text):
    Path("f.csv.json").write_text(text, encoding="utf-8")
    result = result_of(exported, "calibrate", "f.csv")
    assert result["simulated"] is False
    assert any("was not written by this program" in note for note in result["notes"])
    Path("f.csv.json").write_text('{"my": "notes"}', encoding="utf-8")
    assert not any("f.csv.json" in note for note in result_of(exported, "calibrate", "f.csv")["notes"])


def test_a_bench_file_of_another_content_is_never_taken(exported):
    about = told()
    Path("other.yaml").write_text("secret: 17\n", encoding="utf-8")
    about["bench"] |= {"copied_to": str(Path("other.yaml").absolute()), "copied_to_from_here": "other.yaml"}
    Path("f.csv.json").write_text(json.dumps(about), encoding="utf-8")
    status, out, err = exported("verify", "f.csv")
    assert status == 0, err
    assert "secret" not in out + err
    assert "was moved or changed" in out


@pytest.mark.slow
def test_another_file_is_not_written_over_and_what_an_import_is_of_is_kept(exported):
    Path("g.csv.json").write_text('{"my": "notes"}', encoding="utf-8")
    status, _, err = exported("export", "finished", "--csv", "g.csv")
    assert (status, Path("g.csv").exists()) == (2, False)
    assert "g.csv.json: this program did not write this file" in err
    status, out, _ = exported("import", "f.csv", "--name", "again")
    assert (status, out.splitlines()[0][:35]) == (0, "bench file: paper-stand, as f.csv.j")
    result = result_of(exported, "calibrate", "again")
    assert result["simulated"] is True
    assert exported("export", "again", "--csv", "h.csv")[0] == 0
    assert json.loads(Path("h.csv.json").read_text(encoding="utf-8"))["run"] == "finished"
    listed = {run["name"]: run["instruments"] for run in result_of(exported, "runs")["runs"]}
    assert listed == {"finished": "simulated", "again": "simulated"}


# --- one folder holds one verdict -------------------------------------------------------------------


@pytest.mark.slow
def test_a_what_if_leaves_the_runs_own_verdict_alone(exported):
    bench = exported
    assert bench("verify", "finished")[0] == 0
    assert bench("calibrate", "finished")[0] == 0
    files = {name: Path(f"runs/finished/{name}.json") for name in ("verify", "calibrate")}
    own = {name: file.read_bytes() for name, file in files.items()}
    Path("mine.yaml").write_text(SHIPPED.read_text(encoding="utf-8") + "# mine\n", encoding="utf-8")
    for command, *otherwise in (
        ("verify", "--limit", "1e-9"),
        ("verify", "--rule", "guarded"),
        ("verify", "--coefficients", str(files["calibrate"])),
        ("verify", "--bench", "mine.yaml"),
        ("verify", "--g", "9.8"),
        ("calibrate", "--estimator", "ols"),
        ("calibrate", "--nominal-angles"),
        ("calibrate", "--join-verification"),
    ):
        shutil.rmtree("runs/finished/what-if", ignore_errors=True)
        out = bench(command, "finished", *otherwise)[1]
        assert f"result of this what-if (the run's own stays): runs/finished/what-if/{command}.json" in out
        assert Path(f"runs/finished/what-if/{command}.json").is_file()
        assert {name: file.read_bytes() for name, file in files.items()} == own
    assert [run["verdict"] for run in result_of(bench, "runs")["runs"]] == ["conditional pass"]
    bench("verify", "finished", "--rule", "simple", "--limit", "3e-4")
    assert files["verify"].read_bytes() == own["verify"]
    assert bench("verify", "finished", "--limit", "1e-9", "--out", "here")[0] == 1
    assert Path("here/finished-verify.json").is_file()
