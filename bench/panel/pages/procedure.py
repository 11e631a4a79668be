"""Procedures in a table: the list with pictures, the table with the check beside it, writing a file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import yaml
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response

from bench.base.languages import message
from bench.base.text import visible
from bench.base.yaml_files import FileMistake, FileMistakes, document_of, read_yaml
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import Procedure
from bench.config.shipped import CONFIG, PROCEDURES
from bench.panel.access import STATE, Person, Refusal, Role
from bench.panel.bench_fields import BenchField, Group, placed
from bench.panel.launching import choices
from bench.panel.own_files import (
    EditedFile,
    FileText,
    offered_procedures,
    own_file,
    own_files,
    read_file,
    shipped_files,
)
from bench.panel.procedure_fields import (
    Row,
    judged,
    place_of,
    rows_of,
    sections_of,
    table_text,
    values_in,
    with_copy,
    without_step,
)
from bench.panel.round_trip import edited_text, signed
from bench.panel.shared import Panel, acting, operator, page, panel_of
from bench.run.sentences import duration
from drivers.clock import utc_now

MOST_FIELDS: Final = 1000
LONGEST: Final = 400
MOST_TOLD: Final = 200
MOST_CHECKED: Final = 20_000
"""Steps of the longest plan that is checked beside the table; a longer one is checked before its run."""


@dataclass(frozen=True)
class CheckBeside:
    """The findings of a check, shown beside the table: sentences, problems, and the operator's actions."""

    told: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()


@dataclass
class TableState(EditedFile):
    """The state of the table: its file, the text being edited, the groups and rows, and the check.

    `typed` is the content of the text field, `bench` the bench file for the check.
    """

    text: str = ""
    bench: str = ""
    typed: str = ""
    groups: list[Group] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    values: dict[str, str] = field(default_factory=dict)
    check: CheckBeside = CheckBeside()

    @property
    def fields(self) -> list[BenchField]:
        """All fields of the table, in order."""
        rows = (row.group for row in self.rows)
        return [one for group in (*self.groups, *rows) for one in group.fields]

    @property
    def short(self) -> dict[str, str]:
        """The short name of each field in the form, by its path in the file."""
        return {one.name: f"f{number}" for number, one in enumerate(self.fields)}

    @property
    def path(self) -> Path:
        """The path of the file to write; a placeholder for a new file without a name."""
        return self.base.path if not self.start else Path(PROCEDURES) / "new.yaml"


def procedures(request: Request) -> Response:
    """Show the procedures by picture and duration."""
    operator(request)
    return page(
        request,
        "procedures.html.j2",
        offered=offered_procedures(),
        own=own_files(PROCEDURES),
        folder=str(Path().resolve()),
    )


def form(request: Request) -> Response:
    """Show the table of a procedure (`file`), or of a new procedure that begins as a copy of another (`start`)."""
    operator(request)
    asked = request.query_params
    state = _begun(asked.get("file", ""), asked.get("start", ""), "")
    state.bench = asked.get("bench", "")[:LONGEST]
    if asked.get("written"):
        state.note = message(f"{state.base.path} is written.")
    return _form_page(request, state)


def _begun(name: str, start: str, new_name: str) -> TableState:
    """Return the table of the file `name`, else of a copy of the file `start`. Raises `Refusal` without it."""
    if name:
        base = read_file(own_file(PROCEDURES, name))
        return TableState(name, "", base, text=base.text)
    known = shipped_files(PROCEDURES) | own_files(PROCEDURES)
    if start not in known:
        raise Refusal(
            404, message("there is no procedure of that name to start from; see the list of procedures")
        )
    base = read_file(known[start])
    return TableState(new_name, start, FileText(base.path, base.text), text=base.text)


async def sent(request: Request) -> Response:
    """Carry out the action of the pressed button: show, write, use the text, copy or remove a step."""
    person, given = await acting(request, Role.OPERATOR, most=MOST_FIELDS)
    return await run_in_threadpool(_sent, request, person, given)


def _sent(request: Request, person: Person, given: dict[str, str]) -> Response:
    state = _begun(given.get("file", ""), given.get("start", ""), given.get("new_name", "").strip())
    state.bench = given.get("bench", "")
    do, _, name = given.get("do", "show").partition(":")
    before, typed = _text_of(given, "text"), _text_of(given, "typed")
    state.text = _from_table(before, given)
    if do == "text" or state.text == before:
        state.text = typed
    elif typed != before:
        state.typed = typed
        state.refusal = message(
            "Table and text were both changed: 'Use this text' takes the text and drops the table."
        )
    if not state.refusal and (change := CHANGES.get(do)):
        try:
            state.text = change(state.text, place_of(name, rows_of(_data(state.text))))
        except Refusal as refusal:
            state.refusal = refusal.text
    panel = panel_of(request)
    if do == "write" and not state.refusal and _write(panel, person, state, given.get("sha256", "")):
        address = f"/procedures/form?file={quote(state.name)}&written=1&bench={quote(state.bench)}"
        return RedirectResponse(address, status_code=303)
    return _form_page(request, state)


CHANGES: Final = {"copy": with_copy, "remove": without_step}


