"""Reading a run folder for the catalogue: record, instruments and results become rows of its tables."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.files import read_json, read_regular
from bench.base.text import visible
from bench.base.yaml_files import FileMistakes
from bench.catalogue.store import key_of
from bench.certificate.register import Register
from bench.config.bench_file.file import BenchFile, load_recorded_bench
from bench.run.events import (
    EVENTS,
    MANIFEST,
    Manifest,
    RecordError,
    RunState,
    read_manifest,
    sha256,
    state_after_one,
)
from bench.run.folder import BENCH, CALIBRATE_FILE, DIAGNOSE_FILE, VERIFY_FILE, Run, statement_in
from bench.services.bench_selection import instrument_name
from bench.services.coefficients import coefficients_of, is_of_record
from bench.services.errors import Refused
from drivers.interfaces import NO_SERIAL

Row = dict[str, Any]


def instruments_of(bench: BenchFile | None, run: int, started: Mapping[str, Any]) -> dict[str, list[Row]]:
    """Return the rows of `instruments`, `certificates` and `uses` of a run; `started` is the run's first event."""
    answered = {str(k): str(v) for k, v in (started.get("instruments") or {}).items()}
    serials = {str(k): str(v).strip() for k, v in (started.get("serials") or {}).items()}
    instruments: dict[int, Row] = {}
    certificates: dict[int, Row] = {}
    uses = []
    sections = {section.name: section for section in bench.instruments.all()} if bench else {}
    for role, identity in answered.items():
        section = sections.get(role)
        resource = text_of(getattr(section, "resource", None))
        serial = serials.get(role, "")
        if serial in NO_SERIAL:
            serial = ""
        name = instrument_name(identity, serial, resource, bench.name if bench else "an unknown bench")
        instrument = key_of("instrument", name)
        driver = text_of(getattr(section, "driver", None))
        instruments[instrument] = {"id": instrument, "name": name, "driver": driver, "serial": serial or None}
        certificate = None
        if (stated := getattr(section, "certificate", None)) is not None:
            row = _certificate(stated)
            certificate = row["id"]
            certificates[row["id"]] = row
        uses.append(
            {
                "run": run,
                "role": role,
                "instrument": instrument,
                "certificate": certificate,
                "answered": identity,
                "resource": resource,
            }
        )
    return {"instruments": [*instruments.values()], "certificates": [*certificates.values()], "uses": uses}


def _certificate(stated: Any) -> Row:
    names = ("number", "laboratory", "date", "valid_until", "serial")
    row = {name: getattr(stated, name) for name in names}
    return {"id": key_of("certificate", *(str(value) for value in row.values())), **row}


def text_of(value: Any) -> str | None:
    """Return a text or number as text; None for an empty text and for any other value."""
    return str(value) if isinstance(value, str | int | float) and str(value) else None


_END: Final = b', "prev": "%s"}'
"""The end of each line of a record, with the hash of the previous line."""
_CHANGING: Final = re.compile(rb'"type": "(run_[a-z]+)"')
_OPENED: Final = frozenset({"run_started", "run_resumed"})
_STEP_OF_READING: Final = re.compile(rb'"type": "step_done", "step": (\d+), [^{}\n]*"reading": \{')
_TEMPERATURE: Final = re.compile(rb'"reading": \{[^{}\n]*"temperature_c": (-?[0-9.eE+-]+)')
_TIME: Final = re.compile(rb'"time": "([^"]{1,40})"')


