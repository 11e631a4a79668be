"""Is a number ever lost, given twice, or a file left half written, when a program is killed while issuing?

    python -m benchmarks.certificate_kills --kills 100 --seed 1

A program issues certificates of runs, and is killed (SIGKILL) at a random moment, evenly spread over the time that
three certificates take here; `--programs 2` lets two of them issue at once, and kills both. After each kill the
register is opened, as the next program would: its chain is whole, every number has its files as they were issued,
numbers are 1, 2, 3, …, no run has two, nothing stands in the folder that nobody issued. Programs are started until
all runs are certified; then another round begins, until so many were killed. Exit status 1 where one of these does
not hold.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path

from bench.certificate.life import Desk, issue_all
from bench.certificate.register import LINES, MADE_FROM, opened
from bench.services.errors import Refused
from benchmarks.certificate_desk import prepare

NEEDED = (
    "bench.certificate.dcc.document", "bench.certificate.proof", "matplotlib.backends.backend_svg", "typst",
)  # fmt: skip
SPREAD = 3.0
"""A program is killed within the time of so many certificates."""


def start(desk: Desk, names: list[str]) -> int:
    """Let another program issue certificates of runs; return its process."""
    process = os.fork()
    if process:
        return process
    try:
        for _ in issue_all(names, desk):
            pass
    finally:
        os._exit(0)


def measured(desk: Desk, names: list[str]) -> float:
    """Return how long a certificate takes, s, the mean of a program's first ones.

    What they need is imported before, but nothing is typeset in this program: threads do not outlast a fork.
    """
    for name in NEEDED:
        import_module(name)
    begun = time.perf_counter()
    os.waitpid(start(desk, names), 0)
    return (time.perf_counter() - begun) / len(names)


def wrong_with(folder: Path) -> list[str]:
    """Say what does not hold in a register that was left behind."""
    try:
        with opened(folder) as register:
            wrong = register.damaged_files()
            entries = [standing.entry for standing in register.standings.values()]
    except Refused as error:
        return [str(error)]
    numbers = [int(entry.number.rsplit("-", 1)[1]) for entry in entries]
    if numbers != list(range(1, len(numbers) + 1)):
        wrong.append(f"numbers are {numbers}")
    runs = [entry.data["run"] for entry in entries]
    if len(set(runs)) < len(runs):
        wrong.append("a run was certified twice")
    known = {name for entry in entries for name in entry.files} | {LINES, MADE_FROM, ".register.lock"}
    strange = sorted(path.name for path in folder.iterdir() if path.name not in known)
    return [*wrong, *(f"{name} was issued by nobody" for name in strange)]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--programs", type=int, default=1)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args(arguments)
    moments = random.Random(asked.seed)  # noqa: S311 - moments, no secrets
    killed = rounds = issued = done = unfinished = failures = 0
    with tempfile.TemporaryDirectory() as place:
        desk, names = prepare(Path(place), asked.runs)
        folder = desk.laboratory.register_folder
        took = measured(desk, names[:3])
        folder.rename(folder.with_name("register-0"))
        print(f"a certificate takes {took:.2f} s here")
        while killed < asked.kills:
            programs = [start(desk, names) for _ in range(asked.programs)]
            time.sleep(moments.uniform(0.0, SPREAD * took * asked.programs))
            for process in programs:
                os.kill(process, signal.SIGKILL)
                _, status = os.waitpid(process, 0)
                killed += os.WIFSIGNALED(status)
            unfinished += any(folder.glob("*.part")) if folder.is_dir() else 0
            wrong = wrong_with(folder)
            failures += bool(wrong)
            for text in wrong:
                print(f"after {killed} kills: {text}")
            with opened(folder) as register:
                done = len(register.standings)
            if done == len(names):
                rounds, issued = rounds + 1, issued + done
                folder.rename(folder.with_name(f"register-{rounds}"))
        issued += done if done < len(names) else 0
    print(f"{killed} programs killed, {issued} certificates issued")
    print(f"{unfinished} times a file was left to be finished or taken away")
    print(f"{failures} registers were not as they should be")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
