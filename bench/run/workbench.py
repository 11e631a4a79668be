"""Execution of single plan steps with the instruments of a bench and its operator, including levelling."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from bench.base.arrays import ARCSEC, CHANNELS
from bench.base.languages import message
from bench.config.procedure.plan import (
    Ask,
    Level,
    Mount,
    Power,
    Read,
    SelectInput,
    SetTemperature,
    Settle,
    Step,
    Turn,
    Wait,
)
from bench.config.procedure.steps import in_scan_order, read_order
from bench.readings.columns import Rail, between
from bench.readings.table import Reading
from bench.run.driver_checks import checked_inclination, checked_position, checked_samples
from bench.run.events import (
    Answered,
    CameToRest,
    EventType,
    InputSelected,
    Levelled,
    Mounted,
    Powered,
    Result,
    TemperatureSet,
    Turned,
)
from bench.run.instruments import (
    Instruments,
    TemperatureCheck,
    told_around,
    told_at_mounting,
    told_at_reading,
)
from bench.run.person import UNTOUCHED, ask, confirm, mount_prompt, untouched_prompt
from bench.run.power import NAP_S, Feeding, UnitPower, warm_up
from bench.run.samples import (
    SLOW_AFTER_S,
    ChamberWatch,
    Criterion,
    Settling,
    air_c,
    describe,
    wait_until_settled,
)
from drivers import interfaces
from drivers.angles import wrapped_rad
from drivers.clock import Clock
from drivers.interfaces import (
    BadReading,
    BenchError,
    HeadPosition,
    Inclination,
    LimitExceeded,
    ThermalChamber,
    Voltmeter,
    VoltmeterSettings,
)
from drivers.person import Person, Prompt, PromptKind

MOST_ATTEMPTS: Final = 5
MOST_PAIRS: Final = 3
ZERO_MOVED: Final = 5.0
"""Greatest plausible shift of the level's zero, in standard uncertainties; beyond it, read again."""


