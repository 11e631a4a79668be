"""The result of `bench diagnose` as JSON and as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.text import Text

from bench.base.languages import local_number, message, translated
from bench.base.numbers import concise, quantity, typeset
from bench.base.result_model import Real, ResultModel, Vector
from bench.base.tables import print_notes, table
from bench.base.text import as_typed
from bench.diagnosis import Diagnosis, NamedEffect
from bench.diagnosis.gap import Gap
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.next_measurement import Chance, Separation
from bench.diagnosis.pipeline import FullDiagnosis, MistakesAlone, Rival
from bench.diagnosis.result import UNNAMED_FORM, Findings, Registration, Verdict
from bench.diagnosis.show import SEED, CoefficientChange, ModelComparison, Simulation
from bench.diagnosis.visibility import FarReading, ResidualPattern
from bench.model import CATALOGUE
from bench.results import diagnosis_words as words
from bench.results.diagnosis_parts import (
    CopyPart,
    EffectPart,
    FormPart,
    GapPart,
    NoisePart,
    ResidualsPart,
    compared_residuals,
    form_part,
    gap_part,
    mistake_part,
)
from bench.results.diagnosis_words import Files
from bench.results.form_words import form_in_words
from bench.results.parts import BenchPart, Corrections, by_channel


class OrientationPart(ResultModel):
    """The orientation of the block at the verification points, inferred from the signals."""

    off_deg: float = Field(description="angle between the signals' orientation and the bench file's, deg")
    axis: Vector = Field(description="axis of this turn, in the axes of the block")
    contradicts_bench_file: bool = Field(description="if true, the orientation from the signals is used")


class ProposalPart(ResultModel):
    """A proposal for the next measurement."""

    why: str
    procedure: Path = Field(description="path of the procedure that was written")
    minutes: float
    settles: list[Separation] = Field(description="ties of names that it would resolve")
    shows: list[str] = Field(description="hidden effects that it would show")
    left_out: dict[str, str] = Field(description="procedures that this bench cannot carry out, and why")
    chances: list[Chance] = Field(default=[])
    """for each procedure considered, its duration in hours, and the probability that one name of each tie
    then has a posterior of 0.95
    """


class ModulusPart(ResultModel):
    """The error of the measured |a| at a verification point, where the true |a| is 1 g."""

    angle_deg: float
    pass_number: int = Field(alias="pass")
    point: int
    delta_g: Real = Field(description="error of the modulus, g")
    u: Real = Field(description="standard uncertainty of the error, g")


class SimulationPart(ResultModel):
    """A comparison of the readings with a simulation; `chi2` and `p` are null without enough repeats."""

    chi2: Real
    dof: int | float
    p: Real = Field(description="p-value of the readings under the model")
    rms: Real = Field(description="root mean square of the residuals")
    rms_of_a_simulated_run: Real
    seed: int
    verification_joined: bool = Field(description="whether the verification points joined the fit")
    delta_g: list[ModulusPart]


class SimulationsPart(ResultModel):
    """Simulations by the given model, first without and then with the effects found."""

    before: SimulationPart
    after: SimulationPart | None


class ShiftPart(ResultModel):
    """The change of a coefficient if another effect replaces the one found, in units of its u."""

    coefficient: str
    in_u: Real


class RivalPart(ResultModel):
    """An effect, in any of its forms, that may explain the readings in place of an effect that was found."""

    name: str
    ln_odds: float = Field(description="ln of the odds that this family is present")
    tied: bool = Field(description="whether the data cannot distinguish this family from the effect found")
    largest_shift: ShiftPart = Field(description="coefficient that changes most if it replaces the effect")


Coefficients = Annotated[
    dict[str, CoefficientChange],
    Field(
        description="the twelve coefficients, in the order `Kxx`, `Kxy`, … `Kzz`, `U0x`, `U0y`, `U0z`, by the "
        "model before and after"
    ),
]


class BlockPart(ResultModel):
    """The coefficients of one block in a diagnosis of several blocks."""

    mountings: list[str]
    coefficients: Coefficients
    p_before: Real = Field(description="p-value of the block's readings under the given model")
    p_after: Real = Field(description="p-value with the effects found; null if none was found")


class FoundResult(ResultModel):
    """The findings of a diagnosis."""

    verdict: Verdict = Field(description="the first that applies of mistake, unknown, confounded and named")
    where: list[ResidualPattern] = Field(description="significant patterns in the residuals, largest first")
    effects: list[EffectPart] = Field(description="effects found, in the order of their addition")
    hidden: list[str] = Field(description="effects that these readings cannot show at any size")
    hidden_parts: dict[str, list[str]] = Field(description="parameters that these readings cannot show")
    absent: dict[str, str]
    """effects that were excluded because this bench cannot have them, and why"""
    far: list[FarReading]
    """readings 6 u or more from the prediction by the others in the final model, farthest first; `p` is the
    probability that noise alone gives as much in any reading
    """
    unseen_per_turn: list[int]
    """numbers of periods per turn at which an error of the head's angle is the same at all angles measured"""
    verification_orientation: OrientationPart | None
    """orientation of the block at the verification points; null if unknown"""
    gap: GapPart | None
    """reduced chi-square of readings that were held out of the fit; null if none were held out, or if
    mistakes leave too few readings to fit
    """
    noise: NoisePart | None = Field(description="noise of the readings; null if mistakes leave too few")
    p_left: Real = Field(description="p-value of the final residuals, compared with the scatter of repeats")
    form: FormPart | None
    """terms that describe the effects without a name, their predictions of held-out readings, and the
    unexplained scatter; null if every effect has a name
    """
    detectable: dict[str, Real]
    """size of each effect that half of all runs would show, in units of its plausible size; null if no run
    shows it
    """
    registered: Registration | None
    """settings fixed before the readings were examined (threshold, grids, levels) and their hash; null if
    mistakes leave too few readings to fit
    """
    notes: list[str]


