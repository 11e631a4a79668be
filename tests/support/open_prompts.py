"""The question that stands after the events of a run."""

from collections.abc import Iterable

from bench.run.events import Event
from bench.run.person import AskedPrompt, OpenPrompt


def open_prompt(events: Iterable[Event]) -> AskedPrompt | None:
    """Return the question that stands after `events`; None if none does."""
    found = OpenPrompt()
    for event in events:
        found.take(event)
    return found.prompt
