"""The tables of the catalogue. What nobody recorded is NULL; times are UTC; sizes are SI with the unit in the name.

A row's key is drawn from what it stands for (the hash of `run.json`, an instrument's identity …), so that any
number of programs, in any order and in any database, write the same rows. Arrays are float64, little-endian, row by
row.
"""

from __future__ import annotations

import hashlib
from typing import Final

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
)

METADATA: Final = MetaData()

FOLDERS: Final = Table(
    "folders",
    METADATA,
    Column("path", Text, primary_key=True),
    Column("fingerprint", Text, nullable=False),
    Column("run", BigInteger, index=True),
    Column("reason", Text),
    Column("vanished", Boolean, nullable=False),
)
"""Every folder seen that is a run, or should be one: of which run, or why of none; `fingerprint` of its files."""

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
"""Runs: `record` is what was proved of the chain of hashes (`bench.catalogue.folder`), `problem` what is wrong."""

INSTRUMENTS: Final = Table(
    "instruments",
    METADATA,
    Column("id", BigInteger, primary_key=True, autoincrement=False),
    Column("name", Text, nullable=False, index=True),
    Column("driver", Text),
    Column("serial", Text, index=True),
)
"""Instruments: `name` is maker, model and serial number where that is known, else what answered, and where."""

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
"""Which run used which instrument as what (`voltmeter.x`, `head` …), under which certificate; what it answered."""

CALIBRATIONS: Final = Table(
    "calibrations",
    METADATA,
    Column("run", BigInteger, ForeignKey("runs.id", ondelete="CASCADE"), primary_key=True),
    Column("of_record", Boolean),
    Column("estimator", Text),
    Column("model", Text),
    Column("unit", Text, nullable=False),
    Column("g_m_s2", Float, nullable=False),
    Column("vector", LargeBinary, nullable=False),
    Column("covariance", LargeBinary, nullable=False),
    Column("u_meters", LargeBinary),
    Column("sigma", Float),
    Column("chi2", Float),
    Column("dof", Float),
    Column("p", Float),
    Column("used", Integer),
)
"""Results of `calibrate.json`: `vector` (12,) in `unit`/g, `covariance` (12, 12); `u_meters` (12,) is the part of u
that the same meters bring again. `of_record`: whether it names the head that the record has now, NULL if none."""

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
"""Verdicts of `verify.json`; of all points the largest Δg, in local g, with its sign."""

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
"""Certificates that this laboratory issued, as its registers tell: of which run, by name and head of its record."""

DUES: Final = Table(
    "dues",
    METADATA,
    Column("unit", Text, primary_key=True),
    Column("asked", Text, primary_key=True),
    Column("told", Text, nullable=False),
)
"""When units are due, as it was reckoned for a limit and an interval (`bench.catalogue.unit`), in JSON."""

OF_A_RUN: Final = (USES, CALIBRATIONS, VERIFICATIONS, POINTS, DIAGNOSES)
"""Tables whose rows belong to a run, and are made anew when it is read again."""

Index("ix_runs_unit_created", RUNS.c.unit, RUNS.c.created)
# what counts runs reads these alone
Index("ix_runs_of_units", RUNS.c.unit, RUNS.c.bench, RUNS.c.created, RUNS.c.simulated, RUNS.c.id)
Index("ix_runs_of_benches", RUNS.c.bench, RUNS.c.unit, RUNS.c.created, RUNS.c.simulated, RUNS.c.id)
Index("ix_runs_of_operators", RUNS.c.operator, RUNS.c.unit, RUNS.c.created, RUNS.c.simulated, RUNS.c.id)
Index("ix_verifications_verdict_run", VERIFICATIONS.c.verdict, VERIFICATIONS.c.run)


def key_of(*words: str) -> int:
    """Return the key, 63 bits, of what such words name."""
    digest = hashlib.sha256("\x1f".join(words).encode("utf-8", "surrogatepass")).digest()
    return int.from_bytes(digest[:8], "big") >> 1