class DiagnoseResult(FoundResult):
    """A diagnosis: where model and readings disagree, the missing effect, and its test on held-out readings.

    For several sources, the output of `bench diagnose --json` is a list of these; a source that could not be
    evaluated has a `source-failed` object in its place.
    """

    next_measurement: ProposalPart | None
    """measurement that would break a tie or show a hidden effect; null if none is proposed"""
    model: Path | None = Field(description="path of the model file; null if none was written")
    simulation: SimulationsPart | None
    """comparison with simulated readings; null if mistakes leave too few readings to fit"""
    coefficients: Coefficients
    ranking: list[list[RivalPart]]
    """for each effect found, the families that may be present instead, most plausible first"""
    source: str
    simulated: bool
    skipped_rows: list[str]
    report: Path | None = Field(description="path of the page; null if none was written")
    bench: BenchPart | None
    corrections: Corrections
    corrected: CopyPart | None
    """copy of the readings with the mistakes corrected, from which all members except the mistakes follow;
    null if there is none
    """
    residuals: ResidualsPart | None = None
    """residuals of each fitted reading; of the first block if there are several"""
    blocks: list[BlockPart] = Field(default=[])
    """each block of readings of several blocks; `coefficients` and `simulation` are those of the first"""


def found_result(found: Diagnosis) -> FoundResult:
    """Return the part of the result on the findings of a diagnosis."""
    turned = found.linear.orientation
    return FoundResult.from_object(
        found,
        effects=[*map(mistake_part, found.mistakes.mistakes), *found.effects],
        hidden=list(found.hidden),
        hidden_parts={name: list(parts) for name, parts in found.hidden.items() if parts},
        verification_orientation=turned
        and OrientationPart(
            off_deg=float(np.degrees(turned.off_rad)),
            axis=turned.axis,
            contradicts_bench_file=turned.contradicts,
        ),
        gap=gap_part(found.gap),
        noise=NoisePart.from_object(
            found.noise,
            dof=found.noise.freedom,
            channels=by_channel(found.noise_by_channel),
            kinds=found.noise_kinds,
            findings=found.findings,
        ),
        form=found.form and form_part(found.form),
    )


