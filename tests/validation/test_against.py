"""Past runs computed anew: exactly those of a changed estimator are listed, and somebody must accept it."""

import json
from pathlib import Path

import pytest

import bench as face
from bench.batch import outcome
from bench.batch.work import worked
from bench.services.errors import Refused
from bench.services.requests.documents import Validate
from bench.validation.conduct import against
from benchmarks.validation_faults import edited
from tests.support.certificates import copy_run
from tests.support.commands import printed

pytestmark = pytest.mark.slow


@pytest.fixture
def past_runs(empty_folder, monkeypatch):
    """Four runs with stored results, two of each of two estimators; computed in this program."""
    monkeypatch.setattr(
        outcome, "_computing", lambda job, request, pending: lambda runs: (worked(job, run) for run in runs)
    )
    Path("runs").mkdir()
    for name, estimator in {"a": "gls", "b": "least-squares", "c": "gls", "d": "least-squares"}.items():
        folder = copy_run(Path("runs"), name)
        found = face.calibrate(folder, estimator=estimator).to_dict()
        (folder / "calibrate.json").write_text(json.dumps(found), encoding="utf-8")
    copy_run(Path("runs"), "without-result")
    return "runs/*"


def names(part):
    return [Path(one.run).name for one in part.changed]


def test_a_pattern_without_runs_is_refused_by_the_name_of_its_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Refused, match=r"against nothing: no run is there"):
        against(Validate(), "nothing", Path("out"))


def test_the_runs_of_a_changed_estimator_are_listed_and_no_others(past_runs):
    """One coefficient of least squares is off by half of its u."""
    stored = json.loads(Path("runs/b/calibrate.json").read_text(encoding="utf-8"))
    shift = 0.5 * stored["coefficients"]["Kyy"]["u"]
    with edited(
        "bench.calibration.linear:linear_estimate",
        "    noise, slope = fit.noise.widened()",
        f"    block.K[1, 1] += {shift}\n    noise, slope = fit.noise.widened()",
    ):
        found = against(Validate(), past_runs, Path("out"))
    assert (found.runs, found.compared, names(found), found.failed) == (5, 4, ["b", "d"], {})
    assert [one.largest_change_of for one in found.changed] == ["Kyy", "Kyy"]
    assert [one.largest_change_in_u for one in found.changed] == pytest.approx([0.5, 0.5], rel=1e-6)


def test_a_run_whose_u_alone_changed_is_listed(past_runs):
    """No coefficient moves, but the u of each is a fifth larger."""
    with edited(
        "bench.calibration.calibrate:solve",
        "birge**2 * fit.covariance",
        "birge**2 * 1.44 * fit.covariance",
    ):
        found = against(Validate(), past_runs, Path("out"))
    assert sorted(names(found)) == ["a", "b", "c", "d"]
    assert {one.largest_change_of for one in found.changed} == {"u"}
    assert [one.largest_change_in_u for one in found.changed] == pytest.approx([0.2] * 4, abs=0.01)


def test_changed_runs_wait_for_acceptance(bench, past_runs, monkeypatch):
    from bench.validation import conduct

    monkeypatch.setattr(conduct, "every", list)
    stored = Path("runs/c/calibrate.json")
    result = json.loads(stored.read_text(encoding="utf-8"))
    result["coefficients"]["Kzz"]["value"] += result["coefficients"]["Kzz"]["u"]
    stored.write_text(json.dumps(result), encoding="utf-8")
    out = printed(bench("validate", "--against", past_runs, "--out", "v"), "CHANGED: 1 of", "Kzz", status=1)
    assert "1 changed by more than 0.1 u" in out
