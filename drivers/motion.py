"""The base of motorised heads: limits, approach, supervision of a movement, arrival in a window."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from drivers.angles import format_dms
from drivers.interfaces import (
    BenchError,
    Direction,
    HeadPosition,
    Identity,
    InstrumentRefused,
    LimitExceeded,
    WentAstray,
)
from drivers.making_safe import SEE_IT_STANDS, Attempts, why_failed
from drivers.wire.visa import ProvedSession

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession


NOISE_RAD: Final = math.radians(0.05)
"""The scale may fall back by this much during a movement: by noise, and by play at the start."""
STALLED_S: Final = 5.0
"""A head that takes its load along has gone on by then."""
_LEAST_OF_SPEED: Final = 0.05
"""A head slower than this fraction of its speed counts as stalled."""


@dataclass
class TravelWatch:
    """One movement from `start_rad` to `target_rad` of the head `name`, begun at `begun_s` of the clock.

    Near its target, by half of what it backs off, a head may swing through it; there it may also stand: whether
    it comes to rest within the tolerance is decided elsewhere.
    """

    name: str
    travel: Travel
    start_rad: float
    target_rad: float
    begun_s: float

    def __post_init__(self) -> None:
        """Begin with the whole way before it."""
        self._left_rad = abs(self.target_rad - self.start_rad)
        self._progress_rad, self._progress_s = self._left_rad, self.begun_s
        self._near_rad = 0.5 * self.travel.backoff_rad
        self._was_near = self._left_rad <= self._near_rad

    def take(self, angle_rad: float, now_s: float) -> None:
        """Look at a sample of the scale. Raises `WentAstray`, and `InstrumentRefused` for a head that stalled."""
        if not self.travel.contains(angle_rad, self.travel.tolerance_rad):
            raise self._astray(angle_rad, f"outside its limits, {self.travel.text}")
        left_rad = abs(self.target_rad - angle_rad)
        self._was_near = self._was_near or left_rad <= self._near_rad
        noise_rad = max(NOISE_RAD, 4.0 * self.travel.tolerance_rad)
        farthest_rad = self._near_rad + noise_rad if self._was_near else self._left_rad + noise_rad
        if left_rad > farthest_rad:
            raise self._astray(angle_rad, "away from its target")
        self._left_rad = min(self._left_rad, left_rad)
        if self._progress_rad - self._left_rad >= _LEAST_OF_SPEED * self.travel.speed_rad_s * STALLED_S:
            self._progress_rad, self._progress_s = self._left_rad, now_s
        elif now_s - self._progress_s >= STALLED_S and not self._was_near:
            raise self._stalled(angle_rad, now_s - self._progress_s)

    def _astray(self, angle_rad: float, where: str) -> BenchError:
        return WentAstray(
            self.name,
            f"it moved {where}: sent from {format_dms(self.start_rad)} to {format_dms(self.target_rad)} it was at "
            f"{format_dms(angle_rad)} and was stopped",
            "check the sign and the scale of the axis in the controller and the bench file before it moves again, "
            "minding the cables",
        )

    def _stalled(self, angle_rad: float, stood_s: float) -> BenchError:
        return InstrumentRefused(
            self.name,
            f"it stalled at {format_dms(angle_rad)}, sent to {format_dms(self.target_rad)}: no progress in "
            f"{stood_s:.0f} s",
            "check that nothing blocks the head, and its load, then take this step again",
        )


_ROUNDING_RAD: Final = 1e-9
"""Keeps an angle exactly at a limit from being refused for the last bit of a float."""
_PATIENCE: Final = 2.0
_PATIENCE_S: Final = 10.0


class Axis(Protocol):
    """The interface of a controller for one axis; all angles are of the head's scale, rad."""

    def prepare(self) -> None:
        """Make the axis ready to move: powered, homed, in its positioning mode."""

    def position_rad(self) -> float:
        """Return the angle read back."""

    def start(self, target_rad: float) -> None:
        """Begin to move to an angle."""

    def moving(self) -> bool:
        """Whether the axis moves. Raises `InstrumentRefused` for what keeps it from arriving."""

    def stop(self) -> None:
        """Stop the motion where it is. Raises `BenchError` where that is not confirmed."""


