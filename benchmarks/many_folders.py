"""Write many thousand simulated run folders like those of dry runs, but without page, log and samples.

    python -m benchmarks.many_folders 1000 /var/tmp/laboratory --seed 1 --benches 10 --units 100

One real dry run of the paper's points (54 readings and four verification points) is the template. The others
are drawn in numpy: units with a spread, meters that move between benches, mounting, setting and noise of each run.
Each folder has the inputs, a record with its true chain of hashes, and results. Covariance and residuals are those
of the template. The stated coefficients differ from the true ones by errors of this covariance, and by some u from
those that `bench calibrate` finds in the readings.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import special

from bench.base.arrays import ARCSEC, Floats
from bench.config.shipped import find_bench
from bench.model.geometry import (
    COEFFICIENTS,
    INSTALLATION_1,
    INSTALLATION_2,
    Installation,
    specific_force_on_platform,
)
from benchmarks.campaign import arguments, done
from drivers.clock import utc_now

# --- the truth: units, and their readings ---------------------------------------------------------------


FIRST_DAY: Final = datetime(2016, 1, 4, 6, tzinfo=UTC)
YEARS: Final = 10.0
UNIT_SPREAD: Final = 2e-3
STAND_SD: Final = np.array([5.0 / 3.0, 5.0 / 3.0, 30.0, 0.0, 0.0]) * ARCSEC
VERIFIED: Final = Installation.from_axes("V", ("x", "y", "z"), np.pi / 4)
INSTALLATIONS: Final = (INSTALLATION_1, INSTALLATION_2, VERIFIED)
WHERE: Final = np.repeat([0, 1, 2], [27, 27, 4])
TARGET_DEG: Final = np.concatenate([np.tile(np.arange(9) * 45.0, 6), np.arange(45.0, 360.0, 90.0)])


@dataclass(frozen=True)
class Truth:
    """The coefficients of the units (U, 12), and unit, bench and day (since the first) of each run."""

    units: Floats
    unit: np.ndarray[Any, np.dtype[np.int64]]
    bench: np.ndarray[Any, np.dtype[np.int64]]
    day: Floats

    @classmethod
    def drawn(cls, mean: Floats, count: int, benches: int, units: int, seed: int) -> Truth:
        random = np.random.default_rng([seed, 1])
        return cls(
            mean + random.normal(0.0, UNIT_SPREAD, (units, 12)),
            random.permutation(np.arange(count) % units),
            random.integers(0, benches, count),
            np.sort(random.uniform(0.0, YEARS * 365.25, count)),
        )


def forces(angles: Floats, stand: Floats) -> Floats:
    """Return the force (R, 58, 3) on the block for true angles (R, 58), rad, and stand angles (R, 3, 5)."""
    found = np.empty((*angles.shape, 3))
    for place, installation in enumerate(INSTALLATIONS):
        rows = place == WHERE
        many = angles[:, rows]
        mount = np.broadcast_to(stand[:, place, None], (*many.shape, 5))
        on_platform = specific_force_on_platform(many.ravel(), mount.reshape(-1, 5))
        found[:, rows] = (on_platform @ installation.block_from_platform.T).reshape(*many.shape, 3)
    return found


def signals(theta: Floats, force: Floats) -> Floats:
    """Return the signals K a + U0 (R, n, 3) for coefficients (R, 12)."""
    acting = np.einsum("rij,rnj->rni", theta[:, :9].reshape(-1, 3, 3), force)
    return np.asarray(acting + theta[:, None, 9:], dtype=np.float64)


# --- the folders -----------------------------------------------------------------------------------------


PROCEDURE: Final = """\
procedure: paper-once
title: The paper's points, one sample each, without warm-up
reading: {samples: 1, nplc: 10, settle: 0 s}
steps:
  - installation:
      label: 1
      steps:
        - repeat:
            directions: [rising, rising, rising]
            steps: [turn: {angles: {from: 0 deg, step: 45 deg, count: 9}}]
  - installation:
      label: 2
      steps:
        - repeat:
            directions: [rising, rising, rising]
            steps: [turn: {angles: {from: 0 deg, step: 45 deg, count: 9}}]
  - installation: {label: V, steps: [turn: {angles: [45 deg, 135 deg, 225 deg, 315 deg]}]}
