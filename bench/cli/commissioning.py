"""instruments --commission: a first evening with the instruments of a bench, from the command line."""

from __future__ import annotations

import sys
from pathlib import Path

from bench.cli import printing
from bench.services.errors import Refused


def commission_bench(
    bench: str | None, out: Path | None, target: str | None, *, dry_run: bool, seed: int
) -> int:
    """Commission a bench and print what was found: 0 all works, 1 something is otherwise, 2 not done.

    Raises `Refused` without a person or a folder, `FileMistakes`.
    """
    from bench.base.text import visible
    from bench.config.bench_file.file import load_bench
    from bench.results.commissioning import VERDICTS
    from bench.run.commission.session import WISHES
    from bench.run.terminal import TerminalPerson
    from bench.services.bench_selection import bench_path
    from bench.services.instruments import PAGE, Setting, commission, free_folder
    from drivers.clock import utc_now

    if not dry_run and not sys.stdin.isatty():
        raise Refused(
            "commissioning asks a person at every step and moves the head: start it in a terminal, or go "
            "through it with --dry-run on the simulated bench"
        )
    printing.check_target(target)
    path = bench_path(bench)
    file = load_bench(path)
    console = printing.console(json=target)
    folder = out or free_folder(utc_now())
    console.print(
        f"commissioning of {file.name} ({path}), {'SIMULATED' if dry_run else 'on the bench'}; type :skip REASON "
        "at a question to leave something out, :abort to end; Ctrl-C leaves the bench safe"
    )
    person = None if dry_run else TerminalPerson(sys.stdin, console, wishes=WISHES)
    result = commission(Setting(file, path, folder, person, seed, lambda line: console.print(visible(line))))
    printing.write_json([result], target)
    for name, what in result["to_do"].items():
        printing.aside(f"bench: still to do: {name}: {what}")
    if result["ended"]:
        printing.aside(f"bench: not gone through to its end: {result['ended']}")
    console.print(VERDICTS[result["status"]][1])
    printing.written("page", folder / PAGE, console)
    return int(result["status"])
