"""The form of a bench file: groups of fields made from the models of the file's sections, and its mistakes."""

from __future__ import annotations

import datetime
import inspect
import re
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Annotated, Any, Final, Literal, TypeGuard, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from bench.base.arrays import CHANNELS
from bench.base.languages import message
from bench.base.units import AccelerationMS2, QuantityKind, quantity_of, written_quantity
from bench.base.yaml_files import FileMistake, Place, dotted
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import CheckBlockSection
from bench.config.bench_file.stand import (
    InstallationSection,
    Location,
    MeasuredGravity,
    StandSection,
    UncertaintySection,
    UnitSupplySection,
    UnitUnderTest,
    VerificationSection,
)
from bench.config.devices.device import Role
from bench.config.devices.registry import devices

GRAVITY_FORM: Final = "form:gravity"
METERS: Final = "form:voltmeters"
OF_BENCH: Final = ("name", "description", "line_frequency")
METERS_PLACE: Final[Place] = ("instruments", "voltmeters")
GRAVITY: Final[Place] = ("gravity",)
ROLES: Final[Mapping[Role, str]] = {
    "head": message("Head"), "chamber": message("Chamber"), "level": message("Level"),
    "thermometer": message("Thermometer at the block"), "power_supply": message("Power supply"),
}  # fmt: skip
"""The instruments other than the voltmeters that have a form, with their titles; only the head is required."""
INSTALLATIONS: Final[Place] = ("installations",)
NEW_INSTALLATION: Final = "form:installation"
SUPPLY: Final[Place] = ("unit_under_test", "supply")
FURTHER: Final[tuple[tuple[str, type[BaseModel], str], ...]] = (
    (message("Further uncertainty"), UncertaintySection, "uncertainty"),
    (message("Verification"), VerificationSection, "verification"),
    (message("Check block"), CheckBlockSection, "check_block"),
)
"""The sections at the end of the form: their titles, models and keys."""
MOST_ROWS: Final = 72
"""The most rows of a table that the form adds; a head's table at every 5° has as many."""

Values = Mapping[str, str]
"""The texts of a bench file or of its form, by dotted path; keys "form:…" are choices that only the form has."""


@dataclass(frozen=True)
class BenchField:
    """A field of the form: an input whose name is the dotted path of its value in the bench file.

    `choices` are pairs (value, words), empty for a text field. If `shows` is True, the value decides which other
    fields exist. A field that is not `required` is folded away while it is empty.
    """

    name: str
    at: Place
    label: str
    help: str = ""
    choices: tuple[tuple[str, str], ...] = ()
    required: bool = False
    shows: bool = False
    found: bool = False
    """Whether the value is the resource of an instrument; the form then offers the resources found."""
    many: bool = False
    """Whether the value is a list, written with commas between its members."""
    rows: type[BaseModel] | None = None
    """The model of a row, if the field is the number of rows of the table at `at`."""


@dataclass(frozen=True)
class Group:
    """A section of the form with its fields, or a row of a table in a section.

    `section` is the model of a section whose empty fields are folded away; it is None for other groups.
    """

    title: str
    at: Place
    help: str
    fields: tuple[BenchField, ...]
    section: type[BaseModel] | None = None
    row: bool = False
    own: bool = False
    """Whether the laboratory must state each value itself, such as its gravity; no example can know it."""

    @property
    def place(self) -> str:
        """The dotted path of the section in the file."""
        return dotted(self.at)


# --- groups -----------------------------------------------------------------------------------------


def groups_of(values: Values) -> list[Group]:
    """Return the groups of the form; the choices in `values` determine the fields."""
    others = frozenset(BenchFile.model_fields) - {*OF_BENCH}
    block = tuple(fields_in(UnitUnderTest, ("unit_under_test",)))
    groups = [Group(message("Bench"), (), "", tuple(fields_in(BenchFile, (), others))), _gravity(values)]
    groups += _voltmeters(values)
    for role, title in ROLES.items():
        groups += _instrument(role, ("instruments", role), title, values, required=role == "head")
    groups += _section(message("Stand errors"), StandSection, ("stand",), values, own=True)
    groups += _installations(values)
    groups.append(
        Group(message("Block"), ("unit_under_test",), first_sentence(UnitUnderTest), block, own=True)
    )
    if values.get("instruments.power_supply.driver"):
        title = message("Supply of the block")
        groups += _section(title, UnitSupplySection, SUPPLY, values, optional=True, own=True)
    for title, model, key in FURTHER:
        optional = not BenchFile.model_fields[key].is_required()
        groups += _section(title, model, (key,), values, optional=optional)
    return groups


