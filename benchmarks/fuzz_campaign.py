"""What do twenty thousand inputs that nobody expects do to the program? Promised: a sentence each, no more.

    python -m benchmarks.fuzz_campaign --inputs 20000 --seed 1 --jobs 2

Readings, bench files, procedures, model files, results, records, names, SCPI to the simulated meters, answers
at prompts, values at the edges, pipes for files, damaged catalogues, calls from Python, each made from the seed
and its number (`fuzz_inputs`, `fuzz_edges`), tried in a worker process (`fuzz_trials`).
Judged: no traceback, no message of a mistake that nobody foresaw, no character that acts on a terminal, one of
the promised statuses, nothing taken that must be refused (no finite signal, a covariance that none is, a wrong
unit, a key twice, a changed record, …), no hang: a worker that takes too long over an input is ended, and
another goes on behind it. Prints a table by kind and every violation; exit status 1 when there is one. One
input again: `--only readings:17`.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final

import matplotlib

from benchmarks.fuzz_trials import KINDS, Violation, own_folder, tried

CPU_S, LIMIT_S = 30.0, 300.0
"""An input hangs that takes so much CPU time, or is silent for so long: a busy machine is no fault."""

SHARES: Final = {
    "readings": 4,
    "bench": 4,
    "procedure": 4,
    "model": 2,
    "result": 3,
    "record": 2,
    "names": 2,
    "scpi": 3,
    "answers": 3,
    "edges": 5,
    "special": 2,
    "catalogue": 1,
    "python": 3,
}
"""How many inputs of each kind there are, of 38; those that cost most are fewest."""


def inputs(count: int) -> list[tuple[str, int]]:
    """Return kind and number of so many inputs, or a few more."""
    rounds = -(-count // sum(SHARES.values()))
    return [(kind, number) for kind in KINDS for number in range(rounds * SHARES[kind])]


def work(link: Connection, seed: int, parent: str) -> None:
    """Try inputs as they are asked for, until nothing more comes."""
    os.environ["MPLCONFIGDIR"] = matplotlib.get_cachedir()  # a list of fonts takes half a minute to make
    os.environ["XDG_CACHE_HOME"] = parent
    import bench.cli.app  # noqa: F401 - what takes long to import is no input

    for kind, number in iter(link.recv, None):
        with own_folder(Path(parent)):
            found = tried(kind, seed, number)
        link.send((found, time.process_time()))


class Worker:
    """A process that tries inputs, one at a time, and is ended where it stays silent."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._folder = tempfile.TemporaryDirectory()
        self.cpu_s = 0.0
        self.at: tuple[str, int] | None = None
        self._start()

    def _start(self) -> None:
        self._own = tempfile.mkdtemp(dir=self._folder.name)
        self.link, far = get_context("spawn").Pipe()
        self._process = get_context("spawn").Process(target=work, args=(far, self._seed, self._own))
        self._process.start()
        far.close()
        self._cpu_s = 0.0

    def give(self, which: tuple[str, int]) -> None:
        """Ask for an input."""
        self.at, self._since, self._before_s = which, time.monotonic(), self._spent_s()
        self.link.send(which)

    def taken(self) -> list[Violation]:
        """Return what was found with the input; of a worker that died that it did."""
        kind, number = self.at or ("", 0)
        self.at = None
        try:
            found, cpu_s = self.link.recv()
        except EOFError:
            self._again()
            return [Violation(kind, number, "died", "the process ended")]
        self.cpu_s, self._cpu_s = self.cpu_s + cpu_s - self._cpu_s, cpu_s
        violations: list[Violation] = found
        return violations

    def hangs(self) -> list[Violation]:
        """Return that the input hangs, where it does; the process is then another."""
        if self.at is None:
            return []
        silent_s, spent_s = time.monotonic() - self._since, self._spent_s() - self._before_s
        if silent_s < LIMIT_S and spent_s < CPU_S:
            return []
        (kind, number), self.at = self.at, None
        self._again()
        return [Violation(kind, number, "hang", f"silent for {silent_s:.0f} s, {spent_s:.0f} s of CPU")]

    def _spent_s(self) -> float:
        """Return the CPU time of the process until now, 0 where the system does not tell."""
        try:
            words = (
                Path(f"/proc/{self._process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
            )
            return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        except (OSError, ValueError, IndexError):
            return 0.0

    def _again(self) -> None:
        self._process.kill()
        self._process.join()
        self.link.close()
        self._start()

    def close(self) -> None:
        """End the process."""
        self.link.send(None)
        self._process.join()
        self._folder.cleanup()


def campaign(which: Iterable[tuple[str, int]], seed: int, jobs: int) -> tuple[list[Violation], float]:
    """Try inputs on so many processes; return the violations and the CPU time, s."""
    left = iter(which)
    workers = [Worker(seed) for _ in range(jobs)]
    found: list[Violation] = []
    more = True
    while more or any(worker.at for worker in workers):
        for worker in workers:
            if worker.at is None and more:
                following = next(left, None)
                more = following is not None
                if following is not None:
                    worker.give(following)
        ready = wait([worker.link for worker in workers if worker.at], timeout=1.0)
        for worker in workers:
            new = worker.taken() if worker.link in ready else worker.hangs()
            for violation in new:
                print(told(violation), flush=True)
            found += new
    for worker in workers:
        worker.close()
    return found, sum(worker.cpu_s for worker in workers)


def told(violation: Violation) -> str:
    """Return a violation as it is printed."""
    return f"--- {violation.kind}:{violation.number} {violation.what}\n{violation.how.rstrip()}"


def table(counts: dict[str, int], found: list[Violation]) -> str:
    """Return the table by kind of input."""
    words = sorted(
        {violation.what for violation in found} | {"traceback", "unforeseen", "obeyed", "accepted", "hang"}
    )
    lines = [f"{'input':12}{'tried':>8}" + "".join(f"{word:>12}" for word in words)]
    for kind, count in (*counts.items(), ("all", sum(counts.values()))):
        of = Counter(v.what for v in found if kind in {v.kind, "all"})
        lines.append(f"{kind:12}{count:8}" + "".join(f"{of[word]:12}" for word in words))
    return "\n".join(lines)


def main(arguments: Any = None) -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=KINDS)
    parser.add_argument("--only", metavar="KIND:NUMBER")
    given = parser.parse_args(arguments)
    which = [(kind, number) for kind, number in inputs(given.inputs) if kind in given.kinds]
    if given.only:
        kind, _, number = given.only.partition(":")
        which = [(kind, int(number))]
    begun = time.monotonic()
    found, cpu_s = campaign(which, given.seed, given.jobs)
    print(table(dict(Counter(kind for kind, _ in which)), found))
    print(
        f"{(time.monotonic() - begun) / 60:.1f} min, {cpu_s / 60:.1f} min of CPU, "
        f"{given.jobs} processes, seed {given.seed}"
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
