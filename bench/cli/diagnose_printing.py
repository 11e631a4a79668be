"""A diagnosis as text in the terminal, from the result as JSON has it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from bench.base.numbers import quantity, typeset
from bench.model import CATALOGUE
from bench.report.diagnosis.words import (
    LEAD,
    STILL_MISSING,
    alike_in_words,
    effect_title,
    effects_of,
    joined_in_words,
    less_certain,
    mistakes_of,
    p_in_column,
    p_in_words,
    parameters_in_words,
    place_in_words,
    shift_in_words,
    smallest_found,
    verdict_in_words,
)
from bench.report.page import FITS

LISTED_PLACES: Final = 6
LISTED_SHIFT: Final = 0.5
"""A change of a coefficient below this part of its u is not worth a line."""


def one(result: Mapping[str, Any], out: Console) -> None:
    """Print one diagnosis in the order in which it was made."""
    _notes(result, "", out)
    _mistakes(result, out)
    _places(result, out)
    for number, effect in enumerate(effects_of(result)):
        _effect(result, number, effect, out)
    _gap(result, out)
    _consequence(result, out)
    _limits_of_sight(result, out)
    _files(result, out)
    lead = LEAD[result["verdict"]].upper()
    out.print(f"{result['source']}: {lead}: {typeset(verdict_in_words(result))}", style="bold")


def several(results: Sequence[Mapping[str, Any]], out: Console) -> None:
    """Print a line for each of several diagnoses."""
    table = Table(box=None, pad_edge=False)
    for heading, side in (
        ("source", "left"), ("verdict", "left"), ("what", "left"), ("p, all looks", "right"),
        ("gap before", "right"), ("after", "right"), ("model", "left"),
    ):  # fmt: skip
        table.add_column(heading, justify=side)  # type: ignore[arg-type]
    for result in results:
        gap = result["gap"]
        what = alike_in_words(result["effects"]) or "nothing"
        p = min((effect["p_all_looks"] for effect in result["effects"]), default=None)
        table.add_row(
            str(result["source"]), str(result["verdict"]), what, "" if p is None else typeset(p_in_column(p)),
            _ratio(gap["before"]), _ratio(gap["after"]), str(result["model"] or ""),
        )  # fmt: skip
    for result in results:
        _notes(result, f"{result['source']}: ", out)
    out.print(table)
    out.print("gap: reduced chi-square of readings held out, 1 is noise alone")
    for result in results:
        if result["report"]:
            out.print(f"report: {result['report']}")


def _notes(result: Mapping[str, Any], lead: str, out: Console) -> None:
    for note in result["notes"]:
        out.print(f"note: {lead}{note}")
    for row in result["skipped_rows"]:
        out.print(f"left out: {row}")


def _ratio(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _places(result: Mapping[str, Any], out: Console) -> None:
    if not result["where"]:
        out.print("Readings and model disagree nowhere: no pattern of the residuals stands out of the noise")
        return
    out.print("Where readings and model disagree, the largest first:")
    for place in result["where"][:LISTED_PLACES]:
        out.print(f"  {typeset(place_in_words(place))}")
    more = len(result["where"]) - LISTED_PLACES
    if more > 0:
        out.print(f"  and {more} more")


def _mistakes(result: Mapping[str, Any], out: Console) -> None:
    for mistake in mistakes_of(result):
        out.print(f"Mistake: {mistake['name']}: {mistake['words']}", style="bold")
        out.print("  what follows is from a copy with it put right; the record is as it was")


def _effect(result: Mapping[str, Any], number: int, effect: Mapping[str, Any], out: Console) -> None:
    out.print(f"Found: {effect_title(effect)}", style="bold")
    out.print(f"  {effect['words']}")
    for line in parameters_in_words(effect):
        out.print(f"  {line}")
    rho = "" if effect["rho"] is None else f", {effect['rho']:.1f} times the noise in all (rho)"
    out.print(typeset(f"  {p_in_words(effect['p_all_looks'])} with all looks counted{rho}"))
    for other in effect["cannot_tell_from"]:
        told = [shift_in_words(result, number, other)]
        if other in CATALOGUE:
            told.append(f"to tell them apart: {CATALOGUE[other].shown_by}")
        out.print(f"  the data cannot tell it from {'; '.join([other, *filter(None, told)])}")
    for other in effect["plainer_than"]:
        told = [shift_in_words(result, number, other)]
        why = "would explain it with more parameters, the plainer one is taken"
        out.print(f"  {'; '.join([f'{other} {why}', *filter(None, told)])}")


def _gap(result: Mapping[str, Any], out: Console) -> None:
    gap, simulated = result["gap"], result["simulation"]
    if not effects_of(result):
        return
    if any(fold["confirmable"] for fold in gap["held_out"]):
        rms = [quantity(gap[f"{when}_rms"], gap["unit"]) for when in ("before", "after")]
        out.print(
            f"Gap on readings not used: reduced chi-square {gap['before']:.2f} before, {gap['after']:.2f} after "
            f"(noise alone: 1; {p_in_words(gap['p_after'], 2)} after); residuals {rms[0]} before, {rms[1]} after"
        )
    blind = [fold["what"] for fold in gap["held_out"] if not fold["confirmable"]]
    if blind:
        out.print(f"  not counted, as without it the rest could not have shown it: {', '.join(blind)}")
    if simulated["after"] is not None and simulated["after"]["p"] is not None:
        p = [simulated[when]["p"] for when in ("after", "before")]
        told = [p_in_words(one, 2) for one in p]
        out.print(typeset(f"Simulated bench beside the readings: {told[0]} with it, {told[1]} without"))
        if p[0] < FITS:
            out.print(f"  {STILL_MISSING}")
    for line in joined_in_words(result):
        out.print(f"  {typeset(line)}")


def _consequence(result: Mapping[str, Any], out: Console) -> None:
    rows = [
        (name, told, (told["after"] - told["before"]) / told["u_before"] if told["u_before"] else 0.0)
        for name, told in result["coefficients"].items()
    ]
    changed = sorted((row for row in rows if abs(row[2]) >= LISTED_SHIFT), key=lambda row: -abs(row[2]))
    if result["simulation"]["after"] is None or not changed:
        return
    told = ", ".join(f"{name} by {shift:+.1f} u" for name, _, shift in changed)
    out.print(typeset(f"Coefficients that change, in units of u before: {told}"))
    wider = less_certain(result)
    if wider:
        out.print(f"  less certain with it: {', '.join(wider)}")


def _limits_of_sight(result: Mapping[str, Any], out: Console) -> None:
    following = result["next_measurement"]
    if following is not None:
        out.print(f"Measure next: {following['why']} ({following['procedure']})")
    if result["hidden"]:
        out.print(f"These readings could never show: {', '.join(result['hidden'])}")
    if result["verdict"] == "agrees":
        sizes = [f"{name} {size}" for name, size in smallest_found(result)]
        out.print(f"Smaller effects would not show. Found in half of all runs: {'; '.join(sizes)}")


def _files(result: Mapping[str, Any], out: Console) -> None:
    for what, file in _written(result):
        out.print(f"{what}: {file}")
    if result["verdict"] == "confounded" and result["model"] is None:
        out.print("no model file is written while the data cannot tell; --accept-first takes the first")


def _written(result: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if result["model"]:
        yield "model", result["model"]
    if result["report"]:
        yield "report", result["report"]
