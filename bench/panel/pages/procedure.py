"""Procedures in a table: rows of fields with the check beside them, the list with pictures, writing a file."""

from __future__ import annotations

import copy
import inspect
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import yaml
from pydantic import BaseModel, ValidationError
from starlette.requests import Request
from starlette.responses import Response

from bench.base.languages import message
from bench.base.text import exact_degrees, visible
from bench.base.units import ANGLE, parse_quantity
from bench.base.yaml_files import FileMistake, FileMistakes, Place, document_of, dotted, read_yaml
from bench.config.bench_file.file import load_bench
from bench.config.procedure.file import AngleSteps, OperatorTimeSection, ReadingSection, StepEntry, TurnVerb
from bench.config.procedure.load import Procedure, load_procedure
from bench.config.shipped import CONFIG, PROCEDURES
from bench.panel.access import Refusal
from bench.panel.bench_fields import BenchField, Group, Values, bare, fields_in, placed, values_of
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
from bench.panel.round_trip import edited_text, in_one_line
from bench.panel.shared import Panel, operator, page, panel_of
from bench.run.sentences import duration

STEPS: Final[Place] = ("steps",)
READING: Final[Place] = ("reading",)
OPERATOR_TIME: Final[Place] = ("operator_time",)
TITLES: Final[Mapping[str, str]] = {
    "installation": message("Mount the block"), "repeat": "Passes", "turn": "Turn", "read": "Read",
    "input": message("Switch the inputs"), "wait": "Wait", "settle": "Settle", "prompt": "Ask",
    "temperature": message("Set the temperature"),
    "temperatures": message("At each temperature"),
    "power": message("Switch the block"),
    "level": message("Read the level"), "include": "Include",
}  # fmt: skip
AS_LIST: Final = "list"
AS_STEPS: Final = "steps"
LISTS: Final = {
    ("repeat", "directions"): message("such as rising, falling, rising; in place of Times"),
    ("repeat", "scans"): message("such as xyz, zyx: an order for each pass"),
    ("temperatures", "at"): message("such as -40 degC, 23 degC, 70 degC"),
}
"""Keys of a step whose values are lists, with the help texts of their fields."""


@dataclass(frozen=True)
class Row:
    """A row of the table: a step's fields, its nesting depth, and `written`, the part shown as plain text."""

    group: Group
    depth: int
    written: str = ""


def sections_of(data: Any) -> list[Group]:
    """Return the groups of fields above the steps: name and title, the reading, the operator's times."""
    reading = {one.name: one for one in fields_in(ReadingSection, READING)}
    told = data.get("reading") if isinstance(data, dict) else None
    dwell = reading.pop("reading.settle")
    if not (isinstance(told, dict) and isinstance(told.get("settle"), dict)):  # a criterion has no field
        reading["reading.settle"] = replace(dwell, label=message("Dwell after a turn"))
    name = BenchField("procedure", ("procedure",), message("Name in records"), required=True)
    title = BenchField("title", ("title",), "Title")
    return [
        Group("Procedure", (), "", (name, title)),
        Group(message("Each reading"), READING, "", tuple(reading.values())),
        Group(
            message("Operator's times"),
            OPERATOR_TIME,
            message("For the estimate of the duration only."),
            tuple(fields_in(OperatorTimeSection, OPERATOR_TIME)),
        ),
    ]


def rows_of(data: Any) -> list[Row]:
    """Return the rows of the table of a parsed procedure."""
    return list(_rows(data.get("steps") if isinstance(data, dict) else None, STEPS, 0))


def _rows(steps: Any, at: Place, depth: int) -> Iterator[Row]:
    for index, entry in enumerate(steps if isinstance(steps, list) else []):
        for verb, body in entry.items() if isinstance(entry, dict) else ():
            place = (*at, index, verb)
            title = TITLES.get(verb, str(verb).replace("_", " ").capitalize())
            fields = tuple(_fields(verb, body, place)) if body is None or isinstance(body, dict) else ()
            yield Row(Group(title, place, "", fields), depth, "" if fields else _in_line(body))
            if isinstance(body, dict):
                yield from _rows(body.get("steps"), (*place, "steps"), depth + 1)


