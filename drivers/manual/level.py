"""A bubble level that a person reads, in graduations of its vial."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from drivers.angles import typed_bubble
from drivers.interfaces import BadReading, Identity, Inclination, LevelAxis, LevelSizes, Prompt, PromptKind

if TYPE_CHECKING:
    from drivers.interfaces import Person

_MAX_ATTEMPTS: Final = 5
_ENDS: Final[dict[tuple[LevelAxis, bool], str]] = {
    ("along", False): "along the shaft, its marked end away from you",
    ("along", True): "along the shaft the other way round, its marked end towards you",
    ("across", False): "across the shaft, its marked end to your right",
    ("across", True): "across the shaft the other way round, its marked end to your left",
}


class ManualLevel:
    """A `Level` of one vial, laid along the shaft and across it. A graduation is `division_rad`.

    A person reads it to `reading_divisions` (standard uncertainty); the vial has `most_divisions` to either side.
    `scale` is the standard uncertainty of a graduation as a part of it, `turn_rad` that of how it is laid.
    """

    asks_person = True

    def __init__(
        self,
        name: str,
        person: Person,
        *,
        division_rad: float,
        reading_divisions: float,
        most_divisions: float,
        scale: float,
        turn_rad: float,
    ) -> None:
        self.name = name
        self._person = person
        self._division_rad = division_rad
        self._most_divisions = most_divisions
        self._sizes = LevelSizes(reading_divisions * division_rad, scale, turn_rad)

    @property
    def sizes(self) -> LevelSizes:
        """As the bench file states them."""
        return self._sizes

    def open(self) -> Identity:
        """Return what stands in the record for a level without electronics; nothing is asked."""
        return Identity(maker="manual", model="bubble level")

    def close(self) -> None:
        """Nothing to release."""

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Ask for the bubble along the shaft and across it; what is off the vial's scale is asked again.

        Raises `BadReading` when nothing on the scale comes, `NoAnswer` when there is nobody to ask.
        """
        return Inclination(self._read(key, "along", turned), self._read(key, "across", turned))

    def _read(self, key: str, axis: LevelAxis, turned: bool) -> float:
        most = self._most_divisions
        trouble = ""
        for attempt in range(1, _MAX_ATTEMPTS + 1):
            prompt = Prompt(
                id=f"{key}/{axis}#{attempt}",
                kind=PromptKind.NUMBER,
                text=(
                    f"{trouble} Looking at the end of the shaft, lay the level {_ENDS[axis, turned]}; when the "
                    "bubble stands, type by how many divisions it is off the middle, + towards the marked end "
                    "(or so many arcsec)."
                ).lstrip(),
                unit="divisions",
                action={
                    "do": "read_level",
                    "axis": axis,
                    "turned": turned,
                    "division_rad": self._division_rad,
                    "most_divisions": most,
                },
            )
            answer = self._person.ask(prompt)
            if answer.prompt_id != prompt.id:
                trouble = "That answer belonged to an earlier question."
                continue
            try:
                return typed_bubble(answer.text, self._division_rad, most)
            except ValueError as error:
                trouble = str(error)
        raise BadReading(
            self.name,
            f"no reading on its scale in {_MAX_ATTEMPTS} attempts ({trouble.rstrip('.')})",
            "level the platform roughly, check the divisions in the bench file, then take this step again",
        )
