"""The commands as their user types them, in an empty folder; one source of several that fails."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from bench.model.geometry import COEFFICIENTS
from bench.run.folder import Run
from tests.support.commands import printed, refused
from tests.support.procedure_texts import TWO_INSTALLATIONS
from tests.support.schemas import keeps_to

PAPER = [
    -2.177087, -0.018243, 0.025027, 0.026542, -2.139892, 0.032755, 0.006754, 0.006026, -2.144367,
    0.071469, -0.196485, -0.411789,
]  # fmt: skip
"""Equation (11) of the paper, V/g and V."""

SILENT_STAND = {
    "limit: 5 arcsec": "limit: 0 arcsec",
    "limit: 90 arcsec": "limit: 0 arcsec",
    "limit: 10 arcsec": "limit: 0 arcsec",
    "limit: 0.3 mV": "limit: 0 mV",
    "setting_deviation: 2 arcsec": "setting_deviation: 0 arcsec",
    "slip_probability: 0.01": "slip_probability: 0.0",
    "noise: yes": "noise: no",
}
SHIPPED = Path(__file__).parents[2] / "config" / "paper-stand.yaml"


def edited_stand(**changes):
    """Write the shipped bench file with changes of its text; every change must apply."""
    text = SHIPPED.read_text(encoding="utf-8")
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    Path("stand.yaml").write_text(text, encoding="utf-8")
    return "stand.yaml"


@pytest.mark.slow
def test_a_dry_run_ends_with_coefficients_a_verdict_and_a_report(bench):
    status, out, err = bench("run", "paper", "--dry-run", "--name", "first", "--operator", "A. Person")
    assert (status, err) == (0, "")
    assert "first (SIMULATED): PASSED" in out
    folder = Path("runs/first")
    result = json.loads((folder / "calibrate.json").read_text())
    value = np.array([result["coefficients"][name]["value"] for name in COEFFICIENTS])
    u = np.array([result["coefficients"][name]["u"] for name in COEFFICIENTS])
    assert result["estimator"] == "gls"
    assert result["readings"] == {"used": 54, "skipped": 0}
    assert np.all(np.abs(value - PAPER) < 5 * u)
    # the third mounting angle, which nobody stated, is most of u(Kyz) and u(Kzy)
    assert np.all(np.delete(u, [5, 7]) < 1e-4)
    assert np.all(u[[5, 7]] < 4e-4)
    verdict = json.loads((folder / "verify.json").read_text())
    assert verdict["passed"] is True
    assert [round(p["angle_deg"]) for p in verdict["points"]] == [45, 135, 225, 315]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "A. Person" in page
    assert "SIMULATED" in page
    assert Run(folder).history.problems == ()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_run_and_another_seed_another(bench):
    Path("two.yaml").write_text(TWO_INSTALLATIONS, encoding="utf-8")
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        assert bench("run", "two.yaml", "--dry-run", "--seed", seed, "--name", name)[0] == 0
    a, b, c = (Run(Path("runs") / name).readings() for name in "abc")
    assert np.array_equal(a.signal, b.signal)
    assert np.array_equal(a.time_s, b.time_s)
    assert np.mean(a.signal == c.signal) < 0.1  # readings are rounded: a few may agree


@pytest.mark.slow
def test_error_free_both_estimators_return_the_paper_over_the_wire(bench):
    """A reply carries 1e-8 V, so 5e-9 V of rounding; equation (11) to 5e-9."""
    stand = edited_stand(**SILENT_STAND)
    assert bench("run", "paper", "--dry-run", "--bench", stand, "--name", "exact")[0] == 0
    for estimator in ("gls", "closed-form"):
        out = printed(bench("calibrate", "exact", "--estimator", estimator, "--json", "-"))
        found = [json.loads(out)["coefficients"][name]["value"] for name in COEFFICIENTS]
        assert np.max(np.abs(np.array(found) - PAPER)) < 5e-9


@pytest.mark.slow
def test_a_run_exported_calibrates_to_the_same_numbers(bench, paper_run):
    assert bench("export", "run", "--csv", "readings.csv")[0] == 0
    results = []
    for source in ("run", "readings.csv"):
        out = printed(bench("calibrate", source, "--json", "-"))
        results.append(json.loads(out))
    for name in COEFFICIENTS:
        ours, theirs = (r["coefficients"][name] for r in results)
        assert ours["value"] == pytest.approx(theirs["value"], rel=1e-9, abs=1e-11)
        assert ours["u"] == pytest.approx(theirs["u"], rel=1e-5)
    assert Path("calibrate/readings.json").is_file()
    assert bench("import", "readings.csv", "--name", "by-hand")[0] == 0
    both = json.loads(printed(bench("calibrate", "by-hand", "readings.csv", "--json", "-")))
    assert both[0]["coefficients"] == both[1]["coefficients"]
    assert bench("report", "by-hand")[0] == 0
    assert Path("runs/by-hand/report.html").is_file()


@pytest.mark.slow
def test_runs_and_show_tell_what_there_is(bench):
    assert bench("runs")[1].startswith("runs: no runs there")
    bench("run", "quick", "--dry-run", "--name", "one")
    out = bench("runs")[1]
    assert re.search(r"one .*simulated .*finished .*22 +PASSED", out)
    assert "events, chain of hashes complete\n" in bench("show", "one", "--verify")[1]
    events = Path("runs/one/events.jsonl")
    events.write_text(events.read_text().replace('"samples_taken": 5', '"samples_taken": 6', 1))
    printed(bench("show", "one", "--verify"), "the chain is broken", status=1)
    assert re.search(r"one .*damaged .* -\n", bench("runs")[1])
    assert json.loads(bench("show", "one", "--json", "-")[1])["verdict"] is None
    refused(bench("calibrate", "one"), "cannot be trusted")


def test_check_prints_the_steps_and_touches_nothing(bench):
    printed(bench("check", "calibration"), "installation 2, pass 2, point 9")
    assert list(Path().iterdir()) == []
    summary = json.loads(bench("check", "calibration", "--json", "-")[1])
    assert summary["counts"]["read"] == 58
    assert summary["counts"]["turn"] == 58
    assert summary["problems"] == []


@pytest.mark.slow
def test_init_writes_copies_and_never_over_a_file(bench):
    assert bench("init")[0] == 0
    mine = Path("procedures/quick.yaml")
    mine.write_text(mine.read_text().replace("samples: 5", "samples: 3"))
    assert bench("init")[0] == 0
    assert "samples: 3" in mine.read_text()
    assert bench("check", "procedures/quick.yaml", "--bench", "config/bench-rs232.yaml")[0] in {0, 1}
    assert bench("run", "procedures/quick.yaml", "--dry-run", "--name", "mine")[0] == 0
    assert set(Run(Path("runs/mine")).readings().samples) == {3}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("calibrate", "nix.csv"), "nix.csv: no such readings file"),
        (("calibrate", "nix"), "nix: no run of that name"),
        (("run", "paper"), "needs a bench file"),
        (("run", "papper", "--dry-run"), "did you mean paper"),
        (("run", "paper", "--dry-run", "--bench", "nix.yaml"), "nix.yaml"),
        (("run", "paper", "--dry-run", "--name", "../up"), "a run's name begins"),
        (("verify", "x.csv", "--coefficients", "c.json"), "x.csv: no such readings file"),
        (("verify", "x.csv", "--limit", "1e-5 g"), "--limit"),
        (("resume",), "no unfinished run"),
        (("frob",), "No such command"),
        (("calibrate",), "Missing"),
    ],
)
def test_every_mistake_is_one_clear_line(bench, arguments, says):
    answer = bench(*arguments)
    refused(answer, says)
    assert answer[1] == ""


@pytest.mark.slow
def test_a_bad_readings_file_lists_its_rows_and_computes_nothing(bench, paper_run):
    bench("export", "run", "--csv", "r.csv")
    lines = Path("r.csv").read_text().splitlines()
    lines[3] = lines[3].replace(lines[3].split(",")[10], "9.9E37")
    lines[7] = lines[7].replace("1,1,", "1,Q,", 1)
    Path("bad.csv").write_text("\n".join(lines))
    refused(
        bench("calibrate", "bad.csv"),
        "bad.csv, line 4, column ux_v: the voltmeter was overloaded",
        "bad.csv, line 8, column installation",
        lines=3,
    )
    assert not Path("calibrate/bad.json").exists()
    out = printed(bench("calibrate", "bad.csv", "--skip-bad-rows", "--json", "-"))
    assert json.loads(out)["readings"] == {"used": 52, "skipped": 2}


def test_a_file_where_nothing_can_be_written_beside_it_still_calibrates(bench, paper_run, monkeypatch):
    bench("export", "run", "--csv", "r.csv")
    Path("calibrate").write_text("in the way")
    status, _, err = bench("calibrate", "r.csv")
    assert status == 0
    assert "was not written" in err
    assert bench("calibrate", "r.csv", "--out", "calibrate")[0] == 2


def test_check_opens_the_instruments_only_when_asked(bench):
    """The shipped bench has its meters on a GPIB board, which a machine without one says at once."""
    status, out, _ = bench("check", "quick")
    assert status == 0
    assert "no mistakes found" in out
    status, out, err = bench("check", "quick", "--instruments", "--bench", "paper-stand")
    assert status == 2
    assert "no mistakes found" not in out
    assert all(f"voltmeter.{channel}" in err for channel in "xyz")
    assert "Traceback" not in err


@pytest.mark.slow
def test_run_and_report_give_json_on_standard_output_alone(bench):
    status, out, err = bench("run", "quick", "--dry-run", "--name", "j", "--json", "-")
    assert status == 0
    told = json.loads(out)
    assert told["run"] == "j"
    assert told["verification"]["passed"] is True
    assert told["calibration"]["order"][0] == "Kxx"
    assert "PASSED" in err  # what a person reads goes beside it
    told = json.loads(bench("report", "j", "--json", "-")[1])
    assert Path(told["report"]).is_file()
    keeps_to("report", told)


READINGS = Path(__file__).parents[1] / "data" / "records" / "readings.csv"


@pytest.fixture
def files(empty_folder):
    names = ["a.csv", "bad.csv", "c.csv"]
    for name in names:
        shutil.copy(READINGS, name)
    text = READINGS.read_text(encoding="utf-8")
    Path("bad.csv").write_text(text.replace("installation,", "mounting,", 1), encoding="utf-8")
    return names


@pytest.mark.parametrize("command", ["calibrate", "verify"])
def test_the_others_are_done_in_their_order(bench, files, command):
    status, _, err = bench(command, *files, "none.csv", "--json", "all.json")
    assert status == 2
    a, bad, c, none = json.loads(Path("all.json").read_text(encoding="utf-8"))
    assert bad["source"] == "bad.csv"
    assert "the header lacks installation" in bad["problem"]
    assert none == {"source": "none.csv", "problem": "none.csv: no such readings file; check the name"}
    for one in (bad, none):
        keeps_to("source-failed", one)
    for one in (a, c):
        keeps_to(command, one)
    assert a.keys() == c.keys()
    assert "problem" not in a
    told = [line for line in err.splitlines() if line.startswith("bench: ")]
    assert told[0].startswith("bench: bad.csv, line 1: the header lacks installation")
    assert told[-1] == "bench: 2 of 4 sources could not be evaluated"


def test_what_is_wrong_with_all_is_told_once(bench, files):
    refused(bench("calibrate", "a.csv", "c.csv", "--bench", "none.yaml"), "none.yaml")


def test_one_alone_is_told_as_ever(bench, files):
    err = refused(bench("calibrate", "bad.csv", "--json", "one.json"))
    assert err.count("bench: ") == 1
    assert not Path("one.json").exists()
