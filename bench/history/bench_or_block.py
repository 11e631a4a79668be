"""Bench or block: whether calibrations differ because of the bench or the unit, in twelve coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Labels, rms, u_of
from bench.base.languages import message
from bench.calibration.result import CalibrationError
from bench.history.measured import ComparedCalibrations, coded
from bench.model.geometry import COEFFICIENTS
from bench.stats import holm
from bench.stats.crossed_effects import (
    BENCH,
    EXCESS,
    UNIT,
    Crossed,
    Crossing,
    about_sets,
    fit,
    most,
    scales_of,
    solve,
)

FLAT: Final = 1e3
"""A prior this many times wider than the scatter has no influence on the estimates."""


@dataclass(frozen=True)
class Allotment:
    """A Hausman test of the hypothesis that units were assigned to benches at random: `chi2` with `dof`.

    The test compares two estimates of the differences between benches. The first uses only differences within
    units. The second uses the means of units as well, and is therefore biased if a bench measures units unlike
    those of other benches. Source: J. A. Hausman, Econometrica 46 (1978) 1251.
    """

    chi2: float
    dof: int

    @property
    def p(self) -> float:
        """The p-value of `chi2`; 1 without degrees of freedom."""
        return float(special.chdtrc(self.dof, self.chi2)) if self.dof else 1.0


def allotment(found: Crossed) -> Allotment:
    """Return the test, from the fit of one coefficient, that units were assigned to benches at random."""
    at = found.at
    crossing = at.crossing
    wide = found.sizes.copy()
    wide[BENCH] = FLAT * scales_of(crossing, found.y, found.variance)[BENCH]
    both = solve(crossing, found.y, found.variance, wide)
    wide[UNIT] = np.inf
    within = solve(crossing, found.y, found.variance, wide)
    about = about_sets(crossing)
    gap = about @ (within.bench - both.bench)
    more = about @ (within.bench_covariance - both.bench_covariance) @ about.T
    size, along = np.linalg.eigh(more)
    told = size > 1e-6 * max(float(size.max(initial=0.0)), 1e-300)
    return Allotment(float(np.sum((along.T[told] @ gap) ** 2 / size[told])), int(told.sum()))


SHOWN_P: Final = 0.05
"""Significance level of an effect, after correction for the number of tests."""
ALLOTTED_P: Final = 0.01
LITTLE_SCATTER_P: Final = 0.01
WELL_KNOWN: Final = 0.15
"""Below this relative u, a size's upper limit is value + 1.645 u; above it, the limit is by profile likelihood."""
ONE_SIDED: Final = 1.645


@dataclass(frozen=True)
class EstimatedSize:
    """An estimated standard deviation, its u (NaN if the estimate is zero) and its upper 95 % limit, `most`.

    `p_all_looks` is the p-value of the likelihood-ratio test of the hypothesis that the standard deviation is zero,
    corrected for twelve coefficients; NaN if not tested.
    """

    value: float
    u: float
    most: float
    p_all_looks: float = float("nan")

    @property
    def shown(self) -> bool:
        """Whether the standard deviation is significantly larger than zero."""
        return self.p_all_looks < SHOWN_P


@dataclass(frozen=True)
class Sizes:
    """Variance components of one coefficient, as standard deviations: units of a type, benches, excess scatter.

    `stated` (rms) is the part of the stated u that is independent between calibrations. `meters` is the part that
    recurs with the same meters and the same g, and so belongs to the bench. `allotment` tests whether units
    were assigned to benches at random. If they were not, `by_chance` is false; the values for benches and
    excess are then estimated from differences within units only. `scatter` is the reduced chi-square, with
    `scatter_dof`, of repeated calibrations of a unit on a bench.
    """

    unit: EstimatedSize
    bench: EstimatedSize
    excess: EstimatedSize
    stated: float
    meters: float
    allotment: Allotment
    by_chance: bool
    scatter: float
    scatter_dof: int

    @property
    def shares(self) -> dict[str, float]:
        """Each component's fraction of the variance of one calibration about the mean of the unit's type."""
        squares = {
            "unit": self.unit.value**2,
            "bench": self.bench.value**2,
            "excess": self.excess.value**2,
            "stated": self.stated**2,
        }
        whole = sum(squares.values())
        return {name: square / whole for name, square in squares.items()}


@dataclass(frozen=True)
class OutlyingEffect:
    """A unit or bench with an outlying effect on one coefficient.

    `effect` is a bench's difference from the mean of all benches linked by common units, itself included, or
    a unit's from the mean of its type. `p_all_looks` is Holm's p-value, adjusted for all effects examined.
    """

    name: str
    coefficient: str
    effect: float
    u: float
    p_all_looks: float


