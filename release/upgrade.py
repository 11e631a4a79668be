"""Does an upgrade keep what a laboratory has? `python -m release.upgrade [--from COMMIT]`.

An earlier program makes a finished and an interrupted run, a catalogue, a certificate, failures and a token; this
program then reads, verifies, resumes and continues them. The exit status is 1 if something is lost.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
FIRST: Final = "056dda05"
"""A commit of version 0.1.0."""

CERTIFY: Final = ("--laboratory", "laboratory.yaml", "--order", "order.yaml", "--authorised-by", "A. Example")
OLD: Final = (
    (0, ("init", "lab")),
    (0, ("run", "quick", "--dry-run", "--name", "one", "--operator", "A. Example")),
    (0, ("run", "quick", "--dry-run", "--name", "two", "--seed", "2")),
    (0, ("catalogue", "sync", "runs", "--catalogue", "lab.db")),
    (0, ("failures", "--laboratory", "laboratory.yaml")),
    (0, ("certificate", "one", *CERTIFY)),
    (0, ("panel", "token", "anna")),
)
"""What the earlier program does: exit status and arguments of each command."""
NEW: Final = (
    (0, ("runs",)),
    (0, ("show", "one")),
    (0, ("calibrate", "one")),
    (0, ("verify", "one")),
    (0, ("resume", "two")),
    (0, ("catalogue", "sync", "runs", "--catalogue", "lab.db")),
    (0, ("catalogue", "ask", "operator=A. Example", "--catalogue", "lab.db")),
    (0, ("failures", "--laboratory", "laboratory.yaml")),
    (0, ("certificate", "register", "--laboratory", "laboratory.yaml")),
    (0, ("certificate", "two", *CERTIFY)),
    (0, ("panel", "tokens")),
    (0, ("persons", "add", "A. Example", "--may", "administer,authorise", "--by", "A. Example",
         "--laboratory", "laboratory.yaml")),
    (0, ("certificate", "register", "--laboratory", "laboratory.yaml")),
    (0, ("show", "one", "--verify")),
)  # fmt: skip
"""What this program does with it."""


def called(source: Path, place: Path, arguments: tuple[str, ...]) -> tuple[int, str]:
    """Run a command of the program in a source folder; return its exit status and what it printed."""
    environment = {**os.environ, "PYTHONPATH": str(source), "XDG_CACHE_HOME": str(place / ".cache")}
    environment = {name: value for name, value in environment.items() if not name.startswith("BENCH_")}
    command = [sys.executable, "-c", "from bench.cli.program import main; main()", *arguments]
    done = subprocess.run(command, cwd=place, env=environment, capture_output=True, check=False, text=True)
    return done.returncode, (done.stdout + done.stderr).strip()


def upgraded(
    commit: str, place: Path, before: Sequence[tuple[int, tuple[str, ...]]] = OLD,
    after: Sequence[tuple[int, tuple[str, ...]]] = NEW,
) -> list[str]:  # fmt: skip
    """Return a sentence for each command that did not end as it must, of the earlier program and of this one."""
    old, laboratory, archive = place / "old", place / "laboratory", place / "old.tar"
    for folder in (old, laboratory):
        folder.mkdir()
    subprocess.run(["git", "-C", str(ROOT), "archive", "-o", str(archive), commit], check=True)
    shutil.unpack_archive(archive, old)
    wrong = []
    for which, source, commands in (("earlier", old, before), ("this", ROOT, after)):
        for status, arguments in commands:
            found, said = called(source, laboratory, arguments)
            if found != status:
                wrong.append(
                    f"{which} program: bench {' '.join(arguments)}: exit status {found}: {said[-400:]}"
                )
            if arguments == ("init", "lab"):
                for name in ("laboratory.yaml", "order.yaml"):
                    shutil.copy(laboratory / "lab/config/certificate" / name, laboratory)
            if arguments[:4] == ("run", "quick", "--dry-run", "--name") and "two" in arguments:
                _interrupt(laboratory / "runs" / "two" / "events.jsonl")
    return wrong


def _interrupt(events: Path) -> None:
    """Cut a record off in the middle of a line, as a power failure does."""
    content = events.read_bytes()
    events.write_bytes(content[: len(content) // 2])


def main() -> int:
    """Try the upgrade and print what is lost; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--from", dest="commit", default=FIRST)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="bench-upgrade-") as place:
        wrong = upgraded(asked.commit, Path(place))
    for line in wrong:
        print(line)
    print(f"{len(OLD) + len(NEW) - len(wrong)} of {len(OLD) + len(NEW)} commands ended as they must")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
