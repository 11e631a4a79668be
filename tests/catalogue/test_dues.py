"""When many units are due; the same catalogue in a PostgreSQL server."""

import json
import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest
from sqlalchemy import select, text

from bench.catalogue import store, unit
from bench.catalogue.questions import KINDS, answer, run_folders
from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.catalogue.unit import compared_of, due_units, unit_history
from bench.catalogue.values import coefficient_table, measured_of
from bench.model.geometry import COEFFICIENTS
from bench.results.catalogue import coefficient_rows
from bench.services.errors import Refused
from tests.support.laboratory import VECTOR, U, write_run

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


def test_instruments_are_due_by_their_latest_certificate(catalogue):
    """Each meter has a certificate of each year, valid for a year; the last of them counts."""
    found = due_units(catalogue, []).instruments
    assert found
    assert {one.valid_until[:4] for one in found} == {"2025"}
    assert due_units(catalogue, [], before="2025-01-01").instruments == []
    assert due_units(catalogue, ["serial=9"]).instruments == []


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


def test_after_a_sync_with_due_nobody_waits(catalogue, bench, monkeypatch):
    status, _, err = bench("catalogue", "sync", "runs", "--due", "--catalogue", "there.sqlite")
    assert (status, err) == (0, "")
    monkeypatch.setattr(unit, "due_of", None)
    found = due_units(catalogue, [])
    assert len(found.units) + len(found.not_known) == 3


pytest.importorskip("psycopg", reason="the extra 'postgresql' is not installed")


@pytest.fixture(scope="module")
def server():
    """The URL of a server that ends with the tests; by the user `postgres` where we are root, which it refuses."""
    missing = [name for name in ("initdb", "pg_ctl") if shutil.which(name) is None]
    if missing:
        pytest.skip(f"no PostgreSQL server here: {', '.join(missing)} not in PATH")
    user, own = "postgres", {}
    if os.geteuid() == 0:
        try:
            found = pwd.getpwnam(user)
        except KeyError:
            pytest.skip("PostgreSQL refuses root, and there is no user postgres")
        own = {"user": found.pw_uid, "group": found.pw_gid, "extra_groups": []}
    with tempfile.TemporaryDirectory(prefix="pg-") as name:
        folder = Path(name)
        if own:
            os.chown(folder, own["user"], own["group"])
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]

        def call(*words):
            subprocess.run(words, check=True, cwd=folder, capture_output=True, timeout=120, **own)  # noqa: S603 - ours

        call("initdb", "-D", f"{name}/data", "-U", user, "-A", "trust", "-E", "UTF8", "--locale=C", "-N")
        options = f"-c listen_addresses=127.0.0.1 -p {port} -k {name} -c fsync=off"
        call("pg_ctl", "-D", f"{name}/data", "-w", "-l", f"{name}/log", "-o", options, "start")
        try:
            yield f"postgresql://{user}@127.0.0.1:{port}/postgres"
        finally:
            call("pg_ctl", "-D", f"{name}/data", "-m", "immediate", "stop")


def everything(catalogue):
    with catalogue.reading() as connection:
        return {
            table.name: connection.execute(select(table).order_by(*table.primary_key)).all()
            for table in store.METADATA.sorted_tables
        }


@pytest.mark.slow
def test_a_file_and_a_server_give_the_same(server, tmp_path, monkeypatch):
    monkeypatch.setattr("bench.catalogue.sync.SETTLED_NS", -(10**15))
    runs = tmp_path / "runs"
    for k in range(6):
        write_run(runs / f"r{k}", serial=str(k % 2), created=f"202{k}-03-01T08:00:00+00:00", effects=("a_b",))
    write_run(runs / "odd", operator="Ö\x00\ud800%_", calibrated=False, simulated=True)
    write_run(runs / "Odd", operator="ö", verdict="fail", bench="Bench-01")
    (runs / "half").mkdir()
    (runs / "half" / "plan.json").write_text("{}")
    with open_catalogue(tmp_path / "file") as file, open_catalogue(server) as other:
        for catalogue in (file, other):
            first = sync(catalogue, [runs], processes=1)
            assert (first.added, len(first.problems)) == (8, 1)
        assert everything(file) == everything(other)
        for query in (
            ["operator=*"],
            ["bench=bench*"],
            ["unit!=0"],
            ["verdict=none"],
            ["simulated=no", "p<0.6"],
        ):
            assert run_folders(file, query) == run_folders(other, query)
            for of in KINDS:
                assert answer(file, query, of) == answer(other, query, of)
        assert (coefficient_table(file, []).vector == coefficient_table(other, []).vector).all()
        shutil.rmtree(runs / "r0")
        (runs / "r1").rename(runs / "r9")
        changes = [sync(catalogue, [runs]) for catalogue in (file, other)]
        assert changes[0] == changes[1]
        assert (changes[0].moved, changes[0].vanished) == (1, 1)
        assert everything(file) == everything(other)
        with other.writing() as connection:
            connection.execute(text("DROP SCHEMA public CASCADE"))
            connection.execute(text("CREATE SCHEMA public"))


@pytest.mark.slow
def test_a_server_that_is_not_there_is_a_sentence_without_the_password(server):
    gone = server.replace("postgres@", "postgres:secret@").rsplit(":", 1)[0] + ":1/postgres"
    with pytest.raises(Refused, match="cannot be used") as refused:
        open_catalogue(gone)
    assert "secret" not in str(refused.value)


def test_gravity_counts_between_places_only(catalogue):
    """Unit 1 goes to a place with another g: u(g) of both places is in the u of what was found in the first."""
    places = {DAYS[0]: (9.80665, 3e-5), DAYS[1]: (9.80665, 3e-5), DAYS[2]: (9.83, 4e-5)}
    for day, (g, u) in places.items():
        file = Path("runs") / f"1-{day}" / "calibrate.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), "g_m_s2": g, "gravity_u": u}))
    sync(catalogue, ["runs"])
    table = coefficient_table(catalogue, ["serial=1"])
    assert table.gravity_u.tolist() == [3e-5, 3e-5, 4e-5]

    of_g = VECTOR[0] * 9.83 / 9.80665 * 5e-5
    there, _, _ = compared_of(catalogue, "block A 1")
    own = U**2 * (9.83 / 9.80665) ** 2
    assert there.covariance[:, 0, 0] == pytest.approx([own + of_g**2, own + of_g**2, U**2], rel=1e-9)
    assert there.covariance[:, 9, 9] == pytest.approx(U**2)
    assert there.covariance[0, 0, 4] == pytest.approx(of_g * VECTOR[4] * 9.83 / 9.80665 * 5e-5)

    measured, _, _ = measured_of(
        table
    )  # per standard g, which is no place: u(g) counts for every calibration
    of_each = measured.vector[:, 0] * table.gravity_u
    assert measured.own_variance[:, 0] == pytest.approx(
        measured.variance[:, 0] - of_each**2 - U**2 / 2, rel=1e-3
    )
    assert measured.place.tolist() == [9.80665, 9.80665, 9.83]


def test_the_page_of_a_unit_rounds_expanded_uncertainties_as_its_certificate_does():
    coefficients = {name: SimpleNamespace(value=0.0714348, u=5.2e-5) for name in COEFFICIENTS}
    one = SimpleNamespace(coefficients=coefficients, unit="V")
    assert {row[1:3] for row in coefficient_rows([one])} == {("0.07143", "0.00011")}
