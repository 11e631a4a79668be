"""The physical truth of a simulated bench: head, block, temperature. It holds no instrument state.

Random numbers never come from one running generator: each is derived from the seed, what it is for, and
the step of the procedure that needs it. A world that is set up again in a new process therefore draws the
very same numbers for the same step, whatever happened before.
"""

from __future__ import annotations

import hashlib
import threading
from bisect import bisect_right
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from bench.model import STAND_ANGLES, Conditions, Distribution, stand_errors
from drivers.interfaces import CHANNELS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bench.model import Block, ForwardModel
    from drivers.clock import Clock
    from drivers.interfaces import Channel, Direction

Floats = NDArray[np.float64]

SETTING_ERROR: Final = "setting_error"
VOLTMETER_ERROR: Final = "voltmeter_error"
STAND_NAMES: Final = (*STAND_ANGLES, SETTING_ERROR, VOLTMETER_ERROR)

_NO_ERROR: Final = Distribution(0.0)
_CACHED_SIGNALS: Final = 4096


def keyed_generator(seed: int, *key: object) -> np.random.Generator:
    """Return the generator that belongs to `seed` and `key`; equal arguments give equal numbers."""
    text = "\x1f".join(str(part) for part in (seed, *key))
    return np.random.default_rng(np.frombuffer(hashlib.sha256(text.encode()).digest(), dtype=np.uint32))


@dataclass(frozen=True)
class WorldSettings:
    """What the world is like.

    `stand` gives the distribution of each stand error by its name in `STAND_NAMES`: the stand angles
    (rad, drawn at each mounting), "setting_error" alpha4 (rad, drawn at each turn of the head) and
    "voltmeter_error" (V, drawn for each reading of each channel); a name left out is zero.
    `ambient_c` is the room, and the reference from which effects count temperature;
    `block_time_constant_s` is the lag of the block behind the chamber.
    """

    block: Block
    model: ForwardModel
    stand: Mapping[str, Distribution]
    seed: int
    ambient_c: float = 23.0
    block_time_constant_s: float = 750.0

    def __post_init__(self) -> None:
        """Raise `ValueError` for a stand error that the world does not know."""
        unknown = sorted(set(self.stand) - set(STAND_NAMES))
        if unknown:
            raise ValueError(f"not a stand error: {', '.join(unknown)}; known are {', '.join(STAND_NAMES)}")


@dataclass(frozen=True)
class _Pose:
    """How the block stands from `since_s` on. Compared by identity: each pose is an event of its own."""

    since_s: float
    installation: str
    series: int
    stand_rad: Floats
    scale_angle_rad: float
    setting_error_rad: float
    direction: Direction | None


@dataclass(frozen=True)
class _Heat:
    """The chamber's demand from `since_s` on, and the temperature the block had then."""

    since_s: float
    chamber_c: float
    block_c: float


