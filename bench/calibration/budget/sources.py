"""The error sources that follow from a bench file, each with its distribution and the origin of it."""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS
from bench.base.languages import message
from bench.base.text import exact_duration
from bench.calibration.budget.coefficients import Setup
from bench.calibration.budget.error_source import Common, ErrorSource, foundation_of, learned_sources
from bench.calibration.budget.meters import KnownMeters, Size, linearity_of, size_of, thermometer_size
from bench.calibration.design import SYMBOLS, WEAK
from bench.calibration.noise import KnownStand
from bench.config.bench_file.file import STAND_ERRORS, BenchFile
from bench.config.bench_file.stand import ErrorSize, Location, MeasuredGravity, RoomError
from bench.config.devices.sections import VoltmeterForm
from bench.model import STAND_ANGLES, Distribution, ForwardModel
from bench.model.effects import AppliedEffect

ANOMALY_M_S2: Final = 5e-4
"""Local anomalies of gravity about the WGS 84 formula, 50 mGal, 1 sigma."""
MEASURED_M_S2: Final = 1e-5
"""Least standard uncertainty, 1 mGal, of a local gravity that the file states as a number."""
CHAMBER: Final = Distribution(0.5, "rectangular")
"""Prior distribution of the chamber's temperature about its set point, K."""
BIAS_PER_K: Final = Distribution(30e-6, "rectangular")
SCALE_PER_K: Final = Distribution(180e-6, "rectangular")
"""Priors of the block's temperature coefficients, g/K and 1/K: limits of a quartz-flexure accelerometer."""
GAIN_PER_K: Final = Distribution(1e-6)
"""Prior of the change of a voltmeter's gain per kelvin, relative; a 34420A in an air bath had 0.75 ppm/K."""
ROOM: Final = Distribution(5.0, "rectangular")
"""Prior of a meter's temperature about 23 °C, K: the range for which data sheets of voltmeters hold."""
REFERENCE_NOISE: Final = Distribution(0.1e-6)
"""Prior of the 1/f noise of a voltmeter's reference per decade of frequency, relative.

LM399, as in the 34401A: about 4 uV peak to peak of 7 V from 0.1 to 10 Hz (eevblog.com, "LM399 based 10 V
reference", reply 1000), which is 0.07 ppm per decade; single ones have twice as much.
"""
BIAS_PER_V: Final = Distribution(20e-6)
SCALE_PER_V: Final = Distribution(20e-6)
"""Priors of a block's sensitivity to its supply, g/V and 1/V: the catalogue's plausible sizes, 1 sigma."""
TURN_ON: Final = Distribution(20e-6)
"""Prior of the turn-on repeatability of a bias, g: 10 to 25 µg for a quartz-flexure accelerometer."""
K2_PRIOR: Final = Distribution(30e-6)
K3_PRIOR: Final = Distribution(20e-6)
"""Priors of the nonlinearity of a channel, g/g² and g/g³: the catalogue's plausible sizes, 1 sigma."""


# --- from a bench file ------------------------------------------------------------------------------


def bench_sources(
    bench: BenchFile, setup: Setup, day: datetime.date | None = None, known: KnownStand | None = None
) -> tuple[ErrorSource, ...]:
    """Return the error sources of a bench: stand, voltmeters, gravity, temperature, block.

    `day` is the date of the readings, from which the drift since each certificate follows. `known` is prior
    knowledge of stand and noise from other runs. Parameters of effects in the model of `setup` are sources,
    too. The nonlinearities K2 and K3 are separate sources only for channels whose model lacks them.
    """
    own = stand_sources(bench)
    if known is not None:
        own = learned_sources(own, known, setup.conditions)
    return (
        *own, *_foundation_source(bench), *hidden_sources(bench, setup.model, day), *effect_sources(setup)
    )  # fmt: skip


def signed_sources(
    bench: BenchFile, model: ForwardModel, day: datetime.date | None = None
) -> tuple[ErrorSource, ...]:
    """Return the foundation's tilt rate and the `hidden_sources`: both enter a calibration's combined u.

    Local gravity is left out: coefficients are stated per local g.
    """
    hidden = (source for source in hidden_sources(bench, model, day) if source.name != "gravity")
    return (*_foundation_source(bench), *hidden)


