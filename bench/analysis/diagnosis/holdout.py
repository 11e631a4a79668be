"""The gap on readings that the naming did not use: whole passes held out in turn, and the verification points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.evidence import Search, Whitened
from bench.analysis.diagnosis.linear import MODULUS, LinearSystem, Rows
from bench.analysis.diagnosis.naming import Naming, name
from bench.analysis.diagnosis.noise_grid import RATIOS, NoiseGrid, make_noise_grid
from bench.analysis.diagnosis.posterior import NoiseSize, posterior, predicted_error
from bench.analysis.diagnosis.threshold import Threshold
from bench.base.arrays import Floats, Mask

SURE: Final = 2.0
"""Beyond the size that half of the searches find, in units of noise: so large is found nearly always."""


@dataclass(frozen=True)
class Fold:
    """Readings held out: measured less predicted by the model before and after, in the unit of the signal.

    `found` are the names that the search on the other readings gave. `confirmable` is false where those could
    not have shown what was found, as worked out before these were opened.
    """

    label: str
    rows: Mask
    found: tuple[str, ...]
    before: Floats
    after: Floats
    chi2_before: float
    chi2_after: float
    confirmable: bool


@dataclass(frozen=True)
class Gap:
    """Reduced chi-square of the readings held out, before and after; its expectation is 1 (`floor`)."""

    folds: tuple[Fold, ...]
    noise: NoiseSize
    unit: str
    freedom: int

    @property
    def opened(self) -> tuple[Fold, ...]:
        """The folds that can confirm what was found."""
        return tuple(f for f in self.folds if f.confirmable)

    @property
    def count(self) -> int:
        """Rows in them."""
        return int(sum(f.rows.sum() for f in self.opened))

    @property
    def before(self) -> float:
        """Reduced chi-square of the model that was given."""
        return sum(f.chi2_before for f in self.opened) / max(self.count, 1)

    @property
    def after(self) -> float:
        """Reduced chi-square with what was named, each fold by itself."""
        return sum(f.chi2_after for f in self.opened) / max(self.count, 1)

    @property
    def p_after(self) -> float:
        """Probability of more than `after` by chance."""
        return float(special.fdtrc(self.count, self.freedom, self.after)) if self.count else float("nan")

    def rms(self, after: bool) -> float:
        """Root mean square of measured less predicted in single channels, unit of the signal."""
        parts = [f.after if after else f.before for f in self.opened]
        return float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) if parts else float("nan")

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        opened = bool(self.opened)
        return {
            "before": self.before if opened else None,
            "after": self.after if opened else None,
            "floor": 1.0,
            "p_after": self.p_after if opened else None,
            "before_rms": self.rms(False) if opened else None,
            "after_rms": self.rms(True) if opened else None,
            "noise_rms": self.noise.reading,
            "unit": self.unit,
            "held_out": [
                {
                    "what": f.label,
                    "confirmable": f.confirmable,
                    "named_without_it": list(f.found),
                    "before": f.chi2_before / int(f.rows.sum()),
                    "after": f.chi2_after / int(f.rows.sum()),
                }
                for f in self.folds
            ],
        }


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


def measure_gap(
    linear: LinearSystem,
    candidates: Candidates,
    grid: NoiseGrid,
    naming: Naming,
    noise: NoiseSize,
    threshold: Threshold,
    setting_rad: float,
) -> Gap:
    """Hold readings out in turn; name, fit and predict without them."""
    ratios = near_ratios(linear, noise)
    folds = []
    for label, held in folds_of(linear):
        train = ~held
        part = restrict(linear, train)
        kept = Candidates(candidates.columns[train], candidates.kinds, candidates.scale, candidates.variants)
        whitened = Whitened.of(make_noise_grid(part, grid.sigma, setting_rad, ratios), kept)
        fold_naming = name(whitened, whitened.reduce(part.response[:, None]), threshold)
        effects = candidates.columns[:, list(fold_naming.columns)]
        nothing = candidates.columns[:, :0]
        before, chi2_before = predicted_error(
            linear, nothing, noise, posterior(linear, nothing, noise, train), held
        )
        after, chi2_after = predicted_error(
            linear, effects, noise, posterior(linear, effects, noise, train), held
        )
        names = tuple(f.variant.family for f in fold_naming.found)
        confirmable = _could_show(whitened, linear, candidates, naming, noise, threshold)
        folds.append(Fold(label, held, names, before, after, chi2_before, chi2_after, confirmable))
    return Gap(tuple(folds), noise, linear.readings.unit, noise.freedom)


def _could_show(
    whitened: Whitened,
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    noise: NoiseSize,
    threshold: Threshold,
) -> bool:
    """Whether the training readings would show each effect at its size: from the design, not their values."""
    columns = list(naming.columns)
    if not columns:
        return True
    amplitudes = posterior(linear, candidates.columns[:, columns], noise).amplitudes
    start = 0
    for one in naming.found:
        mine = list(one.variant.columns)
        part = amplitudes[start : start + len(mine)]
        start += len(mine)
        others = [c for c in columns if c not in mine]
        search = Search.beside(whitened, others)
        gram = search.cross(len(whitened.gram) // 2, mine)[:, mine]
        middle = gram * (whitened.grid.sigma / noise.reading) ** 2
        half = np.sqrt(2.0 * max(threshold.value + np.log(len(candidates.families)), 1.0))
        if np.sqrt(max(float(part @ middle @ part), 0.0)) < half + SURE:
            return False
    return True


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
    count = int(linear.setting.max()) + 1
    ratio = noise.setting_rad / noise.reading * float(np.sqrt(np.sum(linear.slope**2) / count))
    nearest = int(np.argmin(np.abs(np.array(RATIOS) - ratio)))
    first = min(max(nearest - 1, 0), len(RATIOS) - 3)
    return RATIOS[first : first + 3]
