"""The physical truth of a simulated bench: head, block, heat, power; no instrument state."""

from __future__ import annotations

import cmath
import itertools
import math
import threading
from bisect import bisect_right
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.model.geometry import STAND_ANGLES, Distribution, stand_errors
from sim.world.chance import KeyedNumbers
from sim.world.clock import VirtualClock
from sim.world.pose import (
    HeadFault,
    HeadTurn,
    LevelSettings,
    Pose,
    Visit,
    platform_tilt_rad,
    readings_of,
    switched_on_since,
)
from sim.world.power import Power, PowerSettings, dead_v

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from bench.model.forward import ForwardModel
    from bench.model.geometry import Block
    from drivers.clock import Clock
    from drivers.interfaces import Channel, Direction, LevelAxis


_LEAST_SPREAD: Final = 1e-6
"""Smallest relative difference between the lags of air and block, because a formula divides by their difference."""


@dataclass(frozen=True)
class _Stretch:
    """A period from `since_s` on; after t seconds the air is at base + slope·t + Re(excess·exp(-t/lag)), °C.

    With a complex lag the air rings. `block_c` is the block's temperature at the start.
    """

    since_s: float
    base_c: float
    slope_c_s: float
    excess_c: complex
    lag_s: complex
    block_c: float

    def air_c(self, time_s: float) -> float:
        elapsed_s = max(0.0, time_s - self.since_s)
        excess_c = self.excess_c * cmath.exp(-elapsed_s / self.lag_s)
        return self.base_c + self.slope_c_s * elapsed_s + excess_c.real

    def block_c_at(self, time_s: float, block_lag_s: float) -> float:
        """Return the solution of block' = (air - block) / block_lag for the air of this period, °C."""
        elapsed_s = max(0.0, time_s - self.since_s)
        carried_c = self.excess_c * self.lag_s / (self.lag_s - block_lag_s) if self.excess_c else 0.0
        left_c = self.block_c - (self.base_c - self.slope_c_s * block_lag_s + carried_c.real)
        return (
            self.base_c
            + self.slope_c_s * (elapsed_s - block_lag_s)
            + (carried_c * cmath.exp(-elapsed_s / self.lag_s)).real
            + left_c * math.exp(-elapsed_s / block_lag_s)
        )


class Heat:
    """The temperatures of the chamber air and of the block in it; both are `ambient_c` at time `now_s`.

    The block follows the air with the time constant `block_lag_s`. The air keeps a temperature until the next
    change.
    """

    def __init__(self, now_s: float, ambient_c: float, block_lag_s: float) -> None:
        self._block_lag_s = block_lag_s
        self._stretches = [_Stretch(now_s, ambient_c, 0.0, 0.0, 1.0, ambient_c)]

    def air_c(self, time_s: float) -> float:
        """Return the air's temperature at a time, °C."""
        return self._at(time_s).air_c(time_s)

    def block_c(self, time_s: float) -> float:
        """Return the block's temperature at a time, °C."""
        return self._at(time_s).block_c_at(time_s, self._block_lag_s)

    def set_air(self, now_s: float, target_c: float) -> None:
        """Set the air to `target_c` at once."""
        self._go_on(now_s, target_c, 0.0, 0.0, 1.0)

    def relax_air(self, now_s: float, target_c: float, lag_s: float) -> None:
        """Let the air relax to `target_c` with the time constant `lag_s`, as in a chamber that is off."""
        self._go_on(now_s, target_c, 0.0, self.air_c(now_s) - target_c, lag_s)

    def ramp_air(
        self, now_s: float, target_c: float, rate_c_s: float, lag_s: float, ringing_s: float = 0.0
    ) -> None:
        """Ramp the demand from the present air to `target_c` at `rate_c_s`; the air follows with `lag_s`.

        With a period `ringing_s` the air overshoots the target and oscillates about it with this period; the
        oscillation decays with the lag.
        """
        start_c = self.air_c(now_s)
        slope_c_s = math.copysign(rate_c_s, target_c - start_c)
        end_s = now_s + abs(target_c - start_c) / rate_c_s
        self._go_on(now_s, start_c - slope_c_s * lag_s, slope_c_s, slope_c_s * lag_s, lag_s)
        excess_c: complex = self.air_c(end_s) - target_c
        after_s: complex = lag_s
        if ringing_s and end_s > now_s:
            rate = 2.0 * math.pi / ringing_s
            rising_c_s = slope_c_s * (1.0 - math.exp(-(end_s - now_s) / lag_s))
            # The imaginary part makes the air's rate continuous at the end of the ramp.
            excess_c += 1j * (rising_c_s + excess_c.real / lag_s) / rate
            after_s = 1.0 / complex(1.0 / lag_s, rate)
        self._go_on(end_s, target_c, 0.0, excess_c, after_s)

    def _go_on(
        self, since_s: float, base_c: float, slope_c_s: float, excess_c: complex, lag_s: complex
    ) -> None:
        """From `since_s` on, the air follows a line plus an excess, °C; drop the changes scheduled after it.

        The line starts at `base_c` with `slope_c_s`. The excess `excess_c` decays with `lag_s`; complex values make
        it oscillate.
        """
        if cmath.isclose(lag_s, self._block_lag_s, rel_tol=_LEAST_SPREAD):
            lag_s = self._block_lag_s * (1.0 + _LEAST_SPREAD)
        block_c = self.block_c(since_s)
        kept = [stretch for stretch in self._stretches if stretch.since_s <= since_s]
        self._stretches = [*kept, _Stretch(since_s, base_c, slope_c_s, excess_c, lag_s, block_c)]

    def _at(self, time_s: float) -> _Stretch:
        index = bisect_right(self._stretches, time_s, key=lambda stretch: stretch.since_s) - 1
        return self._stretches[max(0, index)]


