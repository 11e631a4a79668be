"""Starting a run: what is chosen, what check and a dry run find, and then the bench."""

from __future__ import annotations

from datetime import timedelta
from typing import Any, Final
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from bench.base.text import visible
from bench.config.shipped import CONFIG, PROCEDURES
from bench.panel.access import Person, Refusal, Role
from bench.panel.acting import acting, looking, panel_of
from bench.panel.holding import change, read_holding
from bench.panel.launching import (
    OF_RUN,
    WISH,
    Found,
    Wanted,
    WishFolder,
    choices,
    chosen_bench,
    chosen_procedure,
    name_of,
    start,
    start_run,
)
from bench.panel.pages.shown import page
from bench.panel.panel import Panel
from bench.run.sentences import duration
from drivers.clock import utc_now

LONGEST: Final = 100
BEGINS_WITHIN: Final = timedelta(seconds=30)


def form(request: Request) -> Response:
    """Show what can be chosen; `after` is a run whose diagnosis proposes what to measure."""
    person = _operator(request)
    given = {
        name: request.query_params.get(name, "")[:LONGEST] for name in ("procedure", "bench", "unit", "after")
    }
    after = None
    if given["after"]:
        after = panel_of(request).runs.run(given["after"])
        chosen_procedure(f"{OF_RUN}{after.name}", panel_of(request).runs)
        given["unit"] = given["unit"] or _unit_of(after.manifest)
    return page(
        request,
        "start.html.j2",
        procedures=list(choices(PROCEDURES)),
        benches=list(choices(CONFIG)),
        given=given,
        after=after and f"{OF_RUN}{after.name}",
        operator=person.name,
    )


async def check(request: Request) -> Response:
    """Have what was chosen checked and tried, by a process of its own."""
    person, sent = await acting(request, Role.OPERATOR)
    panel = panel_of(request)
    wish = await run_in_threadpool(_wished, panel, person, sent)
    return RedirectResponse(f"/start/{wish.id}", status_code=303)


def _wished(panel: Panel, person: Person, sent: dict[str, str]) -> WishFolder:
    wanted = Wanted(
        procedure=str(chosen_procedure(sent.get("procedure", ""), panel.runs).absolute()),
        bench=str(chosen_bench(sent.get("bench", ""), panel.runs).absolute()),
        unit=_text(sent, "unit"),
        operator=_text(sent, "operator") or person.name,
        name=_text(sent, "name"),
        practice=sent.get("practice", "") == "yes",
    ).hashed()
    name_of(wanted, panel.runs)
    wish = panel.wishes.new(wanted)
    start([str(wish.path.absolute())], wish.path / "trying.log", program=("-m", "bench.panel.trying"))
    return wish


def found(request: Request) -> Response:
    """Show what was found, as far as it goes."""
    _operator(request)
    wish = panel_of(request).wishes.of(request.path_params["wish"])
    told = wish.found()
    return page(
        request,
        "started.html.j2",
        wish=wish,
        wanted=wish.wanted(),
        found=told,
        times=_times(told),
        working=told.stage != "done" and (wish.at_work() or _just_begun(wish)),
        started=wish.started(),
    )


async def go(request: Request) -> Response:
    """Start what was found to be right; who starts it is in control."""
    person, _ = await acting(request, Role.OPERATOR)
    panel = panel_of(request)
    wish = panel.wishes.of(request.path_params["wish"])
    name = await run_in_threadpool(_begun, panel, person, wish)
    return RedirectResponse(f"/runs/{quote(name)}/", status_code=303)


def _begun(panel: Panel, person: Person, wish: WishFolder) -> str:
    if not wish.found().startable:
        raise Refusal(409, "what was found forbids it, or it is not checked yet")
    run = start_run(wish, panel.runs)
    if not read_holding(run.folder).holder:
        change(run.folder, "take", person)
    return run.name


def _operator(request: Request) -> Person:
    person = looking(request)
    if not person.role.includes(Role.OPERATOR):
        raise Refusal(
            403, f"{person.name} is signed in as {person.role}; this takes the role {Role.OPERATOR}"
        )
    return person


def _text(sent: dict[str, str], name: str) -> str:
    text = sent.get(name, "").strip()
    if len(text) > LONGEST or (text and not text.isprintable()) or visible(text) != text:
        raise Refusal(400, f"{name}: at most {LONGEST} characters that can be printed")
    return text


def _unit_of(manifest: Any) -> str:
    unit = manifest.get("unit_under_test")
    return str(unit.get("serial", "")) if isinstance(unit, dict) else ""


def _times(told: Found) -> dict[str, str]:
    if told.check is None:
        return {}
    expected, longest = float(told.check["expected_s"]), float(told.check["longest_s"])
    return {"expected": duration(expected), "longest": duration(longest) if longest > expected else ""}


def _just_begun(wish: WishFolder) -> bool:
    """Whether the process that checks may not have begun to yet."""
    age_s = utc_now().timestamp() - (wish.path / WISH).stat().st_mtime
    return age_s < BEGINS_WITHIN.total_seconds()
