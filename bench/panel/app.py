"""The panel's application: which address leads to which page."""

from __future__ import annotations

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.routing import Route

from bench.panel import assets
from bench.panel.access.gate import Gate
from bench.panel.access.people import Refusal
from bench.panel.pages import live, refused, runs, sign_in
from bench.panel.panel import Panel
from bench.panel.settings import Settings
from bench.run.manifest import RecordError

ROUTES = [
    Route("/", runs.runs),
    Route("/sign-in", sign_in.sign_in, methods=["GET"]),
    Route("/sign-in", sign_in.signed_in, methods=["POST"]),
    Route("/sign-out", sign_in.sign_out, methods=["POST"]),
    Route("/static/{hash}/{name}", assets.send_asset),
    Route("/runs/{name}/", live.run),
    Route("/runs/{name}/state", live.state),
    Route("/runs/{name}/stream", live.stream),
    Route("/runs/{name}/check-answer", live.check_answer),
]


def make_app(settings: Settings) -> Starlette:
    """Return the application of a panel. Raises `RecordError` where it cannot keep what it keeps."""
    app = Starlette(
        routes=ROUTES,
        middleware=[Middleware(Gate, settings=settings, refuse=refused.refused)],
        exception_handlers={
            HTTPException: refused.by_framework,
            Refusal: refused.by_refusal,
            RecordError: refused.by_record,
        },
    )
    app.state.panel = Panel(settings)
    return app
