"""The terms of the residual dictionary: functions (courses) of angle, turns, time, temperature and pass."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, NamedTuple

import numpy as np

from bench.base.arrays import ARCSEC, MINUTE, Floats
from bench.base.languages import message
from bench.diagnosis.linear import LinearSystem
from bench.model.conditions import Conditions
from bench.model.effects import CATALOGUE, AppliedEffect, Parameter, Stage
from bench.model.effects.base import Seen, lagged
from bench.model.effects.formula import SUBSYSTEM_OF, FormulaEffect, ValueReading, interpret, variables_of
from bench.model.effects.voltmeter import LOW_RANGE_V

SIZE_NAMES: Final = ("A", "B")
FASTEST: Final = 6
"""Largest number of half waves over a run that describe a slow change in time."""
MOST_WAVES: Final = 200
"""Largest number of half waves over a run of usual length; faster waves are aliases of slower ones."""
MIDDLES: Final = (0.3, 0.4, 0.5, 0.6, 0.7)
"""Fractions of a run at which a parabola in time may have its vertex."""
CREEPS_MIN: Final = (1, 4, 16)
"""Times, min, after which a creep grows with ln of the time: a factor of four apart, as ln hardly differs."""
LEVELS: Final = (-0.8, -0.6, -0.4, -0.2, -0.05, 0.05, 0.2, 0.4, 0.6, 0.8)
"""Specific forces, g, at which a step is tried: every 0.2 g, and close to zero."""
FORCE_STEPS: Final = tuple(f"(a {'<' if level < 0.0 else '>'} {level:g})" for level in LEVELS)
"""Steps at these levels. They are zero at no force, so the bias stays the signal at no force."""


@dataclass(frozen=True)
class TermUnit:
    """The unit of the amplitude of a term: its symbol `text`, and its value `si` in SI.

    `plausible` is the plausible size, SI; `plausible_per_k` is that of a term in proportion to temperature, SI/K.
    """

    text: str
    si: float
    plausible: float
    plausible_per_k: float = 0.0


BIAS: Final = TermUnit("ug", 1e-6, 30e-6, 60e-6)
SCALE: Final = TermUnit("ppm", 1e-6, 50e-6, 100e-6)
ANGLE: Final = TermUnit("arcsec", ARCSEC, 10 * ARCSEC, 10 * ARCSEC)
VOLTS: Final = TermUnit("uV", 1e-6, 20e-6, 20e-6)
SQUARE: Final = TermUnit("ug", 1e-6, 20e-6)
STEP: Final = TermUnit("ug", 1e-6, 40e-6)
VOLTS_PER_V2: Final = TermUnit("uV/V^2", 1e-6, 3e-6)
VOLTS_PER_V3: Final = TermUnit("uV/V^3", 1e-6, 1.3e-6)
GAIN: Final = TermUnit("ppm", 1e-6, 25e-6)


class TimeCourse(NamedTuple):
    """A course over the readings that an unnamed effect may follow; its values are of order 1.

    Each of the formulas `expressions` has its own amplitude; `constants` are parameters with a single value.
    With `of_temperature`, the course is in kelvin; with `of_angle`, it depends on the head angle. Only a
    `long` course may act on scale factor and voltage and, if it has a `where`, on a meter's gain. A `narrow`
    course does not act on stand angles: a step, a fast wave, one angle, or a wave in one mounting. `where`
    says in words where it acts. In a scale factor, `settled` takes the place of the course.
    """

    words: str
    expressions: tuple[str, ...]
    constants: tuple[Parameter, ...] = ()
    of_temperature: bool = False
    long: bool = False
    narrow: bool = False
    of_angle: bool = False
    where: str = ""
    settled: TimeCourse | None = None


class DictionaryTerm(NamedTuple):
    """A term of the dictionary: formulas, each with an amplitude in `unit`, added at one stage of the model.

    `family` describes it in words. At the stand, it is added to the angle `adds_to`. `course` is None for powers
    and products. With `in_proportion`, the course changes the scale factor or the meter's gain.
    """

    family: str
    stage: Stage
    expressions: tuple[str, ...]
    unit: TermUnit
    adds_to: str = ""
    constants: tuple[Parameter, ...] = ()
    course: TimeCourse | None = None
    in_proportion: bool = False

    @property
    def where(self) -> str:
        """Where the term acts, in words: an angle, time, pass or mounting; empty for everywhere."""
        return self.course.where if self.course is not None else ""

    def effect(self, name: str, *, per_channel: bool) -> FormulaEffect:
        """Return the term as an effect with this name; amplitudes are `per_channel` or common to all."""
        sizes = SIZE_NAMES[: len(self.expressions)]
        unit = self.unit
        return FormulaEffect(
            name=name,
            stage=self.stage,
            subsystem=SUBSYSTEM_OF[self.stage],
            parameters=(
                *(Parameter(s, unit.text, unit.si, unit.plausible, per_channel=per_channel) for s in sizes),
                *self.constants,
            ),
            sentence=message(f"something without a name, described by {self.family}"),
            shown_by=message("a run over which more changes of what its formula depends on"),
            expression=" + ".join(
                f"{size} * {_factor(text)}" for size, text in zip(sizes, self.expressions, strict=True)
            ),
            adds_to=self.adds_to,
        )


def _factor(text: str) -> str:
    call = text.endswith(")") and text.count("(") == 1 and text.partition("(")[0].isidentifier()
    plain = call or text.isidentifier()
    return text if plain else f"({text})"


TermColumns = tuple[DictionaryTerm, int | None, Floats]
"""A term in one channel, or in all (None), with the columns (k, N) of its k sizes."""


def dictionary(linear: LinearSystem) -> Iterator[TermColumns]:
    """Yield each term for single channels and for all channels, with columns (k, N) of plausible sizes.

    Terms of the stand or the head are for all channels, products of the force for single ones, since each
    accelerometer has its own. Terms that change no row are left out.
    """
    values_of = cache(_values_of(linear))
    for term in _terms(linear):
        changes = _changes(linear, term, values_of)
        shown = np.asarray(changes.any(axis=(0, 2))).tolist()
        for channel in range(3) if term.stage in WITH_CHANNELS else ():
            if shown[channel]:
                yield term, channel, changes[:, channel]
        if any(shown) and (term.course is not None or term.stage is not Stage.BLOCK_OUTPUT):
            yield term, None, changes.sum(axis=1)


WITH_CHANNELS: Final = (Stage.BLOCK_OUTPUT, Stage.VOLTMETER_READING)


def _changes(linear: LinearSystem, term: DictionaryTerm, values_of: Callable[[TimeCourse], Floats]) -> Floats:
    """Return the changes (k, channels, N) of the rows by plausible sizes of the k amplitudes of a term."""
    if term.course is not None:
        added = term.unit.plausible * values_of(term.course).T
        changes = linear.stage_columns(added, term.stage, term.adds_to, in_proportion=term.in_proportion)
        return np.ascontiguousarray(changes.transpose(1, 2, 0))
    effect, sizes = term.effect("term", per_channel=True), SIZE_NAMES[: len(term.expressions)]
    each = (AppliedEffect(effect, {size: np.full(3, term.unit.plausible)}) for size in sizes)
    return np.stack([linear.effect_columns(applied).T for applied in each])


def _values_of(linear: LinearSystem) -> Callable[[TimeCourse], Floats]:
    """Return a function for the values (k, n) of the k formulas of a course; a reading that has none gets 0."""
    conditions = linear.conditions
    seen = Seen(conditions.angle_rad, conditions, linear.block)
    variables = {name: of(seen) for name, of in variables_of(Stage.HEAD_ANGLE).items()}

    def values_of(course: TimeCourse) -> Floats:
        names = variables | {p.name: np.asarray(p.default) for p in course.constants}
        reading = ValueReading(names, lambda of, lag: lagged(of, conditions.elapsed_s, float(lag)))
        values = np.empty((len(course.expressions), len(conditions)))
        with np.errstate(all="ignore"):
            for own, text in zip(values, course.expressions, strict=True):
                own[:] = interpret(text, reading)
        values[~np.isfinite(values)] = 0.0
        return values

    return values_of


# --- terms ------------------------------------------------------------------------------------------


def _terms(linear: LinearSystem) -> Iterator[DictionaryTerm]:
    """Yield every term: the courses in each place, products of the force, and terms of the voltage."""
    courses = list(_courses(linear.readings.conditions()))
    for course in courses:
        yield _of_course(course, message("the bias"), Stage.BLOCK_OUTPUT, BIAS)
        if course.long:
            settled = course.settled or course
            yield _of_course(
                settled, message("the scale factor"), Stage.BLOCK_OUTPUT, SCALE, in_proportion=True
            )
        yield _of_course(course, message("the head's angle"), Stage.HEAD_ANGLE, ANGLE)
        # a platform does not turn or roll with the head's angle
        for angle, what in STAND_WORDS.items():
            if not course.narrow and (angle == AXIS_TILT or not course.of_angle):
                yield _of_course(course, what, Stage.STAND, ANGLE, angle)
    for words, expressions in FORCES.items():
        for text in expressions:
            yield DictionaryTerm(words, Stage.BLOCK_OUTPUT, (text,), STEP if text in FORCE_STEPS else SQUARE)
    if linear.readings.unit == "V":
        yield from _of_voltmeters(courses)


def _of_course(
    course: TimeCourse,
    place: str,
    stage: Stage,
    unit: TermUnit,
    adds_to: str = "",
    *,
    in_proportion: bool = False,
) -> DictionaryTerm:
    """Return the term of a course at a stage; `place` says in words where it acts."""
    texts, signal = course.expressions, "U" if stage is Stage.VOLTMETER_READING else "a"
    if course.of_temperature:
        unit = TermUnit(f"{unit.text}/K", unit.si, unit.plausible_per_k)
    return DictionaryTerm(
        message(f"{course.words}, in {place}"),
        stage,
        tuple(f"{signal} * ({text})" for text in texts) if in_proportion else texts,
        unit,
        adds_to,
        course.constants,
        course,
        in_proportion=in_proportion,
    )


AXIS_TILT: Final = "axis_tilt"
STAND_WORDS: Final = {
    "axis_tilt": message("a tilt of the axis"),
    "mounting_error": message("a turn of the block on the platform"),
    "mounting_roll": message("a roll of the block on the platform"),
}

FORCES: Final[dict[str, tuple[str, ...]]] = {
    message("a square or product of the specific force"): (
        "a**2",
        "aj**2",
        "ak**2",
        "a * aj",
        "a * ak",
        "aj * ak",
    ),
    message("a third power of the specific force"): (
        "a**3",
        "a**2 * aj",
        "a**2 * ak",
        "a * aj**2",
        "aj**3",
        "ak**3",
    ),
    message("a fourth or fifth power of the specific force"): ("a**4", "a**5"),
    message("the size of the specific force"): ("abs(a)", "a * abs(a)", "abs(aj)", "abs(ak)"),
    message("a step at a level of the specific force"): (*FORCE_STEPS, "tanh(20 * aj)", "tanh(20 * ak)"),
}


def _of_voltmeters(courses: Sequence[TimeCourse]) -> Iterator[DictionaryTerm]:
    stage = Stage.VOLTMETER_READING
    for course in courses:
        if course.long and course.where:
            yield _of_course(course, message("the gain of the voltmeter"), stage, GAIN, in_proportion=True)
    for text in ("abs(U)", "abs(Ux)", "abs(Uy)", "abs(Uz)"):
        yield DictionaryTerm(message("the size of a voltage"), stage, (text,), GAIN)
    yield DictionaryTerm(message("a power of the voltage"), stage, ("U**2",), VOLTS_PER_V2)
    yield DictionaryTerm(message("a power of the voltage"), stage, ("U**3",), VOLTS_PER_V3)
    low, below = "(abs(U) < low)", (_constant("low", "V", 1.0, LOW_RANGE_V),)
    yield DictionaryTerm(message("voltages below 1.2 V"), stage, (low,), VOLTS, constants=below)
    yield DictionaryTerm(
        message("voltages below 1.2 V, in proportion"), stage, (f"U * {low}",), GAIN, constants=below
    )


def _constant(name: str, unit: str, si: float, value: float) -> Parameter:
    """Return a shape parameter with a single value, SI."""
    return Parameter(name, unit, si, value, per_channel=False, grid=(value,), default=value)


# --- courses ----------------------------------------------------------------------------------------


def _courses(conditions: Conditions) -> Iterator[TimeCourse]:
    """Yield the courses that can vary over these readings."""
    yield from _of_angle(conditions)
    yield from _of_turns(conditions)
    yield from _of_time(conditions)
    yield from _of_passes(conditions)
    if np.ptp(conditions.warmth_k) > 0.0:
        # another lag of an effect of the catalogue is no form of its own; nor is another time constant
        for lag_s in shapes("thermal_bias", "lag"):
            text = "lagged(temperature, lag)" if lag_s else "temperature"
            behind = (_constant("lag", "min", MINUTE, lag_s),) if lag_s else ()
            yield TimeCourse(
                message("the temperature, at once or with a lag"),
                (text,),
                behind,
                of_temperature=True,
                long=True,
            )


def shapes(effect: str, parameter: str) -> tuple[float, ...]:
    """Return the grid of values, in SI, of a shape parameter of an effect of the catalogue."""
    return next(p.grid for p in CATALOGUE[effect].parameters if p.name == parameter)


def _visits(conditions: Conditions) -> range:
    """Return the numbers of the mountings, from 1; none if there is only one."""
    changes = np.count_nonzero(np.diff(conditions.mount[np.isfinite(conditions.angle_rad)]))
    return range(1, int(changes) + 2) if changes else range(0)


def _in_visit(number: int) -> str:
    return f"(visit > {number - 0.5:g}) * (visit < {number + 0.5:g})"


def _of_angle(conditions: Conditions) -> Iterator[TimeCourse]:
    angle = conditions.angle_rad[np.isfinite(conditions.angle_rad)]
    distinct = len(np.unique(np.round(np.degrees(angle) % 360.0, 1)))
    visits = _visits(conditions)
    for k in (0.5, *range(1, min(distinct // 2, 6) + 1)):
        inside = "angle" if k == 1 else f"{k:g} * angle"
        wave = (f"cos({inside})", f"sin({inside})")
        yield from _by_mounting(TimeCourse(message(f"a wave, {k:g} per turn"), wave, of_angle=True), visits)
    yield TimeCourse(message("the angle of the head, unwound between passes"), ("angle / (2 * pi)",))
    for degrees in sorted(set(np.round(np.degrees(angle), 1).tolist())):
        at = f"(abs(angle - {np.radians(degrees):.6g}) < 0.004)"
        course = TimeCourse(message("one angle of the head"), (at,), narrow=True, where=f"{degrees:g}°")
        yield from _by_mounting(course, visits)


def _by_mounting(course: TimeCourse, visits: range) -> Iterator[TimeCourse]:
    """Yield a course of all mountings, then the same course of each one."""
    yield course
    for visit in visits:
        yield TimeCourse(
            message(f"{course.words}, of one mounting"),
            tuple(f"{text} * {_in_visit(visit)}" for text in course.expressions),
            narrow=True,
            where=", ".join(filter(None, (course.where, message(f"mounting {visit}")))),
        )


def _of_turns(conditions: Conditions) -> Iterator[TimeCourse]:
    yield TimeCourse(message("the turn of the head since the block was mounted"), ("turned / (2 * pi)",))
    yield TimeCourse(message("the turn of the head since the start"), ("wound / (2 * pi)",))
    for turns in (0.25, 0.5, 1, 2):
        yield TimeCourse(
            message("what fades as the head is turned"),
            (f"exp(-travelled / ({2 * turns:g} * pi))",),
            long=True,
        )
    if len(set(conditions.direction[np.isfinite(conditions.angle_rad)].tolist())) > 1:
        yield TimeCourse(message("the direction of approach"), ("direction",))
        yield TimeCourse(
            message("the direction of approach, once per turn"),
            ("direction * cos(angle)", "direction * sin(angle)"),
        )


def _of_time(conditions: Conditions) -> Iterator[TimeCourse]:
    time = conditions.elapsed_s
    if np.ptp(time) <= 0.0:
        return
    span = (_constant("T", "s", 1.0, float(f"{np.ptp(time):.4g}")),)
    yield TimeCourse(message("the time"), ("time / T",), span, long=True)
    for middle in MIDDLES:
        yield TimeCourse(message("a parabola in time"), (f"(time / T - {middle:g})**2",), span, long=True)
    for tau_s in shapes("warm_up", "tau"):
        tau = (_constant("tau", "min", MINUTE, tau_s),)
        yield TimeCourse(message("what fades with time"), ("exp(-time / tau)",), tau, long=True)
    for minutes in CREEPS_MIN:
        tau = (_constant("tau", "min", MINUTE, minutes * MINUTE),)
        creep = TimeCourse(message("what creeps with time"), ("log(1 + time / tau)",), tau, long=True)
        # a bias creeps from where it was; a scale factor settles, and holds as at the end of the run
        settled = creep._replace(expressions=("log((tau + time) / (tau + T))",), constants=(*tau, *span))
        yield creep._replace(settled=settled)
    for k in range(1, FASTEST + 1):
        yield TimeCourse(message("a slow wave in time"), (f"cos({k:g} * pi * time / T)",), span)
    angled = np.unique(time[np.isfinite(conditions.angle_rad)])
    for k in _frequencies(angled):
        wave = (f"cos({k:g} * pi * time / T)", f"sin({k:g} * pi * time / T)")
        yield TimeCourse(message("a wave in time"), wave, span, narrow=True)
    for at in (angled[1:] + angled[:-1]) / 2:
        when = (_constant("t", "s", 1.0, float(f"{at:.7g}")),)
        yield TimeCourse(
            message("a step in time"),
            ("(time > t)",),
            when,
            narrow=True,
            where=message(f"from {at / MINUTE:.0f} min on"),
        )


def _frequencies(time_s: Floats) -> range:
    """Return the numbers of half waves per run that the ascending times sample at least twice per period."""
    if len(time_s) < 2:
        return range(0)
    fastest = int(np.ptp(time_s) / float(np.median(np.diff(time_s))))
    return range(FASTEST + 1, min(fastest, MOST_WAVES) + 1)


def _of_passes(conditions: Conditions) -> Iterator[TimeCourse]:
    angled = np.isfinite(conditions.angle_rad)
    passes = sorted(set(conditions.pass_number[angled].tolist()))
    visits = _visits(conditions)
    for visit in visits:
        yield TimeCourse(
            message("one mounting"), (_in_visit(visit),), long=True, where=message(f"mounting {visit}")
        )
    for number in passes if len(passes) > 1 else ():
        alone = f"(pass_number > {number - 0.5:g}) * (pass_number < {number + 0.5:g})"
        yield TimeCourse(message("one pass"), (alone,), long=True, where=f"pass {number}")
        for visit in visits:
            yield TimeCourse(
                message("one pass of one mounting"),
                (f"{alone} * {_in_visit(visit)}",),
                long=True,
                where=message(f"pass {number} of mounting {visit}"),
            )
