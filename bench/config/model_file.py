"""Model files: the effects of a forward model with their values; naming of the unnamed terms in them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import yaml
from pydantic import Field

from bench.base.arrays import CHANNELS, Floats
from bench.base.units import QuantityKind, parse_quantity
from bench.base.yaml_files import (
    FileMistake,
    FileMistakes,
    FileModel,
    Place,
    load_validated,
    part,
    unknown_word,
)
from bench.config.formulas import FormulaEntry, effects_as_written, formula_mistakes, written_formulas
from bench.model.effects import CATALOGUE, AppliedEffect, Effect, Parameter
from bench.model.effects.base import PART, PASS, InPart, in_part, pass_label
from bench.model.effects.formula import QUANTITY, FormulaEffect
from drivers.interfaces import Channel

FORMAT: Final = "1"
"""The version of the file format; readers refuse any other version."""


class EffectEntry(FileModel):
    """An effect in a file: its name in `CATALOGUE`, its values, and the channels and mountings affected.

    `installations` lists mountings ("2", in series 3 "2/3") or passes ("2 pass 1"); empty means all.
    `either_of` lists the effects that the readings could not distinguish, this one first; empty if none.
    """

    name: str
    channels: tuple[Channel, ...] = Field(CHANNELS, min_length=1)
    installations: tuple[str, ...] = ()
    either_of: tuple[str, ...] = ()
    parameters: dict[str, Any]

    def applied(self) -> AppliedEffect:
        """Return the effect with its values in SI. The entry must have passed `effect_mistakes`."""
        effect = CATALOGUE[self.name]
        values: dict[str, Floats] = {}
        u: dict[str, Floats] = {}
        for parameter in effect.parameters:
            if parameter.name in self.parameters:
                read = _Reader(parameter, self.channels)
                read.all(self.parameters[parameter.name])
                values[parameter.name] = read.values
                if read.has_u:
                    u[parameter.name] = read.u
        return AppliedEffect(effect, values, self.channels, u, self.installations, self.either_of)


class OpenShape(FileModel):
    """A correction of the shape of an effect, by an uncertain amount.

    The correction is the sum of `changes` times the factor `times`, which has the standard uncertainty `u`.
    `of` names the corrected effect. The factors of different corrections are uncorrelated. `says` describes
    the correction for the reader of the file; nothing is computed from it.
    """

    of: str
    says: str | None = None
    times: float = Field(allow_inf_nan=False)
    u: float = Field(gt=0.0, allow_inf_nan=False)
    changes: tuple[EffectEntry, ...] = Field(min_length=1)

    def applied(self, number: int) -> AppliedEffect:
        """Return correction `number` (from 1) of its effect as an effect of amplitude `times` ± `u`."""
        return in_part(self.of, number, tuple(entry.applied() for entry in self.changes), self.times, self.u)


class WithEffects(FileModel):
    """A file or section with `effects` and the user's `formulas` that they use.

    `left_open` lists uncertain corrections of the shapes of these effects.
    """

    if TYPE_CHECKING:
        formulas: tuple[FormulaEntry, ...]
        effects: tuple[EffectEntry, ...]
        left_open: tuple[OpenShape, ...]

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield the mistakes in the effects and in the formulas that they use."""
        return mistakes_with_formulas(data)

    def own_effects(self) -> tuple[Effect, ...]:
        """Return the effects that the formulas in the file define."""
        return tuple(entry.effect() for entry in self.formulas)

    def applied_effects(self) -> tuple[AppliedEffect, ...]:
        """Return the file's effects (values in SI), then the corrections in `left_open` as effects."""
        count: Counter[str] = Counter()
        with CATALOGUE.also(self.own_effects()):
            applied = [entry.applied() for entry in self.effects]
            for entry in self.left_open:
                count[entry.of] += 1
                applied.append(entry.applied(count[entry.of]))
        return tuple(applied)


class ModelFile(WithEffects):
    """A model file: effects that extend the model named `parent`.

    `data_sha256` has the hashes of the readings used to make the file, separated by blanks. `evidence` is
    text for the reader of the file; nothing is computed from it. `dark_uncertainty` is the standard deviation
    of a reading that neither effects nor unnamed terms explain; a note warns users of the file.
    """

    model_file: Literal["1"]
    name: str
    parent: str = "paper"
    data_sha256: str | None = None
    evidence: dict[str, str] = Field(default_factory=dict)
    dark_uncertainty: str | None = None
    formulas: tuple[FormulaEntry, ...] = ()
    effects: tuple[EffectEntry, ...] = ()
    left_open: tuple[OpenShape, ...] = ()


