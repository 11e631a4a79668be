"""The schemas of results: real results keep to them, and hold nothing that they do not name."""

import json
import shutil
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

import bench as program
from bench.validation.registry import REFERENCE
from docs.generators.schemas import RESULTS
from tests.support.pages import ROOT
from tests.support.schemas import keeps_to, validator

DATA = ROOT / "tests" / "data"


@pytest.fixture
def finished(empty_folder):
    """A run of a version before; its results are made by this one."""
    shutil.copytree(DATA / "records" / "finished", "runs/finished")
    return "finished"


@pytest.mark.parametrize("name", RESULTS)
def test_a_schema_is_one_and_describes_what_it_is_of(name):
    Draft202012Validator.check_schema(validator(name).schema)
    assert validator(name).schema["title"]
    assert validator(name).schema["description"].endswith(".")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("calibrate", "calibrate finished --estimator robust --join-verification"),
        ("calibrate", f"calibrate {REFERENCE / 'xsens-38.csv'} --g 9.81744 --out here"),
        ("budget", "budget --procedure quick --trials 2200"),
        ("require", "require --accuracy 3e-4 --procedure quick"),
        ("plan-points", "plan-points --u all=2e-4"),
        ("check", "check quick"),
        ("runs", "runs"),
        ("show", "show finished --verify"),
        ("compare", "compare finished finished"),
    ],
)
def test_a_real_result_keeps_to_its_schema(bench, finished, name, command):
    status, _, err = bench(*command.split(), "--json", "result.json")
    assert status < 2, err
    keeps_to(name, json.loads(Path("result.json").read_text(encoding="utf-8")))


def test_the_lines_of_a_record_keep_to_their_schema(finished):
    lines = (DATA / "records" / "finished" / "events.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(lines) > 50
    for line in lines:
        keeps_to("event", json.loads(line))


def test_a_member_that_no_schema_names_is_noticed():
    found = program.calibrate(str(DATA / "records" / "readings.csv")).to_dict()
    result = json.loads(json.dumps(found))
    keeps_to("calibrate", result)
    assert not validator("calibrate").is_valid(result | {"surprise": 1})
    del result["covariance"]
    assert not validator("calibrate").is_valid(result)