def _foundation_source(bench: BenchFile) -> Iterator[ErrorSource]:
    """Yield the tilt rate of the platform if the bench file states one; levellings of a run take precedence."""
    stated = foundation_of(None, bench, levelled=False)
    if stated is not None:
        yield stated.source()


def hidden_sources(
    bench: BenchFile, model: ForwardModel, day: datetime.date | None = None, meters: KnownMeters | None = None
) -> tuple[ErrorSource, ...]:
    """Return the sources whose errors no reading shows and no fit estimates.

    If the bench file does not state an error, its distribution is assumed, or the source is left out. `meters` are
    errors inferred from learned differences between the meters; they replace the voltmeters' sources.
    """
    return (
        *_voltmeter_sources(bench, day, meters),
        *_reference_source(bench),
        *_room_source(bench, model),
        *unread_sources(bench, model),
        *_head_table_source(bench),
        *_gravity_source(bench),
        _temperature_source(bench),
        *_thermometer_source(bench),
        *_supply_sources(bench, model),
        *_turn_on_source(bench),
        *_nonlinearity_sources(bench, model),
    )


def stand_sources(bench: BenchFile) -> tuple[ErrorSource, ...]:
    """Return the stand errors of a bench file.

    An unstated third mounting angle has the distribution of `mounting_error`, because the same surfaces determine
    both angles.
    """
    sizes = bench.stand_distributions()
    dof = {name: section.dof for name in STAND_ERRORS if (section := getattr(bench.stand, name)) is not None}
    stated = [
        stand_source(name, sizes[name], dof[name], message("bench file"))
        for name in STAND_ERRORS
        if name in dof
    ]
    assumed = [
        replace(stand_source(name, size, origin=ROLL_ORIGIN), prior=True)
        for name, size in assumed_stand(bench).items()
    ]
    return (*stated, *assumed)


ROLL_ORIGIN: Final = message("not stated: as mounting_error")


def assumed_stand(bench: BenchFile) -> dict[str, Distribution]:
    """Return assumed distributions, by name, of stand errors that every bench has and this file leaves out."""
    if bench.stand.mounting_roll is not None:
        return {}
    return {"mounting_roll": bench.stand_distributions()["mounting_error"]}


def stand_source(
    name: str, distribution: Distribution, dof: float = math.inf, origin: str = "as asked"
) -> ErrorSource:
    """Return the source of the stand error `name`, in rad or V. Raises `KeyError` for an unknown name."""
    if name in STAND_ANGLES:
        symbol = {"mounting_offset": "mounting offset"}.get(name, SYMBOLS[name].replace("alpha", "α"))
        return ErrorSource(name, symbol, "rad", distribution, "mounting", "stand", origin, dof)
    symbol, unit, common = _FRESH[name]
    return ErrorSource(name, symbol, unit, distribution, common, "stand", origin, dof)


_FRESH: Final[Mapping[str, tuple[str, str, Common]]] = {
    "setting_error": ("α4", "rad", "setting"),
    "voltmeter_error": ("ΔU", "V", "reading"),
}


def _voltmeter_sources(
    bench: BenchFile, day: datetime.date | None, known: KnownMeters | None
) -> Iterator[ErrorSource]:
    """Yield one source per quantity if all meters have the same errors, else one per meter: "voltmeter_gain[x]".

    Learned differences between meters give one source with correlated draws.
    """
    meters = bench.instruments.voltmeters
    largest_v = float(np.max(np.abs(bench.unit_under_test.scale_factors.values)))
    section = bench.uncertainty
    quantities: tuple[tuple[str, str, str, Common, ErrorSize | None, Callable[[VoltmeterForm], Size]], ...] = (
        ("voltmeter_gain", "gain", "1", "run", section.voltmeter_gain,
         lambda meter: size_of("voltmeter_gain", meter, day)),
        ("voltmeter_offset", "offset", "V", "run", section.voltmeter_offset,
         lambda meter: size_of("voltmeter_offset", meter, day)),
        ("voltmeter_linearity", "linearity", "V", "orientation", section.voltmeter_linearity,
         lambda meter: linearity_of(meter, largest_v)),
    )  # fmt: skip
    for name, symbol, unit, common, stated, size in quantities:
        if known is not None and name in known.quantities:
            size_known, errors = known.quantities[name]
            yield replace(_of_size(name, symbol, unit, common, size_known), root=errors.root)
            continue
        sizes = [size(meter) for meter in meters] if stated is None else [Size.stated(stated)]
        if all(one == sizes[0] for one in sizes):
            yield _of_size(name, symbol, unit, common, sizes[0])
            continue
        for meter, one in zip(meters, sizes, strict=True):
            called = f"{name}[{''.join(meter.channels)}]"
            yield replace(_of_size(called, symbol, unit, common, one), channels=meter.channels)


