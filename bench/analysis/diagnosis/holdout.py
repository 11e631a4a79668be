"""The gap on readings that the naming did not use: whole passes held out in turn, and the verification points.

Where none of these can measure it (something that acts in one pass alone, a single pass), every third setting is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.coupled import coupled
from bench.analysis.diagnosis.evidence import Search, Whitened
from bench.analysis.diagnosis.gap import BLIND, LEAST_FALL, NOT_THERE, OWN_VALUE, Fold, Gap, HeldOut
from bench.analysis.diagnosis.linear import MODULUS, LinearSystem, Rows
from bench.analysis.diagnosis.naming import Naming, name
from bench.analysis.diagnosis.noise_grid import RATIOS, make_noise_grid
from bench.analysis.diagnosis.posterior import NoiseSize, posterior, predicted_error, whiten_rows
from bench.analysis.diagnosis.threshold import Threshold
from bench.base.arrays import Floats, Mask
from bench.base.progress import tracked

SURE: Final = 2.0
"""Beyond the size that half of the searches find, in units of noise: so large is found nearly always."""

DETERMINED: Final = 1e-6
"""Smallest singular value over the largest of the coefficients' columns, scaled, from which they are determined."""

LEAST_HELD: Final = 1.0
"""What is held out can say nothing of what was found where less than this square of it shows there."""

UNSEEN: Final = 1e-9
THIRDS: Final = 3
HELD_OUT: Final = "readings held out in turn"


def folds_of(linear: LinearSystem) -> Iterator[tuple[str, Mask]]:
    """Yield what is held out in turn: each pass of the settings, and the rows of known modulus alone."""
    oriented = linear.setting >= 0
    passes = linear.readings.pass_number[linear.rows.reading]
    numbers = sorted(set(passes[oriented].tolist()))
    if len(numbers) > 1:
        for number in numbers:
            yield f"pass {number}", oriented & (passes == number)
    modulus = linear.rows.channel == MODULUS
    if modulus.any():
        yield "verification and free positions", modulus


def thirds_of(linear: LinearSystem) -> Iterator[tuple[str, Mask]]:
    """Yield every third setting of each pass, at other angles in the next one, and every third known modulus."""
    readings, reading = linear.readings, linear.rows.reading
    third = np.full(len(linear), -1)
    next_third: dict[tuple[str, int, int], int] = {}
    last = -1
    for row in np.flatnonzero((linear.setting >= 0) | (linear.rows.channel == MODULUS)).tolist():
        i = int(reading[row])
        if i != last:
            key = (str(readings.installation[i]), int(readings.series[i]), int(readings.pass_number[i]))
            now = next_third.setdefault(key, len(next_third)) % THIRDS
            next_third[key], last = now + 1, i
        third[row] = now
    for number in range(THIRDS):
        yield f"every third setting, set {number + 1}", third == number


def measure_gap(
    linear: LinearSystem,
    whitened: Whitened,
    naming: Naming,
    noise: NoiseSize,
    threshold: Threshold,
    setting_rad: float,
) -> Gap:
    """Hold readings out in turn; name, fit and predict without them. `whitened` are all readings."""
    shown = _Shown.of(linear, whitened, naming, noise)
    hold = partial(_fold, linear, whitened, shown, noise, threshold, setting_rad)
    possible = [(label, held, determined(linear, ~held)) for label, held in folds_of(linear)]
    folds = [hold(label, held) for label, held, able in tracked(possible, HELD_OUT) if able]
    undetermined = tuple(label for label, _, able in possible if not able)
    if naming.found and not any(fold.counted for fold in folds):
        thirds = [(label, held) for label, held in thirds_of(linear) if determined(linear, ~held)]
        folds += [hold(label, held) for label, held in tracked(thirds, HELD_OUT)]
    families = tuple(one.variant.family for one in naming.found)
    return Gap(tuple(folds), noise, linear.readings.unit, noise.freedom, families, undetermined)


def determined(linear: LinearSystem, rows: Mask) -> bool:
    """Whether some of the rows determine the coefficients."""
    fixed = linear.fixed[rows] / np.linalg.norm(linear.fixed, axis=0)
    if len(fixed) <= fixed.shape[1]:
        return False
    parts = [fixed[np.ix_(*part)] for part in coupled(fixed)]
    if any(len(part) < part.shape[1] for part in parts):
        return False
    sizes = np.concatenate([np.linalg.svd(part, compute_uv=False) for part in parts])
    return bool(sizes.min() > DETERMINED * sizes.max())


def _fold(
    linear: LinearSystem,
    whitened: Whitened,
    shown: _Shown,
    noise: NoiseSize,
    threshold: Threshold,
    setting_rad: float,
    label: str,
    held: Mask,
) -> Fold:
    """Name without the rows `held`, and predict them."""
    part, candidates = restrict(linear, ~held), whitened.candidates
    kept = Candidates(candidates.columns[~held], candidates.kinds, candidates.scale, candidates.variants)
    grid = make_noise_grid(part, whitened.grid.sigma, setting_rad, near_ratios(linear, noise))
    rest = Whitened.of(grid, kept)
    found = name(rest, rest.reduce(part.response[:, None]), threshold)
    predict = partial(_held_out, linear, candidates, noise, held)
    before, after = predict(()), predict(found.columns)
    gains: dict[str, float] = {}
    for one in found.found:
        without = predict(tuple(i for i in found.columns if i not in one.variant.columns))
        family = one.variant.family
        gains[family] = max(without.chi2 - after.chi2, gains.get(family, -np.inf))
    return Fold(label, gains, before, after, shown.blind(rest, linear, held, threshold))


