"""The page of a diagnosis: one HTML file that needs nothing but itself, and tells what was found in order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from markupsafe import Markup

from bench.base.numbers import aligned, concise, fixed, quantity, rounded, scale_for, two_digits, typeset
from bench.diagnosis import Diagnosis, NamedEffect
from bench.diagnosis.full import FullDiagnosis
from bench.diagnosis.gap import UNDETERMINED, Gap
from bench.diagnosis.show import SEED, Shown
from bench.diagnosis.where import Place
from bench.model import CATALOGUE, Effect
from bench.results.diagnosis import plots, words
from bench.results.diagnosis.plots import most_telling, overlay_of_mount
from bench.results.diagnosis.words import form_in_words
from bench.results.plots import mounts_of
from bench.results.tables import Row, symbol
from bench.results.template import page

DRAWN: Final = 4
"""Mountings of which the residuals are drawn in full view; those beyond are folded away."""

MOST_DRAWN: Final = 12
"""Of no more mountings than this all are drawn; of more, as many runs have, those in full view alone."""

STATES: Final = {"agrees": "passed", "named": "none", "confounded": "none"}
"""Colour of the verdict; of the others it is that of a failure."""


def render_diagnosis(full: FullDiagnosis, title: str, limit_g: float, provenance: Mapping[str, str]) -> str:
    """Return the page; the same content gives the same text. `limit_g` is that of the verification points."""
    diagnosis, shown = full.diagnosis, full.shown
    return page(
        "diagnosis.html.j2",
        title=title,
        full=full,
        diagnosis=diagnosis,
        shown=shown,
        provenance=provenance,
        seed=SEED,
        state=STATES.get(diagnosis.verdict, "failed"),
        words=words,
        quantity=quantity,
        verdict=words.what_in_words(diagnosis),
        gap=words.gap_of_verdict(diagnosis),
        to_do=list(words.what_to_do(full)),
        overlays=_overlays(shown),
        places=[_place(place) for place in diagnosis.where],
        effects=[(e, full.rivals_of(i), _ranking(full, i, e)) for i, e in enumerate(diagnosis.effects)],
        form=list(form_in_words(diagnosis)),
        held_out=_held_out(diagnosis.gap),
        gap_bars=_drawn(plots.gap_bars(diagnosis.gap)) if diagnosis.effects and diagnosis.gap.folds else None,
        coefficients=_coefficients(shown),
        blocks=[
            (number, words.mountings_of(one), words.p_in_column(one.last.test.p, 2), _coefficients(one))
            for number, one in enumerate(full.blocks, start=1)
        ],
        tests=_tests(shown),
        joined=list(words.joined_in_words(shown)),
        less_certain=words.less_certain(shown.coefficients) if shown.after else [],
        residuals=_residuals(shown),
        in_time=_drawn(plots.residuals_in_time(shown)),
        modulus=_drawn(plots.modulus(shown, limit_g)) if shown.before.points else None,
        apart=_apart(diagnosis),
        hidden=[CATALOGUE[name] for name in diagnosis.hidden],
        smallest=[
            Row(name, (size.replace(" ", "\N{NO-BREAK SPACE}"), CATALOGUE[name].sentence))
            for name, size in words.smallest_found(diagnosis)
        ],
        setting=f"{two_digits(diagnosis.noise.setting_arcsec)}″",
    )


def _drawn(svg: str) -> Markup:
    return Markup(svg)  # noqa: S704 - our own drawing


def _place(place: Place) -> Row:
    where = "verification points" if place.channel == "modulus" else place.channel
    installation = "whole run" if place.installation == "all" else place.installation
    size = quantity(place.size, place.unit)
    return Row(where, (installation, place.pattern, size, typeset(words.p_in_column(place.p))))


def _ranking(full: FullDiagnosis, number: int, effect: NamedEffect) -> Markup | None:
    rivals = full.rivals_of(number)
    return _drawn(plots.ranking(rivals, effect.name, number)) if rivals else None


def _held_out(gap: Gap) -> list[Row]:
    return [
        Row(
            fold.label,
            (
                ", ".join(fold.gains) or "nothing",
                f"{fold.before.reduced:.2f}",
                f"{fold.after.reduced:.2f}",
                "yes" if fold.counted else f"no: {fold.blind}",
            ),
        )
        for fold in gap.folds
    ] + [Row(label, ("", "", "", f"no: {UNDETERMINED}")) for label in gap.undetermined]


def _coefficients(shown: Shown) -> list[Row]:
    changes, unit = shown.coefficients, shown.before.calibration.unit
    before = aligned([concise(one.before, one.u_before) for one in changes.values()])
    after = aligned([concise(one.after, one.u_after) for one in changes.values()])
    scale = scale_for(max(abs(one.after - one.before) for one in changes.values()), unit)
    rows = []
    for (name, one), was, now in zip(changes.items(), before, after, strict=True):
        change, u = one.after - one.before, max(one.u_after, one.u_before)
        difference = rounded(change / scale.size, u / scale.size, sign=True)
        printed = scale.unit if name.startswith("U0") else scale.per_g
        in_u = fixed(one.in_u, 1, sign=True) if one.u_before > 0 else ""
        rows.append(Row(symbol(name), (was, now, difference, printed, in_u)))
    return rows


def _tests(shown: Shown) -> list[Row]:
    rows = []
    unit = shown.before.calibration.unit
    for name, one in (("as it was given", shown.before), ("with what was found", shown.after)):
        if one is not None and one.tested:
            simulated = quantity(one.repeated.lack_of_fit.rms, unit)
            chi2, p = f"{one.test.chi2:.1f} for {one.test.dof}", typeset(words.p_in_column(one.test.p, 2))
            rows.append(Row(name, (chi2, p, quantity(one.test.rms, unit), simulated)))
    return rows


def _drawn_of(shown: Shown) -> int:
    """Return of how many mountings there are figures: each takes a second, and nobody looks through sixty."""
    count = len(mounts_of(shown.before.calibration))
    return count if count <= MOST_DRAWN else DRAWN


def _overlays(shown: Shown) -> tuple[list[Markup], list[Markup]]:
    """Return measured and simulated signals, of the mounting that tells most, and of others, folded away."""
    figures = [_drawn(overlay_of_mount(shown, i)) for i in most_telling(shown)[: _drawn_of(shown)]]
    return figures[:1], figures[1:]


def _residuals(shown: Shown) -> tuple[list[Markup], list[Markup]]:
    """Return the figures of the first mountings: those in full view, and those folded away."""
    mounts = mounts_of(shown.before.calibration)[: _drawn_of(shown)]
    figures = [_drawn(plots.residuals_of_mount(shown, i)) for i in range(len(mounts))]
    return figures[:DRAWN], figures[DRAWN:]


def _apart(diagnosis: Diagnosis) -> list[Effect]:
    """Return what measurement would show each effect that is in a tie."""
    names = dict.fromkeys(
        name
        for effect in diagnosis.effects
        if effect.cannot_tell_from
        for name in (effect.name, *effect.cannot_tell_from)
    )
    return [CATALOGUE[name] for name in names if name in CATALOGUE]
