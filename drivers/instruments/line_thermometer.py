"""A thermometer that answers a request with one line of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.facts import text_line as facts
from drivers.interfaces import BadReading, Identity
from drivers.text_line import TextLine
from drivers.wire.visa import ProvedInstrument

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession


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
