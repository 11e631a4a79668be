"""The positions of head, platform and block in the course of a run."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from bench.base.arrays import Floats
from bench.model.conditions import METER_REFERENCE_C, Conditions
from bench.model.effects.base import Stage
from bench.model.forward import ForwardModel, Stages
from bench.model.geometry import INSTALLATION_1, Block

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from drivers.interfaces import Direction, LevelAxis


@dataclass(frozen=True)
class Pose:
    """The position of the block from `since_s` on; compared by identity, since each pose is a separate event.

    `demanded_rad` is the target of the head; `stuck` is true if a fault makes the head stick or run away. All
    three meters measure `input_v`, V, or the block's signals if that is None.
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
    """A pose at one time, `elapsed_s` after the world began, with the conditions at that time.

    `block_c` and `meters_c` are the temperatures of block and voltmeters, °C. `scan` lists the channels 0, 1,
    2 in the order in which the meters were triggered. `on_s` is the time since the block got power, None
    without power, without rails or for a recalled reading. `supply_v` is the voltage of each rail minus its
    nominal voltage, V. `series_on` is the result of `switched_on_since`; it is added to the mounting's
    series, so that effects treat a power cycle like a remount.
    """

    pose: Pose
    time_s: float
    elapsed_s: float
    block_c: float
    scan: tuple[int, ...] = (0, 1, 2)
    on_s: float | None = None
    supply_v: tuple[float, ...] = ()
    series_on: int = 0
    meters_c: float = METER_REFERENCE_C


def switched_on_since(
    pose: Pose, visits: Sequence[Visit], switchings: Sequence[tuple[float, bool]], time_s: float
) -> int:
    """Return the number of power cycles of the block from the first reading of a mounting to `time_s`.

    Power cycles without a reading between them count once. `pose` is any pose of the mounting; without a
    reading in it the number is 0. `visits` are the readings made so far, `switchings` the times at which the
    block gained (True) or lost power.
    """
    read_s = [visit.time_s for visit in visits if visit.pose.stand_rad is pose.stand_rad]
    on_s = [at_s for at_s, on in switchings if on and read_s and read_s[0] < at_s <= time_s]
    # power cycles without a reading between them count once
    return len({bisect_right(on_s, at_s) for at_s in (*read_s, time_s)} - {0}) if on_s else 0


def readings_of(visits: Sequence[Visit], model: ForwardModel, block: Block) -> Floats:
    """Return the signals of visits in time order, V, shape (n, 3); effects depend on the earlier visits.

    For a visit with `input_v`, the meters measure that voltage, and only their own effects apply.
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
        meter_c=np.array([visit.meters_c for visit in visits]),
    )
    first = [int(np.argmax(conditions.mount == mount)) for mount in range(len(conditions.mounts))]
    stand_rad = np.stack([poses[row].stand_rad for row in first])
    setting_rad = np.array([pose.setting_error_rad for pose in poses])
    voltage_v = np.array([[np.nan if pose.input_v is None else pose.input_v] * 3 for pose in poses])
    return Stages(model, block, conditions, stand_rad, setting_rad, voltage_v=voltage_v).readings


def _supply_v(visits: Sequence[Visit]) -> Floats | None:
    """Return each rail's voltage minus its nominal voltage, V, (n, rails); None if no visit has one.

    The rows of visits without voltages are NaN.
    """
    rails = max((len(visit.supply_v) for visit in visits), default=0)
    if not rails:
        return None
    unknown = (float("nan"),) * rails
    return np.array([visit.supply_v or unknown for visit in visits])


_ENDLESS_RAD: Final = 1000.0 * math.tau


@dataclass(frozen=True)
class HeadTurn:
    """A rotation on the scale from `start_rad` to `end_rad`, begun at `since_s`, at `speed_rad_s`.

    An infinite speed makes the rotation instantaneous.
    """

    since_s: float
    start_rad: float
    end_rad: float
    speed_rad_s: float = math.inf

    @property
    def arrives_s(self) -> float:
        """The clock time at which the rotation ends, s."""
        return self.since_s + abs(self.end_rad - self.start_rad) / self.speed_rad_s

    def angle_rad(self, time_s: float) -> float:
        """Return the angle on the scale at a time, rad."""
        if time_s >= self.arrives_s:
            return self.end_rad
        turned_rad = max(0.0, time_s - self.since_s) * self.speed_rad_s
        return self.start_rad + math.copysign(turned_rad, self.end_rad - self.start_rad)

    def rate_rad_s(self, time_s: float) -> float:
        """Return the rate at a time, rad/s, negative for a falling angle; zero at rest."""
        if not self.since_s <= time_s < self.arrives_s:
            return 0.0
        return math.copysign(self.speed_rad_s, self.end_rad - self.start_rad)


@dataclass(frozen=True)
class HeadFault:
    """A fault of a motorised head, for movements that begin while it is set.

    With `sticks_after_rad`, the head sticks after a rotation by this angle, at once if it is 0. A head that
    does not stick stops at a scale angle `stops_off_rad` above the target. A head that `runs_away`, as with a
    wrong sign, turns away from the target until it is stopped.
    """

    sticks_after_rad: float | None = None
    stops_off_rad: float = 0.0
    runs_away: bool = False

    def end_rad(self, start_rad: float, target_rad: float) -> tuple[float, bool]:
        """Return the angle at which a movement with this fault ends, rad.

        The second value says whether the fault makes the head stick or run away.
        """
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
"""Effects on the position of the block on the platform, which a level on the platform does not show."""
_BLOCK: Final = Block(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class LevelSettings:
    """The errors of a level, rad: two zero errors and the noise's standard deviation; `scale`, relative."""

    zero_along_rad: float = 0.0
    zero_across_rad: float = 0.0
    noise_rad: float = 0.0
    scale: float = 0.0

    def shown_rad(self, axis: LevelAxis, inclined_rad: float, normal: Callable[[], float]) -> float:
        """Return the reading for an axis inclined by `inclined_rad`; `normal` returns a standard normal number."""
        zero_rad = self.zero_along_rad if axis == "along" else self.zero_across_rad
        return inclined_rad * (1.0 + self.scale) + zero_rad + self.noise_rad * normal()


def platform_tilt_rad(visit: Visit, model: ForwardModel) -> dict[LevelAxis, float]:
    """Return the inclination of the platform along the shaft and across it at the present head angle, rad.

    It includes the effects of stand and head, but not those of the block's mounting.
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
    stand_rad[:, 2:] = 0.0  # without the mounting angles of the block
    x, y, _ = bare.specific_force(conditions, stand_rad, _BLOCK, pose.setting_error_rad)[0]
    return {"along": math.asin(y), "across": math.asin(x)}
