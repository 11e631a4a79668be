"""How the block stood in the course of a run, and what the forward model makes of it."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.base.arrays import Floats
from bench.model import Conditions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.model import Block, ForwardModel
    from drivers.interfaces import Direction
    from sim.world.turning import HeadTurn


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
