"""A Leica Nivel210 or Nivel220: two inclinations over a serial line, in blocks with a check sum.

Source: see `drivers.facts.leica_nivel`.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final, Literal

from drivers.facts import leica_nivel as facts
from drivers.interfaces import BadReading, Identity, Inclination, InstrumentRefused, LevelSizes, message
from drivers.wire.visa import ProvedInstrument

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

Axis = Literal["+X", "-X", "+Y", "-Y"]

_VALUE: Final = r"[+-]\d\.\d{3}"
_ALL: Final = rf"X:\s*({_VALUE})\s+Y:\s*({_VALUE})\s+T:\s*([+-]\d{{1,2}}\.\d{{1,2}})"
_AXIS: Final = re.compile(rf"([XY]):\s*({_VALUE})")
_EXAMPLE: Final = "X:-0.084 Y:+0.296 T:+24.4"


class LeicaNivel(ProvedInstrument):
    """A `Level` that reads the sensor with address N`sensor`.

    `along` and `across` name the sensor axes that lie along and across the shaft in the level's first
    position. Their signs give readings the signs that `LevelAxis` defines. A reading is the mean of
    `averages` measurements, one per second. Raises `ValueError` if both name the same axis.
    """

    asks_person = False

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        *,
        sensor: str = "1",
        along: Axis = "+Y",
        across: Axis = "+X",
        averages: int = facts.AVERAGES,
    ) -> None:
        if along[1] == across[1]:
            raise ValueError(
                f"{name}: along and across need different axes, not both {along[1]} of the sensor"
            )
        super().__init__(
            name, session, clock, Identity(facts.MAKER, facts.MODEL), write_gap_s=facts.SLOWEST_REPLY_S
        )
        self._address = f"N{sensor}"
        self._along, self._across = along, across
        self._averages = averages

    @property
    def sizes(self) -> LevelSizes:
        """The standard uncertainties from the data sheet for range A, including the resolution."""
        digit_rad = facts.RESOLUTION_RAD / math.sqrt(12.0)
        cross_deg = math.hypot(facts.DIRECTION_ERROR_DEG, facts.ORTHOGONAL_ERROR_DEG)
        return LevelSizes(
            reading_rad=math.hypot(facts.ACCURACY_RAD[0][1], digit_rad),
            scale=facts.SCALE_ERROR / math.sqrt(3.0),
            cross=math.radians(cross_deg) / math.sqrt(3.0),
        )

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Wait until the sensor's mean contains only measurements of the present position, and return it.

        `turned` is not used. Raises `BadReading` if the sensor is out of range, `InstrumentRefused` if it lost
        power, `InstrumentLost`.
        """
        if self._averages_set() != self._averages:
            raise InstrumentRefused(
                self.name,
                "it was switched off and on since it was set up",
                "let it warm up for 20 minutes, then level again",
            )
        self._clock.sleep(float(self._averages + 1))  # until then the mean includes the previous position
        if self._ask("G P", "OK|F", "OK or F") != "OK":
            raise BadReading(
                self.name,
                f"the inclination exceeds its range of ±{facts.RANGE_RAD / facts.MRAD:g} mrad",
                "level the platform by the circular level on the sensor, then read again",
            )
        said = self._ask("G A", _ALL, message(f"inclinations such as {_EXAMPLE}"))
        by_axis = {axis: float(value) * facts.MRAD for axis, value in _AXIS.findall(said)}
        along_rad, across_rad = (
            float(f"{axis[0]}1") * by_axis[axis[1]] for axis in (self._along, self._across)
        )
        return Inclination(along_rad, across_rad)

    # --- blocks -------------------------------------------------------------------------------------

    def _prove(self) -> None:
        """Read serial number and firmware, verify corrected and continuous values, and set the averages."""
        number, firmware = self._ask(
            "RB D", r"\d{6} [\x21-\x7e]{1,8}", message("a serial number and firmware")
        ).split()
        self._identity = Identity(facts.MAKER, facts.MODEL, number, firmware)
        for command, wanted, what in (
            ("RS C", "ON", message("its corrections are switched off")),
            ("RS M", "CONT", message("it waits for a trigger")),
        ):
            if self._ask(command, "ON|OFF|CONT|PRE", "ON, OFF, CONT or PRE") != wanted:
                raise InstrumentRefused(
                    self.name, what, "switch it off and on, or reset it by its own program"
                )
        self._session.write(self._block(f"W N {self._averages:03d}"))
        taken = self._averages_set()
        if taken != self._averages:
            raise InstrumentRefused(
                self.name,
                f"it averages over {taken} measurements, not the {self._averages} demanded",
                "check that no other program uses it",
            )

    def _averages_set(self) -> int:
        return int(self._ask("R N", r"\d{3}", message("a number of averages such as 008")))

    def _block(self, command: str) -> str:
        return f"{facts.START}{self._address}{facts.HOST} {command}{facts.END}"

    def _ask(self, command: str, pattern: str, expected: str) -> str:
        """Return the text of the reply to a command. Raises `BadReading` for a wrong check sum or format."""

        def exchange() -> str:
            whole = self._session.command(self._block(command), r"[\x00-\xff]+", message("a block"))
            said = whole[len(facts.START) : -1 - facts.READ_TAIL]
            sender = f"{facts.HOST}{self._address} "
            right = (
                whole.startswith(facts.START)
                and whole[-facts.READ_TAIL :].encode("latin-1") == facts.check_sum(said)
                and said.startswith(sender)
                and re.fullmatch(pattern, said.removeprefix(sender).strip()) is not None
            )
            if not right:
                raise BadReading(
                    self.name,
                    f"the reply to {command} is {said!r}, not {expected} with its check sum",
                    "try again; if the fault returns, check cable, address and baud rate",
                )
            return said.removeprefix(sender).strip()

        return self._session.repeating(exchange)