def result_of(full: FullDiagnosis | MistakesAlone, files: Files, **made_from: Any) -> DiagnoseResult:
    """Return the result of a diagnosis; `files` are the files that were written.

    Of `made_from`, only `bench` and `corrections` are used; all else is from the diagnosis.
    """
    of_source = {name: made_from[name] for name in ("bench", "corrections")}
    if isinstance(full, MistakesAlone):
        return _of_mistakes(full, files, of_source)
    diagnosis, shown, mistakes = full.diagnosis, full.shown, full.diagnosis.mistakes
    blocks = [_block_part(one) for one in full.blocks]
    return DiagnoseResult(
        **dict(found_result(diagnosis)),
        source=full.source,
        simulated=full.simulated,
        skipped_rows=list(full.skipped_rows),
        next_measurement=full.next_measurement,
        model=files.model,
        simulation=SimulationsPart(
            before=_simulation_part(shown.before),
            after=None if shown.after is None else _simulation_part(shown.after),
        ),
        coefficients=shown.coefficients,
        ranking=[[_rival_part(rival) for rival in one] for one in full.ranking],
        report=files.report,
        corrected=_copy_part(files, mistakes.mistakes, len(mistakes.corrected), diagnosis.of_copy)
        if mistakes.mistakes
        else None,
        **of_source,
        **({"blocks": blocks} if blocks else {}),
        **({"residuals": compared_residuals(shown)} if len(shown.before.calibration.fitted) else {}),
    )


def _of_mistakes(found: MistakesAlone, files: Files, of_source: dict[str, Any]) -> DiagnoseResult:
    """Return the result of a diagnosis that found only mistakes: the other readings are too few to fit."""
    nothing: dict[str, Any] = {
        **dict.fromkeys(("next_measurement", "verification_orientation", "gap", "model", "noise", "p_left")),
        **dict.fromkeys(("form", "registered", "simulation", "report")),
        **dict.fromkeys(("far", "where", "hidden", "unseen_per_turn", "ranking", "skipped_rows"), ()),
        **{name: {} for name in ("hidden_parts", "absent", "detectable", "coefficients")},
    }
    return DiagnoseResult.from_object(
        found,
        verdict="mistake",
        effects=[mistake_part(mistake) for mistake in found.mistakes],
        notes=[message(f"in the corrected copy {found.reason}")],
        corrected=_copy_part(files, found.mistakes, len(found.corrected), None),
        **of_source,
        **nothing,
    )


def _simulation_part(one: Simulation) -> SimulationPart:
    return SimulationPart.from_object(
        one.test,
        rms_of_a_simulated_run=one.repeated.lack_of_fit.rms,
        seed=SEED,
        verification_joined=one.joined,
        delta_g=one.points,
    )


def _rival_part(rival: Rival) -> RivalPart:
    coefficient, in_u = rival.largest_shift
    return RivalPart(
        name=rival.family,
        ln_odds=rival.evidence,
        tied=rival.tied,
        largest_shift=ShiftPart(coefficient=coefficient, in_u=in_u),
    )


def _copy_part(files: Files, mistakes: Sequence[Mistake], used: int, verdict: Verdict | None) -> CopyPart:
    return CopyPart(
        readings=files.copy,
        used=used,
        verdict=verdict,
        rests_on=[mistake.words for mistake in mistakes],
    )


def _block_part(shown: ModelComparison) -> BlockPart:
    return BlockPart(
        mountings=[str(mount) for mount in shown.before.calibration.fitted.conditions().mounts],
        coefficients=shown.coefficients,
        p_before=shown.before.test.p,
        p_after=None if shown.after is None else shown.after.test.p,
    )


# --- text for the terminal ----------------------------------------------------------------------

LISTED_SHIFT: Final = 0.5
"""Smallest change of a coefficient, in units of its u, that is printed."""


