"""The form of a bench file: groups of fields, made from the models of its sections; mistakes at fields."""

from __future__ import annotations

import datetime
import inspect
import re
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from bench.base.arrays import CHANNELS
from bench.base.languages import message
from bench.base.units import AccelerationMS2, QuantityKind, quantity_of, written_quantity
from bench.base.yaml_files import FileMistake, Place, dotted
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.stand import Location, MeasuredGravity, StandSection, UnitUnderTest
from bench.config.devices.device import Certificate, RangeValues, Role, VoltmeterCertificate
from bench.config.devices.registry import devices

GRAVITY_FORM: Final = "form:gravity"
METERS: Final = "form:voltmeters"
OF_BENCH: Final = ("name", "description", "line_frequency")
METERS_PLACE: Final[Place] = ("instruments", "voltmeters")
GRAVITY: Final[Place] = ("gravity",)
ONE_ROLE: Final[tuple[tuple[Role, bool], ...]] = (("head", True), ("chamber", False))
"""Roles other than the voltmeters that have a form, each with whether a bench must fill it."""

Values = Mapping[str, str]
"""The texts of a bench file or of its form, by dotted path; keys "form:…" are choices that only the form has."""


@dataclass(frozen=True)
class BenchField:
    """A field of the form: an input whose name is the dotted path of its value in the bench file.

    `choices` are pairs (value, words), empty for a text field; `shows` says whether the choice decides which
    other fields exist.
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


@dataclass(frozen=True)
class Group:
    """A section of the form with its fields.

    `section` is the model of an instrument or of the stand errors, of which empty fields are folded away; None for
    other sections.
    """

    title: str
    at: Place
    help: str
    fields: tuple[BenchField, ...]
    section: type[BaseModel] | None = None
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
    bench = Group("Bench", (), "", tuple(fields_in(BenchFile, (), others)))
    block = Group(
        "Block",
        ("unit_under_test",),
        first_sentence(UnitUnderTest),
        tuple(fields_in(UnitUnderTest, ("unit_under_test",))),
        own=True,
    )
    instruments = [
        _instrument(role, ("instruments", role), role.capitalize(), values, required=required)
        for role, required in ONE_ROLE
    ]
    errors = [
        one for key in StandSection.model_fields for one in _optional(StandSection, key, ("stand",), values)
    ]
    told = first_sentence(StandSection)
    stand = Group(message("Stand errors"), ("stand",), told, tuple(errors), StandSection, own=True)
    return [bench, _gravity(values), *_voltmeters(values), *instruments, stand, block]


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
    yield Group("Voltmeters", METERS_PLACE, "", (choice,))
    for index in range(number_of_meters(values)):
        group = _instrument(
            "voltmeter", (*METERS_PLACE, index), f"Voltmeter {index + 1}", values, required=True
        )
        signal = values.get(f"{group.place}.channels", "")
        reads_one = any(one.at[-1] == "channels" for one in group.fields)
        yield replace(group, title=message(f"Voltmeter of {signal}")) if signal and reads_one else group


def number_of_meters(values: Values) -> int:
    """Return the number of voltmeters chosen in the form; 3 if none is."""
    text = values.get(METERS, "")
    return int(text) if text in {"1", "2", "3"} else len(CHANNELS)


def _instrument(role: Role, at: Place, title: str, values: Values, *, required: bool) -> Group:
    known = devices().of(role)
    name = dotted((*at, "driver"))
    words = tuple((one.name, f"by hand ({one.name})" if one.section.by_hand else one.name) for one in known)
    stated = values.get(name, "")
    choices = words if required else (("", "none"), *words)
    choice = BenchField(name, (*at, "driver"), "Instrument", choices=choices, required=required, shows=True)
    device = devices().get(stated)
    if device is None or device not in known:
        return Group(title, at, "", (choice,))
    inner = tuple(fields_in(device.section, at, frozenset({"driver"})))
    certificate = bare(device.section.model_fields["certificate"].annotation)
    inner = (choice, *inner, *_certificate(certificate, (*at, "certificate"), values))
    return Group(title, at, first_sentence(device.section), inner, device.section)


def _certificate(model: type[Certificate], at: Place, values: Values) -> Iterator[BenchField]:
    """Yield the fields of an instrument's certificate; none is required before one of them is filled.

    For a voltmeter these include the corrections of each range with their U and k. For another instrument there are
    fields only if the bench file has its certificate, because the form has none for the table of corrections.
    """
    of_meter = issubclass(model, VoltmeterCertificate)
    if of_meter or within(at, values):
        yield from _as_begun(fields_in(model, at), at, values)
    for number in range(_rows(at, values) if of_meter else 0):
        row = (*at, "values", number)
        yield from _as_begun(fields_in(RangeValues, row), at, values)
        for key in ("gain", "offset"):
            yield from _optional(RangeValues, key, row, values)


def _rows(at: Place, values: Values) -> int:
    """Return the number of ranges in a voltmeter's certificate, at least 1 to be filled."""
    return next(number for number in count(1) if not within((*at, "values", number), values))


