"""`bench diagnose` and `bench confirm` on free positions, as their user types them, and from Python."""

import json
from pathlib import Path

import numpy as np
import pytest

import bench as program
from bench.readings.csv import write_csv
from bench.readings.table import make_readings
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to

NOISE = 0.2
"""Counts: 0.1 mg."""


def measured(name, seed, *, count=48, warm_g=0.0, moved=None):
    """A file of free positions of a sensor whose z warms up by so much; `moved` is one that was not at rest."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(count, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    time_s = 60.0 * np.arange(count)
    warming = np.exp(-time_s / 600.0)[:, None] * np.array([0.0, 0.0, warm_g])
    signal = (a + warming) @ np.diag([2060.0, 2045.0, 2052.0]) + np.array([-55.0, 20.0, -110.0])
    signal += rng.normal(0.0, NOISE, (count, 3))
    if moved is not None:
        signal[moved] *= 1.01
    table = make_readings(
        ["F"] * count, [1] * count, list(range(1, count + 1)), np.full(count, np.nan), signal,
        source=name, unit="counts", time_s=time_s,
    )  # fmt: skip
    write_csv(table, Path(name))
    return name


@pytest.fixture
def named(bench):
    """A diagnosis that found a warm-up, with its page and its model file."""
    measured("warm.csv", 1, warm_g=6e-3)
    assert bench("diagnose", "warm.csv", "--accept-first", "--json", "d.json")[0] == 0
    return json.loads(Path("d.json").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_what_is_found_is_written_as_a_page_and_as_a_model_that_calibrate_and_confirm_take(bench, named):
    keeps_to("diagnose-free", named)
    first = named["effects"][0]
    assert "warm_up" in {first["name"], *first["cannot_tell_from"]}
    page = Path(named["report"]).read_text(encoding="utf-8")
    for told in ("gap closed", "What to do", "bench confirm NEW", "Residuals of the modulus", "Consequence"):
        assert told.lower() in page.lower(), told
    assert page.count("<svg") >= 3
    assert "bench" in named
    assert bench("calibrate", "warm.csv", "--model", named["model"])[0] == 0
    measured("again.csv", 2, warm_g=6e-3)
    status, out, err = bench("confirm", "again.csv", "--model", named["model"], "--json", "c.json")
    result = json.loads(Path("c.json").read_text(encoding="utf-8"))
    keeps_to("confirm", result)
    assert (status, err, result["verdict"]) == (0, "", "confirmed"), out
    assert result["closed"] > 0.9
    assert result["after_rms_ug"] < 0.5 * result["before_rms_ug"]
    assert "again.csv: CONFIRMED: either of warm_up or thermal_settling; gap closed" in out
    # the model given is not searched for again
    assert "NOTHING FOUND" in bench("diagnose", "again.csv", "--model", named["model"])[1]


@pytest.mark.slow
def test_what_is_gone_or_was_found_in_these_is_no_proof(bench, named):
    printed(
        bench("confirm", measured("cold.csv", 3), "--model", named["model"]), "cold.csv: GONE: ", status=1
    )
    refused(bench("confirm", "warm.csv", "--model", named["model"]), "found in these same readings")


@pytest.mark.slow
def test_the_copy_without_what_stands_apart_is_searched_to_the_same_end(bench):
    measured("moved.csv", 5, moved=7)
    status, out, _ = bench("diagnose", "moved.csv", "--json", "m.json", "--out", "there")
    result = json.loads(Path("m.json").read_text(encoding="utf-8"))
    assert (status, result["verdict"]) == (0, "mistake")
    assert "point 8" in out
    keeps_to("diagnose-free", result)
    assert result["corrected"]["used"] == 47
    assert bench("diagnose", result["corrected"]["readings"], "--json", "again.json")[0] == 0
    again = json.loads(Path("again.json").read_text(encoding="utf-8"))
    assert again["verdict"] == "agrees"
    assert again["noise"]["reading"] == pytest.approx(result["noise"]["reading"])


@pytest.mark.slow
def test_several_sources_keep_their_order_and_say_what_was_left_out_and_which_failed(bench, monkeypatch):
    """In a process of its own, as on a machine with one core; two of the four cannot be read."""
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    names = [measured("b.csv", 3), "none.csv", measured("bad.csv", 3), measured("a.csv", 1, warm_g=6e-3)]
    lines = Path("b.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    lines[5] = lines[5].replace("F,1,5", "F,1,nan", 1)
    Path("b.csv").write_text("".join(lines), encoding="utf-8")
    Path("bad.csv").write_text("".join(lines).replace("installation,", "mounting,", 1), encoding="utf-8")
    status, out, err = bench("diagnose", *names, "--skip-bad-rows", "--json", "all.json")
    assert status == 2
    assert "47 free positions" in out
    first, none, bad, last = json.loads(Path("all.json").read_text(encoding="utf-8"))
    assert [f["source"] for f in (first, last)] == ["b.csv", "a.csv"]
    assert [f["verdict"] for f in (first, last)] == ["agrees", "confounded"]
    assert [f["report"] for f in (first, last)] == [None] * 2
    for one in (none, bad):
        keeps_to("source-failed", one)
    for one in (first, last):
        keeps_to("diagnose-free", one)
    assert none["problem"] == "none.csv: no such readings file; check the name"
    assert "bad.csv, line 1: the header lacks installation" in err
    assert err.splitlines()[-1] == "bench: 2 of 4 sources could not be evaluated"


def test_a_folder_that_cannot_be_made_costs_the_files_and_not_the_result(bench):
    Path("diagnose").write_text("a file where the folder would be", encoding="utf-8")
    name = measured("warm.csv", 1, warm_g=6e-3)
    status, _, err = bench("diagnose", name, "--no-report", "--accept-first", "--json", "d.json")
    found = json.loads(Path("d.json").read_text(encoding="utf-8"))
    assert (status, found["verdict"], found["model"]) == (0, "confounded", None)
    assert "use --out DIR" in err
    refused(bench("diagnose", name, "--no-report", "--out", "diagnose"), "diagnose")


@pytest.mark.slow
def test_files_of_several_records_stand_beside_the_first_of_them(bench):
    Path("one").mkdir()
    Path("two").mkdir()
    measured("one/a.csv", 6)
    measured("two/b.csv", 7)
    out = printed(bench("diagnose", "one/a.csv", "two/b.csv", "--together"))
    assert Path("one/diagnose-together/a+b.html").is_file(), out
    assert sorted(path.name for path in Path().iterdir()) == ["one", "two"]


@pytest.mark.slow
def test_from_python_it_is_the_same(bench, named):
    result = program.diagnose("warm.csv")
    assert isinstance(result, program.FreeDiagnosisResult)
    assert result.verdict == named["verdict"]
    assert result.to_dict()["gap"] == named["gap"]
    result.report("here.html")
    assert Path("here.html").is_file()
    assert "warm_up" in repr(result)
    assert [path.name for path in result.write_model("mine.yaml", accept_first=True)] == ["mine.yaml"]
    with pytest.raises(program.Refused, match="no model file was written"):
        program.diagnose(measured("cold.csv", 3)).write_model("none.yaml")
    pair = ["warm.csv", measured("more.csv", 8, warm_g=6e-3)]
    for one_block, sensors, records in ((True, 1, 2), (False, 2, 1)):
        both = program.diagnose(pair, one_block=one_block)
        assert (both.found.rows.sensors, both.found.records) == (sensors, records)
