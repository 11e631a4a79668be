"""Stands between a run and its early warning: tells it what is taken again, mounted anew, gone on with."""

from __future__ import annotations

from collections.abc import Sequence

from bench.readings.reading import Reading
from bench.run.events import Event, EventType, Mounted
from bench.run.resume import Progress
from bench.run.watch.early_warning import EarlyWarning, Place
from bench.run.watch.expectation import Judgement
from bench.run.watch.sign import EarlySign


class Watcher:
    """An observer of a run that keeps its early warning up to date; a resumed run's events are told it again."""

    def __init__(self, warning: EarlyWarning) -> None:
        self._warning = warning
        self._places: dict[int, Place] = {}

    def observe(self, event: Event) -> None:
        """Take note of an event of the run."""
        match event.type:
            case EventType.STEP_DONE:
                if isinstance(result := event.result, Reading):
                    self._places[event.step] = result.place
                elif isinstance(result, Mounted):
                    self._warning.remounted()
            case EventType.REMOUNTED:
                self._warning.remounted()
            case EventType.REDO:
                again = [self._places.pop(step) for step in event.steps if step in self._places]
                self._warning.strike(again)
            case EventType.WENT_ON:
                self._warning.went_on()

    def take(self, reading: Reading) -> Sequence[EarlySign]:
        """Judge a reading; return what is to be told of it."""
        return self._warning.take(reading)

    @property
    def judged(self) -> Judgement | None:
        """How the reading taken last was judged; None for one without a known orientation."""
        return self._warning.judged

    def recall(self, taken: Sequence[tuple[int, Reading] | None], progress: Progress) -> None:
        """Take the readings on record of a run that is taken up again.

        None stands where the block was mounted anew. Those that were taken again, or are to be, are passed over.
        """
        last = {one[0]: number for number, one in enumerate(taken) if one is not None}
        for number, one in enumerate(taken):
            if one is None:
                self._warning.remounted()
                continue
            step, reading = one
            if last[step] != number or step not in progress.done:
                continue
            self._places[step] = reading.place
            self._warning.take(reading)
            if step in progress.gone_on:
                self._warning.went_on()

    def foresee(self, reading: Reading) -> Judgement:
        """Hold a reading against what is expected of it without taking it."""
        return self._warning.foresee(reading)
