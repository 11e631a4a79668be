"""What a catalogue of many calibrations costs: the first sync, a second one with 100 new runs, and questions.

    python -m benchmarks.many_folders 100100 /var/tmp/laboratory --seed 1 --benches 50
    python -m benchmarks.catalogue_speed /var/tmp/laboratory --hold-back 100 [--catalogue FILE|URL]

The last folders are put aside for the second sync, and put back. Each step is a process of its own: wall clock,
processor time of it and of the processes it starts, peak of memory of the largest of them, MB, and load of the
computer. A question is timed from opening the catalogue to its rows; the median and the slowest of five.
"""

from __future__ import annotations

import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from benchmarks.campaign import Cost, arguments, cost_of

QUESTIONS: Final[tuple[tuple[str, list[str], str], ...]] = (
    ("ask", ["meter=MY540012", "after=2017-05-03"], "units"), ("ask", ["certificate=2017-40012"], "runs"),
    ("ask", ["verdict=fail", "bench=bench-07"], "runs"),
    ("ask", ["verdict!=pass", "operator=A.*"], "runs"), ("ask", ["unit=*00000"], "coefficients"),
    ("ask", ["after=2017-09-01"], "runs"), ("ask", [], "units"), ("ask", [], "benches"),
    ("ask", ["bench=bench-07"], "instruments"), ("folders", ["bench=bench-07"], ""),
    ("table", ["bench=bench-07"], ""), ("unit", ["triaxial block A 00000"], ""),
)  # fmt: skip
"""What is asked: of answers, of folders for a batch, of coefficients as arrays, of a unit with its date due."""


def synced(where: str, folder: str) -> dict[str, Any]:
    """Sync a folder of runs."""
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.sync import sync

    with open_catalogue(where) as catalogue:
        done = sync(catalogue, [folder])
    return {**vars(done), "problems": len(done.problems)}


def asked(where: str, kind: str, words: list[str], of: str) -> int:
    """Ask one question; return how many rows it has."""
    from bench.catalogue.questions import answer, run_folders
    from bench.catalogue.store import open_catalogue
    from bench.catalogue.unit import unit_history
    from bench.catalogue.values import coefficient_table

    with open_catalogue(where, existing=True) as catalogue:
        if kind == "unit":
            return len(unit_history(catalogue, words[0]).calibrations)
        if kind == "folders":
            return len(run_folders(catalogue, words))
        if kind == "table":
            return len(coefficient_table(catalogue, words))
        return len(answer(catalogue, words, of))


def questioned(where: str) -> list[tuple[str, int, float, float]]:
    """Ask all questions five times; return words, rows, median and slowest, s."""
    told = []
    for kind, words, of in QUESTIONS:
        times = []
        for _ in range(5):
            begun = time.perf_counter()
            rows = asked(where, kind, words, of)
            times.append(time.perf_counter() - begun)
        shown = " ".join([kind, *words, *(["--of", of] if of else [])])
        told.append((shown, rows, statistics.median(times), max(times)))
    return told


def main() -> int:
    """Print a table."""
    given = arguments(__doc__, folder={"positional": True, "type": Path}, catalogue="", hold_back=100)
    runs = sorted(path for path in given.folder.iterdir() if path.is_dir())
    aside = given.folder.parent / f"{given.folder.name}-aside"
    with tempfile.TemporaryDirectory() as place:
        where = given.catalogue or str(Path(place) / "catalogue.sqlite")
        aside.mkdir()
        held = runs[-given.hold_back :] if given.hold_back else []
        try:
            for path in held:
                path.rename(aside / path.name)
            _print("first sync", cost_of(synced, where, str(given.folder)))
        finally:
            for path in held:
                (aside / path.name).rename(path)
            aside.rmdir()
        _print("second sync", cost_of(synced, where, str(given.folder)))
        found = cost_of(questioned, where)
        print(f"questions: peak {found.peak_mb:.0f} MB, load {os.getloadavg()[0]:.1f}")
        for words, rows, median, slowest in found.result:
            print(f"  {words:55} {rows:7} rows  {median:6.3f} s  {slowest:6.3f} s")
    return 0


def _print(what: str, found: Cost) -> None:
    sizes = f"{found.wall_s:.1f} s, processor {found.cpu_s:.1f} s, peak {found.peak_mb:.0f} MB"
    print(f"{what}: {sizes}, load {os.getloadavg()[0]:.1f}; {found.result}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
