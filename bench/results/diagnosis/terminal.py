"""A diagnosis as text in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from rich.console import Console
from rich.table import Table

from bench.base.computing import quiet
from bench.base.numbers import concise, quantity, typeset
from bench.diagnosis import Diagnosis, NamedEffect
from bench.diagnosis.full import FullDiagnosis, Rival, TooLittleLeft
from bench.diagnosis.residual_search import UNNAMED_FORM
from bench.diagnosis.show import Shown
from bench.model import CATALOGUE
from bench.results.diagnosis import words
from bench.results.diagnosis.words import form_in_words

LISTED_PLACES: Final = 6
LISTED_SHIFT: Final = 0.5
"""A change of a coefficient below this part of its u is not worth a line."""


def print_one(full: FullDiagnosis, out: Console) -> None:
    """Print one diagnosis in the order in which it was made."""
    diagnosis, shown = full.diagnosis, full.shown
    _notes(full, "", out)
    _mistakes(diagnosis, out)
    _places(diagnosis, out)
    for number, effect in enumerate(diagnosis.effects):
        _effect(effect, full.rivals_of(number), out)
    _form(full, out)
    if diagnosis.effects:
        _gap(diagnosis, shown, out)
    if full.blocks:
        _blocks(full, out)
    elif shown.after is not None:
        _consequence(shown, out)
    _limits_of_sight(full, out)
    _files(full, out)
    lead = words.lead(diagnosis).upper()
    out.print(f"{full.source}: {lead}: {typeset(words.verdict_in_words(diagnosis))}", style="bold")


def print_several(results: Sequence[FullDiagnosis], out: Console) -> None:
    """Print a line for each of several diagnoses."""
    table = Table(box=None, pad_edge=False)
    for heading, side in (
        ("source", "left"), ("verdict", "left"), ("what", "left"), ("p, all looks", "right"),
        ("gap before", "right"), ("after", "right"), ("model", "left"),
    ):  # fmt: skip
        table.add_column(heading, justify=side)  # type: ignore[arg-type]
    for full in results:
        diagnosis, gap = full.diagnosis, full.diagnosis.gap
        mistakes = diagnosis.mistakes.mistakes
        looks = [*(one.p for one in mistakes), *(one.p_all_looks for one in diagnosis.effects)]
        table.add_row(
            full.source,
            diagnosis.verdict,
            words.alike_in_words([*mistakes, *diagnosis.effects]) or "nothing",
            typeset(words.p_in_column(min(looks))) if looks else "",
            *(f"{size:.2f}" if gap.opened else "–" for size in (gap.before, gap.after)),
            str(full.model or ""),
        )
    for full in results:
        _notes(full, f"{full.source}: ", out)
    out.print(table)
    out.print("gap: reduced chi-square of readings held out, 1 is noise alone")
    for full in results:
        if full.report:
            out.print(f"report: {full.report}")


def _notes(full: FullDiagnosis, lead: str, out: Console) -> None:
    for note in full.diagnosis.notes:
        if not quiet.get():
            out.print(f"note: {lead}{note}")
    for row in full.skipped_rows:
        out.print(f"left out: {row}")


def _places(diagnosis: Diagnosis, out: Console) -> None:
    if not diagnosis.where:
        out.print("Readings and model disagree nowhere: no pattern of the residuals stands out of the noise")
        return
    out.print("Where readings and model disagree, the largest first:")
    for place in diagnosis.where[:LISTED_PLACES]:
        out.print(f"  {typeset(words.place_in_words(place))}")
    more = len(diagnosis.where) - LISTED_PLACES
    if more > 0:
        out.print(f"  and {more} more")


def print_mistakes(found: TooLittleLeft, source: str, out: Console) -> None:
    """Print mistakes that leave too little to fit anything, and what is missing."""
    for mistake in found.mistakes:
        out.print(f"Mistake: {mistake.name}: {mistake.words}", style="bold")
    out.print(f"Put right in a copy, {found.reason}")
    if found.copy is not None:
        out.print(f"corrected copy of the readings: {found.copy}")
    names = ", ".join(dict.fromkeys(mistake.name for mistake in found.mistakes))
    lead = words.LEAD["mistake"].upper()
    out.print(f"{source}: {lead}: {names}; put it right and measure again what is missing", style="bold")


def _mistakes(diagnosis: Diagnosis, out: Console) -> None:
    for mistake in diagnosis.mistakes.mistakes:
        out.print(f"Mistake: {mistake.name}: {mistake.words}", style="bold")
        out.print("  what follows is from a copy with it put right; the record is as it was")
    if diagnosis.mistakes.mistakes:
        used = len(diagnosis.mistakes.corrected)
        out.print(f"Put right, {used} readings are searched")


def _effect(effect: NamedEffect, ranking: Sequence[Rival], out: Console) -> None:
    out.print(f"Found: {words.effect_title(effect)}", style="bold")
    out.print(f"  {effect.words}")
    for line in words.parameters_in_words(effect):
        out.print(f"  {line}")
    if effect.aliases:
        orders = words.orders_in_words(effect.aliases)
        out.print(f"  at the angles measured what repeats {orders} times a turn would look the same")
    rho = f", {effect.rho:.1f} times the noise in all (rho)" if effect.rho is not None else ""
    out.print(typeset(f"  {words.p_in_words(effect.p_all_looks)} with all looks counted{rho}"))
    for other in effect.cannot_tell_from:
        parts = [other, words.shift_in_words(ranking, other)]
        if other in CATALOGUE:
            parts.append(f"to tell them apart: {CATALOGUE[other].shown_by}")
        if other == UNNAMED_FORM:
            parts.append("something without a name, of another form, is as plausible")
        out.print(f"  the data cannot tell it from {'; '.join(filter(None, parts))}")
    for other in effect.plainer_than:
        why = "would explain it with more parameters, the plainer one is taken"
        parts = [f"{other} {why}", words.shift_in_words(ranking, other)]
        out.print(f"  {'; '.join(filter(None, parts))}")


def _form(full: FullDiagnosis, out: Console) -> None:
    lines = list(form_in_words(full.diagnosis))
    if not lines:
        return
    out.print("The form of what has no name:", style="bold")
    for line in lines:
        out.print(f"  {typeset(line)}")
    if full.diagnosis.form is not None and full.diagnosis.form.applied and full.model is not None:
        out.print(f"  to give it a name: bench accept {full.model} --name NAME --sentence TEXT")


def _gap(diagnosis: Diagnosis, shown: Shown, out: Console) -> None:
    gap, after = diagnosis.gap, shown.after
    if gap.opened:
        told = words.closed_in_words(gap.closed, gap.before_rms_g, gap.after_rms_g, gap.expected_rms_g)
        out.print(
            f"{told[0].upper()}{told[1:]}, on readings not used: reduced chi-square {gap.before:.2f} before, "
            f"{gap.after:.2f} after (noise alone: 1; {words.p_in_words(gap.p_after, 2)} after); residuals "
            f"{quantity(gap.before_rms, gap.unit)} before, {quantity(gap.after_rms, gap.unit)} after"
        )
    for line in words.left_out_in_words(gap):
        out.print(f"  not counted: {line}")
    if gap.reason:
        out.print(f"  not confirmed: {gap.reason}")
    if after is not None and after.tested:
        with_it, without = (words.p_in_words(one.test.p, 2) for one in (after, shown.before))
        out.print(
            typeset(
                f"Simulated bench against the readings, by the scatter of their own repeats: {with_it} with it, "
                f"{without} without"
            )
        )
        if diagnosis.findings:
            out.print(f"  {words.LOUD_REPEATS}")
        if words.still_missing(shown):
            out.print(f"  {words.STILL_MISSING}")
    for line in words.joined_in_words(shown):
        out.print(f"  {typeset(line)}")


def _consequence(shown: Shown, out: Console) -> None:
    coefficients = shown.coefficients
    changed = [(name, one.in_u) for name, one in coefficients.items() if abs(one.in_u) >= LISTED_SHIFT]
    if not changed:
        return
    changed.sort(key=lambda pair: -abs(pair[1]))
    shifts = ", ".join(f"{name} by {in_u:+.1f} u" for name, in_u in changed)
    out.print(typeset(f"Coefficients that change, in units of u before: {shifts}"))
    wider = words.less_certain(coefficients)
    if wider:
        out.print(f"  less certain with it: {', '.join(wider)}")


def _blocks(full: FullDiagnosis, out: Console) -> None:
    """Print the coefficients of each block; what is the stand's and the meters' was told once, for all."""
    changed = any(block.after is not None for block in full.blocks)
    out.print(f"Coefficients of each block{', with what was found' if changed else ''}; in brackets u:")
    table = Table(box=None, pad_edge=False)
    names = list(full.blocks[0].coefficients)
    for heading in ("block", *names, "p"):
        table.add_column(heading, justify="left" if heading == "block" else "right")
    for number, block in enumerate(full.blocks, start=1):
        values = [concise(one.after, one.u_after) for one in block.coefficients.values()]
        p = typeset(words.p_in_column(block.last.test.p, 2)) if block.last.tested else "–"
        table.add_row(f"{number}: {words.mountings_of(block)}", *values, p)
    out.print(table)
    out.print("p: of the simulated bench against the readings of the block, by the scatter of their repeats")


def _limits_of_sight(full: FullDiagnosis, out: Console) -> None:
    diagnosis, proposal = full.diagnosis, full.next_measurement
    if proposal is not None:
        out.print(f"Measure next: {proposal.why} ({proposal.procedure})")
    if diagnosis.hidden:
        out.print(f"These readings could never show: {', '.join(diagnosis.hidden)}")
    if diagnosis.unseen_per_turn:
        out.print(
            "Nor an error of the head's angle that repeats "
            f"{words.orders_in_words(diagnosis.unseen_per_turn)} times a turn: it is the same at all of them"
        )
    if diagnosis.absent:
        reasons = "; ".join(f"{name} ({why})" for name, why in diagnosis.absent.items())
        out.print(f"Not looked for, as the bench has nothing that could: {reasons}")
    if diagnosis.verdict == "agrees":
        sizes = [f"{name} {size}" for name, size in words.smallest_found(diagnosis)]
        out.print(f"Smaller effects would not show. Found in half of all runs: {'; '.join(sizes)}")


def _files(full: FullDiagnosis, out: Console) -> None:
    files = (("corrected copy of the readings", full.copy), ("model", full.model), ("report", full.report))
    for what, file in files:
        if file is not None:
            out.print(f"{what}: {file}")
    if full.diagnosis.of_copy == "confounded" and full.model is None:
        out.print(f"no model file is written {words.why_no_model(full.diagnosis)}")
