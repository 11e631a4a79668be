"""Effects that a user defines by a formula: stage, parameters, expression, units."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field

from bench.base.units import Dimension, number_and_unit, unit_of
from bench.base.yaml_files import FileMistake, FileMistakes, FileModel, Place, load_document, part, validated
from bench.model.effects import CATALOGUE, Effect, Parameter, Stage, Subsystem
from bench.model.effects.formula import (
    LAGGED,
    SUBSYSTEM_OF,
    ExpressionError,
    FormulaEffect,
    interpret,
    known_functions,
    names_in,
    variables_of,
)

_OF_VARIABLE: Final[Mapping[str, str]] = {
    "time": "s", "since_start": "s", "since_mounting": "s", "since_power_on": "s",
    "temperature": "K", "U": "V", "Ux": "V", "Uy": "V", "Uz": "V",
}  # fmt: skip
"""The units of the formula variables; those not listed are plain numbers."""

Known = dict[str, Dimension]


def dimension_mistake(effect: FormulaEffect) -> str | None:
    """Return a sentence if the formula's units contradict each other or its stage; None if they fit."""
    known: Known = {name: unit_of(_OF_VARIABLE.get(name, ""))[1] for name in variables_of(effect.stage)}
    known |= {p.name: unit_of("" if p.unit == "1" else p.unit)[1] for p in effect.parameters}
    wanted = unit_of("V" if effect.stage is Stage.VOLTMETER_READING else "")[1]
    try:
        got = interpret(effect.expression, _DimensionReading(known))
    except ExpressionError as error:
        return str(error)
    if got[1] == wanted:
        return None
    return f"the expression gives {_told(got[1])}, and {_told(wanted)} is added at the stage '{effect.stage}'"


class _DimensionReading:
    """An interpreter that computes the dimension of a formula: each of its values is a pair (number, dimension).

    The number is that of a literal without a unit or of a product of such literals, else None.
    """

    def __init__(self, known: Known) -> None:
        self._known = known

    def number(self, value: float, unit: str) -> tuple[float | None, Dimension]:
        return (None if unit else value), unit_of(unit)[1]

    def name(self, name: str) -> tuple[float | None, Dimension]:
        return None, self._known[name]

    def operation(
        self, symbol: str, left: tuple[float | None, Dimension], right: tuple[float | None, Dimension]
    ) -> tuple[float | None, Dimension]:
        of_left, of_right = left[1], right[1]
        if symbol == "*":
            both = None if left[0] is None or right[0] is None else left[0] * right[0]
            return both, _product(of_left, of_right, 1.0)
        if symbol == "/":
            return None, _product(of_left, of_right, -1.0)
        if symbol == "**":
            return None, self._power(of_left, right)
        if of_left != of_right and not (left[0] == 0.0 or right[0] == 0.0):
            raise ExpressionError(
                f"'{symbol}' combines {_told(of_left)} with {_told(of_right)}{_how(left, right)}"
            )
        if symbol in {"+", "-"}:
            return None, of_left or of_right
        return None, ()

    def _power(self, base: Dimension, exponent: tuple[float | None, Dimension]) -> Dimension:
        if exponent[1]:
            raise ExpressionError(
                f"an exponent must be a plain number; this one is in {_told(exponent[1])}: divide it by a unit"
            )
        if not base:
            return ()
        if exponent[0] is None:
            raise ExpressionError(f"{_told(base)} is raised to a power; write the exponent as a number")
        return _product((), base, exponent[0])

    def call(
        self, name: str, arguments: list[tuple[float | None, Dimension]]
    ) -> tuple[float | None, Dimension]:
        of_first = arguments[0][1]
        match name:
            case "abs":
                return None, of_first
            case "sqrt":
                return None, _product((), of_first, 0.5)
            case "sign":
                return None, ()
            case "min" | "max":
                return self.operation("+", arguments[0], arguments[1])
            case _ if name == LAGGED:
                if arguments[1][1] != unit_of("s")[1] and arguments[1][0] is None:
                    raise ExpressionError("the second argument of 'lagged' is not a time; state a time")
                return None, of_first
        if of_first:
            raise ExpressionError(f"{name} needs a plain number or an angle, not {_told(of_first)}")
        return None, ()


