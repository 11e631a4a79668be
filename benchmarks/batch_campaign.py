"""Measure a batch over many run folders: how busy its processes are, their memory, the effect of kills.

    python -m benchmarks.many_folders 10000 /var/tmp/laboratory --seed 1
    python -m benchmarks.batch_campaign busy '/var/tmp/laboratory/*' --count 10000
    python -m benchmarks.batch_campaign kills '/var/tmp/laboratory/*' --count 600 --kills 50 --seed 1

`busy` carries out one batch and observes its processes every second (in /proc, so on Linux only). It reports
in which share of their life after the first row the processes computed (CPU), and in which they computed or
waited for a core (from `schedstat`), because other programs compete for cores. On an otherwise idle machine
the two are equal. The rest of the time they waited for work from the program, or for the disk. Memory is the
resident set of the program and of the largest process, by tenths of the runs.

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
from dataclasses import dataclass, field
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
_TICKS: Final = os.sysconf("SC_CLK_TCK")


@dataclass
class Seen:
    """Observations of a process: times (s) of the first and the last one; CPU and queue times (s), and memory."""

    first: tuple[float, float, float]
    last: tuple[float, float, float]
    most_kb: int = 0


@dataclass
class Watch:
    """The processes of one batch, observed repeatedly."""

    program: int
    workers: dict[int, Seen] = field(default_factory=dict)
    memory: list[tuple[int, int, int]] = field(default_factory=list)

    def look(self, done: int) -> None:
        """Note times and memory of all living processes."""
        largest = 0
        for pid in workers_of(self.program):
            found = times_of(pid)
            if found is None:
                continue
            cpu, queued, kb = found
            now = (time.monotonic(), cpu, queued)
            one = self.workers.setdefault(pid, Seen(now, now))
            one.last, one.most_kb = now, max(one.most_kb, kb)
            largest = max(largest, kb)
        mine = times_of(self.program)
        if not largest:
            return  # all have ended: only the tables are still written
        self.memory.append((done, 0 if mine is None else mine[2], largest))

    def shares(self) -> tuple[float, float]:
        """Return the shares of their life in which the processes computed, and computed or waited for a core."""
        life, cpu, queued = (
            sum(one.last[k] - one.first[k] for one in self.workers.values()) for k in range(3)
        )
        return cpu / life, (cpu + queued) / life


def children_of(pid: int) -> list[int]:
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def workers_of(program: int) -> list[int]:
    """Return the computing processes, which are children of the program's fork server."""
    return [pid for child in children_of(program) for pid in children_of(child)]


def times_of(pid: int) -> tuple[float, float, int] | None:
    """Return CPU time (s), threads' queue time (s) and memory (kB) of a process; None once it has ended."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        queued = sum(
            int(task.joinpath("schedstat").read_text().split()[1])
            for task in Path(f"/proc/{pid}/task").iterdir()
        )
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return None
    kb = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")), 0)
    return (int(stat[11]) + int(stat[12])) / _TICKS, queued / 1e9, kb


def begin(over: str, runs: list[str], out: Path, options: argparse.Namespace) -> subprocess.Popen[bytes]:
    """Start the batch command over a folder of links to the runs."""
    more = [] if options.workers is None else ["--workers", str(options.workers)]
    command = [*PROGRAM, "batch", "calibrate", "--over", over, "--out", str(out), *more]
    log = (out.parent / "log.txt").open("ab")
    return subprocess.Popen(command, stdout=log, stderr=log)  # noqa: S603 - our own program


def rows_done(out: Path) -> int:
    return sum(parquet.read_metadata(part).num_rows for part in (out / "parts").glob("part-*.parquet"))


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
    began = time.monotonic()
    program = begin(over, runs, out, options)
    watch, first_row = Watch(program.pid), 0.0
    while program.poll() is None:
        time.sleep(1.0)
        done = rows_done(out) if (out / "parts").is_dir() else 0
        if done:
            first_row = first_row or time.monotonic()
            watch.look(done)
    lasted = time.monotonic() - began
    if not any(one.last > one.first for one in watch.workers.values()):
        sys.exit(f"{len(runs)} runs ended between two observations: give more, by --count")
    computed, wanted = watch.shares()
    print(f"{len(runs)} runs in {lasted:.0f} s, {lasted - (first_row - began):.0f} s after the first part")
    print(f"processes that computed, one after another: {len(watch.workers)}")
    print(f"share of their time: computing {computed:.1%}, computing or waiting for a core {wanted:.1%}")
    print("runs done   program, MB   largest process, MB")
    for tenth in range(1, 11):
        at = min(watch.memory, key=lambda one: abs(one[0] - tenth * len(runs) / 10))
        print(f"{at[0]:9}   {at[1] / 1024:11.0f}   {at[2] / 1024:19.0f}")
    wrong = checked(out, runs, random.Random(options.seed))  # noqa: S311 - to be repeated
    return amiss(wrong, "WRONG")


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
