"""`bench diagnose` as its user types it: find, add, show, and what the next command makes of the model."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bench as program
from bench.config.model_file import load_model
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.pipeline import MistakesAlone
from bench.model.geometry import COEFFICIENTS
from bench.readings.csv import write_csv
from bench.services.bodies import body_of
from bench.services.diagnosis import MistakesResult
from bench.services.source import Request, load_sources
from tests.support import diagnosis_bench
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to

BOTH_WAYS = (1, -1, 1)
HIDDEN = """\
model_file: 1
name: hidden
effects:
  - {name: bias_drift, channels: [y], parameters: {rate: 250 ug/h}}
"""


def measured(name, seed, **hidden):
    """Write a readings file of the independent simulation in bench/validation/paper_bench.py."""
    write_csv(
        diagnosis_bench.paper_run(np.random.default_rng(seed), directions=BOTH_WAYS, **hidden), Path(name)
    )
    return name


def refuse(constant):
    raise AssertionError(f"{constant} in JSON")


def result_of(path):
    return json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=refuse)


@pytest.mark.slow
def test_an_effect_hidden_in_a_dry_run_is_named_added_and_the_gap_shrinks(bench):
    Path("hidden.yaml").write_text(HIDDEN, encoding="utf-8")
    run = bench("run", "calibration", "--dry-run", "--model", "hidden.yaml", "--name", "a", "--seed", 5)
    assert run[0] == 1
    status, out, err = bench("diagnose", "a", "--strict", "--json", "a.json")
    assert (status, err) == (1, "")
    found = result_of("a.json")
    assert found["verdict"] == "named"
    (effect,) = found["effects"]
    assert (effect["name"], effect["channels"]) == ("bias_drift", ["y"])
    rate = effect["parameters"]["rate"]["y"]
    assert abs(rate["value"] - 250) < 4 * rate["u"]
    assert "Found: bias_drift of y" in out
    first, *rest = effect["odds"]
    assert first["name"] == "bias_drift"
    assert (
        0.95 <= first["probability"] <= first["probability"] + sum(o["probability"] for o in rest) <= 1 + 1e-9
    )
    assert re.search(r"FOUND AND NAMED: bias_drift of y \((> )?\d+ % bias_drift", out.splitlines()[-1])
    # the gap closes on readings that were not used, and the simulated bench is like the real one
    assert found["gap"]["before"] > 2
    assert abs(found["gap"]["after"] - 1) < 0.25
    assert found["simulation"]["before"]["p"] < 1e-4
    assert found["simulation"]["after"]["p"] > 0.01
    model = load_model(Path(found["model"]))
    assert found["model"] == str(Path("runs/a/diagnose-model.yaml"))
    assert (model.parent, [e.name for e in model.effects]) == ("paper", ["bias_drift"])
    printed(
        bench("calibrate", "a", "--model", found["model"], "--strict", "--json", "after.json"),
        "estimated again",
    )
    assert result_of("after.json")["residual"]["p"] > 0.01
    page = Path(found["report"]).read_text(encoding="utf-8")
    assert "bias_drift" in page
    assert "SIMULATED" in page


@pytest.mark.slow
def test_readings_without_an_effect_agree_and_strict_accepts_them(bench):
    # JSON alone goes to standard output, what a person reads beside it
    lines = Path(measured("null.csv", 3)).read_text(encoding="utf-8").splitlines(keepends=True)
    lines[5] = lines[5].replace("1,1,5", "1,1,nan", 1)
    Path("null.csv").write_text("".join(lines), encoding="utf-8")
    asked = ("diagnose", "null.csv", "--skip-bad-rows", "--strict", "--no-report", "--json", "-")
    status, out, told = bench(*asked)
    found = json.loads(out, parse_constant=refuse)
    assert "left out: null.csv, line 6, column point" in " ".join(told.split())
    assert (status, found["verdict"], found["effects"], found["model"]) == (0, "agrees", [], None)
    assert "NOTHING FOUND" in told
    assert "quadratic_nonlinearity" in told  # the smallest size that would have shown
    assert "voltmeter_gain" in found["hidden"]
    assert found["simulation"]["after"] is None


@pytest.fixture(scope="module")
def day_before(tmp_path_factory):
    """A folder with readings of a block with a K2, and what was found in them, with a model file of it."""
    folder = tmp_path_factory.mktemp("first")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("BENCH_FILE", raising=False)
        found = program.diagnose(measured("first.csv", 4, K2=(0, 100e-6, 0)))
        assert [path.name for path in Path().iterdir()] == ["first.csv"]  # nothing is written unasked
        found.written(report=False)
    return folder, found


@pytest.fixture
def first(bench, day_before):
    shutil.copytree(day_before[0], ".", dirs_exist_ok=True)
    return "first.csv"


@pytest.mark.slow
def test_a_model_of_one_day_serves_on_another_and_is_never_overwritten(bench, first, day_before):
    written = Path("diagnose/first-model.yaml").read_bytes()
    assert day_before[1].written(report=False).files.model == Path("diagnose/first-model-2.yaml")
    assert Path("diagnose/first-model.yaml").read_bytes() == written
    written = sorted(path.name for path in Path("diagnose").glob("*-model*.yaml"))
    assert written == ["first-model-2.yaml", "first-model.yaml"]
    model = Path("diagnose/first-model.yaml")
    # on the next day the value of the first is known, with its u: the two together know it better
    second = measured("second.csv", 5, K2=(0, 100e-6, 0))
    u = {}
    for name in (first, second):
        out = printed(bench("calibrate", name, "--model", model, "--strict", "--json", "c.json"))
        assert ("estimated again" in out) is (name == first)
        k2 = result_of("c.json")["effects"]["quadratic_nonlinearity.K2[y]"]
        assert abs(k2["value"] - 100) < 4 * k2["u"]
        u[name] = k2["u"]
    assert u[second] / u[first] == pytest.approx(1 / np.sqrt(2), rel=0.2)


@pytest.mark.slow
def test_in_python_what_is_found_is_written_where_it_is_asked_for(first, day_before):
    found = day_before[1]
    assert (found.verdict, found.to_dict()["model"]) == ("named", None)
    assert load_model(found.write_model("mine.yaml")).effects[0].name == "quadratic_nonlinearity"
    with pytest.raises(program.FileMistakes, match="exists and was not overwritten"):
        found.write_model("mine.yaml")
    assert found.report("page.html").is_file()
    if found.next_measurement is not None:
        assert found.write_next("next.yaml").read_text(encoding="utf-8").startswith("# Proposed: ")


@pytest.mark.slow
def test_what_is_there_again_is_confirmed_and_what_confirms_nothing_is_refused(bench, first):
    Path("mine.yaml").write_text(
        "model_file: 1\nname: found\neffects:\n  - name: quadratic_nonlinearity\n    channels: [y]\n"
        "    parameters: {K2: {y: {value: 100 ug/g^2, u: 5 ug/g^2}}}\n", encoding="utf-8",
    )  # fmt: skip
    write_csv(diagnosis_bench.paper_run(np.random.default_rng(71), K2=(0, 100e-6, 0)), Path("new.csv"))
    status, out, err = bench("confirm", "new.csv", "--model", "mine.yaml", "--json", "c.json")
    result = result_of("c.json")
    assert (status, err, result["verdict"]) == (0, "", "confirmed")
    keeps_to("confirm", result)
    assert f"new.csv: CONFIRMED: gap closed {min(100 * result['closed'], 100):.0f} %, from " in out
    assert "quadratic_nonlinearity[y]: confirmed" in out
    assert program.confirm("new.csv", model="mine.yaml").to_dict() == result
    same = "the model was found in these same readings (first.csv), which cannot confirm it; measure new readings"
    refused(bench("confirm", first, "--model", "diagnose/first-model.yaml"), same)
    Path("empty.yaml").write_text("model_file: 1\nname: nothing\n", encoding="utf-8")
    refused(bench("confirm", first, "--model", "empty.yaml"), "the model has no effects")


@pytest.mark.slow
def test_a_child_has_the_effects_of_its_parent_and_what_was_found_beside_them(bench, first):
    parent = load_model(Path("diagnose/first-model.yaml"))
    second = measured("second.csv", 5, K2=(0, 100e-6, 0), drift_v_per_h=(3e-4, 0, 0))
    model = "diagnose/first-model.yaml"
    assert bench("diagnose", second, "--model", model, "--no-report", "--json", "d.json")[0] == 0
    found = result_of("d.json")
    assert [e["name"] for e in found["effects"]] == ["bias_drift"]
    child = load_model(Path(found["model"]))
    assert [e.name for e in child.effects] == ["quadratic_nonlinearity", "bias_drift"]
    assert child.parent == parent.name
    k2 = child.applied_effects()[0]
    assert abs(k2.values["K2"][1] - 100e-6) < 4 * k2.u["K2"][1]
    assert k2.u["K2"][1] < parent.applied_effects()[0].u["K2"][1]
    # both days have given something to it: neither may be taken as new to it
    for name in (first, second):
        assert "estimated again" in bench("calibrate", name, "--model", found["model"])[1]


@pytest.mark.slow
def test_what_the_data_cannot_tell_is_added_only_when_asked(bench):
    # no input was shorted: the zero of the voltmeters drifts, or the biases of all three channels alike
    measured("tie.csv", 7, drift_v_per_h=(1e-4, 1e-4, 1e-4))
    result = program.diagnose("tie.csv", write=True, report=False)
    found = result.to_dict()
    assert found["verdict"] == "confounded"
    (effect,) = found["effects"]
    assert {effect["name"], *effect["cannot_tell_from"]} >= {"voltmeter_drift", "bias_drift"}
    assert found["model"] is None
    model = load_model(result.written(accept_first=True, report=False).files.model)
    assert [e.name for e in model.effects] == [effect["name"]]
    assert "cannot tell" in " ".join(model.evidence.values())


@pytest.mark.slow
def test_together_they_are_one_body_of_data(bench):
    names = [measured(f"{seed}.csv", seed, K2=(0, 60e-6, 0)) for seed in (4, 5)]
    assert bench("diagnose", *names, "--together", "--no-report", "--json", "d.json")[0] == 0
    found = result_of("d.json")
    assert [e["name"] for e in found["effects"]] == ["quadratic_nonlinearity"]
    k2 = found["effects"][0]["parameters"]["K2"]["y"]
    assert abs(k2["value"] - 60) < 4 * k2["u"]
    assert found["source"] == "4.csv + 5.csv"
    assert any("series 2" in note for note in found["notes"])
    model = load_model(Path(found["model"]))
    assert len((model.data_sha256 or "").split()) == 2
    assert "estimated again" in bench("calibrate", names[1], "--model", found["model"])[1]


@pytest.mark.slow
def test_the_search_goes_on_in_the_copy_and_its_model_says_on_which_correction_it_rests(bench):
    right = diagnosis_bench.paper_run(np.random.default_rng(4), directions=BOTH_WAYS, K2=(0, 150e-6, 0))
    signal = right.signal.copy()
    signal[20, 0] += 2e-3
    write_csv(replace(right, signal=signal), Path("both.csv"))
    before = Path("both.csv").read_bytes()
    status, out, _ = bench("diagnose", "both.csv", "--strict", "--no-report", "--json", "d.json")
    found = result_of("d.json")
    assert (status, found["verdict"], found["corrected"]["verdict"]) == (1, "mistake", "named")
    assert "Mistake: outlier" in out
    assert Path("both.csv").read_bytes() == before
    assert [e["name"] for e in found["effects"]] == ["outlier", "quadratic_nonlinearity"]
    copy, model = found["corrected"]["readings"], load_model(Path(found["model"]))
    assert (copy, found["corrected"]["used"]) == (str(Path("diagnose/both-corrected.csv")), len(right) - 1)
    assert copy in model.evidence["rests on"]
    assert found["effects"][0]["words"] in model.evidence["rests on"]
    # the copy is a readings file like any other, and the model has seen it
    assert "estimated again" in bench("calibrate", copy, "--model", found["model"])[1]


@pytest.mark.slow
def test_the_copy_of_a_run_stands_in_its_folder_and_tells_where_it_comes_from(bench, paper_run):
    """As a diagnosis writes it that left out one reading of the run."""
    (source,) = load_sources(Request(["run"], Path("runs")))
    mistake = Mistake("outlier", ("x",), ("1",), None, None, "one reading is off", 1e-9, ())
    left = source.readings.select(np.arange(len(source.readings)) != 20)
    found = MistakesAlone("run", True, (mistake,), left, "it ends here")
    copy = MistakesResult(body_of([source]), found).written().to_dict()["corrected"]["readings"]
    assert copy == str(Path("runs/run/diagnose-corrected.csv"))
    printed(bench("calibrate", copy, "--json", "c.json"), "with corrected mistakes: one reading is off")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.csv"], "none.csv: no such readings file"),
        (["null.csv", "--json", "nowhere/d.json"], "no such folder; create it or name another"),
        (["null.csv", "--model", "null.csv"], "null.csv"),
        (["null.csv", "counts.csv", "--together"], "evaluate the files of each unit separately"),
        (["null.csv", "null.csv"], "two sources would write"),
        (["null.csv", "copy.csv", "--together"], "copy.csv: has the same readings as null.csv"),
        (["short.csv"], "short.csv, line 1: the header lacks"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(bench, arguments, message):
    measured("null.csv", 3)
    text = Path("null.csv").read_text(encoding="utf-8")
    Path("counts.csv").write_text(text.replace("_v", "_counts"), encoding="utf-8")
    Path("copy.csv").write_text(text, encoding="utf-8")
    Path("short.csv").write_text("installation,pass\n1,1\n", encoding="utf-8")
    refused(bench("diagnose", *arguments), message)


@pytest.mark.slow
def test_of_several_blocks_all_are_told(bench):
    """Scale factors 1 % apart: coefficients of both stand in the terminal and on the page, each its own."""
    write_csv(diagnosis_bench.paper_run(np.random.default_rng(21)), Path("first.csv"))
    other = diagnosis_bench.paper_run(np.random.default_rng(22))
    write_csv(replace(other, signal=other.signal * 1.01), Path("second.csv"))
    out = printed(bench("diagnose", "first.csv", "second.csv", "--together", "--json", "d.json"))
    found = result_of("d.json")
    table = out[out.index("Coefficients of each block") :].splitlines()
    assert ["1:" in table[1], "2:" in table[1]] == [True, True]
    assert [line.split()[0] for line in table[2:15]] == [*COEFFICIENTS, "p"]
    assert all(len(line.split()) == 3 for line in table[2:15])
    assert len(found["blocks"]) == 2
    page = Path(found["report"]).read_text(encoding="utf-8")
    for number in (1, 2):
        assert f"Block {number}: mountings" in page
    of_each = [block["coefficients"]["Kxx"]["after"] for block in found["blocks"]]
    assert of_each[1] / of_each[0] == pytest.approx(1.01, abs=1e-4)


def test_what_too_little_is_left_of_is_written_as_a_copy(bench):
    name = measured("r.csv", 23)
    (source,) = load_sources(Request([name], Path("runs")))
    mistake = Mistake("other_mounting", (), ("1",), None, None, "it sat otherwise", 1e-9, ())
    left = source.readings.select(np.arange(len(source.readings)) < 5)
    found = MistakesAlone(name, False, (mistake,), left, "5 readings are too few")
    written = MistakesResult(body_of([source]), found).written()
    assert "5 readings are too few" in repr(written)
    result = written.to_dict()
    keeps_to("diagnose", result)
    assert result["corrected"] | {"rests_on": []} == {
        "readings": "diagnose/r-corrected.csv", "used": 5, "verdict": None, "rests_on": [],
    }  # fmt: skip
    assert len(load_sources(Request(["diagnose/r-corrected.csv"], Path("runs")))[0].readings) == 5


@pytest.mark.slow
def test_a_block_that_was_not_remounted_is_named_though_the_rest_determines_too_little(bench):
    taken, again = (diagnosis_bench.paper_run(np.random.default_rng(seed)) for seed in (24, 25))
    signal = taken.signal.copy()
    signal[taken.installation == "2"] = again.signal[again.installation == "1"]
    write_csv(replace(taken, signal=signal), Path("r.csv"))
    status, out, _ = bench("diagnose", "r.csv", "--json", "d.json")
    assert status == 0
    assert "A MISTAKE IN PROCEDURE OR WIRING" in out.splitlines()[-1]
    found = result_of("d.json")
    keeps_to("diagnose", found)
    assert found["verdict"] == "mistake"
    assert [one["name"] for one in found["effects"]] == ["swapped_installations"]
    assert found["corrected"]["verdict"] is None
    assert any("do not determine" in note for note in found["notes"])


def test_the_simulated_bench_refuses_what_it_cannot_have(bench):
    Path("slip.yaml").write_text(
        "model_file: 1\nname: slip\neffects:\n"
        "  - name: quadratic_nonlinearity\n    installations: ['1 pass 2']\n"
        "    parameters: {K2: 50 ug/g^2}\n",
        encoding="utf-8",
    )
    refused(
        bench("run", "quick", "--dry-run", "--name", "s", "--model", "slip.yaml"),
        "quadratic_nonlinearity of 1 pass 2: the simulated bench cannot have an effect in single passes",
    )
    assert not Path("runs/s").exists()
