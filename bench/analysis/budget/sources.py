"""The errors of a bench by name: how large, how distributed, what each is common to, where its size comes from."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from bench.analysis.budget.influence import Influence
from bench.analysis.budget.setup import Setup
from bench.analysis.calibration.design import SYMBOLS, WEAK, EffectUnknown
from bench.base.arrays import ARCSEC, CHANNELS, Floats, Ints
from bench.files.bench.file import STAND_ERRORS, BenchFile
from bench.files.bench.stand import ErrorSize, Location
from bench.model import STAND_ANGLES, Distribution

Common = Literal["reading", "setting", "orientation", "mounting", "run"]
"""What shares one draw of an error: a single signal, the three of a setting of the head, all readings in one
orientation, all of one mounting, everything."""

Group = Literal["stand", "scale", "block"]
"""Which errors a source belongs to: the stand's and the readings' own, which `bench calibrate` states; those
of scale and zero, which no reading shows; what the model of the block leaves out or has in addition."""

ANOMALY_M_S2: Final = 5e-4
"""Local anomalies of gravity about the WGS 84 formula, 50 mGal, 1 sigma."""
MEASURED_M_S2: Final = 1e-5
"""Least uncertainty of a value of gravity that was stated as a number, 1 mGal."""
CHAMBER: Final = Distribution(0.5, "rectangular")
"""Prior of the chamber's stability, K."""
BIAS_PER_K: Final = Distribution(30e-6, "rectangular")
SCALE_PER_K: Final = Distribution(180e-6, "rectangular")
"""Priors of the block's temperature coefficients, g/K and 1/K: limits of a quartz-flexure accelerometer."""
K2_PRIOR: Final = Distribution(30e-6)
K3_PRIOR: Final = Distribution(20e-6)
"""Priors of the nonlinearity of a channel, g/g² and g/g³: the catalogue's plausible sizes, 1 sigma."""


_SHOWN: Final[Mapping[str, tuple[str, float]]] = {
    "rad": ("arcsec", ARCSEC),
    "V": ("µV", 1e-6),
    "1": ("ppm", 1e-6),
    "1/g": ("µg/g²", 1e-6),
    "1/g^2": ("µg/g³", 1e-6),
}


@dataclass(frozen=True)
class ErrorSource:
    """An error with its distribution in `unit` (SI), what it is common to and its degrees of freedom.

    `origin` says where the size comes from; `prior` that it is a plausible size and not a stated one.
    `factors` scale the error where it acts (the temperature coefficients, per K). The parameter of an effect
    has `effect`, and in `written_in` the unit in which files state it with its size in SI. `channels` are
    those that it is of: K2 and K3 are not of one for which the model has such an effect.
    """

    name: str
    symbol: str
    unit: str
    distribution: Distribution
    common: Common
    group: Group
    origin: str
    dof: float = math.inf
    prior: bool = False
    factors: Mapping[str, float] | None = None
    effect: EffectUnknown | None = None
    channels: tuple[str, ...] = CHANNELS
    written_in: tuple[str, float] = ("", 1.0)

    @property
    def u(self) -> float:
        """Standard uncertainty, in `unit`."""
        return self.distribution.u

    @property
    def shown(self) -> str:
        """The standard uncertainty in the unit in which files state it: "1.67 arcsec"."""
        unit, size = _SHOWN.get(self.unit, (self.unit, 1.0)) if self.effect is None else self.written_in
        return f"{self.u / size:.3g} {unit}"

    @property
    def on_channels(self) -> Floats:
        """1 for a channel that it is of, 0 for another, shape (3,)."""
        return np.array([float(channel in self.channels) for channel in CHANNELS])

    def sized(self, u: float) -> ErrorSource:
        """Return the source with another standard uncertainty, normally distributed."""
        return replace(self, distribution=Distribution(u), origin="as asked")


# --- from a bench file ------------------------------------------------------------------------------


def bench_sources(bench: BenchFile, setup: Setup) -> tuple[ErrorSource, ...]:
    """Return the sources of a bench: the stand's errors, the voltmeters', gravity, temperature, the block.

    Parameters of effects in the model of `setup` are sources, too; the priors of K2 and K3 stand only where the
    model has no such effect.
    """
    return (
        *stand_sources(bench),
        *_voltmeter_sources(bench),
        *_gravity_source(bench),
        _temperature_source(bench),
        *_nonlinearity_sources(bench, setup),
        *effect_sources(setup),
    )


def stand_sources(bench: BenchFile) -> tuple[ErrorSource, ...]:
    """Return the stand errors of a bench file. The third mounting angle is zero unless it is stated."""
    sizes = bench.stand_distributions()
    dof = {name: section.dof for name in STAND_ERRORS if (section := getattr(bench.stand, name)) is not None}
    return tuple(
        stand_source(
            name,
            sizes[name],
            dof.get(name, math.inf),
            "bench file" if name in dof else "not stated: taken as zero",
        )
        for name in STAND_ERRORS
        if name in dof or name == "mounting_roll"
    )


