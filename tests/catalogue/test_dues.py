"""When many units are due: as one by one, kept, and forgotten where a run of a unit changes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from bench.catalogue import unit
from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.catalogue.unit import due_units, unit_history
from tests.support.laboratory import write_run

DAYS = ("2023-01-10", "2024-01-12", "2025-01-09", "2026-01-11")


@pytest.fixture
def catalogue(empty_folder, monkeypatch):
    monkeypatch.setattr("bench.catalogue.sync.SETTLED_NS", -(10**15))
    for serial in ("1", "2"):
        for day in DAYS[:3]:
            write_run(Path("runs") / f"{serial}-{day}", serial=serial, created=f"{day}T08:00:00+00:00")
    write_run(Path("runs") / "bare", serial="3", created=f"{DAYS[0]}T08:00:00+00:00")
    with open_catalogue("there.sqlite") as opened:
        sync(opened, ["runs"])
        yield opened


def counts(catalogue, **asked):
    found = due_units(catalogue, [], **asked)
    return {one.unit: one.calibrations for one in found.units}, found.not_known


def test_units_are_due_as_one_by_one(catalogue):
    asked = {"limit_g": 5e-4, "interval_days": 100.0}
    found = due_units(catalogue, [], **asked)
    names = [one.unit for one in found.units]
    alone = [unit_history(catalogue, name, **asked).due.to_dict() for name in names]
    assert [one.to_dict() for one in found.units] == [
        {**due, "unit": name} for name, due in zip(names, alone, strict=True)
    ]
    assert [one.due for one in found.units] == sorted(one.due for one in found.units)
    assert {one.basis for one in found.units} == {"drift", "interval"}
    assert (len(names), found.not_known) == (3, {})
    assert [one.unit for one in due_units(catalogue, ["serial=2"], limit_g=5e-4).units] == ["block A 2"]


def test_what_was_reckoned_is_kept_until_a_run_of_the_unit_changes(catalogue, monkeypatch):
    before, _ = counts(catalogue, limit_g=5e-4)
    assert before == {"block A 1": 3, "block A 2": 3, "block A 3": 1}
    reckoned = []
    whole = unit.due_of

    def counted(table, *rest, **more):
        reckoned.append(len(table))
        return whole(table, *rest, **more)

    monkeypatch.setattr(unit, "due_of", counted)
    assert counts(catalogue, limit_g=5e-4)[0] == before
    assert reckoned == []
    # another limit is another question
    counts(catalogue, limit_g=1e-3)
    assert sorted(reckoned) == [1, 3, 3]
    reckoned.clear()

    write_run(Path("runs") / "new", serial="2", created=f"{DAYS[3]}T08:00:00+00:00")
    sync(catalogue, ["runs"])
    assert counts(catalogue, limit_g=5e-4)[0] == {**before, "block A 2": 4}
    assert reckoned == [4]
    reckoned.clear()

    shutil.move("runs/new", "away")
    sync(catalogue, ["runs"])
    assert counts(catalogue, limit_g=5e-4)[0] == before
    shutil.move("away", "runs/new")
    sync(catalogue, ["runs"])
    assert counts(catalogue, limit_g=5e-4)[0]["block A 2"] == 4
    assert reckoned == [3, 4]


def test_a_run_that_comes_while_it_is_reckoned_is_not_lost(catalogue, monkeypatch):
    whole = unit.due_of

    def meanwhile(table, *rest, **more):
        if not Path("runs/new").exists():
            write_run(Path("runs") / "new", serial="1", created=f"{DAYS[3]}T08:00:00+00:00")
            sync(catalogue, ["runs"])
        return whole(table, *rest, **more)

    monkeypatch.setattr(unit, "due_of", meanwhile)
    assert counts(catalogue, limit_g=5e-4)[0]["block A 1"] == 3
    # what was reckoned without the new run was not kept
    assert counts(catalogue, limit_g=5e-4)[0]["block A 1"] == 4


def test_processes_reckon_the_same(catalogue, monkeypatch):
    here = due_units(catalogue, [], limit_g=4e-4)
    monkeypatch.setattr("bench.catalogue.unit.FEW", 0)
    monkeypatch.setattr("bench.catalogue.unit.METHOD", 0)  # nothing is kept of it
    assert due_units(catalogue, [], limit_g=4e-4, processes=2) == here


def test_after_a_sync_with_due_nobody_waits(catalogue, bench, monkeypatch):
    status, _, err = bench("catalogue", "sync", "runs", "--due", "--catalogue", "there.sqlite")
    assert (status, err) == (0, "")
    monkeypatch.setattr(unit, "due_of", None)
    found = due_units(catalogue, [])
    assert len(found.units) + len(found.not_known) == 3
