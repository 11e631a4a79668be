"""A counter that answers a request with one line of text, on a head that a person turns."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from drivers.facts import encoder_line as facts
from drivers.interfaces import BadReading, Identity, InstrumentRefused
from drivers.readout import Approach, ReadOutHead, ScaleOfEncoder

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drivers.clock import Clock
    from drivers.person import Person
    from drivers.wire.visa import MessageSession

_NUMBER: Final = re.compile(r"[+-]? *\d+(?:\.\d*)?|[+-]? *\.\d+")


class EncoderLine(ReadOutHead):
    """A `DividingHead` with an encoder on a counter that its bench file describes; `model` names it in the record.

    The counter answers `request` with one line, which must match `pattern`. The group `angle` of the pattern is the
    number; `per_turn` units make a turn. `errors` maps lines instead of an angle to their meanings.
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
        self._request = request
        self._pattern = re.compile(pattern)
        self._errors = errors
        self._rad = math.tau / per_turn

    def _prove(self) -> None:
        """Take a reading: its form is the only identity of such a counter."""
        self._shown_rad()

    def _shown_rad(self) -> float:
        """Return the value of the counter, rad.

        Raises `InstrumentRefused` for an error of the bench file, `BadReading` for any other reply.
        """
        known = "|".join([f"(?:{self._pattern.pattern})", *map(re.escape, self._errors)])
        said = self._session.ask(self._request, known, "a line of the form in the bench file")
        if (meaning := self._errors.get(said)) is not None:
            raise InstrumentRefused(
                self.name,
                f"its counter says {said!r} instead of an angle: {meaning}",
                "clear that fault, cross the encoder's reference mark again, then redo this point",
            )
        match = self._pattern.fullmatch(said)
        number = match[facts.ANGLE] if match else ""
        if _NUMBER.fullmatch(number) is None:
            raise BadReading(
                self.name,
                f"the angle in {said!r} is {number!r}, which is not a number",
                "correct the pattern in the bench file",
            )
        return float(number.replace(" ", "")) * self._rad