def load_model(path: Path, installations: Collection[str] = ()) -> ModelFile:
    """Read a model file. Raises `FileMistakes` with every mistake in the file.

    If the bench's `installations` are given, an effect of any other installation is a mistake, too.
    """
    model = load_validated(path, ModelFile)
    mistakes = [
        FileMistake(0, f"effects[{index}].installations", text)
        for index, entry in enumerate(model.effects, start=1)
        for text in _mounting_mistakes(entry.installations, installations)
    ]
    if mistakes and installations:
        raise FileMistakes(path, mistakes)
    return model


# --- reading effects --------------------------------------------------------------------------------


def mistakes_with_formulas(
    data: Any, installations: Collection[str] = (), place: Place = ()
) -> Iterator[tuple[Place, str]]:
    """Yield place and text of the mistakes in `formulas`, `effects` and `left_open` of the section at `place`."""
    wrong = list(formula_mistakes(part(data, "formulas"), (*place, "formulas")))
    yield from wrong
    if wrong:
        return  # without valid formulas, the set of effects is unknown
    with CATALOGUE.also(effects_as_written(part(data, "formulas"))):
        yield from list(effect_mistakes(part(data, "effects"), (*place, "effects"), installations))
        yield from list(_left_open_mistakes(part(data, "left_open"), (*place, "left_open"), installations))


def _left_open_mistakes(
    entries: Any, place: Place, installations: Collection[str]
) -> Iterator[tuple[Place, str]]:
    for index, entry in enumerate(entries if isinstance(entries, list) else []):
        here: Place = (*place, index, "changes")
        effects = part(entry, "changes")
        wrong = list(effect_mistakes(effects, here, installations))
        yield from wrong
        if wrong or not isinstance(effects, list):
            continue
        stages = {CATALOGUE[one["name"]].stage for one in effects if isinstance(one, dict) and "name" in one}
        if len(stages) > 1:
            yield here, "its effects act at several stages of the model: state a size for each"


def effect_mistakes(
    entries: Any, place: Place, installations: Collection[str] = ()
) -> Iterator[tuple[Place, str]]:
    """Yield place and text of the mistakes in a list of effects as written at `place`.

    If the bench's `installations` are given, an effect of any other installation is a mistake, too.
    """
    seen: set[tuple[object, ...]] = set()
    for index, entry in enumerate(entries if isinstance(entries, list) else []):
        if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
            continue
        here = (*place, index)
        effect = CATALOGUE.get(entry["name"])
        if effect is None:
            yield (*here, "name"), unknown_word(entry["name"], sorted(CATALOGUE), "effect")
            continue
        given = entry.get("parameters")
        known = {parameter.name: parameter for parameter in effect.parameters}
        channels = _channels(entry.get("channels"))
        shapes = {parameter.name: parameter.default for parameter in effect.parameters if parameter.is_shape}
        for name, written in (given if isinstance(given, dict) else {}).items():
            inside = (*here, "parameters", name)
            if name not in known:
                yield inside, unknown_word(name, list(known), f"parameter of {effect.name}")
                continue
            reader = _Reader(known[name], channels)
            reader.all(written)
            yield from (((*inside, *where), text) for where, text in reader.problems)
            if name in shapes:
                shapes[name] = float(reader.values)
        mountings = entry.get("installations")
        listed = tuple(sorted(map(str, mountings))) if isinstance(mountings, list) else ()
        if installations:
            yield from (
                ((*here, "installations"), text) for text in _mounting_mistakes(listed, installations)
            )
        common = not any(parameter.per_channel for parameter in effect.parameters)
        if common and set(channels) != set(CHANNELS):
            yield (*here, "channels"), f"{effect.name} acts on all channels alike: remove this line"
        of = CHANNELS if common else channels
        own = {(effect.name, listed, channel, *shapes.values()) for channel in of}
        if own & seen:
            yield here, f"{effect.name} appears twice for the same channel; merge the entries"
        seen |= own


def _mounting_mistakes(written: Iterable[str], installations: Collection[str]) -> Iterator[str]:
    """Yield a sentence for each invalid mounting; valid ones are such as "2", or "2/3" for series 3."""
    for written_one in written:
        mounting, of_pass, number = written_one.partition(PASS)
        label, slash, series = mounting.partition("/")
        if label not in installations:
            yield unknown_word(label, sorted(installations), "installation")
        elif slash and not (series.isascii() and series.isdecimal() and int(series) > 1):
            yield f"expected a series from 2 on after the slash, such as '{label}/2', got '{mounting}'"
        elif of_pass and not (number.isascii() and number.isdecimal()):
            yield f"expected the number of a pass, such as '{pass_label(mounting, 2)}', got '{written_one}'"


