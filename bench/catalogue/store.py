"""Where the catalogue is kept, SQLite or PostgreSQL, and its schema, brought to the present one by Alembic."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from bench.base.files import cache_folder
from bench.services.errors import Refused

if TYPE_CHECKING:
    from sqlalchemy import Connection, Engine

VARIABLE: Final = "TRIAXIAL_BENCH_CATALOGUE"
FILE: Final = "catalogue.sqlite"
SCHEMA: Final = "0003"
"""The newest revision of `bench/catalogue/migrations`."""

BUSY_MS: Final = 120_000
"""How long another program's turn is waited for."""

_TURN: Final = 0x7472_6961
"""The lock of a PostgreSQL database by which programs write into it one after the other."""
_WRITES: Final = "writes"


@dataclass(frozen=True)
class Catalogue:
    """A catalogue that is open. `where` names it, without a password; `engine` speaks to the database."""

    engine: Engine
    where: str

    @property
    def is_file(self) -> bool:
        """Whether it is a file (SQLite), and no server's."""
        return self.engine.dialect.name == "sqlite"

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Give a connection that sees one state of the catalogue. Raises `Refused` where the database fails."""
        with _told(self.where), self.engine.connect() as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Give a connection of which all is written at the end, or nothing. One program at a time has it."""
        writer = self.engine.execution_options(**{_WRITES: True})
        with _told(self.where), writer.begin() as connection:
            if not self.is_file:
                connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_TURN})")
            yield connection

    def close(self) -> None:
        """Let the database go."""
        self.engine.dispose()

    def __enter__(self) -> Catalogue:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_catalogue(where: str | Path | None = None, *, existing: bool = False) -> Catalogue:
    """Open a catalogue, a file or the URL of a database, and bring its schema to the present.

    None takes what TRIAXIAL_BENCH_CATALOGUE names, or `catalogue.sqlite` in the user's cache folder. One that is
    not there is made, unless it has to be `existing`. Raises `Refused` with why and what to do.
    """
    named = str(where or os.environ.get(VARIABLE) or cache_folder(FILE))
    import sqlalchemy

    # it takes half as long to load as an answer may take, and is needed where the schema is not the present one
    if find_spec("alembic") is None:
        raise ModuleNotFoundError(name="alembic")
    url = _url(named)
    told = url.render_as_string(hide_password=True) if url.get_backend_name() != "sqlite" else named
    if url.get_backend_name() == "sqlite":
        _prepare_file(Path(url.database or ""), existing=existing)
    engine = sqlalchemy.create_engine(url, connect_args=_connect_args(url.get_backend_name()))
    _listen(engine)
    catalogue = Catalogue(engine, told)
    try:
        _upgrade(catalogue)
    except BaseException:
        catalogue.close()
        raise
    return catalogue


def _url(named: str) -> Any:
    """Return the URL of a database; a file's name is one of SQLite."""
    from sqlalchemy import URL, make_url
    from sqlalchemy.exc import ArgumentError

    if "://" not in named:
        return URL.create("sqlite", database=str(Path(named).absolute()))
    try:
        url = make_url(named)
    except (ArgumentError, ValueError):
        raise Refused(
            "--catalogue: this is no URL of a database; give a file, or postgresql://USER@HOST/NAME"
        ) from None
    kind = url.get_backend_name()
    if kind == "sqlite" and url.database and not url.query:
        return URL.create("sqlite", database=str(Path(url.database).absolute()))
    if kind != "postgresql":
        raise Refused(
            f"--catalogue: a catalogue is a file (SQLite) or stands in PostgreSQL, not in {kind or 'nothing'}; "
            "give a file, or postgresql://USER@HOST/NAME"
        )
    return url.set(drivername="postgresql+psycopg")


def _connect_args(kind: str) -> dict[str, Any]:
    if kind == "sqlite":
        return {"timeout": BUSY_MS / 1e3}
    return {"connect_timeout": 10, "options": "-c timezone=UTC"}


def _prepare_file(file: Path, *, existing: bool) -> None:
    """Make the folder of the file; refuse what is none, or is missing where it has to be there."""
    if file.is_dir():
        raise Refused(f"{file}: is a folder; name a file for the catalogue")
    if existing and not file.is_file():
        raise Refused(f"{file}: there is no catalogue yet; make it with: bench catalogue sync DIR")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Refused(f"{file}: cannot be made ({error.strerror}); name another with --catalogue") from error


def _listen(engine: Engine) -> None:
    """Begin what writes into a file as a writer, so that two of them wait for each other and none fails."""
    from sqlalchemy import event

    if engine.dialect.name != "sqlite":
        return

    def connected(connection: Any, _record: Any) -> None:
        connection.isolation_level = None
        connection.execute(f"PRAGMA busy_timeout = {BUSY_MS}")
        _take_up_wal(connection)
        for setting in (
            "synchronous = NORMAL",
            "foreign_keys = ON",
            "case_sensitive_like = ON",
            "cache_size = -65536",
        ):
            connection.execute(f"PRAGMA {setting}")

    def begun(connection: Connection) -> None:
        writes = connection.get_execution_options().get(_WRITES)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    event.listen(engine, "connect", connected)
    event.listen(engine, "begin", begun)


def _take_up_wal(connection: Any) -> None:
    """Have a file keep a write-ahead log; where several programs make it at once, SQLite refuses without a wait."""
    until = time.monotonic() + BUSY_MS / 1e3
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError as error:
            if "locked" not in str(error) or time.monotonic() > until:
                raise
            time.sleep(0.02)
        else:
            return


def _upgrade(catalogue: Catalogue) -> None:
    """Bring the schema to the present one; one program at a time does."""
    with catalogue.reading() as connection:
        if _revision(connection) == SCHEMA:
            return
    from alembic import command
    from alembic.config import Config
    from alembic.util import CommandError

    config = Config()
    config.set_main_option("script_location", str(files("bench.catalogue") / "migrations").replace("%", "%%"))
    with catalogue.writing() as connection:
        found = _revision(connection)
        if found == SCHEMA:
            return
        if found is None and _tables(connection):
            raise Refused(f"{catalogue.where}: a database with other tables; name another for the catalogue")
        config.attributes["connection"] = connection
        try:
            command.upgrade(config, "head")
        except CommandError as error:
            raise Refused(
                f"{catalogue.where}: made by a newer version of this program (schema {found}); use that, or delete "
                "the catalogue and make it again with: bench catalogue sync DIR"
            ) from error


def _revision(connection: Connection) -> str | None:
    """Return the revision of the schema that a database has, None where it has none."""
    if "alembic_version" not in _tables(connection):
        return None
    found = connection.exec_driver_sql("SELECT version_num FROM alembic_version").scalar()
    return None if found is None else str(found)


def _tables(connection: Connection) -> list[str]:
    from sqlalchemy import inspect

    return inspect(connection).get_table_names()


@contextmanager
def _told(where: str) -> Iterator[None]:
    """Say in a sentence what a database refused."""
    from sqlalchemy.exc import DBAPIError, OperationalError

    try:
        yield
    except (DBAPIError, ValueError) as error:  # a text that is none, a date that is none
        why = " ".join(str(getattr(error, "orig", "a value in it cannot be read")).split())
        if isinstance(error, OperationalError) and not why.startswith("no such "):
            raise Refused(
                f"{where}: the catalogue cannot be used ({why}); check its place and the server"
            ) from error
        raise Refused(
            f"{where}: not a catalogue, or a damaged one ({why}); delete it and make it again with: bench "
            "catalogue sync DIR"
        ) from error
