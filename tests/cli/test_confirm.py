"""`bench confirm` as its user types it, and from Python."""

import json
from pathlib import Path

import numpy as np
import pytest

import bench as program
from bench.readings.csv import write_csv
from tests.support.commands import printed, refused
from tests.support.diagnosis_bench import paper_run
from tests.support.schemas import keeps_to

MODEL = """\
model_file: 1
name: found
effects:
  - {name: quadratic_nonlinearity, channels: [y], parameters: {K2: {y: {value: 100 ug/g^2, u: 5 ug/g^2}}}}
"""


@pytest.fixture(autouse=True)
def found(empty_folder):
    Path("found.yaml").write_text(MODEL, encoding="utf-8")


def measured(name, seed, k2):
    write_csv(paper_run(np.random.default_rng(seed), K2=(0.0, k2, 0.0)), Path(name))
    return name


@pytest.mark.slow
def test_what_is_there_again_is_confirmed(bench):
    status, out, err = bench(
        "confirm", measured("new.csv", 71, 100e-6), "--model", "found.yaml", "--json", "c.json"
    )
    result = json.loads(Path("c.json").read_text(encoding="utf-8"))
    assert (status, err, result["verdict"]) == (0, "", "confirmed")
    keeps_to("confirm", result)
    assert f"new.csv: CONFIRMED: gap closed {min(100 * result['closed'], 100):.0f} %, from " in out
    assert "quadratic_nonlinearity[y]: confirmed" in out
    assert program.confirm("new.csv", model="found.yaml").to_dict() == result
    # what is gone is not accepted
    printed(
        bench("confirm", measured("clean.csv", 72, 0.0), "--model", "found.yaml"),
        "clean.csv: GONE: ",
        status=1,
    )


def test_what_confirms_nothing_is_refused(bench):
    from bench.services.source import Request, data_sha256, load_sources

    name = measured("first.csv", 73, 100e-6)
    (source,) = load_sources(Request([name], Path("runs")))
    Path("own.yaml").write_text(MODEL + f"data_sha256: {data_sha256(source.as_read)}\n", encoding="utf-8")
    refused(
        bench("confirm", name, "--model", "own.yaml"),
        "own.yaml: it was found in these same readings (first.csv), which cannot confirm it; measure new ones",
    )
    Path("empty.yaml").write_text("model_file: 1\nname: nothing\n", encoding="utf-8")
    refused(bench("confirm", name, "--model", "empty.yaml"), "it has no effects")


@pytest.mark.slow
def test_in_python_what_is_found_becomes_a_model_that_new_readings_confirm(empty_folder):
    found = program.diagnose(measured("first.csv", 74, 100e-6))
    assert (found.verdict, found.to_dict()["model"]) == ("named", None)
    assert [path.name for path in Path().iterdir() if path.suffix != ".csv"] == ["found.yaml"]
    model = found.write_model("mine.yaml")
    assert program.confirm(measured("again.csv", 75, 100e-6), model=model).verdict == "confirmed"
    assert found.report("page.html").is_file()
    with pytest.raises(program.FileMistakes, match="exists and was not overwritten"):
        found.write_model("mine.yaml")
    written = found.written()
    assert written.to_dict()["model"] == str(Path("diagnose/first-model.yaml"))
    assert Path("diagnose/first.html").is_file()
    if found.next_measurement is not None:
        assert found.write_next("next.yaml").read_text(encoding="utf-8").startswith("# Proposed: ")