def _section(
    title: str,
    model: type[BaseModel],
    at: Place,
    values: Values,
    *,
    first: tuple[BenchField, ...] = (),
    optional: bool = False,
    own: bool = False,
) -> Iterator[Group]:
    """Yield the group of a section, with the fields `first`, and a group for each row of its tables."""
    skip = frozenset(str(one.at[-1]) for one in first)
    fields = (*first, *_fields_of(model, at, values, skip, optional=optional))
    yield Group(title, at, first_sentence(model), fields, model, own=own)
    for table in fields:
        for number in range(number_of_rows(table.at, values) if table.rows else 0):
            row = (*table.at, number)
            inner = tuple(
                replace(one, help="" if number else one.help)  # the first row explains the others
                for one in _fields_of(table.rows or model, row, values)
            )
            yield Group(message(f"{title}: row {number + 1}"), row, "", inner, row=True, own=own)


def _fields_of(
    model: type[BaseModel],
    at: Place,
    values: Values,
    skip: frozenset[str] = frozenset(),
    *,
    optional: bool = False,
) -> Iterator[BenchField]:
    """Yield the fields of a section and of the sections in it; of a table, the number of its rows.

    In an `optional` section, no field is required before one of them is filled.
    """
    inner = {key: info for key, info in model.model_fields.items() if key not in skip}
    sections = {key: found for key, info in inner.items() if (found := _optional_section(info.annotation))}
    written = {key for key in sections if within((*at, key), values)}
    fields = fields_in(model, at, skip | written)
    yield from _as_begun(fields, at, values) if optional else fields
    for key, info in inner.items():
        if (row := _row_model(info.annotation)) is not None:
            yield _number_field(row, (*at, key), values)
        elif key in written or (key in sections and _words(info.annotation, info.metadata) is None):
            yield from _fields_of(sections[key], (*at, key), values, optional=True)


def _number_field(row: type[BaseModel], at: Place, values: Values) -> BenchField:
    name, number = f"form:{dotted(at)}", number_of_rows(at, values)
    choices = tuple((str(one), str(one)) for one in range(1, MOST_ROWS + 1))
    if not values.get(name):
        choices = (("", str(number or "none")), *choices)
    label = _label(f"number_of_{at[-1]}", at[:-1])
    return BenchField(name, at, label, choices=choices, required=number > 0, shows=True, rows=row)


def number_of_rows(at: Place, values: Values) -> int:
    """Return the number of rows of a table: the number chosen in the form, else the number of rows with values.

    A table has at least one row if its section has any value.
    """
    chosen = values.get(f"form:{dotted(at)}", "")
    if chosen.isdecimal() and len(chosen) < 3:
        return min(int(chosen), MOST_ROWS)
    return next(n for n in count(int(_is_begun(at[:-1], values))) if not within((*at, n), values))


def _is_begun(at: Place, values: Values) -> bool:
    """Whether a value of the section at a path is filled, or the number of rows of a table in it is chosen."""
    inside = f"{dotted(at)}."
    return any(text.strip() for name, text in values.items() if name.removeprefix("form:").startswith(inside))


def _installations(values: Values) -> Iterator[Group]:
    """Yield the group with the label of a new installation, and a group for each installation of the file."""
    told = message("Installations 1 and 2 are known. State each further one that a procedure uses.")
    label = message("Label of a further installation")
    field = BenchField(NEW_INSTALLATION, INSTALLATIONS, label, message("such as V or 1T90"), shows=True)
    yield Group(message("Installations"), INSTALLATIONS, told, (field,))
    keys = "|".join(InstallationSection.model_fields)
    found = (re.fullmatch(rf"installations\.(.+)\.(?:{keys})", name) for name in values)
    for label in dict.fromkeys([values.get(NEW_INSTALLATION, ""), *(match[1] for match in found if match)]):
        if label:
            at = (*INSTALLATIONS, label)
            fields = tuple(_fields_of(InstallationSection, at, values, optional=True))
            yield Group(message(f"Installation {label}"), at, "", fields, row=True)


def _gravity(values: Values) -> Group:
    chosen = values.get(GRAVITY_FORM, "")
    words = (("", message("not stated")), *((form, form) for form in FORMS_OF_GRAVITY.values()))
    choice = BenchField(GRAVITY_FORM, GRAVITY, message("Gravity is stated as"), choices=words, shows=True)
    told = ""
    inner: tuple[BenchField, ...] = ()
    if chosen == FORMS_OF_GRAVITY["value"]:
        inner = (BenchField("gravity", GRAVITY, "Gravity", _words(AccelerationMS2, ()) or "", required=True),)
    elif chosen in FORMS_OF_GRAVITY.values():
        model = Location if chosen == FORMS_OF_GRAVITY["place"] else MeasuredGravity
        told, inner = first_sentence(model), tuple(fields_in(model, GRAVITY))
    return Group(message("Local gravity"), GRAVITY, told, (choice, *inner), own=True)