@dataclass(frozen=True, slots=True)
class Travel:
    """The limits of a head's movements and the criterion of arrival.

    It stays within [`minimum_rad`, `maximum_rad`], also on the way. It arrives from at least `backoff_rad`
    away on the demanded side. It is in position when for `settle_s` every sample, one each `poll_s`, lies
    within `tolerance_rad`. `speed_rad_s` is its speed: a movement may take twice the time that it needs
    for the way, and 10 s. Raises `ValueError` for what cannot be.
    """

    minimum_rad: float
    maximum_rad: float
    tolerance_rad: float
    speed_rad_s: float
    backoff_rad: float = math.radians(1.0)
    settle_s: float = 2.0
    poll_s: float = 0.25

    def __post_init__(self) -> None:
        """Refuse limits in the wrong order and sizes that are not positive."""
        if not self.minimum_rad < self.maximum_rad:
            raise ValueError(
                f"the lowest angle {format_dms(self.minimum_rad)} of the head is not below the highest "
                f"{format_dms(self.maximum_rad)}"
            )
        for name in ("tolerance_rad", "speed_rad_s", "poll_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} of the head must be positive, not {getattr(self, name):g}")
        if not self.backoff_rad > self.tolerance_rad:
            raise ValueError("the head must back off by more than its tolerance")

    def contains(self, angle_rad: float, margin_rad: float = _ROUNDING_RAD) -> bool:
        """Whether an angle lies within the limits, or no more than `margin_rad` outside."""
        return self.minimum_rad - margin_rad <= angle_rad <= self.maximum_rad + margin_rad

    @property
    def text(self) -> str:
        """The limits as text for a person."""
        return f"{format_dms(self.minimum_rad)} to {format_dms(self.maximum_rad)}"

    def time_limit_s(self, way_rad: float) -> float:
        """Return how long a movement may take, s."""
        return _PATIENCE * abs(way_rad) / self.speed_rad_s + self.settle_s + _PATIENCE_S


class Mover:
    """Moves one axis as a `Travel` allows."""

    def __init__(self, name: str, axis: Axis, travel: Travel, clock: Clock) -> None:
        self._name = name
        self._axis = axis
        self._travel = travel
        self._clock = clock

    def check(self, target_rad: float, direction: Direction) -> None:
        """Raise `LimitExceeded` for a target, or the way to it, outside the limits; nothing is sent.

        The head always comes from at least `backoff_rad` away, so that place must be within them, too.
        """
        if not math.isfinite(target_rad) or not self._travel.contains(target_rad):
            shown = format_dms(target_rad) if math.isfinite(target_rad) else f"{target_rad}"
            raise LimitExceeded(
                self._name,
                f"{shown} is outside its limits, {self._travel.text}",
                "change the angle in the procedure or the limits in the bench file",
            )
        from_rad = self._backed_off(target_rad, direction)
        if not self._travel.contains(from_rad):
            side = "below" if direction > 0 else "above"
            raise LimitExceeded(
                self._name,
                f"to come to {format_dms(target_rad)} from {side} it must start at {format_dms(from_rad)}, "
                f"outside its limits, {self._travel.text}",
                "change the direction of approach in the procedure or the limits in the bench file",
            )

    def move(self, target_rad: float, direction: Direction) -> HeadPosition:
        """Bring the head to `target_rad` from the demanded side; return the angle read back.

        Whatever goes wrong, Ctrl-C included, the motion is stopped. Raises `LimitExceeded`,
        `WentAstray`, `InstrumentRefused` when it does not arrive, and what the axis raises.
        """
        self.check(target_rad, direction)
        try:
            self._axis.prepare()
            start_rad = self._axis.position_rad()
            self._refuse_outside(start_rad)
            from_rad = self._backed_off(target_rad, direction)
            if direction * (from_rad - start_rad) < -self._travel.tolerance_rad:
                start_rad = self._go(start_rad, from_rad, settle_s=0.0)
            return HeadPosition(self._go(start_rad, target_rad, self._travel.settle_s), direction)
        except BaseException as error:
            try:
                self._axis.stop()
            except Exception as failed:
                error.add_note(
                    f"{self._name}: its stop is not confirmed: {SEE_IT_STANDS} ({why_failed(failed)})"
                )
            raise

    def wait_while(self, busy: Callable[[], bool], limit_s: float) -> None:
        """Wait until the axis is no longer busy. Raises `InstrumentRefused` after `limit_s`."""
        deadline_s = self._clock.now_s() + limit_s
        while busy():
            if self._clock.now_s() > deadline_s:
                raise InstrumentRefused(
                    self._name,
                    f"it still moves after {limit_s:.0f} s",
                    "check the head and its speed in the bench file, then take this step again",
                )
            self._clock.sleep(self._travel.poll_s)

    def _backed_off(self, target_rad: float, direction: Direction) -> float:
        return target_rad - direction * self._travel.backoff_rad

    def _refuse_outside(self, angle_rad: float) -> None:
        if not self._travel.contains(angle_rad, self._travel.tolerance_rad):
            raise LimitExceeded(
                self._name,
                f"it stands at {format_dms(angle_rad)}, outside its limits, {self._travel.text}",
                "bring it back within them by hand, minding the cables",
            )

    def _go(self, start_rad: float, target_rad: float, settle_s: float) -> float:
        """Move, wait for the window, return the last angle read.

        Raises `WentAstray` at the first sample that shows it, `InstrumentRefused` when it stalls or is too late.
        """
        limit_s = self._travel.time_limit_s(target_rad - start_rad)
        begun_s = self._clock.now_s()
        watch = TravelWatch(self._name, self._travel, start_rad, target_rad, begun_s)
        self._axis.start(target_rad)
        inside_since_s: float | None = None
        while True:
            moving = self._axis.moving()
            angle_rad = self._axis.position_rad()
            now_s = self._clock.now_s()
            watch.take(angle_rad, now_s)
            if moving or abs(angle_rad - target_rad) > self._travel.tolerance_rad:
                inside_since_s = None
            else:
                inside_since_s = now_s if inside_since_s is None else inside_since_s
                if now_s - inside_since_s >= settle_s:
                    return angle_rad
            if now_s - begun_s > limit_s:
                raise self._not_arrived(target_rad, angle_rad, moving, limit_s)
            self._clock.sleep(self._travel.poll_s)

    def _not_arrived(
        self, target_rad: float, angle_rad: float, moving: bool, limit_s: float
    ) -> InstrumentRefused:
        target = format_dms(target_rad)
        if moving:
            cause = f"it still moved after {limit_s:.0f} s, at {format_dms(angle_rad)}, sent to {target}"
        else:
            side = "above" if angle_rad > target_rad else "below"
            cause = (
                f"it did not come to rest within {format_dms(self._travel.tolerance_rad, 1)} of {target} in "
                f"{limit_s:.0f} s, it is {format_dms(abs(angle_rad - target_rad), 1)} {side} it"
            )
        return InstrumentRefused(
            self._name,
            cause,
            "check that nothing blocks the head, its load, its scale and its speed, then take this step again",
        )


