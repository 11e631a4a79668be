"""The question that stands after the events of a run."""

from bench.run.person import OpenPrompt


def open_prompt(events):
    """Return the question that stands after `events`; None if none does."""
    found = OpenPrompt()
    for event in events:
        found.take(event)
    return found.prompt