def _channels(written: Any) -> tuple[Channel, ...]:
    return tuple(c for c in CHANNELS if c in written) if isinstance(written, list) and written else CHANNELS


class _Reader:
    """Reads a written parameter into `values` and standard uncertainties `u` in SI, shape (3,) or () each.

    `problems` collects the mistakes, each with its place below the parameter.
    """

    def __init__(self, parameter: Parameter, channels: tuple[Channel, ...]) -> None:
        self._parameter = parameter
        self._channels = channels
        unit = "" if parameter.unit == "1" else parameter.unit
        size = parameter.plausible / parameter.si_per_unit
        self._kind = QuantityKind(f"a value of {parameter.name}", f"{size:.3g} {unit}".strip(), unit)
        shape = (3,) if parameter.per_channel else ()
        self.values: Floats = np.zeros(shape)
        self.u: Floats = np.zeros(shape)
        self.has_u = False
        self.problems: list[tuple[Place, str]] = []

    def all(self, written: Any) -> None:
        """Read one value for all channels, or a mapping from channels to values."""
        if not isinstance(written, dict) or not set(written) & set(CHANNELS):
            rows = [CHANNELS.index(channel) for channel in self._channels]
            self._one(written, rows if self._parameter.per_channel else (), ())
            return
        if not self._parameter.per_channel:
            text = f"{self._parameter.name} has one value, not one for each channel"
            self.problems.append(((), text))
            return
        for channel, value in written.items():
            if channel not in CHANNELS:
                self.problems.append(((channel,), unknown_word(channel, list(CHANNELS), "channel")))
            elif channel not in self._channels:
                listed = ", ".join(self._channels)
                self.problems.append(
                    (
                        (channel,),
                        f"channel {channel} is not among 'channels' ({listed}); add it there, or remove its value",
                    )
                )
            else:
                self._one(value, [CHANNELS.index(channel)], (channel,))

    def _one(self, written: Any, rows: Sequence[int] | tuple[()], place: Place) -> None:
        if not isinstance(written, dict):
            self.values[rows] = self._number(written, place)
            return
        for key in written:
            if key not in {"value", "u"}:
                self.problems.append(((*place, key), unknown_word(key, ["value", "u", *CHANNELS], "key")))
        if "value" in written:
            self.values[rows] = self._number(written["value"], (*place, "value"))
        else:
            self.problems.append((place, "'value' is missing; state it"))
        if "u" in written and self._parameter.is_shape:
            text = f"{self._parameter.name} is a shape, which a fit keeps fixed; remove its u"
            self.problems.append(((*place, "u"), text))
        elif "u" in written:
            self.has_u = True
            u = self._number(written["u"], (*place, "u"))
            self.u[rows] = u
            if u < 0.0:
                self.problems.append(((*place, "u"), "the standard uncertainty is negative; state 0 or more"))

    def _number(self, written: Any, place: Place) -> float:
        parameter = self._parameter
        try:
            number = parse_quantity(written, self._kind)
            if parameter.is_shape and (number < 0.0 or (number == 0.0 and 0.0 not in parameter.grid)):
                least = "0 or more" if 0.0 in parameter.grid else "above 0"
                raise ValueError(f"expected {parameter.name} to be {least}, got '{written}'")
            return number * parameter.si_per_unit
        except ValueError as error:
            self.problems.append((place, str(error)))
            return 0.0


# --- writing ----------------------------------------------------------------------------------------


class _Dumper(yaml.SafeDumper):
    """A writer of YAML with each entry of `changes` on one line, so that the entries read as a table."""

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> yaml.MappingNode:
        node = super().represent_mapping(tag, mapping, flow_style)
        for key, value in node.value:
            if key.value == "changes" and isinstance(value, yaml.SequenceNode):
                for change in value.value:
                    change.flow_style = True
        return node


