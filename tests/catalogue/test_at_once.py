"""Two syncs at once lose nothing, and one that was ended goes on where it was."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import pytest
from sqlalchemy import func, select

from bench.catalogue import store, unit
from bench.catalogue import sync as syncing
from bench.catalogue.questions import run_folders
from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.catalogue.unit import due_units
from bench.certificate.register import ISSUED, Register
from bench.services.chain import Entry, opened
from tests.support.laboratory import write_run

COUNT = 24


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.setattr("bench.catalogue.sync.SETTLED_NS", -(10**15))
    monkeypatch.setattr(syncing, "BATCH", 3)
    for k in range(COUNT):
        write_run(
            tmp_path / "runs" / f"r{k:02}", serial=str(k % 5), meters=(f"M{k % 3}", "N", "O"), effects=()
        )
    return tmp_path / "runs"


@pytest.mark.slow
def test_two_syncs_at_once_write_what_one_alone_writes(runs, tmp_path):
    def synced(_):
        with open_catalogue(tmp_path / "both") as catalogue:
            return sync(catalogue, [runs], processes=1)

    with ThreadPoolExecutor(3) as pool:
        done = list(pool.map(synced, range(3)))
    assert all(one.problems == {} for one in done)
    with open_catalogue(tmp_path / "alone") as catalogue:
        sync(catalogue, [runs], processes=1)
    assert rows_of(tmp_path / "both") == rows_of(tmp_path / "alone")


@pytest.mark.slow
def test_a_sync_that_was_ended_goes_on_where_it_was(runs, tmp_path, monkeypatch):
    write, batches = syncing._write, []

    def ended(*given):
        batches.append(given)
        if len(batches) == 4:
            raise KeyboardInterrupt
        write(*given)

    with open_catalogue(tmp_path / "file") as catalogue:
        monkeypatch.setattr(syncing, "_write", ended)
        with pytest.raises(KeyboardInterrupt):
            sync(catalogue, [runs], processes=1)
        assert len(run_folders(catalogue, [])) == 9
        monkeypatch.setattr(syncing, "_write", write)
        done = sync(catalogue, [runs], processes=1)
    assert (done.added, done.unchanged) == (COUNT - 9, 9)


@pytest.fixture(scope="module")
def pool():
    """A process for all tests of this file, as its start takes seconds."""
    with syncing.pool_of(1, "it ended") as pool:
        yield pool


@pytest.fixture
def apart(pool, monkeypatch):
    """Work of which there is little is done apart, too, by that process."""
    for module in (syncing, unit):
        monkeypatch.setattr(module, "pool_of", lambda *_: nullcontext(pool))
        monkeypatch.setattr(module, "FEW", 0)
    monkeypatch.setattr(syncing, "CHUNK", 5)


@pytest.mark.slow
@pytest.mark.usefixtures("apart")
def test_folders_read_and_units_reckoned_apart_are_the_same(runs, tmp_path, monkeypatch):
    for name, processes in (("one", 1), ("two", 2)):
        with open_catalogue(tmp_path / name) as catalogue:
            assert sync(catalogue, [runs], processes=processes).added == COUNT
    assert rows_of(tmp_path / "one") == rows_of(tmp_path / "two")
    with open_catalogue(tmp_path / "two") as catalogue:
        here = due_units(catalogue, [], limit_g=4e-4, processes=1)
        monkeypatch.setattr(unit, "METHOD", 0)  # nothing is kept of it
        assert due_units(catalogue, [], limit_g=4e-4, processes=2) == here
    assert len(here.units) + len(here.not_known) == 5


@pytest.mark.slow
@pytest.mark.usefixtures("apart")
def test_folders_looked_into_apart_are_the_same(tmp_path, monkeypatch):
    write_run(tmp_path / "runs" / "0" / "own")
    for k in range(6):
        write_run(tmp_path / "runs" / f"year-{k}" / f"a{k}")
    (tmp_path / "runs" / "half").mkdir()
    (tmp_path / "runs" / "half" / "events.jsonl").touch()
    with open_catalogue(tmp_path / "file") as catalogue:
        alone = sync(catalogue, [tmp_path / "runs"], processes=1)
        assert alone.added == 7
        for name, value in {"MANY": 3, "LOOKED": 2, "SETTLED_NS": -(10**18)}.items():
            monkeypatch.setattr(syncing, name, value)
        found = sync(catalogue, [tmp_path / "runs"], processes=2)
    # a process of its own knows nothing of the time that this one takes files to settle in
    assert (found.added, found.vanished, found.problems) == (0, 0, alone.problems)
    assert found.changed + found.unchanged == 7


@pytest.mark.slow
def test_a_register_tells_which_certificate_was_issued_of_which_run(runs, tmp_path):
    with open_catalogue(tmp_path / "file") as catalogue:
        sync(catalogue, [runs], processes=1)
        with catalogue.reading() as connection:
            asked = select(store.RUNS.c.head).where(store.RUNS.c.name == "r07")
            head = connection.execute(asked).scalar_one()
        with opened(Register(runs / "certificates")) as register:
            data = {"run": "r07", "record": {"head": head}}
            register.issue(Entry(ISSUED, "C-1", "2026-05-01T00:00:00+00:00", "A. Example", data), {})
        assert sync(catalogue, [runs]).problems == {}
        assert [path.name for path in run_folders(catalogue, ["issued=C-*"])] == ["r07"]
        assert len(run_folders(catalogue, ["issued=none"])) == COUNT - 1
        (runs / "certificates" / "register.jsonl").write_text("{}\n")
        assert list(sync(catalogue, [runs]).problems) == [str(runs / "certificates")]
        assert [path.name for path in run_folders(catalogue, ["issued=C-1"])] == ["r07"]


def rows_of(file):
    with open_catalogue(file) as catalogue, catalogue.reading() as connection:
        assert connection.execute(select(func.count()).select_from(store.RUNS)).scalar_one() == COUNT
        return {
            table.name: connection.execute(select(table).order_by(*table.primary_key)).all()
            for table in store.METADATA.sorted_tables
        }
