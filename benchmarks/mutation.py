"""Test the tests: small faults are put into the calibration and the runner, one at a time.

    python -m benchmarks.mutation --mutants 30 --seed 1

mutmut changes a copy of the program (an operator, a number, an omitted argument) and runs the tests that reach the
changed function, except those marked slow, until one fails: the mutant is killed. A random sample, drawn with the
seed, represents all mutants. Each survivor is shown with its change for a person to judge, because many change
nothing of importance (the words of a message, an unused default). The exit status is 1 if fewer are killed than
`--least` demands.
"""

import os
import random
import subprocess
import sys
from collections import Counter

from benchmarks.campaign import ROOT, arguments

FIRST = "bench.calibration.linear.*__mutmut_1"
"""Name of a few mutants: they start the run, in which all mutants are made and the tests are timed."""


def mutmut(*arguments: str) -> str:
    """Run mutmut on this tree and return its output; a failure ends the program with this output."""
    command = [sys.executable, "-m", "mutmut", *arguments]
    environment = {
        k: v for k, v in os.environ.items() if k != "PYTHONPATH"
    }  # so that mutmut's copy is imported
    done = subprocess.run(  # noqa: S603 - a tool of our own environment
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        sys.exit(done.stdout[-4000:] + done.stderr)
    return done.stdout


def verdicts() -> dict[str, str]:
    """Return the state of each mutant by name: "killed", "survived", "not checked", …"""
    lines = (line.strip() for line in mutmut("results", "--all", "true").splitlines())
    return dict(line.split(": ", 1) for line in lines if "__mutmut_" in line)


def main() -> int:
    given = arguments(
        __doc__, mutants=(30, "how many are tried"), seed=(1, "which are tried"),
        least=(0.0, "the share that is to be killed"), processes=os.cpu_count() or 1,
    )  # fmt: skip
    children = ("--max-children", str(given.processes))

    mutmut("run", *children, FIRST)
    names = sorted(verdicts())
    chosen = random.Random(given.seed).sample(names, min(given.mutants, len(names)))  # noqa: S311 - a sample
    mutmut("run", *children, *chosen)
    found = {name: verdict for name, verdict in verdicts().items() if name in set(chosen)}

    survivors = sorted(name for name, verdict in found.items() if verdict != "killed")
    for name in survivors:
        print(f"\n{found[name]}: {mutmut('show', name)}")
    rooms = Counter(name.rpartition(".")[0] for name in chosen)
    lived = Counter(name.rpartition(".")[0] for name in survivors)
    print(f"\n{'module':44}{'tried':>7}{'killed':>8}")
    for room, tried in sorted(rooms.items()):
        print(f"{room:44}{tried:7}{tried - lived[room]:8}")
    killed = len(chosen) - len(survivors)
    print(f"{'all':44}{len(chosen):7}{killed:8}   of {len(names)} mutants, seed {given.seed}")
    return 0 if killed >= given.least * len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
