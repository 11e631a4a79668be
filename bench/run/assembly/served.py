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


HELD: Final = "instruments"
"""The part of the cache folder in which a program holds the instruments that it has opened."""


@dataclass(frozen=True)
class Assembly:
    """A bench put together: instruments, who answers prompts, the clock, and who watches the run.

    `sessions` are those of the instruments with a wire, `simulated` the bench behind them where it is a dry one.
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
    """Put the bench of a bench file together; nothing is opened yet, and what is opened is held."""
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
    """Put a simulated bench together: the bench file's stand and block as truth, `model` with its effects.

    `living` is a person who answers in place of the scripted operator.

    Of the steps of `plan` the world learns in which order they read the channels. `taken` are the readings on
    record of a run to be resumed: effects look back to them.
    Raises `BenchError` for a fault in the bench file that its instrument cannot have.
    """
    clock = VirtualClock()
    world = world_of(bench, model, seed, clock)
    scripted = ScriptedOperator(world, operator_of(bench))
    operator = scripted if living is None else LivingOperator(living, scripted)

    def key_world(event: Event) -> None:
        """Tell the world which step goes on, so that its random numbers belong to the step."""
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
    """Tell a world the readings on record, where an effect in it looks back to them.

    A free position, of which nobody knows how it was, is none to it.
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
    """A simulated bench as other programs see it: who is where, and where it is controlled."""

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
    """Serve the instruments of a bench file that have a wire, on a clock `speed` times the real one's.

    Raises `BenchError` when a port is taken, or for a fault that its instrument cannot have.
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


def real_evening(
    file: BenchFile, person: Person, log: Wire | None, haste: Haste | None = None
) -> CommissioningSession:
    """Return an evening on the bench of a bench file; nothing is opened yet. `haste` cuts waiting short."""
    watch, heard = WireWatch(log), CommissioningPerson(person)
    assembly = real_bench(file, heard, watch, haste)
    watch.time_s = assembly.clock.now_s
    return _evening(file, assembly, heard, watch)


@contextmanager
def dry_evening(
    file: BenchFile, model: ForwardModel, seed: int, log: Wire | None, haste: Haste | None = None
) -> Iterator[CommissioningSession]:
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
