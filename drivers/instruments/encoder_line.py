"""A counter that replies with one line of text and measures the angle of a head that a person turns."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from drivers.facts import text_line as facts
from drivers.interfaces import Identity
from drivers.readout import Approach, ReadOutHead, ScaleOfEncoder
from drivers.text_line import TextLine

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drivers.clock import Clock
    from drivers.person import Person
    from drivers.wire.visa import MessageSession


class EncoderLine(ReadOutHead):
    """A `DividingHead` with an encoder on a counter that the bench file describes.

    `model` is the counter's name in the record. The counter replies to `request` with one line. The `pattern` must
    match the whole line, and its group `angle` is the number; `per_turn` units make a turn. `errors` maps each line
    that the counter sends instead of an angle to its meaning.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        person: Person,
        approach: Approach,
        *,
        model: str,
        request: str,
        pattern: str,
        per_turn: float,
        errors: Mapping[str, str],
        scale: ScaleOfEncoder,
    ) -> None:
        super().__init__(
            name,
            session,
            clock,
            person,
            approach,
            scale=scale,
            identity=Identity(model, facts.MODEL),
            tells_reference=False,
        )
        again = "clear that fault, cross the encoder's reference mark again, then redo this point"
        self._line = TextLine(name, request, pattern, facts.ANGLE, errors, again)
        self._rad = math.tau / per_turn

    def _prove(self) -> None:
        """Take a reading: its form is the only identity of such a counter."""
        self._shown_rad()

    def _shown_rad(self) -> float:
        """Return the value of the counter, rad. Raises the errors of `TextLine.number`."""
        return self._line.number(self._session) * self._rad
