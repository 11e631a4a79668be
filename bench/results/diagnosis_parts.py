"""Parts of the JSON of a diagnosis: findings, held-out readings (gap), noise, unnamed terms, residuals, repeats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field

from bench.base.arrays import CHANNELS, rms
from bench.base.languages import message
from bench.base.result_model import Real, ResultModel
from bench.calibration import Calibration
from bench.diagnosis.free_records import BetweenRecords
from bench.diagnosis.gap import FLOOR, UNDETERMINED, Fold, Gap
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.naming import FamilyOdds
from bench.diagnosis.noise_kinds import LocalScatter, NoiseKind
from bench.diagnosis.pipeline import values_of
from bench.diagnosis.posterior import KnownTogether
from bench.diagnosis.result import FormTerm, FreeForm, Verdict
from bench.diagnosis.show import ModelComparison
from bench.results.diagnosis_words import Files
from bench.results.parts import BenchPart, ChannelsPart, Corrections
from bench.results.plots import mounts_of, sd_of_reading
from bench.stats.repeats import Repeats

DIGITS: Final = 6
"""Significant digits of a residual; its uncertainty is known to fewer."""


class ReadingPart(ResultModel):
    """A fitted reading: its place, direction, head angle and time, and its standard deviation by channel."""

    installation: str
    series: int
    pass_number: int = Field(alias="pass")
    point: int
    direction: int = Field(description="1 if the angle rose, -1 if it fell, 0 if unknown")
    angle_deg: float = Field(description="angle of the head, deg")
    time_s: Real = Field(description="time since the start of the run, s; null if unknown")
    u: list[Real] = Field(description="standard deviation of a single reading, by channel")


class ComparedReadingPart(ReadingPart):
    """A reading with its residuals, by channel, from each model of a diagnosis."""

    signal: list[float] = Field(description="measured signal")
    before: list[float] = Field(description="residual from the given model")
    after: list[float] | None = Field(description="residual with the effects found; null if none was found")
    simulated: list[float] = Field(description="residual of a simulated reading, including noise")


class ResidualsPart(ResultModel):
    """The residuals of the fitted readings."""

    unit: str = Field(description="unit of the signals")
    readings: list[ComparedReadingPart]


def fitted_readings(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the members of a `ReadingPart` for each fitted reading, in the order of the table."""
    fitted = calibration.fitted
    u = np.zeros((len(fitted), 3))
    for _, rows in mounts_of(calibration):
        u[rows] = sd_of_reading(calibration, rows, fitted.angle_rad[rows])
    columns = {
        "installation": fitted.installation.tolist(),
        "series": fitted.series.tolist(),
        "pass": fitted.pass_number.tolist(),
        "point": fitted.point.tolist(),
        "direction": fitted.direction.tolist(),
        "angle_deg": np.degrees(fitted.angle_rad).round(9).tolist(),
        "time_s": fitted.time_s.tolist(),
        "u": _rows(u),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def residuals_of(calibration: Calibration) -> list[list[float]]:
    """Return the residuals of the fitted readings, rounded: a list of three numbers for each reading."""
    return _rows(calibration.residuals)


def compared_residuals(shown: ModelComparison) -> ResidualsPart:
    """Return the residuals without and with the effects found, and those of one simulated run."""
    before = shown.before.calibration
    after = None if shown.after is None else residuals_of(shown.after.calibration)
    signal, given = _rows(before.fitted.signal, 9), residuals_of(before)
    simulated = residuals_of(shown.last.repeated)
    readings = [
        ComparedReadingPart(
            **reading,
            signal=signal[i],
            before=given[i],
            after=None if after is None else after[i],
            simulated=simulated[i],
        )
        for i, reading in enumerate(fitted_readings(before))
    ]
    return ResidualsPart(unit=before.unit, readings=readings)


def _rows(values: Any, digits: int = DIGITS) -> list[list[float]]:
    return [[float(f"{value:.{digits}g}") for value in row] for row in np.asarray(values).tolist()]


VerdictOfCopy = Literal["agrees", "named", "confounded", "unknown"]


class ValuePart(ResultModel):
    """A parameter with its standard uncertainty; a shape parameter that is chosen from a grid has no u."""

    value: float
    u: float = 0.0
    unit: str


def _nested(values: Any) -> Any:
    """Return values as nested dictionaries by installations, parameter and channel; empty levels are left out."""
    if not isinstance(values, tuple):
        return values
    tree: dict[str, Any] = {}
    for one in values:
        *levels, last = [key for key in (one.installations, one.parameter, one.channel) if key]
        branch = tree
        for key in levels:
            branch = branch.setdefault(key, {})
        u = {} if one.u is None else {"u": one.u}
        branch[last] = {"value": one.value, **u, "unit": one.unit}
    return tree


Parameters = Annotated[
    dict[str, ValuePart | dict[str, ValuePart | dict[str, ValuePart]]], BeforeValidator(_nested)
]


class MistakePlace(ResultModel):
    """Where a mistake is, and the misfit of all readings (in units of noise) with and without it."""

    pass_number: int | None = Field(alias="pass")
    point: int | None
    misfit_before: Real
    misfit_after: Real


class FoundPart(ResultModel):
    """The members that a mistake and an effect have in common."""

    name: str = Field(description="name in the catalogue, or the kind of mistake or unnamed pattern")
    channels: list[str]
    cannot_tell_from: list[str] = Field(description="other effects that explain the readings equally well")
    parameters: MistakePlace | Parameters
    """values with `u` and `unit` by parameter and channel; for a mistake, its place and the misfit with and
    without it
    """
    p: Real = Field(description="p-value of this effect alone")
    p_all_looks: Real
    """p-value corrected for everything that was examined; 2.2e-308 stands for smaller values of a mistake"""
    rho: Real = None
    """size divided by its u; for several parameters, root of their chi-square"""
    probability: Real = None
    """posterior probability of the name; null for a mistake"""
    words: str = Field(description="the finding as a sentence")
    odds: list[FamilyOdds] = Field(default=[])
    """possible names of the effect, most probable first; `unnamed_form` is any pattern without a name"""


class EffectPart(FoundPart):
    """An effect or a mistake that was found."""

    installations: list[str] = Field(description="installations that show the effect; empty if all do")
    plainer_than: list[str] = Field(default=[])
    """more general families of the same subsystem that contain this one"""
    together: list[KnownTogether] = Field(default=[])
    """sums or differences of parameters that are better known than the values"""
    shape_held: bool = False
    """whether each u of the parameters applies to the shape of the effect as found"""
    aliases: list[int] = Field(default=[])
    """other numbers of periods per turn that give the same errors at the angles measured"""


class FormFoldPart(ResultModel):
    """Readings held out together, and the misfit when they are predicted from all other readings."""

    what: str
    counted: bool = Field(description="whether it counts in `before` and `after` of the gap")
    before: Real
    after: Real


class FoldPart(FormFoldPart):
    """Readings held out together, and how well the effects named from all other readings predict them."""

    confirmable: bool = Field(description="whether the other readings determine the coefficients")
    left_out: str | None = Field(description="why it does not count; null if it does")
    named_without_it: list[str]
    before_rms_ug: Real
    after_rms_ug: Real


class FormGapPart(ResultModel):
    """The reduced chi-square of readings that were held out of both search and fit."""

    before: Real
    """reduced chi-square with the given model; null if nothing was held out (see `reason`)"""
    after: Real = Field(description="reduced chi-square with the effects found")
    floor: float = Field(description="expected reduced chi-square if no effect is missing")
    closed: Real
    """part of the gap that is closed: (before - after)/(before - floor); null if `before` is not above the
    floor
    """
    before_rms: Real = Field(description="rms of measured minus predicted with the given model, in `unit`")
    after_rms: Real
    unit: str
    held_out: Sequence[FormFoldPart]


class GapPart(FormGapPart):
    """The reduced chi-square of readings held out of the fit, and whether they confirm the effects found."""

    shrinks: bool | None
    """whether the gap shrinks by the rule in `registered`, which a name requires; null if nothing was found
    or nothing was held out
    """
    reason: str | None = Field(description="why held-out readings do not confirm effects; null if they do")
    p_after: Real = Field(description="p-value of `after`")
    before_rms_ug: Real
    """rms of measured minus predicted with the given model, µg by the scale factors"""
    after_rms_ug: Real
    expected_rms_ug: Real
    """expected `after_rms_ug` if no effect is missing, from noise and the uncertainty of the prediction"""
    noise_rms: float = Field(description="standard deviation of a reading, in `unit`")
    held_out: list[FoldPart]


class CopyPart(ResultModel):
    """The copy of the readings in which the mistakes are corrected."""

    readings: Path | None = Field(description="readings file of the copy; null if it was not written")
    used: int = Field(description="number of readings in the copy")
    verdict: VerdictOfCopy | None
    """verdict of the search on the copy; null if it has too few readings to fit"""
    rests_on: list[str] = Field(description="mistakes that are corrected in the copy")


class PlacePart(ResultModel):
    """A channel of a record, or a sensor in free positions, and its residuals before any effect is named."""

    channel: str
    installation: str
    pattern: str
    size: float = Field(description="root mean square of the residuals after zero and drift, or of |a| - 1 g")
    unit: str
    p: Real = Field(description="p-value under white noise; corrected for several records of free positions")


class AloneResult(ResultModel):
    """The fields that the diagnoses of free positions and of records at a known input have in common."""

    verdict: Verdict
    where: list[PlacePart]
    """places where readings and model differ; for free positions, largest first"""
    next_measurement: None
    hidden: list[str] = Field(description="effects that these readings cannot show at any size")
    gap: GapPart
    """reduced chi-square of readings held out in turn: every fifth position (rms in g), or the excursions of
    a record (rms in V)
    """
    model: Path | None
    """path of the model file, the first if several sensors have one each; null if none was written"""
    threshold: float = Field(description="ln of the odds above which an effect counts as found")
    notes: list[str]
    source: str
    report: Path | None = Field(description="path of the page; null if none was written")
    bench: BenchPart | None
    corrections: Corrections
    simulated: bool
    skipped_rows: list[str]

    @classmethod
    def made(cls, found: object, files: Files, made_from: Mapping[str, Any], **others: Any) -> Self:
        """Return the result for `found`; `made_from` may have bench, corrections, simulated, skipped_rows."""
        of_source = {"bench": None, "corrections": [], "simulated": False, "skipped_rows": [], **made_from}
        written = {"next_measurement": None, "model": files.model, "report": files.report}
        return cls.from_object(found, **{**written, **of_source, **others})


class FindingPart(ResultModel):
    """A noise that is larger than stated."""

    what: Literal["reading", "slow", "setting"]
    found: float
    stated: float
    unit: str
    factor: float = Field(description="`found` divided by `stated`, above 2")
    p: float
    source: str = Field(description="what states the noise: the scatter of the readings or the bench file")
    series: list[int] = Field(default=[])
    """runs (by series number) with this noise, if runs have noise of their own"""
    words: str


class NoisePart(ResultModel):
    """The noise as estimated from the scatter of the readings."""

    reading: float = Field(description="standard deviation of a reading, unit of the signal")
    setting_arcsec: float
    dof: int
    channels: ChannelsPart
    """standard deviation of a reading of each channel; `reading` is their root mean square"""
    kinds: list[NoiseKind]
    """deviations from normal noise of equal size in all channels; the search allows for them"""
    findings: list[FindingPart]
    """noise larger than stated; if there is any, the verdict is unknown"""


class SizePart(ResultModel):
    """The estimated amplitude of a term; `channel` is null if all channels share it."""

    parameter: str
    channel: str | None
    value: float
    u: float
    unit: str


class TermPart(ResultModel):
    """A term that describes an unnamed effect."""

    name: str
    stage: str = Field(description="stage of the chain from head to voltmeter at which the term is added")
    adds_to: str | None
    expression: str
    constants: dict[str, ValuePart]
    channels: list[str]
    sizes: list[SizePart]
    family: str
    could_also_be: list[str]
    rho: float = Field(description="size divided by its u")
    p: float = Field(description="p-value of this term alone")


class DarkPart(ResultModel):
    """The dark uncertainty: the scatter of readings that remains unexplained."""

    value: float = Field(description="standard deviation; 0 if it is not significant")
    u: Real
    upper_95: Real
    p: float


class FormPart(ResultModel):
    """The terms that describe an unnamed effect."""

    terms: list[TermPart]
    instead_of: list[str] = Field(description="named effects that are as plausible as these terms")
    gap: FormGapPart
    dark_uncertainty: float = Field(description="standard deviation of the unexplained part of each reading")
    dark: DarkPart
    scatter: LocalScatter | None = Field(description="places where readings scatter more than elsewhere")
    unit: str


# --- conversion of a diagnosis to parts of its result -------------------------------------------------


def mistake_part(mistake: Mistake) -> EffectPart:
    """Return the part of the result on a mistake."""
    return EffectPart.from_object(
        mistake,
        parameters=MistakePlace.from_object(mistake),
        p_all_looks=mistake.p,
    )


def gap_part(gap: Gap) -> GapPart:
    """Return the part on the misfit of held-out readings; its numbers are null if no reading was held out."""
    return GapPart.from_object(
        gap,
        **_sizes(gap),
        reason=gap.reason or None,
        before_rms_ug=1e6 * gap.before_rms_g,
        after_rms_ug=1e6 * gap.after_rms_g,
        expected_rms_ug=1e6 * gap.expected_rms_g,
        noise_rms=gap.noise.reading,
        held_out=[*map(_fold_part, gap.folds), *map(_undetermined_part, gap.undetermined)],
    )


def _sizes(gap: Gap) -> dict[str, float | None]:
    before, after = (gap.before, gap.after) if gap.folds else (None, None)
    return {"before": before, "after": after, "floor": FLOOR}


def _fold_part(fold: Fold) -> FoldPart:
    return FoldPart.from_object(
        fold,
        what=fold.label,
        confirmable=True,
        counted=True,
        left_out=None,
        named_without_it=list(fold.gains),
        before=fold.before.reduced,
        after=fold.after.reduced,
        before_rms_ug=1e6 * rms(fold.before.error_g),
        after_rms_ug=1e6 * rms(fold.after.error_g),
    )


def _undetermined_part(label: str) -> FoldPart:
    sizes = dict.fromkeys(("before", "after", "before_rms_ug", "after_rms_ug"))
    told = {"what": label, "confirmable": False, "counted": False, "left_out": UNDETERMINED}
    return FoldPart.model_validate(sizes | told | {"named_without_it": []})


def form_part(form: FreeForm) -> FormPart:
    """Return the result's part on what no effect of the catalogue explains."""
    dark, found = form.dark, form.dark.value if form.dark.there else 0.0
    return FormPart.from_object(
        form,
        terms=[_term_part(term) for term in form.terms],
        gap=FormGapPart.from_object(
            form.gap,
            **_sizes(form.gap),
            held_out=[FormFoldPart.from_object(_fold_part(fold)) for fold in form.gap.folds],
        ),
        dark_uncertainty=found,
        dark=DarkPart.from_object(dark, value=found, u=dark.u if dark.there else None, upper_95=dark.upper),
    )


def _term_part(term: FormTerm) -> TermPart:
    effect = term.effect
    return TermPart.from_object(
        term,
        effect,
        stage=effect.stage.value,
        adds_to=effect.adds_to or None,
        constants={
            p.name: ValuePart(value=p.default / p.si_per_unit, unit=p.unit)
            for p in effect.parameters
            if p.is_shape
        },
        channels=list(term.applied.channels),
        sizes=[
            SizePart(parameter=v.parameter, channel=v.channel or None, value=v.value, u=v.u, unit=v.unit)
            for v in values_of((term.applied,))
            if v.u is not None
        ],
    )


# --- repeats against their stated uncertainty ------------------------------------------------------------


MEANING: Final = {
    "restart": message("a value of its own in each repeat"),
    "drift": message("a random walk from one repeat to the next"),
    "scale": message(
        "a value of its own in each repeat, in proportion to u, as where each repeat drifts within itself"
    ),
}


class RatioPart(ResultModel):
    """Scatter of repeats about their predictions, divided by u of the prediction; with 95 % interval."""

    value: float
    low: float
    high: float = Field(description="upper end; repeats, not single values, are independent")


class RepeatsTermPart(ResultModel):
    """The term that is added to u so that u agrees with the scatter of repeats."""

    name: Literal["restart", "drift", "scale"]
    means: str
    size: list[float]
    """standard deviation for each kind of quantity; for `scale`, in multiples of u"""


class RepeatsPart(ResultModel):
    """The scatter of repeats compared with their stated u."""

    ratio: Real = Field(description="scatter of the repeats divided by their stated u")
    too_small: bool = Field(description="whether u is significantly too small, by a factor above 1.5")
    before: RatioPart | None
    """ratio for repeats held out in turn, with u as stated; null for fewer than three repeats"""
    after: RatioPart | None = Field(description="the same ratio with u widened by `term`")
    term: RepeatsTermPart | None


def repeats_part(found: Repeats) -> RepeatsPart:
    """Return the part of a result on repeats."""
    term = found.term
    return RepeatsPart.from_object(
        found,
        ratio=found.scatter,
        before=found.held_before,
        after=found.held_after,
        term=term and RepeatsTermPart(name=term.name, means=MEANING[term.name], size=term.size.tolist()),
    )


def repeats_told(found: Repeats, where: str, sizes: Sequence[str]) -> str:
    """Return a sentence that compares the scatter of repeats with their u.

    `where` says which repeats, such as "between records". `sizes` states the term added to u in words, by channel.
    """
    text = message(f"repeats {where} scatter {found.scatter:.2g} × u")
    before = found.held_before
    if before is None:
        return message(f"{text}; too few to leave one out")
    if found.term is None or found.held_after is None:
        return message(
            f"{text}, one left out {before.value:.2g} × u (95 %: {before.low:.2g} to {before.high:.2g}): they do "
            "not show that u is too small"
        )
    after = found.held_after
    return message(
        f"{text}; with the term {found.term.name} ({', '.join(sizes)}; {MEANING[found.term.name]}) one left out "
        f"scatters {after.value:.2g} × u (95 %: {after.low:.2g} to {after.high:.2g}), without it "
        f"{before.value:.2g} × u"
    )


# --- zeros of free positions in several records ------------------------------------------------------


class HeldOutByRecord(ResultModel):
    """Biases (zeros) of held-out records: scatter about the prediction by other records, over stated u."""

    by: Literal["record"]
    before: Real = Field(description="ratio for constant zeros")
    after: Real = Field(description="ratio with u widened by the term; null if u is not too small")


class BetweenRecordsPart(ResultModel):
    """The changes of the biases (zeros, in g) from record to record, if each record is fitted alone."""

    ratio: Real = Field(description="scatter of the zeros divided by their stated u")
    repeats: RepeatsPart
    u_with_term_g: list[list[list[Real]]] | None
    """standard uncertainty of the zeros with the term, g; null if the stated u is not too small"""
    bench_file: str
    """line for a bench file that includes the term in u of calibrations; may be empty"""
    scatter_g: list[Real]
    common_part: list[Real]
    """fraction of the variance that all sensors share; null for one sensor"""
    held_out: HeldOutByRecord
    zeros_g: list[list[list[Real]]] = Field(description="zeros by sensor, record and channel, g")
    u_g: list[list[list[Real]]]


def between_part(found: BetweenRecords) -> BetweenRecordsPart:
    """Return the part of a result on the biases (zeros) in several records of free positions."""
    repeats = found.repeats
    before = np.nan if repeats.held_before is None else repeats.held_before.value
    return BetweenRecordsPart(
        ratio=repeats.scatter,
        repeats=repeats_part(repeats),
        u_with_term_g=None if repeats.term is None else repeats.term.u.tolist(),
        bench_file=found.in_bench_file(),
        scatter_g=found.scatter.tolist(),
        common_part=found.common.tolist(),
        held_out=HeldOutByRecord(
            by="record",
            before=before,
            after=before if repeats.held_after is None else repeats.held_after.value,
        ),
        zeros_g=found.zero.tolist(),
        u_g=found.u.tolist(),
    )


def repeats_between(between: BetweenRecords) -> str:
    """Return a sentence on how biases (zeros) scatter between records, and the term to add to their u."""
    sizes = [f"{c} {size}" for c, size in zip(CHANNELS, between.term_sizes(), strict=False)]
    return repeats_told(between.repeats, message("between records"), sizes)