class RecordSeen:
    """The results of a fast scan of a record: end of the hash chain, state of the run, steps with a reading."""

    def __init__(self, folder: Path, manifest: Manifest, manifest_sha256: str) -> None:
        self.folder = folder
        self.head, self.count, self.state = manifest_sha256, 0, RunState.READY
        self.problem = ""
        self.steps: set[bytes] = set()
        self.started: dict[str, Any] = {}
        self.whole = False
        self._temperatures: list[float] = []
        self._last = b""
        self._check_inputs(manifest)
        try:
            content = read_regular(folder / EVENTS)
        except FileNotFoundError:
            content = b""
        self._go_through(content)

    def _check_inputs(self, manifest: Manifest) -> None:
        for name, digest in manifest["files"].items():
            if Path(name).name != name:
                self.problem = f"{MANIFEST} names an input outside of the folder"
                return
            file = self.folder / name
            if not file.is_file() or sha256(read_regular(file)) != digest:
                self.problem = f"{name} was changed since the run began"

    def _go_through(self, content: bytes) -> None:
        lines = content.split(b"\n")[:-1]
        heads = [self.head.encode(), *(hashlib.sha256(line).hexdigest().encode() for line in lines)]
        count = next((k for k, line in enumerate(lines) if not line.endswith(_END % heads[k])), len(lines))
        if count < len(lines):
            self.problem = f"{EVENTS}, line {count + 1}: the chain is broken here"
        self.head, self.count = heads[count].decode(), count
        self._note(content[: sum(len(line) + 1 for line in lines[:count])])

    def _note(self, content: bytes) -> None:
        """Note state, readings, temperatures; an operator's text never matches: its quotation marks are escaped."""
        for found in _CHANGING.finditer(content):
            name = found.group(1).decode()
            self.state = state_after_one(self.state, name)
            if name in _OPENED and not self.started:
                begin, end = content.rfind(b"\n", 0, found.start()) + 1, content.index(b"\n", found.start())
                self.started = read_json(content[begin:end])
        self.steps = set(_STEP_OF_READING.findall(content))
        # both readings of a repeated step count in the mean
        told = _TEMPERATURE.findall(content) if self.steps else []
        self._temperatures = [float(value) for value in told]
        self._last = content[content.rfind(b"\n", 0, -1) + 1 :]

    def read_whole(self) -> None:
        """Read every event, as `bench show --verify` does."""
        if problems := Run(self.folder).history.problems:
            self.problem = "; ".join(problems)
        self.whole = True

    @property
    def proved(self) -> str:
        """How the record was verified: "read" (events), "chain" (hashes), "none" (no event), or "broken"."""
        if self.problem:
            return "broken"
        return ("read" if self.whole else "chain") if self.count else "none"

    @property
    def ended(self) -> datetime | None:
        """The UTC time of the last event, without a time zone; None before the run has ended."""
        if self.state in (RunState.READY, RunState.RUNNING, RunState.PAUSED):
            return None
        told = _TIME.search(self._last)
        return utc_of(told.group(1).decode()) if told else None

    @property
    def temperature_c(self) -> float | None:
        """Mean temperature (°C) of all readings, repeats included; None if no reading has a temperature."""
        finite = [value for value in self._temperatures if math.isfinite(value)]
        return sum(finite) / len(finite) if finite else None


def utc_of(text: Any) -> datetime | None:
    """Return an ISO 8601 time with a UTC offset as UTC without a zone; None for any other value."""
    try:
        when = datetime.fromisoformat(str(text))
    except ValueError:
        return None
    return when.astimezone(UTC).replace(tzinfo=None) if when.tzinfo else None


MOST: Final = 2**31 - 1
"""The largest whole number that an integer column can hold; keys use larger columns."""
_KEYS: Final = frozenset({"id", "run", "instrument", "certificate"})
_NOT_OURS: Final = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)
"""Errors in reading a file that another program wrote or changed."""


@dataclass(frozen=True)
class FolderEntry:
    """The catalogue's rows of a run folder, by table; without rows, `reason` says why there are none."""

    path: str
    fingerprint: str
    rows: dict[str, list[Row]] = field(default_factory=dict)
    reason: str = ""

    @property
    def run(self) -> int | None:
        """The key of the run; None if the folder holds no run."""
        return self.rows["runs"][0]["id"] if self.rows else None


