"""A budget as a page, its figures, and as text in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup
from rich.console import Console
from rich.table import Table

from bench.base.arrays import Floats
from bench.base.computing import quiet
from bench.base.numbers import fixed
from bench.base.tables import table
from bench.calibration.budget.acceleration import ExactResult
from bench.calibration.budget.assessment import Assessment
from bench.calibration.budget.coefficients import Budget
from bench.calibration.budget.propagation import coverage_factor
from bench.calibration.conformity import DecisionRule
from bench.calibration.verification import rule_in_words
from bench.model.geometry import COEFFICIENTS
from bench.results import tables
from bench.results.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION, drawn, svg_figure, symbol
from bench.results.tables import Row
from bench.results.template import page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


COLOURS: Final = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, "#56B4E9", "#F0E442", GREY)
HATCHES: Final = ("", "////", "....", "xxxx")
VISIBLE: Final = 0.01
"""Sources with less than this part of every variance are drawn together."""
DOTS_PER_INCH: Final = 160


@dataclass(frozen=True)
class BudgetFigure:
    """A figure by name, with what it shows in words."""

    name: str
    inches: tuple[float, float]
    draw: Callable[[Figure], None]
    alt: str

    def svg(self) -> str:
        """Return it as an element for a page."""
        return svg_figure(self.name, self.inches, self.draw, self.alt)

    def save(self, folder: Path) -> tuple[Path, Path]:
        """Draw it once, write it as SVG and as PNG, and return both files. Raises `OSError`."""
        with drawn(self.name, self.inches, self.draw) as figure:
            svg, png = folder / f"{self.name}.svg", folder / f"{self.name}.png"
            figure.savefig(png, dpi=DOTS_PER_INCH)
            figure.savefig(svg, metadata={"Date": None})
        return svg, png


def figures(result: Mapping[str, Any]) -> tuple[BudgetFigure, ...]:
    """Return the figures of a budget's result."""
    return contributions(result), modulus(result)


