"""Run folders of a small laboratory: short records with their chain of hashes, and results."""

import hashlib
import json
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from bench.config.shipped import find_bench
from bench.model.geometry import COEFFICIENTS

VECTOR = (-2.177, -0.018, 0.025, 0.027, -2.14, 0.033, 0.007, 0.006, -2.144, 0.071, -0.196, -0.412)
U = 2e-5
METER = """\
    - driver: keysight-34461a
      channels: [%(channel)s]
      resource: "TCPIP0::192.0.2.%(place)d::5025::SOCKET"
      range: 10 V
      certificate:
        number: "%(number)s"
        laboratory: Accredited Laboratory
        date: %(year)d-01-02
        valid_until: %(year)d-12-31
        serial: %(serial)s
        values: [{range: 10 V, gain: {U: 4 ppm, k: 2}, offset: {U: 5 uV, k: 2}}]
"""


def write_run(
    folder: Path,
    *,
    serial: str = "1",
    kind: str = "block A",
    bench: str = "bench-01",
    meters: tuple[str, str, str] = ("MY1", "MY2", "MY3"),
    created: str = "2026-03-01T08:00:00+00:00",
    simulated: bool = False,
    operator: str = "A. Example",
    shift: Any = 0.0,
    verdict: str = "pass",
    effects: tuple[str, ...] | None = None,
    calibrated: bool = True,
) -> Path:
    """Write a run folder with one reading; `shift` (12,) is added to the coefficients."""
    folder.mkdir(parents=True)
    bench_file = bench_text(bench, meters, int(created[:4]), kind).encode()
    (folder / "bench.yaml").write_bytes(bench_file)
    manifest = {
        "format": 1,
        "name": folder.name,
        "created": created,
        "dry_run": simulated,
        "operator": operator,
        "procedure": "procedures/paper.yaml",
        "plan_hash": "0" * 64,
        "unit_under_test": {"type": kind, "serial": serial},
        "versions": {"triaxial-bench": "0.1.0"},
        "files": {"bench.yaml": hashlib.sha256(bench_file).hexdigest()},
    }
    (folder / "run.json").write_text(json.dumps(manifest), encoding="utf-8")
    head = write_events(folder, events_of(created, meters))
    if calibrated:
        write_result(folder, np.add(VECTOR, shift), head)
        points = [{"angle_deg": 45.0, "delta_g": 1e-4, "u": 9e-5, "passed": verdict == "pass"}]
        whole = {"limit_g": 3e-4, "rule": "simple acceptance", "passed": verdict == "pass", "missing": 0}
        (folder / "verify.json").write_text(
            json.dumps({**whole, "statement": verdict, "points": [{**points[0], "statement": verdict}]})
        )
    if effects is not None:
        found = {"verdict": "named" if effects else "agrees", "effects": [{"name": e} for e in effects]}
        (folder / "diagnose.json").write_text(json.dumps(found), encoding="utf-8")
    return folder


def events_of(created: str, meters: tuple[str, str, str]) -> list[dict[str, Any]]:
    """Return the events of a run with one reading, without numbers and hashes."""
    begun = datetime.fromisoformat(created)
    names = [f"voltmeter.{channel}" for channel in "xyz"]
    identities = {n: f"Keysight Technologies 34461A {m} A.02" for n, m in zip(names, meters, strict=True)}
    reading = {
        "installation": "1", "series": 1, "pass": 1, "point": 1, "target_deg": 0.0, "angle_deg": 0.0,
        "direction": 1, "time_s": 1.0, "temperature_c": 23.5, "unit": "V", "mean": [0.1, -0.2, -2.5],
    }  # fmt: skip
    serials = {**dict(zip(names, meters, strict=True)), "head": ""}
    told: list[dict[str, Any]] = [
        {"type": "run_started", "step": 0, "instruments": {**identities, "head": "manual dividing head"}},
        {"type": "step_started", "step": 0, "key": "0001/read/1.1.1", "attempt": 1},
        {"type": "step_done", "step": 0, "key": "0001/read/1.1.1", "attempt": 1, "reading": reading},
        {"type": "run_finished"},
    ]
    told[0]["serials"] = serials
    for k, event in enumerate(told):
        event["time"] = (begun + timedelta(minutes=k)).isoformat()
    return told


def write_events(folder: Path, events: list[dict[str, Any]]) -> str:
    """Write a record with its chain of hashes; return the hash of its last line."""
    head = hashlib.sha256((folder / "run.json").read_bytes()).hexdigest()
    lines = []
    for n, event in enumerate(events, start=1):
        first = {"n": n, "time": event["time"], "bench_s": float(n), "type": event["type"]}
        line = json.dumps({**first, **event, "prev": head}, ensure_ascii=False).encode()
        head = hashlib.sha256(line).hexdigest()
        lines.append(line + b"\n")
    (folder / "events.jsonl").write_bytes(b"".join(lines))
    return head


def write_result(folder: Path, vector: Any, head: str) -> None:
    """Write calibrate.json with uncorrelated coefficients, each with the standard uncertainty `U`."""
    coefficients = {
        name: {"value": value, "u": U}
        for name, value in zip(COEFFICIENTS, np.asarray(vector).tolist(), strict=True)
    }
    result = {
        "estimator": "gls",
        "model": "paper",
        "unit": "V",
        "g_m_s2": 9.81,
        "coefficients": coefficients,
        "order": list(COEFFICIENTS),
        "covariance": (np.eye(12) * U**2).tolist(),
        "covariance_same_meters": (np.eye(12) * U**2 / 2).tolist(),
        "noise": {"reading_v": 1e-4},
        "residual": {"chi2": 40.0, "dof": 42, "p": 0.5},
        "readings": {"used": 1},
        "record": {"head": head},
    }
    (folder / "calibrate.json").write_text(json.dumps(result), encoding="utf-8")


def bench_text(name: str, serials: tuple[str, ...], year: int, kind: str) -> str:
    """Return the paper's bench file with another name, whose meters have certificates of a year."""
    text = find_bench("paper-stand").read_text(encoding="utf-8")
    text = "\n".join(line for line in text.splitlines() if not line.strip().startswith("#")) + "\n"
    before, rest = text.split("  voltmeters:\n")
    after = rest[rest.index("  head:") :]
    meters = ""
    for k, (channel, serial) in enumerate(zip("xyz", serials, strict=True)):
        number = f"{year}-{serial[-5:]}"
        meters += METER % {
            "channel": channel, "place": 20 + k, "serial": serial, "year": year, "number": number,
        }  # fmt: skip
    text = f"{before}  voltmeters:\n{meters}{after}".replace("name: paper-stand", f"name: {name}")
    return text.replace("type: triaxial block of the paper", f"type: {kind}")