def _voltmeters(values: Values) -> Iterator[Group]:
    words = (
        ("3", message("three, one for each signal")), ("2", "two"), ("1", message("one, which scans all signals")),
    )  # fmt: skip
    choice = BenchField(METERS, METERS_PLACE, message("Number of voltmeters"), choices=words, shows=True)
    yield Group(message("Voltmeters"), METERS_PLACE, "", (choice,))
    for index in range(number_of_meters(values)):
        at = (*METERS_PLACE, index)
        device = devices().get(values.get(dotted((*at, "driver")), ""))
        reads_one = device is not None and "channels" in device.section.model_fields
        signal = values.get(dotted((*at, "channels")), "") if reads_one else ""
        title = message(f"Voltmeter of {signal}") if signal else f"Voltmeter {index + 1}"
        yield from _instrument("voltmeter", at, title, values, required=True)


def number_of_meters(values: Values) -> int:
    """Return the number of voltmeters chosen in the form; 3 if none is."""
    text = values.get(METERS, "")
    return int(text) if text in {"1", "2", "3"} else len(CHANNELS)


def _instrument(role: Role, at: Place, title: str, values: Values, *, required: bool) -> Iterator[Group]:
    known = devices().of(role)
    name = dotted((*at, "driver"))
    words = tuple((one.name, f"by hand ({one.name})" if one.section.by_hand else one.name) for one in known)
    choices = words if required else (("", "none"), *words)
    choice = BenchField(name, (*at, "driver"), "Instrument", choices=choices, required=True, shows=True)
    device = devices().get(values.get(name, ""))
    if device is None or device not in known:
        yield Group(title, at, "", (choice,))
    else:
        yield from _section(title, device.section, at, values, first=(choice,))


def _as_begun(fields: Iterable[BenchField], at: Place, values: Values) -> Iterator[BenchField]:
    """Yield the fields of a section that may be left out, required only if one of them is filled."""
    begun = _is_begun(at, values)
    for one in fields:
        left_out = (("", message("left out")),) if one.choices and one.required else ()
        yield replace(one, required=one.required and begun, choices=(*left_out, *one.choices))


def within(at: Place, values: Values) -> list[str]:
    """Return the names of the values in the section at a path."""
    return [name for name in values if name.startswith(f"{dotted(at)}.")]


# --- fields -----------------------------------------------------------------------------------------


def fields_in(
    model: type[BaseModel], at: Place, skip: frozenset[str] = frozenset(), default: Any = None
) -> Iterator[BenchField]:
    """Yield a field for each value of a model and of its required sections; `at` is the model's path in the file.

    Tables and optional sections, such as certificates, get no field here. `default` is the section that applies if
    the file lacks it. In a section, coverage factor and degrees of freedom come last.
    """
    model.model_rebuild()
    for name, info in sorted(model.model_fields.items(), key=lambda item: item[0] in {"k", "dof"}):
        key = info.alias or name
        if key in skip:
            continue
        inner = info.annotation
        if is_model(inner):
            value = info.get_default(call_default_factory=True, validated_data={})
            given = value if isinstance(value, BaseModel) else None
            yield from fields_in(inner, (*at, key), default=given)
            continue
        yield from _fields_of_key(key, info, at, getattr(default, name, None))


def _fields_of_key(key: str, info: FieldInfo, at: Place, default: Any) -> Iterator[BenchField]:
    place = (*at, key)
    label = _label(key, at)
    required = info.is_required() and default is None
    one = BenchField(dotted(place), place, label, required=required, found=key == "resource")
    if key == "channels":
        yield replace(one, label="Signal", choices=tuple((signal, signal) for signal in CHANNELS))
    elif key == "inputs":
        for signal in CHANNELS:
            inside = (*place, signal)
            yield BenchField(
                dotted(inside),
                inside,
                message(f"Input of {signal}"),
                message("the channel of the multiplexer"),
            )
    elif (words := _words(info.annotation, info.metadata)) is not None:
        left_out = _left_out(info, default)
        told = ". ".join(filter(None, (words, message(f"Left out: {left_out}") if left_out else "")))
        choices = _choices(info.annotation)
        if choices and not required:
            choices = (("", message(f"left out: {left_out}") if left_out else message("left out")), *choices)
        yield replace(one, help="" if choices else told, choices=choices, many=_is_list(info.annotation))


