"""panel: the operator's panel in a browser, and access to it."""

from __future__ import annotations

from pathlib import Path

from bench.cli import printing
from bench.cli.options import command
from bench.services.errors import Refused
from bench.services.requests.documents import PeopleCommand, ServePanel
from bench.services.requests.shared import runs_folder


@command("bench panel, or: bench panel token anna --role operator")
def panel(request: ServePanel) -> int:
    """Serve the operator's panel in a browser.

    'bench panel token NAME' makes a token, with which NAME may sign in.
    """
    refuse_without_packages()
    from bench.panel.access import Settings
    from bench.panel.app import serve

    if request.what is not None:
        return _of_people(request, request.what)
    address = request.address.rstrip("/")
    settings = Settings(
        runs_folder(request.runs), request.host, request.port, address, request.laboratory, request.catalogue
    )
    serve(settings, printing.console().print)
    return 0


def refuse_without_packages() -> None:
    """Raise `ImportError` if a package that the panel needs is missing."""
    import starlette  # noqa: F401 - only whether it is there
    import uvicorn  # noqa: F401


def link_to(run: str, runs: Path, operator: str, laboratory: Path | None) -> str:
    """Return a link to a run's page for its operator; start the panel if it is not running. Raises `Refused`."""
    refuse_without_packages()
    from urllib.parse import quote

    from bench.panel.app import open_panel
    from bench.run.events import RecordError

    try:
        return open_panel(runs, f"/runs/{quote(run)}/", operator, laboratory)
    except RecordError as error:
        raise Refused(str(error)) from error


def _of_people(request: ServePanel, what: PeopleCommand) -> int:
    """Make, list or revoke tokens, or print a one-time link; return 0. Raises `Refused` for invalid options."""
    from bench.panel.access import STATE, Access, Role
    from bench.panel.app import link_of

    out, name, runs = printing.console(), request.name or "", runs_folder(request.runs)
    if what in {PeopleCommand.TOKEN, PeopleCommand.REVOKE} and not name:
        raise Refused(f"no person is named; give the name: bench panel {what} NAME")
    if request.role not in list(Role):
        raise Refused(f"--role {request.role}: choose from {', '.join(Role)}")
    if what is PeopleCommand.LINK:
        out.print(link_of(runs, name, request.laboratory))
        return 0
    access = Access(runs / STATE, laboratory=request.laboratory)
    match what:
        case PeopleCommand.TOKENS:
            shown = printing.table("name", "role", "made")
            for row in access.tokens():
                shown.add_row(row["name"], row["role"], row["made"][:16].replace("T", " "))
            out.print(shown if access.tokens() else "nobody has a token")
        case PeopleCommand.REVOKE:
            access.revoke(name)
            out.print(f"{name}: the token is withdrawn; its sessions are signed out")
        case _:
            token = access.new_token(name, Role(request.role))
            out.print(f"the token of {name} ({request.role}), shown only now: {token}")
    return 0