class World:
    """The bench as it really is: what the head's scale cannot show and the meters only look at.

    `began_s` is the clock's time at which the world began (0 for a virtual clock; a world on the system's
    clock passes its present time). All methods may be called from any thread.
    """

    def __init__(self, settings: WorldSettings, clock: Clock, began_s: float = 0.0) -> None:
        self.settings = settings
        self.clock = clock
        self.began_s = began_s
        self._lock = threading.RLock()
        self._step: str | None = None
        self._counts: Counter[tuple[str, ...]] = Counter()
        self._voltmeter_error_v: dict[Channel, float] = dict.fromkeys(CHANNELS, 0.0)
        self._signals: dict[object, Floats] = {}
        now_s = clock.now_s()
        self._heats = [_Heat(now_s, settings.ambient_c, settings.ambient_c)]
        installation = next(iter(settings.model.installations))
        self._poses = [_Pose(now_s, installation, 1, self._stand_rad(installation, 1), 0.0, 0.0, None)]

    # --- random numbers -----------------------------------------------------------------------------

    def begin_step(self, key: str) -> None:
        """From now on key random numbers by this step of the procedure (its attempt included)."""
        with self._lock:
            self._step = key
            self._counts.clear()

    def random(self, purpose: str, *key: object) -> np.random.Generator:
        """Return the generator for a purpose within the current step; the same each time it is asked."""
        return keyed_generator(self.settings.seed, purpose, "step", self._step or "", *key)

    def fixed_random(self, purpose: str, *key: object) -> np.random.Generator:
        """Return the generator for something drawn once for the whole world, such as a meter's gain."""
        return keyed_generator(self.settings.seed, purpose, "world", *key)

    def _draw(self, name: str, generator: np.random.Generator) -> float:
        return self.settings.stand.get(name, _NO_ERROR).draw(generator)

    def _stand_rad(self, installation: str, series: int) -> Floats:
        return stand_errors(
            **{name: self._draw(name, self.fixed_random(name, series, installation)) for name in STAND_ANGLES}
        )

    # --- what is done to the bench ------------------------------------------------------------------

    def mount(self, installation: str, series: int = 1) -> None:
        """Mount the block; the stand angles depend on the seed, the series and the installation alone.

        Raises `KeyError` for an installation that the model does not have.
        """
        if installation not in self.settings.model.installations:
            known = ", ".join(self.settings.model.installations)
            raise KeyError(f"the bench has no installation {installation!r}; it has {known}")
        with self._lock:
            last = self._poses[-1]
            self._poses.append(
                _Pose(
                    self.clock.now_s(),
                    installation,
                    series,
                    self._stand_rad(installation, series),
                    last.scale_angle_rad,
                    last.setting_error_rad,
                    last.direction,
                )
            )

    def turn(self, scale_angle_rad: float, direction: Direction) -> None:
        """Turn the head until its scale shows `scale_angle_rad`; the true angle differs by a fresh alpha4."""
        with self._lock:
            self._counts["turn",] += 1
            setting_error_rad = self._draw(SETTING_ERROR, self.random(SETTING_ERROR, self._counts["turn",]))
            last = self._poses[-1]
            self._poses.append(
                _Pose(
                    self.clock.now_s(),
                    last.installation,
                    last.series,
                    last.stand_rad,
                    scale_angle_rad,
                    setting_error_rad,
                    direction,
                )
            )

    def set_chamber(self, target_c: float) -> None:
        """Set the air of the chamber to a temperature, at once, °C; the block follows with its lag."""
        with self._lock:
            self._heats.append(_Heat(self.clock.now_s(), target_c, self.block_c))

    def new_reading(self, channel: Channel) -> int:
        """Begin a reading of a channel: draw its voltmeter error; return its number within the step."""
        with self._lock:
            self._counts["reading", channel] += 1
            number = self._counts["reading", channel]
            generator = self.random(VOLTMETER_ERROR, channel, number)
            self._voltmeter_error_v[channel] = self._draw(VOLTMETER_ERROR, generator)
            return number

    # --- what is true -------------------------------------------------------------------------------

    @property
    def installation(self) -> str:
        """The installation that is mounted."""
        return self._poses[-1].installation

    @property
    def series(self) -> int:
        """The series of the mounting."""
        return self._poses[-1].series

    @property
    def scale_angle_rad(self) -> float:
        """The angle that the head's scale shows, rad."""
        return self._poses[-1].scale_angle_rad

    @property
    def true_angle_rad(self) -> float:
        """The angle at which the head really stands: the scale's and alpha4, rad."""
        return self._poses[-1].scale_angle_rad + self._poses[-1].setting_error_rad

    @property
    def direction(self) -> Direction | None:
        """The side from which the head came, None before the first turn."""
        return self._poses[-1].direction

    @property
    def stand_rad(self) -> Floats:
        """The stand angles of the present mounting, in the order of `STAND_ANGLES`, rad, shape (5,)."""
        return self._poses[-1].stand_rad.copy()

    @property
    def chamber_c(self) -> float:
        """The air in the chamber, °C."""
        return self._heats[-1].chamber_c

    @property
    def block_c(self) -> float:
        """The block, °C."""
        return self.block_c_at(self.clock.now_s())

    def block_c_at(self, time_s: float) -> float:
        """Return the temperature of the block at a time of the clock, °C: first-order lag, in closed form."""
        with self._lock:
            heat = self._heats[max(0, bisect_right(self._heats, time_s, key=lambda h: h.since_s) - 1)]
        if heat.block_c == heat.chamber_c:
            return heat.chamber_c
        elapsed_s = max(0.0, time_s - heat.since_s)
        left = np.exp(-elapsed_s / self.settings.block_time_constant_s)
        return float(heat.chamber_c + (heat.block_c - heat.chamber_c) * left)

    def signal_v(self, channel: Channel, time_s: float | None = None) -> float:
        """Return the voltage at a meter's terminals now, or as it was at `time_s` of the clock, V.

        It is the forward model's reading with all effects at the true angle, plus the voltmeter error of
        the channel's present reading. A meter that hands over its samples late asks for their own times.
        """
        at_s = self.clock.now_s() if time_s is None else time_s
        with self._lock:
            pose = self._poses[max(0, bisect_right(self._poses, at_s, key=lambda p: p.since_s) - 1)]
            # Without effects the output depends on the pose alone; an effect may look at time and heat.
            key = (id(pose), at_s) if self.settings.model.effects else id(pose)
            signals = self._signals.get(key)
            if signals is None:
                if len(self._signals) >= _CACHED_SIGNALS:
                    self._signals.clear()
                signals = self._signals[key] = self._model_readings(pose, at_s)
            return float(signals[CHANNELS.index(channel)]) + self._voltmeter_error_v[channel]

    def _model_readings(self, pose: _Pose, time_s: float) -> Floats:
        """Return the three signals of a pose, V, shape (3,)."""
        conditions = Conditions.of(
            [pose.installation],
            [pose.scale_angle_rad],
            series=[pose.series],
            direction=[pose.direction or 0],
            time_s=[time_s - self.began_s],
            temperature_c=[self.block_c_at(time_s) - self.settings.ambient_c],
        )
        signals: Floats = self.settings.model.readings(
            self.settings.block, conditions, pose.stand_rad[np.newaxis, :], pose.setting_error_rad
        )[0]
        return signals

    def terminals(self, channel: Channel) -> Terminals:
        """Return what a meter that is wired to `channel` sees."""
        if channel not in CHANNELS:
            raise ValueError(f"the block has the channels {', '.join(CHANNELS)}, not {channel!r}")
        return Terminals(self, channel)


class Terminals:
    """One channel of the world, as the meter on it sees it (the `Source` of a simulated meter)."""

    def __init__(self, world: World, channel: Channel) -> None:
        self._world = world
        self._channel = channel
        self._reading = 0

    @property
    def temperature_c(self) -> float:
        """The temperature of the room in which the meter stands, °C."""
        return self._world.settings.ambient_c

    def signal_v(self, time_s: float | None = None) -> float:
        """Return the voltage at the terminals now, or at `time_s` of the clock, V."""
        return self._world.signal_v(self._channel, time_s)

    def new_reading(self) -> None:
        """Say that a reading was triggered."""
        self._reading = self._world.new_reading(self._channel)

    def random(self, purpose: str) -> np.random.Generator:
        """Return the generator for a purpose within the present reading."""
        return self._world.random(purpose, self._channel, self._reading)

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the generator for something that the meter on this channel has for good."""
        return self._world.fixed_random(purpose, self._channel)
