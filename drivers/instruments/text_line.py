"""Instruments that answer a request with one line of text: counters of a head, and thermometers."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from drivers.facts import text_line as facts
from drivers.interfaces import BadReading, Identity, InstrumentRefused, message
from drivers.readout import Approach, ReadOutHead, ScaleOfEncoder
from drivers.wire.visa import ProvedInstrument

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drivers.clock import Clock
    from drivers.person import Person
    from drivers.wire.visa import MessageSession, ProvedSession


_NUMBER: Final = re.compile(r"[+-]? *\d+(?:\.\d*)?|[+-]? *\.\d+")


class TextLine:
    """A request to the instrument `name`, and the form of its reply, a line of text.

    The group `group` of `pattern` is the number in the reply. `errors` maps each line that may come instead to its
    meaning; `remedy` says what to do then.
    """

    def __init__(
        self,
        name: str,
        request: str,
        pattern: str,
        group: str,
        errors: Mapping[str, str],
        remedy: str = "clear that fault, then redo this point",
    ) -> None:
        self._name = name
        self._request = request
        self._pattern = re.compile(pattern)
        self._group = group
        self._errors = errors
        self._remedy = remedy

    def number(self, session: ProvedSession) -> float:
        """Return the number in the instrument's present reply.

        Raises `InstrumentRefused` for one of the `errors`, `BadReading` for a reply that does not match.
        """
        known = "|".join([f"(?:{self._pattern.pattern})", *map(re.escape, self._errors)])
        said = session.ask(self._request, known, message("a line that fits the pattern in the bench file"))
        if (meaning := self._errors.get(said)) is not None:
            raise InstrumentRefused(
                self._name,
                f"it says {said!r} instead of its {self._group}: {meaning}",
                self._remedy,
            )
        match = self._pattern.fullmatch(said)
        number = match[self._group] if match else ""
        if _NUMBER.fullmatch(number) is None:
            raise BadReading(
                self._name,
                f"the {self._group} in {said!r} is {number!r}, which is not a number",
                "correct the pattern in the bench file",
            )
        return float(number.replace(" ", ""))


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


class LineThermometer(ProvedInstrument):
    """A `Thermometer` described in the bench file by its `request` and the `pattern` of its reply.

    The group `temperature` of the pattern is the value, °C. `errors` maps each line that the thermometer sends
    instead of a value to its meaning. `line_hz` is not used.
    """

    asks_person = False

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        *,
        model: str,
        request: str,
        pattern: str,
        errors: Mapping[str, str],
        minimum_c: float,
        maximum_c: float,
        line_hz: float = 50.0,
    ) -> None:
        super().__init__(name, session, clock, Identity(model, facts.MODEL))
        self.sensor = model
        self._range_c = minimum_c, maximum_c
        self._line = TextLine(name, request, pattern, facts.TEMPERATURE, errors)

    def _prove(self) -> None:
        """Take a reading: the form of the reply is the thermometer's only identity."""
        self._line.number(self._session)

    def block_c(self, key: str) -> float:
        """Return the block temperature, °C.

        Raises `BadReading` for a reply without a number, or for a number out of range; `InstrumentRefused`
        for a line in `errors`; `InstrumentLost` if there is no reply.
        """
        shown_c, (low_c, high_c) = self._line.number(self._session), self._range_c
        if not low_c <= shown_c <= high_c:
            raise BadReading(
                self.name,
                f"it shows {shown_c:g} °C, outside {low_c:g} to {high_c:g} °C",
                "check the sensor, and the pattern and the range in the bench file",
            )
        return shown_c
