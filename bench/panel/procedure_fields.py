"""The table of a procedure, with a row of fields for each step; copying and removal of steps in its text."""

from __future__ import annotations

import copy
import inspect
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ValidationError

from bench.base.languages import message
from bench.base.text import exact_degrees
from bench.base.units import ANGLE, parse_quantity
from bench.base.yaml_files import FileMistake, FileMistakes, Place, dotted, read_yaml
from bench.config.procedure.file import AngleSteps, OperatorTimeSection, ReadingSection, StepEntry, TurnVerb
from bench.config.procedure.load import Procedure, load_procedure
from bench.panel.access import Refusal
from bench.panel.bench_fields import BenchField, Group, Values, bare, fields_in, values_of
from bench.panel.round_trip import edited_text, in_one_line

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