def stand_source(
    name: str, distribution: Distribution, dof: float = math.inf, origin: str = "as asked"
) -> ErrorSource:
    """Return one of the stand errors by its name in a bench file, rad or V. Raises `KeyError` for others."""
    if name in STAND_ANGLES:
        symbol = {"mounting_offset": "mounting offset"}.get(name, SYMBOLS[name].replace("alpha", "α"))
        return ErrorSource(name, symbol, "rad", distribution, "mounting", "stand", origin, dof)
    symbol, unit, common = _FRESH[name]
    return ErrorSource(name, symbol, unit, distribution, common, "stand", origin, dof)


_FRESH: Final[Mapping[str, tuple[str, str, Common]]] = {
    "setting_error": ("α4", "rad", "setting"),
    "voltmeter_error": ("ΔU", "V", "reading"),
}


def _voltmeter_sources(bench: BenchFile) -> Iterator[ErrorSource]:
    meter = bench.instruments.voltmeters[0]
    kind, range_v = meter.kind, meter.range
    of_reading, of_range = kind.accuracy[range_v]
    whose = f"{meter.driver}, limits of 90 days on {range_v:g} V"
    largest_v = float(np.max(np.abs(bench.unit_under_test.scale_factors.values)))
    curved_v = kind.linearity[0] * largest_v + kind.linearity[1] * range_v
    section = bench.uncertainty
    for name, symbol, unit, limit, common, stated in (
        ("voltmeter_gain", "gain", "1", of_reading, "run", section.voltmeter_gain),
        ("voltmeter_offset", "offset", "V", of_range * range_v, "run", section.voltmeter_offset),
        ("voltmeter_linearity", "linearity", "V", curved_v, "orientation", section.voltmeter_linearity),
    ):
        usual = Distribution(limit, "rectangular")
        yield _stated(name, symbol, unit, common, stated, usual, whose)  # type: ignore[arg-type]


def _gravity_source(bench: BenchFile) -> Iterator[ErrorSource]:
    """Relative to local gravity. A number has the uncertainty of its last digit, at least that of a survey."""
    g = bench.gravity_m_s2
    stated = bench.uncertainty.gravity
    if g is None:
        return
    if stated is not None:
        relative = replace(stated.to_distribution(), limit=stated.limit / g)
        yield ErrorSource("gravity", "g", "1", relative, "run", "scale", "bench file", stated.dof)
    elif isinstance(bench.gravity, Location):
        origin = "WGS 84 formula: anomalies of 50 mGal"
        yield ErrorSource(
            "gravity", "g", "1", Distribution(ANOMALY_M_S2 / g), "run", "scale", origin, prior=True
        )
    else:
        decimals = len(repr(g).partition(".")[2])
        rounding = Distribution(0.5 * 10.0**-decimals, "rectangular")
        size = rounding if rounding.u > MEASURED_M_S2 else Distribution(MEASURED_M_S2)
        origin = f"{g!r} m/s² as stated: its last digit, 1 mGal at least"
        relative = replace(size, limit=size.limit / g)
        yield ErrorSource("gravity", "g", "1", relative, "run", "scale", origin, prior=True)


def _temperature_source(bench: BenchFile) -> ErrorSource:
    section, chamber = bench.uncertainty, bench.instruments.chamber
    band = getattr(chamber, "band", None)
    usual, origin = (CHAMBER, "no band stated: ±0.5 K") if band is None else (
        Distribution(band, "rectangular"), "band of the chamber"
    )  # fmt: skip
    sizes = (section.bias_temperature_coefficient, section.scale_temperature_coefficient)
    coefficients = [
        (prior if size is None else size.to_distribution()).u
        for size, prior in zip(sizes, (BIAS_PER_K, SCALE_PER_K), strict=True)
    ]
    source = _stated("temperature", "T", "K", "mounting", section.temperature, usual, origin)
    return replace(
        source,
        origin=f"{source.origin}; {coefficients[0] * 1e6:.3g} µg/K and {coefficients[1] * 1e6:.3g} ppm/K (1σ)",
        prior=section.temperature is None or None in sizes,
        factors={"bias": coefficients[0], "scale": coefficients[1]},
    )


