"""What the application may ask of a level."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from drivers.interfaces.instruments import Instrument

LevelAxis = Literal["along", "across"]
"""Along the shaft, positive where the end is the higher one that is away from whoever looks at the end of the
shaft; across it, positive where the end to the right is."""


@dataclass(frozen=True, slots=True)
class Inclination:
    """What a level shows, its own zero included, rad; the signs are those of `LevelAxis`."""

    along_rad: float
    across_rad: float


@dataclass(frozen=True, slots=True)
class LevelSizes:
    """How exact a level is: standard uncertainties of one reading (rad), of its scale, and of what it leaks.

    `cross` is the part of the inclination about the other axis that a reading may hold: axes that are not where
    they should be, a half turn that is none.
    """

    reading_rad: float
    scale: float
    cross: float


@runtime_checkable
class Level(Instrument, Protocol):
    """A level of two axes on the platform; its own zero is not known."""

    asks_person: bool
    """Whether a person reads it, and is told by it how to place it; else a person is only to place it."""

    @property
    def sizes(self) -> LevelSizes:
        """How exact it is."""
        ...

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Return what it shows at rest in its first position, or `turned` half a turn from it, with its own signs.

        Raises `BadReading` for what is out of its range, `InstrumentRefused`, `InstrumentLost`, `NoAnswer`.
        """
        ...
