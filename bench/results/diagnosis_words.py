"""Sentences on a diagnosis, shared by page and terminal; the gap is the misfit of held-out readings."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from bench.base.languages import message, translated
from bench.base.numbers import fixed, quantity, rounded, two_digits, uncertainty
from bench.base.text import LISTED_IN_SENTENCE, as_typed
from bench.diagnosis.gap import Gap
from bench.diagnosis.levels import BY_CHANCE
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.next_measurement import Proposal
from bench.diagnosis.pipeline import FullDiagnosis, Rival
from bench.diagnosis.result import (
    UNNAMED_WORDS,
    Diagnosis,
    EffectValue,
    Findings,
    FreeForm,
    NamedEffect,
)
from bench.diagnosis.show import CoefficientChange, ModelComparison, label
from bench.diagnosis.visibility import ResidualPattern
from bench.model.effects import CATALOGUE

if TYPE_CHECKING:
    from bench.diagnosis.free_records import FreeDiagnosis
    from bench.diagnosis.record_diagnosis import RecordDiagnosis


@dataclass(frozen=True)
class Files:
    """The files written for a diagnosis: corrected copies, model files (one for each sensor), and the page."""

    copies: tuple[Path, ...] = ()
    models: tuple[Path, ...] = ()
    report: Path | None = None

    @property
    def copy(self) -> Path | None:
        """The first corrected copy; None if there is none."""
        return next(iter(self.copies), None)

    @property
    def model(self) -> Path | None:
        """The first model file; None if there is none."""
        return next(iter(self.models), None)


NO_FILES: Final = Files()

UNITS: Final = (("ug", "µg"), ("uV", "µV"), ("^2", "²"), ("^3", "³"), ("arcsec", "″"))
"""Units as files spell them, and their printed form."""

WHOLE_UG: Final = 9.95
"""Smallest size in µg that is printed without decimals."""

MUCH_LESS_CERTAIN: Final = 2.0
"""Coefficients whose u grows by more than this factor are listed."""

LEAST_P: Final = 1e-9
"""Smallest probability that is stated: below it, the noise would have to be normal far into its tails."""

STILL_MISSING: Final = message(
    "readings and simulated bench still differ by more than the scatter of repeats (level 1 %): "
    "the model may lack a small effect"
)


GAP: Final = message("gap: misfit of held-out readings (the fit does not use them)")
"""The meaning of "gap", for its first use on the terminal."""

LOUD_REPEATS: Final = message(
    "the scatter of repeats is larger than stated; this test does not show the cause"
)


_CLAUSE: Final = re.compile(r"; (?![^(]*\))")
"""What separates clauses, outside brackets."""
_OF_CHANNELS: Final = re.compile(r"(.*) of ([xyz](?:, [xyz])*)")


def by_clause(text: str) -> str:
    """Return a text of a diagnosis in the current language, each clause by itself."""
    return "; ".join(map(_clause, _CLAUSE.split(text)))


def _clause(text: str) -> str:
    """Return a clause; without a translation, a bracket or channels at its end are translated by themselves."""
    said = translated(text)
    if (said == text or "; " in text) and (found := re.fullmatch(r"(.*?) \((.*)\)", text)):
        return f"{_clause(found[1])} ({by_clause(found[2])})"
    if said == text and (found := _OF_CHANNELS.fullmatch(text)) and translated(found[1]) != found[1]:
        return f"{translated(found[1])}, {translated(message(f'channel {found[2]}'))}"
    return said


def sentence(text: str) -> str:
    """Return `by_clause` of a text, beginning with a capital letter."""
    said = by_clause(text)
    return said[:1].upper() + said[1:]


def unit_in_print(unit: str) -> str:
    """Return the printed form of a unit: "ug/g^2" -> "µg/g²"."""
    for written, printed in UNITS:
        unit = unit.replace(written, printed)
    return unit


def with_unit(number: str, unit: str) -> str:
    """Return a number with its printed unit: "58 µg/g²", "8.1″"; without unit if that is "1"."""
    printed = unit_in_print(unit)
    if printed == "1":
        return number
    return f"{number}{printed}" if printed == "″" else f"{number} {printed}"


def effect_title(effect: NamedEffect | Mistake) -> str:
    """Return the name of an effect with its channels and installations: "quadratic_nonlinearity of y"."""
    title = effect.name
    entry = CATALOGUE.get(title)
    of_channels = entry is None or any(parameter.per_channel for parameter in entry.parameters)
    if effect.channels and of_channels:
        title += f" of {', '.join(effect.channels)}"
    return placed(title, effect.installations)


def placed(what: str, names: Sequence[str]) -> str:
    """Return `what` with its place: "… in installations 1, 2" or, in free positions, "… in sensor 2"."""
    listed = ", ".join(names)
    if not names:
        return what
    if listed.startswith("sensor "):
        return message(f"{what} in sensor {listed.removeprefix('sensor ')}")
    return message(f"{what} in installation{'s' if len(names) > 1 else ''} {listed}")


def mistake_title(mistake: Mistake) -> str:
    """Return the name of a mistake with its place: "outlier of z in installation 2, pass 1, point 5"."""
    title, number, point = effect_title(mistake), mistake.pass_number, mistake.point
    if number is not None:
        title += message(f", pass {number}")
    return title if point is None else title + message(f", point {point}")


def parameters_in_words(effect: NamedEffect) -> Iterator[str]:
    """Yield a line for each parameter, such as "K2 of y = 58.1 ± 5.2 µg/g² (u)"."""
    for value in effect.parameters:
        yield parameter_in_words(value, (value.installations,) if value.installations else ())
    for one in effect.together:
        yield message(
            f"{one.combination} of {one.parameter} of {' and '.join(one.of)} = "
            f"{with_u(one.value, one.u, one.unit)}: only this combination is well determined"
        )


def parameter_in_words(value: EffectValue, at: Sequence[str] = ()) -> str:
    """Return a parameter with its value: "K2 of y = 58.1 ± 5.2 µg/g² (u)"; `at` names its installations."""
    if value.u is None:
        size = message(
            f"{with_unit(format(value.value, 'g'), value.unit)} (the likeliest of the values tried)"
        )
    else:
        size = with_u(value.value, value.u, value.unit)
    size = translated(size)
    if value.channel and not at:
        return message(f"{value.parameter} of {value.channel} = {size}")
    of = f" of {value.channel}" if value.channel else ""
    return f"{placed(f'{value.parameter}{of}', at)} = {size}"


def with_u(value: float, u: float, unit: str) -> str:
    """Return a value with its standard uncertainty and unit: "58.1 ± 5.2 µg/g² (u)"."""
    return f"{with_unit(f'{rounded(value, u)} ± {uncertainty(u)}', unit)} (u)"


def p_in_words(p: float, digits: int = 1) -> str:
    """Return a probability in words: "p = 0.003", or "p < 1e-09" below `LEAST_P`."""
    return f"p < {LEAST_P:.0e}" if p < LEAST_P else f"p = {p:.{digits}g}"


def p_in_column(p: float, digits: int = 1) -> str:
    """Return a probability for a column headed p: "0.003", "< 1e-09"."""
    return p_in_words(p, digits).removeprefix("p ").removeprefix("= ")


def significance_in_words(effect: NamedEffect) -> str:
    """Return an effect's p-value, corrected for multiple tests, and rho (joint amplitude over u) if known."""
    p = message(f"{p_in_words(effect.p_all_looks)}, corrected for multiple tests")
    if effect.rho is None:
        return p
    return message(f"{p}; ρ = {effect.rho:.1f} (its total size in units of the noise)")


