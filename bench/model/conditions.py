"""The conditions of a run's readings: all that the forward model may depend on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from bench.base.arrays import Floats, Ints, Mask
from bench.model.geometry import within_half_turn

REFERENCE_C: Final = 20.0
"""Default reference temperature for the effects of temperature, °C."""

METER_REFERENCE_C: Final = 23.0
"""The temperature, °C, to which voltmeter specifications refer (34401A User's Guide, chapter 8)."""

SETTING_S: Final = 120.0
"""Assumed time from one setting to the next in a run without recorded times, s."""

REMOUNT_S: Final = 1200.0
"""Assumed additional time for a remount, s."""


class Mounting(NamedTuple):
    """One mounting of the block, during which the stand angles stay constant.

    As text it is the label of the installation, such as "2". From the second series on, the text includes the
    series: "2/3" is installation 2 in series 3.
    """

    series: int
    installation: str

    def __str__(self) -> str:
        return self.installation if self.series == 1 else f"{self.installation}/{self.series}"


class HeadTurns:
    """The rotation of the head, rad, shape (n,), summed over all turns up to each reading.

    The head is assumed to turn by the shortest way from each angle to the next. A reading without an angle has the
    values of the reading before it and does not count as a remount. The accumulation restarts with every run.
    """

    def __init__(self, conditions: Conditions) -> None:
        n = len(conditions)
        steps, begins = np.zeros(n), np.zeros(n, dtype=bool)
        run = np.zeros(n) if conditions.began_s is None else conditions.began_s
        rows = np.flatnonzero(np.isfinite(conditions.angle_rad))
        angle, mount, of_run = conditions.angle_rad[rows], conditions.mount[rows], run[rows]
        other_run = of_run[1:] != of_run[:-1]
        steps[rows[1:]] = np.where(other_run, 0.0, within_half_turn(np.diff(angle)))
        begins[rows[:1]] = True
        begins[rows[1:]] = (mount[1:] != mount[:-1]) | other_run
        self.first: Ints = _last_of(begins)
        """The row of the first reading in the same mounting, for each reading."""
        start = _last_of(np.concatenate([np.ones(min(n, 1), dtype=bool), run[1:] != run[:-1]]))
        wound, visit = np.cumsum(steps), np.cumsum(begins)
        self.wound: Floats = wound - wound[start]
        self._to_and_fro: Floats = np.cumsum(np.abs(steps))
        self.visit: Floats = (visit - visit[start] + begins[start]).astype(np.float64)

    @property
    def turned(self) -> Floats:
        """The signed rotation since the block was mounted, rad, shape (n,)."""
        return np.asarray(self.wound - self.wound[self.first])

    @property
    def travelled(self) -> Floats:
        """The total rotation in both directions since the block was mounted, rad, shape (n,)."""
        return np.asarray(self._to_and_fro - self._to_and_fro[self.first])


def _last_of(begins: Mask) -> Ints:
    """Return for each row i the last row j ≤ i for which `begins[j]` is true; 0 if there is none."""
    return (
        np.maximum.accumulate(np.where(begins, np.arange(len(begins)), 0))
        if len(begins)
        else begins.astype(np.int64)
    )


@dataclass(frozen=True)
class Conditions:
    """The conditions of n readings as columns, in the order of measurement: an effect may depend on earlier rows.

    `mount` (n,) indexes `mounts`, which are in order of first appearance. `angle_rad` is the scale reading of the
    head. `direction` is the direction of approach: +1, -1, or 0 if unknown. `time_s` (since the start of the run)
    and `temperature_c` are NaN where unknown. `scan_order` (n, 3) lists the channels 0, 1, 2 in the order in which
    they were read. Effects use the temperature minus `reference_c`. `turns` (mounts, 3, 3) holds the
    `block_from_platform` of each mounting, NaN for an unknown installation; the forward model fills it in for
    effects with `needs_path`. If the rows come from several runs, `began_s` (n,) is the start of each row's run on
    the clock of `time_s`, and warm-up restarts in each run. `on_s` (n,) is the time since the unit was switched on,
    `supply_v` (n, rails) the voltage of each supply rail minus its nominal voltage, `meter_c` (n,) the temperature
    of the voltmeters; they are NaN where unknown and None if never recorded. `level_rad` (n, 4) holds the level
    readings of the row's mounting: alpha1, alpha2 and their standard uncertainties, NaN if none were taken.
    `mounting` (n,) is the number of the mounting, which may last for several series; 0 means unknown. None means
    that each series is a mounting, or that no mounting is known.
    """

    mounts: tuple[Mounting, ...]
    mount: Ints
    pass_number: Ints
    point: Ints
    angle_rad: Floats
    direction: Ints
    time_s: Floats
    temperature_c: Floats
    scan_order: Ints
    reference_c: ClassVar[float] = REFERENCE_C
    turns: Floats | None = None
    began_s: Floats | None = None
    on_s: Floats | None = None
    level_rad: Floats | None = None
    supply_v: Floats | None = None
    meter_c: Floats | None = None
    mounting: Ints | None = None

    def __len__(self) -> int:
        return len(self.angle_rad)

    @property
    def remounted(self) -> Mask:
        """The mask (n,) of the first row, and of each row in another mounting than the row before."""
        return np.concatenate([np.ones(min(len(self), 1), dtype=bool), self.mount[1:] != self.mount[:-1]])

    @cached_property
    def clamped(self) -> Ints:
        """For each of `mounts`, the index of the first one since which the block has stayed mounted.

        Without a known `mounting`, each series is a mounting of its own.
        """
        first: dict[object, int] = {}
        found = []
        for index, mount in enumerate(self.mounts):
            row = int(np.argmax(self.mount == index))
            number = 0 if self.mounting is None else int(self.mounting[row])
            began_s = 0.0 if self.began_s is None else float(self.began_s[row])
            key = (mount.installation, began_s, number) if number else index
            found.append(first.setdefault(key, index))
        return np.array(found, dtype=np.int64)

    @cached_property
    def memory(self) -> dict[Any, Any]:
        """A cache for values derived from these conditions."""
        return {}

    @cached_property
    def head_turns(self) -> HeadTurns:
        """The rotation of the head accumulated up to each reading."""
        return HeadTurns(self)

    @cached_property
    def elapsed_s(self) -> Floats:
        """The time since the start of the run, s, shape (n,), estimated where it was not recorded.

        The estimate assumes `SETTING_S` for each setting, and an additional `REMOUNT_S` for each remount. In a run
        with times, rows without a time are interpolated at this pace. With `began_s`, unknown times stay NaN.
        """
        known = np.isfinite(self.time_s)
        if self.began_s is not None:
            return np.asarray(self.time_s - self.began_s)
        if known.all():
            return self.time_s
        steps = SETTING_S + REMOUNT_S * self.remounted
        steps[:1] = 0.0
        pace: Floats = np.cumsum(steps)
        if not known.any():
            return pace
        late = np.interp(pace, pace[known], self.time_s[known] - pace[known])
        return np.where(known, self.time_s, pace + late)

    @cached_property
    def since_mounting_s(self) -> Floats:
        """The time, s, shape (n,), since the first reading in the row's mounting."""
        return np.asarray(self.elapsed_s - self.elapsed_s[self.head_turns.first])

    @cached_property
    def switched_on_s(self) -> Floats:
        """The time, s, shape (n,), since the unit was switched on or, if unknown, since the start of the run."""
        if self.on_s is None:
            return self.elapsed_s
        return np.where(np.isfinite(self.on_s), self.on_s, self.elapsed_s)

    @cached_property
    def warmth_k(self) -> Floats:
        """The temperature minus `reference_c`, K, shape (n,); zero if no row has a temperature.

        Rows without a temperature are interpolated in time.
        """
        return self._between_known(self.temperature_c - self.reference_c)

    @cached_property
    def meter_warmth_k(self) -> Floats:
        """Temperature of the voltmeters minus `METER_REFERENCE_C`, K, shape (n,); zero if never recorded."""
        if self.meter_c is None:
            return np.zeros(len(self))
        return self._between_known(self.meter_c - METER_REFERENCE_C)

    @cached_property
    def above_nominal_v(self) -> Floats:
        """The voltage of each rail minus its nominal voltage, V, shape (n, rails); (n, 0) without rails.

        Rows without a voltage are interpolated in time; a rail without any voltage has zeros.
        """
        if self.supply_v is None:
            return np.zeros((len(self), 0))
        return np.stack([self._between_known(rail) for rail in self.supply_v.T], axis=1)

    def _between_known(self, values: Floats) -> Floats:
        """Return a column (n,) with its NaN values interpolated in time; all zeros if every value is NaN."""
        known = np.isfinite(values)
        if known.all():
            return values
        if not known.any():
            return np.zeros(len(self))
        clock_s = self.elapsed_s if self.began_s is None else self.time_s
        order = np.argsort(clock_s[known], kind="stable")
        between = np.interp(clock_s, clock_s[known][order], values[known][order])
        return np.where(known, values, between)

    def levels(self) -> dict[tuple[int, int], tuple[float, float]]:
        """Return each stand angle measured with the level, and its standard uncertainty, rad.

        The keys are (index of the mounting, column of `STAND_ANGLES`). Without level readings there are none.
        """
        if self.level_rad is None:
            return {}
        found: dict[tuple[int, int], tuple[float, float]] = {}
        for mount in range(len(self.mounts)):
            rows = self.level_rad[(self.mount == mount) & np.isfinite(self.level_rad).all(axis=1)]
            for column in (0, 1) if len(rows) else ():
                found[mount, column] = float(rows[0, column]), float(rows[0, 2 + column])
        return found

    def select(self, rows: Mask) -> Conditions:
        """Return the conditions of the rows where the mask (n,) is true; mountings without rows are dropped."""
        used, mount = np.unique(self.mount[rows], return_inverse=True)
        kept: dict[str, Any] = {name: column[rows] for name, column in self._columns().items()}
        mounts = tuple(self.mounts[i] for i in used)
        return replace(self, mounts=mounts, mount=mount.ravel().astype(np.int64), **kept)

    def repeated(self, times: int) -> Conditions:
        """Return the conditions with all rows repeated `times` times; each repetition has separate mountings."""
        mount = (np.arange(times)[:, None] * len(self.mounts) + self.mount).ravel()
        tiled: dict[str, Any] = {
            name: np.concatenate([column] * times) for name, column in self._columns().items()
        }
        return replace(self, mounts=self.mounts * times, mount=mount, **tiled)

    def _columns(self) -> dict[str, Any]:
        """The arrays with one entry per row, except `mount`."""
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in {"mount", "turns"}}
        return {name: column for name, column in columns.items() if isinstance(column, np.ndarray)}

    @classmethod
    def of(
        cls,
        installation: Sequence[str],
        angle_rad: Sequence[float] | Floats,
        *,
        series: Sequence[int] | None = None,
        pass_number: Sequence[int] | None = None,
        point: Sequence[int] | None = None,
        direction: Sequence[int] | None = None,
        time_s: Sequence[float] | Floats | None = None,
        temperature_c: Sequence[float] | Floats | None = None,
        scan_order: Sequence[Sequence[int]] | Ints | None = None,
        began_s: Floats | None = None,
        on_s: Floats | None = None,
        level_rad: Floats | None = None,
        supply_v: Floats | None = None,
        meter_c: Floats | None = None,
        mounting: Ints | None = None,
    ) -> Conditions:
        """Return the conditions made of columns of equal length.

        Shapes are those of the class. By default series and pass are 1, points 1…n, the scan order is x, y, z, and
        all else is unknown.
        """
        n = len(installation)
        keys = [Mounting(s, label) for s, label in zip(series or [1] * n, installation, strict=True)]
        mounts = tuple(dict.fromkeys(keys))
        order = [(0, 1, 2)] * n if scan_order is None else scan_order
        unknown = [float("nan")] * n
        return cls(
            mounts=mounts,
            mount=np.array([mounts.index(key) for key in keys], dtype=np.int64),
            pass_number=np.asarray(pass_number or [1] * n, dtype=np.int64),
            point=np.asarray(point or range(1, n + 1), dtype=np.int64),
            angle_rad=np.asarray(angle_rad, dtype=np.float64),
            direction=np.asarray(direction or [0] * n, dtype=np.int64),
            time_s=np.asarray(unknown if time_s is None else time_s, dtype=np.float64),
            temperature_c=np.asarray(unknown if temperature_c is None else temperature_c, dtype=np.float64),
            scan_order=np.asarray(order, dtype=np.int64).reshape(n, 3),
            began_s=began_s,
            on_s=on_s,
            level_rad=level_rad,
            supply_v=supply_v,
            meter_c=meter_c,
            mounting=mounting,
        )


