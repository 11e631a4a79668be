"""The gap on readings that the naming did not use: whole passes held out in turn, and the verification points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
from bench.base.progress import tracked

SURE: Final = 2.0
"""Beyond the size that half of the searches find, in units of noise: so large is found nearly always."""


@dataclass(frozen=True)
class HeldOut:
    """Measured less predicted in readings held out (n,), in the unit of the signal, and its chi-square."""

    error: Floats
    chi2: float

    @property
    def reduced(self) -> float:
        """Chi-square over the number of rows."""
        return self.chi2 / len(self.error)


@dataclass(frozen=True)
class Fold:
    """Readings held out, predicted by the model as it was given and with what the others named.

    `found` are the names that the search on the other readings gave. `confirmable` is false where those could
    not have shown what was found, as worked out before these were opened.
    """

    label: str
    found: tuple[str, ...]
    before: HeldOut
    after: HeldOut
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
        return sum(len(f.before.error) for f in self.opened)

    @property
    def before(self) -> float:
        """Reduced chi-square of the model that was given."""
        return sum(f.before.chi2 for f in self.opened) / max(self.count, 1)

    @property
    def after(self) -> float:
        """Reduced chi-square with what was named, each fold by itself."""
        return sum(f.after.chi2 for f in self.opened) / max(self.count, 1)

    @property
    def p_after(self) -> float:
        """Probability of more than `after` by chance."""
        return float(special.fdtrc(self.count, self.freedom, self.after)) if self.count else float("nan")

    @property
    def before_rms(self) -> float:
        """Root mean square of measured less predicted in single channels, unit of the signal."""
        return _rms([f.before for f in self.opened])

    @property
    def after_rms(self) -> float:
        """The same with what was named."""
        return _rms([f.after for f in self.opened])

    def to_dict(self) -> dict[str, Any]:
        """Return the promised form."""
        opened = bool(self.opened)
        return {
            "before": self.before if opened else None,
            "after": self.after if opened else None,
            "floor": 1.0,
            "p_after": self.p_after if opened else None,
            "before_rms": self.before_rms if opened else None,
            "after_rms": self.after_rms if opened else None,
            "noise_rms": self.noise.reading,
            "unit": self.unit,
            "held_out": [
                {
                    "what": f.label,
                    "confirmable": f.confirmable,
                    "named_without_it": list(f.found),
                    "before": f.before.reduced,
                    "after": f.after.reduced,
                }
                for f in self.folds
            ],
        }


def _rms(parts: Sequence[HeldOut]) -> float:
    if not parts:
        return float("nan")
    return float(np.sqrt(np.mean(np.concatenate([part.error for part in parts]) ** 2)))


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
    shown = posterior(linear, candidates.columns[:, list(naming.columns)], noise).amplitudes
    folds = []
    for label, held in tracked(list(folds_of(linear)), "readings held out in turn"):
        train = ~held
        part = restrict(linear, train)
        kept = Candidates(candidates.columns[train], candidates.kinds, candidates.scale, candidates.variants)
        whitened = Whitened.of(make_noise_grid(part, grid.sigma, setting_rad, ratios), kept)
        fold_naming = name(whitened, whitened.reduce(part.response[:, None]), threshold)
        before, after = (
            HeldOut(*predicted_error(linear, effects, noise, posterior(linear, effects, noise, train), held))
            for effects in (candidates.columns[:, :0], candidates.columns[:, list(fold_naming.columns)])
        )
        names = tuple(f.variant.family for f in fold_naming.found)
        folds.append(
            Fold(label, names, before, after, _could_show(whitened, shown, naming, noise, threshold))
        )
    return Gap(tuple(folds), noise, linear.readings.unit, noise.freedom)


def _could_show(
    whitened: Whitened, amplitudes: Floats, naming: Naming, noise: NoiseSize, threshold: Threshold
) -> bool:
    """Whether the training readings would show each effect at its size: from the design, not their values."""
    half = np.sqrt(2.0 * max(threshold.value + np.log(len(whitened.candidates.families)), 1.0))
    for one, place in naming.parts():
        mine, part = list(one.variant.columns), amplitudes[place]
        search = Search.beside(whitened, [c for c in naming.columns if c not in mine])
        gram = search.cross(len(whitened.gram) // 2, mine)[:, mine]
        middle = gram * (whitened.grid.sigma / noise.reading) ** 2
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
    ratio = noise.setting_rad / noise.reading * linear.typical_slope
    nearest = int(np.argmin(np.abs(np.array(RATIOS) - ratio)))
    first = min(max(nearest - 1, 0), len(RATIOS) - 3)
    return RATIOS[first : first + 3]
