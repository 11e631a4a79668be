"""The gap on held-out readings: passes left out in turn, and the verification points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask
from bench.base.computing import tracked
from bench.base.languages import message
from bench.diagnosis.candidates import Candidates, replace_columns
from bench.diagnosis.evidence import Data, Threshold, Whitened
from bench.diagnosis.levels import BY_CHANCE as BY_CHANCE  # noqa: PLC0414 - also taken from here
from bench.diagnosis.levels import MOSTLY, OFTEN
from bench.diagnosis.linear import MODULUS, LinearSystem, Rows
from bench.diagnosis.naming import ALIAS, Naming, name
from bench.diagnosis.noise_grid import RATIOS, coupled, make_noise_grid, make_whitener
from bench.diagnosis.posterior import NoiseSize, posterior, predicted_error

FLOOR: Final = 1.0
"""Expected reduced chi-square of held-out readings when nothing is missing."""

LEAST_FALL: Final = 4.0
"""Least fall of the chi-square of held-out readings, in all and by each effect.

An absent effect of any size reaches this fall by noise in at most 2.3 % of cases.
"""


UNDETERMINED: Final = message("the rest does not determine the coefficients")


@dataclass(frozen=True)
class HeldOut:
    """The residuals, measured minus predicted, of n held-out readings, in the unit of the signal and in g, and
    their chi-square.

    `expected_g` (n,) is the standard deviation of each residual from noise and from the uncertainty of everything
    estimated.
    """

    error: Floats
    error_g: Floats
    expected_g: Floats
    chi2: float

    @property
    def reduced(self) -> float:
        """Chi-square divided by the number of rows."""
        return self.chi2 / len(self.error)


@dataclass(frozen=True)
class Fold:
    """A set of readings held out, predicted by the given model, and by the model with what a search of the other
    readings found.

    `gains` maps each name found in the other readings to the decrease of chi-square that it causes.
    """

    label: str
    gains: Mapping[str, float]
    before: HeldOut
    after: HeldOut


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
    def count(self) -> int:
        """The number of rows held out."""
        return sum(len(f.before.error) for f in self.folds)

    @property
    def before(self) -> float:
        """Reduced chi-square of the given model on held-out readings."""
        return sum(f.before.chi2 for f in self.folds) / max(self.count, 1)

    @property
    def after(self) -> float:
        """Reduced chi-square with the effects named, each fold with the effects found without it."""
        return sum(f.after.chi2 for f in self.folds) / max(self.count, 1)

    @property
    def closed(self) -> float | None:
        """The fraction of the gap above the floor that the named effects close; None if there is no gap."""
        return part_closed(self.before, self.after) if self.folds else None

    @property
    def p_after(self) -> float:
        """Probability that chance alone gives a chi-square larger than `after`."""
        return self._chance(self.after)

    def _chance(self, reduced: float) -> float:
        return float(special.fdtrc(self.count, self.freedom, reduced)) if self.count else float("nan")

    @property
    def before_rms(self) -> float:
        """Root mean square of measured less predicted in single channels, unit of the signal."""
        return rms([f.before.error for f in self.folds])

    @property
    def after_rms(self) -> float:
        """Root mean square of measured less predicted with the named effects, unit of the signal."""
        return rms([f.after.error for f in self.folds])

    @property
    def before_rms_g(self) -> float:
        """Root mean square of measured less predicted, g by the scale factors."""
        return rms([f.before.error_g for f in self.folds])

    @property
    def after_rms_g(self) -> float:
        """Root mean square of measured less predicted with the named effects, g by the scale factors."""
        return rms([f.after.error_g for f in self.folds])

    @property
    def expected_rms_g(self) -> float:
        """The expectation of `after_rms_g` when nothing is missing."""
        return rms([f.after.expected_g for f in self.folds])

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """The names that held-out readings do not confirm: the other readings gave them, but they improve the
        prediction too little.
        """
        return tuple(
            name
            for name in dict.fromkeys(self.named)
            if sum(fold.gains.get(name, 0.0) for fold in self.folds) < LEAST_FALL
        )

    @property
    def shrinks(self) -> bool | None:
        """Whether the gap shrinks by the rule registered; None where nothing was found, or no fold measures it.

        The chi-square falls by `LEAST_FALL`, in all and by each name. `MOSTLY` of the part above the floor
        closes, unless chance explains that part. Root mean squares do not decide: settings' errors rule them.
        """
        if not self.named or not self.folds:
            return None
        part = self.closed
        return (
            (self.before - self.after) * self.count >= LEAST_FALL
            and (part is None or part >= MOSTLY or self._chance(self.before) >= BY_CHANCE)
            and not self.unconfirmed
        )

    @property
    def reason(self) -> str:
        """The reason why held-out readings do not confirm the finds; empty if they do, or if there are no finds."""
        if not self.named or self.shrinks:
            return ""
        if not self.folds:
            cannot = f"; without {', '.join(self.undetermined)} {UNDETERMINED}" if self.undetermined else ""
            return message(f"nothing can be held out: one pass, and no verification or free position{cannot}")
        sizes = message(
            f"reduced chi-square {self.before:.2f} before, {self.after:.2f} after, root mean square "
            f"{1e6 * self.before_rms_g:.3g} µg before, {1e6 * self.after_rms_g:.3g} µg after"
        )
        if len(set(self.named)) > len(self.unconfirmed) > 0:
            return message(f"readings held out do not confirm {', '.join(self.unconfirmed)} ({sizes})")
        return message(f"the gap on readings held out does not shrink enough ({sizes})")


def part_closed(before: float, after: float) -> float | None:
    """Return the fraction of a gap above the floor that is closed; None if nothing was above the floor."""
    return (before - after) / (before - FLOOR) if before > FLOOR else None


def rms(parts: Sequence[Floats]) -> float:
    """Return the root mean square of all numbers together; NaN if there are none."""
    if not parts:
        return float("nan")
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


LEAST_FREEDOM: Final = 3
"""Readings beyond the number of coefficients from which there is a scatter to compare anything with."""
DETERMINED: Final = 1e-6
"""Smallest singular value over the largest of the coefficients' columns, scaled, from which they are determined."""