class Terminals:
    """The terminals of one channel of the world, as the `MeteredSignal` to which a simulated meter is wired."""

    def __init__(self, world: World, channel: Channel) -> None:
        self._world = world
        self._channel = channel
        self._reading = 0

    @property
    def place(self) -> int:
        """The index of the meter on the bench: 0 at channel x, 1 at y, 2 at z."""
        return CHANNELS.index(self._channel)

    @property
    def temperature_c(self) -> float:
        """The temperature of the meter, °C."""
        return self._world.meters_c()

    def signal_v(self, time_s: float | None = None) -> float:
        """Return the voltage at the terminals now, or at `time_s` of the clock, V."""
        return self._world.signal_v(self._channel, time_s)

    def new_reading(self) -> None:
        """Begin a new reading; called when the meter is triggered."""
        self._reading = self._world.new_reading(self._channel)

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for one purpose within the present reading."""
        return self._world.random(purpose, self._channel, self._reading)

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the random generator for a permanent property of the meter, such as its gain error."""
        return self._world.fixed_random(purpose, self._channel)


SETTING_ERROR: Final = "setting_error"
VOLTMETER_ERROR: Final = "voltmeter_error"
STAND_NAMES: Final = (*STAND_ANGLES, SETTING_ERROR, VOLTMETER_ERROR)

_NO_ERROR: Final = Distribution(0.0)
_CACHED_SIGNALS: Final = 4096


@dataclass(frozen=True)
class WorldSettings:
    """Settings of the simulated world.

    `stand` maps names in `STAND_NAMES` to the distributions of the stand errors; an omitted error is zero.
    The stand angles (rad) are drawn at each mounting, "setting_error" alpha4 (rad) at each turn of the head,
    "voltmeter_error" (V) at each reading of each channel.
    The room's temperature is a sine about `ambient_c` with the amplitude (K) and period (s) `room_swing`; the
    meters follow it with the lag `meter_lag_s`. A controlled chamber ramps its demand at `chamber_rate_c_s`,
    and its air follows with the lag `chamber_lag_s`; with a period `chamber_ringing_s` the air overshoots and
    oscillates. The air of a chamber that is off relaxes to `ambient_c` with the lag `chamber_off_lag_s`. The
    block follows the air with the lag `block_time_constant_s`. Heat through the platform moves the block's
    temperature towards the room's, by the fraction `room_share` of their difference. A block without rails in
    `power` always has power.
    """

    block: Block
    model: ForwardModel
    stand: Mapping[str, Distribution]
    seed: int
    ambient_c: float = 23.0
    room_swing: tuple[float, float] = (0.0, 86400.0)
    meter_lag_s: float = 0.0
    block_time_constant_s: float = 750.0
    chamber_rate_c_s: float = 4.0 / 60.0
    chamber_lag_s: float = 120.0
    chamber_off_lag_s: float = 3600.0
    chamber_ringing_s: float = 0.0
    room_share: float = 0.0
    level: LevelSettings = field(default_factory=LevelSettings)
    power: PowerSettings = field(default_factory=PowerSettings)

    def __post_init__(self) -> None:
        """Raise `ValueError` for an unknown name in `stand`."""
        unknown = sorted(set(self.stand) - set(STAND_NAMES))
        if unknown:
            raise ValueError(f"not a stand error: {', '.join(unknown)}; choose from {', '.join(STAND_NAMES)}")


