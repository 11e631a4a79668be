"""The panel's application: which address leads to which page, and how connections are kept."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from importlib import import_module
from typing import Any, Final

import h11
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.panel.access import Gate, Refusal, Settings
from bench.panel.pages import catalogue, run, runs, sign_in, start, verdict
from bench.panel.shared import Panel, by_framework, by_record, by_refusal, load, refused, send_asset
from bench.readings.csv import ReadingsError
from bench.run.events import RecordError
from bench.services.errors import Refused
from drivers.interfaces import BenchError

ROUTES = [
    Route("/", runs.runs),
    Route("/sign-in", sign_in.sign_in, methods=["GET"]),
    Route("/sign-in", sign_in.signed_in, methods=["POST"]),
    Route("/sign-out", sign_in.sign_out, methods=["POST"]),
    Route("/static/{hash}/{name}", send_asset),
    Route("/start", start.form, methods=["GET"]),
    Route("/start", start.check, methods=["POST"]),
    Route("/start/{wish}", start.found),
    Route("/start/{wish}/go", start.go, methods=["POST"]),
    Route("/catalogue", catalogue.units),
    Route("/catalogue/unit/{unit:path}", catalogue.unit),
    Route("/catalogue/figure/{unit:path}", catalogue.figure),
    Route("/check", runs.check_block),
    Route("/runs/{name}/", run.run),
    Route("/runs/{name}/answer", run.answer, methods=["POST"]),
    Route("/runs/{name}/wish", run.wish, methods=["POST"]),
    Route("/runs/{name}/control", run.control, methods=["POST"]),
    Route("/runs/{name}/resume", run.resume, methods=["POST"]),
    Route("/runs/{name}/give-up", run.give_up, methods=["POST"]),
    Route("/runs/{name}/verdict", verdict.verdict),
    Route("/runs/{name}/report", verdict.report),
    Route("/runs/{name}/diagnosis", verdict.diagnosis),
    Route("/runs/{name}/diagnose", verdict.diagnose, methods=["POST"]),
    Route("/runs/{name}/figures/{figure}", verdict.figure),
    Route("/runs/{name}/certificate/{file}", verdict.certificate),
    Route("/runs/{name}/state", run.state),
    Route("/runs/{name}/stream", run.stream),
    Route("/runs/{name}/check-answer", run.check_answer),
]

KNOWN = (RecordError, FileMistakes, Refused, ReadingsError, BenchError, OSError, ImportError)
"""Errors that were made to be read by a person: what a record or a file is like is no defect of the panel."""


def make_app(settings: Settings) -> Starlette:
    """Return the application of a panel. Raises `RecordError` where it cannot keep what it keeps."""
    panel = Panel(settings)
    app = Starlette(
        routes=ROUTES,
        lifespan=_preparing(panel),
        middleware=[Middleware(Gate, settings=settings, refuse=refused)],
        exception_handlers={
            HTTPException: by_framework,
            Refusal: by_refusal,
            **dict.fromkeys(KNOWN, by_record),
        },
    )
    app.state.panel = panel
    return app


LATE: Final = (
    "bench.calibration.conformity",
    "bench.calibration.verification",
    "bench.services.check_block",
    "bench.services.execution",
    "bench.results.control_chart_page",
    "bench.results.verification",
)
LATE_OF_CATALOGUE: Final = (
    "bench.catalogue.questions",
    "bench.catalogue.store",
    "bench.catalogue.unit",
    "bench.results.catalogue",
)
"""What pages import when they are first asked for: a second's work, which a program that only asks is spared."""


def prepare(panel: Panel) -> None:
    """Load what the first pages would load, and read the runs once, so that nobody waits for it."""
    load()
    load_bench(find_bench("paper-stand"))  # units and devices are loaded by the first file that names some
    for name in LATE + LATE_OF_CATALOGUE * bool(panel.settings.catalogue):
        with suppress(ImportError):  # an extra that is missing is told by the page that needs it
            import_module(name)
    panel.table.read_all()


def _preparing(panel: Panel) -> Callable[[Starlette], AbstractAsyncContextManager[None]]:
    """Return what prepares the panel while it begins to serve."""

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        threading.Thread(target=prepare, args=(panel,), daemon=True).start()
        yield
        panel.followers.close()

    return lifespan


MOST_CONNECTIONS: Final = 200
REQUEST_S: Final = 10.0
"""A request, head and body, must have arrived within this time."""

_UNFINISHED: Final = frozenset({h11.IDLE, h11.SEND_BODY})


class Connection(H11Protocol):
    """A connection that is closed where its request takes too long, or where there are too many connections."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for a request; beyond `MOST_CONNECTIONS` the one that has waited longest is closed, or this one."""
        super().connection_made(transport)
        self._watch()
        living = [
            one for one in self.connections if isinstance(one, Connection) and not one.transport.is_closing()
        ]
        if len(living) > MOST_CONNECTIONS:
            waiting = {one: one._late.when() for one in living if one._late}
            min(waiting, key=waiting.__getitem__).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        if self._late:
            self._late.cancel()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Take what has arrived; see whether the request is whole now."""
        super().handle_events()
        self._watch()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, unless it follows a request that was answered before its body had come."""
        if self.cycle is not None:
            self.cycle.disconnected = True  # what a page still answers has nowhere to go
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
    """Passes each warning once in a minute: what a client does wrong must not fill the disk. Errors pass."""

    def __init__(self) -> None:
        super().__init__()
        self._last: dict[Any, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is written."""
        if record.levelno > logging.WARNING:
            return True
        before = self._last.get(record.msg)
        if before is not None and record.created - before < 60.0:
            return False
        self._last[record.msg] = record.created
        return True


ONCE: Final = OncePerMinute()
