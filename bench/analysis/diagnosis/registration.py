"""What was settled before the readings were scored: hashed, so that nobody can say it was fitted to them."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any

from bench.analysis.diagnosis import candidates, evidence, naming, noise_grid, threshold, visibility, where
from bench.analysis.diagnosis.holdout import folds_of
from bench.analysis.diagnosis.linear import LinearSystem
from bench.model import CATALOGUE


def register(linear: LinearSystem, limit: threshold.Threshold) -> dict[str, Any]:
    """Return catalogue, priors, threshold, limits of a tie and what is held out, with their SHA-256."""
    settled: dict[str, Any] = {
        "catalogue": {
            name: [asdict(parameter) for parameter in effect.parameters] for name, effect in CATALOGUE.items()
        },
        "unnamed": list(candidates.UNNAMED),
        "sizes": list(evidence.SIZES),
        "size_weights": [round(w, 12) for w in evidence.LOG_SIZE_WEIGHTS],
        "noise_ratios": list(noise_grid.RATIOS),
        "noise_ratio_spread": noise_grid.RATIO_SPREAD,
        "threshold": round(limit.value, 9),
        "false_alarms": limit.probability,
        "tie_leak": naming.LEAK,
        "tie_evidence": naming.LESS_PLAUSIBLE,
        "tie_absurd": naming.ABSURD,
        "pair_margin": naming.PAIR_MARGIN,
        "most_effects": naming.MOST_EFFECTS,
        "hidden_beyond": visibility.BEYOND_BELIEF,
        "significance_where": where.SIGNIFICANT,
        "held_out": [label for label, _ in folds_of(linear)],
    }
    text = json.dumps(settled, sort_keys=True)
    told = {key: value for key, value in settled.items() if key not in {"catalogue", "size_weights"}}
    return {"sha256": hashlib.sha256(text.encode()).hexdigest(), **told}