@dataclass
class Levelling:
    """One levelling of the platform with the level of a bench.

    `setting_u_rad` is the standard uncertainty of a head setting. `zero` is the level's own zero offset, None until
    it is known; `carry_out` updates it. `position` is the head's last position. `moved` says whether the person has
    set the platform's screws.
    """

    instruments: Instruments
    person: Person
    setting_u_rad: float
    zero: Inclination | None = None
    position: HeadPosition | None = field(default=None, init=False)
    moved: bool = field(default=False, init=False)

    def carry_out(self, step: Level) -> Levelled:
        """Level the platform if the step requires it; measure and return the remaining tilt angles.

        Raises `LimitExceeded` if the platform is still not level after `MOST_ATTEMPTS` attempts, and the errors
        of level, head and person.
        """
        level = self.instruments.level
        if level is None:
            raise BenchError(
                "level",
                f"{step.key}: the procedure levels the platform, but the bench has no level",
                "add one to the bench file, or take a procedure without levelling",
            )
        self._set_head(step, 1)
        if step.within_rad is None:
            return self._measured(step, level, 1)
        off = ""
        for attempt in range(1, MOST_ATTEMPTS + 1):
            self._have_levelled(step, attempt, off)
            found = self._measured(step, level, attempt)
            if max(abs(found.alpha1_arcsec), abs(found.alpha2_arcsec)) <= step.within_rad / ARCSEC:
                return found
            off = message(
                f"α1 = {found.alpha1_arcsec:+.1f}″ along the shaft and α2 = {found.alpha2_arcsec:+.1f}″ across it"
            )
        raise LimitExceeded(
            level.name,
            f"after {MOST_ATTEMPTS} attempts the platform is still off by {off}, more than "
            f"{step.within_rad / ARCSEC:g}″",
            "loosen its screws and level it again, or widen the limit in the procedure",
        )

    def _have_levelled(self, step: Level, attempt: int, off: str) -> None:
        text = message("Level the platform by its screws, along the shaft and across it, and confirm")
        confirm(
            self.person,
            Prompt(
                id=f"{step.key}/platform{attempt}",
                kind=PromptKind.CONFIRM,
                text=message(f"It is off by {off}. {text}") if off else text,
                action={
                    "do": "level_platform",
                    "installation": step.installation,
                    "series": step.series,
                },
            ),
        )
        self.moved = True

    def _set_head(self, step: Level, number: int) -> HeadPosition:
        head = self.instruments.head
        self.position = checked_position(head, head.move(0.0, 1, f"{step.key}/zero{number}"))
        return self.position

    def _measured(self, step: Level, level: interfaces.Level, attempt: int) -> Levelled:
        rows, along, across, zeros = [], [], [], []
        for number in range(1, step.settings + 1):
            position = self.position if number == 1 and self.position else self._set_head(step, number)
            head_rad = wrapped_rad(position.angle_rad)
            first, second = self._pair(level, f"{step.key}/{attempt}.{number}")
            rows.append((head_rad, first.along_rad, first.across_rad, second.along_rad, second.across_rad))
            along.append((first.along_rad - second.along_rad) / 2.0)
            across.append((first.across_rad - second.across_rad) / 2.0 - head_rad)
            zeros.append(_zero(first, second))
        n, sizes = step.settings, level.sizes
        alpha1, alpha2 = sum(along) / n, sum(across) / n
        reading = sizes.reading_rad / math.sqrt(2.0 * n)
        u1 = math.hypot(reading, sizes.scale * alpha1, sizes.cross * alpha2)
        setting = self.setting_u_rad / math.sqrt(n)
        u2 = math.hypot(reading, sizes.scale * alpha2, sizes.cross * alpha1, setting)
        return Levelled(
            level_of=step.installation,
            level_series=step.series,
            adjusted=step.within_rad is not None,
            alpha1_arcsec=_arcsec(alpha1),
            u_alpha1_arcsec=_arcsec(u1),
            alpha2_arcsec=_arcsec(alpha2),
            u_alpha2_arcsec=_arcsec(u2),
            level_zero_arcsec=(
                _arcsec(sum(zero.along_rad for zero in zeros) / n),
                _arcsec(sum(zero.across_rad for zero in zeros) / n),
            ),
            level_readings=tuple(tuple(map(_arcsec, row)) for row in rows),
        )

    def _pair(self, level: interfaces.Level, key: str) -> tuple[Inclination, Inclination]:
        """Return the readings in both positions.

        If they imply another zero of the level than before, one may be misread: both are repeated.
        """
        for attempt in range(1, MOST_PAIRS + 1):
            first = self._read(level, f"{key}/first{attempt}", turned=False)
            second = self._read(level, f"{key}/turned{attempt}", turned=True)
            before, self.zero = self.zero, _zero(first, second)
            if before is None or _agree(before, self.zero, level.sizes.reading_rad):
                return first, second
        raise BadReading(
            level.name,
            f"its zero differed each time, at last {_arcsec(self.zero.along_rad):+.1f}″ along and "
            f"{_arcsec(self.zero.across_rad):+.1f}″ across"
            if self.zero
            else "its zero is unknown; determine it in two positions",
            "let level and platform reach one temperature, check that it sits firmly, then repeat this step",
        )

    def _read(self, level: interfaces.Level, key: str, *, turned: bool) -> Inclination:
        """Return the level's reading. For an electronic level, first ask the person to place it.

        The prompts of a bubble level, which the person reads, also say how to place it.
        """
        if not level.asks_person:
            how = (
                message("half a turn from its first position")
                if turned
                else message("in its first position, along the shaft")
            )
            confirm(
                self.person,
                Prompt(
                    id=f"{key}/place",
                    kind=PromptKind.CONFIRM,
                    text=message(f"Put the level on the platform {how}, let go of it, and confirm"),
                    action={"do": "place_level", "turned": turned},
                ),
            )
        return checked_inclination(level, level.inclination(key, turned=turned))


def _zero(first: Inclination, second: Inclination) -> Inclination:
    return Inclination(
        (first.along_rad + second.along_rad) / 2.0, (first.across_rad + second.across_rad) / 2.0
    )


def _agree(one: Inclination, other: Inclination, reading_rad: float) -> bool:
    # each zero is the mean of two readings, so the difference of two zeros has the uncertainty of one reading
    most_rad = ZERO_MOVED * reading_rad
    return max(abs(one.along_rad - other.along_rad), abs(one.across_rad - other.across_rad)) <= most_rad


def _arcsec(angle_rad: float) -> float:
    return round(angle_rad / ARCSEC, 4)


QUICK_NPLC: Final = 1.0
"""Integration time of the settling samples, in line periods: the shortest that rejects mains interference."""


@dataclass(frozen=True)
class BenchSetup:
    """The instruments of a run, their clock, and settings from the bench file.

    `range_v` is the fixed range of the voltmeters. `least_samples` is the smallest number of samples that all
    voltmeters accept. `setting_u_rad` is the standard uncertainty of a head setting. `block_limits_c` are the
    permitted temperatures of the block, °C; `feeding` describes its power supply. A chamber whose temperature
    hardly changes for `slow_chamber_s` is reported. `aside` returns a context for samples outside readings.
    `mistake` returns the mistake of a simulation, which ends the connection to the simulated instrument.
    """

    instruments: Instruments
    clock: Clock
    range_v: float
    block_limits_c: tuple[float, float] = (-math.inf, math.inf)
    least_samples: int = 1
    setting_u_rad: float = 0.0
    slow_chamber_s: float = SLOW_AFTER_S
    feeding: Feeding | None = None
    aside: Callable[[], AbstractContextManager[None]] = nullcontext
    mistake: Callable[[], BenchError | None] = lambda: None


