"""Conditions under which readings were taken: everything on which the forward model may depend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from bench.base.arrays import Floats, Ints, Mask
from bench.model.geometry import within_half_turn

REFERENCE_C: Final = 20.0
"""The temperature from which effects count, unless `Conditions` states another, °C."""

SETTING_S: Final = 120.0
"""From one setting to the next where no time is given, s."""

REMOUNT_S: Final = 1200.0
"""What a remount takes beside that, s."""


class Mounting(NamedTuple):
    """One mounting of the block: the angles of the stand stay what they are as long as it lasts."""

    series: int
    installation: str

    def __str__(self) -> str:
        return self.installation if self.series == 1 else f"{self.installation}/{self.series}"


class HeadTurns:
    """How far the head was turned up to each reading, rad, by the shortest way from angle to angle.

    A reading without an angle keeps what the one before it had, and is no remount. Every run begins anew.
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
        """The first reading of the mounting that each reading is of, as its row."""
        start = _last_of(np.concatenate([np.ones(min(n, 1), dtype=bool), run[1:] != run[:-1]]))
        wound, visit = np.cumsum(steps), np.cumsum(begins)
        self.wound: Floats = wound - wound[start]
        self._to_and_fro: Floats = np.cumsum(np.abs(steps))
        self.visit: Floats = (visit - visit[start] + begins[start]).astype(np.float64)

    @property
    def turned(self) -> Floats:
        """Since the block was mounted, with sign."""
        return np.asarray(self.wound - self.wound[self.first])

    @property
    def travelled(self) -> Floats:
        """Since the block was mounted, to and fro."""
        return np.asarray(self._to_and_fro - self._to_and_fro[self.first])


def _last_of(begins: Mask) -> Ints:
    """Return for each row the last one up to it at which something begins, the first row where nothing has."""
    return (
        np.maximum.accumulate(np.where(begins, np.arange(len(begins)), 0))
        if len(begins)
        else begins.astype(np.int64)
    )


