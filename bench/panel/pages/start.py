"""Starting a run: the choice of files, the check with a dry run, then the start on the bench."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, urlencode

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from bench.base.languages import message
from bench.base.requests import fields_of
from bench.base.text import visible
from bench.config.shipped import CONFIG, PROCEDURES
from bench.panel.access import Person, Refusal, Role
from bench.panel.folder import RunsFolder
from bench.panel.holding import change, read_holding
from bench.panel.launching import WISH, TrialResult, WantedRun, WishFolder, name_of, start, start_run
from bench.panel.own_files import (
    OF_RUN,
    choices,
    chosen_bench,
    chosen_procedure,
    offered_procedures,
    own_files,
)
from bench.panel.results import verdict_told
from bench.panel.shared import Panel, acting, operator, page, panel_of
from bench.run.events import MANIFEST, RecordError
from bench.run.sentences import duration
from bench.services.requests.measuring import RunRequest
from drivers.clock import utc_now

FORM: Final = ("procedure", "bench", "unit", "operator", "name", "dry_run")
"""The fields of `RunRequest` in the form; label, help and kind come from the request."""
IN_THE_PANEL: Final = {"dry_run": ("Practice", message("Simulated instruments, and you answer."))}
"""Label and help of fields with another meaning in the panel than at a terminal."""
FOLDERS: Final = {"procedures": PROCEDURES, "bench_files": CONFIG}
"""The folder of the files to choose from, for fields with these completions (`Option.completes`)."""
LONGEST: Final = 100
BEGINS_WITHIN: Final = timedelta(seconds=30)


def form(request: Request) -> Response:
    """Show the form with its choices.

    Query parameters: `after` names a run whose diagnosis proposes the next measurement; `like` names a run whose
    procedure and bench file are preset.
    """
    person = operator(request)
    given = {name: request.query_params.get(name, "")[:LONGEST] for name in (*FORM, "after", "like")}
    given["operator"] = given["operator"] or person.name
    given["bench"] = given["bench"] or first_bench(panel_of(request).runs)
    if given["like"]:
        given |= _files_of(panel_of(request).runs.run(given["like"]).manifest)
    after = None
    if given["after"]:
        after = panel_of(request).runs.run(given["after"])
        chosen_procedure(f"{OF_RUN}{after.name}", panel_of(request).runs)
        block = after.manifest.get("unit_under_test")
        given["unit"] = given["unit"] or (str(block.get("serial", "")) if isinstance(block, dict) else "")
    return page(
        request,
        "start.html.j2",
        fields=[form_field(name) for name in FORM],
        procedures=offered_procedures(),
        given=given,
        after=after and f"{OF_RUN}{after.name}",
    )


@dataclass(frozen=True)
class FormField:
    """A field of the form: `kind` is "choice", "flag" or "text"; `choices` are the names of files."""

    name: str
    label: str
    help: str
    kind: str
    choices: tuple[str, ...] = ()


def form_field(name: str) -> FormField:
    """Return the form field for the field `name` of `RunRequest`."""
    (of,) = (one for one in fields_of(RunRequest) if one.name == name)
    label, words = IN_THE_PANEL.get(name, ("", ""))
    label = label or name.replace("_", " ").capitalize()
    folder = FOLDERS.get(of.option.completes or "")
    if folder is not None:
        return FormField(name, label, "", "choice", tuple(choices(folder)))
    return FormField(name, label, words or of.option.help, "flag" if of.type is bool else "text")


async def check(request: Request) -> Response:
    """Start a separate process that checks the requested run and carries out a dry run of it."""
    person, sent = await acting(request, Role.OPERATOR)
    panel = panel_of(request)
    wish = await run_in_threadpool(wished, panel, person, sent)
    return RedirectResponse(f"/start/{wish.id}", status_code=303)


def wished(panel: Panel, person: Person, sent: Mapping[str, str], queued: str = "") -> WishFolder:
    """Start the check of the run that a form requests; `queued` is the id of its queue item. Raises `Refusal`."""
    given: dict[str, str | bool] = {
        "procedure": str(chosen_procedure(sent.get("procedure", ""), panel.runs).absolute()),
        "bench": str(chosen_bench(sent.get("bench", ""), panel.runs).absolute()),
        "operator": person.name,
    }
    if panel.settings.laboratory is not None:
        given["laboratory"] = str(panel.settings.laboratory.absolute())
    for one in map(form_field, FORM):
        if one.kind == "flag":
            given[one.name] = sent.get(one.name, "") == "yes"
        elif one.kind == "text" and (text := printable(sent.get(one.name, ""), one.name)):
            given[one.name] = text
    wanted = WantedRun(given, queued=queued).hashed()
    name_of(wanted, panel.runs)
    wish = panel.wishes.new(wanted)
    start([str(wish.path.absolute())], wish.path / "trying.log", program=("-m", "bench.panel.launching"))
    return wish


def found(request: Request) -> Response:
    """Show what the check and the dry run have found so far."""
    operator(request)
    wish = panel_of(request).wishes.of(request.path_params["wish"])
    told, asked = wish.found(), wish.wanted()
    verification = (told.result or {}).get("verification")
    return page(
        request,
        "started.html.j2",
        wish=wish,
        wanted=asked.request,
        found=told,
        times=_times(told),
        working=told.stage != "done" and (wish.at_work() or _just_begun(wish)),
        started=wish.started(),
        verdict=verification and verdict_told(verification),
        back="/queue" if asked.queued else f"/start?{urlencode(_choice(asked.request))}",
    )


def _choice(wanted: RunRequest) -> dict[str, str]:
    """Return what was chosen for a run, by the names of the form's fields, without what was left empty."""
    named = _files_of(vars(wanted)) | {name: str(getattr(wanted, name) or "") for name in FORM[2:]}
    return {name: {"True": "yes"}.get(text, text) for name, text in named.items() if text}


