"""The page of a diagnosis: one HTML file that needs nothing but itself, and tells what was found in order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from markupsafe import Markup

from bench.analysis.diagnosis import Diagnosis
from bench.analysis.diagnosis.alternatives import Rival
from bench.analysis.diagnosis.result import UNNAMED_WORDS
from bench.analysis.diagnosis.show import Shown
from bench.base.numbers import aligned, concise, fixed, quantity, rounded, scale_for, two_digits, typeset
from bench.model import CATALOGUE
from bench.report.diagnosis import plots, words
from bench.report.page import FITS
from bench.report.plots import mounts_of
from bench.report.tables import Row, symbol
from bench.report.template import page_template

DRAWN: Final = 4
"""Mountings of which the residuals are drawn in full view; those beyond are folded away."""

STATES: Final = {"agrees": "passed", "named": "none", "confounded": "none"}
"""Colour of the verdict; of the others it is that of a failure."""

NAMES: Final = {"before": "as it was given", "after": "with what was found"}


@dataclass(frozen=True)
class DiagnosisContent:
    """Everything that the page says: the result as JSON has it, and what its figures are drawn from."""

    title: str
    result: Mapping[str, Any]
    diagnosis: Diagnosis
    shown: Shown
    ranked: tuple[tuple[Rival, ...], ...]
    limit_g: float
    provenance: Mapping[str, str] = field(default_factory=dict)


def render_diagnosis(content: DiagnosisContent) -> str:
    """Return the page; the same content gives the same text."""
    result, shown = content.result, content.shown
    return page_template("diagnosis.html.j2").render(
        content=content,
        result=result,
        state=STATES.get(result["verdict"], "failed"),
        lead=words.LEAD[result["verdict"]],
        verdict=words.verdict_in_words(result),
        places=[_place(place) for place in result["where"]],
        mistakes=list(zip(_mistakes(result), content.diagnosis.mistakes.mistakes, strict=True)),
        effects=[_effect(content, i, effect) for i, effect in enumerate(words.effects_of(result))],
        gap=_gap(result),
        coefficients=_coefficients(result),
        changed=shown.after is not None,
        tests=_tests(result),
        joined=list(words.joined_in_words(result)),
        less_certain=words.less_certain(result) if shown.after else [],
        still=words.STILL_MISSING if _still_missing(result) else None,
        residuals=_residuals(shown),
        in_time=_drawn(plots.residuals_in_time(shown)),
        modulus=_drawn(plots.modulus(shown, content.limit_g)) if shown.before.points else None,
        following=result["next_measurement"],
        apart=_apart(result),
        hidden=[(name, CATALOGUE[name].sentence, CATALOGUE[name].shown_by) for name in result["hidden"]],
        smallest=[
            Row(name, (size.replace(" ", "\N{NO-BREAK SPACE}"), CATALOGUE[name].sentence))
            for name, size in words.smallest_found(result)
        ],
        registered=result["registered"],
        noise=_noise(result),
    )


def _drawn(svg: str) -> Markup:
    return Markup(svg)  # noqa: S704 - our own drawing


def _place(place: Mapping[str, Any]) -> Row:
    where = "verification points" if place["channel"] == "modulus" else str(place["channel"])
    installation = "whole run" if place["installation"] == "all" else str(place["installation"])
    size = quantity(place["size"], place["unit"])
    return Row(where, (installation, str(place["pattern"]), size, typeset(words.p_in_column(place["p"]))))


def _mistakes(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the mistakes with p in words."""
    return [
        {**mistake, "p": typeset(words.p_in_words(mistake["p"]))} for mistake in words.mistakes_of(result)
    ]


