"""The gap on held-out readings: passes left out in turn, and the verification points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Mask
from bench.base.computing import tracked
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.evidence import Search, Threshold, Whitened
from bench.diagnosis.linear import MODULUS, LinearSystem, Rows
from bench.diagnosis.naming import Naming, name
from bench.diagnosis.noise_grid import RATIOS, coupled, make_noise_grid
from bench.diagnosis.posterior import NoiseSize, posterior, predicted_error, whiten_rows

FLOOR: Final = 1.0
"""Expected reduced chi-square of held-out readings when nothing is missing."""

LEAST_FALL: Final = 4.0
"""By so much must the chi-square of readings held out fall, in all and by each effect.

An effect that is not there, of whatever size, gains so much from their noise in no more than 2.3 %.
"""

LEAST_CLOSED: Final = 0.5
"""So much of what is above the floor must close, where it is above it by more than chance."""

BY_CHANCE: Final = 0.01
"""A gap that chance alone reaches so often is none: of that, no part can be asked for."""

BLIND: Final = "the rest could not have shown what was found"
NOT_THERE: Final = "what was found does not show there"
OWN_VALUE: Final = "what was found has a value of its own there, of which the rest says nothing"
BLINDNESS: Final = (BLIND, NOT_THERE, OWN_VALUE)
UNDETERMINED: Final = "the rest does not determine the coefficients"


@dataclass(frozen=True)
class HeldOut:
    """Measured less predicted in readings held out (n,), in the unit of the signal and in g, and its chi-square.

    `expected_g` (n,) is the standard deviation that noise and all that was estimated give it.
    """

    error: Floats
    error_g: Floats
    expected_g: Floats
    chi2: float

    @property
    def reduced(self) -> float:
        """Chi-square over the number of rows."""
        return self.chi2 / len(self.error)


@dataclass(frozen=True)
class Fold:
    """Readings held out, predicted by the model as it was given and with what the others named.

    `gains` says of each name that the search on the others gave by how much the chi-square is smaller for it.
    `blind` is why they cannot confirm what was found, as worked out before these were opened; empty where they can.
    """

    label: str
    gains: Mapping[str, float]
    before: HeldOut
    after: HeldOut
    blind: str

    @property
    def confirmable(self) -> bool:
        """Whether the others could have shown what was found."""
        return not self.blind

    @property
    def counted(self) -> bool:
        """Whether the fold counts: it can confirm the finds, or the effects named without it worsen it."""
        worse = self.after.chi2 - self.before.chi2 >= LEAST_FALL
        return self.confirmable or (worse and self.blind == BLIND)


@dataclass(frozen=True)
class Gap:
    """Reduced chi-square of the readings held out, before and after; its expectation is 1 (`floor`).

    `named` are the names that should close it. `undetermined` are readings that could not be held out, because the
    others do not determine the coefficients.
    """

    folds: tuple[Fold, ...]
    noise: NoiseSize
    unit: str
    freedom: int
    named: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()

    @property
    def opened(self) -> tuple[Fold, ...]:
        """The folds that count."""
        return tuple(f for f in self.folds if f.counted)

    @property
    def left_out(self) -> tuple[Fold, ...]:
        """The folds that do not count."""
        return tuple(f for f in self.folds if not f.counted)

    @property
    def count(self) -> int:
        """The number of rows in the folds that count."""
        return sum(len(f.before.error) for f in self.opened)

    @property
    def before(self) -> float:
        """Reduced chi-square of the given model on held-out readings."""
        return sum(f.before.chi2 for f in self.opened) / max(self.count, 1)

    @property
    def after(self) -> float:
        """Reduced chi-square with what was named, each fold by itself."""
        return sum(f.after.chi2 for f in self.opened) / max(self.count, 1)

    @property
    def closed(self) -> float | None:
        """The fraction of the gap above the floor that naming closes; None where there is no gap."""
        return part_closed(self.before, self.after) if self.opened else None

    @property
    def p_after(self) -> float:
        """Probability of more than `after` by chance."""
        return self._chance(self.after)

    def _chance(self, reduced: float) -> float:
        return float(special.fdtrc(self.count, self.freedom, reduced)) if self.count else float("nan")

    @property
    def before_rms(self) -> float:
        """Root mean square of measured less predicted in single channels, unit of the signal."""
        return rms([f.before.error for f in self.opened])

    @property
    def after_rms(self) -> float:
        """The same with what was named."""
        return rms([f.after.error for f in self.opened])

    @property
    def before_rms_g(self) -> float:
        """Root mean square of measured less predicted, g by the scale factors."""
        return rms([f.before.error_g for f in self.opened])

    @property
    def after_rms_g(self) -> float:
        """The same with what was named."""
        return rms([f.after.error_g for f in self.opened])

    @property
    def expected_rms_g(self) -> float:
        """The expectation of `after_rms_g` when nothing is missing."""
        return rms([f.after.expected_g for f in self.opened])

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """The names that readings held out do not confirm: where the rest gave them, they gain too little."""
        return tuple(
            name
            for name in dict.fromkeys(self.named)
            if sum(fold.gains.get(name, 0.0) for fold in self.opened) < LEAST_FALL
        )

    @property
    def shrinks(self) -> bool | None:
        """Whether the gap shrinks by the rule registered; None where nothing was found, or no fold measures it.

        The chi-square falls by `LEAST_FALL`, in all and by each name; `LEAST_CLOSED` of what is above the floor
        closes, where chance does not reach that; and no root mean square rises, in the signal's unit or in g.
        """
        if not self.named or not self.opened:
            return None
        part = self.closed
        return (
            (self.before - self.after) * self.count >= LEAST_FALL
            and (part is None or part >= LEAST_CLOSED or self._chance(self.before) >= BY_CHANCE)
            and self.after_rms <= self.before_rms
            and self.after_rms_g <= self.before_rms_g
            and not self.unconfirmed
        )

    @property
    def reason(self) -> str:
        """Why held-out readings do not confirm the finds; empty where they do, or without finds."""
        if not self.named or self.shrinks:
            return ""
        if not self.folds:
            cannot = f"; without {', '.join(self.undetermined)} {UNDETERMINED}" if self.undetermined else ""
            return f"nothing can be held out: one pass, and no verification or free position{cannot}"
        if not self.opened:
            why = {blind: [f.label for f in self.folds if f.blind == blind] for blind in BLINDNESS}
            told = "; ".join(f"{', '.join(labels)}: {blind}" for blind, labels in why.items() if labels)
            return f"nothing held out can measure the gap ({told})"
        sizes = (
            f"reduced chi-square {self.before:.2f} before, {self.after:.2f} after, root mean square "
            f"{1e6 * self.before_rms_g:.3g} µg before, {1e6 * self.after_rms_g:.3g} µg after"
        )
        if len(set(self.named)) > len(self.unconfirmed) > 0:
            return f"readings held out do not confirm {', '.join(self.unconfirmed)} ({sizes})"
        return f"the gap on readings held out does not shrink enough ({sizes})"


def part_closed(before: float, after: float) -> float | None:
    """Return the part of a gap above the floor that is closed; None where nothing was above it."""
    return (before - after) / (before - FLOOR) if before > FLOOR else None


def rms(parts: Sequence[Floats]) -> float:
    """Return the root mean square of all numbers together; NaN of none."""
    if not parts:
        return float("nan")
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


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
    """Return whether the chosen rows determine the coefficients."""
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
    """The finds at their sizes, and their squared signal-to-noise in all readings, from the design.

    `amplitudes` belong to the columns of `naming`. `each` is the square for each find beside the others,
    `whole` the square for all finds together, in units of the noise squared.
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
