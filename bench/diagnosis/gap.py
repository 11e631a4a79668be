"""The gap between readings and model, measured on held-out readings (cross-validation).

The readings held out are, in turn, each pass and all verification points. The gap is their reduced chi-square,
which is 1 (the floor) if the model lacks nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask, rms
from bench.base.computing import tracked
from bench.base.languages import message
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.evidence import Data, Threshold, Whitened
from bench.diagnosis.levels import BY_CHANCE, INSEPARABLE, LEAST_FREEDOM, MOSTLY, OFTEN
from bench.diagnosis.linear import MODULUS, LinearSystem, Rows
from bench.diagnosis.naming import ALIAS, FoundEffect, Naming, find
from bench.diagnosis.noise_grid import RATIOS, coupled, make_noise_grid, make_whitener
from bench.diagnosis.posterior import NoiseSize, posterior, whiten_rows

FLOOR: Final = 1.0
"""Expected reduced chi-square of held-out readings if the model lacks no effect."""

LEAST_FALL: Final = 4.0
"""Least decrease of the chi-square of held-out readings, by all effects together and by each of them.

For an effect that is not present, noise alone gives this decrease in at most 2.3 % of cases.
"""


UNDETERMINED: Final = message("the rest does not determine the coefficients")


@dataclass(frozen=True)
class HeldOut:
    """How well one model predicts the n held-out rows, after a fit to all other rows.

    `error` (n,) is measured minus predicted, unit of the signal; `error_g` (n,) is the same in g. `expected_g` (n,)
    is the standard deviation of `error_g` that noise and uncertain estimates imply. `chi2` is that of the errors,
    with their full covariance.
    """

    error: Floats
    error_g: Floats
    expected_g: Floats
    chi2: float

    @property
    def reduced(self) -> float:
        """Chi-square divided by the number of rows held out."""
        return self.chi2 / len(self.error)


@dataclass(frozen=True)
class Fold:
    """One set of held-out rows, and its predictions from all other rows.

    `before` is the prediction without the effects found in the other rows, `after` the prediction with them.
    `gains` maps the name of each of these effects to the increase of chi-square without it.
    """

    label: str
    gains: Mapping[str, float]
    before: HeldOut
    after: HeldOut


@dataclass(frozen=True)
class Gap:
    """The prediction of held-out readings by the given model, and by the model with the effects found.

    `named` are the effects found in all readings together. `undetermined` are the sets that cannot be held
    out, because the other readings do not determine the coefficients. Chi-square is in units of `noise`.
    """

    folds: tuple[Fold, ...]
    noise: NoiseSize
    unit: str
    named: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """The number of rows held out."""
        return sum(len(f.before.error) for f in self.folds)

    @property
    def before(self) -> float:
        """Reduced chi-square of all held-out rows, predicted by the given model."""
        return sum(f.before.chi2 for f in self.folds) / max(self.count, 1)

    @property
    def after(self) -> float:
        """Reduced chi-square of all held-out rows, predicted with the effects that the other rows show."""
        return sum(f.after.chi2 for f in self.folds) / max(self.count, 1)

    @property
    def closed(self) -> float | None:
        """The fraction of the excess of reduced chi-square over 1 that the effects found remove.

        None if there is no excess, or nothing was held out.
        """
        return part_closed(self.before, self.after) if self.folds else None

    @property
    def p_after(self) -> float:
        """Probability that chance gives a reduced chi-square of at least `after`; NaN if nothing was held out."""
        return (
            float(special.fdtrc(self.count, self.noise.freedom, self.after)) if self.count else float("nan")
        )

    def _rms(self, of: Callable[[Fold], Floats]) -> float:
        return rms(np.concatenate([np.zeros(0), *map(of, self.folds)]))

    @property
    def before_rms(self) -> float:
        """Root mean square of measured minus predicted, unit of the signal, for the given model."""
        return self._rms(lambda fold: fold.before.error)

    @property
    def after_rms(self) -> float:
        """Root mean square of measured minus predicted, unit of the signal, with the effects found."""
        return self._rms(lambda fold: fold.after.error)

    @property
    def before_rms_g(self) -> float:
        """Root mean square of measured minus predicted, g, for the given model."""
        return self._rms(lambda fold: fold.before.error_g)

    @property
    def after_rms_g(self) -> float:
        """Root mean square of measured minus predicted, g, with the effects found."""
        return self._rms(lambda fold: fold.after.error_g)

    @property
    def expected_rms_g(self) -> float:
        """The expected `after_rms_g` if the model with the effects found lacks nothing."""
        return self._rms(lambda fold: fold.after.expected_g)

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """The names of the effects whose gains, summed over all folds, are below `LEAST_FALL`."""
        return tuple(
            name
            for name in dict.fromkeys(self.named)
            if sum(fold.gains.get(name, 0.0) for fold in self.folds) < LEAST_FALL
        )

    @property
    def shrinks(self) -> bool | None:
        """Whether held-out readings confirm the effects found; None without effects or held-out readings.

        Chi-square must fall by at least `LEAST_FALL` for all effects together, and for each of them. At least
        the fraction `MOSTLY` of the excess of reduced chi-square over 1 must vanish, unless chance explains
        the rest. Root mean squares do not count, because setting errors dominate them.
        """
        if not self.named or not self.folds:
            return None
        part = self.closed
        return (
            (self.before - self.after) * self.count >= LEAST_FALL
            and (part is None or part >= MOSTLY or self.p_after >= BY_CHANCE)
            and not self.unconfirmed
        )

    @property
    def reason(self) -> str:
        """A sentence that says why held-out readings do not confirm the effects found; empty if they do."""
        if not self.named or self.shrinks:
            return ""
        if not self.folds:
            cannot = f"; without {', '.join(self.undetermined)} {UNDETERMINED}" if self.undetermined else ""
            return message(
                f"no readings can be held out: one pass, and no verification or free position{cannot}"
            )
        sizes = message(
            f"reduced chi-square {self.before:.2f} before, {self.after:.2f} after, root mean square "
            f"{1e6 * self.before_rms_g:.3g} µg before, {1e6 * self.after_rms_g:.3g} µg after"
        )
        if len(set(self.named)) > len(self.unconfirmed) > 0:
            return message(f"held-out readings do not confirm {', '.join(self.unconfirmed)} ({sizes})")
        return message(f"the gap on held-out readings does not shrink enough ({sizes})")


def part_closed(before: float, after: float) -> float | None:
    """Return the fraction of the excess of reduced chi-square over 1 that vanishes; None if there is no excess."""
    return (before - after) / (before - FLOOR) if before > FLOOR else None


HELD_OUT: Final = message("readings held out in turn")


def folds_of(linear: LinearSystem) -> Iterator[tuple[str, Mask]]:
    """Yield label and mask (N,) of each set to hold out: each pass, if there are several, and all moduli."""
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
    """Yield label and mask (N,) of three sets to hold out: every third setting or modulus of each pass.

    A set begins at another setting in each pass, so that the sets differ in their angles.
    """
    readings, reading = linear.readings, linear.rows.reading
    third = np.full(len(linear), -1)
    next_third: dict[tuple[str, int, int], int] = {}
    last = -1
    for row in np.flatnonzero((linear.setting >= 0) | (linear.rows.channel == MODULUS)).tolist():
        i = int(reading[row])
        if i != last:
            key = (str(readings.installation[i]), int(readings.series[i]), int(readings.pass_number[i]))
            now = next_third.setdefault(key, len(next_third)) % 3
            next_third[key], last = now + 1, i
        third[row] = now
    for number in range(3):
        yield message(f"every third setting, set {number + 1}"), third == number


FoldSearch = Callable[[Whitened, Data, Threshold, int], Sequence[FoundEffect]]
"""Searches the readings that are not held out; the last argument is the largest number of effects."""


def measure_gap(
    linear: LinearSystem,
    whitened: Whitened,
    naming: Naming,
    noise: NoiseSize,
    threshold: Threshold,
    setting_rad: float,
    search: FoldSearch = find,
    parts: Sequence[tuple[str, Mask]] = (),
) -> Gap:
    """Hold out each set of rows in turn, search for effects in the others, and predict the rows held out.

    `search` is the function that searches. `whitened`, `naming` and `noise` are of all readings; `setting_rad` is
    the setting error that the bench file states. `parts` are labels and masks (N,) of the sets. By default, the
    sets are passes and moduli (`folds_of`). They are thirds (`thirds_of`) instead if the rows outside some set do
    not determine the coefficients, the effects found or their forms, and all thirds can be held out.
    """
    hold = partial(
        _fold, linear, whitened, noise, threshold.at(OFTEN), setting_rad, search, len(naming.found)
    )
    asked, parts = bool(parts), parts or list(folds_of(linear))
    able = _able(linear, parts)
    every = len(able) == len(parts)
    if not asked and not (every and _tell(linear, whitened.candidates, naming, noise, parts)):
        thirds = list(thirds_of(linear))
        if len(of_thirds := _able(linear, thirds)) == len(thirds):
            parts, able = thirds, of_thirds
    folds = tuple(hold(label, held) for label, held in tracked(able, HELD_OUT))
    undetermined = tuple(label for label, _ in parts if label not in dict(able))
    families = tuple(one.variant.family for one in naming.found)
    return Gap(folds, noise, linear.readings.unit, families, undetermined)


def _able(linear: LinearSystem, parts: Sequence[tuple[str, Mask]]) -> list[tuple[str, Mask]]:
    """Return the parts that can be held out, because the other rows determine the coefficients."""
    return [(label, held) for label, held in parts if determined(linear, ~held)]


def _tell(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    noise: NoiseSize,
    parts: Sequence[tuple[str, Mask]],
) -> bool:
    """Return whether the readings outside each held-out part show every effect found and determine its form.

    They show it if they contain `MOSTLY` of the square of its signature. They do not determine the form if
    another form explains the signature in them (up to `ALIAS`), but not in all readings (more than
    `LEAST_FALL` remains). Chance would then choose the form that predicts the held-out part.
    """
    amplitudes = posterior(linear, candidates.columns[:, list(naming.columns)], noise).amplitudes
    every = np.ones(len(linear), dtype=bool)
    for found, mine in naming.sizes():
        variants = [candidates.variants[i] for i in candidates.of_family(found.variant.family)]
        used = sorted({column for one in variants for column in one.sizes})
        forms = [np.searchsorted(used, one.sizes) for one in variants if one.is_plain]
        signature = candidates.columns[:, list(found.variant.sizes)] @ amplitudes[mine]
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
    """Return the square of a signature, in units of noise, and (forms,) the part that each form leaves of it.

    The signature is the first of `columns` (N, 1 + k); each of `forms` has indices among the other k columns.
    """
    white = make_whitener(restrict(linear, rows), noise.reading, noise.setting_rad)
    seen = white @ (columns[rows] / noise.reading)
    size = np.linalg.norm(seen, axis=0)
    gram = seen.T @ (seen / np.maximum(size, 1e-300)) / np.maximum(size, 1e-300)[:, None]
    explained = np.empty(len(forms))
    width = np.array([len(form) for form in forms])
    for own in (np.flatnonzero(width == one) for one in np.unique(width)):
        at = 1 + np.array([forms[i] for i in own.tolist()])
        inverse = np.linalg.pinv(gram[at[:, :, None], at[:, None, :]], INSEPARABLE, hermitian=True)
        explained[own] = np.einsum("fp,fpq,fq->f", gram[0, at], inverse, gram[0, at])
    whole = float(size[0] ** 2)
    return whole, whole * (1.0 - explained)


def determined(linear: LinearSystem, rows: Mask) -> bool:
    """Return whether the rows in the mask (N,) determine the coefficients and leave enough degrees of freedom."""
    fixed = linear.fixed[rows] / np.linalg.norm(linear.fixed, axis=0)
    if len(fixed) < fixed.shape[1] + LEAST_FREEDOM:
        return False
    parts = [fixed[np.ix_(*part)] for part in coupled(fixed)]
    if any(len(part) < part.shape[1] for part in parts):
        return False
    sizes = np.concatenate([np.linalg.svd(part, compute_uv=False) for part in parts])
    return bool(sizes.min() > INSEPARABLE * sizes.max())


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
    """Search the rows outside the mask `held` (N,); predict those in it without and with the effects."""
    part, candidates = restrict(linear, ~held), whitened.candidates
    kept = candidates.with_columns(candidates.columns[~held])

    def predict(columns: Sequence[int]) -> HeldOut:
        return held_out(linear, candidates.columns[:, list(columns)], noise, held)

    before = predict(())
    if not most:
        return Fold(label, {}, before, before)
    grid = make_noise_grid(part, whitened.grid.sigma, setting_rad, near_ratios(linear, noise))
    rest = Whitened.of(replace(grid, known=whitened.grid.known), kept)
    found = search(rest, rest.reduce(part.response[:, None]), threshold, most)
    rest.forget()
    columns = [i for one in found for i in one.variant.columns]
    after = predict(columns)
    gains: dict[str, float] = {}
    for one in found:
        without = predict([i for i in columns if i not in one.variant.columns])
        family = one.variant.family
        gains[family] = max(without.chi2 - after.chi2, gains.get(family, -np.inf))
    return Fold(label, gains, before, after)


def held_out(linear: LinearSystem, effects: Floats, noise: NoiseSize, held: Mask) -> HeldOut:
    """Predict the rows in the mask `held` (N,) from the others, with the columns `effects` (N, m) in the model."""
    fitted = posterior(restrict(linear, ~held), effects[~held], noise)
    rest = restrict(linear, held)
    design = rest.design(effects[held])
    error = rest.response - design @ fitted.mean
    white = whiten_rows(rest, noise, np.column_stack([design, error]))
    spread = np.eye(len(error)) + white[:, :-1] @ fitted.covariance @ white[:, :-1].T
    chi2 = float(white[:, -1] @ np.linalg.solve(spread, white[:, -1]))
    variance = (noise.reading * rest.relative) ** 2 + (noise.setting_rad * rest.slope) ** 2
    variance += np.einsum("ni,ij,nj->n", design, fitted.covariance, design)
    to_g = rest.g_per_signal
    return HeldOut(error, error * to_g, np.sqrt(variance) * to_g, chi2)


def restrict(linear: LinearSystem, rows: Mask) -> LinearSystem:
    """Return the linear system of only the rows in the mask (N,), of whole settings, numbered from 0 again."""
    setting = np.unique(np.append(-1, linear.setting[rows]), return_inverse=True)[1][1:] - 1
    return replace(
        linear,
        rows=Rows(linear.rows.reading[rows], linear.rows.channel[rows]),
        response=linear.response[rows],
        fixed=linear.fixed[rows],
        random=linear.random[rows],
        slope=linear.slope[rows],
        by_row=None if linear.by_row is None else linear.by_row[rows],
        by_place=None if linear.by_place is None else linear.by_place[rows],
        setting=setting,
    )


def near_ratios(linear: LinearSystem, noise: NoiseSize) -> tuple[float, ...]:
    """Return the three noise ratios of the grid nearest to that of all readings; they suffice for held-out rows."""
    ratio = noise.setting_rad / noise.reading * linear.typical_slope
    nearest = int(np.argmin(np.abs(np.array(RATIOS) - ratio)))
    first = min(max(nearest - 1, 0), len(RATIOS) - 3)
    return RATIOS[first : first + 3]
