"""Base class of motorised heads: limits, direction of approach, supervision of a move, settling at the target."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from drivers.angles import format_dms
from drivers.interfaces import (
    BenchError,
    Direction,
    HeadPosition,
    InstrumentRefused,
    LimitExceeded,
    WentAstray,
    message,
)
from drivers.making_safe import SEE_IT_STANDS, Attempts, why_failed
from drivers.wire.visa import ProvedInstrument

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.interfaces import Identity
    from drivers.wire.visa import MessageSession


NOISE_RAD: Final = math.radians(0.05)
"""Largest backward change of the angle during a move, rad: noise, and backlash at the start."""
STALLED_S: Final = 5.0
"""Time without progress after which a head counts as stalled, s."""
_LEAST_OF_SPEED: Final = 0.05
"""A head slower than this fraction of its nominal speed makes no progress."""


@dataclass
class TravelWatch:
    """Supervision of one move of the head `name` from `start_rad`, begun at the clock time `begun_s`.

    A head is near its target within half the back-off. Once it was near, it may stop, and overshoot by the same
    distance; `Mover` then decides whether it has settled.
    """

    name: str
    travel: Travel
    start_rad: float
    target_rad: float
    begun_s: float

    def __post_init__(self) -> None:
        """Set the remaining distance to the whole move."""
        self._left_rad = abs(self.target_rad - self.start_rad)
        self._progress_rad, self._progress_s = self._left_rad, self.begun_s
        self._near_rad = 0.5 * self.travel.backoff_rad
        self._was_near = self._left_rad <= self._near_rad

    def take(self, angle_rad: float, now_s: float) -> None:
        """Check one reading of the angle, rad, at the clock time `now_s`.

        Raises `WentAstray` if the head is outside its limits or moves away from its target, `InstrumentRefused` if
        it stalled.
        """
        if not self.travel.contains(angle_rad, self.travel.tolerance_rad):
            raise self._astray(angle_rad, message(f"outside its limits, {self.travel.text}"))
        left_rad = abs(self.target_rad - angle_rad)
        self._was_near = self._was_near or left_rad <= self._near_rad
        noise_rad = max(NOISE_RAD, 4.0 * self.travel.tolerance_rad)
        farthest_rad = self._near_rad + noise_rad if self._was_near else self._left_rad + noise_rad
        if left_rad > farthest_rad:
            raise self._astray(angle_rad, message("away from its target"))
        self._left_rad = min(self._left_rad, left_rad)
        if self._progress_rad - self._left_rad >= _LEAST_OF_SPEED * self.travel.speed_rad_s * STALLED_S:
            self._progress_rad, self._progress_s = self._left_rad, now_s
        elif now_s - self._progress_s >= STALLED_S and not self._was_near:
            raise self._stalled(angle_rad, now_s - self._progress_s)

    def _astray(self, angle_rad: float, where: str) -> BenchError:
        return WentAstray(
            self.name,
            f"it moved {where}: sent from {format_dms(self.start_rad)} to {format_dms(self.target_rad)} "
            f"it was at {format_dms(angle_rad)} and was stopped",
            "check the sign and the scale of the axis in the controller and the bench file before it moves "
            "again, watching the cables",
        )

    def _stalled(self, angle_rad: float, stood_s: float) -> BenchError:
        return InstrumentRefused(
            self.name,
            f"it stalled at {format_dms(angle_rad)}, sent to {format_dms(self.target_rad)}: no progress in "
            f"{stood_s:.0f} s",
            "check the load and that nothing blocks the head, then repeat this step",
        )


_ROUNDING_RAD: Final = 1e-9
"""Tolerance for floating-point rounding, rad, so that an angle exactly at a limit is accepted."""
_PATIENCE: Final = 2.0
"""A move may take this multiple of its nominal time, plus `_PATIENCE_S` and the settling time."""
_PATIENCE_S: Final = 10.0


class Axis(Protocol):
    """The interface of a controller for one axis; all angles are on the head's scale, rad."""

    @abstractmethod
    def prepare(self) -> None:
        """Make the axis ready to move: powered, homed, in its positioning mode."""

    @abstractmethod
    def position_rad(self) -> float:
        """Return the angle read back."""

    @abstractmethod
    def start(self, target_rad: float) -> None:
        """Begin to move to an angle."""

    @abstractmethod
    def moving(self) -> bool:
        """Return whether the axis is moving. Raises `InstrumentRefused` for a fault that keeps it from arriving."""

    @abstractmethod
    def stop(self) -> None:
        """Stop the axis at once. Raises `BenchError` if the stop is not confirmed."""


