"""A diagnosis with all that follows: simulation beside bench, rivals, next measurement, files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.numbers import without_infinity
from bench.calibration.design import FIXED
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile
from bench.diagnosis.candidates import NOTHING_KNOWN, KnownBench
from bench.diagnosis.mistakes.search import Mistake
from bench.diagnosis.naming import Scored
from bench.diagnosis.next_measurement import Proposal, propose
from bench.diagnosis.pipeline import diagnose
from bench.diagnosis.posterior import posterior
from bench.diagnosis.result import Diagnosis, mistake_to_dict
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

    def to_dict(self) -> dict[str, Any]:
        """Return the evidence and the coefficient that would change most."""
        coefficient, in_u = self.largest_shift
        return {
            "name": self.family,
            "ln_odds": self.evidence,
            "tied": self.tied,
            "largest_shift": {"coefficient": coefficient, "in_u": in_u},
        }


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
    source that could not be read. `model`, `report` and `copy`, the readings with mistakes put right, are files
    that were written; `corrections` is what is known of the instruments' certificates. Of several blocks
    `shown` is the first and `blocks` are all.
    """

    source: str
    simulated: bool
    skipped_rows: tuple[str, ...]
    diagnosis: Diagnosis
    shown: Shown
    ranking: tuple[tuple[Rival, ...], ...]
    next_measurement: Proposal | None
    model: Path | None = None
    report: Path | None = None
    copy: Path | None = None
    bench: Mapping[str, str] | None = None
    corrections: Sequence[Mapping[str, Any]] = ()
    blocks: tuple[Shown, ...] = ()

    def rivals_of(self, effect: int) -> tuple[Rival, ...]:
        """Return the ranking of the effect of this number; nothing where it was not ranked."""
        return self.ranking[effect] if effect < len(self.ranking) else ()

    def to_dict(self) -> dict[str, Any]:
        """Return the promised result; null stands for what is no finite number, as JSON has none."""
        shown = self.shown
        blocks = [_of_block(one) for one in self.blocks]
        whole = self.diagnosis.to_dict() | {
            "next_measurement": None if self.next_measurement is None else self.next_measurement.to_dict(),
            "model": None if self.model is None else str(self.model),
            "simulation": {
                "before": shown.before.to_dict(),
                "after": None if shown.after is None else shown.after.to_dict(),
            },
            "coefficients": {name: asdict(change) for name, change in shown.coefficients.items()},
            "ranking": [[rival.to_dict() for rival in one] for one in self.ranking],
            "source": self.source,
            "bench": None if self.bench is None else dict(self.bench),
            "corrections": [dict(one) for one in self.corrections],
            "simulated": self.simulated,
            "skipped_rows": list(self.skipped_rows),
            "report": None if self.report is None else str(self.report),
            "corrected": self._corrected(),
            **({"blocks": blocks} if blocks else {}),
        }
        return {key: without_infinity(value) for key, value in whole.items()}

    def _corrected(self) -> dict[str, Any] | None:
        """Return what the search on a copy with mistakes put right came to; None where there is no mistake."""
        mistakes = self.diagnosis.mistakes
        if not mistakes.mistakes:
            return None
        return {
            "readings": None if self.copy is None else str(self.copy),
            "used": len(mistakes.corrected),
            "verdict": self.diagnosis.of_copy,
            "rests_on": [mistake.words for mistake in mistakes.mistakes],
        }


def _of_block(shown: Shown) -> dict[str, Any]:
    """Return what is shown of one of several blocks: its mountings, its coefficients, the test of its readings."""
    return {
        "mountings": [str(mount) for mount in shown.before.calibration.fitted.conditions().mounts],
        "coefficients": {name: asdict(change) for name, change in shown.coefficients.items()},
        "p_before": shown.before.test.p,
        "p_after": None if shown.after is None else shown.after.test.p,
    }


class TooLittleLeft(CalibrationError):
    """Mistakes are known and put right, and what is left, `corrected`, does not determine the coefficients.

    `copy` is the file of what is left, where it was written.
    """

    def __init__(
        self, mistakes: Sequence[Mistake], reason: str, corrected: Readings, *, simulated: bool
    ) -> None:
        self.mistakes = tuple(mistakes)
        self.corrected = corrected
        self.copy: Path | None = None
        self.simulated = simulated
        self.bench: Mapping[str, str] | None = None
        self.corrections: Sequence[Mapping[str, Any]] = ()
        self.reason = reason
        told = "; ".join(mistake.words for mistake in mistakes)
        super().__init__(f"a mistake: {told}; put right, {reason}")

    def to_dict(self, source: str) -> dict[str, Any]:
        """Return the promised result: the mistakes, and null or nothing where there is no fit."""
        found = [without_infinity(mistake_to_dict(mistake)) for mistake in self.mistakes]
        return {
            "verdict": "mistake",
            "where": [],
            "effects": found,
            "next_measurement": None,
            "hidden": [],
            "hidden_parts": {},
            "absent": {},
            "unseen_per_turn": [],
            "verification_orientation": None,
            "gap": None,
            "model": None,
            "noise": None,
            "p_left": None,
            "form": None,
            "detectable": {},
            "registered": None,
            "notes": [f"put right, {self.reason}"],
            "simulation": None,
            "coefficients": {},
            "ranking": [],
            "source": source,
            "simulated": self.simulated,
            "skipped_rows": [],
            "bench": None if self.bench is None else dict(self.bench),
            "corrections": [dict(one) for one in self.corrections],
            "report": None,
            "corrected": {
                "readings": None if self.copy is None else str(self.copy),
                "used": len(self.corrected),
                "verdict": None,
                "rests_on": [mistake.words for mistake in self.mistakes],
            },
        }


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
    coefficients: `TooLittleLeft` where some were known.
    """
    stand_u = {name: spread.u for name, spread in bench.stand_distributions().items()}
    sheet = np.array(bench.unit_under_test.scale_factors.values) if nominal is None else nominal
    sheet_of_unit = sheet if readings.unit == "V" else None
    there = KnownBench.of(bench) if stated else NOTHING_KNOWN
    try:
        diagnosis = diagnose(readings, model, stand_u, sheet_of_unit, cache, there)
    except CalibrationError as reason:
        if known:
            raise TooLittleLeft(known, str(reason), readings, simulated=simulated) from reason
        raise
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