def _optional(model: type[BaseModel], key: str, at: Place, values: Values) -> Iterator[BenchField]:
    """Yield the fields of the section `key` of `model`, whether or not the file may leave the section out."""
    info = model.model_fields[key]
    inner = fields_in(bare(info.annotation), (*at, key))
    return inner if info.is_required() else _as_begun(inner, (*at, key), values)


def _as_begun(fields: Iterable[BenchField], at: Place, values: Values) -> Iterator[BenchField]:
    """Yield the fields of a section that may be left out, required only if one of them is filled."""
    begun = any(values[name].strip() for name in within(at, values))
    for one in fields:
        choices = (("", message("left out")), *one.choices) if one.choices else ()
        yield replace(one, required=one.required and begun, choices=choices)


def within(at: Place, values: Values) -> list[str]:
    """Return the names of the values in the section at a path."""
    return [name for name in values if name.startswith(f"{dotted(at)}.")]


# --- fields -----------------------------------------------------------------------------------------


def fields_in(
    model: type[BaseModel], at: Place, skip: frozenset[str] = frozenset(), default: Any = None
) -> Iterator[BenchField]:
    """Yield the field for each value of a model and of its required sections; `at` is the model's path in the file.

    Lists and optional sections, such as certificates, have no field here. `default` is the section that applies if
    the file has none.
    """
    model.model_rebuild()
    for name, info in model.model_fields.items():
        key = info.alias or name
        if key in skip:
            continue
        inner = info.annotation
        if inspect.isclass(inner) and not get_args(inner) and issubclass(inner, BaseModel):
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
        yield replace(one, help="" if choices else told, choices=choices)


_WITHIN: Final = (
    "serial", "scale_factors", "temperature", "certificate", "gain", "offset", *StandSection.model_fields,
)  # fmt: skip
"""Sections within a section, whose name precedes the label of each of their fields."""


def _label(key: str, at: Place) -> str:
    own = key.replace("_", " ")
    if at and at[-1] in _WITHIN:
        return f"{str(at[-1]).replace('_', ' ').capitalize()}: {own}"
    if at[-2:-1] == ("values",):
        return f"Certificate: {own}"
    return own if len(own) == 1 else own.capitalize()


_PLAIN: Final[Mapping[Any, str]] = {
    str: "", int: message("a whole number"), float: "a number", datetime.date: message("a date such as 2026-03-02"),
}  # fmt: skip


def _words(annotation: Any, metadata: Iterable[Any]) -> str | None:
    """Return in words what kind of value a field takes; None for a list or section, which has no field."""
    kind = quantity_of(annotation, tuple(metadata))
    if kind is not None:
        return f"{kind.called} such as {kind.example}"
    return "" if _choices(annotation) else _PLAIN.get(bare(annotation))


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
    """Return texts by dotted path: a bench file's values, its form of gravity, its number of meters."""
    values: dict[str, str] = {}

    def look(part: Any, at: Place) -> None:
        if isinstance(part, dict):
            for key, inner in part.items():
                look(inner, (*at, key))
        elif isinstance(part, list):
            if at[-1:] == ("channels",) and len(part) == 1:
                values[dotted(at)] = str(part[0])
                return
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


def listed(values: Values, name: str) -> str:
    """Return the members of the list `name`, separated by commas, as its field shows them."""
    members: list[str] = []
    while (inside := f"{name}[{len(members) + 1}]") in values:
        members.append(values[inside])
    return ", ".join(members)


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
    """Return the typed values, completed with examples for newly chosen drivers.

    Fields that the form did not show yet get the examples, but resources stay empty. `before` are the values of
    the file. A single voltmeter becomes a scanning one; an added voltmeter is a copy of the first one, and
    measures the next signal.
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
    for role, _ in ONE_ROLE:
        _exemplify(full, before, dotted(("instruments", role)))
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
    """Return the names of the fields that the laboratory must state itself and that have the value of `example`.

    These are all values of an `own` group, and the resources of the instruments; `example` are the texts of the
    bench file from which the form began.
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
    """The mistakes of a bench file: by field, by group, and those of neither."""

    at: dict[str, list[str]] = field(default_factory=dict)
    elsewhere: list[FileMistake] = field(default_factory=list)

    @property
    def number(self) -> int:
        """The number of mistakes."""
        return sum(map(len, self.at.values())) + len(self.elsewhere)


_QUOTED: Final = re.compile(r"'([^']+)'")
"""A key that a mistake names, such as one that is missing in its section."""


def placed(mistakes: Iterable[FileMistake], groups: Iterable[Group]) -> Placed:
    """Return the mistakes by field or, without a field, by group; those of neither are `elsewhere`."""
    groups = list(groups)
    fields = [one.name for group in groups for one in group.fields]
    known = {*fields} | {group.place for group in groups if group.at}
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
            result.at.setdefault(place, []).append(mistake.text)
        else:
            result.elsewhere.append(mistake)
    return result
