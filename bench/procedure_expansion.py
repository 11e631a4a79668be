"""From the steps of a procedure file to the flat steps of a plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from bench.plan import SETTLING, Ask, Mount, Read, SetTemperature, Step, Turn, Wait, told_mount
from bench.procedure_file import (
    IncludedFile,
    InstallationVerb,
    PromptVerb,
    ReadingSection,
    ReadVerb,
    RepeatVerb,
    StepEntry,
    TemperatureVerb,
    TurnVerb,
)
from bench.yaml_file import Document, Mistake
from bench.yaml_mistakes import Place
from drivers.interfaces import Direction

MOST_STEPS: Final = 200_000
"""More is a slip in a file, not a procedure."""

_DIRECTIONS: Final[Mapping[str, Direction]] = {"rising": 1, "falling": -1}


@dataclass(frozen=True)
class _Context:
    """Where in the procedure a step stands; what of it is not entered yet has the values given here."""

    document: Document
    reading: ReadingSection
    installation: str = ""
    series: int = 1
    pass_number: int = 1
    direction: Direction = 1
    point: int = 0
    target_rad: float = 0.0

    @property
    def mount(self) -> str:
        """The mounting as it stands in a key."""
        return self.installation if self.series == 1 else f"{self.installation}s{self.series}"

    @property
    def told_point(self) -> str:
        """The point as it stands in a key."""
        return f"{self.mount}.{self.pass_number}.{self.point}"


class _TooLong(Exception):
    """The plan has more steps than any procedure."""


class Expansion:
    """Expands a procedure whose files are valid and whose verbs stand where they may.

    `mistakes` holds what only shows now (something measured twice), with the document that it is in.
    """

    def __init__(self, documents: Mapping[Path, Document], files: Mapping[Path, IncludedFile]) -> None:
        self.mistakes: list[tuple[Document, Mistake]] = []
        self._documents = documents
        self._files = files
        self._steps: list[Step] = []
        self._mounted: set[tuple[str, int]] = set()
        self._read: set[tuple[str, int, int, int]] = set()
        self._told: set[tuple[Path, Place]] = set()

    def run(self, root: Path) -> tuple[Step, ...]:
        """Return the steps of the procedure in the file `root`."""
        document, file = self._documents[root], self._files[root]
        context = _Context(document, file.reading or ReadingSection())
        try:
            self._all(file.steps, ("steps",), context)
        except _TooLong:
            text = f"the procedure has more than {MOST_STEPS} steps; check its repeats and counts"
            self.mistakes.append((document, document.mistake(("steps",), text)))
        return tuple(self._steps)

    def _key(self, kind: str, where: str = "") -> str:
        if len(self._steps) >= MOST_STEPS:
            raise _TooLong
        return f"{len(self._steps) + 1:04d}/{kind}" + (f"/{where}" if where else "")

    def _once(self, context: _Context, place: Place, text: str) -> None:
        """Note a mistake of a place once, however often the place is repeated."""
        if (context.document.path, place) not in self._told:
            self._told.add((context.document.path, place))
            self.mistakes.append((context.document, context.document.mistake(place, text)))

    def _all(self, entries: Sequence[StepEntry], place: Place, context: _Context) -> None:
        for index, entry in enumerate(entries):
            self._one(entry, (*place, index), context)

    def _one(self, entry: StepEntry, place: Place, context: _Context) -> None:
        if entry.installation is not None:
            self._installation(entry.installation, (*place, "installation"), context)
        elif entry.repeat is not None:
            self._repeat(entry.repeat, (*place, "repeat"), context)
        elif entry.turn is not None:
            self._turn(entry.turn, (*place, "turn"), context)
        elif entry.read is not None:
            self._reading(entry.read, (*place, "read"), context)
        elif entry.wait is not None:
            self._wait(entry.wait.duration, entry.wait.reason)
        elif entry.prompt is not None:
            self._prompt(entry.prompt)
        elif entry.temperature is not None:
            self._temperature(entry.temperature)
        elif entry.include is not None:
            path = (context.document.path.parent / entry.include).resolve()
            file = self._files[path]
            inside = replace(context, document=self._documents[path], reading=file.reading or context.reading)
            self._all(file.steps, ("steps",), inside)

    def _installation(self, verb: InstallationVerb, place: Place, context: _Context) -> None:
        visits = [series for label, series in self._mounted if label == verb.label]
        series = verb.series or max(visits, default=0) + 1
        if series in visits:
            where = told_mount(verb.label, series)
            text = f"installation {where} was visited before; give this visit a series of its own"
            self._once(context, (*place, "series"), text)
        self._mounted.add((verb.label, series))
        inside = replace(context, installation=verb.label, series=series)
        self._steps.append(Mount(self._key("mount", inside.mount), verb.label, series))
        self._all(verb.steps, (*place, "steps"), inside)

    def _repeat(self, verb: RepeatVerb, place: Place, context: _Context) -> None:
        directions = [_DIRECTIONS[word] for word in verb.directions or ()]
        times = verb.times or len(directions)
        before = (context.pass_number - 1) * times
        for index in range(times):
            number = before + index + 1
            direction = directions[index] if directions else context.direction
            inside = replace(context, pass_number=number, direction=direction)
            self._all(verb.steps, (*place, "steps"), inside)

    def _turn(self, verb: TurnVerb, place: Place, context: _Context) -> None:
        direction = _DIRECTIONS[verb.direction] if verb.direction else context.direction
        points = list(enumerate(verb.angles_rad, start=verb.first_point))
        for point, target_rad in points if direction > 0 else reversed(points):
            here = replace(context, direction=direction, point=point, target_rad=target_rad)
            self._steps.append(
                Turn(
                    self._key("turn", here.told_point),
                    here.installation,
                    here.series,
                    here.pass_number,
                    point,
                    target_rad,
                    direction,
                )
            )
            if verb.steps is not None:
                self._all(verb.steps, (*place, "steps"), here)
                continue
            if here.reading.settle:
                self._wait(here.reading.settle, SETTLING)
            self._reading(ReadVerb(), place, here)

    def _reading(self, verb: ReadVerb, place: Place, context: _Context) -> None:
        identity = (context.installation, context.series, context.pass_number, context.point)
        if identity in self._read:
            where = told_mount(context.installation, context.series)
            text = (
                f"point {context.point} of pass {context.pass_number} in installation {where} is read a "
                "second time; number the points on with 'first_point', or put both into one repeat"
            )
            self._once(context, place, text)
        self._read.add(identity)
        self._steps.append(
            Read(
                self._key("read", context.told_point),
                context.installation,
                context.series,
                context.pass_number,
                context.point,
                context.target_rad,
                context.direction,
                verb.samples or context.reading.samples,
                verb.nplc or context.reading.nplc,
            )
        )

    def _wait(self, duration_s: float, reason: str) -> None:
        self._steps.append(Wait(self._key("wait"), duration_s, reason))

    def _prompt(self, verb: PromptVerb) -> None:
        key = self._key("ask")
        asked = Ask(
            key,
            verb.kind,
            verb.text,
            verb.default,
            verb.unit,
            verb.choices,
            verb.minimum,
            verb.maximum,
        )
        self._steps.append(asked)

    def _temperature(self, verb: TemperatureVerb) -> None:
        self._steps.append(SetTemperature(self._key("temperature"), verb.at))
        if verb.soak:
            self._wait(verb.soak, f"soak at {verb.at:g} °C")
