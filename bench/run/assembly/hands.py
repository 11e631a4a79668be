"""Simulated hands at a served bench: they do the tasks that runs ask for, while a person gives the answers."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from bench.base.files import open_regular
from bench.run.events import EVENTS, EventType
from bench.run.folder import Run
from bench.run.person import INSTRUMENT, OpenPrompt
from bench.run.record import is_being_written, parse_line
from drivers.interfaces import NoAnswer
from drivers.person import Prompt, TurnHead
from sim.control import CRANK_RAD_S
from sim.world.operator import OperatorSettings, ScriptedOperator
from sim.world.world import World

LOOK_S: Final = 0.2
"""Interval between two readings of the folder of runs, s."""

LAST_BYTES: Final = 1 << 16
"""Number of bytes read from the end of a record; they contain the open question."""

_BRISK: Final = OperatorSettings(mount_time_s=0.0, task_time_s=0.0, display_time_s=0.0, slip_probability=0.0)


class SimulatedHands:
    """Simulated hands that do the tasks of real runs in the folder `runs` at the simulated bench of `world`.

    They turn the head, mount the block and set a manual chamber, and report through `tell` what they did or what a
    display shows. A person answers the prompts. A head with an encoder turns at `CRANK_RAD_S` in real time.
    """

    def __init__(self, world: World, runs: Path, tell: Callable[[str], None], speed: float = 1.0) -> None:
        self._world, self._runs, self._tell, self._speed = world, runs, tell, speed
        self._operator = ScriptedOperator(world, _BRISK)
        self._done: dict[Path, int] = {}

    @contextmanager
    def working(self) -> Iterator[None]:
        """Do the tasks in a separate thread within this context."""
        over = threading.Event()

        def work() -> None:
            while not over.wait(LOOK_S):
                self.look()

        thread = threading.Thread(target=work, name="hands", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()

    def look(self) -> None:
        """Do the tasks of the prompts since the last call, but only the latest task of each kind."""
        for record in self._runs.glob(f"*/{EVENTS}"):
            if is_being_written(record.parent) and not Run(record.parent).simulated:
                for prompt in self._new_prompts(record):
                    with suppress(NoAnswer, KeyError):  # nothing to do, or an installation of another bench
                        self._do(prompt)

    def _new_prompts(self, record: Path) -> list[Prompt]:
        """Return the prompts in `record` since the last call, also those after an encoder's refused answer."""
        asked, put = OpenPrompt(), dict[str, Prompt]()
        with suppress(OSError, ValueError), open_regular(record) as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - LAST_BYTES))
            for line in file.readlines()[1 if size > LAST_BYTES else 0 :]:
                event, _ = parse_line(line)
                asked.take(event)
                of_encoder = event.type == EventType.ANSWER_REFUSED and event.data.get("where") == INSTRUMENT
                if asked.prompt is None or event.number <= self._done.get(record, 0):
                    continue
                self._done[record] = event.number
                if event.type == EventType.ASKED or of_encoder:
                    action = asked.prompt.prompt.action["do"]
                    put.pop(action, None)
                    put[action] = asked.prompt.prompt
        return list(put.values())

    def _do(self, prompt: Prompt) -> None:
        action = prompt.action
        if action["do"] == "turn":
            self._turn(action)
            self._tell(f"turned the head to {math.degrees(action['target_rad']):g}°")
        elif action["do"] not in ("answer", "confirm_reading", "wait"):
            answer_text = self._operator.ask(prompt).text
            read = action["do"].startswith("read_")
            self._tell(f"{action['do'].replace('_', ' ')}: {answer_text if read else 'done'}")

    def _turn(self, action: TurnHead) -> None:
        target_rad, direction = action["target_rad"], action["direction"]
        if "backoff_rad" not in action:
            self._world.turn(target_rad, direction)
            return
        speed_rad_s = CRANK_RAD_S / self._speed
        for end_rad in (target_rad - 1.5 * direction * action["backoff_rad"], target_rad):
            way_rad = abs(end_rad - self._world.scale_angle_rad)
            self._world.move_head(end_rad, speed_rad_s)
            self._world.clock.sleep(way_rad / speed_rad_s + LOOK_S * self._speed)