@dataclass(frozen=True, slots=True)
class Travel:
    """The limits of a head's moves and the criterion of arrival.

    The head stays within [`minimum_rad`, `maximum_rad`]. Its final approach covers at least `backoff_rad` in
    the requested direction. Its angle is read every `poll_s`, s. The head has arrived if it is at rest within
    `tolerance_rad` of the target for `settle_s`, s. A move may take twice as long as at constant
    `speed_rad_s`, plus `settle_s` and 10 s. Raises `ValueError` for inconsistent values.
    """

    minimum_rad: float
    maximum_rad: float
    tolerance_rad: float
    speed_rad_s: float
    backoff_rad: float = math.radians(1.0)
    settle_s: float = 2.0
    poll_s: float = 0.25

    def __post_init__(self) -> None:
        """Raise `ValueError` for limits in the wrong order, values not positive, or too small a back-off."""
        if not self.minimum_rad < self.maximum_rad:
            raise ValueError(
                f"the lowest angle {format_dms(self.minimum_rad)} of the head must be below the highest "
                f"{format_dms(self.maximum_rad)}"
            )
        for name in ("tolerance_rad", "speed_rad_s", "poll_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} of the head must be positive, not {getattr(self, name):g}")
        if not self.backoff_rad > self.tolerance_rad:
            raise ValueError("state a back-off above the tolerance")

    def contains(self, angle_rad: float, margin_rad: float = _ROUNDING_RAD) -> bool:
        """Return whether an angle lies within the limits, or at most `margin_rad` outside."""
        return self.minimum_rad - margin_rad <= angle_rad <= self.maximum_rad + margin_rad

    @property
    def text(self) -> str:
        """The limits as text, such as `-10°00′00″ to 370°00′00″`."""
        return f"{format_dms(self.minimum_rad)} to {format_dms(self.maximum_rad)}"

    def time_limit_s(self, way_rad: float) -> float:
        """Return the longest time allowed for a move by `way_rad`, s."""
        return _PATIENCE * abs(way_rad) / self.speed_rad_s + self.settle_s + _PATIENCE_S


class Mover:
    """Moves one axis within the limits of a `Travel`."""

    def __init__(self, name: str, axis: Axis, travel: Travel, clock: Clock) -> None:
        self._name = name
        self._axis = axis
        self._travel = travel
        self._clock = clock

    def check(self, target_rad: float, direction: Direction) -> None:
        """Raise `LimitExceeded` if the target or the start of its approach is outside the limits.

        The final approach starts at least `backoff_rad` before the target, so its start must be within the limits,
        too. Nothing is sent.
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
            raise LimitExceeded(
                self._name,
                f"to come to {format_dms(target_rad)} from {'below' if direction > 0 else 'above'} "
                f"it must start at {format_dms(from_rad)}, outside its limits, {self._travel.text}",
                "change the direction of approach in the procedure or the limits in the bench file",
            )

    def move(self, target_rad: float, direction: Direction) -> HeadPosition:
        """Move the head to `target_rad` in the requested direction; return the angle read back.

        Any exception, including Ctrl-C, stops the motion. Raises `LimitExceeded`, `WentAstray`,
        `InstrumentRefused` if the head does not arrive, and the errors of the axis.
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
                    f"{self._name}: {message('its stop is not confirmed')}; {SEE_IT_STANDS}. "
                    f"{message(f'Cause: {why_failed(failed)}')}"
                )
            raise

    def wait_while(self, busy: Callable[[], bool], limit_s: float) -> None:
        """Wait until `busy` returns False. Raises `InstrumentRefused` after `limit_s`, s."""
        deadline_s = self._clock.now_s() + limit_s
        while busy():
            if self._clock.now_s() > deadline_s:
                raise InstrumentRefused(
                    self._name,
                    f"it still moves after {limit_s:.0f} s",
                    "check the head and its speed in the bench file, then repeat this step",
                )
            self._clock.sleep(self._travel.poll_s)

    def _backed_off(self, target_rad: float, direction: Direction) -> float:
        return target_rad - direction * self._travel.backoff_rad

    def _refuse_outside(self, angle_rad: float) -> None:
        if not self._travel.contains(angle_rad, self._travel.tolerance_rad):
            raise LimitExceeded(
                self._name,
                f"it stands at {format_dms(angle_rad)}, outside its limits, {self._travel.text}",
                "bring it back within them by hand, watching the cables",
            )

    def _go(self, start_rad: float, target_rad: float, settle_s: float) -> float:
        """Move, wait until the angle has stayed within tolerance for `settle_s`, and return the last angle read.

        Raises `WentAstray`, and `InstrumentRefused` if the head stalls or does not arrive in time.
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
            cause = message(
                f"it still moved after {limit_s:.0f} s, at {format_dms(angle_rad)}, sent to {target}"
            )
        else:
            above = angle_rad > target_rad
            cause = message(
                f"it did not come to rest within {format_dms(self._travel.tolerance_rad, 1)} of {target} in "
                f"{limit_s:.0f} s, it is {format_dms(abs(angle_rad - target_rad), 1)} "
                f"{'above' if above else 'below'} it"
            )
        return InstrumentRefused(
            self._name,
            cause,
            "check that nothing blocks the head, its load, its scale and its speed, then repeat this step",
        )


class MotorisedHead(ProvedInstrument, Axis):
    """The base class of heads with a controller: a `DividingHead` whose subclass implements the `Axis`.

    A subclass also verifies its controller (`_prove`). The controller needs a pause of `write_gap_s`, s,
    after a command without reply.
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
        super().__init__(name, session, clock, identity, write_gap_s=write_gap_s)
        self._travel = travel
        self._mover = Mover(name, self, travel, clock)

    def close(self) -> str:
        """Stop the head and disconnect; return what a person must still do. Never raises, may be called twice."""
        attempts = Attempts()
        if self._session.opened:
            attempts.make(SEE_IT_STANDS, self.stop)
            self._release(attempts)
        self._session.close()
        return attempts.end()

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Turn to `target_rad` in the requested direction; return the angle read back.

        Raises `LimitExceeded`, before anything is sent, for a target or approach outside the limits; also if
        the head stands outside them. Raises `WentAstray` if the head leaves its limits or moves away from its
        target; `InstrumentRefused` if it stalls, does not arrive, or the controller reports an error;
        `InstrumentLost`, `BadReading`. An error during the motion stops the motion.
        """
        return self._mover.move(target_rad, direction)

    def _release(self, attempts: Attempts) -> None:
        """Make the stopped head safe before the connection closes, one attempt per command."""
