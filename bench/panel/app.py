"""The panel's application: which address leads to which page."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from importlib import import_module
from typing import Final

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.routing import Route

from bench.base.yaml_files import FileMistakes
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.panel import look
from bench.panel.access import Gate, Refusal
from bench.panel.pages import catalogue, check, control, live, runs, shown, sign_in, start, verdict
from bench.panel.panel import Panel
from bench.panel.settings import Settings
from bench.readings.csv import ReadingsError
from bench.run.events import RecordError
from bench.services.errors import Refused
from drivers.interfaces import BenchError

ROUTES = [
    Route("/", runs.runs),
    Route("/sign-in", sign_in.sign_in, methods=["GET"]),
    Route("/sign-in", sign_in.signed_in, methods=["POST"]),
    Route("/sign-out", sign_in.sign_out, methods=["POST"]),
    Route("/static/{hash}/{name}", look.send_asset),
    Route("/start", start.form, methods=["GET"]),
    Route("/start", start.check, methods=["POST"]),
    Route("/start/{wish}", start.found),
    Route("/start/{wish}/go", start.go, methods=["POST"]),
    Route("/catalogue", catalogue.units),
    Route("/catalogue/unit/{unit:path}", catalogue.unit),
    Route("/catalogue/figure/{unit:path}", catalogue.figure),
    Route("/check", check.check),
    Route("/runs/{name}/", live.run),
    Route("/runs/{name}/answer", control.answer, methods=["POST"]),
    Route("/runs/{name}/wish", control.wish, methods=["POST"]),
    Route("/runs/{name}/control", control.control, methods=["POST"]),
    Route("/runs/{name}/resume", control.resume, methods=["POST"]),
    Route("/runs/{name}/give-up", control.give_up, methods=["POST"]),
    Route("/runs/{name}/verdict", verdict.verdict),
    Route("/runs/{name}/report", verdict.report),
    Route("/runs/{name}/diagnosis", verdict.diagnosis),
    Route("/runs/{name}/diagnose", verdict.diagnose, methods=["POST"]),
    Route("/runs/{name}/figures/{figure}", verdict.figure),
    Route("/runs/{name}/certificate/{file}", verdict.certificate),
    Route("/runs/{name}/state", live.state),
    Route("/runs/{name}/stream", live.stream),
    Route("/runs/{name}/check-answer", live.check_answer),
]

KNOWN = (RecordError, FileMistakes, Refused, ReadingsError, BenchError, OSError, ImportError)
"""Errors that were made to be read by a person: what a record or a file is like is no defect of the panel."""


def make_app(settings: Settings) -> Starlette:
    """Return the application of a panel. Raises `RecordError` where it cannot keep what it keeps."""
    panel = Panel(settings)
    app = Starlette(
        routes=ROUTES,
        lifespan=_preparing(panel),
        middleware=[Middleware(Gate, settings=settings, refuse=shown.refused)],
        exception_handlers={
            HTTPException: shown.by_framework,
            Refusal: shown.by_refusal,
            **dict.fromkeys(KNOWN, shown.by_record),
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
    look.load()
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