@dataclass(frozen=True)
class BenchOrBlock:
    """The variation between units and between B benches.

    `effect` (B, 12) are the effects of the benches, `u` (B, 12) their standard uncertainties. `connected` are
    the sets of benches linked by common units; an effect is the difference from the mean of its set. The
    effect of a bench that shares no unit with another is NaN. `units_apart` are the outlying units.
    """

    benches: tuple[str, ...]
    connected: tuple[tuple[str, ...], ...]
    sizes: tuple[Sizes, ...]
    effect: Floats
    u: Floats
    p_all_looks: Floats
    units_apart: tuple[OutlyingEffect, ...]
    counts: dict[str, int]
    signal: str
    simulated: bool
    notes: tuple[str, ...]

    @property
    def benches_apart(self) -> tuple[OutlyingEffect, ...]:
        """The significant effects of benches, the most significant first."""
        return _apart(self.benches, self.effect, self.u, self.p_all_looks)

    @property
    def answer(self) -> str:
        """The sentence that attributes differences between calibrations to benches, blocks or both."""
        if all(len(one) == 1 for one in self.connected):
            return message(
                "bench and block cannot be separated: no unit was measured on two benches; measure some "
                "units on each"
            )
        shown = [name for name, s in zip(COEFFICIENTS, self.sizes, strict=True) if s.bench.shown]
        apart = list(dict.fromkeys(one.name for one in self.benches_apart))
        if not shown and not apart:
            return message("the block: benches do not differ beyond the stated uncertainties")
        names = ", ".join(apart)
        if not shown:
            return message(f"mostly the block; {names} stand{'s' if len(apart) == 1 else ''} out")
        whole = [
            name for name, s in zip(COEFFICIENTS, self.sizes, strict=True) if s.bench.value > s.unit.value
        ]
        said = message(f"both: benches differ in {', '.join(shown)}")
        if whole:
            said = message(f"{said}, in {', '.join(whole)} more than blocks of a type do")
        return message(f"{said}; {names} stand{'s' if len(apart) == 1 else ''} out") if apart else said


def bench_or_block(measured: ComparedCalibrations) -> BenchOrBlock:
    """Return the variance components and effects of units and benches from calibrations of many units.

    Raises `CalibrationError` if no unit was calibrated twice, or all calibrations were made on one bench.
    """
    (kinds, kind), (units, unit), (benches, bench) = (
        coded(labels) for labels in (measured.kind, _whole_names(measured), measured.bench)
    )
    crossing = Crossing(unit, bench, kind)
    if len(benches) < 2:
        raise CalibrationError(
            f"all calibrations were made on one bench ({benches[0]}); measure units on a second bench"
        )
    if not crossing.repeated:
        raise CalibrationError(
            f"none of {len(units)} units was calibrated twice: units, benches and scatter cannot be "
            "separated; calibrate some units again"
        )
    columns = [
        _Column(crossing, np.ascontiguousarray(y), np.ascontiguousarray(v))
        for y, v in zip(measured.vector.T, measured.own_variance.T, strict=True)
    ]
    chosen = _chosen(columns)
    of_bench = np.sqrt(np.mean(measured.meters**2 + measured.gravity**2, axis=0))
    sizes = _sizes(columns, chosen, of_bench)
    effect = np.stack([one.bench[0] for one, _ in chosen], axis=1)
    u = np.stack([u_of(one.bench[1]) for one, _ in chosen], axis=1)
    effect[crossing.alone()] = np.nan
    told = ~np.isnan(effect)
    p = np.full(effect.shape, np.nan)
    p[told] = holm(special.erfc(np.abs(effect[told]) / np.where(u[told] > 0, u[told], np.inf) / np.sqrt(2.0)))
    return BenchOrBlock(
        benches=tuple(benches.tolist()),
        connected=tuple(
            tuple(benches[crossing.component == c].tolist()) for c in np.unique(crossing.component)
        ),
        sizes=sizes,
        effect=effect,
        u=np.where(told, u, np.nan),
        p_all_looks=p,
        units_apart=_units_apart([one for one, _ in chosen], columns, units),
        counts={
            "calibrations": len(measured), "units": len(units), "benches": len(benches), "types": len(kinds),
            "units_on_several_benches": int(np.sum(np.bincount(crossing.cells[1]) > 1)),
        },
        signal=measured.signal,
        simulated=measured.simulated,
        notes=_notes(crossing, benches, sizes),
    )  # fmt: skip


def _whole_names(measured: ComparedCalibrations) -> list[str]:
    """Return unique unit names that include the type, since units of two types may share a serial number."""
    return [
        unit if unit.startswith(kind) else f"{kind} {unit}"
        for kind, unit in zip(measured.kind.tolist(), measured.unit.tolist(), strict=True)
    ]


@dataclass(frozen=True)
class _Column:
    """The values of one coefficient, (n,), and the independent part of their stated variances, (n,)."""

    crossing: Crossing
    y: Floats
    variance: Floats

    def fit(self, without: int | None = None, *, units_fixed: bool = False) -> Crossed:
        return fit(self.crossing, self.y, self.variance, without=without, units_fixed=units_fixed)

    def scatter(self) -> tuple[float, int]:
        """Return reduced chi-square and degrees of freedom of repeated calibrations of a unit on a bench."""
        cell, unit, _ = self.crossing.cells
        dof = len(cell) - len(unit)
        w = 1.0 / self.variance
        mean = np.bincount(cell, w * self.y) / np.bincount(cell, w)
        chi2 = float(np.sum(w * (self.y - mean[cell]) ** 2))
        return (chi2 / dof if dof else float("nan")), dof