THIRDS: Final = 3
HELD_OUT: Final = message("readings held out in turn")


def folds_of(linear: LinearSystem) -> Iterator[tuple[str, Mask]]:
    """Yield what is held out in turn: each pass of the settings, and the rows of known modulus as a fold of their
    own.
    """
    oriented = linear.setting >= 0
    passes = linear.readings.pass_number[linear.rows.reading]
    numbers = sorted(set(passes[oriented].tolist()))
    if len(numbers) > 1:
        for number in numbers:
            yield f"pass {number}", oriented & (passes == number)
    modulus = linear.rows.channel == MODULUS
    if modulus.any():
        yield message("verification and free positions"), modulus


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
        yield message(f"every third setting, set {number + 1}"), third == number


FoldSearch = Callable[[Whitened, Data, Threshold, int], Naming]
"""Searches the readings that are not held out, for a number of effects at most."""


def measure_gap(
    linear: LinearSystem,
    whitened: Whitened,
    naming: Naming,
    noise: NoiseSize,
    threshold: Threshold,
    setting_rad: float,
    search: FoldSearch = name,
    parts: Sequence[tuple[str, Mask]] = (),
) -> Gap:
    """Hold readings out in turn; search the others, fit and predict. `whitened` are all readings.

    A search of the others finds no more effects than that of all readings did. `parts` are labels with the rows
    (N,) to hold out, by default passes and verification points. Where the other rows do not determine the finds
    and their forms (`_tell`), every third setting is held out instead.
    """
    hold = partial(
        _fold, linear, whitened, noise, threshold.at(OFTEN), setting_rad, search, len(naming.found)
    )
    if not parts:
        parts = list(folds_of(linear))
        every = all(determined(linear, ~held) for _, held in parts)
        if not every or not _tell(linear, whitened.candidates, naming, noise, parts):
            thirds = list(thirds_of(linear))
            parts = thirds if all(determined(linear, ~held) for _, held in thirds) else parts
    able = [(label, held) for label, held in parts if determined(linear, ~held)]
    folds = tuple(hold(label, held) for label, held in tracked(able, HELD_OUT))
    undetermined = tuple(label for label, _ in parts if label not in dict(able))
    families = tuple(one.variant.family for one in naming.found)
    return Gap(folds, noise, linear.readings.unit, noise.freedom, families, undetermined)


def _tell(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    noise: NoiseSize,
    parts: Sequence[tuple[str, Mask]],
) -> bool:
    """Return whether the readings beside each part, held out, show every find and tell its form.

    They show a find where they keep `MOSTLY` of the square of its signature. They tell its form unless another
    form of the family leaves at most `ALIAS` of the signature in them, and more than `LEAST_FALL` in all
    readings. Otherwise chance would choose the form that predicts the part.
    """
    amplitudes = posterior(linear, candidates.columns[:, list(naming.columns)], noise).amplitudes
    every = np.ones(len(linear), dtype=bool)
    for found, mine in naming.parts():
        variants = [candidates.variants[i] for i in candidates.of_family(found.variant.family)]
        used = sorted({column for one in variants for column in one.columns})
        forms = [np.searchsorted(used, one.columns) for one in variants]
        signature = candidates.columns[:, list(found.variant.columns)] @ amplitudes[mine]
        columns = np.column_stack([signature, candidates.columns[:, used]])
        whole, left = _left_by_forms(linear, noise, columns, forms, every)
        for _, held in parts:
            kept, left_in_rest = _left_by_forms(linear, noise, columns, forms, ~held)
            if kept < MOSTLY * whole or np.any((left_in_rest <= ALIAS**2) & (left > LEAST_FALL)):
                return False
    return True


