"""A bench for commissioning: the real one, or a simulated one whose scripted person pulls cables, too."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager

from bench.config.bench_file.file import BenchFile
from bench.model import ForwardModel
from bench.run.assembly.served import Assembly, dry_bench, real_bench
from bench.run.commission.session import Evening, Listening, Wire, WireWatch
from drivers.clock import SystemClock
from drivers.interfaces import Answer, BenchError, Person, Prompt
from drivers.wire.causes import Haste
from sim.bench import SimulatedBench
from sim.wires.control import BenchControl

TASK_TIME_S = 30.0
"""How long the scripted person takes to pull a cable, or to see that a way is clear."""


class ScriptedHand:
    """A `Person` at a simulated bench: pulls and plugs cables, leaves all else to the scripted operator."""

    def __init__(self, operator: Person, simulated: SimulatedBench) -> None:
        self._operator = operator
        self._world = simulated.world
        self._control = BenchControl(simulated)

    def ask(self, prompt: Prompt) -> Answer:
        """Do what is asked, and say so."""
        action = prompt.action
        if action["do"] == "cable":
            word = "accept" if action["plugged"] else "refuse"
            self._tell(f"{word} {shlex.quote(action['instrument'])}")
        elif action["do"] != "stand_clear":
            return self._operator.ask(prompt)
        self._world.clock.sleep(TASK_TIME_S)
        return Answer(prompt.id, "yes")

    def _tell(self, command: str) -> None:
        reply = json.loads(self._control.handle(command.encode(), lambda: False) or b"{}")
        if not reply.get("ok"):
            raise BenchError("simulation", str(reply.get("error")), "start again")


def real_evening(file: BenchFile, person: Person, log: Wire | None, haste: Haste | None = None) -> Evening:
    """Return an evening on the bench of a bench file; nothing is opened yet. `haste` cuts waiting short."""
    watch, heard = WireWatch(log), Listening(person)
    assembly = real_bench(file, heard, watch, haste)
    watch.time_s = assembly.clock.now_s
    return _evening(file, assembly, heard, watch)


@contextmanager
def dry_evening(
    file: BenchFile, model: ForwardModel, seed: int, log: Wire | None, haste: Haste | None = None
) -> Iterator[Evening]:
    """Yield an evening on the simulated bench of a bench file, with its scripted person.

    Time is that of its clock, and what the wires take on the computer on top of that: a fault that makes an
    answer late does so in the computer's time. Raises `BenchError` for a fault that its instrument cannot have.
    """
    watch = WireWatch(log)
    with dry_bench(file, model, seed, watch, haste) as assembly:
        simulated, clock, computer = assembly.simulated, assembly.clock, SystemClock()
        if simulated is None:
            raise BenchError("simulation", "there is no simulated bench", "start again")
        watch.time_s = lambda: clock.now_s() + computer.now_s()
        yield _evening(file, assembly, ScriptedHand(assembly.person, simulated), watch)


def _evening(file: BenchFile, assembly: Assembly, person: Person, watch: WireWatch) -> Evening:
    connections = {
        name: (lambda session=session: session.connection) for name, session in assembly.sessions.items()
    }
    return Evening(
        file,
        assembly.instruments,
        person,
        assembly.clock,
        watch.time_s,
        watch,
        connections,
        simulated=assembly.simulated is not None,
    )