def _chosen(columns: list[_Column]) -> list[tuple[Crossed, Allotment]]:
    """Return the fit of each column and the test of its allotment.

    Units are fixed effects if they were not assigned to benches at random.
    """
    found = [column.fit() for column in columns]
    allotted = [allotment(one) for one in found]
    p = holm(np.array([one.p for one in allotted]))
    return [
        (column.fit(units_fixed=True) if chance < ALLOTTED_P else one, how)
        for column, one, how, chance in zip(columns, found, allotted, p, strict=True)
    ]


def _sizes(
    columns: list[_Column], chosen: list[tuple[Crossed, Allotment]], meters: Floats
) -> tuple[Sizes, ...]:
    """Return the variance components of all columns, with p-values for benches and excess."""
    p = {}
    for which in (BENCH, EXCESS):
        gained = [
            one.at.likelihood - column.fit(which, units_fixed=bool(np.isinf(one.sizes[UNIT]))).at.likelihood
            for column, (one, _) in zip(columns, chosen, strict=True)
        ]
        # a size of zero is at the end of its range: half of a chi-square of one degree of freedom
        p[which] = holm(0.5 * special.erfc(np.sqrt(np.maximum(gained, 0.0))))
    sizes = []
    for k, (column, (one, how)) in enumerate(zip(columns, chosen, strict=True)):
        by_chance = bool(np.isfinite(one.sizes[UNIT]))
        scatter, dof = column.scatter()
        sizes.append(
            Sizes(
                _size(one if by_chance else column.fit(), UNIT),
                _size(one, BENCH, float(p[BENCH][k])),
                _size(one, EXCESS, float(p[EXCESS][k])),
                rms(np.sqrt(column.variance)),
                float(meters[k]),
                how,
                by_chance,
                scatter,
                dof,
            )
        )
    return tuple(sizes)


def _size(found: Crossed, which: int, p: float = float("nan")) -> EstimatedSize:
    value, u = float(found.sizes[which]), float(found.u_sizes[which])
    limit = value + ONE_SIDED * u if u < WELL_KNOWN * value else most(found, which)
    return EstimatedSize(value, u, limit, p)


def _units_apart(found: list[Crossed], columns: list[_Column], units: Labels) -> tuple[OutlyingEffect, ...]:
    rows = [
        (one if np.isfinite(one.sizes[UNIT]) else column.fit()).unit()
        for one, column in zip(found, columns, strict=True)
    ]
    effect, score = (np.stack(part, axis=1) for part in zip(*rows, strict=True))
    p = holm(special.erfc(np.abs(score).ravel() / np.sqrt(2.0))).reshape(score.shape)
    u = np.divide(effect, score, out=np.zeros_like(effect), where=score != 0.0)
    return _apart(units.tolist(), effect, u, p)


def _apart(names: Sequence[str], effect: Floats, u: Floats, p: Floats) -> tuple[OutlyingEffect, ...]:
    """Return the significant effects, most significant first; arrays have a row per name, (n, 12)."""
    found = [
        OutlyingEffect(names[i], COEFFICIENTS[k], float(effect[i, k]), float(u[i, k]), float(p[i, k]))
        for i, k in zip(*np.nonzero(p < SHOWN_P), strict=True)
    ]
    return tuple(sorted(found, key=lambda one: one.p_all_looks))


def _notes(crossing: Crossing, benches: Labels, sizes: tuple[Sizes, ...]) -> tuple[str, ...]:
    notes = []
    alone: Ints = crossing.alone()
    if len(alone):
        listed = ", ".join(benches[alone].tolist())
        notes.append(
            message(
                f"no unit measured on {listed} was measured on another bench: its effect is unknown, only the "
                "spread of its units"
            )
        )
    joined = np.bincount(crossing.component)
    if np.sum(joined > 1) > 1:
        notes.append(
            message("no unit connects some sets of benches; effects are relative to the mean of each set")
        )
    for words, names in (
        (
            message(
                "units were not assigned to benches at random, so effects come only from units measured on "
                "several benches"
            ),
            [n for n, s in zip(COEFFICIENTS, sizes, strict=True) if not s.by_chance],
        ),
        (
            message(
                "repeated calibrations scatter less than their stated uncertainty: a part is common to a "
                "bench, and the stated uncertainty already covers such differences between benches"
            ),
            [
                n
                for n, s in zip(COEFFICIENTS, sizes, strict=True)
                if s.scatter_dof
                and special.chdtr(s.scatter_dof, s.scatter * s.scatter_dof) < LITTLE_SCATTER_P
            ],
        ),
    ):
        if names:
            notes.append(f"{', '.join(names)}: {words}")
    return tuple(notes)
