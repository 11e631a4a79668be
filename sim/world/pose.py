"""How head, platform and block stand in the course of a run."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from bench.base.arrays import Floats
from bench.model.conditions import Conditions
from bench.model.effects.base import Stage
from bench.model.forward import ForwardModel
from bench.model.geometry import INSTALLATION_1, Block

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from drivers.interfaces import Direction, LevelAxis


@dataclass(frozen=True)
class Pose:
    """How the block stands from `since_s` on. Compared by identity: each pose is an event of its own.

    `demanded_rad` is where the head was sent, which a fault may keep it from; `stuck` that one has. `input_v`
    is the voltage at all three inputs in place of the block's signals, None for the signals.
    """

    since_s: float
    installation: str
    series: int
    stand_rad: Floats
    turn: HeadTurn
    setting_error_rad: float
    direction: Direction | None
    demanded_rad: float
    stuck: bool = False
    input_v: float | None = None


class Visit(NamedTuple):
    """A pose at a time of the clock, `elapsed_s` after the world began, with the block's temperature, °C.

    `scan` holds the channels 0, 1, 2 in the order in which the meters were triggered; `on_s` is how long the block
    has had power, None where that is not told, `supply_v` the voltage of each rail less its nominal one, V. A block
    that was off since it was mounted and read is on another visit: `series_on` more than that of its mounting.
    """

    pose: Pose
    time_s: float
    elapsed_s: float
    block_c: float
    scan: tuple[int, ...] = (0, 1, 2)
    on_s: float | None = None
    supply_v: tuple[float, ...] = ()
    series_on: int = 0


def switched_on_since(
    pose: Pose, visits: Sequence[Visit], switchings: Sequence[tuple[float, bool]], time_s: float
) -> int:
    """Return how often the block got power again, until a time, after it was read as it is mounted in a pose.

    `visits` are those that were read, `switchings` when it got power (True) and lost it.
    """
    read_s = [visit.time_s for visit in visits if visit.pose.stand_rad is pose.stand_rad]
    on_s = [at_s for at_s, on in switchings if on and read_s and read_s[0] < at_s <= time_s]
    # switched twice before it is read again is one visit
    return len({bisect_right(on_s, at_s) for at_s in (*read_s, time_s)} - {0}) if on_s else 0


def readings_of(visits: Sequence[Visit], model: ForwardModel, block: Block) -> Floats:
    """Return the signals of visits in the order of time, V, shape (n, 3): effects look back along them.

    What is at the inputs in place of the block's signals shows the effects of the meters alone.
    """
    poses = [visit.pose for visit in visits]
    on_s = np.array([np.nan if visit.on_s is None else visit.on_s for visit in visits])
    conditions = Conditions.of(
        [pose.installation for pose in poses],
        [visit.pose.turn.angle_rad(visit.time_s) for visit in visits],
        series=[visit.pose.series + visit.series_on for visit in visits],
        direction=[pose.direction or 0 for pose in poses],
        time_s=[visit.elapsed_s for visit in visits],
        temperature_c=[visit.block_c for visit in visits],
        scan_order=[visit.scan for visit in visits],
        on_s=on_s if any(visit.on_s is not None for visit in visits) else None,
        supply_v=_supply_v(visits),
    )
    first = [int(np.argmax(conditions.mount == mount)) for mount in range(len(conditions.mounts))]
    stand_rad = np.stack([poses[row].stand_rad for row in first])
    setting_rad = np.array([pose.setting_error_rad for pose in poses])
    voltage_v = np.array([[np.nan if pose.input_v is None else pose.input_v] * 3 for pose in poses])
    return model.readings_in_order(block, conditions, stand_rad, setting_rad, voltage_v=voltage_v)


def _supply_v(visits: Sequence[Visit]) -> Floats | None:
    """Return the voltages of the rails less their nominal ones, shape (n, rails), NaN where a visit has none."""
    rails = max((len(visit.supply_v) for visit in visits), default=0)
    if not rails:
        return None
    unknown = (float("nan"),) * rails
    return np.array([visit.supply_v or unknown for visit in visits])


_ENDLESS_RAD: Final = 1000.0 * math.tau


@dataclass(frozen=True)
class HeadTurn:
    """A turn on the scale from `start_rad` to `end_rad`, begun at `since_s`, at `speed_rad_s`.

    With an infinite speed the head is there at once.
    """

    since_s: float
    start_rad: float
    end_rad: float
    speed_rad_s: float = math.inf

    @property
    def arrives_s(self) -> float:
        """The time from which on the head stands at its end."""
        return self.since_s + abs(self.end_rad - self.start_rad) / self.speed_rad_s

    def angle_rad(self, time_s: float) -> float:
        """Return the angle on the scale at a time, rad."""
        if time_s >= self.arrives_s:
            return self.end_rad
        turned_rad = max(0.0, time_s - self.since_s) * self.speed_rad_s
        return self.start_rad + math.copysign(turned_rad, self.end_rad - self.start_rad)

    def rate_rad_s(self, time_s: float) -> float:
        """Return the rate at a time, rad/s: signed while it turns, else zero."""
        if not self.since_s <= time_s < self.arrives_s:
            return 0.0
        return math.copysign(self.speed_rad_s, self.end_rad - self.start_rad)


@dataclass(frozen=True)
class HeadFault:
    """What is wrong with a motorised head, for the movements that begin while it is set.

    It sticks after it has turned by `sticks_after_rad` (0: it does not move at all), or it comes to rest
    `stops_off_rad` beside where it was sent, on its own scale. One that `runs_away`, as with a wrong sign, turns
    away from where it was sent until it is stopped.
    """

    sticks_after_rad: float | None = None
    stops_off_rad: float = 0.0
    runs_away: bool = False

    def end_rad(self, start_rad: float, target_rad: float) -> tuple[float, bool]:
        """Return where a movement really ends, and whether the head is stuck there."""
        if self.runs_away:
            return start_rad + math.copysign(_ENDLESS_RAD, start_rad - target_rad), True
        end_rad = target_rad + self.stops_off_rad
        if self.sticks_after_rad is None or abs(end_rad - start_rad) <= self.sticks_after_rad:
            return end_rad, False
        return start_rad + math.copysign(self.sticks_after_rad, end_rad - start_rad), True


_OF_THE_PLATFORM: Final = (Stage.STAND, Stage.HEAD_ANGLE)
_OF_THE_BLOCK: Final = (
    "bracket_tilt", "mounting_error", "mounting_offset", "mounting_roll", "block_slip", "mounting_creep",
)  # fmt: skip
"""Effects of how the block sits on the platform: no level on the platform shows them."""
_BLOCK: Final = Block(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class LevelSettings:
    """What is true of a level: how far its zero is off, its noise (1 σ), rad, and the error of its scale."""

    zero_along_rad: float = 0.0
    zero_across_rad: float = 0.0
    noise_rad: float = 0.0
    scale: float = 0.0

    def shown_rad(self, axis: LevelAxis, inclined_rad: float, normal: Callable[[], float]) -> float:
        """Return what it shows where its axis is inclined so much; `normal` gives a standard normal number."""
        zero_rad = self.zero_along_rad if axis == "along" else self.zero_across_rad
        return inclined_rad * (1.0 + self.scale) + zero_rad + self.noise_rad * normal()


def platform_tilt_rad(visit: Visit, model: ForwardModel) -> dict[LevelAxis, float]:
    """Return the inclination of the platform along the shaft and across it, rad, the head where it stands.

    The effects of stand and head are in it, those of how the block sits are not.
    """
    pose = visit.pose
    effects = tuple(
        applied
        for applied in model.effects
        if applied.effect.stage in _OF_THE_PLATFORM and applied.effect.name not in _OF_THE_BLOCK
    )
    bare = ForwardModel({pose.installation: replace(INSTALLATION_1, label=pose.installation)}, effects)
    conditions = Conditions.of(
        [pose.installation],
        [pose.turn.angle_rad(visit.time_s)],
        series=[pose.series],
        direction=[pose.direction or 0],
        time_s=[visit.elapsed_s],
        temperature_c=[visit.block_c],
    )
    stand_rad = pose.stand_rad.copy()[None]
    stand_rad[:, 2:] = 0.0  # the angles at which the block is mounted
    x, y, _ = bare.specific_force(conditions, stand_rad, _BLOCK, pose.setting_error_rad)[0]
    return {"along": math.asin(y), "across": math.asin(x)}