def _text_of(given: Mapping[str, str], name: str) -> str:
    """Return the text of several lines in field `name`. Raises `Refusal` (400) for impossible characters."""
    lines = re.split(r"\r\n|\r|\n", given.get(name, "").rstrip())
    text = "\n".join(line.rstrip(" \t") for line in lines) + "\n"
    if visible(text) != text:
        raise Refusal(400, message("the text has characters that cannot be printed; remove them"))
    return text


def _data(text: str) -> Any:
    """Return a parsed text, None if it is no YAML or is nested too deep."""
    try:
        data = read_yaml(text).data
        rows_of(data)
    except (yaml.YAMLError, RecursionError):
        return None
    return data


def _from_table(text: str, given: Mapping[str, str]) -> str:
    """Return `text` with the values typed in the table's fields; unchanged if it is no YAML."""
    data = _data(text)
    if not isinstance(data, dict):
        return text
    groups, rows = sections_of(data), rows_of(data)
    fields = [one for group in (*groups, *(row.group for row in rows)) for one in group.fields]
    values = values_in(data, fields)
    for number, one in enumerate(fields):
        typed = given.get(f"f{number}", values[one.name]).strip()
        if len(typed) > LONGEST or visible(typed) != typed or not (typed.isprintable() or not typed):
            raise Refusal(400, message(f"{one.label}: give at most {LONGEST} printable characters"))
        values[one.name] = typed
    try:
        return table_text(text, values, fields)
    except (yaml.YAMLError, TypeError, KeyError, AttributeError, IndexError, RecursionError) as error:
        raise Refusal(409, message("the table cannot show this file; change it in the text")) from error


def _write(panel: Panel, person: Person, state: TableState, expected: str) -> bool:
    """Write the file if it has no mistakes and was not changed meanwhile; return whether it was written."""
    if (path := state.target(PROCEDURES)) is None:
        return False
    if state.start:
        state.text = _named(state)
    if _data(state.text) is None or judged(path, state.text)[0]:
        state.refusal = message("Not written: there are mistakes, each shown beside its field.")
        return False
    state.text = signed(state.text, person.name, utc_now())
    changed = message(
        "Not written: the file was changed since this table was shown. Look at the difference below."
    )
    return state.write(path, state.text, expected, panel.settings.runs / STATE, changed)


def _named(state: TableState) -> str:
    """Return the text of a new procedure, named after its file unless the person typed another name."""
    data = _data(state.text)
    name = sections_of(data)[0].fields[:1]
    if not isinstance(data, dict) or data.get("procedure") != (_data(state.base.text) or {}).get("procedure"):
        return state.text
    return edited_text(state.text, {"procedure": state.name}, name)


def _form_page(request: Request, state: TableState) -> Response:
    data, procedure = _data(state.text), None
    if data is None:
        state.refusal = state.refusal or message(
            "The text is not a procedure in YAML. Correct it in its field."
        )
        mistakes = _unreadable(state)
    else:
        state.groups, state.rows = sections_of(data), rows_of(data)
        state.values = values_in(data, state.fields)
        mistakes, procedure = judged(state.path, state.text)
    named = state.placed.at
    state.placed = placed(mistakes, [*state.groups, *(row.group for row in state.rows)])
    state.placed.at |= named
    benches = list(choices(CONFIG))
    own = list(own_files(CONFIG))
    if state.bench not in benches:
        state.bench = own[0] if own else "paper-stand"
    if procedure is not None:
        state.check = check_beside(procedure, state.bench, panel_of(request).settings.runs)
    return page(request, "procedure_form.html.j2", state=state, benches=benches)


def _unreadable(state: TableState) -> tuple[FileMistake, ...]:
    try:
        document_of(state.path, state.text.encode())
    except FileMistakes as mistakes:
        return mistakes.mistakes
    except RecursionError:
        pass
    return (FileMistake(0, "", message("the steps are nested too deeply; move some out of the others")),)


def check_beside(procedure: Procedure, bench: str, runs: Path) -> CheckBeside:
    """Return the findings of `bench check` for a procedure and the bench file named `bench`."""
    from bench.services.until import findings_of  # takes long to import

    plan = procedure.plan
    if len(plan.steps) > MOST_CHECKED:
        return CheckBeside(
            (
                message(
                    f"{len(plan.steps)} steps are too many to check here; the check runs before you start the run."
                ),
            )
        )
    try:
        file = load_bench(choices(CONFIG)[bench])
    except FileMistakes as mistakes:
        return CheckBeside(problems=(message(f"the bench file has mistakes: {mistakes.mistakes[0].text}"),))
    found = findings_of(plan, file, runs).result
    longest = message(f" (at most {duration(found.longest_s)})") if found.longest_s > found.expected_s else ""
    told = [
        message(f"{found.steps} steps, {found.operator_actions} operator actions, "
        f"{found.counts.get('read', 0)} readings."),
        f"About {duration(found.expected_s)}{longest}.",
        *(f"{'Before the first mounting' if not label else f'Installation {label}'}: {duration(seconds)}."
          for label, seconds in found.expected_by_installation_s.items()),
        *(message(f"Not determined: {', '.join(one.coefficients)}.")
          for one in found.not_determined if one.coefficients),
    ]  # fmt: skip
    actions = tuple(step.describe() for step in plan.steps if step.BY_OPERATOR)
    shown = actions[:MOST_TOLD] + (("…",) if len(actions) > MOST_TOLD else ())
    return CheckBeside(tuple(told), tuple(found.problems), shown)