PAST_RAD: Final = np.radians(5.0)
"""Overshoot, rad, before a setting is approached from the other side; also the rotation to a first setting."""

SAME_RAD: Final = 1e-3
"""Settings that differ by less than this, rad, count as equal: the head was not turned."""


class HeadPath(NamedTuple):
    """The path of the head to each of m settings, as angles in rad, shape (m,).

    The head turns from `start` to `turn`, and from there to the setting at `end`. If it reaches the setting without
    reversing, `turn` equals `start`. `rows` (m,) are the settings' row indices in the conditions; `sits` (m, 3, 3)
    are the matrices `block_from_platform`. `direction` is the direction of approach: +1, -1, or 0 if unknown.
    `begins` marks the first setting after a mounting.
    """

    rows: Ints
    sits: Floats
    start: Floats
    turn: Floats
    end: Floats
    direction: Floats
    begins: Mask


def head_path(conditions: Conditions) -> HeadPath:
    """Return the path of the head to each row that has an angle and a known installation.

    After a mounting the path starts `PAST_RAD` before the setting. An unknown direction of approach is inferred
    from the rotation since the previous setting; without rotation the previous direction holds. Raises
    `ValueError` if `conditions.turns` is None; the forward model fills it in for effects with `needs_path`.
    """
    if conditions.turns is None:
        raise ValueError("conditions.turns is None; take conditions from the forward model")
    known = np.isfinite(conditions.turns[:, 0, 0])[conditions.mount] & np.isfinite(conditions.angle_rad)
    rows: Ints = np.flatnonzero(known)
    mount, end, direction = conditions.mount[rows], conditions.angle_rad[rows], conditions.direction[rows]
    begins = np.concatenate([np.ones(min(len(rows), 1), dtype=bool), mount[1:] != mount[:-1]])
    change = within_half_turn(np.diff(end, prepend=end[:1]))
    change[begins] = 0.0
    moved = np.where(np.abs(change) > SAME_RAD, np.sign(change), 0.0)
    arrived = np.where(direction != 0, direction, moved)
    last = np.maximum.accumulate(np.where((arrived != 0) | begins, np.arange(len(arrived)), 0))
    arrived = arrived[last]
    before = np.where(begins, 0.0, np.roll(arrived, 1))
    straight = np.where(moved != 0, moved == arrived, arrived == before)
    start = np.where(begins, end - arrived * PAST_RAD, end - change)
    turn = np.where(straight | begins, start, end - arrived * PAST_RAD)
    return HeadPath(rows, conditions.turns[mount], start, turn, end, arrived, begins)
