"""Measure a batch over many run folders: its duration, its memory, the effect of kills.

    python -m benchmarks.many_folders 10000 /var/tmp/laboratory --seed 1
    python -m benchmarks.batch_campaign busy '/var/tmp/laboratory/*' --count 10000
    python -m benchmarks.batch_campaign kills '/var/tmp/laboratory/*' --count 600 --kills 50 --seed 1

`busy` carries out one batch and reads the resident memory of its program and processes every second (in /proc, so
on Linux only). It prints the duration and the largest memory of both.

`kills` ends processes at random moments (SIGKILL): the program itself, a computing process, or the fork
server from which these are copied. The program is then restarted with the same command. At the end every run
must be in the result exactly once and in one part only, no part may have been rewritten, and the rows of a
sample must equal, number by number, those of a single calibration. Otherwise the exit status is 1.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Final

from pyarrow import parquet

from bench.batch.job import CALIBRATE, Job
from bench.batch.store import list_runs
from bench.batch.work import worked
from bench.model.geometry import COEFFICIENTS
from benchmarks.campaign import PROGRAM, amiss, arguments

_SAMPLE: Final = 20


def children_of(pid: int) -> list[int]:
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def workers_of(program: int) -> list[int]:
    """Return the computing processes, which are children of the program's fork server."""
    return [pid for child in children_of(program) for pid in children_of(child)]


def memory_of(pid: int) -> int:
    """Return the resident memory of a process, kB; 0 once it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")), 0)


def begin(over: str, runs: list[str], out: Path, options: argparse.Namespace) -> subprocess.Popen[bytes]:
    """Start the batch command over a folder of links to the runs."""
    more = [] if options.workers is None else ["--workers", str(options.workers)]
    command = [*PROGRAM, "batch", "calibrate", "--over", over, "--out", str(out), *more]
    log = (out.parent / "log.txt").open("ab")
    return subprocess.Popen(command, stdout=log, stderr=log)  # noqa: S603 - our own program


def chosen(options: argparse.Namespace, folder: Path) -> tuple[str, list[str]]:
    """Return the pattern of a folder with links to the selected runs, and the paths of these runs."""
    found = list_runs([options.over], Path("runs")).runs[: options.count]
    place = folder / "runs"
    place.mkdir()
    for number, run in enumerate(found):
        (place / f"{number:06}").symlink_to(run)
    return str(place / "*"), list(found)


# --- busy -------------------------------------------------------------------------------------------


def busy(options: argparse.Namespace, folder: Path) -> int:
    over, runs = chosen(options, folder)
    out = folder / "out"
    began, largest = time.monotonic(), Counter[str]()
    program = begin(over, runs, out, options)
    while program.poll() is None:
        time.sleep(1.0)
        largest["program"] = max(largest["program"], memory_of(program.pid))
        for pid in workers_of(program.pid):
            largest["process"] = max(largest["process"], memory_of(pid))
    print(f"{len(runs)} runs in {time.monotonic() - began:.0f} s")
    print(", ".join(f"largest {what} {kb / 1024:.0f} MB" for what, kb in largest.items()))
    return amiss(checked(out, runs, random.Random(options.seed)), "WRONG")  # noqa: S311 - to be repeated


# --- kills ------------------------------------------------------------------------------------------


def kills(options: argparse.Namespace, folder: Path) -> int:
    chance = random.Random(options.seed)  # noqa: S311 - to be repeated
    over, runs = chosen(options, folder)
    out = folder / "out"
    killed: Counter[str] = Counter()
    parts: dict[str, str] = {}
    wrong: list[str] = []
    program = begin(over, runs, out, options)
    while program.poll() is None or program.returncode not in {0, 1}:
        if program.poll() is not None:
            wrong += [] if program.returncode == -signal.SIGKILL else [f"it ended with {program.returncode}"]
            if len(wrong) > options.kills:
                break
            program = begin(over, runs, out, options)
        if sum(killed.values()) < options.kills and not workers_of(program.pid):
            time.sleep(0.2)  # the program has just started
        elif sum(killed.values()) < options.kills:
            time.sleep(chance.uniform(0.0, options.every))
            killed.update(kill_one(program, chance))
        else:
            time.sleep(1.0)
        wrong += written_again(out, parts)
    print(f"kills: {', '.join(f'{count} of {what}' for what, count in sorted(killed.items()))}")
    print(f"{len(runs)} runs, {len(parts)} parts")
    wrong += checked(out, runs, chance)
    print(f"{len(wrong)} faults")
    return amiss(wrong, "WRONG", 20)


def kill_one(program: subprocess.Popen[bytes], chance: random.Random) -> list[str]:
    """Kill at random one of those alive: the program, a computing process, or the fork server."""
    what = chance.choices(["the program", "a process", "the one of which they are copies"], [3, 6, 1])[0]
    pids = {
        "the program": [program.pid] if program.poll() is None else [],
        "a process": workers_of(program.pid),
        "the one of which they are copies": [one for one in children_of(program.pid) if children_of(one)],
    }[what]
    if not pids:
        return []
    try:
        os.kill(chance.choice(pids), signal.SIGKILL)
    except ProcessLookupError:
        return []
    if what == "the program":
        program.wait()
    return [what]


def written_again(out: Path, parts: dict[str, str]) -> Iterator[str]:
    """Record the new parts; yield a sentence for each earlier part that was rewritten."""
    for part in (out / "parts").glob("part-*.parquet"):
        mark = sha256(part.read_bytes()).hexdigest()
        if parts.setdefault(part.name, mark) != mark:
            yield f"{part.name} was written again"


# --- checks of the result --------------------------------------------------------------------------------


def checked(out: Path, runs: list[str], chance: random.Random) -> list[str]:
    """Return sentences on faults of a result: lost or repeated runs, and numbers that differ from a calibration."""
    table = parquet.read_table(out / "changes.parquet")
    counted = Counter(table["run"].to_pylist())
    in_parts: Counter[str] = Counter()
    for part in (out / "parts").glob("part-*.parquet"):
        in_parts.update(parquet.read_table(part, columns=["run"])["run"].to_pylist())
    wrong = [f"{run}: {counted[run]} times in the result" for run in runs if counted[run] != 1]
    wrong += [f"{run}: in {in_parts[run]} parts" for run in runs if in_parts[run] != 1]
    wrong += [f"{run}: nobody asked for it" for run in counted.keys() - set(runs)]
    rows = {row["run"]: row for row in table.to_pylist()}
    for run in chance.sample(runs, min(_SAMPLE, len(runs))):
        row = worked(Job(CALIBRATE, estimator="gls"), run)
        columns = [*COEFFICIENTS, *(f"u_{name}" for name in COEFFICIENTS)]
        wrong += [f"{run}: {name} is another number" for name in columns if rows[run][name] != row[name]]
    return wrong


def main() -> None:
    options = arguments(
        __doc__, what={"positional": True, "choices": ["busy", "kills"]},
        over={"positional": True, "help": "runs: a pattern, or a folder of runs"}, count=10000, kills=50,
        every=(20.0, "longest time between two kills, s"), seed=1, workers=int,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        sys.exit({"busy": busy, "kills": kills}[options.what](options, Path(name)))


if __name__ == "__main__":
    main()