def read_folder(path: str, fingerprint: str, *, whole: bool = False) -> FolderEntry:
    """Return the rows of a run folder, or the reason why it has none; `whole` reads every event of the record."""
    try:
        rows = _rows(Path(path), whole=whole).items()
        return FolderEntry(path, fingerprint, {name: [_storable(row) for row in own] for name, own in rows})
    except (RecordError, Refused) as error:
        return FolderEntry(path, fingerprint, reason=_in_a_line(error, path))
    except OSError as error:
        return FolderEntry(path, fingerprint, reason=f"cannot be read ({error.strerror})")
    except _NOT_OURS as error:
        why = f"not in the format of this program ({_in_a_line(error, path)})"
        return FolderEntry(path, fingerprint, reason=why)


def _rows(folder: Path, *, whole: bool) -> dict[str, list[Row]]:
    manifest = read_manifest(folder)
    if "files" not in manifest or "created" not in manifest:
        raise RecordError(f"{MANIFEST} lacks 'files' or 'created'; restore it from a copy")
    digest = sha256(read_regular(folder / MANIFEST))
    run = key_of("run", digest)
    record = RecordSeen(folder, manifest, digest)
    if whole:
        record.read_whole()
    bench, bench_sha256 = _bench_of(folder)
    unit: Any = manifest.get("unit_under_test") or {}
    imported = "imported" in manifest
    results = _results(folder, run, record)
    problem, bench_name = results.pop("problem"), results.pop("bench", None)
    said = {name: text_of(unit.get(name)) for name in ("type", "serial")}
    stated = said if any(said.values()) else _block_of(bench)
    whole_unit = " ".join(word for word in (stated["type"], stated["serial"]) if word) or None
    row = {
        "id": run,
        "manifest_sha256": digest,
        "path": str(folder),
        "vanished": False,
        "name": folder.name,
        "created": utc_of(manifest.get("created")),
        "ended": None if imported else record.ended,
        "imported": imported,
        "simulated": bool(manifest["dry_run"]) if "dry_run" in manifest else None,
        "state": "imported" if imported else record.state.value,
        "procedure": Path(str(manifest["procedure"])).stem if manifest.get("procedure") else None,
        "plan_hash": manifest.get("plan_hash") or None,
        "operator": manifest.get("operator") or None,
        "unit_type": stated["type"],
        "serial": stated["serial"],
        "unit": whole_unit,
        "bench": bench.name if bench else bench_name,
        "bench_sha256": bench_sha256,
        "temperature_c": record.temperature_c,
        "readings": int(manifest.get("readings", 0)) if imported else len(record.steps),
        "program_version": dict(manifest.get("versions") or {}).get("triaxial-bench"),
        "head": record.head if record.count else None,
        "events": record.count,
        "record": record.proved,
        "problem": record.problem or problem or None,
    }
    return {"runs": [row], **instruments_of(bench, run, record.started), **results}


def _storable(row: Row) -> Row:
    """Return a row in a form that every database accepts. Raises `ValueError` for a number too large."""
    for name, value in row.items():
        if isinstance(value, str) and not value.isprintable():
            row[name] = visible(value)
        elif isinstance(value, int) and not -MOST <= value <= MOST and name not in _KEYS:
            raise ValueError(f"{name} is {value:.3g}")
    return row


def _results(folder: Path, run: int, record: RecordSeen) -> dict[str, Any]:
    """Return the rows of a run's results by table; `problem` says what cannot be read, `bench` names the bench."""
    rows: dict[str, Any] = {"problem": ""}
    for name, read in (
        (CALIBRATE_FILE, _calibration),
        (VERIFY_FILE, _verification),
        (DIAGNOSE_FILE, _diagnosis),
    ):
        try:
            content = read_regular(folder / name)
        except FileNotFoundError:
            continue
        except OSError as error:
            rows["problem"] = f"{name} cannot be read ({error.strerror})"
            continue
        try:
            rows |= read(read_json(content), run, record)
        except (Refused, *_NOT_OURS) as error:
            rows["problem"] = f"{name} is not a result of this program ({_in_a_line(error, str(folder))})"
    return rows


