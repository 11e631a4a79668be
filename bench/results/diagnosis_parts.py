"""Parts of the JSON of a diagnosis: findings, gap, noise, unnamed terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field

from bench.base.arrays import rms
from bench.base.result_model import Real, ResultModel
from bench.diagnosis.gap import FLOOR, UNDETERMINED, Fold, Gap
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.naming import FamilyOdds
from bench.diagnosis.noise_kinds import LocalScatter, NoiseKind
from bench.diagnosis.pipeline import values_of
from bench.diagnosis.posterior import KnownTogether
from bench.diagnosis.residual_model import FormTerm, FreeForm
from bench.diagnosis.result import Verdict
from bench.results.diagnosis_words import Files
from bench.results.parts import BenchPart, ChannelsPart, CorrectionPart

VerdictOfCopy = Literal["agrees", "named", "confounded", "unknown"]


class ValuePart(ResultModel):
    """A parameter with its standard uncertainty; a shape parameter, which is chosen from a grid, has no u."""

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
    """The members that mistakes and effects share."""

    name: str = Field(description="from the catalogue, or what kind of mistake or unnamed pattern it is")
    channels: list[str]
    cannot_tell_from: list[str] = Field(description="what explains the readings equally well")
    parameters: MistakePlace | Parameters = Field(
        description="values with `u` and `unit`, by parameter and channel; of a mistake where it is and how the "
        "misfit changes"
    )
    p: Real = Field(description="for this effect alone")
    p_all_looks: Real = Field(
        description="everything that was looked at counted; of a mistake never 0, 2.2e-308 stands for less"
    )
    rho: Real = Field(
        default=None,
        description="size over its u: |value|/u of one number, of several the root of their chi-square",
    )
    probability: Real = Field(
        default=None, description="posterior probability of the name; null for a mistake, which has none"
    )
    words: str = Field(description="the sentence on it")
    odds: list[FamilyOdds] = Field(
        default=[],
        description="the names that may stand in this place, the most probable first; `unnamed_form` is any form "
        "without a name",
    )


class EffectPart(FoundPart):
    """An effect or a mistake that was found."""

    installations: list[str] = Field(description="mountings that have it; empty where it is of all")
    plainer_than: list[str] = Field(
        default=[], description="larger families of the same subsystem that contain it"
    )
    together: list[KnownTogether] = Field(
        default=[], description="sums or differences that the readings tell where they hardly tell the values"
    )
    shape_held: bool = Field(
        default=False,
        description="whether each u of the parameters is that with the effect's shape as it was found",
    )
    aliases: list[int] = Field(
        default=[], description="other periods a turn that would look the same at the angles measured"
    )


class FormFoldPart(ResultModel):
    """Readings that were held out together, and the misfit of their prediction from the other readings."""

    what: str
    counted: bool = Field(
        description="whether it counts in `before` and `after` above; every fold measured does"
    )
    before: Real
    after: Real


class FoldPart(FormFoldPart):
    """Readings that were held out together, the effects that the others showed, and how well these predict."""

    confirmable: bool = Field(description="whether the other readings determine the coefficients")
    left_out: str | None = Field(description="why it does not count")
    named_without_it: list[str]
    before_rms_ug: Real
    after_rms_ug: Real


class FormGapPart(ResultModel):
    """The reduced chi-square of readings that were held out of both search and fit."""

    before: Real = Field(
        description="with the model before; null where no fold measures it, `reason` says why"
    )
    after: Real = Field(description="with what was named")
    floor: float = Field(description="its expectation when nothing is missing")
    closed: Real = Field(
        description="(before - after)/(before - floor): the part of the gap that is closed; null where nothing is "
        "above the floor"
    )
    before_rms: Real = Field(description="root mean square of measured less predicted, in `unit`")
    after_rms: Real
    unit: str
    held_out: Sequence[FormFoldPart]


class GapPart(FormGapPart):
    """The reduced chi-square of readings held out of the fit, and whether it confirms the effects found."""

    shrinks: bool | None = Field(
        description="whether it shrinks by the rule in `registered`, without which nothing is named alone; null "
        "where nothing was found or nothing measures it"
    )
    reason: str | None = Field(description="why readings held out do not confirm what was found")
    p_after: Real = Field(description="chance of more than `after`")
    before_rms_ug: Real = Field(
        description="root mean square of measured less predicted, in µg by the scale factors"
    )
    after_rms_ug: Real
    expected_rms_ug: Real = Field(
        description="what after_rms_ug is expected to be when nothing is missing: noise, and the uncertainty of "
        "the prediction"
    )
    noise_rms: float = Field(description="of a reading, in `unit`")
    held_out: list[FoldPart]


class CopyPart(ResultModel):
    """The copy of the readings in which the mistakes are corrected."""

    readings: Path | None = Field(description="the readings file of the copy; null where it was not written")
    used: int = Field(description="readings in the copy")
    verdict: VerdictOfCopy | None = Field(
        description="what the search on the copy came to; null where it is too little to fit"
    )
    rests_on: list[str] = Field(description="the mistakes that are put right in it")


class PlacePart(ResultModel):
    """A channel of a record, or a sensor in free positions, and its residuals before any effect is named."""

    channel: str
    installation: str
    pattern: str
    size: float = Field(description="root mean square beside zero and drift, or of |a| - 1 g")
    unit: str
    p: Real = Field(description="by white noise alone; of free positions all records counted")


class AloneResult(ResultModel):
    """The members of a diagnosis whose readings are all free positions, or a record at a known input."""

    verdict: Verdict
    where: list[PlacePart] = Field(
        description="where readings and model differ, of free positions the largest first"
    )
    next_measurement: None
    hidden: list[str] = Field(description="effects that these readings could never show")
    gap: GapPart = Field(
        description="reduced chi-square of what was held out in turn: every fifth position, rms in g; or the "
        "excursions of a record, rms in V"
    )
    model: Path | None = Field(
        description="path of the model file that was written; of several sensors with values of their own the "
        "first's"
    )
    threshold: float = Field(description="ln odds above which something is found")
    notes: list[str]
    source: str
    report: Path | None = Field(description="path of the page")
    bench: BenchPart | None
    corrections: list[CorrectionPart] = Field(
        description="the certificates of the instruments, and what was done by them; without any an empty list"
    )
    simulated: bool
    skipped_rows: list[str]

    @classmethod
    def made(cls, found: object, files: Files, made_from: Mapping[str, Any], **others: Any) -> Self:
        """Return the result on findings.

        `made_from` are bench, certificates, and the members that describe the source.
        """
        of_source = {"bench": None, "corrections": [], "simulated": False, "skipped_rows": [], **made_from}
        written = {"next_measurement": None, "model": files.model, "report": files.report}
        return cls.from_object(found, **{**written, **of_source, **others})


class FindingPart(ResultModel):
    """A noise that is larger than stated."""

    what: Literal["reading", "setting"]
    found: float
    stated: float
    unit: str
    factor: float = Field(description="found over stated, more than 2")
    p: float
    source: str = Field(description="what states it: the readings' own scatter or the bench file")
    series: list[int] = Field(
        default=[], description="of the run that it is of, where runs have noise of their own"
    )
    words: str


class NoisePart(ResultModel):
    """The noise as estimated from the scatter of the readings."""

    reading: float = Field(description="of a reading, unit of the signal")
    setting_arcsec: float
    dof: int
    channels: ChannelsPart = Field(
        description="of a reading of each channel; the root of their mean square is reading"
    )
    kinds: list[NoiseKind] = Field(
        description="in what the noise is not normal and of one size in all channels; the search reckons with it"
    )
    findings: list[FindingPart] = Field(
        description="noise larger than stated; with one the verdict is unknown"
    )


class SizePart(ResultModel):
    """The estimated size of a term; `channel` is null if all channels share it."""

    parameter: str
    channel: str | None
    value: float
    u: float
    unit: str


class TermPart(ResultModel):
    """A term that describes an unnamed effect."""

    name: str
    stage: str = Field(description="where it is added in the chain from the head to the voltmeter")
    adds_to: str | None
    expression: str
    constants: dict[str, ValuePart]
    channels: list[str]
    sizes: list[SizePart]
    family: str
    could_also_be: list[str]
    rho: float = Field(description="size over its u, as of effects")
    p: float = Field(description="for this term alone")


class DarkPart(ResultModel):
    """The dark uncertainty: the scatter of readings that remains unexplained."""

    value: float = Field(description="1 sigma; 0 where it is no more than chance gives")
    u: Real
    upper_95: Real
    p: float


class FormPart(ResultModel):
    """The terms that describe an unnamed effect."""

    terms: list[TermPart]
    instead_of: list[str] = Field(description="the named effects in whose place the terms are as plausible")
    gap: FormGapPart
    dark_uncertainty: float = Field(description="what stays unexplained in each reading, 1 sigma")
    dark: DarkPart
    scatter: LocalScatter | None = Field(description="where readings scatter more than elsewhere")
    unit: str


# --- conversion of a diagnosis to parts of its result -------------------------------------------------


def mistake_part(mistake: Mistake) -> EffectPart:
    """Return the part of the result on a mistake."""
    return EffectPart.from_object(
        mistake,
        parameters=MistakePlace(
            pass_number=mistake.pass_number,
            point=mistake.point,
            misfit_before=mistake.evidence.before,
            misfit_after=mistake.evidence.after,
        ),
        p_all_looks=mistake.p,
    )


def gap_part(gap: Gap) -> GapPart:
    """Return the part of the result on a gap; its numbers are null if no readings could be held out."""
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
    """Return the part of the result on the terms that describe an unnamed effect."""
    dark = form.dark
    return FormPart.from_object(
        form,
        terms=[_term_part(term) for term in form.terms],
        gap=FormGapPart.from_object(
            form.gap,
            **_sizes(form.gap),
            held_out=[
                FormFoldPart(
                    what=fold.label, counted=True, before=fold.before.reduced, after=fold.after.reduced
                )
                for fold in form.gap.folds
            ],
        ),
        dark_uncertainty=dark.value if dark.there else 0.0,
        dark=DarkPart.from_object(
            dark,
            value=dark.value if dark.there else 0.0,
            u=dark.u if dark.there else None,
            upper_95=dark.upper,
        ),
    )


def _term_part(term: FormTerm) -> TermPart:
    effect = term.effect
    return TermPart.from_object(
        term,
        name=effect.name,
        stage=effect.stage.value,
        adds_to=effect.adds_to or None,
        expression=effect.expression,
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
