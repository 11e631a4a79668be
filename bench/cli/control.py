"""control: a wish left for the program that carries out a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import RUNS, RunArgument, RunsOption, app
from bench.services.errors import Refused


@app.command(epilog='Example: bench control unit-17 skip "the cable came loose"')
def control(
    run: RunArgument,
    wish: Annotated[
        str, typer.Argument(help="pause, continue, redo (the point), redo-pass, remount, skip, stop, abort.")
    ],
    reason: Annotated[str, typer.Argument(help="Why; a skip needs it.")] = "",
    runs: RunsOption = RUNS,
) -> int:
    """Ask something of a run that another program is carrying out; typed at a prompt it is :pause, :redo, …"""
    from bench.run.events import Wish
    from bench.run.folder import find_run
    from bench.run.person import SIGN, at_the_shell, leave_wish, parse_wish
    from bench.run.record import is_being_written

    found = find_run(run, runs)
    try:
        asked = replace(parse_wish(f"{wish} {reason}"), by_person=False, who=at_the_shell("command"))
    except ValueError as mistake:
        raise Refused(str(mistake).replace(SIGN, "")) from mistake
    if not is_being_written(found.folder):
        raise Refused(f"{found.name}: nobody is carrying out this run; 'bench runs' tells how to go on")
    leave_wish(found.folder, asked)
    when = "at once" if asked.wish is Wish.STOP else "before the next step, or at the question that stands"
    printing.console().print(f"{found.name}: {asked.wish} is asked for; it is heard {when}")
    return 0
