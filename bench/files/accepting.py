"""Terms without a name that a person gives one: from then on they are an effect like any other."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.model import AppliedEffect, Parameter
from bench.model.effects import FormulaEffect

UNNAMED: Final = "unnamed_"
WIDENED: Final = ("tau", "lag")
"""Shapes of which an effect with a name has more values to be tried: half and twice as much."""


@dataclass(frozen=True)
class Accepted:
    """The effect with its name, and the effects of the model with it in place of the terms."""

    effect: FormulaEffect
    effects: tuple[AppliedEffect, ...]


def unnamed_in(effects: Sequence[AppliedEffect]) -> list[str]:
    """Return the names of the terms among effects that have none yet."""
    return [applied.effect.name for applied in effects if applied.effect.name.startswith(UNNAMED)]


def accept(effects: Sequence[AppliedEffect], terms: Sequence[str], name: str, sentence: str) -> Accepted:
    """Give terms a name and a sentence, as one effect. Raises `ValueError` with what speaks against it."""
    known = unnamed_in(effects)
    if not known:
        raise ValueError("no term without a name is in this model file; 'bench diagnose' writes them")
    strange = [term for term in terms if term not in known]
    if strange:
        raise ValueError(f"there is no term {', '.join(strange)}; there are {', '.join(known)}")
    chosen = [a for a in effects if a.effect.name in (terms or known)]
    formulas = [a.effect for a in chosen if isinstance(a.effect, FormulaEffect)]
    places = {(f.stage, f.adds_to) for f in formulas}
    if len(places) > 1:
        where = "; ".join(f"{f.name} at the {f.stage} {f.adds_to}".rstrip() for f in formulas)
        raise ValueError(
            f"these terms act at different places ({where}): give each a name of its own with --term"
        )
    whole = _joined(chosen, formulas, name, sentence)
    first = next(i for i, a in enumerate(effects) if a is chosen[0])
    kept = [a for a in effects if not any(a is one for one in chosen)]
    before = sum(1 for a in effects[:first] if not any(a is one for one in chosen))
    assert isinstance(whole.effect, FormulaEffect)  # noqa: S101 - made so
    return Accepted(whole.effect, (*kept[:before], whole, *kept[before:]))


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
        # the phase of a wave is nobody's to expect: all sizes of a term are as large as its largest
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
    """Return the new name of each parameter: numbered where several terms are joined, but for equal shapes."""
    names = {}
    for parameter in formula.parameters:
        same = taken.get(parameter.name)
        alike = parameter.is_shape and (same is None or same.default == parameter.default)
        names[parameter.name] = parameter.name if alike or not number else f"{parameter.name}{number}"
    return names


def _with_names(expression: str, names: dict[str, str]) -> str:
    return re.sub(r"[A-Za-z_]\w*", lambda word: names.get(word[0], word[0]), expression)


def _widened(parameter: Parameter, largest: float) -> Parameter:
    """Return the parameter with what is plausible of it now: as large as it was found, a shape about as long."""
    if parameter.is_shape:
        if parameter.name not in WIDENED:
            return parameter
        grid = tuple(parameter.default * times for times in (0.5, 1.0, 2.0))
        return replace(parameter, grid=grid, plausible=max(grid))
    return replace(parameter, plausible=max(parameter.plausible, largest))