def absent_by_reason(absent: Mapping[str, str]) -> Iterator[tuple[str, list[str]]]:
    """Yield each reason why effects were not searched for, with the names of these effects."""
    for why in dict.fromkeys(absent.values()):
        yield why, [name for name, other in absent.items() if other == why]


def sentence_of(family: str) -> str:
    """Return the description of the effect or unnamed pattern `family`, a sentence without a full stop."""
    return CATALOGUE[family].sentence if family in CATALOGUE else UNNAMED_WORDS[family]


def place_in_words(place: ResidualPattern) -> str:
    """Return a pattern of residuals as a phrase: its place, description, amplitude and p-value."""
    where = message("verification points") if place.channel == "modulus" else f"channel {place.channel}"
    if place.installation == "all":
        where += message(", whole run")
    elif place.channel != "modulus":
        where = message(f"channel {place.channel}, installation {place.installation}")
    size = quantity(place.size, place.unit)
    pattern = translated(place.pattern)
    return message(f"{where}: {pattern}, {size} ({p_in_words(place.p)}, corrected for multiple tests)")


def smallest_found(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Return each effect that such readings can show, with the amplitude that half of all runs would find.

    The channel, mounting and form that show the effect best count. If an effect has several amplitudes of one unit,
    such as the phases of a wave, the result is their norm in the direction that is hardest to find.
    """
    sizes = []
    for name, factor in diagnosis.detectable.items():
        if not isfinite(factor) or name in diagnosis.hidden:
            continue
        if name in diagnosis.smallest:
            told = [
                message(f"{with_unit(two_digits(one.size), one.unit)} in the part that shows")
                if one.part
                else with_unit(two_digits(one.size), one.unit)
                for one in diagnosis.smallest[name]
            ]
            sizes.append((name, " or ".join(told)))
            continue
        parameter = next(p for p in CATALOGUE[name].parameters if not p.is_shape)
        size = factor * parameter.plausible / parameter.si_per_unit
        sizes.append((name, with_unit(two_digits(size), parameter.unit)))
    return sizes


def orders_in_words(orders: Sequence[int]) -> str:
    """Return the first of these `orders` of harmonics (periods per turn): "6, 10, 14, 18, …"."""
    shown = ", ".join(str(order) for order in orders[:LISTED_IN_SENTENCE])
    return f"{shown}, …" if len(orders) > LISTED_IN_SENTENCE else shown


UNCONFIRMED: Final = message("Found, but not confirmed")
"""The words for a verdict "confounded" that is not due to a tie: held-out readings do not confirm the effects."""

LEAD: Final[Mapping[str, str]] = {
    "agrees": message("Nothing found"),
    "mistake": message("A mistake in procedure or wiring"),
    "named": message("Found and named"),
    "confounded": message("Found, but several names fit"),
    "unknown": message("Something unknown"),
}
"""The words for each verdict."""


def lead(diagnosis: Findings) -> str:
    """Return the verdict in a few words."""
    tied = any(effect.cannot_tell_from for effect in diagnosis.effects)
    return LEAD[diagnosis.verdict] if diagnosis.verdict != "confounded" or tied else UNCONFIRMED


def closed_in_words(
    part: float | None, before_g: float, after_g: float, noise_g: float, unit: str = "g"
) -> str:
    """Return how far a gap closes: "gap closed 99 %, from 412 µg to 9.0 µg (noise alone: 8.8 µg)".

    `part` is the closed fraction of the gap in reduced chi-square, which weights each reading by the u of its
    prediction. The root mean squares `before_g` and `after_g` are unweighted: they may rise if the predictions of a
    few held-out readings are uncertain.
    """
    before, after, noise = (
        micro_g(v) if unit == "g" else quantity(v, unit) for v in (before_g, after_g, noise_g)
    )
    sizes = message(f"from {before} to {after} (noise alone: {noise})")
    if part is None:
        return message(f"gap {sizes}, no larger than chance before")
    if part <= 0.0:
        return message(f"gap not closed, {sizes}")
    closed = f"{min(100.0 * part, 100.0):.0f}"
    if after_g > before_g:
        return message(
            f"gap closed {closed} % by chi-square; rms from {before} to {after} "
            f"(noise and u of the prediction: {noise})"
        )
    return message(f"gap closed {closed} %, {sizes}")


def micro_g(value_g: float) -> str:
    """Return an acceleration in g as text in µg: "412 µg", "9.0 µg"."""
    size = 1e6 * value_g
    return f"{size:.0f} µg" if abs(size) >= WHOLE_UG else f"{two_digits(size)} µg"


def gap_in_words(gap: Gap) -> str:
    """Return how far the effects close the gap; "" if no effect is named or no readings were held out."""
    if not (gap.named and gap.folds):
        return ""
    told = closed_in_words(gap.closed, gap.before_rms_g, gap.after_rms_g, gap.expected_rms_g)
    return message(f"{told}, on held-out readings")


def verdict_in_words(diagnosis: Diagnosis) -> list[str]:
    """Return the findings, the gap and the warnings of a diagnosis as clauses of a sentence."""
    told = [what_in_words(diagnosis), gap_of_verdict(diagnosis), *warnings_in_words(diagnosis)]
    return list(filter(None, told))


LIKELY: Final = 0.3
"""Least probability of an answer with which a measurement is recommended as deciding."""


def surer_in_words(proposal: Proposal | None) -> str:
    """Return duration and success probability of the procedure that can decide between names; "" if none."""
    one = None if proposal is None else proposal.surer
    if one is None:
        return ""
    procedure, chance = f"'{one.procedure}' ({one.hours:.1f} h)", _percent(one.answers)
    if one.answers < LIKELY:
        return message(
            f"no procedure is likely to decide: procedure {procedure} leaves one name with a probability of "
            f"only {chance}"
        )
    return message(f"to decide: procedure {procedure} leaves one name with a probability of {chance}")


def warnings_in_words(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield the warnings that follow the verdict: each kind of unusual noise, and readings far from the model.

    A warning on noise is the sentence up to its colon, already in the current language.
    """
    yield from (translated(kind.words).partition(":")[0] for kind in diagnosis.noise_kinds)
    if diagnosis.far:
        listed = "; ".join(one.words for one in diagnosis.far[:LISTED_IN_SENTENCE])
        more = (
            message(f" and {len(diagnosis.far) - LISTED_IN_SENTENCE} more")
            if len(diagnosis.far) > LISTED_IN_SENTENCE
            else ""
        )
        yield message(
            f"far from this model: {listed}{more} (probability that noise alone moves any reading that far: "
            f"{p_in_words(diagnosis.far[0].p)})"
        )


def odds_in_words(effect: NamedEffect) -> str:
    """Return the names with a probability of at least 1 %: "97 % cubic_nonlinearity, 2 % warm_up"."""
    shown = [one for one in effect.odds if one.probability >= BY_CHANCE]
    return ", ".join(f"{_percent(one.probability)} {one.name}" for one in shown)


def _percent(probability: float) -> str:
    """Return a probability in per cent, "> 99 %" above 99.5 %."""
    return "> 99 %" if probability > 0.995 else f"{100 * probability:.0f} %"


def gap_of_verdict(diagnosis: Findings) -> str:
    """Return how far effects close the gap, or why held-out readings do not confirm them; "" for neither."""
    gap = diagnosis.gap
    return gap.reason if diagnosis.of_copy == "confounded" and gap.reason else gap_in_words(gap)


def what_in_words(diagnosis: Diagnosis) -> str:
    """Return the findings as a sentence without a full stop."""
    effects = diagnosis.effects
    match diagnosis.verdict:
        case "agrees":
            return message("readings and model agree within the noise")
        case "mistake":
            found = ", ".join(
                " or ".join([mistake_title(mistake), *mistake.cannot_tell_from])
                for mistake in diagnosis.mistakes.mistakes
            )
            return f"{found}; " + message(f"corrected copy: {_of_copy_in_words(diagnosis)}")
        case "named" | "confounded":
            return "; ".join(map(named_in_words, effects))
    return "; ".join([*(effect.words for effect in effects), *(one.words for one in diagnosis.findings)])


def what_to_do(full: FullDiagnosis, files: Files) -> Iterator[str]:
    """Yield a sentence on each step that should follow a diagnosis, with the command to type."""
    diagnosis, source = full.diagnosis, as_typed(full.source)
    model = None if files.model is None else as_typed(files.model)
    if diagnosis.verdict == "mistake":
        again = message("Correct it on the bench and measure again")
        copy = message(f"until then the corrected copy is {files.copy}") if files.copy else ""
        yield "; ".join(filter(None, [again, copy]))
    if model is not None:
        yield message(f"Use the model: bench calibrate {source} --model {model}")
        yield message(f"Test it with new readings: bench confirm NEW --model {model}")
    if diagnosis.of_copy == "confounded":
        if full.next_measurement is not None:
            yield message(f"Measure {full.next_measurement.procedure}: {full.next_measurement.why}")
        elif diagnosis.gap.reason:
            yield message(
                "Repeat the measurement with more passes, and diagnose both runs: bench diagnose … --together"
            )
    elif diagnosis.of_copy == "unknown":
        yield message(
            "Repeat the measurement: an effect that returns belongs to the bench or the block; see below where "
            "it acts"
        )
    elif diagnosis.verdict == "agrees":
        yield message(f"Nothing; use the coefficients: bench calibrate {source}")


def _of_copy_in_words(diagnosis: Diagnosis) -> str:
    if diagnosis.of_copy == "agrees":
        return message("it agrees with the model within the noise")
    if diagnosis.of_copy == "unknown":
        return "; ".join(effect.words for effect in diagnosis.effects)
    return message(f"it also contains {alike_in_words(diagnosis.effects)}")


def alike_in_words(effects: Sequence[NamedEffect | Mistake]) -> str:
    """Return the names of effects, each with those that fit as well: "bias_drift of x or warm_up; ..."."""
    return "; ".join(" or ".join([effect_title(one), *one.cannot_tell_from]) for one in effects)


def named_in_words(effect: NamedEffect) -> str:
    """Return the name of an effect with its probability; if several names fit, each with at least 1 %."""
    odds = odds_in_words(effect)
    if effect.cannot_tell_from:
        return odds
    return f"{effect_title(effect)} ({odds})" if odds else effect_title(effect)


def found_in_words(diagnosis: Findings, nothing: str) -> str:
    """Return the findings in free positions or in a record as a sentence; `nothing` if there are none."""
    effects = diagnosis.effects
    return "; ".join(named_in_words(e) if e.in_catalogue else e.words for e in effects) or nothing


def readings_named(source: str) -> str:
    """Return a short form of joined names of readings files: "a + b", or "a … z (5 readings files)"."""
    first, *others = source.split(" + ")
    return (
        message(f"{first} … {others[-1]} ({1 + len(others)} readings files)") if len(others) > 1 else source
    )


def evidence_of(found: FreeDiagnosis | RecordDiagnosis, gap: str) -> dict[str, str]:
    """Return the evidence for the model file, by title; `gap` is the text on held-out readings."""
    told = {"found in": readings_named(found.source)}
    for one in found.effects:
        rho = "" if one.rho is None else f", rho {one.rho:.1f}"
        told[alike_in_words([one])] = (
            f"p {one.p_all_looks:.2g} corrected for multiple tests{rho}; {odds_in_words(one)}"
        )
    return told | {"gap": gap, "threshold": f"ln odds {found.threshold:.3f}"}


def mountings_of(block: ModelComparison) -> str:
    """Return the mountings of a block, as installation/series: "1/3, 2/3"."""
    return ", ".join(str(mount) for mount in block.before.calibration.fitted.conditions().mounts)


def shift_in_words(ranking: Sequence[Rival], other: str) -> str:
    """Return in words which coefficient differs most if effect `other` is the cause; "" if it is not ranked."""
    for rival in ranking:
        if rival.family == other:
            coefficient, in_u = rival.largest_shift
            return message(f"in that case {coefficient} would differ by {fixed(in_u, 1, sign=True)} u")
    return ""


def why_no_model(diagnosis: Findings) -> str:
    """Return the reason that completes the sentence "no model file was written"."""
    if diagnosis.gap.shrinks is False:
        return message("because the gap on held-out readings does not shrink: the model would be no better")
    if any(effect.cannot_tell_from for effect in diagnosis.effects):
        return message("because these readings cannot separate the names; --accept-first takes the likeliest")
    return message("because held-out readings do not confirm it; --accept-first writes it anyway")


def joined_in_words(shown: ModelComparison) -> Iterator[str]:
    """Yield a sentence if verification points joined the fit because an effect shows only there."""
    if shown.after is None or not shown.after.joined:
        return
    without, with_it = shown.before.worst_g, shown.after.worst_g
    if without is not None and with_it is not None:
        yield message(
            "this test covers the settings alone: some effects found show only at the verification points, "
            f"which joined the fit and check nothing (largest |Δg| {quantity(without, 'g')} without the "
            f"effects, {quantity(with_it, 'g')} with them)"
        )


def still_missing(shown: ModelComparison) -> bool:
    """Return whether the last model (with any effects found) misfits beyond the scatter of repeats (1 %)."""
    return shown.last.tested and shown.last.test.shown


def evidence_in_words(full: FullDiagnosis, file_of_copy: Path | None) -> dict[str, str]:
    """Return the evidence for each effect and for the whole diagnosis, by title, for the model file."""
    diagnosis, gap = full.diagnosis, full.diagnosis.gap
    evidence = {"found in": full.source}
    if diagnosis.mistakes.mistakes:
        mended = "; ".join(mistake.words for mistake in diagnosis.mistakes.mistakes)
        copy = "a copy" if file_of_copy is None else str(file_of_copy)
        evidence["rests on"] = f"{copy} with these mistakes corrected: {mended}"
    for effect, found in zip(diagnosis.effects, diagnosis.naming.found, strict=False):
        rho = effect.rho or 0.0
        text = f"ln odds {found.evidence:.2f}, p {effect.p_all_looks:.2g} corrected for multiple tests, "
        text += f"rho {rho:.1f}"
        if effect.cannot_tell_from:
            text += f"; the data cannot tell it from {', '.join(effect.cannot_tell_from)}"
        if effect.plainer_than:
            text += f"; plainer than {', '.join(effect.plainer_than)}"
        if effect.applied:
            evidence[label(effect.applied[0])] = text
    if diagnosis.form is not None and diagnosis.form.applied:
        evidence |= _evidence_for_form(diagnosis.form)
    evidence["gap"] = gap.reason
    if gap.folds:
        evidence["gap"] = (
            f"reduced chi-square of held-out readings {gap.before:.3f} before, {gap.after:.3f} after, "
            f"1 expected; p after {gap.p_after:.2g}; root mean square {micro_g(gap.before_rms_g)} before, "
            f"{micro_g(gap.after_rms_g)} after"
        )
    if full.shown.after is not None and np.isfinite(full.shown.after.test.p):
        evidence["simulation"] = f"p of the readings under the model {full.shown.after.test.p:.2g}"
    evidence["threshold"] = f"ln odds {diagnosis.registered.threshold:.3f}"
    evidence["registered"] = diagnosis.registered.sha256
    return evidence


def _evidence_for_form(form: FreeForm) -> dict[str, str]:
    closed = (
        "not measured"
        if form.gap.closed is None
        else f"{100 * form.gap.closed:.0f} % of the gap on held-out readings"
    )
    return {
        **{term.effect.name: f"{term.family}; rho {term.rho:.1f}" for term in form.terms},
        "closed by the unnamed terms": f"{closed}, {form.gap.before:.3f} before, {form.gap.after:.3f} after",
    }


def less_certain(coefficients: Mapping[str, CoefficientChange]) -> list[str]:
    """Return the coefficients whose u more than doubles with the effects found, as "Kyz (u 249 times)"."""
    grown = [(name, one.u_after / one.u_before) for name, one in coefficients.items() if one.u_before > 0]
    grown.sort(key=lambda pair: -pair[1])
    return [
        message(f"{name} (u {two_digits(times)} times)") for name, times in grown if times > MUCH_LESS_CERTAIN
    ]


def dark_for_model(form: FreeForm) -> str | None:
    """Return the unexplained scatter for a model file: "41 uV with u 6 uV"; None if unknown or without terms."""
    if not form.applied or not isfinite(form.dark.upper):
        return None
    if form.dark.there:
        return f"{form.dark.value:.3g} {form.unit} with u {form.dark.u:.2g} {form.unit}"
    return message(f"less than {form.dark.upper:.2g} {form.unit} (95 %)")
