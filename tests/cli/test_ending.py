"""The end of a run in the terminal: the verdict first, then where the rest is and what to do next."""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import bench as face
from bench.calibration.conformity import Statement
from bench.calibration.result import FaultyReadings, SpoiledFit
from bench.run.folder import Run
from bench.services.conclusion import MOST_LINES, conclude, ending, run_again
from bench.services.source import Request, load_sources
from tests.support.commands import printed, refused
from tests.support.pages import ROOT

RECORDS = ROOT / "tests" / "data" / "records"


@pytest.fixture
def concluded(empty_folder):
    shutil.copytree(RECORDS / "finished", "runs/finished")
    return conclude(Run(Path("runs/finished")))


def real(found):
    """Return the conclusion as of a run on real instruments."""
    run = Run(found.run.folder)
    run.__dict__["manifest"] = {**run.manifest, "dry_run": False}
    return replace(found, run=run)


def test_the_verdict_is_first_and_the_next_step_last(concluded):
    lines = ending(concluded)
    assert len(lines) <= MOST_LINES
    assert lines[0].startswith("finished (SIMULATED): ")
    assert "worst |Δg| = " in lines[0]
    assert any(line.startswith("report: runs/finished/report.html") for line in lines)
    assert lines[-1].startswith("next: on real instruments: bench run ")


def test_after_a_real_run_the_certificate_and_the_next_unit_follow(concluded):
    lines = ending(real(concluded))
    assert lines[0].startswith("finished: ")
    assert lines[-2] == "next: bench certificate finished"
    assert lines[-1].startswith("next unit: bench run ")
    assert lines[-1].endswith(" --unit SERIAL")


def test_the_next_command_names_another_folder_of_runs(concluded):
    """Typed as printed, it measured into ./runs, beside which the runs of the same unit were not found."""
    shutil.move("runs", "their runs")
    found = replace(concluded, run=Run(Path("their runs/finished")))
    assert ending(found)[-1].endswith(" --runs 'their runs' --bench FILE")
    assert ending(real(found))[-1].endswith(" --runs 'their runs' --unit SERIAL")


def test_the_next_command_has_the_goals_and_the_limit_of_the_run(concluded):
    """Typed as printed, it measured every point, and judged by the limit of the bench file."""
    found = real(concluded)
    verdict = {"limit_g": 2.5e-4, "rule": "guarded", "guard_band": 0.8}
    found.run.manifest.update(until=["all=5e-5", "time=4h"], verdict=verdict)
    goals, judged = " --until all=5e-5 --until time=4h", " --limit 0.00025 --rule guarded --guard-band 0.8"
    assert goals + judged in ending(found)[-1]
    assert run_again(found.run, "verification") == f"bench run verification{judged}"


def test_where_the_verification_fails_the_diagnosis_is_next(concluded):
    verdict = concluded.verification.verification
    points = tuple(replace(point, statement=Statement.FAIL, accepted_up_to=0.0) for point in verdict.points)
    failed = replace(concluded.verification, verification=replace(verdict, points=points))
    found = replace(concluded, verification=failed)
    lines = ending(found)
    assert lines[0].startswith("finished (SIMULATED): FAILED: ")
    assert len(lines) <= MOST_LINES
    assert not found.verification.passed
    assert lines[-1] == "next: bench diagnose finished"


def test_where_u_is_too_large_the_budget_is_next(concluded):
    lines = ending(replace(concluded, verification=face.verify("finished", limit=1e-9)))
    assert lines[0].startswith("finished (SIMULATED): INCONCLUSIVE: ")
    assert len(lines) <= MOST_LINES
    assert lines[-1].startswith("next: bench budget ")


def test_where_points_are_missing_these_are_measured_next(concluded):
    verdict = concluded.verification.verification
    without = replace(concluded.verification, verification=replace(verdict, missing=1))
    assert ending(replace(concluded, verification=without))[-1].endswith(
        "points, bench run verification --dry-run; then "
        "bench verify NEW --coefficients runs/finished/calibrate.json"
    )