def meter_gain_sources(bench: BenchFile, day: datetime.date | None) -> Iterator[ErrorSource]:
    """Yield the errors of the voltmeters' gains on `day`.

    Without a statement of the bench file, they follow from certificates or makers' limits.
    """
    return (one for one in _voltmeter_sources(bench, day, None) if one.kind == "voltmeter_gain")


def _reference_source(bench: BenchFile) -> Iterator[ErrorSource]:
    """Yield the 1/f noise of the references in the voltmeters, per decade of frequency."""
    stated, origin = bench.uncertainty.reference_noise, message("prior: an LM399")
    yield _stated("reference_noise", "1/f", "1", "time", stated, REFERENCE_NOISE, origin)


THERMAL: Final = {"voltmeter_thermal_gain": "gain", "voltmeter_thermal_offset": "offset"}
"""The effects that follow the temperature of the meters, each with its size."""


def _room_source(bench: BenchFile, model: ForwardModel) -> Iterator[ErrorSource]:
    """Yield the gain error of voltmeters that follow the room's temperature with a lag.

    There is no such source unless the bench file states the room's temperature changes. It acts on the channels
    whose model has no such gain.
    """
    room, stated = bench.uncertainty.room_temperature, bench.uncertainty.voltmeter_temperature_coefficient
    left = _without(applied for applied in model.effects if THERMAL.get(applied.effect.name) == "gain")
    if room is None or not left:
        return
    coefficient = _u(stated, GAIN_PER_K)
    size = Size.stated(room)
    origin = message(f"{size.origin}; {coefficient * 1e6:.3g} ppm/K (1σ), {exact_duration(room.lag)} late")
    source = _of_size("room_temperature", "T room", "K", "time", replace(size, origin=origin))
    yield replace(
        source, prior=stated is None, factors={"scale": coefficient}, correlation_s=room.lag, channels=left
    )


def unread_sources(bench: BenchFile, model: ForwardModel) -> Iterator[ErrorSource]:
    """Yield a source for each effect of the voltmeters' temperature (gain, offset) that the model has.

    It acts on readings without a recorded meter temperature, which is then unknown within the limits of the
    room. Its correlation time is the longer of two lags: that of the effect and that of the room. A
    temperature coefficient without u has the catalogue's plausible value as u.
    """
    room = bench.uncertainty.room_temperature
    for applied in model.effects:
        name = THERMAL.get(applied.effect.name)
        if name is None:
            continue
        of = next(p for p in applied.effect.parameters if p.name == name)
        values, acts = applied.complete_values(), np.isin(CHANNELS, applied.channels)
        u = np.broadcast_to(applied.u.get(name, 0.0), (3,))
        sizes = np.hypot(values[name], np.where(u > 0.0, u, of.plausible)) * acts
        lag_s = max(float(values["lag"]), RoomError.LAG_S if room is None else room.lag)
        limits = Size(ROOM, message("not stated: 23 °C ± 5 K, the range of data sheets"), prior=True)
        size = limits if room is None else Size.stated(room)
        shown = ", ".join(
            f"{c} {one / of.si_per_unit:.3g}" for c, one in zip(CHANNELS, sizes, strict=True) if one
        )
        origin = message(
            f"{size.origin}; temperature not recorded; {name} {shown} {of.unit} of the model, "
            f"{exact_duration(lag_s)} late"
        )
        source = _of_size(f"meter_temperature[{name}]", "T meter", "K", "time", replace(size, origin=origin))
        factors = {f"{each} {c}": 0.0 for each in THERMAL.values() for c in CHANNELS}
        factors |= {f"{name} {c}": float(one) for c, one in zip(CHANNELS, sizes, strict=True)}
        yield replace(
            source, prior=size.prior or not np.all(u[acts] > 0.0), factors=factors, correlation_s=lag_s
        )


