"""A diagnosis with all that follows: simulation beside bench, rivals, next measurement, files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.design import FIXED
from bench.config.bench_file.file import BenchFile
from bench.diagnosis.candidates import NOTHING_KNOWN, KnownBench
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.naming import Scored
from bench.diagnosis.next_measurement import Proposal, propose
from bench.diagnosis.pipeline import diagnose
from bench.diagnosis.posterior import posterior
from bench.diagnosis.result import Diagnosis
from bench.diagnosis.show import Shown, contradicted, show
from bench.diagnosis.threshold import ThresholdCache
from bench.model.forward import ForwardModel
from bench.model.geometry import COEFFICIENTS
from bench.readings.table import Readings

LISTED: Final = 8
"""Families that a ranking shows, the most plausible first."""


@dataclass(frozen=True)
class Rival:
    """A family beside what else was found: ln odds that it is there, whether the data can tell it from the named.

    `shift` (12 of each block,) is by how much the coefficients would differ were it this one, in units of their u.
    """

    family: str
    evidence: float
    tied: bool
    shift: Floats

    @property
    def largest_shift(self) -> tuple[str, float]:
        """The coefficient that would change most, and by how many u."""
        worst = int(np.argmax(np.abs(self.shift)))
        return COEFFICIENTS[worst % FIXED], float(self.shift[worst])


def rivals(diagnosis: Diagnosis) -> tuple[tuple[Rival, ...], ...]:
    """Return for each effect that was found the most plausible families in its place, itself among them.

    All that is tied is among them.
    """
    naming = diagnosis.naming
    if not naming.found:
        return ()
    linear, candidates = diagnosis.linear, diagnosis.candidates
    fixed = linear.fixed.shape[1]
    u = np.sqrt(np.diag(diagnosis.fitted.covariance))[:fixed]
    # with the same wide prior as each rival, or the priors would pass for a difference
    found = posterior(linear, candidates.columns[:, list(naming.columns)], diagnosis.noise)
    coefficients = found.mean[:fixed]
    rankings = []
    for one in naming.found:
        others = [i for f in naming.found if f is not one for i in f.variant.columns]
        scored = Scored.beside(diagnosis.whitened, diagnosis.data, others)
        ranked = sorted(scored.evidence, key=lambda family: -scored.evidence[family])
        alike = {one.variant.family, *one.ties, *one.plainer_than}
        rows = []
        for family in (f for i, f in enumerate(ranked) if i < LISTED or f in alike):
            best = max(
                (i for i, v in enumerate(candidates.variants) if v.family == family),
                key=lambda i: float(scored.scores.variants[i, 0]),
            )
            variant = one.variant if family == one.variant.family else candidates.variants[best]
            columns = candidates.columns[:, [*others, *variant.columns]]
            shift = (posterior(linear, columns, diagnosis.noise).mean[:fixed] - coefficients) / u
            rows.append(Rival(family, scored.evidence[family], family in one.ties, shift))
        rankings.append(tuple(rows))
    return tuple(rankings)


@dataclass(frozen=True)
class FullDiagnosis:
    """What `bench diagnose` finds out of one body of readings; JSON, terminal and page are told from it.

    `ranking` has for each effect that was found the families in its place; `skipped_rows` names rows of the
    source that could not be read. Of several blocks `shown` is the first and `blocks` are all.
    """

    source: str
    simulated: bool
    skipped_rows: tuple[str, ...]
    diagnosis: Diagnosis
    shown: Shown
    ranking: tuple[tuple[Rival, ...], ...]
    next_measurement: Proposal | None
    blocks: tuple[Shown, ...] = ()

    def rivals_of(self, effect: int) -> tuple[Rival, ...]:
        """Return the ranking of the effect of this number; nothing where it was not ranked."""
        return self.ranking[effect] if effect < len(self.ranking) else ()


@dataclass(frozen=True)
class MistakesAlone:
    """A diagnosis that ended with mistakes: what they leave does not determine the coefficients.

    `corrected` are the readings with the mistakes put right, `reason` says what is missing in them.
    """

    source: str
    simulated: bool
    mistakes: tuple[Mistake, ...]
    corrected: Readings
    reason: str

    @property
    def words(self) -> str:
        """The mistakes and what is missing without them, in a sentence."""
        return f"a mistake: {'; '.join(one.words for one in self.mistakes)}; put right, {self.reason}"


def diagnose_fully(
    readings: Readings,
    model: ForwardModel,
    bench: BenchFile,
    g_m_s2: float,
    cache: ThresholdCache,
    *,
    source: str,
    simulated: bool,
    known: Sequence[Mistake] = (),
    stated: bool = True,
    nominal: Floats | None = None,
) -> FullDiagnosis:
    """Diagnose readings that were taken on a bench, and work out what follows; nothing is written.

    `source` is what they are called, `simulated` whether they come from simulated instruments, `known` mistakes
    that are put right in them already, `nominal` (blocks, 3) the scale factors of several blocks where they are
    not all that of the bench file. Where nobody `stated` that the readings are of this bench, nothing is
    concluded from what meters and head it has. Raises `CalibrationError` where the readings do not determine the
    coefficients.
    """
    stand_u = {name: spread.u for name, spread in bench.stand_distributions().items()}
    sheet = np.array(bench.unit_under_test.scale_factors.values) if nominal is None else nominal
    sheet_of_unit = sheet if readings.unit == "V" else None
    there = KnownBench.of(bench) if stated else NOTHING_KNOWN
    diagnosis = diagnose(readings, model, stand_u, sheet_of_unit, cache, there)
    if known:
        mistakes = replace(diagnosis.mistakes, mistakes=(*known, *diagnosis.mistakes.mistakes))
        diagnosis = replace(diagnosis, mistakes=mistakes, verdict="mistake")
    model = diagnosis.linear.model
    blocks = tuple(_shown(diagnosis, model, stand_u, g_m_s2))
    shown = blocks[0]
    told = [*filter(None, [there.not_judged(readings)]), *contradicted(model.effects, shown.before.effects)]
    return FullDiagnosis(
        source=source,
        simulated=simulated,
        skipped_rows=readings.skipped,
        diagnosis=replace(diagnosis, notes=(*diagnosis.notes, *told)),
        shown=shown,
        ranking=rivals(diagnosis),
        # a proposal is for one block: which of several would be measured again, nobody said
        next_measurement=propose(diagnosis, bench) if len(blocks) == 1 else None,
        blocks=blocks if len(blocks) > 1 else (),
    )


def _shown(
    diagnosis: Diagnosis, model: ForwardModel, stand_u: Mapping[str, float], g_m_s2: float
) -> Iterator[Shown]:
    """Yield simulation beside bench for each block, with what was found that is of it."""
    readings = diagnosis.mistakes.corrected
    if readings.block is None:
        yield show(readings, model, diagnosis.applied, stand_u, g_m_s2, diagnosis.in_part)
        return
    for number in np.unique(readings.block):
        own = readings.select(readings.block == number)
        mounts = {str(mount) for mount in own.conditions().mounts}
        applied = [a for a in diagnosis.applied if not a.installations or mounts & set(a.installations)]
        yield show(own, model, tuple(applied), stand_u, g_m_s2)
