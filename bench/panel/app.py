"""The panel's web application: routes, connection limits, starting the server, one-time links to sign in."""

from __future__ import annotations

import asyncio
import errno
import getpass
import logging
import os
import socket
import threading
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote, urlsplit

import h11
from filelock import FileLock, Timeout
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from bench.base.files import from_text, read_regular, to_text, write_whole
from bench.base.text import as_typed
from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.panel.access import (
    PORT,
    STATE,
    Access,
    Gate,
    Refusal,
    Settings,
    is_held,
    is_loopback,
    private_folder,
)
from bench.panel.launching import Started, wait_until
from bench.panel.launching import start as start_program
from bench.panel.pages import bench, catalogue, procedure, queue, run, runs, sign_in, start, verdict
from bench.panel.shared import Panel, by_error, load, refused, send_asset
from bench.readings.csv import ReadingsError
from bench.run.events import RecordError
from bench.services.errors import Refused
from bench.services.requests.shared import runs_folder
from drivers.interfaces import BenchError

if TYPE_CHECKING:
    import uvicorn
    from starlette.types import ASGIApp

ROUTES = [
    Route("/", runs.runs),
    Route("/sign-in", sign_in.sign_in, methods=["GET"]),
    Route("/sign-in", sign_in.signed_in, methods=["POST"]),
    Route("/sign-out", sign_in.sign_out, methods=["POST"]),
    Route("/language/{name}", sign_in.choose_language),
    Route("/static/{hash}/{name}", send_asset),
    Route("/start", start.form, methods=["GET"]),
    Route("/start", start.check, methods=["POST"]),
    Route("/start/{wish}", start.found),
    Route("/start/{wish}/go", start.go, methods=["POST"]),
    Route("/queue", queue.queue, methods=["GET"]),
    Route("/queue", queue.changed, methods=["POST"]),
    Route("/queue/{item}", queue.item_changed, methods=["POST"]),
    Route("/procedures", procedure.procedures),
    Route("/procedures/form", procedure.ProcedureTable.form, methods=["GET"]),
    Route("/procedures/form", procedure.ProcedureTable.sent, methods=["POST"]),
    Route("/bench", bench.benches),
    Route("/bench/form", bench.BenchForm.form, methods=["GET"]),
    Route("/bench/form", bench.BenchForm.sent, methods=["POST"]),
    Route("/bench/search", bench.searched),
    Route("/bench/test", bench.test, methods=["POST"]),
    Route("/catalogue", catalogue.units),
    Route("/catalogue/unit/{unit:path}", catalogue.unit),
    Route("/catalogue/figure/{unit:path}", catalogue.figure),
    Route("/check", runs.check_block),
    Route("/check/chart", runs.chart),
    Route("/runs/{name}/", run.run),
    Route("/runs/{name}/answer", run.answer, methods=["POST"]),
    Route("/runs/{name}/wish", run.wish, methods=["POST"]),
    Route("/runs/{name}/control", run.control, methods=["POST"]),
    Route("/runs/{name}/resume", run.resume, methods=["POST"]),
    Route("/runs/{name}/give-up", run.give_up, methods=["POST"]),
    Route("/runs/{name}/outcome", run.outcome),
    Route("/runs/{name}/verdict", verdict.verdict),
    Route("/runs/{name}/view/{what}", verdict.view),
    Route("/runs/{name}/report", verdict.report),
    Route("/runs/{name}/diagnosis", verdict.diagnosis),
    Route("/runs/{name}/diagnose", verdict.diagnose, methods=["POST"]),
    Route("/runs/{name}/figures/{figure}", verdict.figure),
    Route("/runs/{name}/plots", verdict.plots),
    Route("/runs/{name}/plots/data", verdict.data),
    Route("/runs/{name}/plots/previous", verdict.previous),
    Route("/runs/{name}/plots/{table}.{form}", verdict.table),
    Route("/runs/{name}/certificate/{file}", verdict.certificate),
    Route("/runs/{name}/state", run.state),
    Route("/runs/{name}/stream", run.stream),
    Route("/runs/{name}/check-answer", run.check_answer),
]

KNOWN = (RecordError, FileMistakes, Refused, ReadingsError, BenchError, OSError, ImportError)
"""Errors with a message for the user: they concern records and files, not defects of the panel."""


def make_app(settings: Settings) -> Starlette:
    """Return the application of a panel. Raises `RecordError` if its folder cannot be used."""
    panel = Panel(settings)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        threading.Thread(target=prepare, args=(panel,), daemon=True).start()
        yield
        panel.followers.close()

    app = Starlette(
        routes=ROUTES,
        lifespan=lifespan,
        middleware=[Middleware(Gate, settings=settings, refuse=refused)],
        exception_handlers=dict.fromkeys((HTTPException, Refusal, *KNOWN), by_error),
    )
    app.state.panel = panel
    return app


