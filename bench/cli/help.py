"""help: lists the commands, or shows the help of one command."""

from __future__ import annotations

from typing import Annotated

import typer

from bench.cli.commands import ask_whole_help
from bench.cli.options import command
from bench.services.errors import Refused


@command("bench help run --all", "help")
def help(
    ctx: typer.Context,
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="[COMMAND]", help="Command to explain; all if left out.", show_default=False),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="List all commands, or all options.")] = False,
) -> int:
    """Show the commands, or the help of one."""
    context = ctx.parent
    if context is None:  # never, as the command is one of a group
        return 2
    if every:
        ask_whole_help(context)
    for word in command or ():
        found = (
            context.command.get_command(context, word) if hasattr(context.command, "get_command") else None
        )
        if found is None:
            raise Refused(f"unknown command '{' '.join(command or ())}'; 'bench help --all' lists all")
        context = typer.Context(found, parent=context, info_name=word)
    typer.echo(context.get_help())
    return 0