_WITHIN: Final = frozenset({
    "serial", "scale_factors", "temperature", "certificate", "gain", "offset", "current", "limits", "warm_up",
    "population", "baseline_days", *StandSection.model_fields, *UncertaintySection.model_fields,
})  # fmt: skip
"""Sections within a section, whose name precedes the label of each of their fields."""


def _label(key: str, at: Place) -> str:
    own = key.replace("_", " ")
    if len(at) > 1 and at[-1] in _WITHIN:
        return f"{str(at[-1]).replace('_', ' ').capitalize()}: {own}"
    return own if len(own) == 1 else own.capitalize()


_PLAIN: Final[Mapping[Any, str]] = {
    str: "", int: message("a whole number"), float: "a number", datetime.date: message("a date such as 2026-03-02"),
}  # fmt: skip


def _words(annotation: Any, metadata: Iterable[Any]) -> str | None:
    """Return in words what kind of value a field takes; None for a list or section, which has no field."""
    kind = quantity_of(annotation, tuple(metadata))
    if kind is not None:
        return f"{kind.called}, {message(f'such as {kind.example}')}"
    if _is_list(annotation):
        return message("with commas between")
    return "" if _choices(annotation) else _PLAIN.get(bare(annotation))


def _is_list(annotation: Any) -> bool:
    return get_origin(bare(annotation)) is tuple and get_args(bare(annotation))[0] is str


def is_model(kind: Any) -> TypeGuard[type[BaseModel]]:
    """Whether a type is a model, that is a section of a file."""
    return inspect.isclass(kind) and not get_args(kind) and issubclass(kind, BaseModel)


def _optional_section(annotation: Any) -> type[BaseModel] | None:
    """Return the model of a section that may be left out or written as a plain value; None for another type."""
    kind = bare(annotation)
    if is_model(annotation) or not (is_model(kind) or get_origin(kind) in {Union, types.UnionType}):
        return None
    return next((part for one in (kind, *get_args(kind)) if is_model(part := bare(one))), None)


def _row_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model of a table's rows; None for any other type."""
    kind = bare(annotation)
    return get_args(kind)[0] if get_origin(kind) is tuple and is_model(get_args(kind)[0]) else None


def bare(annotation: Any) -> Any:
    """Return the type of an annotation without metadata and None; a union of several types is unchanged."""
    if get_origin(annotation) is Annotated:
        return bare(get_args(annotation)[0])
    if get_origin(annotation) in {Union, types.UnionType}:
        parts = [part for part in get_args(annotation) if part is not type(None)]
        return bare(parts[0]) if len(parts) == 1 else annotation
    return annotation


def _choices(annotation: Any) -> tuple[tuple[str, str], ...]:
    inner = bare(annotation)
    if inner is bool:
        return (("yes", "yes"), ("no", "no"))
    return tuple((str(word), str(word)) for word in get_args(inner)) if get_origin(inner) is Literal else ()


def _left_out(info: FieldInfo, default: Any) -> str:
    value = info.get_default(call_default_factory=True, validated_data={}) if default is None else default
    if value is None or value is PydanticUndefined or value == "" or value == float("inf"):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    kind: QuantityKind | None = quantity_of(info.annotation, info.metadata)
    if kind is not None and isinstance(value, float):
        return written_quantity(value, kind)
    return f"{value:g}" if isinstance(value, float) else str(value)


def first_sentence(model: type[BaseModel]) -> str:
    """Return the first sentence of a model's description, without code marks."""
    text = " ".join(inspect.cleandoc(model.__doc__ or "").partition("\n\n")[0].split())
    return re.split(r"(?<=\.) ", text)[0].replace("`", "")


# --- values -----------------------------------------------------------------------------------------


def values_of(data: Any) -> dict[str, str]:
    """Return a bench file's values as texts by dotted path, and the form's choices ("form:…") for them."""
    values: dict[str, str] = {}

    def look(part: Any, at: Place) -> None:
        if isinstance(part, dict):
            for key, inner in part.items():
                look(inner, (*at, key))
        elif isinstance(part, list):
            if all(not isinstance(one, dict | list) for one in part):
                values[dotted(at)] = ", ".join(map(str, part))
                return
            if at != METERS_PLACE:
                values[f"form:{dotted(at)}"] = str(len(part))
            for index, inner in enumerate(part):
                look(inner, (*at, index))
        elif part is not None:
            values[dotted(at)] = str(part)

    look(data, ())
    top = data if isinstance(data, dict) else {}
    values[GRAVITY_FORM] = _form_of(top.get("gravity"))
    instruments = top.get("instruments")
    meters = instruments.get("voltmeters") if isinstance(instruments, dict) else None
    values[METERS] = str(len(meters)) if isinstance(meters, list) else str(len(CHANNELS))
    return values