def print_found(full: FullDiagnosis | MistakesAlone, files: Files, out: Console) -> None:
    """Print one diagnosis, in the order of its steps."""
    if isinstance(full, MistakesAlone):
        _print_mistakes(full, files, out)
        return
    diagnosis, shown = full.diagnosis, full.shown
    _notes(full, "", out)
    _mistakes(diagnosis, out)
    _places(diagnosis, out)
    for number, effect in enumerate(diagnosis.effects):
        print_effect(effect, full.rivals_of(number), out)
    _form(full.diagnosis, files.model, out)
    if diagnosis.effects:
        print_gap(diagnosis.gap, out)
        _simulated(diagnosis, shown, out)
    if full.blocks:
        _blocks(full, out)
    elif shown.after is not None:
        _consequence(shown, out)
    _limits_of_sight(full, out)
    print_files(full.diagnosis, files, out)
    what, *then = words.verdict_in_words(diagnosis)
    surer = words.surer_in_words(full.next_measurement)
    print_verdict(full.source, diagnosis, what, [*then, surer], out)


def print_verdict(source: str, found: Findings, what: str, then: Iterable[str], out: Console) -> None:
    """Print the last line of a diagnosis: its source, its verdict, `what` was found, and the clauses `then`."""
    told = [words.by_clause(typeset(what)), *(translated(typeset(clause)) for clause in then if clause)]
    line = f"{source}: {translated(words.lead(found)).upper()}: {'; '.join(told)}"
    out.print(Text(line), style="bold")  # not translated twice, which would translate the name


def print_several(results: Sequence[tuple[FullDiagnosis, Files]], out: Console) -> None:
    """Print a table with a row for each diagnosis, and the files that were written."""
    rows = table("source", "verdict", "what", ">p, corrected", ">gap before", ">after", "model")
    for full, files in results:
        diagnosis, gap = full.diagnosis, full.diagnosis.gap
        mistakes = diagnosis.mistakes.mistakes
        looks = [*(one.p for one in mistakes), *(one.p_all_looks for one in diagnosis.effects)]
        rows.add_row(
            full.source,
            diagnosis.verdict,
            words.alike_in_words([*mistakes, *diagnosis.effects]) or "nothing",
            typeset(words.p_in_column(min(looks))) if looks else "",
            *(f"{size:.2f}" if gap.folds else "–" for size in (gap.before, gap.after)),
            str(files.model or ""),
        )
    for full, _ in results:
        _notes(full, f"{full.source}: ", out)
    out.print(rows)
    out.print(message("gap: reduced chi-square of held-out readings; noise alone gives 1"))
    for _, files in results:
        if files.report:
            out.print(f"report: {files.report}")


def _notes(full: FullDiagnosis, lead: str, out: Console) -> None:
    print_notes(out, full.diagnosis.notes, lead)
    for row in full.skipped_rows:
        out.print(message(f"left out: {row}"))


def _places(diagnosis: Diagnosis, out: Console) -> None:
    if not diagnosis.where:
        out.print(message("No pattern in the residuals (readings minus model) exceeds the noise"))
        return
    out.print(message("Patterns in the residuals (readings minus model), largest first:"))
    for place in diagnosis.where:
        out.print(f"  {typeset(words.place_in_words(place))}")


def _print_mistakes(found: MistakesAlone, files: Files, out: Console) -> None:
    """Print the mistakes of a diagnosis that could go no further, and what must be measured again."""
    for mistake in found.mistakes:
        out.print(message(f"Mistake: {mistake.name}: {words.by_clause(mistake.words)}"), style="bold")
    out.print(message(f"In the corrected copy {found.reason}"))
    if files.copy is not None:
        out.print(message(f"corrected copy of the readings: {files.copy}"))
    names = ", ".join(dict.fromkeys(mistake.name for mistake in found.mistakes))
    lead = translated(words.LEAD["mistake"]).upper()
    told = message(f"{found.source}: {lead}: {names}; correct it and repeat the affected readings")
    out.print(told, style="bold")