class World(KeyedNumbers):
    """The true state of the bench, including what the head's scale and the meters do not show.

    `began_s` is the clock time at which the world began (0 for a virtual clock; on the system clock, pass the
    present time). All methods may be called from any thread.
    """

    def __init__(self, settings: WorldSettings, clock: Clock, began_s: float = 0.0) -> None:
        self.settings = settings
        self.clock = clock
        self.began_s = began_s
        super().__init__(settings.seed, threading.RLock())
        self._voltmeter_error_v: dict[Channel, float] = dict.fromkeys(CHANNELS, 0.0)
        self._signals: dict[object, Floats] = {}
        self._stands_rad: dict[tuple[str, int], Floats] = {}
        now_s = clock.now_s()
        self._heat = Heat(now_s, settings.ambient_c, settings.block_time_constant_s)
        self._chamber_demand_c: float | None = None
        self._chamber_offset_c = 0.0
        self.head_fault = HeadFault()
        self.power = Power(settings.power, now_s, self.block_c_at, self._lock)
        installation = next(iter(settings.model.installations))
        stand_rad = self._stand_rad(installation, 1)
        at_zero = HeadTurn(now_s, 0.0, 0.0)
        self._poses = [Pose(now_s, installation, 1, stand_rad, at_zero, 0.0, None, 0.0)]
        self._read: list[Visit] = []
        self._level_turned = False
        self._triggered: dict[int, tuple[int, ...]] = {}
        self._asides = itertools.count(1)
        self._aside = False

    def _draw(self, name: str, generator: np.random.Generator) -> float:
        return self.settings.stand.get(name, _NO_ERROR).draw(generator)

    def _stand_rad(self, installation: str, series: int) -> Floats:
        """Return the stand angles of a mounting, rad, shape (5,); cached, because every `recall` needs them."""
        place = (installation, series)
        if place not in self._stands_rad:
            self._stands_rad[place] = stand_errors(
                **{n: self._draw(n, self.fixed_random(n, series, installation)) for n in STAND_ANGLES}
            )
        return self._stands_rad[place]

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Let instruments be read in this context without effect on the history of readings.

        Its end restores a virtual clock's time and the random numbers of the step; other clocks run on.
        """
        with self._lock:
            now_s, kept = self.clock.now_s(), (self._step, self._counts.copy(), self._aside)
            self._step, self._aside = f"aside {next(self._asides)}", True
        try:
            yield
        finally:
            if isinstance(self.clock, VirtualClock):
                self.clock.return_to(now_s)
            with self._lock:
                self._step, self._counts, self._aside = kept

    # --- actions on the bench -----------------------------------------------------------------------

    def mount(self, installation: str, series: int = 1) -> None:
        """Mount the block; the stand angles depend only on the seed, the series and the installation.

        Raises `KeyError` for an installation that is not in the model.
        """
        if installation not in self.settings.model.installations:
            known = ", ".join(self.settings.model.installations)
            raise KeyError(f"the bench has no installation {installation!r}; choose from {known}")
        with self._lock:
            stand_rad = self._stand_rad(installation, series)
            self._pose_on(installation=installation, series=series, stand_rad=stand_rad)

    def level_platform(self, installation: str, series: int) -> None:
        """Level the platform for a mounting: axis tilt and zero offset take that mounting's drawn values."""
        with self._lock:
            stand_rad = self._poses[-1].stand_rad.copy()
            stand_rad[:2] = self._stand_rad(installation, series)[:2]
            self._pose_on(stand_rad=stand_rad)

    def place_level(self, *, turned: bool) -> None:
        """Place the level on the platform in its first position, or rotated by half a turn."""
        self._level_turned = turned

    def turn(self, scale_angle_rad: float, direction: Direction) -> None:
        """Turn the head until its scale shows `scale_angle_rad`; a new alpha4, the setting error, is drawn."""
        with self._lock:
            self._pose_on(
                turn=HeadTurn(self.clock.now_s(), scale_angle_rad, scale_angle_rad),
                setting_error_rad=self._draw(SETTING_ERROR, self.random(SETTING_ERROR, self.count("turn"))),
                direction=direction,
                demanded_rad=scale_angle_rad,
                stuck=False,
            )

    def move_head(self, target_rad: float, speed_rad_s: float) -> None:
        """Move the motorised head to the scale angle `target_rad`, as far as `head_fault` permits.

        alpha4 is drawn by step and target, so it does not depend on whether the head had to back off first.
        Repeating the last target has no effect unless the head is stuck.
        """
        with self._lock:
            now_s, start_rad = self.clock.now_s(), self.scale_angle_rad
            last = self._poses[-1]
            if target_rad == last.demanded_rad and not last.stuck:
                return
            end_rad, stuck = self.head_fault.end_rad(start_rad, target_rad)
            place = f"{target_rad:.9f}"
            generator = self.random(SETTING_ERROR, "move", place, self.count("move", place))
            self._pose_on(
                turn=HeadTurn(now_s, start_rad, end_rad, speed_rad_s),
                setting_error_rad=self._draw(SETTING_ERROR, generator),
                direction=last.direction if end_rad == start_rad else (1 if end_rad > start_rad else -1),
                demanded_rad=target_rad,
                stuck=stuck,
            )

    def stop_head(self) -> None:
        """Stop the motorised head at its present angle."""
        with self._lock:
            angle_rad = self.scale_angle_rad
            at_rest = HeadTurn(self.clock.now_s(), angle_rad, angle_rad)
            self._pose_on(turn=at_rest, demanded_rad=angle_rad, stuck=False)

    def _pose_on(self, **changes: Any) -> None:
        self._poses.append(replace(self._poses[-1], since_s=self.clock.now_s(), **changes))

    def select_input(self, source: str, reference_v: float | None = None) -> None:
        """Switch all three meters to the block's "signal", a "short", or a "reference" of `reference_v`, V.

        Raises `ValueError` for another source, or for a reference without a voltage.
        """
        inputs = {"signal": None, "short": 0.0, "reference": reference_v}
        if source not in inputs:
            raise ValueError(f"no input {source!r}; choose from {', '.join(inputs)}")
        input_v = inputs[source]
        if source == "reference" and input_v is None:
            raise ValueError("the reference needs a voltage; give reference_v")
        with self._lock:
            self._pose_on(input_v=input_v)

    def set_chamber(self, target_c: float) -> None:
        """Set the chamber air to a temperature at once, °C; the block follows with its lag."""
        with self._lock:
            self._chamber_demand_c = None
            self._heat.set_air(self.clock.now_s(), target_c)

    def ramp_chamber(self, target_c: float) -> None:
        """Ramp the chamber air to a temperature, °C, at the controller's rate and with its lag."""
        with self._lock:
            self._chamber_demand_c = target_c
            self._heat.ramp_air(
                self.clock.now_s(),
                target_c + self._chamber_offset_c,
                self.settings.chamber_rate_c_s,
                self.settings.chamber_lag_s,
                self.settings.chamber_ringing_s,
            )

    def switch_chamber_off(self) -> None:
        """Let the chamber air relax to `ambient_c`, the mean temperature of the room."""
        with self._lock:
            self._chamber_demand_c = None
            self._heat.relax_air(self.clock.now_s(), self.settings.ambient_c, self.settings.chamber_off_lag_s)

    def disturb_chamber(self, offset_c: float) -> None:
        """Set a control error, °C: under control, the air from now on settles at the demand plus `offset_c`."""
        with self._lock:
            self._chamber_offset_c = offset_c
            if self._chamber_demand_c is not None:
                self.ramp_chamber(self._chamber_demand_c)

    def new_reading(self, channel: Channel) -> int:
        """Begin a reading of a channel: draw its voltmeter error; return the reading's number in the step.

        If the head is at rest, the pose becomes part of the history on which effects depend. The scan order
        is the order in which readings of the channels begin, unless the step stated one.
        """
        with self._lock:
            if self._aside:  # keep the meter's error and the history of the last reading
                return self.count("reading", channel)
            now_s, pose = self.clock.now_s(), self._poses[-1]
            index, before = CHANNELS.index(channel), self._triggered.get(id(pose), ())
            in_turn = (index,) if index in before else (*before, index)
            self._triggered[id(pose)] = self.told_scan or in_turn
            if now_s >= pose.turn.arrives_s:
                visit, last = self._visit(pose, now_s), self._read[-1] if self._read else None
                if last is not None and last.pose is pose and last.series_on == visit.series_on:
                    self._read.pop()
                self._read.append(visit)
            number = self.count("reading", channel)
            generator = self.random(VOLTMETER_ERROR, channel, number)
            self._voltmeter_error_v[channel] = self._draw(VOLTMETER_ERROR, generator)
            return number

    def recall(
        self,
        installation: str | None,
        series: int,
        scale_angle_rad: float,
        direction: Direction | None,
        elapsed_s: float,
        *,
        block_c: float | None = None,
        input_v: float | None = None,
        scan: tuple[int, ...] = (0, 1, 2),
    ) -> None:
        """Add a reading, made before the world was rebuilt, to the history on which effects depend.

        The arguments are the recorded values; `installation` None means the pose of the previously recalled
        reading. Recall readings in the order of measurement, before the first new reading.
        """
        with self._lock:
            time_s = self.began_s + elapsed_s
            pose = self._read[-1].pose if self._read else self._poses[-1]
            if installation is not None:
                at_rest = HeadTurn(time_s, scale_angle_rad, scale_angle_rad)
                stand_rad = self._stand_rad(installation, series)
                pose = Pose(time_s, installation, series, stand_rad, at_rest, 0.0, direction, scale_angle_rad)
            known_c = self.block_c_at(time_s) if block_c is None else block_c
            visit = Visit(replace(pose, input_v=input_v), time_s, elapsed_s, known_c, scan)
            self._read.append(visit._replace(meters_c=self.meters_c(time_s)))

    # --- true state ---------------------------------------------------------------------------------

    @property
    def installation(self) -> str:
        """The label of the present installation."""
        return self._poses[-1].installation

    @property
    def series(self) -> int:
        """The series number of the present mounting in its installation, as given to `mount`."""
        return self._poses[-1].series

    @property
    def scale_angle_rad(self) -> float:
        """The angle that the head's scale shows, rad."""
        return self._poses[-1].turn.angle_rad(self.clock.now_s())

    @property
    def head_rate_rad_s(self) -> float:
        """The rate at which the motor turns the head, rad/s, negative for a falling angle; zero at rest."""
        return self._poses[-1].turn.rate_rad_s(self.clock.now_s())

    @property
    def head_stuck(self) -> bool:
        """Whether the head stands still, stuck on the way to its target."""
        return self._poses[-1].stuck and self.head_rate_rad_s == 0.0

    @property
    def true_angle_rad(self) -> float:
        """The true angle of the head: the scale angle plus alpha4, rad."""
        pose = self._poses[-1]
        return pose.turn.angle_rad(self.clock.now_s()) + pose.setting_error_rad

    @property
    def direction(self) -> Direction | None:
        """The direction of approach (+1 or -1); None before the first turn."""
        return self._poses[-1].direction

    @property
    def stand_rad(self) -> Floats:
        """The stand angles of the present mounting, in the order of `STAND_ANGLES`, rad, shape (5,)."""
        return self._poses[-1].stand_rad.copy()

    @property
    def chamber_c(self) -> float:
        """The temperature of the chamber air, °C."""
        with self._lock:
            return self._heat.air_c(self.clock.now_s())

    @property
    def block_c(self) -> float:
        """The temperature of the block, °C."""
        return self.block_c_at(self.clock.now_s())

    def block_c_at(self, time_s: float) -> float:
        """Return the temperature of the block at a time of the clock, °C."""
        with self._lock:
            in_air_c = self._heat.block_c(time_s)
        return in_air_c + self.settings.room_share * (self.room_c(time_s) - in_air_c)

    def room_c(self, time_s: float | None = None) -> float:
        """Return the temperature of the room now, or at a time of the clock, °C."""
        return self._swung_c(time_s, 0.0)

    def meters_c(self, time_s: float | None = None) -> float:
        """Return the temperature of the voltmeters now, or at a time of the clock, °C."""
        return self._swung_c(time_s, self.settings.meter_lag_s)

    def _swung_c(self, time_s: float | None, lag_s: float) -> float:
        """Return the temperature, °C, of a body that follows the room with a first-order lag; no transient."""
        elapsed_s = (self.clock.now_s() if time_s is None else time_s) - self.began_s
        size_c, period_s = self.settings.room_swing
        rate = math.tau / period_s
        behind = math.sin(rate * elapsed_s - math.atan(rate * lag_s)) / math.hypot(1.0, rate * lag_s)
        return self.settings.ambient_c + size_c * behind

    def level_shows_rad(self, axis: LevelAxis) -> float:
        """Return the present reading of the level on the platform, rad, with its zero error and new noise."""
        with self._lock:
            visit = self._visit(self._poses[-1], self.clock.now_s())
            inclined_rad = platform_tilt_rad(visit, self.settings.model)[axis]
            normal = self.random("level", axis, self.count("level", axis)).standard_normal
        return self.settings.level.shown_rad(
            axis, -inclined_rad if self._level_turned else inclined_rad, normal
        )

    def signal_v(self, channel: Channel, time_s: float | None = None) -> float:
        """Return the voltage at a meter's terminals at `time_s` of the clock (default: now), V.

        It is the forward model's reading at the true angle with all effects, or the voltage of `select_input`. The
        voltmeter error of the channel's present reading is added. A block without power gives almost zero. A meter
        that evaluates its samples later passes the time of each sample.
        """
        at_s = self.clock.now_s() if time_s is None else time_s
        with self._lock:
            pose = self._poses[max(0, bisect_right(self._poses, at_s, key=lambda p: p.since_s) - 1)]
            if pose.input_v is None and not self.power.feeds_block(self._past_s(at_s)):
                return dead_v(self.settings.power, self, channel, at_s) + self._voltmeter_error_v[channel]
            # Without effects the signal at rest depends only on the pose; effects may depend on the time.
            at_rest = at_s >= pose.turn.arrives_s and not self.settings.model.effects
            key = id(pose) if at_rest else (id(pose), at_s, self._scan(pose))
            signals = self._signals.get(key)
            if signals is None:
                if len(self._signals) >= _CACHED_SIGNALS:
                    self._signals.clear()
                signals = self._signals[key] = self._model_readings(pose, at_s)
            return float(signals[CHANNELS.index(channel)]) + self._voltmeter_error_v[channel]

    def _model_readings(self, pose: Pose, time_s: float) -> Floats:
        """Return the three signals of a pose, V, shape (3,); effects may depend on the visits read before."""
        model, before = self.settings.model, []
        if model.needs_history:
            before = [visit for visit in self._read if visit.pose is not pose and visit.time_s < time_s]
        visits = [*before, self._visit(pose, time_s)]
        signals: Floats = readings_of(visits, model, self.settings.block)[-1]
        return signals

    def _visit(self, pose: Pose, time_s: float) -> Visit:
        on_since_s = self.power.on_since_s(self._past_s(time_s))
        return Visit(
            pose,
            time_s,
            time_s - self.began_s,
            self.block_c_at(time_s),
            self._scan(pose),
            None if on_since_s is None else time_s - on_since_s,
            self.power.above_nominal_v(self._past_s(time_s)),
            switched_on_since(pose, self._read, self.power.switchings, time_s),
            self.meters_c(time_s),
        )

    def _past_s(self, time_s: float) -> float:
        """Return `time_s`, at most now, s: a meter's clock may be ahead of the simulated supply."""
        return min(time_s, self.clock.now_s())

    def _scan(self, pose: Pose) -> tuple[int, ...]:
        """Return the channel indices in scan order; channels not yet triggered come last."""
        begun = self._triggered.get(id(pose), self.told_scan)
        return (*begun, *(index for index in range(len(CHANNELS)) if index not in begun))

    def terminals(self, channel: Channel) -> Terminals:
        """Return the terminals of `channel` for a meter. Raises `ValueError` for an unknown channel."""
        if channel not in CHANNELS:
            raise ValueError(f"the block has no channel {channel!r}; choose from {', '.join(CHANNELS)}")
        return Terminals(self, channel)
