"""The catalogue in a real PostgreSQL server, which is started here: the same rows and answers as in a file."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest
from sqlalchemy import select, text

from bench.catalogue import store
from bench.catalogue.questions import KINDS, answer, run_folders
from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.catalogue.values import coefficient_table
from bench.services.errors import Refused
from tests.support.laboratory import write_run

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