def _left_by_forms(
    linear: LinearSystem, noise: NoiseSize, columns: Floats, forms: Sequence[Ints], rows: Mask
) -> tuple[float, Floats]:
    """Return the square of a signature in some rows, and the part that each form leaves (forms,), in units of
    noise.

    The first of the `columns` (N, 1 + m) is the signature; the `forms` have indices of the others.
    """
    white = make_whitener(restrict(linear, rows), noise.reading, noise.setting_rad)
    seen = white @ (columns[rows] / noise.reading)
    size = np.linalg.norm(seen, axis=0)
    gram = seen.T @ (seen / np.maximum(size, 1e-300)) / np.maximum(size, 1e-300)[:, None]
    explained = [
        gram[0, 1 + form]
        @ np.linalg.pinv(gram[np.ix_(1 + form, 1 + form)], DETERMINED, hermitian=True)
        @ gram[0, 1 + form]
        for form in forms
    ]
    whole = float(size[0] ** 2)
    return whole, whole * (1.0 - np.array(explained))


def determined(linear: LinearSystem, rows: Mask) -> bool:
    """Return whether the chosen rows determine the coefficients."""
    fixed = linear.fixed[rows] / np.linalg.norm(linear.fixed, axis=0)
    if len(fixed) < fixed.shape[1] + LEAST_FREEDOM:
        return False
    parts = [fixed[np.ix_(*part)] for part in coupled(fixed)]
    if any(len(part) < part.shape[1] for part in parts):
        return False
    sizes = np.concatenate([np.linalg.svd(part, compute_uv=False) for part in parts])
    return bool(sizes.min() > DETERMINED * sizes.max())


def _fold(
    linear: LinearSystem,
    whitened: Whitened,
    noise: NoiseSize,
    threshold: Threshold,
    setting_rad: float,
    search: FoldSearch,
    most: int,
    label: str,
    held: Mask,
) -> Fold:
    """Search without the rows `held`, and predict them."""
    part, candidates = restrict(linear, ~held), whitened.candidates
    kept = replace_columns(candidates, candidates.columns[~held])
    grid = make_noise_grid(part, whitened.grid.sigma, setting_rad, near_ratios(linear, noise))
    rest = Whitened.of(replace(grid, known=whitened.grid.known), kept)
    found = search(rest, rest.reduce(part.response[:, None]), threshold, most)
    rest.forget()
    predict = partial(_held_out, linear, candidates, noise, held)
    before, after = predict(()), predict(found.columns)
    gains: dict[str, float] = {}
    for one in found.found:
        without = predict(tuple(i for i in found.columns if i not in one.variant.columns))
        family = one.variant.family
        gains[family] = max(without.chi2 - after.chi2, gains.get(family, -np.inf))
    return Fold(label, gains, before, after)


def _held_out(
    linear: LinearSystem, candidates: Candidates, noise: NoiseSize, held: Mask, columns: Sequence[int]
) -> HeldOut:
    """Predict the rows `held` from all others, with the candidates' `columns`."""
    effects = candidates.columns[:, list(columns)]
    fitted = posterior(linear, effects, noise, ~held)
    error, chi2 = predicted_error(linear, effects, noise, fitted, held)
    design = linear.design(effects)[held]
    variance = (noise.reading * linear.relative[held]) ** 2 + (noise.setting_rad * linear.slope[held]) ** 2
    variance += np.einsum("ni,ij,nj->n", design, fitted.covariance, design)
    to_g = linear.g_per_signal[held]
    return HeldOut(error, error * to_g, np.sqrt(variance) * to_g, chi2)


def restrict(linear: LinearSystem, rows: Mask) -> LinearSystem:
    """Return the system with some of its rows; settings are numbered again."""
    setting = linear.setting[rows]
    present = {number: i for i, number in enumerate(dict.fromkeys(setting[setting >= 0].tolist()))}
    return replace(
        linear,
        rows=Rows(linear.rows.reading[rows], linear.rows.channel[rows]),
        response=linear.response[rows],
        fixed=linear.fixed[rows],
        random=linear.random[rows],
        slope=linear.slope[rows],
        by_row=None if linear.by_row is None else linear.by_row[rows],
        by_place=None if linear.by_place is None else linear.by_place[rows],
        setting=np.array([present.get(int(s), -1) for s in setting]),
    )


def near_ratios(linear: LinearSystem, noise: NoiseSize) -> tuple[float, ...]:
    """Return the three noise ratios of the grid around the ratio that fits all readings; the folds use only
    these.
    """
    ratio = noise.setting_rad / noise.reading * linear.typical_slope
    nearest = int(np.argmin(np.abs(np.array(RATIOS) - ratio)))
    first = min(max(nearest - 1, 0), len(RATIOS) - 3)
    return RATIOS[first : first + 3]