def _effect(content: DiagnosisContent, number: int, effect: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the page says of one thing that was found."""
    ranked = content.ranked[number] if number < len(content.ranked) else ()
    others = [
        {
            "name": name,
            "sentence": CATALOGUE[name].sentence if name in CATALOGUE else UNNAMED_WORDS[name],
            "shift": words.shift_in_words(content.result, number, name),
            "tied": name in effect["cannot_tell_from"],
        }
        for name in (*effect["cannot_tell_from"], *effect["plainer_than"])
    ]
    return {
        "name": effect["name"],
        "title": words.effect_title(effect),
        "sentence": effect["words"],
        "named": effect["name"] in CATALOGUE,
        "parameters": list(words.parameters_in_words(effect)),
        "p": typeset(words.p_in_words(effect["p_all_looks"])),
        "rho": None if effect["rho"] is None else f"{effect['rho']:.1f}",
        "others": others,
        "ranking": _drawn(plots.ranking(ranked, effect["name"], number)) if ranked else None,
    }


def _gap(result: Mapping[str, Any]) -> dict[str, Any] | None:
    gap = result["gap"]
    if not gap["held_out"]:
        return None
    rows = [
        Row(
            fold["what"],
            (
                ", ".join(fold["named_without_it"]) or "nothing",
                f"{fold['before']:.2f}",
                f"{fold['after']:.2f}",
                "yes" if fold["confirmable"] else "no: without it the rest could not have shown the effect",
            ),
        )
        for fold in gap["held_out"]
    ]
    counted = any(fold["confirmable"] for fold in gap["held_out"])
    return {
        "rows": rows,
        "counted": counted,
        "before": f"{gap['before']:.2f}" if counted else "",
        "after": f"{gap['after']:.2f}" if counted else "",
        "p": None if gap["p_after"] is None else typeset(words.p_in_words(gap["p_after"], 2)),
        "before_rms": quantity(gap["before_rms"], gap["unit"]) if counted else "",
        "after_rms": quantity(gap["after_rms"], gap["unit"]) if counted else "",
        "noise": quantity(gap["noise_rms"], gap["unit"]),
        "figure": _drawn(plots.gap_bars(gap)),
    }


def _coefficients(result: Mapping[str, Any]) -> list[Row]:
    told = result["coefficients"]
    before = aligned([concise(one["before"], one["u_before"]) for one in told.values()])
    after = aligned([concise(one["after"], one["u_after"]) for one in told.values()])
    unit = result["gap"]["unit"]
    largest = max(abs(one["after"] - one["before"]) for one in told.values())
    scale = scale_for(largest, unit)
    rows = []
    for (name, one), was, now in zip(told.items(), before, after, strict=True):
        change, u = one["after"] - one["before"], one["u_before"]
        shown = rounded(change / scale.size, max(one["u_after"], u) / scale.size, sign=True)
        printed = scale.unit if name.startswith("U0") else scale.per_g
        per_u = fixed(change / u, 1, sign=True) if u > 0 else ""
        rows.append(Row(symbol(name), (was, now, shown, printed, per_u)))
    return rows


def _tests(result: Mapping[str, Any]) -> list[Row]:
    rows = []
    for name, told in result["simulation"].items():
        if told is not None and told["p"] is not None:
            rms = quantity(told["rms"], result["gap"]["unit"])
            simulated = quantity(told["rms_of_a_simulated_run"], result["gap"]["unit"])
            chi2 = f"{told['chi2']:.1f} for {told['dof']}"
            rows.append(Row(NAMES[name], (chi2, typeset(words.p_in_column(told["p"], 2)), rms, simulated)))
    return rows


def _still_missing(result: Mapping[str, Any]) -> bool:
    last = result["simulation"]["after"] or result["simulation"]["before"]
    return last["p"] is not None and last["p"] < FITS


def _residuals(shown: Shown) -> tuple[list[Markup], list[Markup]]:
    """Return the figures of the mountings: those in full view, and those folded away."""
    figures = [
        _drawn(plots.residuals_of_mount(shown, i)) for i in range(len(mounts_of(shown.before.calibration)))
    ]
    return figures[:DRAWN], figures[DRAWN:]


def _apart(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what measurement would show each effect that is in a tie."""
    names = dict.fromkeys(
        name
        for effect in words.effects_of(result)
        if effect["cannot_tell_from"]
        for name in (effect["name"], *effect["cannot_tell_from"])
    )
    return [(name, CATALOGUE[name].shown_by) for name in names if name in CATALOGUE]


def _noise(result: Mapping[str, Any]) -> dict[str, str]:
    noise = result["noise"]
    return {
        "reading": quantity(noise["reading"], result["gap"]["unit"]),
        "setting": f"{two_digits(noise['setting_arcsec'])}″",
    }
