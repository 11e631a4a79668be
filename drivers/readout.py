"""Heads that a person turns and an encoder reads: the approach is watched, the angle is read and never typed."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from drivers.angles import (
    ROUNDING_RAD,
    classic_slip,
    format_dms,
    parse_angle,
    scale_text,
    wrapped_rad,
)
from drivers.interfaces import (
    BadReading,
    Direction,
    HeadPosition,
    Identity,
    InstrumentRefused,
    LimitExceeded,
)
from drivers.person import APPROACH, AnsweredByInstrument, Prompt, PromptKind, ask_until, watching
from drivers.wire.visa import ProvedSession

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.person import Action, Person
    from drivers.wire.visa import MessageSession

LOOK_S: Final = 0.2
"""Time between two looks at the encoder while a person turns the head, s."""
PATIENCE_S: Final = 10.0
"""So long beyond its settling time may a head move after the person has confirmed, s."""
MOST_ATTEMPTS: Final = 20
"""So often is a person asked to come to one angle."""
UNWATCHED: Final = "Here the head is seen at your answers alone: answer where you have backed off, too."
"""What is told where the head cannot be watched while a question waits."""
ENCODER: Final = "encoder"
"""Who answers in the person's place, for the record."""

_NO: Final = frozenset({"n", "no"})


@dataclass(frozen=True, slots=True)
class Approach:
    """How a head must come to an angle, and when it stands there.

    It comes from at least `backoff_rad` away. It stands within `tolerance_rad` of the target when its angle changes
    by no more than `rest_rad`, peak to peak, for `settle_s`. No hand turns it faster than `speed_rad_s`. With
    `hands_free` nobody confirms; with `typed` a person types the angle on the scale as well.
    """

    tolerance_rad: float
    backoff_rad: float
    rest_rad: float
    settle_s: float
    speed_rad_s: float
    hands_free: bool = False
    typed: bool = False


@dataclass(frozen=True, slots=True)
class ScaleOfEncoder:
    """The relation of encoder and head: `zero_rad` is what the encoder shows where the scale of the head shows 0°.

    The values of a `falling` encoder fall where the angle of the head rises.
    """

    zero_rad: float = 0.0
    falling: bool = False

    def angle_rad(self, shown_rad: float) -> float:
        """Return the angle of the head where the encoder shows `shown_rad`."""
        return (self.zero_rad - shown_rad) if self.falling else (shown_rad - self.zero_rad)


class Track:
    """The angles that an encoder has shown on the way to a target.

    Offsets from the target count along the way: they are negative before it, positive beyond it, rad.
    """

    def __init__(self, approach: Approach, target_rad: float, direction: Direction) -> None:
        self.told = False
        """Whether the person was told that the head came from the wrong side."""
        self.looks = 0
        """How many angles were taken in."""
        self._approach = approach
        self._target_rad = target_rad
        self._direction = direction
        self._seen: deque[tuple[float, float]] = deque()
        self._backed_off = False

    def take(self, time_s: float, angle_rad: float) -> float | None:
        """Take in an angle at a time; return how far it jumped where no hand turns so fast, rad, else None."""
        offset_rad = self._direction * wrapped_rad(angle_rad - self._target_rad)
        approach = self._approach
        if self._seen:
            last_s, last_rad = self._seen[-1]
            way_rad = abs(wrapped_rad(offset_rad - last_rad))
            slack_rad = approach.rest_rad + approach.tolerance_rad
            if way_rad > approach.speed_rad_s * (time_s - last_s) + slack_rad:
                return way_rad
        self.looks += 1
        self._seen.append((time_s, offset_rad))
        while len(self._seen) > 1 and self._seen[1][0] <= time_s - approach.settle_s:
            self._seen.popleft()
        if offset_rad <= -approach.backoff_rad:
            self._backed_off, self.told = True, False
        elif offset_rad > approach.tolerance_rad + ROUNDING_RAD:
            self._backed_off = False
        return None

    @property
    def angle_rad(self) -> float:
        """The last angle, on the turn of the target, rad."""
        return self._target_rad + self._direction * self._offset_rad

    @property
    def moved_rad(self) -> float:
        """How much the angle changed within the settling time, peak to peak, rad."""
        offsets = [offset_rad for _, offset_rad in self._seen]
        return max(offsets) - min(offsets)

    @property
    def rests(self) -> bool:
        """Whether the head was at rest for the whole settling time."""
        watched_s = self._seen[-1][0] - self._seen[0][0]
        return watched_s >= self._approach.settle_s and self.moved_rad <= self._approach.rest_rad

    @property
    def problem(self) -> str:
        """A sentence why the head does not stand at the target, come to as demanded; empty where it does."""
        if not self.rests:
            within = f"{self._approach.settle_s:g} s"
            return f"The head still moves, by {format_dms(self.moved_rad, 1)} within {within}: clamp it."
        if not self.arrived:
            side = "above" if self._direction * self._offset_rad > 0.0 else "below"
            return (
                f"The encoder shows {scale_text(self.angle_rad)}, {format_dms(abs(self._offset_rad), 1)} {side} "
                f"the target, outside the {format_dms(self._approach.tolerance_rad)} allowed: turn the head until "
                "it agrees."
            )
        return "" if self._backed_off else self._wrong_side

    @property
    def arrived(self) -> bool:
        """Whether the head is within the tolerance of the target."""
        return abs(self._offset_rad) <= self._approach.tolerance_rad + ROUNDING_RAD

    @property
    def _offset_rad(self) -> float:
        return self._seen[-1][1]

    @property
    def _wrong_side(self) -> str:
        back = format_dms(self._approach.backoff_rad)
        way = "below" if self._direction > 0 else "above"
        return f"The head did not come from {way}: back off by {back} at least and approach again."


