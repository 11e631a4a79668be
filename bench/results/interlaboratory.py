"""The result of `bench kit evaluate`: laboratories that calibrated one travelling block, as JSON, text and page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from pydantic import Field
from rich.console import Console

from bench.base.arrays import u_of
from bench.base.languages import local_number, message, translated
from bench.base.numbers import fixed, probability, rounded, two_digits, uncertainty
from bench.base.result_model import ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.intrinsic import INTRINSIC, intrinsic_unit
from bench.history.equivalence import Drift, LaboratoryJudged
from bench.results.compare import draw_degrees
from bench.results.parts import ValuePart, by_name, small_unit
from bench.results.plots import svg_figure
from bench.results.tables import Row, page
from bench.results.tables import symbol as html_symbol
from bench.stats import holm

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHANGED_P: Final = 0.05
WORDS: Final = {True: message("OFF", "laboratory"), False: message("agrees", "laboratory")}


class DifferencePart(ValuePart):
    """A laboratory's value minus the consensus of all others, for one of the nine intrinsic numbers."""

    en: float
    dark: float = Field(description="dark uncertainty of the other laboratories (standard deviation)")


class LaboratoryPart(ResultModel):
    """A laboratory compared with the consensus of all others; u includes the scatter between these others."""

    code: str
    chi2: float
    p: float
    p_all_looks: float = Field(description="p-value corrected for the number of laboratories (Holm)")
    off: bool
    differences: dict[str, DifferencePart]


class DriftPart(ResultModel):
    """The change of the block between two calibrations by the pilot, or between two monitor runs."""

    first: str = Field(description="code of the first stop")
    last: str
    by: Literal["calibration", "monitor"]
    changes: dict[str, ValuePart]
    p: float
    p_all_looks: float = Field(description="p-value corrected for the number of changes (Holm)")
    changed: bool


class KitResult(ResultModel):
    """An interlaboratory comparison by the nine intrinsic numbers, which do not depend on the mounting."""

    block: str
    unit: str
    g_m_s2: float = Field(description="gravity to which the sensitivities refer, m/s²")
    consensus: dict[str, ValuePart] = Field(description="consensus values of all laboratories (Mandel-Paule)")
    dark: dict[str, float] = Field(description="dark uncertainty of all laboratories (standard deviation)")
    laboratories: list[LaboratoryPart]
    transport_p: float | None
    """p-value of the hypothesis that the block was the same at each stop at the pilot; null without a return
    """
    drifts: list[DriftPart] = Field(description="changes of the block, in the order of its route")
    transport: dict[str, float]
    """standard deviation of the block's state between stops beyond u, which u of each difference includes"""
    off: list[str]
    accepted: bool = Field(description="whether no laboratory deviates and the block did not change")
    notes: list[str]


def laboratories_of(codes: Sequence[str], judged: Sequence[LaboratoryJudged]) -> list[LaboratoryPart]:
    """Return the part of the result on each laboratory, with its code."""
    return [
        LaboratoryPart.from_object(
            one, code=code, differences=by_name(INTRINSIC, DifferencePart, one, value=one.difference)
        )
        for code, one in zip(codes, judged, strict=True)
    ]


def drifts_of(seen: Sequence[tuple[str, str, Literal["calibration", "monitor"], Drift]]) -> list[DriftPart]:
    """Return the part on each change of the block in `seen`: codes of two measurements, method, change."""
    p = [drift.p for *_, drift in seen]
    looks = holm(np.array(p)).tolist() if p else []
    return [
        DriftPart(
            first=first, last=last, by=by, p=alone, p_all_looks=all_looks, changed=all_looks < CHANGED_P,
            changes={
                name: ValuePart(value=float(v), u=float(u))
                for name, v, u in zip(drift.names, drift.change, u_of(drift.covariance), strict=True)
            },
        )
        for (first, last, by, drift), alone, all_looks in zip(seen, p, looks, strict=True)
    ]  # fmt: skip


def _judged(one: LaboratoryPart) -> str:
    return translated(WORDS[one.off], "laboratory")


