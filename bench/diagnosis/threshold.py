"""How much evidence chance alone gives: the same search on simulated readings in which nothing is missing."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import logsumexp

from bench.base.arrays import Floats
from bench.diagnosis.evidence import LOG_SIZE_WEIGHTS, SIZES, Scores, Search, Whitened
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.noise_grid import RATIOS
from bench.model import CATALOGUE
from bench.model.effects import FormulaEffect

NULLS: Final = 2000
SEED: Final = 20260
FALSE_ALARMS: Final = 0.006
"""How often the search may find something where nothing is."""
OF_SLIPS: Final = 1 / 6
"""The part of it that is a slip's alone: it pays for sizes, axes and passes, and would be silent where it shows."""

TAIL: Final = 0.05
"""Upper part of the simulated evidences to which an exponential tail is fitted."""


CHANNEL_U: Final = 0.1
"""How well the size of a channel's noise is known, as a part of it: by some fifty readings."""
CHANNEL_STEP: Final = 1.5
"""Sizes of channels count as the same for a threshold where they are within such a factor: a coarse grid."""


@dataclass(frozen=True)
class Threshold:
    """Evidence (ln odds of anything at all) that chance reaches, or a slip's likelihood, with `probability`.

    Above `start` the chance of more falls by e for each `decay`; `p_start` is the chance of `start`. `slip`, that
    of slips alone, is None where none is sought: then all of the probability is that of `value`.
    """

    value: float
    probability: float
    start: float
    p_start: float
    decay: float
    nulls: int
    slip: Threshold | None = None

    def at(self, probability: float) -> Threshold:
        """Return the evidence that chance reaches with another probability."""
        slip = None if self.slip is None else self.slip.at(OF_SLIPS * probability)
        own = probability if slip is None else (1.0 - OF_SLIPS) * probability
        value = self.start + self.decay * float(np.log(self.p_start / own))
        return replace(self, value=value, probability=probability, slip=slip)

    def p(self, evidence: float, of_slip: float = 0.0) -> float:
        """Probability that chance gives so much of either, all looks counted; 1 below the fitted tails.

        `of_slip` is ln of the ratio of likelihoods of a slip.
        """
        own = 1.0
        if evidence > self.start:
            own = float(self.p_start * np.exp(-(evidence - self.start) / self.decay))
        if self.slip is None:
            return own
        return min(own / (1.0 - OF_SLIPS), self.slip.p(of_slip) / OF_SLIPS, 1.0)

    def reached(self, evidence: float, of_slip: float) -> bool:
        """Whether either is as much as chance seldom gives."""
        return evidence >= self.value or self.by_slip(of_slip)

    def by_slip(self, of_slip: float) -> bool:
        """Whether the likelihood of a slip is."""
        return self.slip is not None and of_slip >= self.slip.value


def total_evidence(scores: Scores, whitened: Whitened) -> Floats:
    """Return ln of the mean evidence over all families (sets,): the odds that anything is missing."""
    families = scores.families(whitened.candidates)
    return np.asarray(logsumexp(families, axis=0) - np.log(len(families)), dtype=np.float64)


def null_responses(linear: LinearSystem, sigma: float, ratios: Floats, rng: np.random.Generator) -> Floats:
    """Draw responses (N, sets) of readings in which nothing is missing; `ratios` (sets,) of the noise."""
    sets = len(ratios)
    setting = rng.standard_normal((linear.settings, sets)) * ratios / linear.typical_slope
    response = rng.standard_normal((len(linear), sets)) * _row_sizes(linear, sets, rng)
    response += np.where(linear.setting >= 0, linear.slope, 0.0)[:, None] * setting[linear.setting]
    response *= sigma
    if linear.random.shape[1]:
        response += linear.random @ rng.standard_normal((linear.random.shape[1], sets))
    return response


def _row_sizes(linear: LinearSystem, sets: int, rng: np.random.Generator) -> Floats:
    """Return the noise of the rows: where channels or runs differ, as far off the estimates as these are."""
    size = linear.relative[:, None]
    if np.any(linear.by_channel != 1.0):
        size = size * np.exp(CHANNEL_U * rng.standard_normal((4, sets)))[linear.rows.channel]
    if linear.by_run is not None:
        u = np.sqrt(0.5 / linear.by_run.freedom)[:, None]
        off = np.exp(u * rng.standard_normal((len(u), sets)))
        size = size * off[linear.readings.run[linear.rows.reading]]
    return np.asarray(size)


def make_threshold(linear: LinearSystem, whitened: Whitened, nulls: int = NULLS) -> Threshold:
    """Simulate `nulls` data sets on this very design and find what chance gives.

    The ratio of the two noise sizes is drawn from what the bench file says of it.
    """
    rng = np.random.default_rng(SEED)
    grid = whitened.grid
    ratios = rng.choice(np.array(RATIOS), nulls, p=np.exp(grid.log_prior))
    search = Search.beside(whitened, ())
    data = whitened.reduce(null_responses(linear, grid.sigma, ratios, rng))
    whole = fit_tail(total_evidence(search.score(data), whitened))
    slips = whitened.candidates.slips
    if not slips:
        return whole
    return replace(whole, slip=fit_tail(search.likelihood_ratio(data, slips))).at(FALSE_ALARMS)


