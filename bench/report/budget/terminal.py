"""A budget as text in the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.analysis.budget.assessment import Assessment
from bench.analysis.budget.coefficients import Budget
from bench.analysis.budget.exact import ExactResult
from bench.analysis.budget.propagation import coverage_factor
from bench.base.arrays import Floats
from bench.base.progress import quiet
from bench.base.tables import table
from bench.model.block import COEFFICIENTS


def print_budget(head: Mapping[str, Any], found: Assessment, out: Console) -> None:
    """Print the budget: coefficients by source, measured accelerations, the check, Monte Carlo, notes."""
    out.print(headline(head, found))
    out.print("standard uncertainties by source: K in µV/g, U0 in µV; * a plausible size, not a stated one")
    out.print(coefficient_table(found.budget))
    out.print(_sources_in_words(found.budget))
    out.print(acceleration_table(found))
    if found.points:
        _print_points(out, found)
    if found.exact is not None:
        _print_exact(out, found.exact)
    for note in found.notes:
        if not quiet.get():
            out.print(f"note: {note}")


def headline(head: Mapping[str, Any], found: Assessment) -> str:
    """Return a sentence on what the budget is of."""
    return (
        f"Budget of {head['procedure']} on {head['bench']}: {found.budget.estimator}, model {head['model']}, "
        f"{head['readings']['fitted']} readings, about {head['about']}"
    )


def coefficient_table(budget: Budget) -> Table:
    """Return source by coefficient, then combined u, effective degrees of freedom, U; "stand" is a part."""
    rows = _table("source", *COEFFICIENTS)
    for contribution in budget.contributions:
        source = contribution.source
        rows.add_row(f"{source.name}{'*' if source.prior else ''}", *_micro(contribution.u))
    total, stand = budget.combined, budget.of_group("stand")
    rows.add_row("stand, as calibrate states", *_micro(stand.u), style="bold")
    rows.add_row("combined u, per local g", *_micro(budget.per_local_g.u), style="bold")
    rows.add_row("combined u", *_micro(total.u), style="bold")
    if np.any(np.isfinite(total.dof)):
        rows.add_row("effective dof", *(f"{nu:.0f}" if np.isfinite(nu) else "∞" for nu in total.dof))
    factor = coverage_factor(total.dof, budget.probability)
    same = np.ptp(factor) < 0.005
    factors = f"k = {factor[0]:.2f}" if same else "k by dof"
    rows.add_row(f"U ({factors}, {100 * budget.probability:.4g} %)", *_micro(factor * total.u), style="bold")
    return rows


def _sources_in_words(budget: Budget) -> Table:
    rows = table("source", "", ">u", "common to", ">dof", "where its size comes from")
    for contribution in budget.contributions:
        source = contribution.source
        dof = f"{source.dof:g}" if np.isfinite(source.dof) else "∞"
        rows.add_row(source.name, source.symbol, source.shown, source.common, dof, source.origin)
    return rows


def acceleration_table(found: Assessment) -> Table:
    """Return u of a measured acceleration by its size, g."""
    how = "the same voltmeters" if found.question.same_voltmeters else "voltmeters alike"
    rows = _table(
        "measured |a|", "u(|a|) mean", "largest", "U(|a|) largest", "u(vector) mean", "largest", "most of it"
    )
    rows.title = f"one reading with {how}, over all directions, µg"
    rows.title_justify = "left"
    for a in found.accelerations:
        name, share = max(a.share.items(), key=lambda item: item[1])
        sizes = (a.u_modulus_mean, a.u_modulus_max, a.U_modulus_max, a.u_vector_mean, a.u_vector_max)
        rows.add_row(
            f"{a.magnitude_g:g} g", *(f"{1e6 * s:.1f}" for s in sizes), f"{name} {100 * share:.0f} %"
        )
    return rows


def _print_points(out: Console, found: Assessment) -> None:
    question = found.question
    rows = _table("verification point", "u(Δg)", "U(Δg)", "accepted up to", "passes", "most of it")
    for point in found.points:
        name = max(point.by_source, key=lambda source: point.by_source[source])
        rows.add_row(
            f"{point.point} at {point.angle_deg:g}°",
            f"{point.u * 1e6:.1f} µg",
            f"{point.U * 1e6:.1f} µg",
            f"{point.accepted_up_to * 1e6:.1f} µg" if point.accepted_up_to > 0 else "nothing",
            f"{100 * point.passes:.4g} %",
            name,
        )
    out.print(rows)
    surely = f"CANNOT BE PASSED with {100 * found.budget.probability:.4g} %"
    verdict = "can be passed" if found.capable else surely
    out.print(
        f"check of |Δg| ≤ {question.limit_g * 1e6:g} µg, rule: {question.rule.words}: {verdict} "
        "(U against what is accepted, at every point)",
        style="bold",
    )


def _print_exact(out: Console, exact: ExactResult) -> None:
    ratio = exact.verdict.ratio[exact.linear.u > 0.0]
    agreed = np.flatnonzero(~exact.verdict.validated)
    names = ", ".join(exact.names[i] for i in agreed)
    verdict = f"not validated for {names}" if names else "validated for every output"
    out.print(
        f"Monte Carlo on the exact geometry, {exact.trials.trials} trials: u over linear u "
        f"{ratio.min():.3f} to {ratio.max():.3f}; JCGM 101, clause 8: {verdict}"
    )


def _table(first: str, *others: str) -> Table:
    return table(first, *(f">{heading}" for heading in others), no_wrap=True)


def _micro(values: Floats) -> list[str]:
    return [f"{1e6 * value:.1f}" if value >= 5e-8 else "0" for value in values]
