"""The result of `bench confirm`: the effects of a model tested on new readings, as JSON and as text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from pydantic import Field
from rich.console import Console
from rich.text import Text

from bench.base.languages import message, translated
from bench.base.numbers import rounded, typeset, uncertainty
from bench.base.result_model import Real, ResultModel
from bench.base.tables import print_notes
from bench.diagnosis.confirm import Confirmation, EffectNow, Word
from bench.diagnosis.gap import FLOOR
from bench.diagnosis.result import Verdict
from bench.diagnosis.show import label
from bench.results import diagnosis_words as words
from bench.results.parts import BenchPart, Corrections


class ParameterNow(ResultModel):
    """A parameter of an effect: its value in the model, and its estimate from the new readings alone."""

    parameter: str
    channel: str | None
    value: float = Field(description="value in the model")
    u: float = Field(description="standard uncertainty in the model; 0 if it states none")
    now: float = Field(description="value estimated from the new readings alone")
    u_now: float
    unit: str


class EffectPart(ResultModel):
    """An effect of the model, tested on the new readings."""

    name: str
    either_of: list[str]
    """names between which the diagnosis did not decide; the model has the first"""
    channels: list[str]
    installations: list[str]
    verdict: Word | None = Field(description="verdict on it; null if the new readings cannot show it")
    p_same: float = Field(description="p-value of the hypothesis that the values are those of the model")
    p_none: float = Field(description="p-value of the hypothesis that the effect is absent")
    parameters: list[ParameterNow]


class ConfirmResult(ResultModel):
    """A model tested on new readings: misfit without and with its effects, and the verdict on each effect."""

    closed: Real
    """part of the gap that the model closes: (before - after)/(before - floor); null if `before` is not above
    the floor
    """
    before: Real = Field(description="reduced chi-square of the new readings without the model's effects")
    after: Real = Field(description="reduced chi-square with the model's effects as they are")
    floor: float = Field(description="expected reduced chi-square if no effect is missing")
    p_after: Real = Field(description="p-value of `after`")
    before_rms_ug: Real = Field(description="rms of measured minus predicted without the model's effects, µg")
    after_rms_ug: Real = Field(description="rms of measured minus predicted with the model's effects, µg")
    expected_rms_ug: Real = Field(description="root mean square expected from noise alone, µg")
    before_rms_v: Real = None
    """root mean square without the model's effects, V; for a record at a known input"""
    after_rms_v: Real = None
    verdict: Word
    """`confirmed` if every effect that the readings can show is unchanged (p_same of 0.01 or more) and half
    of the gap closes; `gone` if no effect is present (p_none of 0.01 or more)
    """
    effects: list[EffectPart]
    left: Verdict = Field(description="verdict of a diagnosis of the new readings with the model")
    model: str = Field(description="path of the model file")
    source: str
    bench: BenchPart
    corrections: Corrections
    simulated: bool
    notes: list[str]


def _effect_part(now: EffectNow) -> EffectPart:
    applied = now.applied
    return EffectPart.from_object(
        now,
        applied,
        name=applied.effect.name,
        parameters=[
            ParameterNow.from_object(was, channel=was.channel or None, now=here.value, u_now=here.u)
            for was, here in zip(now.found, now.now, strict=True)
        ],
    )


def confirm_result(found: Confirmation, **made_from: Any) -> ConfirmResult:
    """Return the result of a model's test; `made_from` has the fields of `ConfirmResult` from `model` on."""
    in_g, in_v = found.unit == "g", found.unit == "V"
    return ConfirmResult.from_object(
        found,
        before=found.before.reduced,
        after=found.after.reduced,
        floor=FLOOR,
        before_rms_ug=1e6 * found.before.rms_g if in_g else None,
        after_rms_ug=1e6 * found.after.rms_g if in_g else None,
        expected_rms_ug=1e6 * found.after.expected_rms_g if in_g else None,
        before_rms_v=found.before.rms_g if in_v else None,
        after_rms_v=found.after.rms_g if in_v else None,
        effects=[_effect_part(effect) for effect in found.effects],
        left=found.diagnosis.verdict,
        **made_from,
    )


def print_confirmation(source: str, found: Confirmation, notes: Sequence[str], out: Console) -> None:
    """Print notes, the verdict on each effect, and how far the model reduces the misfit of the readings."""
    print_notes(out, notes)
    for effect in found.effects:
        for line in effect_now_in_words(effect):
            out.print(line)
    out.print(
        message(
            f"Reduced chi-square {found.before.reduced:.2f} without the model, {found.after.reduced:.2f} with "
            f"it (noise alone: 1; {typeset(words.p_in_words(found.p_after, 2))} with it)"
        )
    )
    # if values changed, effects found beside the model merely compensate for its wrong values
    left = words.alike_in_words(found.diagnosis.effects)
    if left and found.verdict == "confirmed":
        out.print(
            message(
                f"These readings also contain another effect: {left}; 'bench diagnose' with this model names it"
            )
        )
    closed = words.closed_in_words(
        found.closed, found.before.rms_g, found.after.rms_g, found.after.expected_rms_g, found.unit
    )
    ties = dict.fromkeys(map(either_in_words, found.effects))
    told = "; ".join([*filter(None, ties), closed])
    line = f"{source}: {translated(VERDICTS[found.verdict]).upper()}: {translated(told)}"
    out.print(Text(line), style="bold")


VERDICTS: Final[dict[Word, str]] = {
    "confirmed": message("confirmed"),
    "changed": message("changed"),
    "gone": message("gone"),
}
"""The words for each verdict."""


def either_in_words(effect: EffectNow) -> str:
    """Return the possible names of an ambiguous effect, "either of A or B"; "" if it has only one name."""
    names = effect.applied.either_of
    return message(f"either of {', '.join(names[:-1])} or {names[-1]}") if len(names) > 1 else ""


def effect_now_in_words(effect: EffectNow) -> Iterator[str]:
    """Yield lines on an effect in new readings: its verdict, and each value in the model and in these readings."""
    name = either_in_words(effect) or label(effect.applied)
    if effect.verdict is None:
        yield message(f"{translated(name)}: these readings do not show it")
        return
    chances = message(
        f"{words.p_in_words(effect.p_same)} of the same values, {words.p_in_words(effect.p_none)} of none"
    )
    yield f"{translated(name)}: {translated(VERDICTS[effect.verdict])} ({translated(typeset(chances))})"
    for was, now in zip(effect.found, effect.now, strict=True):
        of = f" of {was.channel}" if was.channel else ""
        u = "" if not was.u else f" ± {uncertainty(was.u)}"
        then = words.with_unit(f"{rounded(was.value, was.u or now.u or 1.0)}{u}", was.unit)
        here = words.with_u(now.value, now.u or 0.0, now.unit)
        yield message(f"  {was.parameter}{of} = {then} in the model, {here} in these readings")