def _of_size(name: str, symbol: str, unit: str, common: Common, size: Size) -> ErrorSource:
    """Return a source of this size in the group "scale", which no reading shows."""
    return ErrorSource(
        name, symbol, unit, size.distribution, common, "scale", size.origin, size.dof, size.prior
    )


def _gravity_source(bench: BenchFile) -> Iterator[ErrorSource]:
    """Yield the relative error of local gravity.

    For gravity stated as a plain number, u follows from rounding to the last digit, and is at least 1 mGal.
    """
    g, stated, known = bench.gravity_m_s2, bench.uncertainty.gravity, bench.gravity
    if g is None:
        return
    if stated is not None:
        size = Size.stated(stated)
    elif isinstance(known, MeasuredGravity):
        origin = f"{known.source}, {known.date}: U = {known.U:.3g} m/s², k = {known.k:g}"
        size = Size(Distribution(known.U, k=known.k), origin, known.dof)
    elif isinstance(known, Location):
        size = Size(Distribution(ANOMALY_M_S2), message("WGS 84 formula: anomalies of 50 mGal"), prior=True)
    else:
        decimals = len(repr(g).partition(".")[2])
        rounding = Distribution(0.5 * 10.0**-decimals, "rectangular")
        origin = message(f"{g!r} m/s² as stated: its last digit, at least 1 mGal")
        size = Size(
            rounding if rounding.u > MEASURED_M_S2 else Distribution(MEASURED_M_S2), origin, prior=True
        )
    relative = replace(size.distribution, limit=size.distribution.limit / g)
    yield _of_size("gravity", "g", "1", "run", replace(size, distribution=relative))


def _temperature_source(bench: BenchFile) -> ErrorSource:
    section, chamber = bench.uncertainty, bench.instruments.chamber
    band = getattr(chamber, "band", None)
    usual, origin = (CHAMBER, message("no band stated: ±0.5 K")) if band is None else (
        Distribution(band, "rectangular"), message("band of the chamber")
    )  # fmt: skip
    sizes = (section.bias_temperature_coefficient, section.scale_temperature_coefficient)
    bias, scale = (_u(size, prior) for size, prior in zip(sizes, (BIAS_PER_K, SCALE_PER_K), strict=True))
    source = _stated("temperature", "T", "K", "run", section.temperature, usual, origin)
    if section.temperature is not None and (time_s := section.temperature.correlation_time) is not None:
        origin = message(f"{source.origin}, correlation time {exact_duration(time_s)}")
        source = replace(source, common="time", correlation_s=time_s, origin=origin)
    return replace(
        source,
        origin=message(f"{source.origin}; {bias * 1e6:.3g} µg/K and {scale * 1e6:.3g} ppm/K (1σ)"),
        prior=section.temperature is None or None in sizes,
        factors={"bias": bias, "scale": scale},
    )


def _head_table_source(bench: BenchFile) -> Iterator[ErrorSource]:
    """Yield the error of the head's certified table: one draw for each angle, the same at every visit."""
    certificate = bench.instruments.head.certificate
    if certificate is not None:
        worst = max(certificate.values, key=lambda value: value.U / value.k)
        origin = message(
            f"certificate {certificate.number} of {certificate.date}: largest U of its table, k = {worst.k:g}"
        )
        size = Size(Distribution(worst.U, k=worst.k), origin, worst.dof)
        yield _of_size("head_table", "head", "rad", "angle", size)


def _thermometer_source(bench: BenchFile) -> Iterator[ErrorSource]:
    """Yield the error of the thermometer, which is the same throughout a run."""
    size = thermometer_size(bench)
    if size is not None:
        source = _of_size("thermometer", "T", "K", "run", size)
        yield replace(source, factors=_temperature_source(bench).factors)


