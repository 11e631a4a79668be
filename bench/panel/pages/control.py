"""What a person asks of a run: an answer, a wish, control of it, to go on with it, to give it up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeVar

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from bench.panel.access import Person, Refusal, Role
from bench.panel.acting import acting, panel_of
from bench.panel.holding import change, read_holding, require_holder
from bench.panel.launching import resume_run
from bench.panel.pages.shown import wants_json
from bench.run.events import Wish
from bench.run.folder import Run
from bench.run.person import (
    LONGEST,
    SIGN,
    LeftAnswer,
    RunControl,
    Who,
    leave_answer,
    leave_wish,
    parse_wish,
    problem_with_answer,
)
from bench.run.record import is_being_written

STOP: Final = "stop"
LONGEST_REASON: Final = 500

Told = TypeVar("Told")


async def answer(request: Request) -> Response:
    """Leave the holder's answer to the question that stands; the program that asked takes the first that fits."""
    person, sent = await acting(request, Role.OPERATOR)
    run = panel_of(request).runs.run(request.path_params["name"])
    await _doing(require_holder, run.folder, person)
    prompt_id, text = sent.get("id", ""), sent.get("text", "")
    if len(text) > LONGEST:
        raise Refusal(413, f"an answer has at most {LONGEST} characters")
    asked = await panel_of(request).followers.prompt(run.folder)
    if asked is None or asked.prompt.id != prompt_id:
        raise Refusal(409, "this question does not stand any more: it was answered, or another is asked")
    if problem := problem_with_answer(asked.prompt, text):
        raise Refusal(422, problem)
    await _doing(leave_answer, run.folder, LeftAnswer(prompt_id, text, _who(person)))
    return _done(request, run, "answered")


async def wish(request: Request) -> Response:
    """Leave a wish for the program that carries out a run: stop is everybody's, all else the holder's."""
    person, sent = await acting(request, Role.VIEWER)
    run = panel_of(request).runs.run(request.path_params["name"])
    word, reason = sent.get("wish", "").strip(), " ".join(sent.get("reason", "").split())
    if word != STOP:
        await _doing(require_holder, run.folder, person)
    if len(reason) > LONGEST_REASON:
        raise Refusal(413, f"a reason has at most {LONGEST_REASON} characters")
    try:
        asked = parse_wish(f"{word} {reason}")
    except ValueError as mistake:
        raise Refusal(400, str(mistake).replace(SIGN, "")) from mistake
    if not await _doing(is_being_written, run.folder):
        if asked.wish is Wish.ABORT:
            return await _given_up(request, run, person)
        raise Refusal(409, "nobody is carrying out this run")
    await _doing(leave_wish, run.folder, RunControl(asked.wish, asked.reason, who=_who(person)))
    return _done(request, run, f"{asked.wish} is asked for")


async def control(request: Request) -> Response:
    """Take, ask for, grant, deny, release or force control of a run."""
    person, sent = await acting(request, Role.OPERATOR)
    run = panel_of(request).runs.run(request.path_params["name"])
    holding = await _doing(change, run.folder, sent.get("do", ""), person, sent.get("to", ""))
    if wants_json(request):
        return JSONResponse({"done": sent["do"], "control": holding.to_json()})
    return _done(request, run, sent["do"])


async def resume(request: Request) -> Response:
    """Go on with a run that nobody carries out; whoever does it is, or comes to be, in control of it."""
    person, _ = await acting(request, Role.OPERATOR)
    run = panel_of(request).runs.run(request.path_params["name"])
    await _doing(_hold, run, person)
    await _doing(resume_run, run)
    return _done(request, run, "it goes on")


async def give_up(request: Request) -> Response:
    """End a run for good that nobody carries out."""
    person, _ = await acting(request, Role.OPERATOR)
    run = panel_of(request).runs.run(request.path_params["name"])
    await _doing(_hold, run, person)
    return await _given_up(request, run, person)


async def _given_up(request: Request, run: Run, person: Person) -> Response:
    from bench.services.execution import give_up as end_for_good  # takes long to import

    left = await _doing(end_for_good, run, _who(person))
    return _done(request, run, "; ".join(("ended for good", *left)))


def _hold(run: Run, person: Person) -> None:
    """Take control where nobody has it. Raises `Refusal` where another person has."""
    if not read_holding(run.folder).holder:
        change(run.folder, "take", person)
    require_holder(run.folder, person)


def _who(person: Person) -> Who:
    return Who(person.name, person.role.value, "panel")


async def _doing(work: Callable[..., Told], *given: object) -> Told:
    """Do what waits for a disk beside the loop. Raises `Refusal` where that refuses to be written."""
    try:
        return await run_in_threadpool(work, *given)
    except OSError as error:
        raise Refusal(409, f"it cannot be written ({error.strerror}); free the disk") from error


def _done(request: Request, run: Run, what: str) -> Response:
    """Answer a script in words, a form with the page of the run."""
    if wants_json(request):
        return JSONResponse({"done": what})
    from urllib.parse import quote

    return RedirectResponse(f"/runs/{quote(run.name)}/", status_code=303)