def _in_line(body: Any) -> str:
    """Return as one line of text the part of a step for which there are no fields."""
    if isinstance(body, dict):
        return ", ".join(f"{key}: {_in_line(value)}" for key, value in body.items() if key != "steps")
    return ", ".join(map(_in_line, body)) if isinstance(body, list) else str(body or "")


def _fields(verb: str, body: Any, at: Place) -> Iterator[BenchField]:
    info = StepEntry.model_fields.get(verb)
    model = bare(info.annotation) if info is not None else None
    if not (inspect.isclass(model) and issubclass(model, BaseModel)):
        return
    if model is TurnVerb:
        yield from _angles(body, (*at, "angles"))
    for (of, key), words in LISTS.items():
        if of == verb:
            yield BenchField(dotted((*at, key)), (*at, key), key.capitalize(), words, many=True)
    yield from fields_in(model, at)


def _angles(body: Any, at: Place) -> Iterator[BenchField]:
    name = dotted(at)
    words = ((AS_LIST, "a list"), (AS_STEPS, message("first, step, number")))
    yield BenchField(f"form:{name}", at, message("Angles as"), choices=words, shows=True, required=True)
    if isinstance(body, dict) and isinstance(body.get("angles"), dict):
        yield from (replace(one, label=f"Angles: {one.label.lower()}") for one in fields_in(AngleSteps, at))
    else:
        yield BenchField(name, at, "Angles", message("such as 45 deg, 135 deg"), many=True, required=True)


def values_in(data: Any, fields: Iterable[BenchField]) -> dict[str, str]:
    """Return the text of each field of a parsed procedure, by name; a list has commas between its members."""
    written = values_of(data)
    values: dict[str, str] = {}
    for one in fields:
        if one.name.startswith("form:"):
            place = dotted(one.at)
            inside = any(name.startswith(f"{place}.") for name in written)
            values[one.name] = AS_STEPS if inside else AS_LIST
        else:
            values[one.name] = written.get(one.name, "")
    return values


def table_text(text: str, values: Values, fields: Sequence[BenchField]) -> str:
    """Return a procedure's text with the values of its table; angles become a list or steps, as chosen."""
    text = edited_text(text, values, fields)
    return edited_text(text, {}, (), lambda tree, _: _arrange_angles(tree, values, fields))


def _arrange_angles(tree: Any, values: Values, fields: Iterable[BenchField]) -> None:
    for one in fields:
        wanted = values.get(one.name, "")
        if not one.name.startswith("form:"):
            continue
        body: Any = tree
        for step in one.at[:-1]:
            body = body[step]
        now = body.get("angles")
        if wanted == AS_LIST and isinstance(now, dict):
            body["angles"] = in_one_line(_as_list(now))
        elif wanted == AS_STEPS and not isinstance(now, dict):
            body["angles"] = in_one_line(_as_steps(now))


def _as_list(angles: Mapping[str, Any]) -> list[str]:
    try:
        found = AngleSteps.model_validate(dict(angles)).angles_rad
    except ValidationError:
        return [str(angles.get("from", "0 deg"))]
    return [exact_degrees(angle) for angle in found]


def _as_steps(angles: Any) -> dict[str, str]:
    texts = [str(text) for text in angles] if isinstance(angles, list) else ["0 deg"]
    try:
        first, second = (parse_quantity(text, ANGLE) for text in texts[:2])
        step = exact_degrees(second - first)
    except ValueError:
        step = "45 deg"
    return {"from": texts[0], "step": step, "count": str(len(texts))}


# --- steps copied and removed -----------------------------------------------------------------------


def with_copy(text: str, at: Place) -> str:
    """Return the procedure `text` with the step at path `at` repeated. Raises `Refusal` (409)."""
    lines = text.splitlines()
    _, first, end = _block(text, at)
    return _compared(text, [*lines[:end], *lines[first:end], *lines[end:]], at, times=2)