def _mistakes(diagnosis: Diagnosis, out: Console) -> None:
    for mistake in diagnosis.mistakes.mistakes:
        out.print(message(f"Mistake: {mistake.name}: {words.by_clause(mistake.words)}"), style="bold")
        out.print(message("  what follows is from a corrected copy; the record is unchanged"))
    if diagnosis.mistakes.mistakes:
        used = len(diagnosis.mistakes.corrected)
        out.print(message(f"The search used the {used} readings of the corrected copy"))


def print_effect(effect: NamedEffect, ranking: Sequence[Rival], out: Console) -> None:
    """Print an effect that was found: values, probability, and the effects that these readings cannot rule out."""
    out.print(message(f"Found: {words.effect_title(effect)}"), style="bold")
    out.print(typeset(f"  {words.by_clause(effect.words)}"))
    for line in words.parameters_in_words(effect):
        out.print(f"  {line}")
    if effect.aliases:
        orders = words.orders_in_words(effect.aliases)
        out.print(
            message(f"  at the measured angles, an error that repeats {orders} times a turn looks the same")
        )
    if effect.odds:
        out.print(message(f"  probability: {words.odds_in_words(effect)}"))
    out.print(typeset(f"  {words.significance_in_words(effect)}"))
    if effect.cannot_tell_from:
        out.print(message(f"  tie: these readings cannot separate {effect.name} from"))
        tied = table("   effect", *map(translated, (message("in that case"), message("to separate them"))))
        for other in effect.cannot_tell_from:
            told = CATALOGUE[other].shown_by if other in CATALOGUE else ""
            told = message("– (any form without a name)") if other == UNNAMED_FORM else told
            change = translated(words.shift_in_words(ranking, other)).removeprefix("in that case ")
            tied.add_row(f"   {other}", change, translated(told))
        out.print(tied)
    for other in effect.plainer_than:
        parts = [
            message(f"{other} explains it too, with more parameters"),
            words.shift_in_words(ranking, other),
            message("the simpler effect is used"),
        ]
        out.print(f"  {'; '.join(filter(None, parts))}")


def _form(diagnosis: Diagnosis, model: Path | None, out: Console) -> None:
    lines = list(form_in_words(diagnosis))
    if not lines:
        return
    out.print(message("Form without a name:"), style="bold")
    for line in lines:
        out.print(f"  {typeset(line)}")
    if diagnosis.form is not None and diagnosis.form.applied and model is not None:
        out.print(message(f"  to give it a name: bench accept {as_typed(model)} --name NAME --sentence TEXT"))


def print_gap(gap: Gap, out: Console) -> None:
    """Print how much the effects found reduce the misfit of held-out readings (the gap)."""
    if gap.folds:
        told = words.closed_in_words(gap.closed, gap.before_rms_g, gap.after_rms_g, gap.expected_rms_g)
        out.print(f"{translated(told[0].upper() + told[1:])}; {translated(words.GAP)}")
        out.print(
            message(
                f"  reduced chi-square {gap.before:.2f} before, {gap.after:.2f} after (noise alone: 1; "
                f"{words.p_in_words(gap.p_after, 2)} after); residuals {quantity(gap.before_rms, gap.unit)} "
                f"before, {quantity(gap.after_rms, gap.unit)} after (rms)"
            )
        )
    if gap.reason:
        out.print(message(f"  not confirmed: {gap.reason}"))


def _simulated(diagnosis: Diagnosis, shown: ModelComparison, out: Console) -> None:
    after = shown.after
    if after is not None and after.tested:
        with_it, without = (words.p_in_words(one.test.p, 2) for one in (after, shown.before))
        out.print(
            typeset(
                message(
                    f"Readings against the simulated bench: {with_it} with the effects found, {without} without "
                    "(compared with the scatter of repeats)"
                )
            )
        )
        if diagnosis.findings:
            out.print(f"  {words.LOUD_REPEATS}")
        if words.still_missing(shown):
            out.print(f"  {words.STILL_MISSING}")
    for line in words.joined_in_words(shown):
        out.print(f"  {typeset(line)}")


