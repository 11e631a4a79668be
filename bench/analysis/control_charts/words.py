"""What a control chart says, in words: why a run is rejected, and what its reader should know."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bench.analysis.control_charts.components import ALIKE_P
from bench.base.arrays import Floats
from bench.base.numbers import MINUS, probability
from bench.model.block import COEFFICIENTS

if TYPE_CHECKING:
    from bench.analysis.control_charts.chart import ControlChart

FEW_RUNS = 8
"""With fewer in the baseline, limits are wide: the page says so."""


def reasons_of(chart: ControlChart, row: int) -> tuple[str, ...]:
    """Return why a later run is rejected, a clause for each statistic beyond its limit; nothing where none is."""
    reasons = []
    shewhart, ewma, short = chart.shewhart, chart.ewma, chart.short
    if shewhart.t2[row] > chart.limit_t2:
        which = _which(shewhart.z[row], chart.limit_single)
        reasons.append(f"T² = {shewhart.t2[row]:.1f} is beyond {chart.limit_t2:.1f} ({which})")
    if ewma.t2[row] > chart.limit_ewma:
        which = _which(ewma.z[row], chart.limit_single_ewma)
        reasons.append(f"T² of the EWMA = {ewma.t2[row]:.1f} is beyond {chart.limit_ewma:.1f} ({which})")
    if short is not None and short.p[row] < chart.design.alpha:
        reasons.append(
            f"its short-term standard deviation is {np.sqrt(short.f[row]):.2f} times that of the baseline "
            f"(F = {short.f[row]:.2f} for {short.dof[row]:.0f} and {short.pooled_dof:.0f})"
        )
    return tuple(reasons)


def _which(z: Floats, limit: float) -> str:
    """Say which coefficients are beyond their own limit, the farthest first; else the farthest, that none is."""
    order = np.argsort(-np.abs(z))
    beyond = [k for k in order if abs(z[k]) > limit]
    named = [f"{COEFFICIENTS[k]} {z[k]:+.1f} u".replace("-", MINUS) for k in order]
    return ", ".join(named[: len(beyond)]) if beyond else f"no coefficient alone; the farthest is {named[0]}"


def _listed(names: Sequence[str]) -> str:
    """Return names as a sentence has them: "Kxx, Kxy and Kxz"."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def notes_of(chart: ControlChart) -> tuple[str, ...]:
    """Return what a reader of the chart should know, a sentence each."""
    return (*_on_baseline(chart), *_on_components(chart), *_on_meters(chart), *_on_drift(chart))


def _on_baseline(chart: ControlChart) -> list[str]:
    notes = []
    runs = len(chart.baseline)
    if chart.reference is not None:
        notes.append(
            f"judged by the reference {chart.reference.name}: what lasts in the u of this bench (limits of its "
            "meters, temperature) is in every limit, so that only large changes show; a baseline of the bench's "
            "own runs sees smaller ones"
        )
    elif runs < FEW_RUNS:
        notes.append(
            f"the baseline has {runs} run{'s' * (runs > 1)}: the limits are as wide as so few make them; they "
            "come closer with more"
        )
    if chart.alone is not None:
        worst = int(np.argmin(chart.alone))
        if runs * chart.alone[worst] < ALIKE_P:
            notes.append(
                f"{chart.baseline[worst].name} stands apart from the other runs of the baseline "
                f"({probability(min(1.0, runs * float(chart.alone[worst])))}): find out why, or leave it out"
            )
    return notes


def _on_components(chart: ControlChart) -> list[str]:
    found = chart.components
    if found is None:
        return []
    notes = []
    more = [name for name, p in zip(COEFFICIENTS, found.more_than_stated, strict=True) if p < ALIKE_P]
    if more:
        notes.append(
            f"between the runs of the baseline {_listed(more)} scatter{'s' * (len(more) == 1)} more than stated u: "
            "something comes anew with each run that the bench file does not state so large"
        )
    if found.birge_p < ALIKE_P:
        taken = (
            "believe stated u all the same" if chart.design.basis == "stated" else "are as the scatter shows"
        )
        notes.append(
            f"the baseline scatters {np.sqrt(found.birge2):.2f} times as much as stated u "
            f"({probability(found.birge_p)}); the limits {taken}"
        )
    if chart.design.basis != "scatter" and found.alike_p < ALIKE_P:
        notes.append(
            f"stated u is not as right for every coefficient ({probability(found.alike_p)}): false alarms are more "
            "frequent than stated; name under 'between_runs' what comes anew with each run, or take limits from "
            "scatter (14 runs or more)"
        )
    return notes


def _on_meters(chart: ControlChart) -> list[str]:
    known = {run.meters for run in chart.baseline}
    other = [run.name for run in chart.later if known and run.meters not in known]
    if not other:
        return []
    return [
        f"not known to be measured with the meters of the baseline: {_listed(other)}; the limits of both meters "
        "are in u there; take a new baseline with the new meters"
    ]


def _on_drift(chart: ControlChart) -> list[str]:
    if chart.drift is None:
        return []
    names = [name for name, p in zip(COEFFICIENTS, chart.drift.p, strict=True) if p < ALIKE_P]
    if not names:
        return []
    return [
        f"{_listed(names)} of the check block drift{'s' * (len(names) == 1)}: if it is the block and not the "
        "bench, state it under 'drift' with its u"
    ]