def _held_out(
    linear: LinearSystem, candidates: Candidates, noise: NoiseSize, held: Mask, columns: Sequence[int]
) -> HeldOut:
    """Predict the rows `held` from all others, with the candidates' `columns`."""
    effects = candidates.columns[:, list(columns)]
    fitted = posterior(linear, effects, noise, ~held)
    error, chi2 = predicted_error(linear, effects, noise, fitted, held)
    design = np.concatenate([linear.fixed, linear.random, effects], axis=1)[held]
    variance = (noise.reading * linear.relative[held]) ** 2 + (noise.setting_rad * linear.slope[held]) ** 2
    variance += np.einsum("ni,ij,nj->n", design, fitted.covariance, design)
    to_g = linear.g_per_signal[held]
    return HeldOut(error, error * to_g, np.sqrt(variance) * to_g, chi2)


@dataclass(frozen=True)
class _Shown:
    """What was found, at its size, and how far all readings show it: from the design, not from their values.

    `amplitudes` are of the columns of `naming`, `each` is the square of how far each find stands out beside the
    others, `whole` of all together, units of noise.
    """

    candidates: Candidates
    naming: Naming
    noise: NoiseSize
    amplitudes: Floats
    each: tuple[float, ...]
    whole: float

    @classmethod
    def of(cls, linear: LinearSystem, whitened: Whitened, naming: Naming, noise: NoiseSize) -> _Shown:
        columns = whitened.candidates.columns[:, list(naming.columns)]
        amplitudes = posterior(linear, columns, noise).amplitudes
        bare = cls(whitened.candidates, naming, noise, amplitudes, (), 0.0)
        ratio = RATIOS.index(near_ratios(linear, noise)[1])
        return replace(bare, each=bare._each(whitened, ratio), whole=bare._whole(whitened, ratio))

    def _each(self, whitened: Whitened, ratio: int) -> tuple[float, ...]:
        parts = []
        for one, place in self.naming.parts():
            mine = list(one.variant.columns)
            search = Search.beside(whitened, [c for c in self.naming.columns if c not in mine])
            gram = search.between(ratio, mine)
            parts.append(self._square(whitened, gram, self.amplitudes[place]))
        return tuple(parts)

    def _whole(self, whitened: Whitened, ratio: int) -> float:
        columns = list(self.naming.columns)
        return self._square(whitened, whitened.among(ratio, columns), self.amplitudes)

    def _square(self, whitened: Whitened, gram: Floats, part: Floats) -> float:
        return max(float(part @ gram @ part), 0.0) * (whitened.grid.sigma / self.noise.reading) ** 2

    def blind(self, rest: Whitened, linear: LinearSystem, held: Mask, threshold: Threshold) -> str:
        """Return why the rest cannot confirm what was found in the rows held out; nothing where it can."""
        if not self.naming.found:
            return ""
        half = np.sqrt(2.0 * max(threshold.value + np.log(len(rest.candidates.families)), 1.0))
        sure = (half + SURE) ** 2
        middle = rest.ratios // 2
        if self._own_value(linear, held) >= LEAST_FALL:
            return OWN_VALUE
        whole = self._whole(rest, middle)
        if whole < sure:
            return BLIND
        there = self.whole - whole
        if there < LEAST_HELD:
            return NOT_THERE
        unseen = [
            one - left for one, left in zip(self.each, self._each(rest, middle), strict=True) if left < sure
        ]
        return BLIND if len(self.each) > 1 and sum(unseen) > there / 2 else ""

    def _own_value(self, linear: LinearSystem, held: Mask) -> float:
        """Return the square of what numbers that act in the rows held out alone put there."""
        columns = self.candidates.columns[:, list(self.naming.columns)]
        reach = np.max(np.abs(columns), axis=0)
        own = np.max(np.abs(columns[~held]), axis=0) <= UNSEEN * reach
        acts = (columns[:, own] @ self.amplitudes[own])[held]
        return float(np.sum(whiten_rows(linear, self.noise, acts[:, None], held) ** 2))


def restrict(linear: LinearSystem, rows: Mask) -> LinearSystem:
    """Return the system with some of its rows; settings are numbered anew."""
    setting = linear.setting[rows]
    present = {number: i for i, number in enumerate(dict.fromkeys(setting[setting >= 0].tolist()))}
    return replace(
        linear,
        rows=Rows(linear.rows.reading[rows], linear.rows.channel[rows]),
        response=linear.response[rows],
        fixed=linear.fixed[rows],
        random=linear.random[rows],
        slope=linear.slope[rows],
        setting=np.array([present.get(int(s), -1) for s in setting]),
    )


def near_ratios(linear: LinearSystem, noise: NoiseSize) -> tuple[float, ...]:
    """Return the ratios of the grid next to what the whole data say: for the folds, which have less of it."""
    ratio = noise.setting_rad / noise.reading * linear.typical_slope
    nearest = int(np.argmin(np.abs(np.array(RATIOS) - ratio)))
    first = min(max(nearest - 1, 0), len(RATIOS) - 3)
    return RATIOS[first : first + 3]
