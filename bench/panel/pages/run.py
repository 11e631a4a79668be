"""The page of a run and its requests: data, answers, wishes (pause, stop, …), control, resuming, giving up."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Callable, Mapping
from datetime import datetime
from typing import Any, Final, TypeVar
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response, StreamingResponse

from bench.base.files import DISK_FULL
from bench.base.languages import message
from bench.base.numbers import without_infinity
from bench.panel.access import Person, Refusal, Role
from bench.panel.holding import change, read_holding, require_holder
from bench.panel.launching import resume_run
from bench.panel.pages.queue import next_unit
from bench.panel.results import Outcome, outcome_of
from bench.panel.shared import acting, looking, page, panel_of, person_of, wants_json
from bench.panel.stream import as_event
from bench.run.events import RecordError, Wish
from bench.run.folder import Run
from bench.run.person import (
    LONGEST,
    SIGN,
    LeftAnswer,
    RunControl,
    WishAuthor,
    leave_answer,
    leave_wish,
    parse_wish,
    problem_with_answer,
    understood_answer,
)
from bench.run.record import is_being_written
from drivers.clock import utc_now

MOST_STREAMS: Final = 30
"""Largest number of live pages of one person; each page occupies a connection."""


def run_of(request: Request) -> Run:
    """Return the run in a request's address. Raises `Refusal` if nobody is signed in or there is no such run."""
    looking(request)
    return panel_of(request).runs.run(request.path_params["name"])


async def run(request: Request) -> Response:
    """Show a run in its current state; the script then updates the page."""
    found = run_of(request)
    state = await panel_of(request).followers.state(found.folder)
    return await _run_page(
        request,
        "run.html.j2",
        found,
        state,
        ended=state["ended"],
        state_json=json.dumps(without_infinity(state)),
    )


async def outcome(request: Request) -> Response:
    """Send the outcome of a run that has ended, as a part of the live page."""
    found = run_of(request)
    state = await panel_of(request).followers.state(found.folder)
    return await _run_page(request, "outcome.html.j2", found, state, ended=True)


async def _run_page(
    request: Request, name: str, run: Run, state: Mapping[str, Any], *, ended: bool, **more: Any
) -> Response:
    panel = panel_of(request)
    told: Outcome | None = None
    if ended:
        finished = state["state"] == "finished"
        age = utc_now() - datetime.fromisoformat(
            state["last_time"]
        )  # the snapshot may be older than this page
        told = await run_in_threadpool(
            outcome_of,
            run,
            panel.runs,
            alive=state["alive"],
            finished=finished,
            age_s=abs(age.total_seconds()),
        )
    return page(request, name, run=run, state=state, outcome=told, next_unit=next_unit(panel), **more)


async def state(request: Request) -> Response:
    """Send the current snapshot of a run, see `bench.panel.run_state.snapshot`."""
    found = run_of(request)
    return JSONResponse(without_infinity(await panel_of(request).followers.state(found.folder)))


async def stream(request: Request) -> Response:
    """Send the snapshot of a run at each change, as server-sent events."""
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
    """Yield `events` while the person may look, and count the streams; an unreadable run becomes an event."""
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
    """Send the problem with the answer typed so far, and how the program understands it; nothing is stored."""
    found = run_of(request)
    asked = await panel_of(request).followers.prompt(found.folder)
    text = request.query_params.get("text", "")
    if asked is None or asked.prompt.id != request.query_params.get("id", ""):
        raise Refusal(409, "this question is closed; load the page again")
    problem, understood = problem_with_answer(asked.prompt, text), understood_answer(asked.prompt, text)
    return JSONResponse({"problem": problem, "understood": understood})


STOP: Final = "stop"
LONGEST_REASON: Final = 500

Told = TypeVar("Told")


async def answer(request: Request) -> Response:
    """Store the holder's answer to the open question; the program that asked uses the first acceptable answer."""
    person, sent = await acting(request, Role.OPERATOR)
    run = panel_of(request).runs.run(request.path_params["name"])
    await _doing(require_holder, run.folder, person)
    prompt_id, text = sent.get("id", ""), sent.get("text", "")
    if len(text) > LONGEST:
        raise Refusal(413, f"the answer is too long; shorten it to at most {LONGEST} characters")
    asked = await panel_of(request).followers.prompt(run.folder)
    if asked is None or asked.prompt.id != prompt_id:
        raise Refusal(409, "this question was answered, or another one is open; load the page again")
    if problem := problem_with_answer(asked.prompt, text):
        raise Refusal(422, problem)
    await _doing(leave_answer, run.folder, LeftAnswer(prompt_id, text, _who(person)))
    return _done(request, run, "answered")


