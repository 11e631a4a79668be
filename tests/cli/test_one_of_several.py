"""Several sources of which one cannot be evaluated: it is named, the others are done, and the status is 2."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.support.schemas import keeps_to

READINGS = Path(__file__).parents[1] / "data" / "records" / "readings.csv"


@pytest.fixture
def files(empty_folder):
    names = ["a.csv", "bad.csv", "c.csv"]
    for name in names:
        shutil.copy(READINGS, name)
    text = READINGS.read_text(encoding="utf-8")
    Path("bad.csv").write_text(text.replace("installation,", "mounting,", 1), encoding="utf-8")
    return names


@pytest.mark.parametrize("command", ["calibrate", "verify", "diagnose"])
@pytest.mark.slow
def test_the_others_are_done_in_their_order(bench, files, command):
    status, _, err = bench(command, *files, "none.csv", "--json", "all.json")
    assert status == 2
    a, bad, c, none = json.loads(Path("all.json").read_text(encoding="utf-8"))
    assert bad["source"] == "bad.csv"
    assert "column installation is missing" in bad["problem"]
    assert none == {"source": "none.csv", "problem": "none.csv: no such readings file; check the name"}
    for one in (bad, none):
        keeps_to("source-failed", one)
    for one in (a, c):
        keeps_to(command, one)
    assert a.keys() == c.keys()
    assert "problem" not in a
    told = [line for line in err.splitlines() if line.startswith("bench: ")]
    assert told[0].startswith("bench: bad.csv, line 1: column installation is missing")
    assert told[-1] == "bench: 2 of 4 sources could not be evaluated"


def test_what_is_wrong_with_all_is_told_once(bench, files):
    status, _, err = bench("calibrate", "a.csv", "c.csv", "--bench", "none.yaml")
    assert status == 2
    assert err.count("\n") == 1
    assert "none.yaml" in err


def test_one_alone_is_told_as_ever(bench, files):
    status, _, err = bench("calibrate", "bad.csv", "--json", "one.json")
    assert status == 2
    assert err.count("bench: ") == 1
    assert not Path("one.json").exists()
