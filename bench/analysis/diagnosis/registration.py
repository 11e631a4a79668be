"""What was settled before the readings were scored: hashed, so that nobody can say it was fitted to them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, replace

from bench.analysis.diagnosis import (
    candidates,
    evidence,
    gap,
    naming,
    noise_grid,
    threshold,
    visibility,
    where,
)
from bench.analysis.diagnosis.form import describe, scatter, search
from bench.analysis.diagnosis.holdout import folds_of, thirds_of
from bench.analysis.diagnosis.linear import LinearSystem
from bench.model import CATALOGUE


@dataclass(frozen=True)
class Registration:
    """What was settled; `sha256` is of all of it, the catalogue and the weights of the sizes.

    Priors, threshold, limits of a tie, what is held out (`held_out_else` where that measures nothing), and by how
    much the gap must shrink on it.
    """

    sha256: str
    unnamed: tuple[str, ...]
    sizes: tuple[float, ...]
    noise_ratios: tuple[float, ...]
    noise_ratio_spread: float
    threshold: float
    false_alarms: float
    tie_leak: float
    tie_evidence: float
    tie_absurd: float
    tie_least_explained: float
    pair_margin: float
    most_effects: int
    hidden_beyond: float
    significance_where: float
    gap_least_fall: float
    gap_least_closed: float
    gap_by_chance: float
    held_out: tuple[str, ...]
    held_out_else: tuple[str, ...]


def register(linear: LinearSystem, limit: threshold.Threshold) -> Registration:
    """Return what is settled for these readings, with its hash."""
    settled = Registration(
        sha256="",
        unnamed=candidates.UNNAMED,
        sizes=evidence.SIZES,
        noise_ratios=noise_grid.RATIOS,
        noise_ratio_spread=noise_grid.RATIO_SPREAD,
        threshold=round(limit.value, 9),
        false_alarms=limit.probability,
        tie_leak=naming.LEAK,
        tie_evidence=naming.LESS_PLAUSIBLE,
        tie_absurd=naming.ABSURD,
        tie_least_explained=naming.LEAST_EXPLAINED,
        pair_margin=naming.PAIR_MARGIN,
        most_effects=naming.MOST_EFFECTS,
        hidden_beyond=visibility.BEYOND_BELIEF,
        significance_where=where.SIGNIFICANT,
        gap_least_fall=gap.LEAST_FALL,
        gap_least_closed=gap.LEAST_CLOSED,
        gap_by_chance=gap.BY_CHANCE,
        held_out=tuple(label for label, _ in folds_of(linear)),
        held_out_else=tuple(label for label, _ in thirds_of(linear)),
    )
    hashed = asdict(settled) | {
        "catalogue": {name: [asdict(p) for p in effect.parameters] for name, effect in CATALOGUE.items()},
        "size_weights": [round(w, 12) for w in evidence.LOG_SIZE_WEIGHTS],
    }
    if limit.slip is not None:
        hashed["slip"] = [threshold.OF_SLIPS, round(limit.slip.value, 9)]
    if threshold.formulas():
        hashed["formulas"] = threshold.formulas()
    hashed["form"] = [search.MOST_TERMS, describe.LEAST_CLOSED, scatter.SIGNIFICANT, scatter.LARGER]
    del hashed["sha256"]
    text = json.dumps(hashed, sort_keys=True)
    return replace(settled, sha256=hashlib.sha256(text.encode()).hexdigest())
