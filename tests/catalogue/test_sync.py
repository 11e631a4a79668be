"""Run folders taken into the catalogue: what is new, changed, moved, gone, copied or bad."""

import json
import shutil

import pytest
from sqlalchemy import func, inspect, select

from bench.catalogue import store
from bench.catalogue.questions import answer, run_folders
from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.services.errors import Refused
from tests.support.certificates import copy_run
from tests.support.laboratory import events_of, write_events, write_run


@pytest.fixture
def catalogue(tmp_path):
    with open_catalogue(tmp_path / "catalogue.sqlite") as opened:
        yield opened


def row_of(catalogue, name):
    with catalogue.reading() as connection:
        return connection.execute(select(store.RUNS).where(store.RUNS.c.name == name)).mappings().one()


def count(catalogue, table):
    with catalogue.reading() as connection:
        return connection.execute(select(func.count()).select_from(table)).scalar_one()


@pytest.fixture(autouse=True)
def settled(monkeypatch):
    """Take files for settled at once."""
    monkeypatch.setattr("bench.catalogue.sync.SETTLED_NS", -(10**15))


def test_what_stands_in_a_run_folder_stands_in_the_catalogue(catalogue, tmp_path):
    write_run(tmp_path / "runs" / "one", serial="17", effects=("cable_torque",), verdict="fail")
    done = sync(catalogue, [tmp_path / "runs"])
    assert (done.added, done.problems) == (1, {})
    row = row_of(catalogue, "one")
    assert (row["unit"], row["bench"], row["operator"]) == ("block A 17", "bench-01", "A. Example")
    assert (row["state"], row["readings"], row["temperature_c"]) == ("finished", 1, 23.5)
    assert (row["procedure"], row["simulated"], row["record"]) == ("paper", False, "chain")
    assert row["created"].isoformat() == "2026-03-01T08:00:00"
    assert row["ended"].isoformat() == "2026-03-01T08:03:00"
    with catalogue.reading() as connection:
        used = connection.execute(
            select(store.USES.c.role, store.INSTRUMENTS.c.name, store.CERTIFICATES.c.number)
            .join(store.INSTRUMENTS, store.INSTRUMENTS.c.id == store.USES.c.instrument)
            .outerjoin(store.CERTIFICATES, store.CERTIFICATES.c.id == store.USES.c.certificate)
            .order_by(store.USES.c.role)
        ).all()
        found = connection.execute(select(store.DIAGNOSES)).mappings().one()
        verified = connection.execute(select(store.VERIFICATIONS)).mappings().one()
    assert [tuple(one) for one in used] == [
        ("head", "manual dividing head of bench-01", None),
        ("voltmeter.x", "Keysight Technologies 34461A MY1", "2026-MY1"),
        ("voltmeter.y", "Keysight Technologies 34461A MY2", "2026-MY2"),
        ("voltmeter.z", "Keysight Technologies 34461A MY3", "2026-MY3"),
    ]
    assert (found["verdict"], found["names"]) == ("named", "cable_torque")
    assert (verified["verdict"], verified["worst_delta_g"]) == ("fail", 1e-4)


def test_a_second_sync_reads_only_what_changed(catalogue, tmp_path):
    folders = [write_run(tmp_path / "runs" / name) for name in ("one", "two", "three")]
    sync(catalogue, [tmp_path / "runs"])
    (folders[1] / "verify.json").unlink()
    done = sync(catalogue, [tmp_path / "runs"])
    assert (done.added, done.changed, done.unchanged) == (0, 1, 2)
    assert count(catalogue, store.VERIFICATIONS) == 2
    assert count(catalogue, store.CALIBRATIONS) == 3


def test_nothing_is_written_where_nothing_changed(catalogue, tmp_path):
    write_run(tmp_path / "runs" / "one")
    (write_run(tmp_path / "runs" / "half") / "run.json").unlink()
    sync(catalogue, [tmp_path / "runs"])
    with catalogue.reading() as connection:
        before = connection.exec_driver_sql("PRAGMA data_version").scalar_one()
        sync(catalogue, [tmp_path / "runs"])
        connection.rollback()
        assert connection.exec_driver_sql("PRAGMA data_version").scalar_one() == before


