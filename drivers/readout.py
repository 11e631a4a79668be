"""Base class of heads that a person turns; an encoder follows the approach and measures the angle."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from drivers.angles import ROUNDING_RAD, classic_slip, format_dms, parse_angle, scale_text, wrapped_rad
from drivers.interfaces import BadReading, Direction, HeadPosition, InstrumentRefused, LimitExceeded, message
from drivers.person import APPROACH, AnsweredByInstrument, Prompt, PromptKind, ask_until, watching
from drivers.wire.visa import ProvedInstrument, ProvedSession

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.interfaces import Identity
    from drivers.person import Action, Person
    from drivers.wire.visa import MessageSession

LOOK_S: Final = 0.2
"""Interval between two readings of the encoder while a person turns the head, s."""
PATIENCE_S: Final = 10.0
"""Longest wait for the head to rest after the person's confirmation, in addition to the settling time, s."""
MOST_ATTEMPTS: Final = 20
"""The most prompts for one angle."""
UNWATCHED: Final = "The program sees the head only when you answer: answer at the back-off position, too."
"""The hint in a prompt if the program cannot read the encoder while the prompt is open."""
ENCODER: Final = "encoder"
"""The name of the encoder as author of an answer in the record."""

_NO: Final = frozenset({"n", "no"})