def _nonlinearity_sources(bench: BenchFile, setup: Setup) -> Iterator[ErrorSource]:
    for name, effect, unit, prior in (
        ("K2", "quadratic_nonlinearity", "1/g", K2_PRIOR),
        ("K3", "cubic_nonlinearity", "1/g^2", K3_PRIOR),
    ):
        known = {c for a in setup.model.effects if a.effect.name == effect for c in a.channels}
        left = tuple(channel for channel in CHANNELS if channel not in known)
        if left:
            stated: ErrorSize | None = getattr(bench.uncertainty, name)
            source = _stated(name, name, unit, "run", stated, prior, "prior: plausible size")
            yield replace(source, group="block", channels=left)


def _stated(
    name: str,
    symbol: str,
    unit: str,
    common: Common,
    stated: ErrorSize | None,
    usual: Distribution,
    origin: str,
) -> ErrorSource:
    if stated is None:
        return ErrorSource(name, symbol, unit, usual, common, "scale", origin, prior=True)
    return ErrorSource(
        name, symbol, unit, stated.to_distribution(), common, "scale", "bench file", stated.dof
    )


def effect_sources(setup: Setup) -> Iterator[ErrorSource]:
    """Yield a source for each parameter of the effects in the model, with the u that the model file states.

    Where it states none the size is the catalogue's plausible one. The prior that a fit then takes is wider, so
    that the data decide, and no statement about a block.
    """
    problem = setup.effect_problem
    for name, unknown in zip(problem.names(), problem.effects, strict=True):
        parameter = problem.parameter(unknown)
        yield ErrorSource(
            name=name,
            symbol=parameter.name,
            unit="SI",
            distribution=Distribution(unknown.prior_u / (1.0 if unknown.stated else WEAK)),
            common="run",
            group="block",
            origin="model file" if unknown.stated else "model file states no u: plausible size",
            prior=not unknown.stated,
            effect=unknown,
            written_in=(parameter.unit, parameter.si_per_unit),
        )


# --- what they do to the readings -------------------------------------------------------------------


_Patterns = Sequence[tuple[Floats, Ints]]
"""What a unit of a source does to the signals, V (n, 3), and what shares a draw of it, as `Influence.of`."""

_EVERYTHING: Final = np.zeros((1, 1), dtype=np.int64)


def influences(source: ErrorSource, setup: Setup) -> tuple[Influence, ...]:
    """Return how a unit of the source acts on the readings of a setup; parts of it are independent."""
    if source.effect is not None:
        column = setup.effect_problem.effects.index(source.effect)
        patterns: _Patterns = [(setup.effect_columns[:, :, column], _EVERYTHING)]
    elif source.name in STAND_ANGLES:
        patterns = [(setup.stand_slope(source.name), setup.conditions.mount[:, None])]
    else:
        patterns = _PATTERNS[source.name](source, setup)
    return tuple(Influence.of(pattern, group) for pattern, group in patterns)


def _linearity(source: ErrorSource, setup: Setup) -> _Patterns:
    # the same voltage gives the same error: repeats do not average it; channels have voltages of their own
    return [(np.ones_like(setup.signal), 3 * setup.orientation[:, None] + np.arange(3))]


def _temperature(source: ErrorSource, setup: Setup) -> _Patterns:
    # the coefficients' signs are not known, so that bias and scale of each channel move on their own
    factors = source.factors or {}
    group = 3 * setup.conditions.mount[:, None] + np.arange(3)
    sensed = setup.force @ setup.block.K.T
    bias = np.broadcast_to(np.diag(setup.block.K), sensed.shape)
    return [(factors["bias"] * bias, group), (factors["scale"] * sensed, group)]


def _power(exponent: int) -> Callable[[ErrorSource, Setup], _Patterns]:
    def act(source: ErrorSource, setup: Setup) -> _Patterns:
        factor = np.diag(setup.block.K) * source.on_channels
        return [(factor * setup.force**exponent, np.arange(3)[None, :])]

    return act


_PATTERNS: Final[Mapping[str, Callable[[ErrorSource, Setup], _Patterns]]] = {
    "voltmeter_error": lambda _, s: [(np.ones_like(s.signal), np.arange(s.signal.size).reshape(-1, 3))],
    "setting_error": lambda _, s: [(s.setting_slope, np.arange(len(s.conditions))[:, None])],
    "voltmeter_gain": lambda _, s: [(s.signal, np.array(s.meters)[None, :])],
    "voltmeter_offset": lambda _, s: [(np.ones_like(s.signal), np.array(s.meters)[None, :])],
    "voltmeter_linearity": _linearity,
    "gravity": lambda _, s: [(s.force @ s.block.K.T, _EVERYTHING)],
    "temperature": _temperature,
    "K2": _power(2),
    "K3": _power(3),
}


def sizes_by_name(sources: Iterable[ErrorSource]) -> dict[str, float]:
    """Return the standard uncertainties of the stand's sources by name, as an estimator is told them."""
    return {source.name: source.u for source in sources if source.name in STAND_ERRORS}
