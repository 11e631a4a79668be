"""The catalogue's database, SQLite or PostgreSQL: location, tables, and rebuilding of old tables.

Values that were not recorded are NULL; times are UTC; `limit_g` and `delta_g` are in local g. A row's key is
derived from the object that the row describes (the hash of `run.json`, an instrument's identity, …). Programs
therefore write the same rows in any order and into any database. Arrays are stored as float64, little-endian,
row by row.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Date,
    DateTime,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
    delete,
    insert,
    inspect,
    select,
)  # fmt: skip

from bench.base.files import cache_folder
from bench.base.text import as_typed
from bench.run.events import MANIFEST
from bench.services.errors import Refused

if TYPE_CHECKING:
    from sqlalchemy import ColumnElement, Connection, Engine

SCHEMA: Final = 5
"""Version of the tables below. Increment it with every change of them; older catalogues are then rebuilt."""

METADATA: Final = MetaData()

ABOUT: Final = Table("catalogue", METADATA, Column("schema", Integer, primary_key=True))
"""The table that holds the version of the schema."""

FOLDERS: Final = Table(
    "folders",
    METADATA,
    Column("path", Text, primary_key=True),
    Column("fingerprint", Text, nullable=False),
    Column("run", BigInteger, index=True),
    Column("reason", Text),
    Column("vanished", Boolean, nullable=False),
)
"""Folders that are or should be runs, with the key of the run or the `reason` why there is none; `fingerprint` is
a hash of the names, sizes and times of their files."""

RUNS: Final = Table(
    "runs",
    METADATA,
    Column("id", BigInteger, primary_key=True, autoincrement=False),
    Column("manifest_sha256", Text, nullable=False, unique=True),
    Column("path", Text, nullable=False, index=True),
    Column("vanished", Boolean, nullable=False),
    Column("name", Text, nullable=False, index=True),
    Column("created", DateTime, index=True),
    Column("ended", DateTime),
    Column("imported", Boolean, nullable=False),
    Column("simulated", Boolean),
    Column("state", Text, nullable=False),
    Column("procedure", Text),
    Column("plan_hash", Text),
    Column("operator", Text),
    Column("unit_type", Text),
    Column("serial", Text, index=True),
    Column("unit", Text),
    Column("bench", Text),
    Column("bench_sha256", Text),
    Column("temperature_c", Float),
    Column("readings", Integer, nullable=False),
    Column("program_version", Text),
    Column("head", Text),
    Column("events", Integer, nullable=False),
    Column("record", Text, nullable=False),
    Column("problem", Text),
)
"""Runs: `record` is the state of the hash chain (see `bench.catalogue.folder`), `problem` its defect."""

INSTRUMENTS: Final = Table(
    "instruments",
    METADATA,
    Column("id", BigInteger, primary_key=True, autoincrement=False),
    Column("name", Text, nullable=False, index=True),
    Column("driver", Text),
    Column("serial", Text, index=True),
)
"""Instruments: `name` is maker, model and serial number if known, else the reported identity and the address."""

CERTIFICATES: Final = Table(
    "certificates",
    METADATA,
    Column("id", BigInteger, primary_key=True, autoincrement=False),
    Column("number", Text, nullable=False, index=True),
    Column("laboratory", Text, nullable=False),
    Column("date", Date, nullable=False),
    Column("valid_until", Date),
    Column("serial", Text),
)
"""Certificates of instruments, as bench files state them."""

USES: Final = Table(
    "uses",
    METADATA,
    Column("run", BigInteger, ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("role", Text, primary_key=True),
    Column("instrument", BigInteger, nullable=False, index=True),
    Column("certificate", BigInteger, index=True),
    Column("answered", Text),
    Column("resource", Text),
)
"""Uses: run, instrument, role (`voltmeter.x`, `head` …), certificate, and the reported identity (`answered`)."""

CALIBRATIONS: Final = Table(
    "calibrations",
    METADATA,
    Column("run", BigInteger, ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("of_record", Boolean),
    Column("estimator", Text),
    Column("model", Text),
    Column("unit", Text, nullable=False),
    Column("g_m_s2", Float, nullable=False),
    Column("gravity_u", Float),
    Column("vector", LargeBinary, nullable=False),
    Column("covariance", LargeBinary, nullable=False),
    Column("u_meters", LargeBinary),
    Column("sigma", Float),
    Column("chi2", Float),
    Column("dof", Float),
    Column("p", Float),
    Column("used", Integer),
)
"""Results of `calibrate.json`: `vector` (12,) in `unit`/g, and `covariance` (12, 12).

