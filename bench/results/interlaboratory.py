"""The result of `bench kit evaluate`: laboratories that calibrated one travelling block, as JSON, text and page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from markupsafe import Markup
from pydantic import Field
from rich.console import Console

from bench.base.numbers import fixed, probability
from bench.base.result_model import ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.intrinsic import INTRINSIC
from bench.history.equivalence import LaboratoryJudged
from bench.results.compare import draw_degrees
from bench.results.intrinsic import small_unit
from bench.results.parts import ValuePart, by_name
from bench.results.plots import svg_figure
from bench.results.tables import Row, page
from bench.results.tables import symbol as html_symbol

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS: Final = {True: "OFF", False: "agrees"}


class DifferencePart(ValuePart):
    """A laboratory less the consensus of the others, in one of the nine."""

    en: float
    dark: float = Field(description="dark uncertainty of the others (1 sigma)")


class LaboratoryPart(ResultModel):
    """A laboratory against the consensus of all others; its u has no term between laboratories."""

    code: str
    chi2: float
    p: float
    p_all_looks: float = Field(description="after Holm's correction over laboratories")
    off: bool
    differences: dict[str, DifferencePart]


class KitResult(ResultModel):
    """An interlaboratory comparison in the nine numbers that do not depend on the mounting."""

    block: str
    unit: str
    g_m_s2: float = Field(description="the g for which sensitivities are stated, m/s²")
    consensus: dict[str, ValuePart] = Field(description="Mandel-Paule, of all laboratories")
    dark: dict[str, float] = Field(description="dark uncertainty between all laboratories (1 sigma)")
    laboratories: list[LaboratoryPart]
    transport_p: float | None = Field(
        description="p-value that the block was the same at each stop of the pilot; null without a return"
    )
    off: list[str]
    accepted: bool = Field(description="no laboratory is off, and the block did not change")
    notes: list[str]


def laboratories_of(codes: Sequence[str], judged: Sequence[LaboratoryJudged]) -> list[LaboratoryPart]:
    """Return the part of each laboratory, by its code."""
    return [
        LaboratoryPart.from_object(
            one, code=code, differences=by_name(INTRINSIC, DifferencePart, one, value=one.difference)
        )
        for code, one in zip(codes, judged, strict=True)
    ]


def print_kit(result: KitResult, on: Console) -> None:
    """Print each laboratory's verdict with its largest E_n, the transport check and the notes."""
    on.print(f"{len(result.laboratories)} laboratories calibrated {result.block}, in the nine numbers")
    shown = table("laboratory", ">chi²(9)", ">p (Holm)", "largest E_n", "")
    for one in result.laboratories:
        name, worst = max(one.differences.items(), key=lambda item: item[1].en)
        shown.add_row(
            one.code,
            fixed(one.chi2, 1),
            probability(one.p_all_looks),
            f"{name} {worst.en:.2f}",
            WORDS[one.off],
        )
    on.print(shown)
    if result.transport_p is not None:
        word = "did not change" if result.transport_p >= 0.05 else "CHANGED"
        on.print(f"the block {word} on its way, by the pilot's returns ({probability(result.transport_p)})")
    print_notes(on, result.notes)


def render_kit(result: KitResult) -> str:
    """Return the report as an HTML page with the degrees of equivalence as a picture."""

    each = [[one.differences[name] for one in result.laboratories] for name in INTRINSIC]
    nine = [(np.array([d.value for d in row]), np.array([d.u for d in row]), 0.0) for row in each]
    codes = [one.code for one in result.laboratories]

    def draw(figure: Figure) -> None:
        draw_degrees(figure, codes, nine, result.unit)

    height = 2.4 + 0.9 * len(codes)
    drawn = svg_figure("equivalence", (7.4, height), draw, "each laboratory less the others, by number")
    figure = Markup(drawn)  # noqa: S704 - our own drawing
    return page(
        "interlaboratory.html.j2", result=result, figure=figure,
        laboratories=[
            Row(
                one.code,
                (fixed(one.chi2, 1), probability(one.p_all_looks), WORDS[one.off]), bad=one.off,
            )
            for one in result.laboratories
        ],
        consensus=[_consensus(result, name) for name in INTRINSIC],
    )  # fmt: skip


def _consensus(result: KitResult, name: str) -> Row:
    own = result.consensus[name]
    size, unit = small_unit(name, own.u, result.unit)
    cells = (f"{own.value:.7g}", f"{own.u / size:.2g} {unit}", f"{result.dark[name] / size:.2g} {unit}")
    return Row(html_symbol(name), cells)
