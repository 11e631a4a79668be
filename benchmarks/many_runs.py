"""Make many run folders, and measure time and memory of a batch and of a catalogue over them.

    python -m benchmarks.many_runs make LABORATORY --count 100100 --benches 50 --units 1000 --seed 1
    python -m benchmarks.many_runs batch LABORATORY --count 10000
    python -m benchmarks.many_runs catalogue LABORATORY --hold-back 100 [--catalogue FILE|URL]

`make` carries out one dry run of the paper's points (54 readings and four verification points, one sample each),
and copies it. Each copy has a unit, a bench with its meters, a day and an operator of its own, and a true chain of
hashes; its readings and results are those of the dry run. `batch` prints the duration of `bench batch calibrate`,
and the largest memory of its program and processes (in /proc, so on Linux only). `catalogue` syncs all folders but
the last ones, then these, and asks questions.
"""

import argparse
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from benchmarks.campaign import PROGRAM, Cost, arguments, cost_of, done
from tests.support.laboratory import bench_text, write_events

# --- the folders -----------------------------------------------------------------------------------------

FIRST_DAY: Final = datetime(2016, 1, 4, 6, tzinfo=UTC)
YEARS: Final = 10.0
PASSES: Final = """\
  - installation:
      label: %d
      steps:
        - repeat:
            directions: [rising, rising, rising]
            steps: [turn: {angles: {from: 0 deg, step: 45 deg, count: 9}}]
"""
PROCEDURE: Final = f"""\
procedure: paper-once
title: The paper's points, one sample each, without warm-up
reading: {{samples: 1, nplc: 10, settle: 0 s}}
steps:
{PASSES % 1}{PASSES % 2}\
  - installation: {{label: V, steps: [turn: {{angles: [45 deg, 135 deg, 225 deg, 315 deg]}}]}}
"""
TYPES: Final = ("triaxial block A", "triaxial block B", "triaxial block C")
OPERATORS: Final = ("A. Example", "B. Example", "C. Example", "D. Example", "E. Example")
SERIALS: Final = ("MY53200001", "MY53200002", "MY53200003")