`covariance` does not include `gravity_u`, the relative standard uncertainty of `g_m_s2`. `u_meters` (12,) is the
part of u that recurs with the same meters. `of_record` states whether the result names the present head of the
record; it is NULL if the result names no head.
"""

VERIFICATIONS: Final = Table(
    "verifications",
    METADATA,
    Column("run", BigInteger, ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("verdict", Text, nullable=False),
    Column("limit_g", Float),
    Column("rule", Text),
    Column("worst_delta_g", Float),
    Column("missing", Integer),
)
"""Verdicts of `verify.json`; `worst_delta_g` is the Δg of largest magnitude, with its sign, in local g."""

POINTS: Final = Table(
    "points",
    METADATA,
    Column("run", BigInteger, ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("place", Integer, primary_key=True),
    Column("angle_deg", Float),
    Column("delta_g", Float, nullable=False),
    Column("u", Float),
    Column("verdict", Text, nullable=False),
)
"""Verification points: Δg with its standard uncertainty, in local g."""

DIAGNOSES: Final = Table(
    "diagnoses",
    METADATA,
    Column("run", BigInteger, ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("verdict", Text, nullable=False, index=True),
    Column("names", Text, nullable=False),
)
"""Diagnoses of `diagnose.json`; the effects named, joined by ", "."""

ISSUED: Final = Table(
    "issued",
    METADATA,
    Column("id", BigInteger, primary_key=True, autoincrement=False),
    Column("register", Text, nullable=False, index=True),
    Column("number", Text, nullable=False, index=True),
    Column("time", DateTime),
    Column("state", Text, nullable=False),
    Column("by", Text),
    Column("run", Text),
    Column("head", Text, index=True),
)
"""Certificates that this laboratory issued, read from its registers; each names its run and the head of the
record."""

DUES: Final = Table(
    "dues",
    METADATA,
    Column("unit", Text, primary_key=True),
    Column("asked", Text, primary_key=True),
    Column("told", Text, nullable=False),
)
"""Cached due dates of units (JSON), each for a limit and an interval; see `bench.catalogue.unit`."""

OF_A_RUN: Final = (USES, CALIBRATIONS, VERIFICATIONS, POINTS, DIAGNOSES)
"""Tables whose rows belong to a run and are replaced when the run is read again."""

Index("ix_runs_unit_created", RUNS.c.unit, RUNS.c.created)
# covering indexes: queries that count runs need not read the table
Index("ix_runs_of_units", RUNS.c.unit, RUNS.c.bench, RUNS.c.created, RUNS.c.simulated, RUNS.c.id)
Index("ix_runs_of_benches", RUNS.c.bench, RUNS.c.unit, RUNS.c.created, RUNS.c.simulated, RUNS.c.id)
Index("ix_runs_of_operators", RUNS.c.operator, RUNS.c.unit, RUNS.c.created, RUNS.c.simulated, RUNS.c.id)
Index("ix_verifications_verdict_run", VERIFICATIONS.c.verdict, VERIFICATIONS.c.run)


def key_of(*words: str) -> int:
    """Return the key (63 bits) of the object that the `words` identify together."""
    digest = hashlib.sha256("\x1f".join(words).encode("utf-8", "surrogatepass")).digest()
    return int.from_bytes(digest[:8], "big") >> 1


# --- the database -------------------------------------------------------------------------------------

REGISTER: Final = "register.jsonl"
"""Name of the register file in a folder of issued certificates."""

VARIABLE: Final = "TRIAXIAL_BENCH_CATALOGUE"
FILE: Final = "catalogue.sqlite"
BUSY_MS: Final = 120_000
"""Longest time (ms) to wait while another program writes."""

_TURN: Final = 0x7472_6961
"""Number of the advisory lock by which programs write to a PostgreSQL database one at a time."""
_WRITES: Final = "writes"


@dataclass(frozen=True)
class Catalogue:
    """An open catalogue. `where` is its file or address, without a password; `engine` connects to the database.

    `sync` is the shell command that fills the catalogue from run folders. `renewed` is a sentence on the
    replaced tables of an older catalogue; it is empty if none were replaced.
    """

    engine: Engine
    where: str
    sync: str
    renewed: str = ""

    @property
    def is_file(self) -> bool:
        """Whether the catalogue is a file (SQLite) and not on a server."""
        return self.engine.dialect.name == "sqlite"

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Yield a connection that sees one consistent state. Raises `Refused` if the database fails."""
        with _refusing(self), self.engine.connect() as connection:
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Yield a connection whose changes are committed together at the end; one program writes at a time."""
        writer = self.engine.execution_options(**{_WRITES: True})
        with _refusing(self), writer.begin() as connection:
            if not self.is_file:
                connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_TURN})")
            yield connection

    def close(self) -> None:
        """Close the connections to the database."""
        self.engine.dispose()

    def __enter__(self) -> Catalogue:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def open_catalogue(
    where: str | Path | None = None, *, existing: bool = False, renew: bool = False
) -> Catalogue:
    """Open a catalogue, given as a file or the URL of a database.

    None means the catalogue that TRIAXIAL_BENCH_CATALOGUE names, else `catalogue.sqlite` in the user's cache
    folder. A missing catalogue is created, unless `existing` is True. With `renew`, tables of an older version are
    replaced by current ones, which `bench.catalogue.sync` then fills; rows of vanished folders stay. Raises
    `Refused` with the reason and the remedy.
    """
    named = str(where or os.environ.get(VARIABLE) or cache_folder(FILE))
    import sqlalchemy

    url = _url(named)
    in_file = url.get_backend_name() == "sqlite"
    shown = named if in_file else url.render_as_string(hide_password=True)
    sync = "bench catalogue sync DIR" + (f" --catalogue {as_typed(shown)}" if where else "")
    if in_file:
        _prepare_file(Path(url.database or ""), sync, existing=existing)
    on_server = {"connect_timeout": 10, "options": "-c timezone=UTC"}
    waiting = {"timeout": BUSY_MS / 1e3} if in_file else on_server
    engine = sqlalchemy.create_engine(url, connect_args=waiting)
    _listen(engine)
    catalogue = Catalogue(engine, shown, sync)
    try:
        return _with_tables(catalogue, renew=renew)
    except BaseException:
        catalogue.close()
        raise


def _url(named: str) -> Any:
    """Return the URL of a database; a file name becomes a URL of SQLite."""
    from sqlalchemy import URL, make_url
    from sqlalchemy.exc import ArgumentError

    if "://" not in named:
        return URL.create("sqlite", database=str(Path(named).absolute()))
    try:
        url = make_url(named)
    except (ArgumentError, ValueError):
        raise Refused(
            "--catalogue: this is not the URL of a database; give a file, or postgresql://USER@HOST/NAME"
        ) from None
    kind = url.get_backend_name()
    if kind == "sqlite" and url.database and not url.query:
        return URL.create("sqlite", database=str(Path(url.database).absolute()))
    if kind != "postgresql":
        raise Refused(
            f"--catalogue: a catalogue is a SQLite file or in PostgreSQL, not {kind or 'nothing'}; "
            "give a file, or postgresql://USER@HOST/NAME"
        )
    return url.set(drivername="postgresql+psycopg")


def _prepare_file(file: Path, sync: str, *, existing: bool) -> None:
    """Create the folder of the catalogue's file. Raises `Refused` for a folder, or for a missing file to read."""
    if file.is_dir():
        raise Refused(f"{file}: is a folder; name a file for the catalogue")
    if existing and not file.is_file():
        raise Refused(f"{file}: no catalogue yet; make it with '{sync}'")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Refused(f"{file}: cannot be made ({error.strerror}); name another with --catalogue") from error