def write_model_file(
    path: Path,
    name: str,
    effects: Sequence[AppliedEffect],
    *,
    parent: str = "paper",
    data_sha256: str | None = None,
    evidence: Mapping[str, object] | None = None,
    dark_uncertainty: str | None = None,
) -> None:
    """Write a model file that `load_model` reads back with equal values.

    Raises `FileMistakes` if `path` exists: a model file is never overwritten.
    """
    told = {key: str(value) for key, value in (evidence or {}).items()} or None
    stated = {"data_sha256": data_sha256, "evidence": told, "dark_uncertainty": dark_uncertainty}
    content: dict[str, Any] = {"model_file": int(FORMAT), "name": name, "parent": parent}
    content |= {key: value for key, value in stated.items() if value is not None}
    content |= written_effects(effects)
    text = yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        problem = "this model file exists and was not overwritten; choose another name"
        raise FileMistakes(path, [FileMistake(0, "", problem)]) from None


def written_effects(effects: Sequence[AppliedEffect]) -> dict[str, Any]:
    """Return the entries of a file for these effects: `effects` and, if needed, `formulas` and `left_open`."""
    content: dict[str, Any] = {}
    formulas = written_formulas(applied.effect for applied in effects)
    if formulas:
        content["formulas"] = formulas
    content["effects"] = [_written_effect(applied) for applied in effects if _is_whole(applied)]
    left_open = [_written_left_open(applied) for applied in effects if not _is_whole(applied)]
    if left_open:
        content["left_open"] = left_open
    return content


def _is_whole(applied: AppliedEffect) -> bool:
    return not isinstance(applied.effect, InPart)


def _written_left_open(applied: AppliedEffect) -> dict[str, Any]:
    effect = applied.effect
    assert isinstance(effect, InPart)  # noqa: S101 - chosen so
    u = float(applied.u.get(PART, np.ones(())))
    return {
        "of": effect.of,
        "says": _said_of_open(effect, float(applied.values[PART]), u or 1.0),
        "times": float(applied.values[PART]),
        "u": u or 1.0,
        "changes": [_written_effect(one) for one in effect.parts],
    }


def _said_of_open(effect: InPart, times: float, u: float) -> str:
    """Return in words what an entry of `left_open` states: the sizes of its parts, multiplied by `times` ± `u`."""
    listed = []
    for one in effect.parts:
        sizes = [
            f"{p.name}{where} {times * value / p.si_per_unit:.3g} ± {abs(u * value) / p.si_per_unit:.2g} {p.unit}"
            for p in one.effect.parameters
            if not p.is_shape and p.name in one.values
            for where, value in _sizes(p, one)
        ]
        shape = one.shapes_text()
        listed.append(f"{f'with {shape}: ' if shape else ''}{', '.join(sizes)}")
    return f"what {effect.of} may be besides, larger or smaller all at once: {'; '.join(listed)}"


def _sizes(parameter: Parameter, applied: AppliedEffect) -> Iterator[tuple[str, float]]:
    """Yield the values of a parameter in SI, each with its channel in words (" in x", or empty)."""
    value = applied.complete_values()[parameter.name]
    if parameter.per_channel:
        yield from ((f" in {c}", float(value[i])) for i, c in enumerate(CHANNELS) if c in applied.channels)
    else:
        yield "", float(value)


def _written_effect(applied: AppliedEffect) -> dict[str, Any]:
    parameters: dict[str, Any] = {}
    complete = applied.complete_values()
    for parameter in applied.effect.parameters:
        if parameter.name not in applied.values and not parameter.is_shape:
            continue
        value = complete[parameter.name]
        u = applied.u.get(parameter.name)
        if parameter.per_channel:
            parameters[parameter.name] = {
                channel: _written_value(parameter, value[i], None if u is None else u[i])
                for i, channel in enumerate(CHANNELS)
                if channel in applied.channels
            }
        else:
            parameters[parameter.name] = _written_value(parameter, value, u)
    written: dict[str, Any] = {"name": applied.effect.name, "channels": list(applied.channels)}
    if applied.installations:
        written["installations"] = list(applied.installations)
    if applied.either_of:
        written["either_of"] = list(applied.either_of)
    return written | {"parameters": parameters}


def _written_value(parameter: Parameter, value: Any, u: Any) -> str | dict[str, str]:
    def text(number: Any) -> str:
        unit = "" if parameter.unit == "1" else parameter.unit
        return f"{float(number) / parameter.si_per_unit!r} {unit}".strip()

    return text(value) if u is None else {"value": text(value), "u": text(u)}


UNNAMED: Final = "unnamed_"
"""Prefix of the name of an unnamed effect."""
WIDENED: Final = ("tau", "lag")
"""Shape parameters whose grid, in a named effect, is half the value found, this value and twice this value."""