def _how(left: tuple[float | None, Dimension], right: tuple[float | None, Dimension]) -> str:
    """Return advice on operands of different units, such as to add a unit to a plain number."""
    for (number, own), (_, other) in ((left, right), (right, left)):
        if number is not None and not own and [power for _, power in other] == [1.0]:
            return f"; write the number with its unit, such as '{abs(number):g} {_told(other)}'"
    return "; give both the same unit"


def _product(left: Dimension, right: Dimension, power: float) -> Dimension:
    total = dict(left)
    for name, exponent in right:
        total[name] = total.get(name, 0.0) + power * exponent
    return tuple(sorted((name, exponent) for name, exponent in total.items() if exponent))


def _told(dimension: Dimension) -> str:
    parts = [name if exponent == 1 else f"{name}^{exponent:g}" for name, exponent in dimension]
    return "*".join(parts) or "a plain number or an angle"


FORMAT: Final = "1"
ENVIRONMENT: Final = "BENCH_EFFECTS"
"""The environment variable that lists effects files, joined by the system's path separator."""

StandAngle = Literal["axis_tilt", "zero_offset", "mounting_error", "mounting_offset", "mounting_roll"]


def _word(text: str) -> str:
    if re.fullmatch(r"[a-z][a-z0-9_]{0,63}", text) is None:
        raise ValueError(f"expected up to 64 small letters, digits and _, a letter first, got '{text}'")
    return text


def _symbol(text: str) -> str:
    if re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,31}", text) is None:
        raise ValueError(f"expected a name of up to 32 letters, digits and _, a letter first, got '{text}'")
    return text


class FormulaParameter(FileModel):
    """A parameter of a formula: an amplitude with a `plausible` value (1 σ), or a shape with a `grid`.

    Readings are linear in an amplitude, but not in a shape, such as a time constant or a width. A diagnosis tries
    each shape value of the grid; a fit holds the shape at the stated value, or else at `default`. An amplitude may
    have a value for each channel.
    """

    plausible: str | None = None
    grid: tuple[str, ...] = ()
    default: str | None = None
    per_channel: bool | None = None


class FormulaEntry(FileModel):
    """An effect that a user defines.

    `expression` is the quantity that the effect adds at its `stage`. Its unit is rad for the stand and the
    head, g for the specific force and the block's output (before the scale factor), V for the voltmeter. At
    the stage of the stand, `adds_to` names the angle that changes. With `per_mount`, the effect may act in
    single mountings; with `lasts`, it acts from such a mounting to the end of the run.
    """

    name: Annotated[str, AfterValidator(_word)]
    sentence: str
    stage: Stage
    adds_to: StandAngle | None = None
    expression: str
    parameters: dict[Annotated[str, AfterValidator(_symbol)], FormulaParameter] = Field(min_length=1)
    shown_by: str | None = None
    subsystem: Subsystem | None = None
    per_mount: bool = False
    lasts: bool = False

    def effect(self) -> FormulaEffect:
        """Return the effect. Raises `ValueError` if parts of the entry contradict each other."""
        taken = set(variables_of(self.stage)).union(known_functions()).intersection(self.parameters)
        if taken:
            raise ValueError(f"'{min(taken)}' is reserved in formulas; rename the parameter")
        parameters = tuple(_parameter(name, stated, self.stage) for name, stated in self.parameters.items())
        made = FormulaEffect(
            name=self.name,
            stage=self.stage,
            subsystem=self.subsystem or SUBSYSTEM_OF[self.stage],
            parameters=parameters,
            sentence=self.sentence,
            shown_by=self.shown_by or _shown_by(self),
            expression=self.expression,
            adds_to=self.adds_to or "",
            per_mount=self.per_mount or self.lasts,
            lasts=self.lasts,
        )
        problem = dimension_mistake(made)
        if problem:
            raise ExpressionError(problem)
        return made