def _listen(engine: Engine) -> None:
    """Make SQLite lock at the start of each write transaction, so that other writers wait and do not fail."""
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
    """Switch to a write-ahead log; retry, because SQLite fails at once if several programs switch a file."""
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


def _with_tables(catalogue: Catalogue, *, renew: bool) -> Catalogue:
    """Return the catalogue with the tables of this version; one program at a time creates them."""
    with catalogue.reading() as connection:
        if _schema_of(connection) == SCHEMA:
            return catalogue
    with catalogue.writing() as connection:
        found = _schema_of(connection)
        if found is None:
            if inspect(connection).get_table_names():
                raise Refused(
                    f"{catalogue.where}: a database with other tables; name another for the catalogue"
                )
            _make_tables(connection)
        elif found > SCHEMA:
            raise Refused(
                f"{catalogue.where}: made by a newer version of this program (schema {found}); use that "
                f"version, or delete the catalogue and make it again with '{catalogue.sync}'"
            )
        elif found < SCHEMA:
            if not renew:
                raise Refused(
                    f"{catalogue.where}: made by an older version of this program; make it again from its runs "
                    f"with '{catalogue.sync}'"
                )
            return replace(catalogue, renewed=_renew(connection))
    return catalogue


def _schema_of(connection: Connection) -> int | None:
    """Return the schema version; 0 for a catalogue that records none, None if the database is no catalogue."""
    there = set(inspect(connection).get_table_names())
    if ABOUT.name in there:
        return int(connection.execute(select(ABOUT.c.schema)).scalar_one())
    return 0 if {FOLDERS.name, RUNS.name} <= there else None


