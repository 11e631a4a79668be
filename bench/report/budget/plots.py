"""The figures of a budget: what each source takes of each coefficient, and u of |a| against its magnitude.

Drawn from the result as JSON has it, for the page (SVG) and as files (SVG, PNG).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.report.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION, drawn, svg_figure, symbol

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
