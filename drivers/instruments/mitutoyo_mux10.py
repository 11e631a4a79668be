"""A counter with the format of a Mitutoyo MUX-10; it measures the angle of a head that a person turns.

Source: see `drivers.facts.mitutoyo_mux10`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from drivers.facts import mitutoyo_mux10 as facts
from drivers.interfaces import Identity, message
from drivers.readout import Approach, ReadOutHead, ScaleOfEncoder

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.person import Person
    from drivers.wire.visa import MessageSession


class MitutoyoMux10(ReadOutHead):
    """A `DividingHead` whose encoder is connected to one channel of a counter that shows degrees."""

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        person: Person,
        approach: Approach,
        *,
        channel: int,
        scale: ScaleOfEncoder,
    ) -> None:
        super().__init__(
            name,
            session,
            clock,
            person,
            approach,
            scale=scale,
            identity=Identity(facts.MAKER, facts.MODEL),
            tells_reference=False,
        )
        self._channel = channel

    def _prove(self) -> None:
        """Take a reading: its form is the only identity of such a counter."""
        self._shown_rad()

    def _shown_rad(self) -> float:
        """Return the value of the channel, rad. Raises `BadReading` for a reply of another form."""
        begin = f"0{self._channel}A"
        form = rf"{begin}(?=.{{{facts.VALUE_CHARACTERS + 1}}}\Z)[+-]\d+\.\d+"
        said = self._session.ask(str(self._channel), form, message(f"a reading such as {facts.EXAMPLE}"))
        return math.radians(float(said.removeprefix(begin)))
