"""The form of what has no name, in words."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.analysis.diagnosis import Diagnosis
from bench.analysis.diagnosis.form.dark import Dark
from bench.analysis.diagnosis.form.describe import FormTerm
from bench.base.numbers import quantity, rounded, uncertainty
from bench.report.diagnosis.words import with_unit


def term_in_words(term: FormTerm) -> str:
    """Return a term as a line: "unnamed_1: A * (time > t), added at the block output; A of y = 70 ± 4 µg (u)"."""
    effect = term.effect
    added = f" to {effect.adds_to}" if effect.adds_to else ""
    sizes = [
        f"{name}{f' of {channel}' if channel else ''} = "
        f"{with_unit(f'{rounded(value, u)} ± {uncertainty(u)}', unit)} (u)"
        for name, channel, value, u, unit in term.sizes()
    ]
    constants = [
        f"{p.name} = {with_unit(format(p.default / p.si_per_unit, 'g'), p.unit)}"
        for p in effect.parameters
        if p.is_shape
    ]
    where = f"added{added} at the {effect.stage.value}"
    return f"{effect.name}: {effect.expression}, {where}; {', '.join([*sizes, *constants])}"


def form_in_words(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield the lines that describe what has no name; nothing where there is nothing to say of it."""
    form = diagnosis.form
    if form is None:
        return
    if not form.terms and any(not effect.in_catalogue for effect in diagnosis.effects):
        yield "no term of the dictionary describes it"
    if form.instead_of and form.terms:
        yield f"as plausible without a name, in the place of {', '.join(dict.fromkeys(form.instead_of))}:"
    elif form.instead_of:
        yield "what is left beside the names speaks for something without a name that is too small to describe"
    for term in form.terms:
        yield term_in_words(term)
        also = f"; could also be: {'; '.join(term.could_also_be)}" if term.could_also_be else ""
        yield f"that is {term.family}, {term.rho:.1f} times the noise in all (rho){also}"
    if form.terms and form.counted:
        closed = "" if form.closed is None else f", which closes {100 * form.closed:.0f} % of the gap"
        yield (
            f"on readings not used: reduced chi-square {form.before:.2f} before, {form.after:.2f} with the terms "
            f"found without them{closed}"
        )
    if form.terms and not form.predicts:
        yield "that is too little for a model file: the terms describe these readings and predict no others"
    if form.scatter is not None:
        one = form.scatter
        sizes = f"{quantity(one.sd, form.unit)} there, {quantity(one.elsewhere, form.unit)} elsewhere"
        yield f"scatter without a form: {one.words}, {sizes}"
    if form.terms or form.scatter is not None:
        yield _dark_in_words(form.dark, form.unit)


def _dark_in_words(dark: Dark, unit: str) -> str:
    if not np.isfinite(dark.upper):
        return "what stays unexplained cannot be told: there are no readings beside the repeats"
    limit = f"less than {quantity(dark.upper, unit)} (95 %)"
    if not dark.there:
        return (
            f"what stays unexplained in each reading is no more than chance gives (p = {dark.p:.2g}): {limit}"
        )
    sizes = f"{quantity(dark.value, unit)} in each reading, u {quantity(dark.u, unit)}, {limit}"
    return f"what stays unexplained: {sizes} (dark uncertainty)"
