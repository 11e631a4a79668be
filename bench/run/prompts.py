"""Asks a person until the answer is one of the kind that the prompt wants."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from bench.run.answers import NO, problem_with_answer
from drivers.interfaces import BenchError, Person, Prompt

MOST_ATTEMPTS: Final = 20
MOST_WAITS: Final = 1000
"""So often may a task be answered with "no": more is nobody who reads the question."""


def ask(person: Person, prompt: Prompt) -> str:
    """Put the prompt until its answer fits; return the answer's text, the default for an empty one.

    `prompt.id` is the step's key; "#1", "#2"… is added for each attempt, and an answer to another id is
    stale and ignored. Raises `NoAnswer` when nobody answers, `BenchError` after five answers that do not fit.
    """
    text = prompt.text
    for attempt in range(1, MOST_ATTEMPTS + 1):
        put = replace(prompt, id=f"{prompt.id}#{attempt}", text=text)
        answer = person.ask(put)
        given = answer.text.strip() or (prompt.default or "")
        problem = "the answer belongs to an earlier question" if answer.prompt_id != put.id else ""
        problem = problem or problem_with_answer(prompt, given)
        if not problem:
            return given
        text = f"{problem[0].upper()}{problem[1:]}. {prompt.text}"
    raise BenchError("operator", f"no usable answer to {prompt.text!r}", "read the question again")


def confirm(person: Person, prompt: Prompt) -> None:
    """Have a task done; "no" waits: the question stands again until it is. Raises what `ask` raises."""
    put = prompt
    for wait in range(1, MOST_WAITS + 1):
        if ask(person, put).lower() not in NO:
            return
        text = f"There is no hurry: say yes when it is done. {prompt.text}"
        put = replace(prompt, id=f"{prompt.id}#wait{wait}", text=text)
    raise BenchError("operator", f"answered no again and again to: {prompt.text}", "go on when it is done")


def agree(person: Person, prompt: Prompt) -> None:
    """Ask for leave to go on. Raises `BenchError` when the person says no, beside what `ask` raises."""
    if ask(person, prompt).lower() in NO:
        raise BenchError("operator", f"answered no to: {prompt.text}", "go on when that is settled")