LATE: Final = (
    "bench.calibration.conformity",
    "bench.calibration.verification",
    "bench.exchange.forms",
    "bench.services.calibration",
    "bench.services.check_block",
    "bench.services.execution",
    "bench.services.history",
    "bench.services.source",
    "bench.services.until",
    "bench.results.compare",
    "bench.results.control_chart",
    "bench.results.verification",
    "bench.results.diagnosis_parts",
)
LATE_OF_CATALOGUE: Final = (
    "bench.catalogue.questions",
    "bench.catalogue.store",
    "bench.catalogue.unit",
    "bench.results.catalogue",
)
"""Modules that pages import on first use, so that programs that only query the panel save about 1 s."""


def prepare(panel: Panel) -> None:
    """Load modules and templates and read the runs once, so that the first pages are fast."""
    load()
    load_bench(find_bench("paper-stand"))  # the first bench file also loads units and device drivers
    for name in LATE + LATE_OF_CATALOGUE * bool(panel.settings.catalogue):
        with suppress(ImportError):  # the page that needs a missing extra reports it
            import_module(name)
    panel.table.read_all()


ADDRESS: Final = "https://bench.lab"
"""An example of an address for browsers."""
MOST_CONNECTIONS: Final = 200
REQUEST_S: Final = 10.0
"""Longest time (s) for a request to arrive, with head and body."""

_UNFINISHED: Final = frozenset({h11.IDLE, h11.SEND_BODY})


class Connection(H11Protocol):
    """A connection that is closed if its request takes too long or there are too many connections."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for a request; above `MOST_CONNECTIONS`, abort the connection that has waited longest."""
        super().connection_made(transport)
        self._watch()
        living = [
            one for one in self.connections if isinstance(one, Connection) and not one.transport.is_closing()
        ]
        if len(living) > MOST_CONNECTIONS:
            waiting = {one: one._late.when() for one in living if one._late}
            min(waiting, key=waiting.__getitem__).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting for a request."""
        if self._late:
            self._late.cancel()
        super().connection_lost(exc)

    def shutdown(self) -> None:
        """Close a connection that is idle or follows a run: the server would wait for it, then cancel it."""
        super().shutdown()
        if self.cycle is not None and self.cycle.response_started and not self.cycle.response_complete:
            self.transport.close()

    def handle_events(self) -> None:
        """Process the data received, and check whether the request is complete."""
        super().handle_events()
        self._watch()

    def send_400_response(self, msg: str) -> None:
        """Respond to invalid HTTP, unless it is the late body of a request that was already answered."""
        if self.cycle is not None:
            self.cycle.disconnected = True  # discards the rest of a page's response
            self.cycle.message_event.set()
        with suppress(h11.LocalProtocolError):
            super().send_400_response(msg)
        self.transport.close()

    def _watch(self) -> None:
        if self.conn.their_state in _UNFINISHED:
            self._late = self._late or self.loop.call_later(REQUEST_S, self.transport.abort)
        elif self._late:
            self._late.cancel()
            self._late = None


class OncePerMinute(logging.Filter):
    """A log filter that passes all errors, but each warning at most once a minute: clients cannot fill the disk."""

    def __init__(self) -> None:
        super().__init__()
        self._last: dict[Any, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to write the record."""
        if record.levelno > logging.WARNING:
            return True
        before = self._last.get(record.msg)
        if before is not None and record.created - before < 60.0:
            return False
        self._last[record.msg] = record.created
        return True


ONCE: Final = OncePerMinute()


SERVER: Final = "server.json"
LOCK: Final = "server.lock"
OUTPUT: Final = "server.log"
LOOKS_S: Final = 2.0

OPEN_WIRE: Final = (
    "this is plain HTTP: others on the network can read and change everything, tokens too; put a proxy "
    "with TLS before it and give --address https://… (documentation, 'The panel: TLS')"
)


def serve(settings: Settings, tell: Callable[[str], None]) -> None:
    """Serve a panel until it is stopped; `tell` receives lines to show: address, one-time link, warnings.

    Raises `RecordError` if another panel serves the folder, if the address is not valid, if a panel on the network
    has no token with which to sign in, or if the port is not available.
    """
    import uvicorn

    check(settings)
    state = private_folder(settings.runs / STATE)
    lock = FileLock(state / LOCK, mode=0o600)
    try:
        lock.acquire(timeout=LOOKS_S)  # `is_serving` in another program may hold it for a moment
    except Timeout:
        raise RecordError(
            f"{settings.runs}: a panel already serves this folder at {url_of(settings.runs)}; "
            f"'{_panel('link', settings.runs)}' makes a one-time link to it"
        ) from None
    with lock, _listening(settings) as listener:
        settings = replace(settings, port=listener.getsockname()[1])
        app = make_app(settings)
        told = {"url": settings.url, "pid": os.getpid(), "loopback": settings.loopback}
        write_whole(state / SERVER, to_text(told))  # the socket listens already, so early clients wait
        tell(f"panel of the runs in {settings.runs}: {settings.url}")
        if settings.loopback:
            try:
                link = new_link(settings.runs, laboratory=settings.laboratory)
                tell(f"sign in, once, within half an hour: {link}")
            except Refused as why:
                tell(f"no link, sign in with your token: {why.typed}")
        elif not settings.address:
            tell(f"note: {OPEN_WIRE}")
        uvicorn.Server(config_of(app)).run(sockets=[listener])