class ReadOutHead(ABC):
    """The base of the `DividingHead`s with an encoder whose counter a make reads.

    A make says how its counter is proved and what it shows. `tells_reference` says whether the counter tells that
    its reference mark was crossed; where it does not, a person is asked once for each connection.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        person: Person,
        approach: Approach,
        *,
        scale: ScaleOfEncoder,
        identity: Identity,
        tells_reference: bool,
    ) -> None:
        self.name = name
        self._session = ProvedSession(session, clock, self._proved)
        self._clock = clock
        self._person = person
        self._approach = approach
        self._scale = scale
        self._identity = identity
        self._tells_reference = tells_reference
        self._trusted = False

    def open(self) -> Identity:
        """Connect and prove the counter.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        self._session.open()
        return self._identity

    def close(self) -> None:
        """Let the wire go: a counter is left as it is. Never raises, may be called twice."""
        self._session.close()

    def position_rad(self) -> float:
        """Return the angle of the head that the encoder shows, rad.

        Raises `InstrumentRefused` where the counter shows no angle, `InstrumentLost`, `BadReading`.
        """
        return self._scale.angle_rad(self._shown_rad())

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Ask the person to turn to `target_rad` from the stated side; return the angle that the encoder shows.

        Raises `InstrumentRefused` for a counter without reference or with an error, `BadReading` for an angle that
        jumped, `InstrumentLost`, `LimitExceeded` after the last attempt, `NoAnswer` when there is nobody to ask.
        """
        if not math.isfinite(target_rad):
            raise LimitExceeded(self.name, f"{target_rad} rad is no angle", "correct the procedure's angle")
        self._have_reference(key)
        track = Track(self._approach, target_rad, direction)
        self._look(track)  # a counter that shows no angle is told before anybody turns
        trouble = ""
        for attempt in range(1, MOST_ATTEMPTS + 1):
            prompt = self._prompt(target_rad, direction, f"{key}#{attempt}", trouble)
            trouble = self._asked(prompt, track)
            if not trouble:
                return HeadPosition(track.angle_rad, direction)
        raise LimitExceeded(
            self.name,
            f"it did not come to {scale_text(target_rad)} in {MOST_ATTEMPTS} attempts ({trouble.rstrip('.')})",
            "check the clamp, the encoder's coupling and the procedure's angle, then take this point again",
        )

    # --- what a make says ---------------------------------------------------------------------------

    @abstractmethod
    def _prove(self) -> None:
        """Identify the counter, prove its settings and set `_identity`. Raises `InstrumentRefused`."""

    @abstractmethod
    def _shown_rad(self) -> float:
        """Return what the encoder shows, rad. Raises `InstrumentRefused` for what is no angle."""

    # --- the encoder --------------------------------------------------------------------------------

    def _proved(self) -> None:
        self._trusted = self._tells_reference
        self._prove()

    def _look(self, track: Track) -> None:
        """Take in what the encoder shows. Raises `BadReading` where it jumped, which no later look mends."""
        angle_rad = self.position_rad()
        jump_rad = track.take(self._clock.now_s(), angle_rad)
        if jump_rad is not None:
            self._trusted = False
            raise BadReading(
                self.name,
                f"the encoder's angle jumped by {format_dms(jump_rad)} to {format_dms(angle_rad)}, "
                f"faster than {math.degrees(self._approach.speed_rad_s):g}°/s",
                "check the encoder's cable, cross its reference mark again, then take this point again",
            )

    def _have_reference(self, key: str) -> None:
        """Ask, where the counter does not tell, whether its reference mark was crossed."""
        self._session.ensure_proved()
        if self._trusted:
            return

        def question(prompt_id: str, trouble: str) -> Prompt:
            task = (
                "Turn the head across the encoder's reference mark. Was it crossed since the counter went on?"
            )
            return Prompt(prompt_id, PromptKind.CONFIRM, f"{trouble} {task}".lstrip(), default="yes")

        def read(text: str) -> None:
            if text.lower() in _NO:
                raise ValueError("Without it the counter shows no angle.")

        try:
            ask_until(self._person, f"{key}/reference", question, read)
        except ValueError as trouble:
            raise InstrumentRefused(
                self.name,
                f"nobody confirmed that its reference mark was crossed ({trouble})",
                "turn the head across the encoder's reference mark, then take this point again",
            ) from None
        self._trusted = True

    # --- the person ---------------------------------------------------------------------------------

    def _asked(self, prompt: Prompt, track: Track) -> str:
        """Have the head turned; return a sentence on what is wrong with where it stands, empty for nothing."""
        looks_before = track.looks
        try:
            with watching(self._person, partial(self._watch, track), LOOK_S, self._clock):
                answer = self._person.ask(prompt)
        except AnsweredByInstrument as seen:
            return seen.problem
        if answer.prompt_id != prompt.id:
            return "That answer belonged to an earlier question."
        typed = answer.text.strip()
        if not self._approach.typed and typed.lower() in _NO:
            return "There is no hurry."
        watched = track.looks > looks_before
        problem = self._come_to_rest(track) or (self._misread(typed, track) if self._approach.typed else "")
        return problem if watched or not problem else f"{problem} {UNWATCHED}"

    def _watch(self, track: Track) -> None:
        """Look at the encoder while the person turns. Raises `AnsweredByInstrument` where nobody confirms."""
        self._look(track)
        if not self._approach.hands_free or not track.rests or not track.arrived:
            return
        problem = track.problem
        if problem and track.told:
            return
        track.told = bool(problem)
        raise AnsweredByInstrument(ENCODER, format_dms(track.angle_rad, 1), problem)

    def _come_to_rest(self, track: Track) -> str:
        """Look at the encoder until the head is at rest; return what is wrong then, empty for nothing."""
        end_s = self._clock.now_s() + self._approach.settle_s + PATIENCE_S
        self._look(track)
        while not track.rests and self._clock.now_s() < end_s:
            self._clock.sleep(LOOK_S)
            self._look(track)
        return track.problem

    def _misread(self, typed: str, track: Track) -> str:
        """Compare a typed angle with the encoder's; return a sentence where they differ, empty where not."""
        try:
            typed_rad = parse_angle(typed)
        except ValueError as trouble:
            return f"{trouble}."
        tolerance_rad = self._approach.tolerance_rad
        if abs(wrapped_rad(typed_rad - track.angle_rad)) <= tolerance_rad + ROUNDING_RAD:
            return ""
        slip = classic_slip(typed_rad, track.angle_rad, tolerance_rad)
        why = f"probably {slip}" if slip else "check the encoder's coupling and its zero"
        return (
            f"You typed {format_dms(typed_rad)}, the encoder shows {format_dms(track.angle_rad % math.tau)}: "
            f"{why}. Read the scale again."
        )

    def _prompt(self, target_rad: float, direction: Direction, prompt_id: str, trouble: str) -> Prompt:
        approach = self._approach
        then = "clamp; then confirm, and the encoder is read."
        if approach.hands_free:
            then = "clamp and let go; the encoder is read once the head is at rest."
        elif approach.typed:
            then = "clamp; type the angle on the scale, which is compared with the encoder."
        action: Action = {
            "do": "turn",
            "target_rad": target_rad,
            "direction": direction,
            "tolerance_rad": approach.tolerance_rad,
            "read_by": ENCODER,
            "backoff_rad": approach.backoff_rad,
            "hands_free": approach.hands_free,
        }
        task = f"Turn the head to {scale_text(target_rad)}: {APPROACH[direction]}; {then}"
        return Prompt(
            id=prompt_id,
            kind=PromptKind.ANGLE if approach.typed else PromptKind.CONFIRM,
            text=f"{trouble} {task}".lstrip(),
            default=None if approach.typed else "yes",
            unit="° ′ ″" if approach.typed else "",
            action=action,
        )