@dataclass
class Workbench:
    """Executor of plan steps on a bench; `now_s` returns the bench time since the start of the run, s.

    `visits` maps (series, installation) to the series number of later readings if the block was remounted during
    that series. `power` controls the block's supply, where there is one. `tell` records an event. `between_naps` is
    called repeatedly during waits. `temperature_c` is the temperature last read or entered by a person;
    `demanded_c` is the chamber's last set point. `platform_moved` says whether the platform was levelled since the
    last point.
    """

    bench: BenchSetup
    person: Person
    now_s: Callable[[], float]
    between_naps: Callable[[], None] = lambda: None
    on_settling: Callable[[Settling], None] = lambda state: None
    tell: Callable[[EventType, dict[str, Any]], None] = lambda kind, data: None
    visits: Mapping[tuple[int, str], int] = field(default_factory=dict)
    power: UnitPower | None = None
    temperature_c: float | None = field(default=None, init=False)
    demanded_c: float | None = field(default=None, init=False)
    platform_moved: bool = field(default=False, init=False)
    _reference_v: float | None = field(default=None, init=False)
    _position: HeadPosition | None = field(default=None, init=False)
    _settings: VoltmeterSettings | None = field(default=None, init=False)
    _level_zero: Inclination | None = field(default=None, init=False)
    _chamber_c: float | None = field(default=None, init=False)
    _around_c: dict[str, float] = field(default_factory=dict, init=False)
    _before_glances: tuple[VoltmeterSettings | None] | None = field(default=None, init=False)
    _glancing: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.instruments, self.clock = self.bench.instruments, self.bench.clock
        self._chamber_watch = ChamberWatch(self.clock, self.bench.slow_chamber_s, self.tell)

    def execute(self, step: Step) -> Result | None:
        """Carry out a step and return its result, or None for a step without one. Raises `BenchError`."""
        if not isinstance(step, Power):
            self.watch_rails(step.key)
        brought: Result | None = step.carry_out(self)
        return brought

    def do_mount(self, step: Mount) -> Mounted:
        """Ask the person to mount the block and to enter the temperatures that no instrument measures."""
        confirm(self.person, mount_prompt(step, chamber=self.instruments.chamber is not None))
        self._position = None
        check = TemperatureCheck(self.person, self.temperature_c, self.demanded_c)
        self.temperature_c = told_at_mounting(self.instruments, step.key, check)
        by_person = {c: by for c, by in self.instruments.around.items() if by != "chamber" and by.asks_person}
        around = replace(self.instruments, around=by_person)
        self._around_c = told_around(around, {}, None, step.key, self._check_around)
        if self.power is not None and self.power.on and self.power.supply.asks_person:
            self.power.look(step.key)
        return Mounted(self.temperature_c)

    def still_mounted(self, step: Mount) -> bool:
        """Ask whether the block is untouched since this mounting step; return False if it was mounted again."""
        return ask(self.person, untouched_prompt(step)) == UNTOUCHED

    def do_temperature(self, step: SetTemperature) -> TemperatureSet:
        """Set the chamber to the step's set point without waiting for its air; return the set point, °C."""
        chamber = self._chamber(message(f"{step.key}: the procedure sets a temperature"))
        before_c, self.demanded_c = self.demanded_c, step.target_c
        try:
            chamber.set_temperature(step.target_c, step.key)
        except LimitExceeded:  # raised before anything is sent; after other errors the set point is uncertain
            self.demanded_c = before_c
            raise
        self._chamber_watch.begin(chamber, step.target_c, step.key)
        self.temperature_c = None
        return TemperatureSet(step.target_c)

    def do_power(self, step: Power) -> Powered:
        """Switch the block's power off, on, or off and on again; after switching it on, wait for the warm-up."""
        if self.power is None:
            raise BenchError(
                "power_supply",
                f"{step.key}: the procedure switches the block, but the bench has no supply for it",
                "state in the bench file how the block is supplied",
            )
        match step.switch:
            case "off":
                self.power.switch_off(step.key)
                return Powered(step.switch, None)
            case "cycle":
                self.power.cycle(step.off_s, step.key)
            case "on":
                self.power.have_on(step.key)
        after_s, at = warm_up(self.power, step.warm_up_s, self._quick_signals, self.on_settling, step.key)
        return Powered(step.switch, round(after_s, 3), at)

    def watch_rails(self, key: str) -> None:
        """Check the rails of the block's supply when the check is due. Raises `RailFault`."""
        if self.power is not None:
            self.power.watch(key)

    def _rails(self, key: str) -> Mapping[str, Rail]:
        return {} if self.power is None else self.power.at_reading(key)

    def _chamber(self, wanted: str) -> ThermalChamber:
        if self.instruments.chamber is None:
            raise BenchError(
                "chamber",
                f"{wanted}, but the bench has no chamber",
                "add one to the bench file, or take a procedure without temperatures",
            )
        return self.instruments.chamber

    def do_turn(self, step: Turn) -> Turned:
        """Turn the head to the step's target angle; return the target and the angle read back, degrees."""
        self.platform_moved, head = False, self.instruments.head
        self._position = checked_position(head, head.move(step.target_rad, step.direction, step.key))
        return Turned(_degrees(self._position.angle_rad), _degrees(step.target_rad))

    def do_level(self, step: Level) -> Levelled:
        """Level the platform if the step requires it, and measure its remaining tilt."""
        levelling = Levelling(self.instruments, self.person, self.bench.setting_u_rad, self._level_zero)
        try:
            found = levelling.carry_out(step)
        finally:
            self.platform_moved |= levelling.moved
        self._position, self._level_zero = levelling.position, levelling.zero
        return found

    def do_wait(self, step: Wait) -> None:
        """Wait for the step's duration; handle the operator's commands and watch rails and chamber meanwhile."""
        end_s = self.clock.now_s() + step.duration_s
        self._end_glances()
        while (left_s := end_s - self.clock.now_s()) > 0:
            self.between_naps()
            self.watch_rails(step.key)
            self._chamber_watch.look(self.instruments.chamber, step.key)
            self.clock.sleep(min(NAP_S, left_s))

    def do_settle(self, step: Settle) -> CameToRest:
        """Wait until the signals, or the chamber's temperature, stay within the step's precision."""
        criterion = Criterion(step.precision, step.window_s, step.timeout_s, step.interval_s)

        def nap(state: Settling) -> None:
            self.on_settling(state)
            self.between_naps()
            self.watch_rails(step.key)

        if step.what == "signals":
            state = wait_until_settled(self._quick_signals, criterion, self.clock, nap)
        else:
            chamber = self._chamber(message(f"{step.key}: the procedure waits for a temperature"))
            if chamber.asks_person:
                raise BenchError(
                    chamber.name,
                    "a person cannot read the temperature repeatedly",
                    "state a plain soak in the procedure, such as 'soak: 4 h'",
                )
            state = wait_until_settled(
                lambda: (self._air_c(chamber, step.key),),
                criterion,
                self.clock,
                nap,
                names=("",),
                unit="°C",
            )
        return CameToRest(state.elapsed_s, state.values)

    def _air_c(self, chamber: ThermalChamber, key: str) -> float:
        shown_c = air_c(chamber, key)
        self._chamber_watch.take(chamber.name, shown_c)
        return shown_c

    def _quick_signals(self) -> tuple[float, ...]:
        """Return the present signals x, y, z in V: the last of the shortest possible series of samples."""
        settings = VoltmeterSettings(self.bench.range_v, QUICK_NPLC, self.bench.least_samples)
        self._configure(settings)
        samples = self._sample(self.instruments.voltmeters, settings)
        return tuple(samples[channel][-1] for channel in CHANNELS)

    def glance(self) -> tuple[float, ...]:
        """Return the present signals x, y, z in V, outside a reading, and record nothing. Raises `BenchError`."""
        with self.bench.aside():
            if self._before_glances is None:
                self._before_glances = (self._settings,)
            self._glancing = True
            try:
                return self._quick_signals()
            finally:
                self._glancing = False

    def _end_glances(self) -> None:
        """Restore the settings that the meters had before the first glance at the signals.

        The next wait calls this, because there the restoration costs no time; without a wait, the next reading
        does. A meter that refuses the settings is reported only by the reading.
        """
        if self._before_glances is None:
            return
        (settings,), self._before_glances = self._before_glances, None
        if settings is not None:
            with self.bench.aside(), contextlib.suppress(BenchError):
                self._configure(settings)

    def do_input(self, step: SelectInput) -> InputSelected:
        """Ask the person to switch the inputs of the voltmeters to the signals, a short, or a reference voltage."""
        prompt = Prompt(
            id=step.key,
            kind=PromptKind.CONFIRM,
            text=message(f"{step.describe().capitalize()} (at the meters' terminals)"),
            default="yes",
            action={"do": "select_input", "source": step.source, "reference_v": step.reference_v},
        )
        confirm(self.person, prompt)
        self._reference_v = step.reference_v if step.source == "reference" else None
        return InputSelected(step.source, step.reference_v)

    def do_ask(self, step: Ask) -> Answered:
        """Ask the person the question defined in the procedure, and return the answer."""
        prompt = Prompt(
            id=step.key,
            kind=step.kind,
            text=step.text,
            default=step.default,
            unit=step.unit,
            choices=step.choices,
            minimum=step.minimum,
            maximum=step.maximum,
            action={"do": "answer"},
        )
        return Answered(ask(self.person, prompt))

    def do_read(self, step: Read) -> Reading:
        """Take one reading with all voltmeters, along with the temperatures and the supply's rails."""
        settings = VoltmeterSettings(self.bench.range_v, step.nplc, step.samples)
        self._configure(settings)
        self._take_temperature(step.key)
        before = self._rails(step.key)
        begun_s = self.now_s()
        meters = in_scan_order(self.instruments.voltmeters, step.scan)
        samples = self._sample(meters, settings)
        rails = between(before, self._rails(step.key))  # raises if the samples cannot be trusted
        described = describe(samples)
        statistics = [described[channel] for channel in CHANNELS]
        position = None if step.target_rad is None else self._position
        return Reading(
            installation=step.installation,
            series=self.visits.get((step.series, step.installation), step.series),
            pass_number=step.pass_number,
            point=step.point,
            target_deg=None if step.target_rad is None else _degrees(step.target_rad),
            angle_deg=None if position is None else _degrees(position.angle_rad),
            direction=0 if position is None else position.direction,
            time_s=begun_s,
            temperature_c=self.temperature_c,
            temperature_source=""
            if self.instruments.thermometer is None
            else self.instruments.thermometer.sensor,
            chamber_c=self._chamber_c,
            **self._around_c,
            unit="V",
            mean=tuple(of.mean for of in statistics),
            sd=tuple(of.sd for of in statistics),
            samples_taken=step.samples,
            samples={channel: samples[channel] for channel in CHANNELS},
            drift=tuple(of.drift for of in statistics),
            drift_p=tuple(of.drift_p for of in statistics),
            outlier=tuple(of.outlier for of in statistics),
            reference_v=self._reference_v,
            scan_order=read_order(meters),
            rails=rails,
        )

    def _take_temperature(self, key: str) -> None:
        """Read the temperatures of meters, room and block; the block's comes from its thermometer or the chamber.

        A person is asked only once after each mounting and each new set point. Raises `LimitExceeded` if the
        block is outside its permitted temperatures; this stops the run and makes the chamber safe.
        """
        check = TemperatureCheck(self.person, demanded_c=self.demanded_c)
        self.temperature_c, self._chamber_c = told_at_reading(
            self.instruments, self.temperature_c, key, check
        )
        shown_c = self.temperature_c if self.instruments.thermometer is None else self._chamber_c
        self._around_c = told_around(self.instruments, self._around_c, shown_c, key, self._check_around)
        low_c, high_c = self.bench.block_limits_c
        if self.temperature_c is not None and not low_c <= self.temperature_c <= high_c:
            raise LimitExceeded(
                "block",
                f"its temperature is {self.temperature_c:g} °C, outside the limits of the block, {low_c:g} to "
                f"{high_c:g} °C",
                "find out why it came to this temperature, then continue",
            )

    def _check_around(self, column: str) -> TemperatureCheck:
        return TemperatureCheck(self.person, self._around_c.get(column))

    @staticmethod
    def _sample(meters: Sequence[Voltmeter], settings: VoltmeterSettings) -> dict[str, tuple[float, ...]]:
        """Start all meters, then fetch, so that they sample at the same time; return the samples by channel."""
        for meter in meters:
            meter.start()
        samples: dict[str, tuple[float, ...]] = {}
        for meter in meters:
            samples.update(checked_samples(meter, meter.fetch(), settings).items())
        return samples

    def _configure(self, settings: VoltmeterSettings) -> None:
        if not self._glancing:
            self._end_glances()
        if settings == self._settings:
            return
        self._settings = None  # if a meter refuses, the settings are unknown
        for meter in self.instruments.voltmeters:
            meter.configure(settings)
        self._settings = settings


def _degrees(angle_rad: float) -> float:
    """Return an angle in degrees, rounded to 1e-9 to hide floating-point noise, so that 45° is recorded as 45."""
    return round(float(np.degrees(angle_rad)), 9)
