"""The check block of a simulated bench: measured on some days, a shift, a run refused."""

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import bench as program
from bench.config.bench_file.file import load_bench
from bench.run.folder import Run
from bench.services import check_block
from bench.services.calibration import calibration_of
from bench.services.check_before import check_before
from bench.services.check_block import chart_of, check_block_runs
from bench.services.conclusion import charted
from bench.services.errors import Refused
from bench.services.execution import new_run
from bench.services.requests.measuring import RunRequest
from bench.services.source import Request, load_sources
from tests.support.check_runs import measured, write_bench
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to

SHIFT = "model_file: 1\nname: a meter off\neffects:\n  - name: voltmeter_offset\n    parameters: {offset: 600 uV}\n"


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A folder with five runs of the check block, the last with a shift of 600 µV; not to be written to."""
    folder = tmp_path_factory.mktemp("laboratory")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_bench()
        Path("shift.yaml").write_text(SHIFT, encoding="utf-8")
        for day in range(4):
            measured(f"check-{day}", seed=10 + day)
        measured("shifted", seed=20, model=Path("shift.yaml"))
    return folder


@pytest.fixture
def there(laboratory, monkeypatch):
    monkeypatch.chdir(laboratory)
    monkeypatch.delenv("BENCH_FILE", raising=False)
    return load_bench(Path("my.yaml"))


def of_days(bench, count: int, name: str = "shifted"):
    """The chart of the first runs, as it was on their day."""
    runs = check_block_runs(bench, Path("runs"), simulated=True)
    return chart_of(runs[:count], bench.check_block)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"block": "Q-18"}, r"a is of Q-17, b of Q-18\); name only runs of one block"),
        ({"unit": "mA"}, r"a is in V, b in mA\); name only runs of one unit"),
        ({"simulated": True}, r"a is real, b simulated\); name only runs of one kind"),
    ],
)
def test_runs_that_cannot_share_a_chart_are_named(other, words):
    one = {"name": "a", "block": "Q-17", "unit": "V", "simulated": False}
    with pytest.raises(Refused, match=words):
        check_block._refuse_mixed([SimpleNamespace(**one), SimpleNamespace(**one | {"name": "b"} | other)])


@pytest.mark.slow
def test_days_in_control_and_the_day_of_a_shift(there):
    first = of_days(there, 1)
    assert first.sentence().startswith("NO VERDICT yet: check-0 is the first")
    good = of_days(there, 4)
    assert good.accepted
    assert [run.name for run in good.chart.baseline] == ["check-0", "check-1", "check-2"]
    assert (good.chart.centre.dof, good.twelve.centre.dof) == (18.0, 24.0)
    bad = of_days(there, 5)
    assert not bad.accepted
    assert bad.sentence().startswith("OUT OF CONTROL: shifted: T² = ")
    assert "bx" in bad.sentence()
    told = json.loads(json.dumps(bad.to_dict()))
    keeps_to("chart", told)
    nine = told["intrinsic"]["runs"]["shifted"]
    assert nine["t2"] > told["intrinsic"]["limits"]["t2"]
    assert len(nine["values"]) == 9
    assert len(told["runs"][-1]["coefficients"]) == 12


def test_with_two_runs_stated_u_has_to_do(there):
    found = of_days(there, 2)
    assert found.chart.design.basis == "stated"
    assert "until the baseline has 3 runs" in found.notes[0]


def test_a_run_that_was_out_of_control_is_no_part_of_the_baseline(there):
    runs = check_block_runs(there, Path("runs"), simulated=True)
    shifted = runs.pop()
    section = there.check_block.model_copy(update={"baseline": 10})
    # as if the shift had come on the third day
    found = chart_of([*runs[:2], shifted, *runs[2:]], section)
    assert "shifted" not in [run.name for run in found.chart.baseline]


def test_what_the_check_says_of_a_run(there, monkeypatch):
    def said(count: int, hours: float):
        runs = check_block_runs(there, Path("runs"), simulated=True)[:count]
        monkeypatch.setattr("bench.services.check_before.check_block_runs", lambda *_, **__: runs)
        when = datetime.fromisoformat(runs[-1].created) if runs else datetime.now(UTC)
        return check_before(
            there, Path("my.yaml"), Path("runs"), when + timedelta(hours=hours), simulated=True
        )

    assert said(4, 2.0).state == "in control"
    assert said(4, 25.0).state == "too old"
    assert "25.0 h old; it is valid for 24 h" in said(4, 25.0).sentence or "1 d" in said(4, 25.0).sentence
    assert said(4, -1.0).state == "missing"
    assert "later than now; set the computer's clock" in said(4, -1.0).sentence
    assert said(5, 1.0).state == "out of control"
    assert said(0, 1.0).state == "missing"
    assert "measure it again" in said(1, 1.0).sentence


def test_a_run_is_refused_unless_somebody_says_why_not(there):
    with pytest.raises(Refused, match=r"OUT OF CONTROL.*despite_check"):
        measured("work", 30, unit=None, check_block=True)
    new = new_run(RunRequest("quick", "my.yaml", dry_run=True, seed=1, despite_check="only y is needed"))
    told = new.manifest["check_block"]
    assert (told["state"], told["run"], told["despite"]) == ("out of control", "shifted", "only y is needed")
    with pytest.raises(Refused, match="give the reason in words"):
        new_run(RunRequest("quick", "my.yaml", dry_run=True, seed=1, despite_check=" "))


def test_neither_a_dry_run_nor_the_check_itself_is_held_to_it(there):
    plain = new_run(RunRequest("quick", "my.yaml", dry_run=True, seed=1))
    assert "check_block" not in plain.manifest
    itself = new_run(RunRequest("quick", "my.yaml", dry_run=True, seed=1, unit="CHECK-1", check_block=True))
    assert "check_block" not in itself.manifest
    assert "this is a run of the check block" in itself.notes[-1]


def test_a_real_run_looks_for_real_checks(there):
    with pytest.raises(Refused, match="no run of the check block CHECK-1"):
        new_run(RunRequest("quick", "my.yaml", dry_run=False, seed=1))


@pytest.mark.slow
def test_with_warn_the_run_goes_on_and_its_result_says_so(laboratory, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(laboratory / "runs", "runs")
    text = (laboratory / "my.yaml").read_text(encoding="utf-8").replace("rule: refuse", "rule: warn")
    Path("my.yaml").write_text(text, encoding="utf-8")
    measured("work", 30, unit=None, check_block=True)
    notes = program.calibrate("work").notes
    assert any(note.startswith("check block: the last run") and "rule is to warn" in note for note in notes)


def test_a_bench_without_a_check_block_cannot_be_held_to_one(there):
    with pytest.raises(Refused, match="has no section check_block"):
        new_run(RunRequest("quick", "paper-stand", dry_run=True, seed=1, check_block=True))


@pytest.mark.slow
def test_the_command_draws_the_chart_and_its_status_is_the_verdict(there, bench, laboratory, monkeypatch):
    monkeypatch.chdir(laboratory)
    status, out, err = bench("chart", "runs", "--json", "chart.json", "--page", "chart.html")
    assert (status, err) == (1, "")
    assert "OUT OF CONTROL: shifted" in out
    keeps_to("chart", json.loads(Path("chart.json").read_text(encoding="utf-8")))
    page = Path("chart.html").read_text(encoding="utf-8")
    assert "Out of control" in page
    assert "SIMULATED" in page
    printed(bench("chart", *(f"check-{k}" for k in range(4)), "--limits", "stated"), "IN CONTROL: check-3")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--limits", "guessed"], "give limits from stated, scaled, scatter"),
        (["--smoothing", "2"], "between 0.03 and 1"),
        (["--arl", "3"], "between 20 and"),
        (["--real"], "no run of a check block"),
    ],
)
def test_what_cannot_be_charted_is_one_sentence(there, bench, laboratory, monkeypatch, arguments, told):
    monkeypatch.chdir(laboratory)
    refused(bench("chart", "runs", *arguments), told)


def test_a_reference_from_elsewhere_stands_in_for_a_baseline(there, tmp_path):
    result = program.calibrate("check-0").to_dict()
    (tmp_path / "ours.json").write_text(json.dumps(result), encoding="utf-8")
    section = there.check_block.model_copy(update={"reference": ("ours.json",)})
    runs = check_block_runs(there, Path("runs"), simulated=True)
    found = chart_of(runs, section, of_bench=tmp_path / "my.yaml")
    assert found.chart.reference.name == "ours.json"
    assert len(found.chart.later) == 5
    with pytest.raises(Refused, match=r"none\.json: not a result of"):
        chart_of(
            runs, section.model_copy(update={"reference": ("none.json",)}), of_bench=tmp_path / "my.yaml"
        )


def test_a_reference_at_another_place_has_the_u_of_both_values_of_g(there, tmp_path):
    """g there is 0.2 % larger, with u = 50 ppm: K per local g is larger, too, and S and b have both u of g."""
    found = program.calibrate("check-0")
    result = found.to_dict()
    section = there.check_block.model_copy(update={"reference": ("theirs.json",)})
    runs = check_block_runs(there, Path("runs"), simulated=True)
    references = []
    for g, gravity_u in ((result["g_m_s2"], 5e-5), (1.002 * result["g_m_s2"], 5e-5)):
        factor = np.where(np.arange(12) < 9, g / result["g_m_s2"], 1.0)
        values = {
            name: {**one, "value": one["value"] * times}
            for (name, one), times in zip(result["coefficients"].items(), factor, strict=True)
        }
        covariance = (np.array(result["covariance"]) * np.outer(factor, factor)).tolist()
        other = {"g_m_s2": g, "gravity_u": gravity_u, "coefficients": values, "covariance": covariance}
        (tmp_path / "theirs.json").write_text(json.dumps(result | other), encoding="utf-8")
        references.append(chart_of(runs, section, of_bench=tmp_path / "my.yaml").chart.reference)
    here, elsewhere = references
    assert elsewhere.value == pytest.approx(here.value)
    more = np.diag(elsewhere.covariance - here.covariance)
    assert found.calibration.gravity_u > 4e-5
    of_g = np.abs(here.value) * np.hypot(5e-5, found.calibration.gravity_u)
    of_g[3:6] = 0.0  # the angles between the axes
    assert np.sqrt(np.abs(more)) == pytest.approx(of_g, rel=1e-3, abs=1e-9)


def test_runs_of_two_places_get_a_note(there, monkeypatch):
    runs = check_block_runs(there, Path("runs"), simulated=True)[:3]
    assert not any("gravity" in note for note in chart_of(runs, there.check_block).notes)
    own = check_block.check_values
    monkeypatch.setattr(
        check_block, "check_values", lambda run: own(run).per(9.83) if run.name == "check-1" else own(run)
    )
    found = chart_of(runs, there.check_block)
    assert (
        "gravity differs from that of check-0: check-1; between places, the limits include" in found.notes[0]
    )
    places = {run.name: run.place for run in (*found.twelve.baseline, *found.twelve.later)}
    assert {name for name, place in places.items() if place == 9.83} == {"check-1"}


def test_a_run_with_skipped_points_has_the_u_of_its_own_readings(there, monkeypatch):
    runs = check_block_runs(there, Path("runs"), simulated=True)[:4]
    whole = chart_of(runs, there.check_block).chart.shewhart.u[-1]
    (source,) = load_sources(Request([str(runs[3].folder)], Path("runs")))
    rows = source.readings
    kept = rows.select((rows.installation != "2") | (rows.point % 2 == 1))
    own, partial = (
        check_block.check_values,
        check_block._of(runs[3], calibration_of(replace(source, readings=kept))),
    )
    monkeypatch.setattr(
        check_block, "check_values", lambda run: partial if run.name == "check-3" else own(run)
    )
    less = chart_of(runs, there.check_block).chart.shewhart.u[-1]
    assert np.max(less / whole) > 1.15


def test_from_python_it_is_the_same_chart(there):
    found = program.chart("runs", bench="my.yaml")
    assert found.to_dict() == of_days(there, 5).to_dict()
    assert not found.accepted


def test_a_run_that_ends_puts_itself_on_the_chart(laboratory, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(laboratory / "runs", "runs")
    found = charted(Run(Path("runs/shifted")))["chart"]
    assert not found.accepted
    keeps_to("chart", json.loads(Path("runs/shifted/chart.json").read_text(encoding="utf-8")))


def test_values_are_kept_by_the_head_of_their_record(there, monkeypatch):
    (run, *_) = check_block_runs(there, Path("runs"), simulated=True)
    kept = check_block.check_values(run)
    monkeypatch.setattr(
        "bench.services.check_block.calibration_of", lambda _: pytest.fail("calibrated again")
    )
    again = check_block.check_values(Run(run.folder))
    assert (again.value == kept.value).all()
    assert (again.readings == kept.readings).all()
    assert again.when == kept.when
