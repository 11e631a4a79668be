"""One run, as it goes on: the page, and what its script is sent."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from typing import Final

from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse

from bench.base.numbers import without_infinity
from bench.panel.access import Refusal
from bench.panel.acting import looking, panel_of, person_of
from bench.panel.following.stream import as_event
from bench.panel.pages.shown import page
from bench.run.events import RecordError
from bench.run.folder import Run
from bench.run.person import AskedPrompt, problem_with_answer, understood_answer

MOST_STREAMS: Final = 30
"""Live pages of one person at a time: each holds a connection."""


def run_of(request: Request) -> Run:
    """Return the run that a request names. Raises `Refusal` for a stranger, and where there is none."""
    looking(request)
    return panel_of(request).runs.run(request.path_params["name"])


async def run(request: Request) -> Response:
    """Show a run, as it is now; the script goes on from there."""
    found = run_of(request)
    state = await panel_of(request).followers.state(found.folder)
    return page(request, "run.html.j2", state=state, state_json=json.dumps(without_infinity(state)))


async def state(request: Request) -> Response:
    """Send what is told of a run now, see `bench.panel.following.snapshot`."""
    found = run_of(request)
    return JSONResponse(without_infinity(await panel_of(request).followers.state(found.folder)))


async def stream(request: Request) -> Response:
    """Send what is told of a run whenever it changes, as server-sent events."""
    found, name, streams = run_of(request), looking(request).name, panel_of(request).streams
    if streams[name] >= MOST_STREAMS:
        raise Refusal(429, f"{name} has {MOST_STREAMS} live pages open; close one")
    events = panel_of(request).followers.stream(found.folder)
    return StreamingResponse(
        _as_long_as_signed_in(request, events, name),
        media_type="text/event-stream",
        headers={"x-accel-buffering": "no"},
    )


async def _as_long_as_signed_in(
    request: Request, events: AsyncIterator[bytes], name: str
) -> AsyncIterator[bytes]:
    """Pass on what is sent until the person signs out, or the token is taken back; count the person's streams.

    A run that cannot be read is told as an event: the answer has begun, and cannot be a refusal any more.
    """
    streams = panel_of(request).streams
    streams[name] += 1
    try:
        async for event in events:
            if person_of(request) is None:
                return
            yield event
    except (RecordError, OSError) as error:
        yield as_event("trouble", {"words": str(error)})
    finally:
        streams[name] -= 1


async def check_answer(request: Request) -> Response:
    """Say what is wrong with an answer that is being typed, and how it is understood; nothing is answered by it."""
    found = run_of(request)
    asked = await panel_of(request).followers.prompt(found.folder)
    text = request.query_params.get("text", "")
    return JSONResponse(checked(asked, request.query_params.get("id", ""), text))


def checked(asked: AskedPrompt | None, prompt_id: str, text: str) -> dict[str, str]:
    """Return the `problem` with an answer, empty where it fits, and how it is `understood`.

    Raises `Refusal` where the question does not stand.
    """
    if asked is None or asked.prompt.id != prompt_id:
        raise Refusal(409, "this question does not stand any more")
    return {
        "problem": problem_with_answer(asked.prompt, text),
        "understood": understood_answer(asked.prompt, text),
    }