def test_where_the_model_does_not_fit_that_is_the_verdict(concluded):
    own = concluded.calibration.calibration
    bad = replace(own, lack_of_fit=replace(own.lack_of_fit, p=1e-9))
    lines = ending(replace(concluded, calibration=replace(concluded.calibration, calibration=bad)))
    assert lines[0] == "finished (SIMULATED): NOT ACCEPTED: the model does not fit the readings"
    assert any(line.startswith("verification points: ") for line in lines)
    assert lines[-1] == "next: bench diagnose finished"


@pytest.mark.parametrize(
    ("error", "words", "step"),
    [
        (FaultyReadings, ["the signal of channel x is the same in every reading; check its cable"], "show"),
        (SpoiledFit, ["the fit did not converge", "find the mistake with 'bench diagnose'"], "diagnose"),
    ],
)
def test_where_wrong_readings_spoil_the_calibration_the_run_is_not_accepted(
    concluded, monkeypatch, error, words, step
):
    def spoiled(_):
        raise error(*words)

    monkeypatch.setattr("bench.services.conclusion.calibration_of", spoiled)
    found = conclude(concluded.run)
    kept = json.loads((concluded.run.folder / "results.json").read_text("utf-8"))
    assert kept["no_calibration"] == "; ".join(words)
    assert kept["diagnosable"] == (step == "diagnose")
    assert not found.accepted
    lines = ending(replace(found, looks=("sign",)))
    assert lines[0].endswith(f"no calibration from it: {'; '.join(words)}")
    assert lines[-1] == f"next: bench {step} finished"


def test_many_looks_are_shortened(concluded):
    lines = ending(replace(concluded, looks=tuple(f"sign {n}" for n in range(9))))
    assert len(lines) <= MOST_LINES
    assert [line for line in lines if line.startswith("note: ")] == [
        "note: sign 0",
        "note: sign 1",
        "note: 7 more notes; 'bench diagnose finished' explains them",
    ]


def test_a_run_elsewhere_is_named_by_its_path(concluded, monkeypatch):
    monkeypatch.setenv("BENCH_RUNS", "others")
    assert ending(real(concluded))[-2] == "next: bench certificate runs/finished"


@pytest.mark.parametrize(
    ("name", "typed"), [("finished", "runs/finished"), ("runs/finished", "runs/finished")]
)
def test_a_command_on_a_run_elsewhere_names_it_by_its_path(concluded, monkeypatch, name, typed):
    """'bench diagnose finished' found no such run, or another one of that name."""
    monkeypatch.setenv("BENCH_RUNS", "others")
    assert load_sources(Request([name], Path("runs")))[0].typed == typed


def test_a_command_to_paste_is_quoted(concluded):
    spaced = Path("my 'runs'")
    Path("runs").rename(spaced)
    found = real(replace(concluded, run=Run(spaced / "finished")))
    found.run.manifest["procedure"] = "my procedure.yaml"
    *_, certificate, further = (shlex.split(line.partition(": ")[2]) for line in ending(found)[-2:])
    assert certificate == ["bench", "certificate", str(spaced / "finished")]
    assert further[:3] == ["bench", "run", "my procedure.yaml"]


# --- export without a name ----------------------------------------------------------------------------


def test_an_export_without_a_name_is_called_after_the_run(bench):
    shutil.copytree(RECORDS / "finished", "runs/finished")
    printed(bench("export", "finished"), "readings written to finished.csv", "finished.csv.json")
    assert Path("finished.csv").is_file()
    named = printed(bench("export", "runs/finished", "--csv", "named.csv"))
    assert "named.csv" in named
    assert Path("named.csv").read_bytes() == Path("finished.csv").read_bytes()
    printed(bench("export", "runs/finished"), "finished.csv")  # its own earlier export is replaced


def test_an_export_without_a_name_overwrites_no_other_file(bench):
    shutil.copytree(RECORDS / "finished", "runs/finished")
    Path("finished.csv").write_text("mine", encoding="utf-8")
    refused(bench("export", "finished"), "finished.csv: exists; name another file with --csv FILE")
    assert Path("finished.csv").read_text(encoding="utf-8") == "mine"