async def wish(request: Request) -> Response:
    """Store a wish for the program that carries out a run.

    Any signed-in person may stop a run; any other wish needs control of it. If no program carries out the run, the
    panel carries out an abort itself and refuses other wishes.
    """
    person, sent = await acting(request, Role.VIEWER)
    run = panel_of(request).runs.run(request.path_params["name"])
    word, reason = sent.get("wish", "").strip(), " ".join(sent.get("reason", "").split())
    if word != STOP:
        await _doing(require_holder, run.folder, person)
    if len(reason) > LONGEST_REASON:
        raise Refusal(413, f"the reason is too long; shorten it to at most {LONGEST_REASON} characters")
    try:
        asked = parse_wish(f"{word} {reason}")
    except ValueError as mistake:
        raise Refusal(400, str(mistake).replace(SIGN, "")) from mistake
    if not await _doing(is_being_written, run.folder):
        if asked.wish is Wish.ABORT:
            return await _given_up(request, run, person)
        raise Refusal(409, "no program is carrying out this run; load the page again")
    await _doing(leave_wish, run.folder, RunControl(asked.wish, asked.reason, who=_who(person)))
    return _done(request, run, message(f"{asked.wish} was sent"))


async def control(request: Request) -> Response:
    """Take, ask for, grant, deny, release or force control of a run."""
    person, sent = await acting(request, Role.OPERATOR)
    run = panel_of(request).runs.run(request.path_params["name"])
    holding = await _doing(change, run.folder, sent.get("do", ""), person, sent.get("to", ""))
    if wants_json(request):
        return JSONResponse({"done": sent["do"], "control": holding.to_json()})
    return _done(request, run, sent["do"])


async def resume(request: Request) -> Response:
    """Resume a run that no program carries out; the person needs control, and gets it if nobody has it."""
    person, _ = await acting(request, Role.OPERATOR)
    run = panel_of(request).runs.run(request.path_params["name"])
    await _doing(_hold, run, person)
    await _doing(resume_run, run, person)
    return _done(request, run, message("it continues"))


async def give_up(request: Request) -> Response:
    """Permanently end a run that no program carries out."""
    person, _ = await acting(request, Role.OPERATOR)
    run = panel_of(request).runs.run(request.path_params["name"])
    await _doing(_hold, run, person)
    return await _given_up(request, run, person)


async def _given_up(request: Request, run: Run, person: Person) -> Response:
    from bench.services.execution import give_up as end_for_good  # takes long to import

    left = await _doing(end_for_good, run, _who(person))
    return _done(request, run, "; ".join((message("ended for good"), *left)))


def _hold(run: Run, person: Person) -> None:
    """Take control of a run if nobody has it. Raises `Refusal` if another person has control."""
    if not read_holding(run.folder).holder:
        change(run.folder, "take", person)
    require_holder(run.folder, person)


def _who(person: Person) -> WishAuthor:
    return WishAuthor(person.name, person.role.value, "panel")


async def _doing(work: Callable[..., Told], *given: object) -> Told:
    """Return the result of `work` that uses the disk, done in a separate thread. Turns `OSError` into `Refusal`."""
    try:
        return await run_in_threadpool(work, *given)
    except OSError as error:
        if error.errno in DISK_FULL:
            raise Refusal(
                409, f"the run's folder cannot be written ({error.strerror}); free disk space"
            ) from error
        raise Refusal(
            409, f"the run's folder cannot be written ({error.strerror}); make it writable"
        ) from error


def _done(request: Request, run: Run, what: str) -> Response:
    """Return the response to a successful request: a script gets a sentence, a form the page of the run."""
    if wants_json(request):
        return JSONResponse({"done": what})
    return RedirectResponse(f"/runs/{quote(run.name)}/", status_code=303)