"""
METER: Final = """\
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
TYPES: Final = ("triaxial block A", "triaxial block B", "triaxial block C")
OPERATORS: Final = ("A. Example", "B. Example", "C. Example", "D. Example", "E. Example")
LIMIT_G: Final = 3e-4
CHUNK: Final = 500


class Template:
    """The folder of a real dry run, divided into parts that are constant and parts that change."""

    def __init__(self, folder: Path) -> None:
        lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
        self.events: list[dict[str, Any]] = [json.loads(line) for line in lines]
        self.calibrated, self.verified, self.manifest = (
            json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
            for name in ("calibrate", "verify", "run")
        )
        self.covariance = np.array(self.calibrated["covariance"])
        self.theta = np.array([self.calibrated["coefficients"][name]["value"] for name in COEFFICIENTS])
        self.noise_v = float(self.calibrated["noise"]["reading_v"])
        self.fixed = {k: json.dumps(v, ensure_ascii=False) for k, v in self.calibrated.items()}
        compact = json.dumps(json.loads((folder / "plan.json").read_bytes()), separators=(",", ":"))
        procedure = (folder / "procedure.yaml").read_bytes()
        self.inputs = {"plan.json": compact.encode(), "procedure.yaml": procedure}
        self.hashes = {name: hashlib.sha256(content).hexdigest() for name, content in self.inputs.items()}
        self.parts = [self._parts(event) for event in self.events]

    def _parts(self, event: dict[str, Any]) -> tuple[str, str, str]:
        """Return the kind of an event line, its text before the time, and its text between the time and `prev`."""
        kind = "reading" if "reading" in event else "turn" if "angle_deg" in event else event["type"]
        rest = {k: v for k, v in event.items() if k not in ("n", "time", "prev")}
        text = json.dumps(rest, ensure_ascii=False)[1:-1]
        return kind, f'{{"n": {event["n"]}, "time": "', f'.{event["n"]:06}+00:00", {text}'


