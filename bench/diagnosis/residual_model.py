"""Description of unnamed effects: terms with their sizes, their predictions, and unexplained scatter."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from typing import Final

import numpy as np
from scipy import special

from bench.config.model_file import UNNAMED
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.gap import Gap
from bench.diagnosis.levels import LISTED_IN_SENTENCE, MOSTLY, OFTEN
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.naming import Naming
from bench.diagnosis.noise_grid import Repeats
from bench.diagnosis.noise_kinds import LocalScatter, larger_scatter, residuals
from bench.diagnosis.posterior import NoiseSize, Posterior, applied_of, posterior
from bench.model.effects import AppliedEffect
from bench.model.effects.formula import FormulaEffect

UNNAMED_FORM: Final = "unnamed_form"
"""Entry in an effect's `cannot_tell_from` if an unnamed form describes the readings equally well."""


@dataclass(frozen=True)
class UnexplainedScatter:
    """Scatter about the model beyond that of repeats, 1 sigma, unit of the signal, with `u` and p-value.

    `upper` is its 95 % limit; it and `u` are infinite if all readings are repeats.
    """

    value: float
    u: float
    upper: float
    p: float

    @classmethod
    def of(cls, noise: NoiseSize, repeats: Repeats) -> UnexplainedScatter:
        """Return the noise about the model with all effects, in excess of the noise of repeats (F test)."""
        # per setting, two directions of the signals are perpendicular to du/dphi
        of_repeats = 2 * repeats.freedom
        beyond = noise.freedom - of_repeats
        all2, repeats2 = noise.reading**2, repeats.sigma**2
        value = float(np.sqrt(max(all2 - repeats2, 0.0)))
        if beyond <= 0:
            return cls(value, np.inf, np.inf, 1.0)
        lack = max(noise.freedom * all2 - of_repeats * repeats2, 0.0) / beyond / repeats2
        # a ratio below 1 is chance, and must not lower the limit
        largest = max(lack, 1.0) / float(special.fdtri(beyond, of_repeats, OFTEN))
        upper = float(np.sqrt(max(largest - 1.0, 0.0) * repeats2 * beyond / noise.freedom))
        # the excess is a part of the difference of two independent mean squares
        part = beyond / noise.freedom
        variance = 2 * (part * repeats2) ** 2 * (lack**2 / beyond + 1 / of_repeats)
        u = float(np.sqrt(variance)) / (2 * value) if value > 0.0 else float(np.sqrt(np.sqrt(variance)))
        return cls(value, u, max(upper, value), float(special.fdtrc(beyond, of_repeats, lack)))

    @property
    def there(self) -> bool:
        """Whether the scatter is significant."""
        return self.p < OFTEN


@dataclass(frozen=True)
class FormTerm:
    """A term of the dictionary that was found, with its sizes and their u.

    `could_also_be` are families that describe the readings as well. `rho` is the size of the term in units of the
    noise. `p` is the p-value of the term, not corrected for the number of terms tried.
    """

    applied: AppliedEffect
    family: str
    could_also_be: tuple[str, ...]
    rho: float
    p: float

    @property
    def effect(self) -> FormulaEffect:
        """The term as an effect that is defined by a formula."""
        assert isinstance(self.applied.effect, FormulaEffect)  # noqa: S101 - made so
        return self.applied.effect


@dataclass(frozen=True)
class FreeForm:
    """A description, by terms of the dictionary, of what the catalogue does not explain.

    `gap` is measured on held-out readings, with and without the terms. `dark` is the scatter in excess of the
    noise of repeats; `scatter` is the place where the scatter is largest, or None if it is the same everywhere.
    `instead_of` are named effects that explain the same readings: either they or the terms are present.
    """

    terms: tuple[FormTerm, ...]
    gap: Gap
    dark: UnexplainedScatter
    scatter: LocalScatter | None
    unit: str
    instead_of: tuple[str, ...] = ()

    @property
    def predicts(self) -> bool:
        """Whether the terms predict held-out readings well enough to belong in a model file."""
        return bool(self.terms) and self.gap.closed is not None and self.gap.closed >= MOSTLY

    @property
    def applied(self) -> tuple[AppliedEffect, ...]:
        """The terms with values, to be added to the model, if they predict and no name explains the same."""
        return tuple(term.applied for term in self.terms) if self.predicts and not self.instead_of else ()


def describe(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    noise: NoiseSize,
    gap: Gap,
    repeats: Repeats,
    instead_of: tuple[str, ...] = (),
) -> FreeForm:
    """Return the description of what the catalogue does not explain, from the terms among the finds.

    `noise` and `gap` are those of the model with all finds; `repeats` is the noise of repeats.
    """
    columns = candidates.columns[:, list(naming.columns)]
    scatter = larger_scatter(linear, residuals(linear, columns, noise))
    terms = tuple(_terms(linear, candidates, naming, posterior(linear, columns, noise)))
    dark = UnexplainedScatter.of(noise, repeats)
    return FreeForm(terms, gap, dark, scatter, linear.readings.unit, instead_of)


def _terms(
    linear: LinearSystem, candidates: Candidates, naming: Naming, fitted: Posterior
) -> Iterator[FormTerm]:
    taken = {applied.effect.name for applied in linear.model.effects}
    names = (name for name in map(f"{UNNAMED}{{}}".format, count(1)) if name not in taken)
    u = np.sqrt(np.diag(fitted.amplitude_covariance))
    for one, mine in naming.parts():
        variant = one.variant
        if variant.term is None:
            continue
        per_channel = candidates.kinds[variant.columns[0]].channel is not None
        effect = variant.term.effect(next(names), per_channel=per_channel)
        shape = tuple((p.name, p.default) for p in effect.parameters if p.is_shape)
        (applied,) = applied_of(
            candidates, variant._replace(shape=shape), fitted.amplitudes[mine], u[mine], effect=effect
        )
        rho, p = fitted.significance(mine)
        yield FormTerm(applied, variant.family, one.ties[:LISTED_IN_SENTENCE], rho, p)