def contributions(result: Mapping[str, Any]) -> BudgetFigure:
    """Bars as high as the combined u of each coefficient, parted as the sources part its variance."""
    names: list[str] = result["order"]
    u = np.array([result["coefficients"][name]["u"] for name in names])
    parts = {source: np.array(of["contribution_u"]) ** 2 for source, of in result["sources"].items()}
    shares = _gathered({source: part / np.where(u > 0, u, 1.0) ** 2 for source, part in parts.items()})

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        base = np.zeros(len(names))
        for i, (source, share) in enumerate(shares.items()):
            axes.bar(
                range(len(names)), 1e6 * share * u, bottom=base, width=0.72, label=source,
                color=COLOURS[i % len(COLOURS)], hatch=HATCHES[i // len(COLOURS)],
                edgecolor="white", linewidth=0.4,
            )  # fmt: skip
            base += 1e6 * share * u
        axes.set_xticks(range(len(names)), [symbol(name) for name in names])
        axes.grid(visible=False, axis="x")
        axes.set_ylabel("combined u / (µV/g)\n(biases: µV)")
        figure.legend(loc="outside upper center", ncols=4)

    alt = "Combined standard uncertainty of the twelve coefficients, parted by source as the variance is"
    return BudgetFigure("budget-coefficients", (7.4, 3.8), draw, alt)


def modulus(result: Mapping[str, Any]) -> BudgetFigure:
    """u of |a| against |a|: mean and largest over directions, and the sources that matter (mean)."""
    rows: list[Mapping[str, Any]] = result["acceleration"]["magnitudes"]
    at = np.array([row["magnitude_g"] for row in rows])
    mean = np.array([row["u_modulus_mean"] for row in rows])
    largest = np.array([row["u_modulus_max"] for row in rows])
    shares = {
        source: np.array([row["share"][source] for row in rows])
        for source in rows[0]["share"]
        if max(row["share"][source] for row in rows) > 10 * VISIBLE
    }

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        for i, (source, share) in enumerate(shares.items()):
            axes.plot(
                at, 1e6 * np.sqrt(share) * mean, linestyle=("--", ":", "-.")[i % 3], linewidth=1.0,
                color=COLOURS[(i + 2) % len(COLOURS)], label=source,
            )  # fmt: skip
        axes.plot(at, 1e6 * largest, "v-", color=VERMILION, label="largest over directions")
        axes.plot(at, 1e6 * mean, "o-", color=BLUE, label="mean over directions")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(at, [f"{a:g}" for a in at])
        axes.minorticks_off()
        axes.set_xlabel("|a| / g")
        axes.set_ylabel("u(|a|) / µg")
        figure.legend(loc="outside upper center", ncols=3)

    alt = f"Standard uncertainty of a measured |a| from {at[0]:g} g to {at[-1]:g} g"
    return BudgetFigure("budget-acceleration", (7.4, 3.8), draw, alt)


def _gathered(shares: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the shares that can be seen, and all others as one."""
    seen = {source: share for source, share in shares.items() if np.max(share) >= VISIBLE}
    rest = sum((share for source, share in shares.items() if source not in seen), np.zeros(12))
    return {**seen, "others": rest} if np.any(rest > 0.0) else seen


def render_budget(result: Mapping[str, Any]) -> str:
    """Return the page; the same result gives the same text."""
    check = result["verification"]
    return page(
        "budget.html.j2",
        result=result,
        headings=["source", *(tables.symbol(name) for name in result["order"])],
        coefficients=_coefficients(result),
        sources=_sources(result),
        accelerations=_accelerations(result),
        points=_points(result),
        verdict={True: "passed", False: "failed", None: "none"}[check["capable"]],
        limit=f"{1e6 * check['limit_g']:g}",
        rule_in_words=rule_in_words(DecisionRule.of_json(check)),
        monte_carlo=_monte_carlo(result),
        contributions=Markup(contributions(result).svg()),  # noqa: S704 - our own drawing
        modulus=Markup(modulus(result).svg()),  # noqa: S704
    )


def _coefficients(result: Mapping[str, Any]) -> list[Row]:
    rows = [
        Row(f"{name.replace('_', ' ')}{' *' if source['prior'] else ''}", _micro(source["contribution_u"]))
        for name, source in result["sources"].items()
    ]
    coefficients = [result["coefficients"][name] for name in result["order"]]
    rows.append(Row("stand, as calibrate states", _micro(result["groups"]["stand"]["u"])))
    rows.append(Row("combined u, per local g", _micro(result["per_local_g"]["u"])))
    rows.append(Row("combined u", _micro([one["u"] for one in coefficients])))
    rows.append(
        Row(
            "effective dof", tuple("∞" if one["dof"] is None else f"{one['dof']:.0f}" for one in coefficients)
        )
    )
    rows.append(Row("k", tuple(f"{one['k']:.2f}" for one in coefficients)))
    rows.append(Row("U", _micro([one["U"] for one in coefficients])))
    return rows


def _sources(result: Mapping[str, Any]) -> list[Row]:
    return [
        Row(
            f"{name.replace('_', ' ')} ({source['symbol']})",
            (
                source["shown"], source["distribution"], source["common_to"],
                "∞" if source["dof"] is None else f"{source['dof']:g}", source["origin"],
            ),
        )
        for name, source in result["sources"].items()
    ]  # fmt: skip


def _accelerations(result: Mapping[str, Any]) -> list[Row]:
    rows = []
    for at in result["acceleration"]["magnitudes"]:
        name, share = max(at["share"].items(), key=lambda item: item[1])
        sizes = [at[key] for key in ("u_modulus_mean", "u_modulus_max", "U_modulus_max", "u_vector_mean")]
        rows.append(Row(f"{at['magnitude_g']:g} g", (*_micro(sizes), f"{name} ({100 * share:.0f} %)")))
    return rows


def _points(result: Mapping[str, Any]) -> list[Row]:
    return [
        Row(
            f"point {point['point']} at {point['angle_deg']:g}°",
            (
                *_micro([point["u"], point["U"]]),
                fixed(1e6 * point["accepted_up_to"], 1) if point["accepted_up_to"] > 0 else "nothing",
                f"{100 * point['passes']:.4g} %",
            ),
            bad=not point["capable"],
        )
        for point in result["verification"]["points"]
    ]


def _monte_carlo(result: Mapping[str, Any]) -> list[Row]:
    if result["monte_carlo"] is None:
        return []
    return [
        Row(
            name,
            (
                *_micro([output["u_linear"], output["u"]]),
                f"{output['ratio']:.3f}",
                *_micro([*output["differences"], output["tolerance"]]),
                "yes" if output["validated"] else "no",
            ),
            bad=not output["validated"],
        )
        for name, output in result["monte_carlo"]["outputs"].items()
    ]


def _micro(values: Sequence[float]) -> tuple[str, ...]:
    return tuple(fixed(1e6 * value, 1) if abs(value) >= 5e-8 else "0" for value in values)


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
        rows.add_row(f"{source.name}{'*' if source.prior else ''}", *_micro_or_zero(contribution.u))
    total, stand = budget.combined, budget.of_group("stand")
    rows.add_row("stand, as calibrate states", *_micro_or_zero(stand.u), style="bold")
    rows.add_row("combined u, per local g", *_micro_or_zero(budget.per_local_g.u), style="bold")
    rows.add_row("combined u", *_micro_or_zero(total.u), style="bold")
    if np.any(np.isfinite(total.dof)):
        rows.add_row("effective dof", *(f"{nu:.0f}" if np.isfinite(nu) else "∞" for nu in total.dof))
    factor = coverage_factor(total.dof, budget.probability)
    same = np.ptp(factor) < 0.005
    factors = f"k = {factor[0]:.2f}" if same else "k by dof"
    rows.add_row(
        f"U ({factors}, {100 * budget.probability:.4g} %)", *_micro_or_zero(factor * total.u), style="bold"
    )
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


def _micro_or_zero(values: Floats) -> list[str]:
    return [f"{1e6 * value:.1f}" if value >= 5e-8 else "0" for value in values]