@pytest.mark.slow
def test_an_older_catalogue_is_made_anew_from_its_runs(tmp_path):
    """One folder is below that of the sync, one elsewhere, one gone; the older tables lack a column."""
    one, _, gone = (
        write_run(tmp_path / name, verdict="fail", serial=name[-1])
        for name in ("runs/1", "elsewhere/2", "runs/3")
    )
    file = tmp_path / "older.sqlite"
    with open_catalogue(file) as catalogue:
        sync(catalogue, [tmp_path])
        shutil.rmtree(gone)
        with catalogue.writing() as connection:
            for statement in (
                "DROP TABLE catalogue", "DROP TABLE dues", "CREATE TABLE alembic_version (version_num TEXT)",
                "ALTER TABLE runs DROP COLUMN temperature_c", "ALTER TABLE runs ADD COLUMN colour TEXT",
            ):  # fmt: skip
                connection.exec_driver_sql(statement)
    with pytest.raises(Refused, match=r"older version of this program; make it again .*bench catalogue sync"):
        open_catalogue(file)
    with open_catalogue(file, renew=True) as catalogue:
        assert catalogue.renewed.endswith("from its 2 runs; 1 runs without a folder were kept unchanged")
    with open_catalogue(file) as catalogue:  # as after a sync that was ended at its beginning
        done = sync(catalogue, [one.parent])
        assert (done.added, done.vanished, done.problems) == (2, 1, {})
        failed = answer(catalogue, ["verdict=fail"], "units").rows
        assert [row[0] for row in failed] == ["block A 1", "block A 2", "block A 3"]
        assert [row_of(catalogue, name)["temperature_c"] for name in "123"] == [23.5, 23.5, None]
        again = sync(catalogue, [one.parent])
        assert (again.added, again.changed, again.unchanged) == (0, 0, 1)
        with catalogue.reading() as connection:
            assert "alembic_version" not in inspect(connection).get_table_names()


def test_a_newer_catalogue_is_refused(tmp_path):
    with open_catalogue(tmp_path / "newer") as catalogue, catalogue.writing() as connection:
        connection.execute(store.ABOUT.update().values(schema=store.SCHEMA + 1))
    with pytest.raises(Refused, match="newer version"):
        open_catalogue(tmp_path / "newer", renew=True)


def test_a_moved_folder_is_the_same_run_and_one_that_is_gone_is_marked(catalogue, tmp_path):
    one, two = (write_run(tmp_path / "runs" / name) for name in ("one", "two"))
    sync(catalogue, [tmp_path / "runs"])
    one.rename(one.with_name("renamed"))
    shutil.rmtree(two)
    done = sync(catalogue, [tmp_path / "runs"])
    assert (done.added, done.moved, done.vanished) == (0, 1, 1)
    assert count(catalogue, store.RUNS) == 2
    assert run_folders(catalogue, []) == [tmp_path / "runs" / "renamed"]
    assert row_of(catalogue, "two")["vanished"]
    write_run(two)
    again = sync(catalogue, [tmp_path / "runs"])
    assert again.vanished == 0
    assert not row_of(catalogue, "two")["vanished"]


@pytest.mark.parametrize("together", [True, False])
def test_a_whole_copy_counts_in_place_of_a_damaged_folder(catalogue, tmp_path, together):
    one = write_run(tmp_path / "runs" / "one")
    shutil.copytree(one, tmp_path / "copy")
    events = one / "events.jsonl"
    events.write_bytes(events.read_bytes().replace(b"step_done", b"step_dnoe"))
    if not together:
        sync(catalogue, [tmp_path / "runs"])
    shutil.copytree(tmp_path / "copy", tmp_path / "runs" / "restored")
    done = sync(catalogue, [tmp_path / "runs"])
    row = row_of(catalogue, "restored")
    assert (row["path"], row["problem"]) == (str(tmp_path / "runs" / "restored"), None)
    assert str(tmp_path / "runs" / "restored") not in done.problems
    assert sync(catalogue, [tmp_path / "runs"]).unchanged == 2


def test_a_copy_is_told_and_counts_once(catalogue, tmp_path):
    one = write_run(tmp_path / "runs" / "one")
    shutil.copytree(one, tmp_path / "runs" / "two")
    done = sync(catalogue, [tmp_path / "runs"])
    assert done.added == 1
    assert done.problems == {str(tmp_path / "runs" / "two"): f"a copy of {one}: counted once"}
    shutil.rmtree(one)
    sync(catalogue, [tmp_path / "runs"])
    assert run_folders(catalogue, []) == [tmp_path / "runs" / "two"]


