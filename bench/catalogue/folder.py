"""A run folder read for the catalogue: rows of its tables, or why there are none. Nothing is written."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.api.coefficients import coefficients_of
from bench.api.errors import Refused
from bench.base.arrays import Floats
from bench.base.forms import FileMistakes
from bench.base.json_text import read_json
from bench.base.regular import read_regular
from bench.base.visible import visible
from bench.catalogue.instruments import Row, instruments_of, text_of
from bench.catalogue.record import RecordSeen, utc_of
from bench.catalogue.schema import key_of
from bench.files.bench.file import BenchFile, load_recorded_bench
from bench.run.folder import BENCH, VERIFY
from bench.run.manifest import MANIFEST, RecordError, read_manifest, sha256

CALIBRATE: Final = "calibrate.json"
DIAGNOSE: Final = "diagnose.json"
MOST: Final = 2**31 - 1
"""The largest whole number that a column takes; keys are larger."""
_KEYS: Final = frozenset({"id", "run", "instrument", "certificate"})


@dataclass(frozen=True)
class Found:
    """What stands in a folder: the rows by table, or a `reason` why it is no run of the catalogue."""

    path: str
    fingerprint: str
    rows: dict[str, list[Row]] = field(default_factory=dict)
    reason: str = ""

    @property
    def run(self) -> int | None:
        """The key of the run, None where there is none."""
        return self.rows["runs"][0]["id"] if self.rows else None


def read_folder(path: str, fingerprint: str, *, whole: bool = False) -> Found:
    """Return the rows of a run folder, or why there are none; `whole` reads every event of its record."""
    try:
        rows = _rows(Path(path), whole=whole)
        return Found(path, fingerprint, {name: [_storable(row) for row in own] for name, own in rows.items()})
    except (RecordError, Refused) as error:
        return Found(path, fingerprint, reason=_in_a_line(error, path))
    except OSError as error:
        return Found(path, fingerprint, reason=f"cannot be read ({error.strerror})")
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        return Found(path, fingerprint, reason=f"not as this program writes it ({_in_a_line(error, path)})")


def _rows(folder: Path, *, whole: bool) -> dict[str, list[Row]]:
    manifest = read_manifest(folder)
    if "files" not in manifest or "created" not in manifest:
        raise RecordError(f"{MANIFEST} is of another program: it has no files or no created")
    digest = sha256(read_regular(folder / MANIFEST))
    run = key_of("run", digest)
    record = RecordSeen(folder, manifest, digest)
    if whole:
        record.read_whole()
    bench, bench_sha256 = _bench_of(folder)
    unit: Any = manifest.get("unit_under_test") or {}
    imported = "imported" in manifest
    results = _results(folder, run, record)
    said = {**_text_or_none(unit, "type", "serial")}
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
        "bench": bench.name if bench else _bench_named(results),
        "bench_sha256": bench_sha256,
        "temperature_c": record.temperature_c,
        "readings": int(manifest.get("readings", 0)) if imported else len(record.steps),
        "program_version": dict(manifest.get("versions") or {}).get("triaxial-bench"),
        "head": record.head if record.count else None,
        "events": record.count,
        "record": record.proved,
        "problem": record.problem or results.pop("problem") or None,
    }
    results.pop("problem", None)
    results.pop("bench", None)
    return {"runs": [row], **instruments_of(bench, run, record.started), **results}


def _storable(row: Row) -> Row:
    """Return a row as every database takes it. Raises `ValueError` for a number that is too large."""
    for name, value in row.items():
        if isinstance(value, str) and not value.isprintable():
            row[name] = visible(value)
        elif isinstance(value, int) and not -MOST <= value <= MOST and name not in _KEYS:
            raise ValueError(f"{name} is {value:.3g}")
    return row


def _results(folder: Path, run: int, record: RecordSeen) -> dict[str, Any]:
    """Return the rows of what was found of a run, and under `problem` what could not be read of it."""
    rows: dict[str, Any] = {"problem": ""}
    for name, read in ((CALIBRATE, _calibration), (f"{VERIFY}.json", _verification), (DIAGNOSE, _diagnosis)):
        try:
            content = read_regular(folder / name)
        except FileNotFoundError:
            continue
        except OSError as error:
            rows["problem"] = f"{name} cannot be read ({error.strerror})"
            continue
        try:
            rows |= read(read_json(content), run, record)
        except (
            Refused,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            OverflowError,
            RecursionError,
        ) as error:
            rows["problem"] = f"{name} is not a result of this program ({_in_a_line(error, str(folder))})"
    return rows


def _calibration(data: Any, run: int, record: RecordSeen) -> dict[str, Any]:
    taken = coefficients_of(data, CALIBRATE)
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
            "verdict": _statement(point),
        }
        for place, point in enumerate(data["points"])
    ]
    sizes = [float(point["delta_g"]) for point in data["points"]]
    worst = max(sizes, key=abs, default=None)
    whole = {
        "run": run,
        "verdict": _statement(data),
        "limit_g": _number(data.get("limit_g")),
        "rule": text_of(data.get("rule")),
        "worst_delta_g": worst,
        "missing": int(data.get("missing") or 0),
    }
    return {"verifications": [whole], "points": points}


def _diagnosis(data: Any, run: int, record: RecordSeen) -> dict[str, list[Row]]:
    names = ", ".join(dict.fromkeys(str(effect["name"]) for effect in data["effects"]))
    return {"diagnoses": [{"run": run, "verdict": str(data["verdict"]), "names": names}]}


def _statement(data: Any) -> str:
    """Return a verdict; results of versions before have no statement: they passed or failed."""
    return str(data.get("statement") or ("pass" if data["passed"] else "fail"))


def _bench_of(folder: Path) -> tuple[BenchFile | None, str | None]:
    """Return the bench file that a run recorded, None where it cannot be read, and its SHA-256."""
    file = folder / BENCH
    try:
        digest = sha256(read_regular(file))
    except OSError:
        return None, None
    return _loaded(digest, str(file)), digest


@lru_cache(maxsize=4096)
def _loaded(digest: str, file: str) -> BenchFile | None:
    """Read a bench file once for all runs that recorded the same."""
    try:
        return load_recorded_bench(Path(file))
    except (FileMistakes, OSError):
        return None


def _block_of(bench: BenchFile | None) -> dict[str, str | None]:
    unit = bench.unit_under_test if bench else None
    return {"type": (unit.type or None) if unit else None, "serial": (unit.serial or None) if unit else None}


def _bench_named(results: dict[str, Any]) -> str | None:
    """Return the bench that a result names, where the file itself cannot be read."""
    return results.get("bench")


def _text_or_none(data: Any, *names: str) -> dict[str, str | None]:
    return {name: text_of(data.get(name)) for name in names}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _packed(array: Floats) -> bytes:
    return np.ascontiguousarray(array, dtype="<f8").tobytes()


def _in_a_line(error: Exception, path: str) -> str:
    """Return a sentence without the folder, which stands beside it."""
    return " ".join(str(error).replace(f"{path}/", "").removeprefix(f"{path}: ").split())[:300]