@dataclass
class Writer:
    """A writer of a laboratory's run folders."""

    template: Template
    truth: Truth
    out: Path
    seed: int
    bench_files: dict[tuple[int, int, int], tuple[str, bytes]] = field(default_factory=dict)

    def write(self) -> None:
        """Write all folders."""
        for begin in range(0, len(self.truth.unit), CHUNK):
            self._write_chunk(np.arange(begin, min(begin + CHUNK, len(self.truth.unit))))

    def _write_chunk(self, runs: np.ndarray[Any, np.dtype[np.int64]]) -> None:
        template, truth = self.template, self.truth
        random = np.random.default_rng([self.seed, 2, int(runs[0])])
        theta = truth.units[truth.unit[runs]]
        found = theta + random.multivariate_normal(np.zeros(12), template.covariance, len(runs))
        set_arcsec = np.round(random.normal(0.0, 2.0, (len(runs), len(WHERE))))
        read_rad = np.radians(TARGET_DEG) + set_arcsec * ARCSEC
        true_rad = read_rad + random.uniform(-0.5, 0.5, read_rad.shape) * ARCSEC
        stand = random.normal(size=(len(runs), 3, 5)) * STAND_SD
        seen = signals(theta, forces(true_rad, stand))
        seen = np.round(seen + random.normal(0.0, template.noise_v, seen.shape), 6)
        matrix = np.linalg.inv(found[:, :9].reshape(-1, 3, 3))
        g_p = np.linalg.norm(
            np.einsum("rij,rnj->rni", matrix, seen[:, WHERE == 2] - found[:, None, 9:]), axis=-1
        )
        angles = np.round(np.degrees(read_rad), 9)
        for k, run in enumerate(runs):
            self._write_run(int(run), angles[k], seen[k], found[k], g_p[k])

    def _write_run(self, run: int, angles: Floats, seen: Floats, found: Floats, g_p: Floats) -> None:
        unit, bench = int(self.truth.unit[run]), int(self.truth.bench[run])
        when = FIRST_DAY + timedelta(days=float(self.truth.day[run]))
        stamp = when.strftime("%Y-%m-%dT%H:%M:%S")
        kind = unit % len(TYPES)
        digest, bench_text = self._bench_file(bench, when.year, kind)
        folder = self.out / f"simulated-{run:06}"
        manifest = {
            **self.template.manifest, "name": folder.name, "created": f"{stamp}.000000+00:00", "seed": run,
            "operator": OPERATORS[(run // 7) % len(OPERATORS)], "procedure": "paper-once.yaml",
            "bench": f"bench-{bench:02}.yaml", "unit_under_test": {"type": TYPES[kind], "serial": f"{unit:05}"},
            "files": {**self.template.hashes, "bench.yaml": digest},
        }  # fmt: skip
        run_text = json.dumps(manifest).encode()
        serials = meters_of(bench, when.year)
        events, head = self._events(hashlib.sha256(run_text).hexdigest(), stamp, angles, seen, serials)
        files = {
            **self.template.inputs, "bench.yaml": bench_text, "run.json": run_text, "events.jsonl": events,
            "calibrate.json": self._calibrated(manifest, found, head, serials, bench),
            "verify.json": self._verified(g_p, angles[WHERE == 2], folder.name, bench, digest),
        }  # fmt: skip
        folder.mkdir()
        for name, content in files.items():
            (folder / name).write_bytes(content)

    def _bench_file(self, bench: int, year: int, kind: int) -> tuple[str, bytes]:
        """Return the hash and the text of a bench's file in a year, for blocks of a type."""
        if (bench, year, kind) not in self.bench_files:
            text = bench_text(f"bench-{bench:02}", meters_of(bench, year), year, TYPES[kind]).encode()
            self.bench_files[bench, year, kind] = hashlib.sha256(text).hexdigest(), text
        return self.bench_files[bench, year, kind]

    def _events(
        self, before: str, stamp: str, angles: Floats, seen: Floats, serials: tuple[str, ...]
    ) -> tuple[bytes, str]:
        """Return the record and its head (the hash of its last line)."""
        head = before
        lines, number = [], -1
        for (kind, first, rest), event in zip(self.template.parts, self.template.events, strict=True):
            text = rest
            if kind == "turn":
                number += 1
                text = _turned(rest, event["angle_deg"], angles[number])
            elif kind == "reading":
                reading = {**event["reading"], "angle_deg": angles[number], "mean": seen[number].tolist()}
                reading["samples"] = {c: [v] for c, v in zip("xyz", reading["mean"], strict=True)}
                text = rest[: rest.index('"reading": ')] + f'"reading": {json.dumps(reading)}'
            elif kind == "run_started":
                for was, now in zip(_answered(event), serials, strict=True):
                    text = text.replace(was, now)
            line = f'{first}{stamp}{text}, "prev": "{head}"}}'.encode()
            head = hashlib.sha256(line).hexdigest()
            lines.append(line)
        return b"\n".join([*lines, b""]), head

    def _calibrated(
        self, own: dict[str, Any], found: Floats, head: str, serials: tuple[str, ...], bench: int
    ) -> bytes:
        """Return calibrate.json of a run: the template's file with this run's values."""
        before = self.template.calibrated
        coefficients = {
            name: {**before["coefficients"][name], "value": value}
            for name, value in zip(COEFFICIENTS, found.tolist(), strict=True)
        }
        g = before["g_m_s2"]
        scales = {name: c for name, c in coefficients.items() if name[0] == "K"}
        per_ms2 = {name: {"value": c["value"] / g, "u": c["u"] / g} for name, c in scales.items()}
        meters = [
            m.replace(was, now).replace("of bench", f"of bench-{bench:02}")
            for m, was, now in zip(before["meters"], _answered(self.template.events[0]), serials, strict=True)
        ]
        changed = {
            "coefficients": coefficients,
            "coefficients_per_ms2": {"unit": before["coefficients_per_ms2"]["unit"], **per_ms2},
            "source": own["name"],
            "bench": _bench(before, own["name"], bench, own["files"]["bench.yaml"]),
            "made_at": own["created"], "unit_under_test": own["unit_under_test"], "meters": meters,
            "corrections": [], "record": {"events": len(self.template.events), "head": head},
        }  # fmt: skip
        texts = {**self.template.fixed, **{k: json.dumps(v) for k, v in changed.items()}}
        return ("{" + ", ".join(f'"{k}": {v}' for k, v in texts.items()) + "}\n").encode()

    def _verified(self, g_p: Floats, angles: Floats, name: str, bench: int, digest: str) -> bytes:
        """Return verify.json of a run: its Δg with the u of the template."""
        before, points = self.template.verified, []
        for was, value, angle in zip(before["points"], g_p.tolist(), angles.tolist(), strict=True):
            beyond = [float(special.ndtr((-LIMIT_G - s * (value - 1.0)) / was["u"])) for s in (-1, 1)]
            passed, false = abs(value - 1.0) <= LIMIT_G, sum(beyond)
            points.append({
                **was, "angle_deg": angle, "g_p": value, "delta_g": value - 1.0, "passed": passed,
                "statement": "pass" if passed else "fail", "p_false_accept": false if passed else None,
                "p_false_reject": None if passed else 1.0 - false,
            })  # fmt: skip
        passed = all(p["passed"] for p in points)
        whole = {
            **before, "passed": passed, "statement": "pass" if passed else "fail", "p_false_accept": None,
            "p_false_accept_worst": max(p["p_false_accept"] for p in points) if passed else None,
            "points": points, "bench": _bench(before, name, bench, digest), "corrections": [],
        }  # fmt: skip
        return (json.dumps(whole, ensure_ascii=False) + "\n").encode()


def meters_of(bench: int, year: int) -> tuple[str, ...]:
    """Return the serial numbers of a bench's meters; every third year the first meter moves to the next
    bench.
    """
    moved = (year - FIRST_DAY.year) // 3
    return f"MY54{(bench - moved) % 100:03}1", f"MY54{bench:03}2", f"MY54{bench:03}3"


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


def make_template(folder: Path) -> Template:
    """Make the dry run that is the template of the others."""
    folder.mkdir(parents=True)
    procedure, bench = folder / "paper-once.yaml", folder / "bench.yaml"
    procedure.write_text(PROCEDURE, encoding="utf-8")
    serials = ("MY53200001", "MY53200002", "MY53200003")
    bench.write_text(bench_text("bench", serials, utc_now().year, TYPES[0]), encoding="utf-8")
    words = ("run", procedure, "--bench", bench, "--dry-run", "--seed", "1", "--name", "template", "--runs")
    done(*words, folder)
    return Template(folder / "template")


def make_folders(count: int, out: Path, seed: int, benches: int, units: int) -> None:
    """Write `count` run folders into the new folder `out`."""
    out.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as place:
        template = make_template(Path(place) / "made")
        truth = Truth.drawn(template.theta, count, benches, units, seed)
        Writer(template, truth, out, seed).write()


def _answered(event: dict[str, Any]) -> tuple[str, ...]:
    """Return the serial numbers that the meters in the template reported."""
    return tuple(event["serials"][f"voltmeter.{channel}"] for channel in "xyz")


def _bench(before: dict[str, Any], name: str, bench: int, digest: str) -> dict[str, Any]:
    """Return the member of a result that describes its bench file."""
    own = {"name": f"bench-{bench:02}", "file": f"{name}/bench.yaml", "sha256": digest}
    return {**before["bench"], **own}


def _turned(text: str, before: float, angle: float) -> str:
    return text.replace(f'"angle_deg": {json.dumps(before)}', f'"angle_deg": {json.dumps(float(angle))}', 1)


def main() -> int:
    given = arguments(
        __doc__, count={"positional": True, "type": int}, out={"positional": True, "type": Path}, seed=1,
        benches=(0, "by default one for 2,000 runs, 3 at least"), units=(0, "by default one for ten runs"),
    )  # fmt: skip
    benches = given.benches or max(3, given.count // 2000)
    units = given.units or max(1, given.count // 10)
    begun = time.perf_counter()
    make_folders(given.count, given.out, given.seed, benches, units)
    took = time.perf_counter() - begun
    print(
        f"{given.count} folders, {benches} benches, {units} units: {took:.0f} s, {given.count / took:.0f} /s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
