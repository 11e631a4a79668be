"""The register of failures: collected once from records, amended by persons, shown for a year."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from bench.run.events import Event
from bench.validation.failures import _in_record
from tests.support.certificates import RECORDED, copy_run, write_files
from tests.support.commands import printed, refused
from tests.support.schemas import keeps_to


@pytest.fixture
def call(bench, monkeypatch):
    """Call the command over a finished, an interrupted and a damaged run."""
    monkeypatch.delenv("BENCH_LABORATORY", raising=False)
    laboratory, _ = write_files(Path())
    Path("runs").mkdir()
    copy_run(Path("runs"))
    shutil.copytree(RECORDED.with_name("interrupted"), "runs/interrupted")
    damaged = copy_run(Path("runs"), "damaged") / "events.jsonl"
    lines = damaged.read_bytes().splitlines(keepends=True)
    damaged.write_bytes(b"".join([*lines[:9], *lines[10:]]))
    return lambda *arguments: bench("failures", "--laboratory", laboratory, *arguments)


def test_failures_are_collected_once(call):
    first = printed(call("--json", "first.json"))
    result = json.loads(Path("first.json").read_text(encoding="utf-8"))
    keeps_to("failures", result)
    assert {(one["run"], one["kind"]) for one in result["failures"]} >= {
        ("interrupted", "run_interrupted"),
        ("damaged", "damaged"),
    }
    assert "finished" not in {one["run"] for one in result["failures"]}
    assert f"{result['collected']} of them new" in first
    assert "0 of them new" in printed(call())
    printed(call("--year", 1999, "--json", "none.json"))
    assert json.loads(Path("none.json").read_text(encoding="utf-8"))["failures"] == []


def test_a_bench_that_was_not_left_safe_is_one_line():
    tasks = {"chamber": "switch it off by hand", "head": "check that it stands still"}
    left = Event(7, "t", 0.0, "left_safe", {"to_do": tasks})
    (found,) = _in_record(SimpleNamespace(history=SimpleNamespace(events=[left], problems=[])))
    assert found["said"] == (
        "still to do: chamber: switch it off by hand; still to do: head: check that it stands still"
    )


@pytest.mark.slow
def test_persons_note_state_and_remedy_and_only_the_authorised_close(call):
    printed(call())
    number = next(word for word in printed(call()).split() if word.startswith("F2"))
    note = ("--number", number, "--remedy", "the cable was loose; replaced")
    refused(call(*note), "a remedy needs --state, --by NAME")
    refused(
        call("--number", "F1", "--state", "closed", "--remedy", "x", "--by", "A. Example"),
        "no failure of that number",
    )
    assert "remedied" in printed(call(*note, "--state", "remedied", "--by", "B. Technician"))
    refused(
        call(*note, "--state", "closed", "--by", "B. Technician"), "--by B. Technician", "choose one of them"
    )
    printed(call(*note, "--state", "closed", "--by", "A. Example", "--page", "review.html"), "review.html")
    page = Path("review.html").read_text(encoding="utf-8")
    assert "the cable was loose; replaced" in page
    assert "B. Technician" in page
    assert number not in printed(call())