def drift_words(drift: DriftPart, unit: str) -> str:
    """Return a change in words: codes of both measurements, number changed most relative to u, p-value."""
    name, worst = max(drift.changes.items(), key=lambda item: abs(item[1].value) / item[1].u)
    size, small = small_unit(name, worst.u, unit)
    change = (
        f"{rounded(worst.value / size, worst.u / size, sign=True)} ± {uncertainty(worst.u / size)} {small}"
    )
    calibrated = translated(message("calibration", "laboratory"), "laboratory")
    p, by = probability(drift.p_all_looks), calibrated if drift.by == "calibration" else drift.by
    if drift.first == drift.last:
        return message(
            f"{'CHANGED' if drift.changed else 'unchanged'} at {drift.first}, by {by}: "
            f"{name} by {change} (u), {p}"
        )
    return message(
        f"{'CHANGED' if drift.changed else 'unchanged'} from {drift.first} to {drift.last}, by {by}: "
        f"{name} by {change} (u), {p}"
    )


def print_kit(result: KitResult, on: Console) -> None:
    """Print each laboratory's verdict with its largest E_n, the transport check and the notes."""
    on.print(
        message(f"{len(result.laboratories)} laboratories calibrated {result.block}, in the nine numbers")
    )
    shown = table("laboratory", ">chi²(9)", ">p (Holm)", "largest E_n", "")
    for one in result.laboratories:
        name, worst = max(one.differences.items(), key=lambda item: item[1].en)
        shown.add_row(
            one.code,
            fixed(one.chi2, 1),
            probability(one.p_all_looks),
            f"{name} {local_number(f'{worst.en:.2f}')}",
            _judged(one),
        )
    on.print(shown)
    if result.transport_p is not None:
        same = result.transport_p >= CHANGED_P
        on.print(
            f"the block {'did not change' if same else 'CHANGED'} in transport, as the pilot's repeated "
            f"calibrations show ({probability(result.transport_p)})"
        )
    for drift in result.drifts:
        on.print(drift_words(drift, result.unit))
    widened = [
        f"{name} {two_digits(dark / size)} {unit}"
        for name, dark in result.transport.items()
        for size, unit in [small_unit(name, dark, result.unit)]
        if dark > 0.0
    ]
    if widened:
        on.print(f"the block scattered between stops; u of each difference includes it: {', '.join(widened)}")
    print_notes(on, result.notes)


def render_kit(result: KitResult) -> str:
    """Return the report as an HTML page, with a picture of the degrees of equivalence."""

    each = [[one.differences[name] for one in result.laboratories] for name in INTRINSIC]
    nine = [(np.array([d.value for d in row]), np.array([d.u for d in row]), 0.0) for row in each]
    codes = [one.code for one in result.laboratories]

    def draw(figure: Figure) -> None:
        draw_degrees(figure, codes, nine, result.unit)

    height = 2.4 + 0.9 * len(codes)
    figure = svg_figure(
        "equivalence", (7.4, height), draw, message("each laboratory less the others, by number")
    )
    return page(
        "interlaboratory.html.j2", result=result, figure=figure,
        laboratories=[
            Row(
                one.code,
                fixed(one.chi2, 1), probability(one.p_all_looks), _judged(one), bad=one.off
            )
            for one in result.laboratories
        ],
        consensus=[_consensus(result, name) for name in INTRINSIC],
        drifts=[drift_words(drift, result.unit) for drift in result.drifts],
    )  # fmt: skip


def _consensus(result: KitResult, name: str) -> Row:
    own = result.consensus[name]
    size, unit = small_unit(name, own.u, result.unit)
    of_value = intrinsic_unit(name, result.unit).replace("deg", "°")
    beyond = (two_digits(dark[name] / size) for dark in (result.dark, result.transport))
    cells = (f"{u} {unit}" for u in (uncertainty(own.u / size), *beyond))
    return Row(html_symbol(name), f"{rounded(own.value, own.u)} {of_value}", *cells)
