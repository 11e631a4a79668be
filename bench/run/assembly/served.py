"""The composition root: drivers and simulation put together, with a person at the simulated bench."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Final

from bench.base.files import cache_folder
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.plan import Plan, Read
from bench.config.procedure.steps import in_scan_order, read_order
from bench.model import ForwardModel
from bench.readings.reading import Reading
from bench.readings.table import REFERENCE, SHORTED, scan_order
from bench.run.assembly.instruments import (
    Surroundings,
    buses_of,
    faults_of,
    instruments_of,
    on_terminals,
    operator_of,
    simulated_instruments,
    world_of,
)
from bench.run.commission.session import CommissioningPerson, CommissioningSession, WireWatch
from bench.run.events import Event, EventType
from bench.run.instruments import Instruments
from bench.run.person import NO, problem_with_answer
from bench.run.runner import Observer
from drivers.angles import parse_angle
from drivers.clock import Clock, Haste, SystemClock
from drivers.interfaces import BenchError, Voltmeter
from drivers.person import Answer, Person, Prompt, WatchingPerson
from drivers.wire.resources import Holding
from drivers.wire.visa import MessageSession, Wire
from sim.bench import SimulatedBench
from sim.control import BenchControl
from sim.wires.server import TERMINALS, TcpServer
from sim.wires.session import ServedInstrument as Wired
from sim.world.clock import ScaledClock, VirtualClock
from sim.world.operator import ScriptedOperator
from sim.world.world import World

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
    """A `drivers.interfaces.WatchingPerson`: `person` answers, and a scripted operator acts in the world.

    The head moves to the angle that the person reads from its scale. The question itself states what a
    display or the bubble of a level shows. In the world a task takes the scripted operator's time, not the
    person's.
    """

    def __init__(self, person: WatchingPerson, hands: ScriptedOperator) -> None:
        self._person = person
        self._hands = hands

    @property
    def meanwhile(self) -> Callable[[], None] | None:
        """The function that is called while a question waits."""
        return self._person.meanwhile

    @meanwhile.setter
    def meanwhile(self, look: Callable[[], None] | None) -> None:
        self._person.meanwhile = self._hands.meanwhile = look

    def ask(self, prompt: Prompt) -> Answer:
        """Ask the person, and do the task in the world. Raises the errors of the person's `ask`."""
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


HELD: Final = "instruments"
"""Name of the cache folder in which a program reserves the instruments that it has opened."""


@dataclass(frozen=True)
class Assembly:
    """A bench put together: instruments, the person who answers prompts, the clock, and the run's observers.

    `sessions` are those of the instruments with a wire; `simulated` is the simulated bench of a dry run.
    """

    instruments: Instruments
    person: Person
    clock: Clock
    observers: tuple[Observer, ...] = ()
    at_resumed_time: Callable[[float], None] | None = None
    sessions: Mapping[str, MessageSession] = field(default_factory=dict)
    simulated: SimulatedBench | None = None


def real_bench(
    bench: BenchFile, person: Person, wire: Wire | None = None, haste: Haste | None = None
) -> Assembly:
    """Return the real bench of a bench file; nothing is opened yet. Opening an instrument reserves it."""
    clock = SystemClock()
    given = Surroundings(
        person,
        clock,
        bench.line_frequency,
        wire,
        haste=haste,
        holding=Holding(cache_folder(HELD)),
    )
    return Assembly(instruments_of(bench, given), person, clock, sessions=given.sessions)


@contextmanager
def dry_bench(
    bench: BenchFile,
    model: ForwardModel,
    seed: int,
    wire: Wire | None = None,
    haste: Haste | None = None,
    *,
    plan: Plan | None = None,
    taken: Sequence[Reading] = (),
    living: WatchingPerson | None = None,
) -> Iterator[Assembly]:
    """Yield a simulated bench: the bench file's stand and block as truth, `model` with its effects.

    `living` is a person who answers in place of the scripted operator. From `plan` the world learns the order
    in which each step reads the channels. `taken` are the recorded readings of a resumed run, for effects
    that depend on earlier readings. Raises `BenchError` for a fault in the bench file that its instrument
    cannot have.
    """
    clock = VirtualClock()
    world = world_of(bench, model, seed, clock)
    scripted = ScriptedOperator(world, operator_of(bench))
    operator = scripted if living is None else LivingOperator(living, scripted)

    def key_world(event: Event) -> None:
        """Give the world the key of the present step, so that its random numbers belong to the step."""
        if event.type == EventType.STEP_STARTED:
            attempt = int(event.data["attempt"])
            key = str(event.data["key"])
            scan = scan_of(event.step, instruments.voltmeters)
            world.begin_step(key if attempt == 1 else f"{key}@{attempt}", scan)

    def scan_of(index: int, meters: Sequence[Voltmeter]) -> tuple[int, ...]:
        """Return the channels in the order in which a step reads them."""
        step = None if plan is None else plan.steps[index]
        return scan_order(read_order(in_scan_order(meters, step.scan if isinstance(step, Read) else "")))

    terminals = on_terminals(bench) if TERMINALS else ()
    with _simulated(bench, world, with_terminals=terminals) as simulated:
        ports = {name: simulated.terminals[name].resource for name in terminals}
        given = Surroundings(
            operator, clock, bench.line_frequency, wire, simulated.resources | ports, haste=haste
        )
        instruments = instruments_of(bench, given)
        _recall(world, taken)
        yield Assembly(
            instruments, operator, clock, (key_world,), clock.advance_to, given.sessions, simulated
        )