def unnamed_in(effects: Sequence[AppliedEffect]) -> list[str]:
    """Return the names of those effects that are unnamed terms of a diagnosis (`unnamed_1`, …)."""
    return [applied.effect.name for applied in effects if applied.effect.name.startswith(UNNAMED)]


def accept(
    effects: Sequence[AppliedEffect], terms: Sequence[str], name: str, sentence: str
) -> tuple[FormulaEffect, tuple[AppliedEffect, ...]]:
    """Combine unnamed terms into one effect with a name and a sentence.

    `terms` names the unnamed terms; if it is empty, all are combined. Return the new effect, and the `effects` in
    which it replaces the terms. Raises `ValueError` for unknown terms, or terms that act at different places of the
    model.
    """
    known = unnamed_in(effects)
    if not known:
        raise ValueError(
            "has no unnamed term to name; give a model file of 'bench diagnose' that has one (unnamed_1, …)"
        )
    strange = [term for term in terms if term not in known]
    if strange:
        raise ValueError(f"there is no term {', '.join(strange)}; choose from {', '.join(known)}")
    chosen = [a for a in effects if a.effect.name in (terms or known)]
    formulas = [a.effect for a in chosen if isinstance(a.effect, FormulaEffect)]
    places = {(f.stage, f.adds_to) for f in formulas}
    if len(places) > 1:
        where = "; ".join(f"{f.name} at the {f.stage} {f.adds_to}".rstrip() for f in formulas)
        raise ValueError(f"these terms act at different places ({where}): name each separately with --term")
    whole = _joined(chosen, formulas, name, sentence)
    first = next(i for i, a in enumerate(effects) if a is chosen[0])
    kept = [a for a in effects if not any(a is one for one in chosen)]
    assert isinstance(whole.effect, FormulaEffect)  # noqa: S101 - made so
    return whole.effect, (*kept[:first], whole, *kept[first:])


def _joined(
    chosen: Sequence[AppliedEffect], formulas: Sequence[FormulaEffect], name: str, sentence: str
) -> AppliedEffect:
    parameters: dict[str, Parameter] = {}
    values: dict[str, Floats] = {}
    u: dict[str, Floats] = {}
    expressions = []
    for number, (applied, formula) in enumerate(zip(chosen, formulas, strict=True), start=1):
        renamed = _new_names(formula, parameters, number if len(chosen) > 1 else 0)
        expressions.append(_with_names(formula.expression, renamed))
        complete = applied.complete_values()
        # the phase of a wave is arbitrary: any of its sizes may become as large as the largest
        largest = max(float(np.max(np.abs(complete[p.name]))) for p in formula.parameters if not p.is_shape)
        for parameter in formula.parameters:
            new = renamed[parameter.name]
            parameters[new] = replace(_widened(parameter, largest), name=new)
            values[new] = complete[parameter.name]
            if parameter.name in applied.u:
                u[new] = applied.u[parameter.name]
    effect = replace(
        formulas[0],
        name=name,
        sentence=sentence,
        parameters=tuple(parameters.values()),
        expression=" + ".join(expressions),
    )
    channels = tuple(c for c in CHANNELS if any(c in a.channels for a in chosen))
    return AppliedEffect(effect, values, channels, u)


def _new_names(formula: FormulaEffect, taken: dict[str, Parameter], number: int) -> dict[str, str]:
    """Return the new names of a term's parameters: old name -> name with `number` appended.

    Equal shape parameters share a name; with `number` 0, names are unchanged.
    """
    names = {}
    for parameter in formula.parameters:
        same = taken.get(parameter.name)
        alike = parameter.is_shape and (same is None or same.default == parameter.default)
        names[parameter.name] = parameter.name if alike or not number else f"{parameter.name}{number}"
    return names


def _with_names(expression: str, names: dict[str, str]) -> str:
    words = re.compile(rf"(?P<quantity>{QUANTITY.pattern})|[A-Za-z_]\w*")
    return words.sub(lambda word: word[0] if word["quantity"] else names.get(word[0], word[0]), expression)


def _widened(parameter: Parameter, largest: float) -> Parameter:
    """Return a size parameter with a plausible size of at least `largest`, or a shape with a grid around its value.

    Shapes that are not in `WIDENED` are returned unchanged.
    """
    if parameter.is_shape:
        if parameter.name not in WIDENED:
            return parameter
        grid = tuple(parameter.default * times for times in (0.5, 1.0, 2.0))
        return replace(parameter, grid=grid, plausible=max(grid))
    return replace(parameter, plausible=max(parameter.plausible, largest))
