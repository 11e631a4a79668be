"""A Heidenhain ND 281B or ND 287 that measures the angle of a head; a person turns the head.

Source: see `drivers.facts.heidenhain_nd28x`.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from drivers.facts import heidenhain_nd28x as facts
from drivers.interfaces import Identity, InstrumentRefused, message
from drivers.readout import Approach, ReadOutHead, ScaleOfEncoder

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.person import Person
    from drivers.wire.visa import MessageSession

_SOFTWARE: Final = rf"{facts.STX} *\d{{6}}- ?\d{{2}} *"
_DEVICE: Final = re.compile(
    rf"{facts.STX} *(ND-?\w{{3,5}}) *\r?\n *(\d{{6}}- ?\d{{2}}) *\r?\n *([\w.-]+(?: ?[\w.-]+)*) *"
)
_SHOWN: Final = rf"{facts.STX}[\x20-\x7e]{{1,{facts.LONGEST_VALUE}}}"
_VALUE: Final = re.compile(r"([+ -]) *(\d+\.\d+) *")


class HeidenhainNd28x(ReadOutHead):
    """A `DividingHead` whose encoder is on an ND-281B or ND-287 (`model`), set to decimal degrees."""

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        person: Person,
        approach: Approach,
        *,
        model: str,
        scale: ScaleOfEncoder,
    ) -> None:
        super().__init__(
            name,
            session,
            clock,
            person,
            approach,
            scale=scale,
            identity=Identity(facts.MAKER, model),
            tells_reference=True,
        )
        self._model = model

    def _prove(self) -> None:
        """Query software, model and version; on an ND 287, query the unit, too."""
        self._session.ask(facts.ASK_SOFTWARE, _SOFTWARE, message("a software number such as 349797-04"))
        said = self._session.ask(
            facts.ASK_DEVICE,
            _DEVICE.pattern,
            message("a name, a software number and a version"),
            lines=facts.DEVICE_LINES,
        )
        match = _DEVICE.fullmatch(said)
        model, software, version = match.groups() if match else ("", "", "")
        if model != self._model:
            raise InstrumentRefused(
                self.name, f"it is an {model}, not an {self._model}", "state its model in the bench file"
            )
        self._identity = Identity(facts.MAKER, model, firmware=f"{software.replace(' ', '')} {version}")
        if model == "ND-287":
            self._refuse_other_display()

    def _refuse_other_display(self) -> None:
        bar = self._session.ask(
            facts.ASK_STATUS_BAR, rf"{facts.STX}\d{{8}}", message("a status bar of eight digits")
        )[1:]
        for what, place, wanted in (
            (
                message("it shows the distance to go instead of the actual value"),
                facts.MODE,
                facts.ACTUAL_VALUE,
            ),
            (message("its scaling factor is switched on"), facts.SCALING, facts.UNSCALED),
            (message("it does not show decimal degrees"), facts.UNIT, facts.DEGREES),
        ):
            if bar[place] != wanted:
                raise InstrumentRefused(self.name, what, "set it by its keys")

    def _shown_rad(self) -> float:
        """Return the displayed angle, rad. Raises `InstrumentRefused` for a relative value or other text."""
        self._refuse_without_reference()
        shown = self._session.ask(
            facts.ASK_DISPLAY, _SHOWN, message("what is displayed, such as +00045.0028")
        )[1:]
        match = _VALUE.fullmatch(shown)
        if match is None or len(shown) < facts.SHORTEST_VALUE:
            raise InstrumentRefused(
                self.name,
                f"its display shows {shown.strip()!r} instead of an angle in decimal degrees",
                "clear it with C or CL, check the encoder, cross the reference mark and redo this point",
            )
        return math.radians(float(f"{match[1].strip()}{match[2]}"))

    def _refuse_without_reference(self) -> None:
        """Raise `InstrumentRefused` if the indicators show a relative value or inches."""
        of_281b = self._model == "ND-281B"
        length = str(facts.INDICATORS_281B) if of_281b else "1,24"
        said = self._session.ask(
            facts.ASK_INDICATORS,
            rf"{facts.STX}[012]{{{length}}}",
            message("indicators such as 01001001000000"),
        )[1:]
        referenced = said[facts.REF_281B] == facts.GLOWS if of_281b else facts.BLINKS not in said
        if not referenced:
            raise InstrumentRefused(
                self.name,
                "it shows a relative angle, as its reference mark was not crossed",
                "turn the head across the reference mark until REF glows, then redo this point",
            )
        if of_281b and said[facts.INCH_281B] != facts.DARK:
            raise InstrumentRefused(self.name, "it shows inches", "set it to decimal degrees (P01)")