@dataclass(frozen=True)
class Conditions:
    """Arrays over n readings, in the order of measurement: effects look back along the rows.

    `mount` (n,) indexes `mounts`, which stand in order of first appearance; `angle_rad` is the head angle as
    read from its scale; `direction` is +1, -1 or 0 (not known); `time_s` (since the start of the run) and
    `temperature_c` are NaN where not known; `scan_order` (n, 3) has the channels 0, 1, 2 in the order in
    which they were read. Effects count temperature from `reference_c`. `turns` (mounts, 3, 3) are the
    installations' `block_from_platform`, filled in by the forward model for effects that follow the path of
    the head, NaN for an installation that it does not know. Where several runs stand in one table, `began_s`
    (n,) is when each row's run began on the clock of `time_s`: warming up begins anew in each. Of the supply,
    `on_s` (n,) is for how long the unit has been switched on, NaN where that is not known, and `supply_v`
    (n, rails) the voltage of each rail less its nominal one, NaN likewise; None where nothing is known of it.
    `level_rad` (n, 4) is what a level showed in the mounting of the row: alpha1, alpha2 and their standard
    uncertainties, NaN for nothing.
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
    reference_c: float = REFERENCE_C
    turns: Floats | None = None
    began_s: Floats | None = None
    on_s: Floats | None = None
    level_rad: Floats | None = None
    supply_v: Floats | None = None

    def __len__(self) -> int:
        return len(self.angle_rad)

    @property
    def remounted(self) -> Mask:
        """Where the block has another mounting than in the row before, shape (n,); true in the first row."""
        return np.concatenate([np.ones(min(len(self), 1), dtype=bool), self.mount[1:] != self.mount[:-1]])

    @cached_property
    def memory(self) -> dict[Any, Any]:
        """What was worked out of these conditions alone, for who needs it again and again."""
        return {}

    @cached_property
    def head_turns(self) -> HeadTurns:
        """How far the head was turned up to each reading."""
        return HeadTurns(self)

    @cached_property
    def elapsed_s(self) -> Floats:
        """The time since the start of the run, s, shape (n,), also where it is not known.

        A run without times is taken to go at `SETTING_S` a setting and `REMOUNT_S` more for a remount; rows
        without a time between or beside others are placed by the same pace.
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
        """The time since the first reading in the mounting of the row, s, shape (n,)."""
        return np.asarray(self.elapsed_s - self.elapsed_s[self.head_turns.first])

    @cached_property
    def switched_on_s(self) -> Floats:
        """The time since the unit was switched on, where not known since the start of the run, s, shape (n,)."""
        if self.on_s is None:
            return self.elapsed_s
        return np.where(np.isfinite(self.on_s), self.on_s, self.elapsed_s)

    @cached_property
    def warmth_k(self) -> Floats:
        """Temperature less `reference_c`, K, shape (n,): zero where none is known.

        Where some rows have a temperature, the others take it from their neighbours in time.
        """
        return self._between_known(self.temperature_c - self.reference_c)

    @cached_property
    def above_nominal_v(self) -> Floats:
        """The voltage of each rail less its nominal one, V, shape (n, rails): zero where none is known.

        Where some rows have one, the others take it from their neighbours in time.
        """
        if self.supply_v is None:
            return np.zeros((len(self), 0))
        return np.stack([self._between_known(rail) for rail in self.supply_v.T], axis=1)

    def _between_known(self, values: Floats) -> Floats:
        """Return a column (n,) with what is NaN in it taken from its neighbours in time; zero if all is."""
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
        """Return what a level showed: by mounting and column of the stand angles the angle and its u, rad."""
        if self.level_rad is None:
            return {}
        found: dict[tuple[int, int], tuple[float, float]] = {}
        for mount in range(len(self.mounts)):
            rows = self.level_rad[(self.mount == mount) & np.isfinite(self.level_rad).all(axis=1)]
            for column in (0, 1) if len(rows) else ():
                found[mount, column] = float(rows[0, column]), float(rows[0, 2 + column])
        return found

    def select(self, rows: Mask) -> Conditions:
        """Return the rows where the mask (n,) is true, with the mountings that they are of."""
        used, mount = np.unique(self.mount[rows], return_inverse=True)
        kept: dict[str, Any] = {name: column[rows] for name, column in self._columns().items()}
        mounts = tuple(self.mounts[i] for i in used)
        return replace(self, mounts=mounts, mount=mount.ravel().astype(np.int64), **kept)

    def repeated(self, times: int) -> Conditions:
        """Return the rows so many times over, each time in mountings of their own."""
        mount = (np.arange(times)[:, None] * len(self.mounts) + self.mount).ravel()
        tiled: dict[str, Any] = {
            name: np.concatenate([column] * times) for name, column in self._columns().items()
        }
        return replace(self, mounts=self.mounts * times, mount=mount, **tiled)

    def _columns(self) -> dict[str, Any]:
        """The arrays that have a value for each row, but for the mounting."""
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
        reference_c: float = REFERENCE_C,
        began_s: Floats | None = None,
        on_s: Floats | None = None,
        level_rad: Floats | None = None,
        supply_v: Floats | None = None,
    ) -> Conditions:
        """Build from columns of equal length; those left out are series 1, pass 1, point 1…n, not known.

        The scan order that is left out is x, y, z.
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
            reference_c=reference_c,
            began_s=began_s,
            on_s=on_s,
            level_rad=level_rad,
            supply_v=supply_v,
        )


PAST_RAD: Final = np.radians(5.0)
"""How far the head turns past a setting to come to it from the other side."""

SAME_RAD: Final = 1e-3
"""Settings closer than this are the same: the head was not turned."""


class HeadPath(NamedTuple):
    """How the head came to each of m settings, rad, shape (m,): from `start` to `turn` to `end`.

    `rows` are their places among the conditions, `sits` (m, 3, 3) how the block sits (`block_from_platform`);
    `direction` is +1 or -1, 0 where not known; `begins` where the block was mounted just before.
    """

    rows: Ints
    sits: Floats
    start: Floats
    turn: Floats
    end: Floats
    direction: Floats
    begins: Mask


def head_path(conditions: Conditions) -> HeadPath:
    """Return the path to the settings among the conditions: rows with an angle, in a known installation.

    After a mounting the head comes from just before the setting. A direction that is not known is that of
    the turn; without a turn it is the one before. Raises `ValueError` when the conditions do not say how the
    block sits: the forward model says it to an effect that `needs_path`.
    """
    if conditions.turns is None:
        raise ValueError("the path of the head needs conditions with the installations' turns")
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
