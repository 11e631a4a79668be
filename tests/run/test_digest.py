"""What is kept of runs that were read: it saves reading them again, and never changes what is told."""

import json
import os
from datetime import UTC, datetime, timedelta

import pytest

from bench.run import folder as digest_module
from bench.run.events import EVENTS
from bench.run.folder import Digest, Digests, Run
from bench.run.record import Record

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def later():
    return datetime.now(tz=UTC) + timedelta(minutes=1)


@pytest.fixture
def runs(tmp_path):
    record = Record.create(tmp_path / "runs" / "a", {"name": "a"}, {"plan.json": b"{}"}, lambda: NOON)
    record.append("run_started", 0.0, step=0, instruments={})
    record.append("run_finished", 1.0)
    record.close()
    return tmp_path / "runs"


@pytest.fixture
def read(monkeypatch):
    """How often a run was read."""
    times = []
    of = Digest.of
    monkeypatch.setattr(digest_module.Digest, "of", lambda run: times.append(run.name) or of(run))
    return times


def look(runs, cache, now=later):
    digests = Digests(runs, cache, now)
    found = digests.of(Run(runs / "a"))
    digests.save()
    return found


def test_a_run_is_read_once(runs, tmp_path, read):
    first = look(runs, tmp_path / "cache")
    assert (first.state, first.readings, first.problems) == ("finished", 0, ())
    assert look(runs, tmp_path / "cache") == first
    assert read == ["a"]


@pytest.mark.parametrize("name", [EVENTS, "plan.json", "run.json"])
def test_a_changed_file_is_seen_even_with_its_size_and_time_put_back(runs, tmp_path, name):
    assert look(runs, tmp_path / "cache").problems == ()
    file = runs / "a" / name
    before = file.stat()
    content = file.read_bytes()
    file.write_bytes(
        {
            "plan.json": b"[]",
            "run.json": content.replace(b"\n", b" "),
            EVENTS: content[:1] + b"#" + content[2:],
        }[name]
    )
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert file.stat().st_size == before.st_size
    assert look(runs, tmp_path / "cache") == Digest.of(Run(runs / "a"))
    assert look(runs, tmp_path / "cache").problems != ()


def test_a_removed_input_is_seen(runs, tmp_path):
    look(runs, tmp_path / "cache")
    (runs / "a" / "plan.json").unlink()
    assert look(runs, tmp_path / "cache").problems == ("plan.json was changed since the run began",)


def test_what_was_written_a_moment_ago_is_not_kept(runs, tmp_path, read):
    for _ in range(2):
        look(runs, tmp_path / "cache", lambda: datetime.now(tz=UTC))
    assert read == ["a", "a"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: "[" * 100_000,
        lambda text: text[:-3],
        lambda text: text.replace("finished", "aborted"),
        lambda text: text.replace('"format": 1', '"format": 0'),
    ],
)
def test_a_damaged_cache_changes_nothing(runs, tmp_path, damage):
    first = look(runs, tmp_path / "cache")
    (file,) = (tmp_path / "cache").iterdir()
    file.write_text(damage(file.read_text()))
    assert look(runs, tmp_path / "cache") == first


@pytest.mark.parametrize(
    "entry", [None, [], {"stamp": None}, {"stamp": [[]]}, {"stamp": [], "state": "none"}]
)
def test_a_cache_of_other_things_changes_nothing(runs, tmp_path, entry):
    first = look(runs, tmp_path / "cache")
    (file,) = (tmp_path / "cache").iterdir()
    text = json.dumps({"a": entry})
    head = {"format": 1, "sha256": digest_module.sha256(text.encode())}
    file.write_text(json.dumps(head) + "\n" + text)
    assert look(runs, tmp_path / "cache") == first


def test_where_nothing_can_be_kept_the_runs_are_told_all_the_same(runs, tmp_path, read):
    (tmp_path / "cache").write_text("a file where the folder would be")
    first = look(runs, tmp_path / "cache")
    assert look(runs, tmp_path / "cache") == first
    assert read == ["a", "a"]
