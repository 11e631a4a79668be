"""The page of a diagnosis of free positions: one HTML file that needs nothing but itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from markupsafe import Markup

from bench.analysis.diagnosis.free_result import FreeDiagnosis
from bench.base.arrays import CHANNELS
from bench.base.numbers import aligned, concise, quantity, rounded, scale_for, typeset
from bench.model import CATALOGUE
from bench.model.block import COEFFICIENTS
from bench.report.diagnosis import free_plots, free_words, plots, words
from bench.report.tables import Row, symbol
from bench.report.template import page

MOST_DRAWN: Final = 8
"""Sensors of which signals are drawn."""
STATES: Final = {"agrees": "passed", "named": "none", "confounded": "none"}
"""Colour of the verdict; of the others it is that of a failure."""


def render_free(
    found: FreeDiagnosis,
    title: str,
    provenance: Mapping[str, str],
    *,
    simulated: bool,
    models: Sequence[str],
    copies: Sequence[str],
) -> str:
    """Return the page; the same content gives the same text. `models` and `copies` are files that were written."""
    drawn = [_drawn(free_plots.overlay(found, s)) for s in range(min(found.rows.sensors, MOST_DRAWN))]
    return page(
        "free_diagnosis.html.j2",
        title=title,
        found=found,
        simulated=simulated,
        source=free_words.named(found),
        provenance=provenance,
        state=STATES.get(found.verdict, "failed"),
        lead=free_words.lead(found),
        what=free_words.what(found),
        gap=free_words.gap(found),
        to_do=list(free_words.what_to_do(found, models, copies)),
        words=words,
        quantity=quantity,
        effects=[(free_words.title(one), one, free_words.parameters(one)) for one in found.found],
        overlays=drawn,
        in_time=_drawn(free_plots.modulus_in_time(found)),
        by_record=_drawn(free_plots.modulus_by_record(found)) if found.records > 1 else None,
        gap_bars=_drawn(plots.gap_bars(found.gap)) if found.found and found.gap.folds else None,
        held_out=[
            Row(
                fold.label,
                (
                    ", ".join(fold.gains) or "nothing",
                    f"{fold.before.reduced:.2f}",
                    f"{fold.after.reduced:.2f}",
                ),
            )
            for fold in found.gap.folds
        ],
        places=[
            Row(p["pattern"], (quantity(p["size"], "g"), typeset(words.p_in_column(p["p"]))))
            for p in found.where
        ],
        coefficients=list(_coefficients(found)),
        zeros=list(_zeros(found)),
        models=models,
        hidden=[CATALOGUE[name] for name in found.to_dict()["hidden"]],
    )


def _drawn(svg: str) -> Markup:
    return Markup(svg)  # noqa: S704 - our own drawing


def _coefficients(found: FreeDiagnosis) -> Iterator[tuple[int, list[Row]]]:
    """Yield the coefficients of each sensor as they are by the model before and after; six of K by convention."""
    unit = found.rows.tables[0].unit
    for sensor in range(found.rows.sensors):
        pairs = [
            (fit.block[sensor].vector.tolist(), fit.u[sensor].tolist()) for fit in (found.before, found.after)
        ]
        (old, u_old), (new, u_new) = pairs
        shown = [i for i in range(len(old)) if u_old[i] > 0.0]
        before = aligned([concise(old[i], u_old[i]) for i in shown])
        after = aligned([concise(new[i], u_new[i]) for i in shown])
        scale = scale_for(max(abs(new[i] - old[i]) for i in shown), unit)
        rows = []
        for i, was, now in zip(shown, before, after, strict=True):
            change = rounded((new[i] - old[i]) / scale.size, max(u_old[i], u_new[i]) / scale.size, sign=True)
            printed = scale.unit if COEFFICIENTS[i].startswith("U0") else scale.per_g
            rows.append(Row(symbol(COEFFICIENTS[i]), (was, now, change, printed)))
        yield sensor, rows


def _zeros(found: FreeDiagnosis) -> Iterator[Row]:
    """Yield the zeros of each sensor in each record, fitted by itself, in mg with u."""
    between = found.between
    if between is None:
        return
    for sensor in range(found.rows.sensors):
        for record in range(between.zero.shape[1]):
            values = 1e3 * between.zero[sensor, record]
            u = 1e3 * between.u[sensor, record]
            cells = tuple(
                concise(float(values[i]), float(u[i])) if np.isfinite(values[i]) else "not determined"
                for i in range(len(CHANNELS))
            )
            yield Row(f"sensor {sensor + 1}, record {record + 1}", cells)