def make(given: argparse.Namespace) -> int:
    """Make the folders; by default one bench for 2,000 runs, 3 at least, and one unit for ten runs."""
    count, begun = given.count, time.perf_counter()
    benches, units = given.benches or max(3, count // 2000), given.units or max(1, count // 10)
    rng = np.random.default_rng(given.seed)
    unit, bench = rng.permutation(np.arange(count) % units), rng.integers(0, benches, count)
    day = np.sort(rng.uniform(0.0, YEARS * 365.25, count))
    given.folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as place:
        template = made_template(Path(place))
        for run in range(count):
            copied(template, given.folder, run, int(unit[run]), int(bench[run]), float(day[run]))
    took_s = time.perf_counter() - begun
    print(f"{count} folders, {benches} benches, {units} units: {took_s:.0f} s, {count / took_s:.0f} /s")
    return 0


def made_template(place: Path) -> dict[str, str]:
    """Return the texts of the files of a dry run, by name."""
    procedure, bench = place / "paper-once.yaml", place / "bench.yaml"
    procedure.write_text(PROCEDURE, encoding="utf-8")
    bench.write_text(bench_text("bench", SERIALS, datetime.now(UTC).year, TYPES[0]), encoding="utf-8")
    words = ("run", procedure, "--bench", bench, "--dry-run", "--seed", "1", "--name", "template", "--runs")
    done(*words, place)
    names = ("plan.json", "procedure.yaml", "run.json", "events.jsonl", "calibrate.json", "verify.json")
    return {name: (place / "template" / name).read_text(encoding="utf-8") for name in names}


@cache
def bench_of(bench: int, year: int, kind: int) -> tuple[tuple[str, str, str], str]:
    """Return the serial numbers of a bench's meters, and its bench file in a year.

    Every third year the first meter moves to the next bench.
    """
    moved = (year - FIRST_DAY.year) // 3
    serials = f"MY54{(bench - moved) % 100:03}1", f"MY54{bench:03}2", f"MY54{bench:03}3"
    return serials, bench_text(f"bench-{bench:02}", serials, year, TYPES[kind])


def copied(template: dict[str, str], out: Path, run: int, unit: int, bench: int, day: float) -> None:
    """Write one folder: the template with names of its own, and its chain of hashes."""
    kind, when = unit % len(TYPES), FIRST_DAY + timedelta(days=day)
    stamp, name = when.strftime("%Y-%m-%dT%H:%M:%S"), f"simulated-{run:06}"
    serials, bench_file = bench_of(bench, when.year, kind)
    digest = sha256(bench_file)
    manifest = json.loads(template["run.json"])
    block = {"type": TYPES[kind], "serial": f"{unit:05}"}
    manifest |= {
        "name": name, "created": f"{stamp}.000000+00:00", "seed": run, "bench": f"bench-{bench:02}.yaml",
        "operator": OPERATORS[(run // 7) % len(OPERATORS)], "unit_under_test": block,
        "files": {**manifest["files"], "bench.yaml": digest},
    }  # fmt: skip
    files = {"plan.json": template["plan.json"], "procedure.yaml": template["procedure.yaml"]}
    files |= {"bench.yaml": bench_file, "run.json": json.dumps(manifest)}
    folder = out / name
    folder.mkdir()
    for file, text in files.items():
        (folder / file).write_text(text, encoding="utf-8")
    lines = enumerate(_renamed(template["events.jsonl"], serials).splitlines(), 1)
    events = [{**json.loads(line), "time": f"{stamp}.{number:06}+00:00"} for number, line in lines]
    head = write_events(folder, events)
    for result in ("calibrate.json", "verify.json"):
        found = json.loads(_renamed(template[result], serials).replace("of bench", f"of bench-{bench:02}"))
        of = {"name": f"bench-{bench:02}", "file": f"{name}/bench.yaml", "sha256": digest}
        found |= {"bench": {**found["bench"], **of}, "corrections": []}
        if result == "calibrate.json":
            record = {"events": len(events), "head": head}
            found |= {
                "source": name,
                "made_at": manifest["created"],
                "unit_under_test": block,
                "record": record,
            }
        (folder / result).write_text(json.dumps(found) + "\n", encoding="utf-8")


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _renamed(text: str, serials: tuple[str, ...]) -> str:
    """Return a text in which the meters have other serial numbers."""
    for was, now in zip(SERIALS, serials, strict=True):
        text = text.replace(was, now)
    return text


# --- the batch -------------------------------------------------------------------------------------------


def batch(given: argparse.Namespace) -> int:
    """Carry out one batch over links to the first runs, and read its memory every second; return its status."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "runs").mkdir()
        runs = sorted(path for path in given.folder.resolve().iterdir() if path.is_dir())[: given.count]
        for run in runs:
            (folder / "runs" / run.name).symlink_to(run)
        words = ["batch", "calibrate", "--over", str(folder / "runs/*"), "--out", str(folder / "out")]
        began, largest = time.monotonic(), Counter[str]()
        with (folder / "log.txt").open("wb") as log:
            program = subprocess.Popen([*PROGRAM, *words], stdout=log, stderr=log)  # noqa: S603 - our own
            while program.poll() is None:
                time.sleep(1.0)
                largest["program"] = max(largest["program"], memory_of(program.pid))
                # the computing processes are children of the program's fork server
                for pid in (one for child in children_of(program.pid) for one in children_of(child)):
                    largest["process"] = max(largest["process"], memory_of(pid))
        print(f"{len(runs)} runs in {time.monotonic() - began:.0f} s, status {program.returncode}")
        print(", ".join(f"largest {what} {kb / 1024:.0f} MB" for what, kb in largest.items()))
    return program.returncode


def children_of(pid: int) -> list[int]:
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def memory_of(pid: int) -> int:
    """Return the resident memory of a process, kB; 0 once it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")), 0)


# --- the catalogue ---------------------------------------------------------------------------------------

QUESTIONS: Final[tuple[tuple[str, list[str], str], ...]] = (
    ("ask", ["meter=MY540012", "after=2017-05-03"], "units"), ("ask", ["certificate=2017-40012"], "runs"),
    ("ask", ["verdict=fail", "bench=bench-07"], "runs"),
    ("ask", ["verdict!=pass", "operator=A.*"], "runs"), ("ask", ["unit=*00000"], "coefficients"),
    ("ask", ["after=2017-09-01"], "runs"), ("ask", [], "units"), ("ask", [], "benches"),
    ("ask", ["bench=bench-07"], "instruments"), ("folders", ["bench=bench-07"], ""),
    ("table", ["bench=bench-07"], ""), ("unit", ["triaxial block A 00000"], ""),
)  # fmt: skip
"""Questions to the catalogue: for answers, folders of a batch, coefficients as arrays, a unit with its due date."""


def catalogue(given: argparse.Namespace) -> int:
    """Print the cost of a first sync, of a second sync of the reserved folders, and of questions."""
    runs = sorted(path for path in given.folder.iterdir() if path.is_dir())
    aside = given.folder.parent / f"{given.folder.name}-aside"
    held = runs[-given.hold_back :] if given.hold_back else []
    with tempfile.TemporaryDirectory() as place:
        where = given.catalogue or str(Path(place) / "catalogue.sqlite")
        aside.mkdir()
        try:
            for path in held:
                path.rename(aside / path.name)
            show_sync("first sync", cost_of(synced, where, str(given.folder)))
        finally:
            for path in held:
                (aside / path.name).rename(path)
            aside.rmdir()
        show_sync("second sync", cost_of(synced, where, str(given.folder)))
        found = cost_of(questioned, where)
    print(f"questions: peak {found.peak_mb:.0f} MB, load {os.getloadavg()[0]:.1f}")
    for words, rows, median_s, slowest_s in found.result:
        print(f"  {words:55} {rows:7} rows  {median_s:6.3f} s  {slowest_s:6.3f} s")
    return 0


def show_sync(what: str, found: Cost) -> None:
    sizes = f"{found.wall_s:.1f} s, processor {found.cpu_s:.1f} s, peak {found.peak_mb:.0f} MB"
    print(f"{what}: {sizes}, load {os.getloadavg()[0]:.1f}; {found.result}", flush=True)


def synced(where: str, folder: str) -> dict[str, Any]:
    """Sync a folder of runs; return the counts."""
    with open_catalogue(where) as opened:
        told = sync(opened, [folder])
    return {**vars(told), "problems": len(told.problems)}


def questioned(where: str) -> list[tuple[str, int, float, float]]:
    """Ask all questions five times, each time opening the catalogue.

    Return words, number of rows, median and slowest time (s) of each.
    """
    # the memory of a sync is without them
    from bench.catalogue.questions import answer, run_folders
    from bench.catalogue.unit import unit_history
    from bench.catalogue.values import coefficient_table

    found = []
    for kind, words, of in QUESTIONS:
        times_s, rows = [], 0
        for _ in range(5):
            begun = time.perf_counter()
            with open_catalogue(where, existing=True) as opened:
                match kind:
                    case "unit":
                        rows = len(unit_history(opened, words[0]).calibrations)
                    case "folders":
                        rows = len(run_folders(opened, words))
                    case "table":
                        rows = len(coefficient_table(opened, words))
                    case _:
                        rows = len(answer(opened, words, of))
            times_s.append(time.perf_counter() - begun)
        shown = " ".join([kind, *words, *(["--of", of] if of else [])])
        found.append((shown, rows, statistics.median(times_s), max(times_s)))
    return found


PARTS: Final = {"make": make, "batch": batch, "catalogue": catalogue}


def main() -> int:
    given = arguments(
        __doc__, part={"positional": True, "choices": PARTS}, folder={"positional": True, "type": Path},
        count=(10_000, "runs"), seed=1, benches=0, units=0, catalogue=("", "file or URL"),
        hold_back=(100, "folders of the second sync"),
    )  # fmt: skip
    return PARTS[given.part](given)


if __name__ == "__main__":
    sys.exit(main())
