"""A living person at a simulated bench: what they say that they did is done in its world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from bench.run.answers import NO, problem_with_answer
from drivers.angles import parse_angle
from drivers.interfaces import Answer, Prompt, WatchingPerson
from sim.world.operator import ScriptedOperator

_LOOKED_AT: Final = frozenset({"read_temperature", "read_level", "read_supply"})
_DONE: Final = frozenset(
    {
        "mount",
        "set_temperature",
        "select_input",
        "place_level",
        "level_platform",
        "set_supply",
        "switch_supply",
    }
)


class LivingOperator:
    """A `drivers.interfaces.WatchingPerson` who is `person`, with the hands of a scripted operator.

    The head stands where the person says that its scale shows it to be. A display, and the bubble of a level, are
    told in the question. In the world a task takes the time that the scripted operator takes for it, however long
    the person does.
    """

    def __init__(self, person: WatchingPerson, hands: ScriptedOperator) -> None:
        self._person = person
        self._hands = hands

    @property
    def meanwhile(self) -> Callable[[], None] | None:
        """What is to be done while a question waits."""
        return self._person.meanwhile

    @meanwhile.setter
    def meanwhile(self, look: Callable[[], None] | None) -> None:
        self._person.meanwhile = self._hands.meanwhile = look

    def ask(self, prompt: Prompt) -> Answer:
        """Ask the person, and do in the world what they say is done. Raises what the person's `ask` raises."""
        action = prompt.action
        if action["do"] in _LOOKED_AT:
            seen = self._hands.ask(prompt).text
            return self._person.ask(replace(prompt, text=f"{prompt.text} (Simulated: it shows {seen}.)"))
        answer = self._person.ask(prompt)
        if answer.prompt_id != prompt.id or problem_with_answer(prompt, answer.text):
            return answer  # it is asked again
        if action["do"] == "turn":
            typed = answer.text.strip() or prompt.default or ""
            self._hands.turn_to(prompt.id, parse_angle(typed), action["direction"])
        elif action["do"] in _DONE and answer.text.strip().lower() not in NO:
            self._hands.ask(prompt)
        return answer