async def go(request: Request) -> Response:
    """Start a run whose check found no obstacle; the person who starts it gets control."""
    person, _ = await acting(request, Role.OPERATOR)
    panel = panel_of(request)
    wish = panel.wishes.of(request.path_params["wish"])
    name = await run_in_threadpool(_begun, panel, person, wish)
    return RedirectResponse(f"/runs/{quote(name)}/", status_code=303)


def _begun(panel: Panel, person: Person, wish: WishFolder) -> str:
    if not wish.found().startable:
        raise Refusal(
            409,
            "the check is not finished or found an obstacle; read the check, remove the obstacle, "
            "then start again",
        )
    wanted = wish.wanted()
    name = name_of(wanted, panel.runs)
    if wanted.queued:
        panel.queue.claim(wanted.queued, name, panel.runs.holds)
    try:
        run = start_run(wish, name, panel.runs)
    except BaseException:
        if wanted.queued and wish.started() != name:
            panel.queue.change(wanted.queued, run="", begun=None)
        raise
    if not read_holding(run.folder).holder:
        change(run.folder, "take", person)
    return run.name


def printable(text: str, name: str, longest: int = LONGEST) -> str:
    """Return a field's `text` without outer blanks. Raises `Refusal` (400) if it is too long or not printable."""
    text = text.strip()
    if len(text) > longest:
        raise Refusal(400, f"{name}: the text has more than {longest} characters; shorten it")
    if (text and not text.isprintable()) or visible(text) != text:
        raise Refusal(400, f"{name}: the text has characters that cannot be printed; remove them")
    return text


def _files_of(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Return the names under which the form offers the procedure and the bench file of a run."""
    offered = {"procedure": choices(PROCEDURES), "bench": choices(CONFIG)}
    named = {field: Path(str(manifest.get(field, ""))) for field in offered}
    return {
        field: name
        for field, path in named.items()
        for name in (path.stem, path.name)
        if name in offered[field]
    }


def first_bench(runs: RunsFolder) -> str:
    """Return the preset bench file: BENCH_FILE, else that of the latest run, else one of the working folder."""
    if named := os.environ.get("BENCH_FILE", ""):
        return named
    first = next(iter(own_files(CONFIG)), "paper-stand")
    last = max(runs.runs(), key=lambda run: (run.folder / MANIFEST).stat().st_mtime, default=None)
    try:
        return _files_of(last.manifest).get("bench", first) if last else first
    except RecordError:
        return first


def _times(told: TrialResult) -> dict[str, str]:
    if told.check is None:
        return {}
    expected, longest = float(told.check["expected_s"]), float(told.check["longest_s"])
    return {"expected": duration(expected), "longest": duration(longest) if longest > expected else ""}


def _just_begun(wish: WishFolder) -> bool:
    """Return whether the wish is so recent that the process of its check may not have begun yet."""
    age_s = utc_now().timestamp() - (wish.path / WISH).stat().st_mtime
    return age_s < BEGINS_WITHIN.total_seconds()
