"""panel: the operator's panel in a browser, and who may come in."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from bench.cli import printing
from bench.cli.options import RUNS, RunsOption, app
from bench.services.errors import Refused


class What(StrEnum):
    """What is asked of the panel beside showing it."""

    TOKEN = "token"
    TOKENS = "tokens"
    REVOKE = "revoke"
    LINK = "link"


@app.command(epilog="Example: bench panel, or: bench panel token anna --role operator")
def panel(
    what: Annotated[
        What | None,
        typer.Argument(
            help="token NAME makes a person's token, tokens lists, revoke NAME takes it back; "
            "link makes a one-time link. Left out: the panel itself."
        ),
    ] = None,
    name: Annotated[str | None, typer.Argument(help="Of which person.")] = None,
    role: Annotated[str, typer.Option(help="viewer, operator or supervisor.")] = "operator",
    host: Annotated[
        str, typer.Option(help="Where to listen; beyond loopback only with tokens.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 8741,
    address: Annotated[
        str,
        typer.Option(metavar="URL", help="Address of a proxy with TLS before it, such as https://bench.lab."),
    ] = "",
    laboratory: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Laboratory file, whose register holds the certificates of the runs."
        ),
    ] = None,
    catalogue: Annotated[
        str, typer.Option(metavar="FILE|URL", help="Catalogue, which its pages on units show; only read.")
    ] = "",
    runs: RunsOption = RUNS,
) -> int:
    """Serve the operator's panel in a browser over a folder of runs; make the tokens of who may come in."""
    refuse_without_packages()
    from bench.panel.access import Settings
    from bench.panel.serving import serve

    if what is not None:
        return _of_people(what, name, role, runs)
    settings = Settings(runs, host, port, address.rstrip("/"), laboratory, catalogue)
    serve(settings, printing.console().print)
    return 0


def refuse_without_packages() -> None:
    """Raise `ImportError` where a package of the panel is missing."""
    import starlette  # noqa: F401 - only whether it is there
    import uvicorn  # noqa: F401


def link_to(run: str, runs: Path) -> str:
    """Return a link to the page of a run, in a panel that is begun where there is none. Raises `Refused`."""
    refuse_without_packages()
    from urllib.parse import quote

    from bench.panel.serving import open_panel
    from bench.run.events import RecordError

    try:
        return open_panel(runs, f"/runs/{quote(run)}/")
    except RecordError as error:
        raise Refused(str(error)) from error


def _of_people(what: What, name: str | None, role: str, runs: Path) -> int:
    """Make, list or take back what people sign in with."""
    from bench.panel.access import STATE, Access, Role
    from bench.panel.serving import is_serving, new_link

    out = printing.console()
    if what in {What.TOKEN, What.REVOKE} and name is None:
        raise Refused(f"say whose: bench panel {what} NAME")
    if role not in list(Role):
        raise Refused(f"--role {role}: there are {', '.join(Role)}")
    if what is What.LINK:
        if not is_serving(runs):
            raise Refused(
                f"{runs}: no panel serves this folder now; 'bench panel' begins one, and prints its link"
            )
        out.print(new_link(runs))
        return 0
    access = Access(runs / STATE)
    if what is What.TOKENS:
        shown = printing.table("name", "role", "made")
        for row in access.tokens():
            shown.add_row(row["name"], row["role"], row["made"][:16].replace("T", " "))
        out.print(shown if access.tokens() else "nobody has a token")
    elif what is What.REVOKE:
        access.revoke(str(name))
        out.print(f"{name}: the token is taken back, and who was signed in with it is signed out")
    else:
        out.print(f"the token of {name} ({role}), told this once: {access.new_token(str(name), Role(role))}")
    return 0
