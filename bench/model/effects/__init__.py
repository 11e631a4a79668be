"""The catalogue of effects: the bench's own, those of installed distributions, and those of the user.

A distribution adds effects by the entry-point group `triaxial_bench.effects`; each entry is an `Effect`, a
subclass of it, or a module with subclasses. The user's own effects are formulas from a file; they are known
within the context of `Catalogue.also`.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property
from importlib import import_module
from inspect import isabstract
from types import ModuleType
from typing import Final

from bench.model.effects.base import AppliedEffect, Effect, Parameter, Seen, Stage, Subsystem, Values
from bench.model.effects.formula import ExpressionError, FormulaEffect, names_in

__all__ = [
    "CATALOGUE",
    "TEMPERATURE_EFFECTS",
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
    "with_temperature",
]

MODULES: Final = ("block", "stand", "voltmeter")
"""The modules of this folder that define effects, in the order of the catalogue."""

TEMPERATURE_EFFECTS: Final = ("thermal_bias", "thermal_scale", "thermal_settling", "thermal_emf")
"""Effects of temperature; without them, a fit absorbs the influence of temperature in the coefficients."""

AT_REFERENCE: Final = ("thermal_bias", "thermal_scale", "thermal_nonlinearity", "thermal_misalignment")
"""Effects of the block's temperature minus the reference; with one of them, coefficients hold at the reference."""

GROUP: Final = "triaxial_bench.effects"

_OWN: ContextVar[tuple[Effect, ...]] = ContextVar("effects_of_the_user", default=())


def with_temperature(effects: Iterable[Effect]) -> tuple[list[str], bool]:
    """Return the names of the effects of temperature, and whether coefficients then hold at the reference."""
    given = list(effects)
    formulas = [e for e in given if isinstance(e, FormulaEffect) and e.subsystem is Subsystem.BLOCK]
    at_reference = {*AT_REFERENCE, *(e.name for e in formulas if "temperature" in names_in(e.expression))}
    names = [e.name for e in given if e.name in at_reference or e.name in TEMPERATURE_EFFECTS]
    return names, not at_reference.isdisjoint(names)


def effects_of(module: ModuleType) -> list[Effect]:
    """Return an instance of each effect class with a `name` that a module defines, in order of definition."""
    found = vars(module).values()
    kinds = [kind for kind in found if isinstance(kind, type) and issubclass(kind, Effect)]
    return [kind() for kind in kinds if kind.__module__ == module.__name__ and "name" in vars(kind)]


class Catalogue(Mapping[str, Effect]):
    """Effects by name: first the bench's own, then those of installed distributions, then the user's."""

    def __init__(self, shipped: Iterable[Effect]) -> None:
        self._shipped = {effect.name: effect for effect in shipped}
        self.troubles: list[str] = []
        """One sentence for each installed effect that could not be loaded; filled at the first look-up."""

    @cached_property
    def _known(self) -> dict[str, Effect]:
        known = dict(self._shipped)
        for place, effect in self._installed():
            if effect.name in known:
                self.troubles.append(
                    f"{place} brings an effect '{effect.name}', which exists already; rename it"
                )
            else:
                known[effect.name] = effect
        return known

    @property
    def own(self) -> tuple[Effect, ...]:
        """The user's effects that `also` has added in this context."""
        return _OWN.get()

    @contextmanager
    def also(self, effects: Iterable[Effect]) -> Iterator[None]:
        """Add the user's own effects within this context; an effect given twice counts once.

        Raises `ValueError` if two different effects share a name, or a name belongs to an effect of the bench.
        """
        own = {effect.name: effect for effect in self.own}
        for effect in effects:
            if effect.name in self._known:
                raise ValueError(f"the bench already has an effect '{effect.name}'; rename yours")
            if own.setdefault(effect.name, effect) != effect:
                raise ValueError(
                    f"two formulas of the name '{effect.name}' differ; rename one, or leave it out"
                )
        token = _OWN.set(tuple(own.values()))
        try:
            yield
        finally:
            _OWN.reset(token)

    def __getitem__(self, name: str) -> Effect:
        known = self._known
        if name in known:
            return known[name]
        for effect in _OWN.get():
            if effect.name == name:
                return effect
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        return name in self._known or any(effect.name == name for effect in _OWN.get())

    def __iter__(self) -> Iterator[str]:
        yield from self._known
        yield from (effect.name for effect in _OWN.get())

    def __len__(self) -> int:
        return len(self._known) + len(_OWN.get())

    def _installed(self) -> Iterator[tuple[str, Effect]]:
        """Yield the effects of installed distributions as (description of the origin, effect)."""
        for entry in importlib.metadata.entry_points(group=GROUP):
            dist = entry.dist
            place = (
                f"the distribution {dist.name} {dist.version}" if dist else f"the entry point {entry.name}"
            )
            try:
                loaded = entry.load()
                effects = _effects_in(loaded)
            except (Exception, SystemExit) as error:
                self.troubles.append(f"{place} cannot be loaded ({type(error).__name__}: {error})")
                continue
            if not effects:
                self.troubles.append(f"{place}: {entry.value} is not an effect and contains none")
            yield from ((place, effect) for effect in effects)


def _effects_in(loaded: object) -> list[Effect]:
    """Return the effects of a loaded entry point: an effect, an effect class, or a module with effect classes."""
    if isinstance(loaded, Effect):
        return [loaded]
    if isinstance(loaded, ModuleType):
        return effects_of(loaded)
    if isinstance(loaded, type) and issubclass(loaded, Effect) and not isabstract(loaded):
        return [loaded()]
    return []


CATALOGUE: Final = Catalogue(
    effect for module in MODULES for effect in effects_of(import_module(f"{__name__}.{module}"))
)