def _recall(world: World, taken: Sequence[Reading]) -> None:
    """Give a world the recorded readings, if an effect in it depends on earlier readings.

    Readings in a free position are left out, because their orientation is unknown.
    """
    for reading in taken if world.settings.model.needs_history else ():
        label, angle_deg = reading.installation, reading.angle_deg
        at_inputs = {SHORTED: 0.0, REFERENCE: reading.reference_v}
        if label not in at_inputs and (label not in world.settings.model.installations or angle_deg is None):
            continue
        world.recall(
            None if label in at_inputs else label,
            reading.series,
            math.radians(angle_deg or 0.0),
            reading.direction or None,
            reading.time_s or 0.0,
            block_c=reading.temperature_c,
            input_v=at_inputs.get(label),
            scan=scan_order(reading.scan_order),
        )


@dataclass(frozen=True)
class Serving:
    """A simulated bench as other programs see it: the addresses of its instruments and of its control."""

    instruments: tuple[Mapping[str, str | None], ...]
    control: str


@contextmanager
def served_bench(
    bench: BenchFile,
    model: ForwardModel,
    seed: int,
    *,
    speed: float = 1.0,
    host: str = "127.0.0.1",
    first_port: int = 0,
    with_terminals: bool = True,
) -> Iterator[Serving]:
    """Serve the wired instruments of a bench file, on a clock `speed` times as fast as the real one.

    Raises `BenchError` when a port is in use, or for a fault that its instrument cannot have.
    """
    simulated = _simulated(
        bench,
        world_of(bench, model, seed, ScaledClock(speed)),
        host=host,
        first_port=first_port,
        with_terminals=with_terminals and TERMINALS,
    )
    with simulated, TcpServer(Wired(BenchControl(simulated)), host=host) as control:
        yield Serving(tuple(simulated.addresses()), control.address)


def _simulated(
    bench: BenchFile,
    world: World,
    *,
    with_terminals: bool | tuple[str, ...],
    host: str = "127.0.0.1",
    first_port: int = 0,
) -> SimulatedBench:
    try:
        return SimulatedBench(
            world,
            simulated_instruments(bench, world),
            host=host,
            first_port=first_port,
            with_terminals=with_terminals,
            buses=buses_of(bench),
            faults=faults_of(bench),
        )
    except ValueError as error:
        raise BenchError("simulation", str(error), "mend the faults in the bench file") from error


TASK_TIME_S = 30.0
"""Time in which the scripted person pulls a cable, or sees that the head's way is clear, s."""


class ScriptedHand:
    """A `Person` at a simulated bench: pulls and plugs cables, leaves all else to the scripted operator."""

    def __init__(self, operator: Person, simulated: SimulatedBench) -> None:
        self._operator = operator
        self._world = simulated.world
        self._control = BenchControl(simulated)

    def ask(self, prompt: Prompt) -> Answer:
        """Do the task in the prompt and confirm it; other prompts go to the scripted operator."""
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


def real_evening(
    file: BenchFile, person: Person, log: Wire | None, haste: Haste | None = None
) -> CommissioningSession:
    """Return a commissioning session on a real bench; nothing is opened yet. `haste` cuts waiting short."""
    watch, heard = WireWatch(log), CommissioningPerson(person)
    assembly = real_bench(file, heard, watch, haste)
    watch.time_s = assembly.clock.now_s
    return _evening(file, assembly, heard, watch)


@contextmanager
def dry_evening(
    file: BenchFile, model: ForwardModel, seed: int, log: Wire | None, haste: Haste | None = None
) -> Iterator[CommissioningSession]:
    """Yield a commissioning session on the simulated bench of a bench file, with its scripted person.

    Its time is the simulated clock's plus the computer's: a fault that delays an answer takes the computer's
    time. Raises `BenchError` for a fault that its instrument cannot have.
    """
    watch = WireWatch(log)
    with dry_bench(file, model, seed, watch, haste) as assembly:
        simulated, clock, computer = assembly.simulated, assembly.clock, SystemClock()
        if simulated is None:
            raise BenchError("simulation", "there is no simulated bench", "start again")
        watch.time_s = lambda: clock.now_s() + computer.now_s()
        yield _evening(file, assembly, ScriptedHand(assembly.person, simulated), watch)


def _evening(file: BenchFile, assembly: Assembly, person: Person, watch: WireWatch) -> CommissioningSession:
    connections = {
        name: (lambda session=session: session.connection) for name, session in assembly.sessions.items()
    }
    return CommissioningSession(
        file,
        assembly.instruments,
        person,
        assembly.clock,
        watch.time_s,
        watch,
        connections,
        simulated=assembly.simulated is not None,
    )