def test_bad_folders_are_listed_with_the_reason_and_stop_nothing(catalogue, tmp_path):
    runs = tmp_path / "runs"
    write_run(runs / "good")
    (write_run(runs / "half") / "run.json").unlink()
    (write_run(runs / "foreign") / "run.json").write_text('{"what": "another program"}')
    (write_run(runs / "torn") / "run.json").write_text('{"format": 1, "na')
    result = write_run(runs / "result") / "calibrate.json"
    result.write_text(result.read_text().replace('"V"', "null"))
    (runs / "notes").mkdir()
    done = sync(catalogue, [runs])
    reasons = {path.rsplit("/", 1)[1]: why for path, why in done.problems.items()}
    assert sorted(reasons) == ["foreign", "half", "result", "torn"]
    assert "without run.json" in reasons["half"]
    assert "lacks 'files' or 'created'" in reasons["foreign"]
    assert "damaged" in reasons["torn"]
    assert "calibrate.json" in reasons["result"]
    assert done.added == 2
    for _ in range(2):
        assert sync(catalogue, [runs]).problems == done.problems
        listed = answer(catalogue, [], "folders").rows
        assert {path.rsplit("/", 1)[1] for path, _ in listed} == {"foreign", "half", "result", "torn"}


@pytest.mark.parametrize("line", [1, 2, 3])
def test_a_changed_line_breaks_the_chain_and_is_told(catalogue, tmp_path, line):
    events = write_run(tmp_path / "runs" / "one") / "events.jsonl"
    lines = events.read_bytes().split(b"\n")
    lines[line - 1] = lines[line - 1].replace(b'"bench_s": ', b'"bench_s": 1')
    events.write_bytes(b"\n".join(lines))
    sync(catalogue, [tmp_path / "runs"])
    row = row_of(catalogue, "one")
    assert row["record"] == "broken"
    assert row["problem"] == f"events.jsonl, line {line + 1}: the chain is broken here"


def test_a_changed_input_is_told(catalogue, tmp_path):
    folder = write_run(tmp_path / "runs" / "one")
    with (folder / "bench.yaml").open("a") as file:
        file.write("# by hand\n")
    sync(catalogue, [tmp_path / "runs"])
    assert row_of(catalogue, "one")["problem"] == "bench.yaml was changed since the run began"


@pytest.mark.slow
def test_a_result_of_another_state_of_the_record_is_told_from_its_own(catalogue, tmp_path):
    folder = write_run(tmp_path / "runs" / "one")
    events = events_of("2026-03-01T08:00:00+00:00", ("MY1", "MY2", "MY3"))
    write_events(folder, events[:-1])
    sync(catalogue, [tmp_path / "runs"])
    with catalogue.reading() as connection:
        assert connection.execute(select(store.CALIBRATIONS.c.of_record)).scalar_one() is False
    assert row_of(catalogue, "one")["state"] == "running"


def test_whole_reads_every_event(catalogue, tmp_path):
    copy_run(tmp_path / "runs", "old")
    sync(catalogue, [tmp_path / "runs"])
    assert row_of(catalogue, "old")["record"] == "chain"
    done = sync(catalogue, [tmp_path / "runs"], whole=True)
    assert (done.changed, row_of(catalogue, "old")["record"]) == (1, "read")
    assert sync(catalogue, [tmp_path / "runs"], whole=True).changed == 0


def test_whole_finds_an_event_that_cannot_be_though_its_chain_holds(catalogue, tmp_path):
    folder = write_run(tmp_path / "runs" / "one")
    events = events_of("2026-03-01T08:00:00+00:00", ("MY1", "MY2", "MY3"))
    events[2]["reading"]["mean"] = [0.1, -0.2]
    write_events(folder, events)
    sync(catalogue, [tmp_path / "runs"])
    assert row_of(catalogue, "one")["record"] == "chain"
    sync(catalogue, [tmp_path / "runs"], whole=True)
    assert row_of(catalogue, "one")["record"] == "broken"


def test_a_folder_that_is_not_there_is_refused_and_marks_nothing(catalogue, tmp_path):
    write_run(tmp_path / "runs" / "one")
    sync(catalogue, [tmp_path / "runs"])
    (tmp_path / "runs").rename(tmp_path / "elsewhere")
    with pytest.raises(Refused, match="no such folder"):
        sync(catalogue, [tmp_path / "runs"])
    assert not row_of(catalogue, "one")["vanished"]


def test_texts_that_no_database_takes_are_made_visible(catalogue, tmp_path):
    write_run(tmp_path / "runs" / "one", operator="A\x00B\ud800")
    sync(catalogue, [tmp_path / "runs"])
    assert row_of(catalogue, "one")["operator"] == "A\\x00B\\ud800"


def test_a_manifest_with_impossible_numbers_stops_nothing(catalogue, tmp_path):
    write_run(tmp_path / "runs" / "good")
    folder = write_run(tmp_path / "runs" / "odd")
    manifest = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**manifest, "imported": "x.csv", "readings": 10**30}))
    done = sync(catalogue, [tmp_path / "runs"])
    assert done.added == 1
    assert list(done.problems) == [str(folder)]