FORMS_OF_GRAVITY: Final = {
    "value": message("value of gravity"),
    "place": message("location of gravity"),
    "source": message("gravity with its source"),
}
"""The ways to state gravity, as the models of `bench.config.bench_file.stand` call them."""


def _form_of(written: Any) -> str:
    if written is None:
        return ""
    if isinstance(written, dict):
        return FORMS_OF_GRAVITY["source" if "value" in written else "place"]
    return FORMS_OF_GRAVITY["value"]


def completed(values: Values, before: Values) -> dict[str, str]:
    """Return the typed values, with the values that follow from a new driver or number of voltmeters.

    If a driver differs from that in `before`, the values of the file, the form's missing fields get the values of
    the driver's example, except resources. A single voltmeter gets a driver that scans the signals. An added
    voltmeter gets the driver, range and interface of the first one, and the next signal.
    """
    full = dict(values)
    number = number_of_meters(full)
    names = [dotted((*METERS_PLACE, index)) for index in range(number)]
    scanning = [one.name for one in devices().of("voltmeter") if "inputs" in one.section.model_fields]
    if number == 1 and scanning and full.get(f"{names[0]}.driver") not in scanning:
        full[f"{names[0]}.driver"] = scanning[0]
    for index, name in enumerate(names):
        if not full.get(f"{name}.driver"):
            for key in ("driver", "range", "interface"):
                full[f"{name}.{key}"] = full.get(f"{names[0]}.{key}", "")
        _exemplify(full, before, name)
        device = devices().get(full.get(f"{name}.driver", ""))
        if device is not None and "channels" in device.section.model_fields:
            full[f"{name}.channels"] = full.get(f"{name}.channels") or CHANNELS[index]
    for role in ROLES:
        _exemplify(full, before, dotted(("instruments", role)))
    if within((*INSTALLATIONS, full.get(NEW_INSTALLATION, "")), full):
        full[NEW_INSTALLATION] = ""
    return full


def _exemplify(values: dict[str, str], before: Values, name: str) -> None:
    driver = values.get(f"{name}.driver", "")
    device = devices().get(driver)
    if device is None or before.get(f"{name}.driver", "") == driver:
        return
    for place, text in values_of(dict(device.example)).items():
        if not place.startswith(("resource", "channels", "form:")):
            values.setdefault(f"{name}.{place}", {"False": "no", "True": "yes"}.get(text, text))


def still_of_example(values: Values, example: Values, groups: Iterable[Group]) -> frozenset[str]:
    """Return the names of fields that the laboratory must state, but that still have the value of `example`.

    The laboratory must state all values of an `own` group, and the resources of the instruments. `example` are the
    texts of the bench file from which the form began.
    """
    return frozenset(
        one.name
        for group in groups
        for one in group.fields
        if (group.own or one.found) and not one.choices
        if (text := values.get(one.name, "").strip()) and text == example.get(one.name)
    )


# --- mistakes ---------------------------------------------------------------------------------------


@dataclass
class Placed:
    """The mistakes of a bench file: `at` by field or group, `elsewhere` those that belong to neither."""

    at: dict[str, list[str]] = field(default_factory=dict)
    elsewhere: list[FileMistake] = field(default_factory=list)

    @property
    def number(self) -> int:
        """The number of mistakes."""
        return sum(map(len, self.at.values())) + len(self.elsewhere)


_QUOTED: Final = re.compile(r"'([^']+)'")
"""A key that a mistake names, such as one that is missing in its section."""


def placed(mistakes: Iterable[FileMistake], groups: Iterable[Group]) -> Placed:
    """Assign each mistake to its field, else to its group, else to `elsewhere`; return the assignment."""
    groups = list(groups)
    fields = [one.name for group in groups for one in group.fields]
    tables = {dotted(one.at): one.name for group in groups for one in group.fields if one.rows}
    known = {*fields, *tables} | {group.place for group in groups if group.at}
    result = Placed()
    for mistake in mistakes:
        place = mistake.place
        if (named := _QUOTED.search(mistake.text)) is not None and place not in fields:
            inside = f"{place}.{named[1]}".removeprefix(".")
            first = (
                name for name in fields if name == inside or name.startswith((f"{inside}.", f"{inside}["))
            )
            place = next(first, place)
        while place and place not in known:
            place = place[: max(place.rfind("."), place.rfind("["), 0)]
        if place:
            result.at.setdefault(tables.get(place, place), []).append(mistake.text)
        else:
            result.elsewhere.append(mistake)
    return result
