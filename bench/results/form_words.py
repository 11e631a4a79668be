"""Lines on the terms that describe an unnamed effect, shared by page and terminal."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.base.languages import message
from bench.base.numbers import quantity
from bench.diagnosis.pipeline import values_of
from bench.diagnosis.result import Diagnosis, FormTerm, UnexplainedScatter
from bench.results.diagnosis_words import parameter_in_words, with_unit


def term_in_words(term: FormTerm) -> str:
    """Return a line such as "unnamed_1: A * (time > t), added at the block output; A of y = 70 ± 4 µg (u)"."""
    effect = term.effect
    sizes = [parameter_in_words(size) for size in values_of((term.applied,)) if size.u is not None]
    constants = [
        f"{p.name} = {with_unit(format(p.default / p.si_per_unit, 'g'), p.unit)}"
        for p in effect.parameters
        if p.is_shape
    ]
    formula, listed = f"{effect.name}: {effect.expression}", ", ".join([*sizes, *constants])
    if not effect.adds_to:
        return message(f"{formula}, added at the {effect.stage.value}; {listed}")
    return message(f"{formula}, added to {effect.adds_to} at the {effect.stage.value}; {listed}")


def form_in_words(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield lines on the terms that describe an unnamed effect; none if terms were not searched for."""
    form = diagnosis.form
    if form is None:
        return
    if not form.terms and any(not effect.in_catalogue for effect in diagnosis.effects):
        yield message("no formula of the dictionary describes it")
    if form.instead_of and form.terms:
        yield message(f"as plausible as {', '.join(dict.fromkeys(form.instead_of))}, but without a name:")
    elif form.instead_of:
        yield message("the remaining residuals suggest an effect without a name; it is too small to describe")
    for term in form.terms:
        yield term_in_words(term)
        also = "; ".join(term.could_also_be)
        if also:
            yield message(f"that is {term.family}; ρ = {term.rho:.1f}; other forms that fit: {also}")
        else:
            yield message(f"that is {term.family}; ρ = {term.rho:.1f}")
    if form.terms and form.gap.folds:
        closed = (
            ""
            if form.gap.closed is None
            else message(f", which closes {100 * form.gap.closed:.0f} % of the gap")
        )
        yield message(
            f"held-out readings: reduced chi-square {form.gap.before:.2f} before, {form.gap.after:.2f} with "
            f"the terms that the other readings show{closed}"
        )
    if form.terms and not form.predicts:
        yield message(
            "too little for a model file: the terms describe these readings but do not predict others"
        )
    if form.scatter is not None:
        one = form.scatter
        sizes = message(
            f"{quantity(one.sd, form.unit)} there, {quantity(one.elsewhere, form.unit)} elsewhere"
        )
        yield message(f"scatter without a form: {one.words}, {sizes}")
    if form.terms or form.scatter is not None:
        yield _dark_in_words(form.dark, form.unit)


def _dark_in_words(dark: UnexplainedScatter, unit: str) -> str:
    if not np.isfinite(dark.upper):
        return message("the unexplained scatter cannot be determined: all readings are repeats")
    limit = message(f"less than {quantity(dark.upper, unit)} (95 %)")
    if not dark.there:
        return message(
            f"the unexplained scatter of each reading is no larger than chance (p = {dark.p:.2g}): {limit}"
        )
    sizes = message(f"{quantity(dark.value, unit)} in each reading, u {quantity(dark.u, unit)}, {limit}")
    return message(f"unexplained scatter (dark uncertainty): {sizes}")