class EffectsFile(FileModel):
    """A file of effects that a user defines."""

    effects_file: Literal["1"]
    formulas: tuple[FormulaEntry, ...] = Field(min_length=1)

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield the mistakes in the formulas."""
        return formula_mistakes(part(data, "formulas"), ("formulas",))


def formula_mistakes(entries: Any, place: Place) -> Iterator[tuple[Place, str]]:
    """Yield place and text of each contradiction within a formula, and of each name that is already used."""
    seen: dict[str, int] = {}
    for index, entry in _readable(entries):
        here = (*place, index)
        try:
            effect = entry.effect()
        except ExpressionError as error:
            yield (*here, "expression"), str(error)
            continue
        except ValueError as error:
            yield (*here, "parameters"), str(error)
            continue
        if effect.name in seen:
            yield (*here, "name"), f"rename one of two formulas named {effect.name}"
        seen.setdefault(effect.name, index)
        try:
            with CATALOGUE.also([effect]):
                pass
        except ValueError as error:
            yield (*here, "name"), str(error)


def _readable(entries: Any) -> Iterator[tuple[int, FormulaEntry]]:
    for index, written in enumerate(entries if isinstance(entries, list) else []):
        try:
            yield index, FormulaEntry.model_validate(written)
        except ValueError:  # reported when the file is validated
            continue


def effects_as_written(entries: Any) -> tuple[Effect, ...]:
    """Return the effects that a list of written formulas defines; invalid formulas are skipped."""
    effects: list[Effect] = []
    for _, entry in _readable(entries):
        try:
            effects.append(entry.effect())
        except ValueError:
            continue
    return tuple(effects)


def load_effects(path: Path) -> tuple[Effect, ...]:
    """Read the effects from a file. Raises `FileMistakes` with every mistake in the file."""
    document = load_document(path)
    return tuple(
        replace(entry.effect(), origin=f"{path}, line {document.line_of(('formulas', index, 'expression'))}")
        for index, entry in enumerate(validated(document, EffectsFile).formulas)
    )


def effects_in(paths: Iterable[Path | str]) -> tuple[Effect, ...]:
    """Return the effects of several files. Raises `FileMistakes`, also for two different effects of one name."""
    effects: dict[str, tuple[Effect, Path]] = {}
    for path in map(Path, paths):
        for effect in load_effects(path):
            first, other = effects.setdefault(effect.name, (effect, path))
            if first != effect:
                text = f"{other} has a different formula named {effect.name}; give one of them another name"
                raise FileMistakes(path, [FileMistake(0, "formulas", text)])
    return tuple(effect for effect, _ in effects.values())


def files_of_environment() -> list[str]:
    """Return the effects files that the environment variable `BENCH_EFFECTS` lists."""
    return [file for file in os.environ.get(ENVIRONMENT, "").split(os.pathsep) if file]


def _shown_by(entry: FormulaEntry) -> str:
    variables = [name for name in names_in(entry.expression) if name not in entry.parameters and name != "pi"]
    return (
        f"a run over which more changes of: {', '.join(variables)}" if variables else "a return to the start"
    )


# --- parameters -------------------------------------------------------------------------------------


def _parameter(name: str, stated: FormulaParameter, stage: Stage) -> Parameter:
    if stated.grid and stated.plausible is not None:
        raise ValueError(f"{name}: state 'plausible' (for a size) or 'grid' (for a shape), not both")
    if stated.grid:
        return _shape(name, stated)
    if stated.plausible is None:
        raise ValueError(
            f"{name}: give its plausible size, such as plausible: 20 arcsec, or a grid of values"
        )
    if stated.default is not None:
        raise ValueError(f"{name}: 'default' needs a 'grid'; remove it or add one")
    number, unit = _number(name, stated.plausible)
    channels = stage not in {Stage.STAND, Stage.HEAD_ANGLE}
    if stated.per_channel and not channels:
        raise ValueError(
            f"{name}: an effect of the stage '{stage}' is common to all channels; remove 'per_channel'"
        )
    if number <= 0.0:
        raise ValueError(f"{name}: state a plausible size above 0, not '{stated.plausible}'")
    of_each = stage is Stage.BLOCK_OUTPUT if stated.per_channel is None else stated.per_channel
    si = unit_of(unit)[0]
    return Parameter(name, unit or "1", si, number * si, per_channel=of_each)


def _shape(name: str, stated: FormulaParameter) -> Parameter:
    if stated.per_channel:
        raise ValueError(f"{name}: a shape has one value for all channels; remove 'per_channel'")
    numbers = [_number(name, text) for text in stated.grid]
    units = [unit_of(unit) for _, unit in numbers]
    if len({dimension for _, dimension in units}) > 1:
        raise ValueError(f"{name}: state all values of the grid in units of one kind")
    grid = tuple(number * si for (number, _), (si, _) in zip(numbers, units, strict=True))
    if min(grid) < 0.0:
        raise ValueError(f"{name}: a shape in the grid is negative; state shapes of 0 or more")
    default = grid[len(grid) // 2]
    if stated.default is not None:
        number, unit = _number(name, stated.default)
        default = number * unit_of(unit)[0]
    if default not in grid:
        raise ValueError(f"{name}: the default is not in the grid; add it there")
    unit, si = numbers[0][1], units[0][0]
    return Parameter(name, unit or "1", si, max(grid), per_channel=False, grid=grid, default=default)


def _number(name: str, text: str) -> tuple[float, str]:
    read = number_and_unit(text)
    if read is None:
        raise ValueError(f"{name}: expected a number with its unit, such as '20 arcsec', got '{text}'")
    try:
        unit_of(read[1])
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    return read


# --- writing ----------------------------------------------------------------------------------------


def written_formulas(effects: Iterable[Effect]) -> list[dict[str, Any]]:
    """Return file entries for those effects that are formulas, each formula once."""
    formulas = {effect.name: effect for effect in effects if isinstance(effect, FormulaEffect)}
    return [_written(effect) for effect in formulas.values()]


def effects_text(effects: Sequence[Effect]) -> dict[str, Any]:
    """Return the content of an effects file with those of `effects` that are formulas, each formula once."""
    return {"effects_file": int(FORMAT), "formulas": written_formulas(effects)}


def _written(effect: FormulaEffect) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": effect.name, "sentence": effect.sentence, "shown_by": effect.shown_by}
    entry |= {"stage": effect.stage.value, "subsystem": effect.subsystem.value}
    if effect.adds_to:
        entry["adds_to"] = effect.adds_to
    entry |= {key: True for key in ("per_mount", "lasts") if getattr(effect, key)}
    parameters = {parameter.name: _written_parameter(parameter) for parameter in effect.parameters}
    return entry | {"expression": effect.expression, "parameters": parameters}


def _written_parameter(parameter: Parameter) -> Mapping[str, Any]:
    unit = "" if parameter.unit == "1" else parameter.unit

    def text(si: float) -> str:
        return f"{_exact(si, parameter.si_per_unit)!r} {unit}".strip()

    if parameter.is_shape:
        return {"grid": [text(value) for value in parameter.grid], "default": text(parameter.default)}
    return {"plausible": text(parameter.plausible), "per_channel": parameter.per_channel}


def _exact(si: float, unit: float) -> float:
    """Return `si` divided by the size `unit`, with the fewest digits that convert back to exactly `si`."""
    plain = si / unit
    near = (float(f"{plain:.{digits}g}") for digits in range(1, 18))
    return next((number for number in near if number * unit == si), plain)