def without_step(text: str, at: Place) -> str:
    """Return a procedure from which the step at path `at` and its comments are removed. Raises `Refusal` (409)."""
    lines = text.splitlines()
    comments, _, end = _block(text, at)
    return _compared(text, [*lines[:comments], *lines[end:]], at, times=0)


def _block(text: str, at: Place) -> tuple[int, int, int]:
    """Return three line numbers of a step: where its comments begin, where it begins, and where it ends."""
    lines = text.splitlines()
    first = read_yaml(text).lines.get(at, 0) - 1
    if first < 0 or not lines[first].lstrip().startswith("- "):
        raise Refusal(409, "the step stands in one line with others; change it in the text")
    mark = re.match(r" *- ", lines[first])
    indent = len(mark[0]) - 2 if mark else 0
    end = first + 1
    for number in range(first + 1, len(lines)):
        bare_line = lines[number].strip()
        if bare_line and not bare_line.startswith("#"):
            if len(lines[number]) - len(lines[number].lstrip()) <= indent:
                break
            end = number + 1
    comments = first
    while comments and lines[comments - 1].startswith(f"{' ' * indent}#"):
        comments -= 1
    return comments, first, end


def _compared(text: str, lines: list[str], at: Place, times: int) -> str:
    """Return `lines` as text. Raises `Refusal` (409) if they are not `text` with `times` copies of step `at`."""
    changed = "\n".join(lines) + "\n"
    wanted = copy.deepcopy(read_yaml(text).data)
    steps: Any = wanted
    for part in at[:-1]:
        steps = steps[part]
    index = int(at[-1])
    steps[index : index + 1] = [steps[index]] * times
    if not steps or read_yaml(changed).data != wanted:
        raise Refusal(409, "the table cannot make this change; make it in the text")
    return changed


def place_of(name: str, rows: Iterable[Row]) -> Place:
    """Return the path of the step whose row has this name. Raises `Refusal` (400) if there is none."""
    for row in rows:
        if row.group.place == name:
            return row.group.at[:-1]
    raise Refusal(400, "there is no such step in the table; load the page again")


# --- mistakes ---------------------------------------------------------------------------------------

_BESIDE: Final = re.compile(r"[\w+-][\w.+-]*")


def judged(path: Path, text: str) -> tuple[tuple[FileMistake, ...], Procedure | None]:
    """Return a procedure's mistakes, and the procedure or None; it may include files of its folder only."""
    beside = [
        FileMistake(
            0,
            row.group.place,
            message(
                "the panel includes files of the same folder only, with names of letters, digits, _ . + -; move or "
                "rename the file, and write its name here"
            ),
        )
        for row in rows_of(read_yaml(text).data)
        if row.group.at[-1] == "include" and _BESIDE.fullmatch(row.written) is None
    ]
    if beside:
        return tuple(beside), None
    try:
        return (), load_procedure(path, text.encode())
    except FileMistakes as mistakes:
        return mistakes.mistakes, None


# --- the pages ----------------------------------------------------------------------------------------

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
    expected, longest = duration(found.expected_s), duration(found.longest_s)
    told = [
        message(f"{found.steps} steps, {found.operator_actions} operator actions, "
        f"{found.counts.get('read', 0)} readings."),
        message(f"About {expected} (at most {longest}).") if found.longest_s > found.expected_s
        else message(f"About {expected}."),
        *(message(f"Installation {label}: {duration(seconds)}.") if label
          else message(f"Before the first mounting: {duration(seconds)}.")
          for label, seconds in found.expected_by_installation_s.items()),
        *(message(f"Not determined: {', '.join(one.coefficients)}.")
          for one in found.not_determined if one.coefficients),
    ]  # fmt: skip
    actions = tuple(step.describe() for step in plan.steps if step.BY_OPERATOR)
    shown = actions[:MOST_TOLD] + (("…",) if len(actions) > MOST_TOLD else ())
    return CheckBeside(tuple(told), tuple(found.problems), shown)