@dataclass(frozen=True, slots=True)
class Approach:
    """The rules by which a head arrives at an angle.

    The head must come from at least `backoff_rad` away, and stop within `tolerance_rad` of the target. It is
    at rest if its angle varies by at most `rest_rad`, peak to peak, during `settle_s`, s. A change faster
    than `speed_rad_s` is an error of the encoder. If `hands_free`, nobody confirms the arrival; if `typed`, a
    person also types the angle.
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
    """The relation between encoder and head: the encoder shows `zero_rad` at 0° of the head's scale.

    The values of a `falling` encoder fall while the angle of the head rises.
    """

    zero_rad: float = 0.0
    falling: bool = False

    def angle_rad(self, shown_rad: float) -> float:
        """Return the angle of the head for a value of the encoder."""
        return (self.zero_rad - shown_rad) if self.falling else (shown_rad - self.zero_rad)


class Track:
    """The recent angles of an encoder on the way to a target.

    An offset from the target, rad, is negative before the target and positive beyond it, in the direction of
    approach.
    """

    def __init__(self, approach: Approach, target_rad: float, direction: Direction) -> None:
        self.told = False
        """Whether the person knows that the head came from the wrong side."""
        self.looks = 0
        """The number of angles taken."""
        self._approach = approach
        self._target_rad = target_rad
        self._direction = direction
        self._seen: deque[tuple[float, float]] = deque()
        self._backed_off = False

    def take(self, time_s: float, angle_rad: float) -> float | None:
        """Add an angle that was read at a time, s; return None, or the change of an angle that jumped, rad.

        A jump is a change faster than a hand can turn the head (`Approach.speed_rad_s`); such an angle is not
        added.
        """
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
        """The last angle, rad, shifted by whole turns to lie within half a turn of the target."""
        return self._target_rad + self._direction * self._offset_rad

    @property
    def moved_rad(self) -> float:
        """The peak-to-peak change of the angle within the settling time, rad."""
        offsets = [offset_rad for _, offset_rad in self._seen]
        return max(offsets) - min(offsets)

    @property
    def rests(self) -> bool:
        """Whether the head has been at rest for the settling time."""
        watched_s = self._seen[-1][0] - self._seen[0][0]
        return watched_s >= self._approach.settle_s and self.moved_rad <= self._approach.rest_rad

    @property
    def problem(self) -> str:
        """The reason, in a sentence, why the head has not arrived as demanded; empty if it has."""
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
        return f"The head did not approach from {way}: back off by {back} at least and approach again."


class ReadOutHead(ProvedInstrument):
    """The base class of each `DividingHead` that a person turns and a counter reads.

    A subclass verifies its counter and reads its value. `tells_reference` says whether the counter reports
    that the encoder's reference mark was crossed. If not, the person is asked once for each connection.
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
        super().__init__(name, session, clock, identity)
        self._session = ProvedSession(session, clock, self._proved)
        self._person = person
        self._approach = approach
        self._scale = scale
        self._tells_reference = tells_reference
        self._trusted = False

    def position_rad(self) -> float:
        """Return the angle of the head by its encoder, rad.

        Raises `InstrumentRefused` if the counter shows no angle, `InstrumentLost`, `BadReading`.
        """
        return self._scale.angle_rad(self._shown_rad())

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Ask the person to turn to `target_rad` from the stated side; return the angle by the encoder.

        Raises `InstrumentRefused` if the counter has an error or no reference, `BadReading` if the angle jumped,
        `InstrumentLost`, `LimitExceeded` after the last attempt, `NoAnswer` if there is nobody to ask.
        """
        if not math.isfinite(target_rad):
            raise LimitExceeded(
                self.name, f"{target_rad} rad is not an angle", "correct the procedure's angle"
            )
        track = self._begun(target_rad, direction, key)
        trouble = ""
        for attempt in range(1, MOST_ATTEMPTS + 1):
            if not self._trusted:  # a new connection: the counter may have been switched off
                track = self._begun(target_rad, direction, key)
            prompt = self._prompt(target_rad, direction, f"{key}#{attempt}", trouble)
            trouble = self._asked(prompt, track)
            if not trouble and self._trusted:
                return HeadPosition(track.angle_rad, direction)
        raise LimitExceeded(
            self.name,
            f"it did not come to {scale_text(target_rad)} in {MOST_ATTEMPTS} attempts ({trouble.rstrip('.')})",
            "check the clamp, the encoder's coupling and the procedure's angle, then redo this point",
        )

    # --- what a subclass provides -------------------------------------------------------------------

    @abstractmethod
    def _shown_rad(self) -> float:
        """Return the value of the encoder, rad. Raises `InstrumentRefused` if the counter shows no angle."""

    # --- the encoder --------------------------------------------------------------------------------

    def _proved(self) -> None:
        self._trusted = self._tells_reference
        self._prove_same()

    def _begun(self, target_rad: float, direction: Direction, key: str) -> Track:
        """Return a new track with the present angle, so that a counter's error is reported before anybody turns."""
        self._have_reference(key)
        track = Track(self._approach, target_rad, direction)
        self._look(track)
        return track

    def _look(self, track: Track) -> None:
        """Add the present angle to the track. Raises `BadReading` if it jumped."""
        angle_rad = self.position_rad()
        jump_rad = track.take(self._clock.now_s(), angle_rad)
        if jump_rad is not None:
            self._trusted = False
            raise BadReading(
                self.name,
                f"the encoder's angle jumped by {format_dms(jump_rad)} to {format_dms(angle_rad)}, "
                f"faster than {math.degrees(self._approach.speed_rad_s):g}°/s",
                "check the encoder's cable, cross its reference mark again, then redo this point",
            )

    def _have_reference(self, key: str) -> None:
        """Ask the person whether the reference mark was crossed, if the counter does not report it."""
        self._session.ensure_proved()
        if self._trusted:
            return

        task = "Turn the head across the encoder's reference mark. Was it crossed since the counter went on?"
        question = Prompt(f"{key}/reference", PromptKind.CONFIRM, task, default="yes")

        def read(text: str) -> None:
            if text.lower() in _NO:
                raise ValueError(
                    message("Without it the counter shows no angle: turn the head across the reference mark.")
                )

        try:
            ask_until(self._person, question, read)
        except ValueError as trouble:
            raise InstrumentRefused(
                self.name,
                f"nobody confirmed that its reference mark was crossed ({trouble})",
                "turn the head across the encoder's reference mark, then redo this point",
            ) from None
        self._trusted = True

    # --- the person ---------------------------------------------------------------------------------

    def _asked(self, prompt: Prompt, track: Track) -> str:
        """Show the prompt and wait until the head is at rest; return why it has not arrived, or an empty text."""
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
        """Read the encoder while the person turns. Raises `AnsweredByInstrument` when hands-free and at rest."""
        self._look(track)
        if not self._approach.hands_free or not track.rests or not track.arrived:
            return
        problem = track.problem
        if problem and track.told:
            return
        track.told = bool(problem)
        raise AnsweredByInstrument(ENCODER, format_dms(track.angle_rad, 1), problem)

    def _come_to_rest(self, track: Track) -> str:
        """Wait until the head is at rest; return why it has not arrived, or an empty text."""
        end_s = self._clock.now_s() + self._approach.settle_s + PATIENCE_S
        self._look(track)
        while not track.rests and self._clock.now_s() < end_s:
            self._clock.sleep(LOOK_S)
            self._look(track)
        return track.problem

    def _misread(self, typed: str, track: Track) -> str:
        """Compare a typed angle with the encoder's; return a sentence if they differ, or an empty text."""
        try:
            typed_rad = parse_angle(typed)
        except ValueError as trouble:
            return f"{trouble}."
        tolerance_rad = self._approach.tolerance_rad
        if abs(wrapped_rad(typed_rad - track.angle_rad)) <= tolerance_rad + ROUNDING_RAD:
            return ""
        slip = classic_slip(typed_rad, track.angle_rad, tolerance_rad)
        why = message(f"probably {slip}") if slip else message("check the encoder's coupling and its zero")
        return message(
            f"You typed {format_dms(typed_rad)}, the encoder shows {format_dms(track.angle_rad % math.tau)}: "
            f"{why}. Read the scale again."
        )

    def _prompt(self, target_rad: float, direction: Direction, prompt_id: str, trouble: str) -> Prompt:
        approach = self._approach
        then = "clamp; then confirm, and the encoder is read."
        if approach.hands_free:
            then = "clamp and let go; the encoder is read once the head is at rest."
        elif approach.typed:
            then = "clamp; type the angle on the scale, to compare it with the encoder."
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