def config_of(app: ASGIApp) -> uvicorn.Config:
    """Return the server configuration, with `Connection` as protocol and `OncePerMinute` as log filter."""
    import uvicorn

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
    """Raise `RecordError` for an invalid address, and for a panel on the network without any token."""
    address = urlsplit(settings.address)
    if settings.address and (address.scheme not in {"http", "https"} or not address.netloc or address.path):
        raise RecordError(
            f"--address {settings.address}: give the address as typed in a browser, such as {ADDRESS}"
        )
    access = Access(settings.runs / STATE, laboratory=settings.laboratory)
    if not settings.loopback and not access.tokens():
        raise RecordError(
            "access from other computers needs a token, and there is none; make one with "
            f"'{_new_token(access, settings.runs)}'"
        )


def _listening(settings: Settings) -> socket.socket:
    """Return a socket that listens at the panel's host and port. Raises `RecordError`."""
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
    except (OSError, UnicodeError) as error:
        no_host = isinstance(error, socket.gaierror | UnicodeError) or error.errno == errno.EADDRNOTAVAIL
        remedy = (
            "give --host an address of this computer"
            if no_host
            else "choose another --port, 0 for a free one"
        )
        why = getattr(error, "strerror", None) or error
        raise RecordError(
            f"--host {settings.host} --port {settings.port}: cannot listen there ({why}); {remedy}"
        ) from error
    return listener


def _panel(what: str, runs: Path) -> str:
    """Return the command `bench panel` with the words `what`, for a folder of runs, as typed at a shell."""
    is_default = runs.absolute() == runs_folder(None).absolute()
    return " ".join(filter(None, ["bench panel", what, "" if is_default else f"--runs {as_typed(runs)}"]))


def _new_token(access: Access, runs: Path) -> str:
    """Return the command that makes a token: of `bench persons` if there is a register of persons."""
    if access.persons is not None:
        return "bench persons change NAME --token"
    return _panel("token NAME --role operator", runs)


def url_of(runs: Path) -> str:
    """Return the address of the panel that last served a folder; an empty string if there was none."""
    try:
        told = from_text(read_regular(runs / STATE / SERVER))
        return str(told["url"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def is_serving(runs: Path) -> bool:
    """Return whether a panel serves this folder now."""
    if not (runs / STATE / LOCK).exists():
        return False
    return is_held(FileLock(runs / STATE / LOCK, mode=0o600))


def link_of(runs: Path, name: str = "", laboratory: Path | None = None) -> str:
    """Return a one-time link for a person to the panel of a folder. Raises `Refused` if no panel serves it."""
    if not is_serving(runs):
        raise Refused(
            f"{runs}: no panel serves this folder; '{_panel('', runs)}' starts one and prints its link"
        )
    return new_link(runs, "/", name, laboratory)


def open_panel(runs: Path, after: str = "/", name: str = "", laboratory: Path | None = None) -> str:
    """Start a panel if none serves the folder; return a one-time link as `new_link` does.

    Raises `RecordError` if the panel does not start, and the errors of `new_link`.
    """
    if not is_serving(runs):
        begin_panel(runs, laboratory=laboratory)
    return new_link(runs, after, name, laboratory)


_SLOW: Final = "starting takes too long; start the panel with 'bench panel'"


def begin_panel(runs: Path, ports: Sequence[int] = (PORT, 0), laboratory: Path | None = None) -> Started:
    """Start a panel that outlives this program, on the first free of `ports`. Raises `RecordError`."""
    state = private_folder(runs / STATE)
    trouble = ""
    for port in ports:
        (state / SERVER).unlink(missing_ok=True)
        of = [] if laboratory is None else [f"--laboratory={laboratory.absolute()}"]
        started = start_program(["panel", f"--runs={runs.absolute()}", f"--port={port}", *of], state / OUTPUT)
        try:
            if wait_until((state / SERVER).exists, started):
                return started
        except Refusal as refusal:
            trouble = refusal.text
    raise RecordError(f"{runs}: the panel did not start: {trouble or _SLOW}")


def new_link(runs: Path, after: str = "/", name: str = "", laboratory: Path | None = None) -> str:
    """Return a one-time link to a folder's panel, which signs an operator in and shows the page `after`.

    Raises `RecordError` if the panel is not on a loopback address, `Refused` as `Access.new_link`.
    """
    url, access = url_of(runs), Access(runs / STATE, laboratory=laboratory)
    if not is_loopback((urlsplit(url).hostname or "").strip("[]")):
        raise RecordError(
            f"the panel at {url} is open to other computers, where sign-in links do not work; make a token with "
            f"'{_new_token(access, runs)}'"
        )
    secret = access.new_link(name or login_name())
    return f"{url}/sign-in?link={secret}" + (f"&next={quote(after)}" if after != "/" else "")


def login_name() -> str:
    """Return the login name of the user of this computer."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return "operator"
