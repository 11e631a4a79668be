"""One server over one folder of runs: begun, found again, and a link to it."""

from __future__ import annotations

import getpass
import os
import socket
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import quote, urlsplit

from filelock import FileLock, Timeout

from bench.base.files import from_text, read_regular, to_text, write_whole
from bench.panel.access import PORT, STATE, Access, Refusal, Settings, is_loopback, private_folder
from bench.panel.launching import Started, start, wait_until
from bench.run.events import RecordError
from bench.services.errors import Refused

if TYPE_CHECKING:
    import uvicorn
    from starlette.types import ASGIApp

SERVER: Final = "server.json"
LOCK: Final = "server.lock"
OUTPUT: Final = "server.log"
LOOKS_S: Final = 2.0

OPEN_WIRE: Final = (
    "this is plain HTTP: what goes over the network can be read and changed on the way, tokens too; put a "
    "proxy with TLS before it and say --address https://… (documentation, 'The panel: TLS')"
)


def serve(settings: Settings, tell: Callable[[str], None]) -> None:
    """Serve until it is ended; `tell` is given the address, the link, and what is to be said of the network.

    Raises `RecordError` where another panel serves the folder, nobody could sign in, or it cannot listen there.
    """
    import uvicorn

    from bench.panel.app import make_app

    check(settings)
    state = private_folder(settings.runs / STATE)
    lock = FileLock(state / LOCK, mode=0o600)
    try:
        lock.acquire(timeout=LOOKS_S)  # who only looks whether a panel serves has it for a moment
    except Timeout:
        raise RecordError(
            f"{settings.runs}: a panel serves this folder already at {url_of(settings.runs)}; "
            "'bench panel link' makes a one-time link to it"
        ) from None
    with lock, _listening(settings) as listener:
        settings = replace(settings, port=listener.getsockname()[1])
        app = make_app(settings)
        told = {"url": settings.url, "pid": os.getpid(), "loopback": settings.loopback}
        write_whole(state / SERVER, to_text(told))  # it listens already: who connects now waits a moment
        tell(f"panel of the runs in {settings.runs}: {settings.url}")
        if settings.loopback:
            tell(f"sign in, once, within half an hour: {new_link(settings.runs)}")
        elif not settings.address:
            tell(f"look: {OPEN_WIRE}")
        uvicorn.Server(config_of(app)).run(sockets=[listener])


def config_of(app: ASGIApp) -> uvicorn.Config:
    """Return how an application is served: by our connections, with warnings about clients once a minute."""
    import uvicorn

    from bench.panel.app import ONCE, Connection
    from bench.panel.shared import LOG

    config = uvicorn.Config(
        app,
        http=Connection,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        ws="none",
        lifespan="on",
        timeout_graceful_shutdown=1,
    )
    LOG.addFilter(ONCE)
    return config


def check(settings: Settings) -> None:
    """Raise `RecordError` for an address that is none, and where others reach it and nobody has a token."""
    address = urlsplit(settings.address)
    if settings.address and (address.scheme not in {"http", "https"} or not address.netloc or address.path):
        raise RecordError(
            f"--address {settings.address}: give what a browser types, such as https://bench.lab"
        )
    if not settings.loopback and not Access(settings.runs / STATE).tokens():
        raise RecordError(
            "beyond this computer only who has a token comes in, and nobody has one: make one with "
            "'bench panel token NAME --role operator'"
        )


def _listening(settings: Settings) -> socket.socket:
    """Return the socket on which it listens. Raises `RecordError`."""
    try:
        (family, kind, _, _, address), *_ = socket.getaddrinfo(
            settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        listener = socket.socket(family, kind)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(128)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise RecordError(
            f"--host {settings.host} --port {settings.port}: cannot listen there ({error.strerror or error}); "
            "choose another --port, 0 for a free one"
        ) from error
    return listener


def url_of(runs: Path) -> str:
    """Return where the panel of a folder is, as it said itself when it began; empty where none ever did."""
    try:
        told = from_text(read_regular(runs / STATE / SERVER))
        return str(told["url"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def is_serving(runs: Path) -> bool:
    """Whether a panel serves this folder now."""
    if not (runs / STATE / LOCK).exists():
        return False
    lock = FileLock(runs / STATE / LOCK, mode=0o600)
    try:
        with lock.acquire(timeout=0):
            return False
    except Timeout:
        return True


def link_of(runs: Path) -> str:
    """Return a one-time link to the panel that serves a folder. Raises `Refused` where none does."""
    if not is_serving(runs):
        raise Refused(
            f"{runs}: no panel serves this folder now; 'bench panel' begins one, and prints its link"
        )
    return new_link(runs)


def open_panel(runs: Path, after: str = "/") -> str:
    """Return a link to the panel of a folder, which is begun as a program of its own where none serves it.

    It leads to the page `after`. Raises `RecordError` where no panel begins.
    """
    if not is_serving(runs):
        begin_panel(runs)
    return new_link(runs, after)


def begin_panel(runs: Path, ports: Sequence[int] = (PORT, 0)) -> Started:
    """Begin a panel that lives on by itself, at the first of these ports that is free; it serves when this returns.

    Raises `RecordError` where it does not begin.
    """
    state = private_folder(runs / STATE)
    trouble = ""
    for port in ports:
        (state / SERVER).unlink(missing_ok=True)
        started = start(["panel", f"--runs={runs.absolute()}", f"--port={port}"], state / OUTPUT)
        try:
            if wait_until((state / SERVER).exists, started):
                return started
        except Refusal as refusal:
            trouble = refusal.text
    raise RecordError(f"{runs}: no panel begins there: {trouble or 'it takes too long'}")


def new_link(runs: Path, after: str = "/") -> str:
    """Return a link to the panel of a folder that signs an operator in, once, and then shows the page `after`.

    Raises `RecordError` where the panel is to be reached from beyond this computer.
    """
    url = url_of(runs)
    if not is_loopback((urlsplit(url).hostname or "").strip("[]")):
        raise RecordError(
            f"links sign in on the bench's computer alone, and this panel is at {url or 'no address'}"
        )
    secret = Access(runs / STATE).new_link(login_name())
    return f"{url}/sign-in?link={secret}" + (f"&next={quote(after)}" if after != "/" else "")


def login_name() -> str:
    """Return under which name a person works on this computer."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return "operator"
