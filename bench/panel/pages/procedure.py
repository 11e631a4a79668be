"""Procedures in a table: the list with pictures, the table with the check beside it, writing a file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import yaml
from starlette.requests import Request
from starlette.responses import Response

from bench.base.languages import message
from bench.base.text import visible
from bench.base.yaml_files import FileMistake, FileMistakes, document_of, read_yaml
from bench.config.bench_file.file import load_bench
from bench.config.procedure.load import Procedure
from bench.config.shipped import CONFIG, PROCEDURES
from bench.panel.access import Refusal
from bench.panel.bench_fields import BenchField, Group, placed
from bench.panel.own_files import (
    FileText,
    choices,
    offered_procedures,
    own_file,
    own_files,
    read_file,
    shipped_files,
)
from bench.panel.pages.editing import LONGEST, EditedFile
from bench.panel.pages.start import first_bench, printable
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
from bench.panel.round_trip import edited_text
from bench.panel.shared import Panel, operator, page, panel_of
from bench.run.sentences import duration

MOST_TOLD: Final = 200
MOST_CHECKED: Final = 20_000
"""Steps of the longest plan that is checked beside the table; a longer one is checked before its run."""


@dataclass(frozen=True)
class CheckBeside:
    """What a check found, shown beside the table: sentences, problems, and what the operator will have to do."""

    told: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()


def procedures(request: Request) -> Response:
    """Show the procedures, each with a picture and its duration."""
    operator(request)
    return page(
        request,
        "procedures.html.j2",
        offered=offered_procedures(),
        own=own_files(PROCEDURES),
        folder=str(Path().resolve()),
    )


CHANGES: Final = {"copy": with_copy, "remove": without_step}


@dataclass
class ProcedureTable(EditedFile):
    """The table of a procedure: groups and rows of fields, and the check.

    `text` is the edited text, `typed_text` that in the text field, and `bench` the bench file of the check.
    """

    KIND = PROCEDURES
    MOST_FIELDS = 1000
    CHANGED = message(
        "Not written: the file was changed since this table was shown. Look at the difference below."
    )

    bench: str = ""
    typed_text: str = ""
    groups: list[Group] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    values: dict[str, str] = field(default_factory=dict)
    check: CheckBeside = CheckBeside()

    @property
    def fields(self) -> list[BenchField]:
        """All fields of the table, in order."""
        return _fields_of(self.groups, self.rows)

    @property
    def short(self) -> dict[str, str]:
        """The input name of each field in the HTML form ("f0", …), by the field's path in the file."""
        return {one.name: f"f{number}" for number, one in enumerate(self.fields)}

    @classmethod
    def _begun(cls, name: str, start: str, new_name: str) -> ProcedureTable:
        if name:
            base = read_file(own_file(PROCEDURES, name))
            return cls(name, "", base, text=base.text)
        known = shipped_files(PROCEDURES) | own_files(PROCEDURES)
        if start not in known:
            raise Refusal(404, "there is no procedure of that name to start from; see the list of procedures")
        base = read_file(known[start])
        return cls(new_name, start, FileText(base.path, base.text), text=base.text)

    def _open(self, asked: Mapping[str, str]) -> None:
        self.bench = asked.get("bench", "")[:LONGEST]
        if asked.get("written"):
            self.note = message(f"{self.base.path} is written.")

    def _take(self, panel: Panel, given: Mapping[str, str]) -> None:
        """Take over the typed values or the text; copy or remove a step."""
        self.bench = given.get("bench", "")
        do, _, name = given.get("do", "show").partition(":")
        before, typed = _text_of(given, "text"), _text_of(given, "typed")
        self.text = _from_table(before, given)
        if do == "text" or self.text == before:
            self.text = typed
        elif typed != before:
            self.typed_text = typed
            self.refusal = message(
                "Table and text were both changed: 'Use this text' takes the text and drops the table."
            )
        if not self.refusal and (change := CHANGES.get(do)):
            try:
                self.text = change(self.text, place_of(name, rows_of(_data(self.text))))
            except Refusal as refusal:
                self.refusal = refusal.text

    def _may_be_written(self, path: Path) -> bool:
        if self.start:
            self.text = _named(self)
        wrong = _data(self.text) is None or bool(judged(path, self.text)[0])
        if wrong:
            self.refusal = message("Not written: there are mistakes, each shown beside its field.")
        return not wrong

    @property
    def _address(self) -> str:
        return f"/procedures/form?file={quote(self.name)}&written=1&bench={quote(self.bench)}"

    def _shown(self, request: Request) -> Response:
        # a placeholder for a new file without a name
        path = self.base.path if not self.start else Path(PROCEDURES) / "new.yaml"
        data, procedure = _data(self.text), None
        if data is None:
            self.refusal = self.refusal or message(
                "The text is not a procedure in YAML. Correct it in its field."
            )
            mistakes = _unreadable(path, self.text)
        else:
            self.groups, self.rows = sections_of(data), rows_of(data)
            self.values = values_in(data, self.fields)
            mistakes, procedure = judged(path, self.text)
        named = self.placed.at
        self.placed = placed(mistakes, [*self.groups, *(row.group for row in self.rows)])
        self.placed.at |= named
        benches = list(choices(CONFIG))
        if self.bench not in benches:
            self.bench = first_bench(panel_of(request).runs)
        if procedure is not None:
            self.check = check_beside(procedure, self.bench, panel_of(request).settings.runs)
        return page(request, "procedure_form.html.j2", state=self, benches=benches)


def _fields_of(groups: Iterable[Group], rows: Iterable[Row]) -> list[BenchField]:
    return [one for group in (*groups, *(row.group for row in rows)) for one in group.fields]


def _text_of(given: Mapping[str, str], name: str) -> str:
    """Return the text of several lines in field `name`. Raises `Refusal` (400) for impossible characters."""
    lines = re.split(r"\r\n|\r|\n", given.get(name, "").rstrip())
    text = "\n".join(line.rstrip(" \t") for line in lines) + "\n"
    if visible(text) != text:
        raise Refusal(400, "the text has characters that cannot be printed; remove them")
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
    fields = _fields_of(sections_of(data), rows_of(data))
    values = values_in(data, fields)
    for number, one in enumerate(fields):
        values[one.name] = printable(given.get(f"f{number}", values[one.name]), one.label, LONGEST)
    try:
        return table_text(text, values, fields)
    except (yaml.YAMLError, TypeError, KeyError, AttributeError, IndexError, RecursionError) as error:
        raise Refusal(
            409,
            "the table cannot show this file, because the file is not valid YAML or a "
            "step has the wrong structure; correct the file in the text",
        ) from error


def _named(state: ProcedureTable) -> str:
    """Return the text of a new procedure, named after its file unless the person typed another name."""
    data = _data(state.text)
    name = sections_of(data)[0].fields[:1]
    if not isinstance(data, dict) or data.get("procedure") != (_data(state.base.text) or {}).get("procedure"):
        return state.text
    return edited_text(state.text, {"procedure": state.name}, name)


def _unreadable(path: Path, text: str) -> tuple[FileMistake, ...]:
    try:
        document_of(path, text.encode())
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
