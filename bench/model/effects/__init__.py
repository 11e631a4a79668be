"""The catalogue of effects: every effect that the model knows, by name."""

from importlib import import_module
from typing import Final

from bench.model.effects.base import AppliedEffect, Effect, Parameter, Seen, Stage, Subsystem, Values

MODULES: Final = (
    "nonlinear", "hysteresis", "thermal", "stand", "head", "stand_motion", "slips", "voltmeter",
)  # fmt: skip
"""The modules of this folder that have effects, in the order of the catalogue."""


def _effects_of(module: str) -> list[Effect]:
    """Return one of each effect that a module defines, in its order: the classes in it that have a name."""
    found = vars(import_module(f"{__name__}.{module}")).values()
    kinds = [kind for kind in found if isinstance(kind, type) and issubclass(kind, Effect)]
    return [kind() for kind in kinds if kind.__module__.endswith(f".{module}") and "name" in vars(kind)]


CATALOGUE: Final[dict[str, Effect]] = {
    effect.name: effect for module in MODULES for effect in _effects_of(module)
}

__all__ = ["CATALOGUE", "AppliedEffect", "Effect", "Parameter", "Seen", "Stage", "Subsystem", "Values"]