def fit_tail(evidence: Floats) -> Threshold:
    """Fit an exponential to the upper tail of simulated evidences: its quantile scatters less than theirs."""
    ordered = np.sort(evidence)
    many = max(int(TAIL * len(ordered)), 10)
    start = float(ordered[-many - 1])
    decay = float(np.mean(ordered[-many:] - start))
    p_start = many / len(ordered)
    return Threshold(start, p_start, start, p_start, decay, len(ordered)).at(FALSE_ALARMS)


@dataclass(frozen=True)
class ThresholdCache:
    """Thresholds of designs that were met before, a small JSON file each in `folder` (None: none is kept).

    A design is known by all that its threshold depends on: angles (to 1 arcmin), times (10 s), temperatures
    (0.01 K), directions, mountings, passes, the stand's limits, the scale of the block and the noise (to 10 %),
    the catalogue and the priors.
    """

    folder: Path | None

    def threshold(self, linear: LinearSystem, whitened: Whitened, setting_rad: float) -> Threshold:
        """Return the threshold of a design, simulated where it is not known yet."""
        if self.folder is None:
            return make_threshold(linear, whitened)
        file = self.folder / f"{_key(linear, whitened, setting_rad)}.json"
        try:
            return _of_file(json.loads(file.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            made = make_threshold(linear, whitened)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(f".{os.getpid()}")
            part.write_text(json.dumps(asdict(made)), encoding="utf-8")
            part.replace(file)
        except OSError:
            pass  # the cache saves time and nothing else
        return made


def _of_file(fields: dict[str, Any]) -> Threshold:
    slip = fields.pop("slip")
    return Threshold(**fields, slip=None if slip is None else Threshold(**slip))


def _key(linear: LinearSystem, whitened: Whitened, setting_rad: float) -> str:
    readings = linear.readings
    scale = np.abs(np.diag(linear.block.K)).mean()
    parts: list[object] = [
        readings.unit,
        readings.installation.tolist(),
        readings.series.tolist(),
        readings.pass_number.tolist(),
        readings.point.tolist(),
        readings.direction.tolist(),
        np.round(np.degrees(readings.angle_rad) * 60).tolist(),
        np.round(readings.time_s / 10).tolist(),
        np.round(readings.temperature_c, 2).tolist(),
        {name: cells.tolist() for name, cells in readings.extra.items() if name in DESIGN_COLUMNS},
        np.round(linear.conditions.above_nominal_v, 2).tolist(),
        {k: np.round(v.block_from_platform, 2).tolist() for k, v in linear.model.installations.items()},
        [(a.effect.name, a.channels, a.installations, sorted(a.values)) for a in linear.model.effects],
        np.round(linear.block.K / scale, 2).tolist(),
        np.round(linear.block.U0 / scale, 2).tolist(),
        round(float(np.log(scale)) * 50),
        round(float(np.log(whitened.grid.sigma / scale)) * 10),
        round(setting_rad * 1e9),
        np.round(np.linalg.norm(linear.random, axis=0) / scale, 6).tolist(),
        repr([(name, effect.parameters) for name, effect in CATALOGUE.items()]),
        whitened.candidates.families,
        (NULLS, SEED, FALSE_ALARMS, OF_SLIPS, TAIL, SIZES, LOG_SIZE_WEIGHTS, RATIOS, CHANNEL_U),
        channel_steps(linear),
    ]
    if readings.run.any():
        parts += [readings.run.tolist(), None if readings.block is None else readings.block.tolist()]
    if linear.by_run is not None:
        parts += [size_steps(linear.by_run.sizes), np.round(linear.by_run.freedom / 10).tolist()]
    parts += formulas()
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def channel_steps(linear: LinearSystem) -> list[int]:
    """Return the sizes of the channels' noise on the coarse grid of thresholds."""
    return size_steps(linear.by_channel)


def size_steps(sizes: Floats) -> list[int]:
    """Return sizes of noise on that grid."""
    steps: list[int] = np.round(np.log(sizes) / np.log(CHANNEL_STEP)).astype(int).tolist()
    return steps


DESIGN_COLUMNS: Final = ("scan_order", "reference_v", "range_v")


def formulas() -> list[str]:
    """Return the formulas of the effects that are stated as one: their parameters do not tell all of them."""
    return [
        f"{effect.name}, {effect.stage} {effect.adds_to}: {effect.expression}"
        for effect in CATALOGUE.values()
        if isinstance(effect, FormulaEffect)
    ]
