"""The catalogue of effects: every effect that the model knows, by name."""

from importlib import import_module
from typing import Final

from bench.model.effects.base import AppliedEffect, Effect, Parameter, Seen, Stage, Subsystem, Values
from bench.model.effects.catalogue import Catalogue, effects_of
from bench.model.effects.expression import ExpressionError
from bench.model.effects.formula import FormulaEffect

MODULES: Final = (
    "nonlinear", "hysteresis", "thermal", "supply", "stand", "head", "stand_motion", "slips", "voltmeter",
)  # fmt: skip
"""The modules of this folder that have effects, in the order of the catalogue."""

CATALOGUE: Final = Catalogue(
    effect for module in MODULES for effect in effects_of(import_module(f"{__name__}.{module}"))
)

__all__ = [
    "CATALOGUE",
    "AppliedEffect",
    "Catalogue",
    "Effect",
    "ExpressionError",
    "FormulaEffect",
    "Parameter",
    "Seen",
    "Stage",
    "Subsystem",
    "Values",
]