def _calibration(data: Any, run: int, record: RecordSeen) -> dict[str, Any]:
    if is_of_record(data):
        return {}
    taken = coefficients_of(data, CALIBRATE_FILE)
    residual = data.get("residual") or {}
    noted = (data.get("record") or {}).get("head")
    shared = None
    if taken.same_meters is not None:
        shared = np.sqrt(np.maximum(np.diag(taken.covariance) - np.diag(taken.same_meters), 0.0))
    row = {
        "run": run,
        "of_record": None if noted is None else noted == record.head,
        "estimator": text_of(data.get("estimator")),
        "model": text_of(data.get("model")),
        "unit": taken.unit,
        "g_m_s2": taken.g_m_s2,
        "gravity_u": taken.gravity_u,
        "vector": _packed(taken.block.vector),
        "covariance": _packed(taken.covariance),
        "u_meters": None if shared is None else _packed(shared),
        "sigma": taken.noise,
        **{name: _number(residual.get(name)) for name in ("chi2", "dof", "p")},
        "used": int((data.get("readings") or {}).get("used", 0)) or None,
    }
    return {"calibrations": [row], "bench": text_of((data.get("bench") or {}).get("name"))}


def _verification(data: Any, run: int, record: RecordSeen) -> dict[str, list[Row]]:
    points = [
        {
            "run": run,
            "place": place,
            "angle_deg": _number(point.get("angle_deg")),
            "delta_g": float(point["delta_g"]),
            "u": _number(point.get("u")),
            "verdict": statement_in(point),
        }
        for place, point in enumerate(data["points"])
    ]
    sizes = [float(point["delta_g"]) for point in data["points"]]
    worst = max(sizes, key=abs, default=None)
    whole = {
        "run": run,
        "verdict": statement_in(data),
        "limit_g": _number(data.get("limit_g")),
        "rule": text_of(data.get("rule")),
        "worst_delta_g": worst,
        "missing": int(data.get("missing") or 0),
    }
    return {"verifications": [whole], "points": points}


def _diagnosis(data: Any, run: int, record: RecordSeen) -> dict[str, list[Row]]:
    names = ", ".join(dict.fromkeys(str(effect["name"]) for effect in data["effects"]))
    return {"diagnoses": [{"run": run, "verdict": str(data["verdict"]), "names": names}]}


def _bench_of(folder: Path) -> tuple[BenchFile | None, str | None]:
    """Return the bench file recorded with a run (None if it cannot be read) and its SHA-256."""
    file = folder / BENCH
    try:
        digest = sha256(read_regular(file))
    except OSError:
        return None, None
    return _loaded(digest, str(file)), digest


@lru_cache(maxsize=4096)
def _loaded(digest: str, file: str) -> BenchFile | None:
    """Return a bench file, cached by its SHA-256 (`digest`); None if it cannot be used."""
    try:
        return load_recorded_bench(Path(file))
    except (FileMistakes, OSError):
        return None


def _block_of(bench: BenchFile | None) -> dict[str, str | None]:
    unit = bench.unit_under_test if bench else None
    return {"type": (unit.type or None) if unit else None, "serial": (unit.serial or None) if unit else None}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _packed(array: Floats) -> bytes:
    return np.ascontiguousarray(array, dtype="<f8").tobytes()


def _in_a_line(error: Exception, path: str) -> str:
    """Return the message of an error in one line, without the folder, which is shown next to it."""
    return " ".join(str(error).replace(f"{path}/", "").removeprefix(f"{path}: ").split())[:300]


def issued_in(folder: str) -> list[Row]:
    """Return a row for each certificate in a folder's register. Raises `Refused` if it is damaged or unreadable."""
    register = Register(Path(folder)).read_lines()
    rows = []
    for number, standing in register.standings.items():
        record = standing.entry.data.get("record")
        rows.append(
            {
                "id": key_of("issued", folder, number),
                "register": folder,
                "number": number,
                "time": utc_of(standing.entry.time),
                "state": standing.state,
                "by": standing.by or standing.entry.by or None,
                "run": text_of(standing.entry.data.get("run")),
                "head": text_of(record.get("head")) if isinstance(record, dict) else None,
            }
        )
    return rows