def _make_tables(connection: Connection) -> None:
    METADATA.create_all(connection)
    connection.execute(insert(ABOUT).values(schema=SCHEMA))


def _renew(connection: Connection) -> str:
    """Replace the tables of an older catalogue by current ones for a sync to fill; return a sentence on it.

    For a run that can be read again, only the folder is kept, so that a sync finds it. Runs and registers
    whose folders are gone keep their rows, as far as the new tables have the columns.
    """
    before = MetaData()
    before.reflect(connection, only=lambda name, _: name in {*METADATA.tables, "alembic_version"})
    was = before.tables[FOLDERS.name]
    folders = connection.execute(select(was.c.path, was.c.run)).all()
    there = {run for path, run in folders if Path(path, MANIFEST).exists()}
    is_kept: dict[Table, Callable[[Any], bool]] = {
        RUNS: lambda row: row["id"] not in there,
        **dict.fromkeys(OF_A_RUN, lambda row: row["run"] not in there),
        **dict.fromkeys((FOLDERS, INSTRUMENTS, CERTIFICATES), lambda row: True),
        ISSUED: lambda row: not Path(row["register"], REGISTER).exists(),
    }
    rows: dict[Table, list[dict[str, Any]]] = {}
    for table, kept in is_kept.items():
        if table.name in before.tables:
            found = connection.execute(select(before.tables[table.name])).mappings()
            rows[table] = [dict(row) for row in found if kept(row)]
    before.drop_all(connection)
    _make_tables(connection)
    for table in (one for one in METADATA.sorted_tables if one in rows):
        needed = {column.name for column in table.columns if not column.nullable}
        for row in (one for one in rows[table] if needed <= one.keys()):
            known = {name: value for name, value in row.items() if name in table.columns}
            connection.execute(insert(table).values(known))
    lost = len(rows[RUNS])
    gone = f"; {lost} runs without a folder were kept unchanged" if lost else ""
    return f"made by an older version of this program: made again from its {len(there)} runs{gone}"


def forget_dues(connection: Connection, changed: ColumnElement[bool]) -> None:
    """Delete the cached due dates of units with runs that satisfy `changed`, a condition on `RUNS`."""
    units = select(RUNS.c.unit).where(changed)
    connection.execute(delete(DUES).where(DUES.c.unit.in_(units)))


@contextmanager
def _refusing(catalogue: Catalogue) -> Iterator[None]:
    """Turn a database error within the context into `Refused`, with a sentence for the user."""
    from sqlalchemy.exc import DBAPIError, OperationalError

    try:
        yield
    except (DBAPIError, ValueError) as error:  # ValueError: an invalid text or date in the database
        why = " ".join(str(getattr(error, "orig", "a value in it cannot be read")).split())
        if isinstance(error, OperationalError) and not why.startswith("no such "):
            raise Refused(
                f"{catalogue.where}: the catalogue cannot be used ({why}); check its path, permissions and server, "
                "and the free disk space"
            ) from error
        raise Refused(
            f"{catalogue.where}: not a catalogue, or a damaged one ({why}); delete it and make it again with "
            f"'{catalogue.sync}'"
        ) from error