class MotorisedHead(ABC):
    """The base of the heads with a controller, a `DividingHead` whose `Axis` the make gives.

    A make says how its controller is proved and what the verbs of an axis are; `write_gap_s` is how long it
    wants to be left alone after a command without reply. How its lines end is the session's.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        travel: Travel,
        *,
        identity: Identity,
        write_gap_s: float = 0.0,
    ) -> None:
        self.name = name
        self._session = ProvedSession(session, clock, self._prove, write_gap_s=write_gap_s)
        self._clock = clock
        self._travel = travel
        self._mover = Mover(name, self, travel, clock)
        self._identity = identity

    def open(self) -> Identity:
        """Connect and prove the controller; nothing moves.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        self._session.open()
        return self._identity

    def close(self) -> str:
        """Stop and let the head go; return what a person must still do. Never raises, may be called twice."""
        attempts = Attempts()
        if self._session.opened:
            attempts.make(SEE_IT_STANDS, self.stop)
            self._release(attempts)
        self._session.close()
        return attempts.end()

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Turn to `target_rad` from the demanded side; return the angle read back.

        Raises `LimitExceeded` before anything is sent, `WentAstray` for a head that leaves its limits or its way,
        `InstrumentRefused` for what the controller reports or refuses or a head that stalls or does not arrive,
        `InstrumentLost`, `BadReading`. The motion is stopped then.
        """
        return self._mover.move(target_rad, direction)

    # --- what a make says ---------------------------------------------------------------------------

    @abstractmethod
    def _prove(self) -> None:
        """Identify the controller, prove its settings and set `_identity`. Raises `InstrumentRefused`."""

    def _release(self, attempts: Attempts) -> None:  # noqa: B027 - most need nothing more
        """Leave the head safe, which was told to stop just now; each command is an attempt of its own."""

    @abstractmethod
    def prepare(self) -> None:
        """Make the axis ready to move: powered, homed, in its positioning mode."""

    @abstractmethod
    def position_rad(self) -> float:
        """Return the angle read back, rad."""

    @abstractmethod
    def start(self, target_rad: float) -> None:
        """Begin to move to an angle."""

    @abstractmethod
    def moving(self) -> bool:
        """Whether the axis moves. Raises `InstrumentRefused` for what keeps it from arriving."""

    @abstractmethod
    def stop(self) -> None:
        """Stop the motion where it is. Raises `BenchError` where that is not confirmed."""