def _supply_sources(bench: BenchFile, model: ForwardModel) -> Iterator[ErrorSource]:
    """Yield one source per supply rail; it acts on the channels whose model has no sensitivity to this rail."""
    supply, section = bench.unit_under_test.supply, bench.uncertainty
    sizes = (section.bias_supply_coefficient, section.scale_supply_coefficient)
    bias, scale = (_u(size, prior) for size, prior in zip(sizes, (BIAS_PER_V, SCALE_PER_V), strict=True))
    for number, rail in enumerate(supply.rails if supply else (), start=1):
        usual = Distribution(rail.tolerance, "rectangular")
        source = _stated(
            "", rail.name, "V", "run", section.supply_voltage, usual, message("tolerance of the rail")
        )
        left = _without(
            applied
            for applied in model.effects
            if applied.effect.name == "supply_sensitivity"
            and float(applied.complete_values()["rail"]) == number
        )
        if left:
            yield replace(
                source,
                name=f"supply_voltage[{rail.name}]",
                origin=message(f"{source.origin}; {bias * 1e6:.3g} µg/V and {scale * 1e6:.3g} ppm/V (1σ)"),
                prior=None in sizes,
                factors={"bias": bias, "scale": scale, "rail": number},
                channels=left,
            )


def _turn_on_source(bench: BenchFile) -> Iterator[ErrorSource]:
    """Yield the turn-on repeatability of the biases, if it is stated or the bench has a supply for the block."""
    stated = bench.uncertainty.turn_on_repeatability
    if stated is not None or bench.unit_under_test.supply is not None:
        origin = message("prior: of a quartz-flexure accelerometer")
        yield _stated("turn_on", "turn-on", "g", "run", stated, TURN_ON, origin)


def _nonlinearity_sources(bench: BenchFile, model: ForwardModel) -> Iterator[ErrorSource]:
    for name, effect, unit, prior in (
        ("K2", "quadratic_nonlinearity", "1/g", K2_PRIOR),
        ("K3", "cubic_nonlinearity", "1/g^2", K3_PRIOR),
    ):
        left = _without(applied for applied in model.effects if applied.effect.name == effect)
        if left:
            stated: ErrorSize | None = getattr(bench.uncertainty, name)
            source = _stated(name, name, unit, "run", stated, prior, message("prior: plausible size"))
            yield replace(source, group="block", channels=left)


def _u(stated: ErrorSize | None, prior: Distribution) -> float:
    return (prior if stated is None else stated.to_distribution()).u


def _without(effects: Iterable[AppliedEffect]) -> tuple[str, ...]:
    """Return the channels on which none of the effects acts."""
    known = {channel for applied in effects for channel in applied.channels}
    return tuple(channel for channel in CHANNELS if channel not in known)


def _stated(
    name: str,
    symbol: str,
    unit: str,
    common: Common,
    stated: ErrorSize | None,
    usual: Distribution,
    origin: str,
) -> ErrorSource:
    size = Size(usual, origin, prior=True) if stated is None else Size.stated(stated)
    return _of_size(name, symbol, unit, common, size)


def effect_sources(setup: Setup) -> Iterator[ErrorSource]:
    """Yield a source for each parameter of the model's effects, with the u that the model file states.

    If the file states no u, the catalogue's plausible value of the parameter serves as u. (A fit uses a wider
    prior, so that the data decide.) For an effect of a meter temperature that was not recorded, see
    `unread_sources`.
    """
    problem, unread = setup.effect_problem, setup.conditions.meter_c is None
    for name, unknown in zip(problem.names(), problem.effects, strict=True):
        if unread and setup.model.effects[unknown.effect].effect.name in THERMAL:
            continue
        parameter = problem.parameter(unknown)
        yield ErrorSource(
            name=name,
            symbol=parameter.name,
            unit="SI",
            distribution=Distribution(unknown.prior_u / (1.0 if unknown.stated else WEAK)),
            common="run",
            group="block",
            origin=message("model file")
            if unknown.stated
            else message("model file states no u: plausible size"),
            prior=not unknown.stated,
            effect=unknown,
            written_in=(parameter.unit, parameter.si_per_unit),
        )