def _consequence(shown: ModelComparison, out: Console) -> None:
    coefficients = shown.coefficients
    changed = [(name, one.in_u) for name, one in coefficients.items() if abs(one.in_u) >= LISTED_SHIFT]
    if not changed:
        return
    changed.sort(key=lambda pair: -abs(pair[1]))
    shifts = ", ".join(f"{name} {local_number(f'{in_u:+.1f} u')}" for name, in_u in changed)
    out.print(typeset(message(f"Change of the coefficients, in units of u with the given model: {shifts}")))
    wider = words.less_certain(coefficients)
    if wider:
        out.print(message(f"  larger u with the effects found: {', '.join(map(translated, wider))}"))


SIDE_BY_SIDE: Final = 4
"""Blocks in a table: their values fit on a line."""


def _blocks(full: FullDiagnosis, out: Console) -> None:
    changed = any(block.after is not None for block in full.blocks)
    out.print(
        message(f"Coefficients of each block{', with the effects found' if changed else ''}; u in brackets:")
    )
    numbered = list(enumerate(full.blocks, start=1))
    for first in range(0, len(numbered), SIDE_BY_SIDE):
        shown = numbered[first : first + SIDE_BY_SIDE]
        rows = table("", *(f">{number}: {words.mountings_of(block)}" for number, block in shown))
        for name in full.blocks[0].coefficients:
            values = [block.coefficients[name] for _, block in shown]
            rows.add_row(name, *(concise(one.after, one.u_after) for one in values))
        tests = [block.last for _, block in shown]
        rows.add_row("p", *(typeset(words.p_in_column(of.test.p, 2)) if of.tested else "–" for of in tests))
        out.print(rows)
    out.print(
        message("p: readings of the block against the simulated bench, compared with the scatter of repeats")
    )


def _limits_of_sight(full: FullDiagnosis, out: Console) -> None:
    diagnosis, proposal = full.diagnosis, full.next_measurement
    if proposal is not None:
        out.print(message(f"Measure next: {translated(proposal.why)} ({proposal.procedure})"))
    if diagnosis.hidden:
        hidden = ", ".join(diagnosis.hidden)
        out.print(message(f"Hidden (these readings cannot show them at any size): {hidden}"))
    if diagnosis.unseen_per_turn:
        out.print(
            message(
                "Also hidden: an error of the head's angle that repeats "
                f"{words.orders_in_words(diagnosis.unseen_per_turn)} times a turn (equal at all measured angles)"
            )
        )
    if diagnosis.absent:
        out.print(message("Not searched:"))
        for why, names in words.absent_by_reason(diagnosis.absent):
            out.print(f"  {', '.join(names)}: {why}")
    if diagnosis.verdict == "agrees":
        sizes = words.smallest_found(diagnosis)
        out.print(
            message(
                "Size that half of all such runs would find where the effect shows best; in other channels, "
                "installations or forms a larger effect may be missed:"
            )
        )
        listed = table("  effect", "size", "effect", "size")
        half = (len(sizes) + 1) // 2
        for left, right in zip_longest(sizes[:half], sizes[half:], fillvalue=("", "")):
            listed.add_row(f"  {left[0]}", translated(left[1]), right[0], translated(right[1]))
        out.print(listed)


def print_files(diagnosis: Findings, files: Files, out: Console) -> None:
    """Print the files that were written; for the verdict "confounded", also why there is no model file."""
    report = () if files.report is None else (files.report,)
    told = {message("corrected copy of the readings"): files.copies, "model": files.models, "report": report}
    for what, paths in told.items():
        for file in paths:
            out.print(f"{what}: {file}")
    if diagnosis.of_copy == "confounded" and files.model is None:
        out.print(message(f"no model file was written {words.why_no_model(diagnosis)}"))
