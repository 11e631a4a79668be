"""Real and simulated benches, each assembled here from drivers, simulations and persons."""

from __future__ import annotations

import json
import math
import shlex
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from bench.base.files import cache_folder, open_regular
from bench.base.languages import message
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.plan import Plan, Read
from bench.config.procedure.steps import in_scan_order, read_order
from bench.model import ForwardModel
from bench.readings.table import REFERENCE, SHORTED, Reading, scan_order
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
from bench.run.commission.session import CommissioningPerson, CommissioningSession, PersonBehind, WireWatch
from bench.run.events import EVENTS, Event, EventType
from bench.run.folder import Run
from bench.run.instruments import Instruments
from bench.run.person import INSTRUMENT, NO, OpenPrompt, problem_with_answer
from bench.run.record import is_being_written, parse_line
from bench.run.runner import Observer
from drivers.angles import typed_angle
from drivers.clock import Clock, Haste, SystemClock
from drivers.interfaces import BenchError, NoAnswer, Voltmeter
from drivers.person import Answer, Person, Prompt, PromptKind, TurnHead, WatchingPerson
from drivers.wire.resources import Holding
from drivers.wire.visa import MessageSession, Wire
from sim.bench import SimulatedBench
from sim.control import CRANK_RAD_S, BenchControl
from sim.wires.server import TERMINALS, TcpServer
from sim.wires.session import ServedInstrument as Wired
from sim.world.clock import ScaledClock, VirtualClock
from sim.world.operator import OperatorSettings, ScriptedOperator
from sim.world.world import World

_LOOKED_AT: Final = frozenset({"read_temperature", "read_head", "read_level", "read_supply"})
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
    """A `drivers.interfaces.WatchingPerson`: a real person answers, a scripted operator does the simulated tasks.

    The simulated head moves to the angle that the person reports. A prompt to read a display or a level's bubble
    contains the value shown. In the simulated world, a task takes as long as the scripted operator needs for it.
    """

    def __init__(self, person: WatchingPerson, hands: ScriptedOperator) -> None:
        self._person = person
        self._hands = hands

    @property
    def meanwhile(self) -> Callable[[], None] | None:
        """The function called repeatedly while a prompt is open."""
        return self._person.meanwhile

    @meanwhile.setter
    def meanwhile(self, look: Callable[[], None] | None) -> None:
        self._person.meanwhile = self._hands.meanwhile = look

    def ask(self, prompt: Prompt) -> Answer:
        """Ask the person and carry out the task in the simulated world; return the person's answer.

        If the task is to read a display, the prompt contains the displayed value. If the task is to turn a head
        with an encoder, the scripted operator answers; with a hands-free encoder, that operator turns the head
        while the question is open. After an invalid answer or a "no", the task is not carried out. Raises the
        errors of the person's `ask`.
        """
        action = prompt.action
        if action["do"] in _LOOKED_AT:
            seen = self._hands.ask(prompt).text
            return self._person.ask(
                replace(prompt, text=f"{prompt.text} {message(f'(Simulated: it shows {seen}.)')}")
            )
        if action["do"] == "turn" and action.get("hands_free"):
            return self._turned_meanwhile(prompt)
        answer = self._person.ask(prompt)
        if answer.prompt_id != prompt.id or problem_with_answer(prompt, answer.text):
            return answer  # invalid, so the caller asks again
        if action["do"] == "turn":
            typed = answer.text.strip() or prompt.default or ""
            if prompt.kind is PromptKind.CONFIRM:  # an encoder reads the angle while the hands turn the head
                return self._hands.ask(prompt) if typed.lower() not in NO else answer
            angle_rad = typed_angle(typed, action["target_rad"])
            self._hands.turn_to(prompt.id, angle_rad, action["direction"], action.get("backoff_rad"))
        elif action["do"] in _DONE and answer.text.strip().lower() not in NO:
            self._hands.ask(prompt)
        return answer

    def _turned_meanwhile(self, prompt: Prompt) -> Answer:
        """Show the prompt to the person while the operator turns the head, until the encoder ends the prompt."""

        def turn() -> None:
            self._hands.ask(prompt)

        look, self._person.meanwhile = self._person.meanwhile, turn
        try:
            return self._person.ask(prompt)
        finally:
            self._person.meanwhile = look


HELD: Final = "instruments"
"""Name of the cache folder in which programs reserve the instruments that they have opened."""


def held_instruments() -> Holding:
    """Return the object that reserves instruments; all programs of this user share the reservations."""
    return Holding(cache_folder(HELD))


@dataclass(frozen=True)
class Assembly:
    """An assembled bench: instruments, the person who answers prompts, the clock, and observers of the run.

    `sessions` are the sessions of the wired instruments; `simulated` is the simulated bench of a dry run. `aside`
    returns a context in which readings do not change the simulated world. `at_resumed_time` sets the simulated
    clock to the bench time at which a run is resumed, s.
    """

    instruments: Instruments
    person: Person
    clock: Clock
    observers: tuple[Observer, ...] = ()
    at_resumed_time: Callable[[float], None] | None = None
    sessions: Mapping[str, MessageSession] = field(default_factory=dict)
    simulated: SimulatedBench | None = None
    aside: Callable[[], AbstractContextManager[None]] = nullcontext


def real_bench(
    bench: BenchFile, person: Person, wire: Wire | None = None, haste: Haste | None = None
) -> Assembly:
    """Return the real bench of a bench file without opening anything. Opening an instrument reserves it."""
    clock = SystemClock()
    given = Surroundings(
        person,
        clock,
        bench.line_frequency,
        wire,
        haste=haste,
        holding=held_instruments(),
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
    """Yield the simulated bench of a bench file: instruments and operator in the world that `world_of` returns.

    `living` is a person who answers instead of the scripted operator. `plan` states the order in which each
    step reads the channels. `taken` are the recorded readings of a resumed run, for effects that depend on
    earlier readings. Raises `BenchError` if the bench file contains a fault that its instrument cannot have.
    """
    clock = VirtualClock()
    world = world_of(bench, model, seed, clock)
    scripted = ScriptedOperator(world, operator_of(bench))
    operator = scripted if living is None else LivingOperator(living, scripted)

    def key_world(event: Event) -> None:
        """Pass the present step's key to the world, whose random numbers then depend on the step alone."""
        if event.type == EventType.STEP_STARTED:
            attempt = int(event.data["attempt"])
            key = str(event.data["key"])
            scan = scan_of(event.step, instruments.voltmeters)
            world.begin_step(key if attempt == 1 else f"{key}@{attempt}", scan)

    def scan_of(index: int, meters: Sequence[Voltmeter]) -> tuple[int, ...]:
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
            instruments,
            operator,
            clock,
            (key_world,),
            clock.advance_to,
            given.sessions,
            simulated,
            simulated.aside,
        )


def _recall(world: World, taken: Sequence[Reading]) -> None:
    """Pass the recorded readings to a world, if an effect in it depends on earlier readings.

    Readings in a free position are omitted, because their orientation is unknown.
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


LOOK_S: Final = 0.2
"""Interval at which the folder of runs is searched for new prompts, s."""

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
        """Do the tasks asked for since the last call; of several tasks of a kind in a run, only the latest."""
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


@dataclass(frozen=True)
class Serving:
    """A simulated bench as other programs see it: the addresses of its instruments and of its control port."""

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
    hands: Path | None = None,
    tell: Callable[[str], None] = print,
) -> Iterator[Serving]:
    """Serve the simulated wired instruments on the network, with a clock `speed` times as fast as real time.

    `hands` is a folder of runs for which simulated hands turn the head and mount the block; `tell` prints what
    they did. Raises `BenchError` if a port is in use, or for a fault that its instrument cannot have.
    """
    world = world_of(bench, model, seed, ScaledClock(speed))
    simulated = _simulated(
        bench,
        world,
        host=host,
        first_port=first_port,
        with_terminals=with_terminals and TERMINALS,
    )
    helped = nullcontext() if hands is None else SimulatedHands(world, hands, tell, speed).working()
    with simulated, TcpServer(Wired(BenchControl(simulated)), host=host) as control, helped:
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
            adapter_options=bench.simulation.adapter.model_dump(),
            faults=faults_of(bench),
        )
    except ValueError as error:
        cause, _, remedy = str(error).partition("; ")
        raise BenchError(
            "simulation", cause, remedy or message("correct the faults in the bench file")
        ) from error


TASK_TIME_S = 30.0
"""Time that the scripted person needs to pull a cable, or to check that the head's path is clear, s."""


class ScriptedHand(PersonBehind):
    """A person at a simulated bench who handles cables; the scripted operator `person` does all other tasks."""

    def __init__(self, person: Person, simulated: SimulatedBench) -> None:
        super().__init__(person)
        self._world = simulated.world
        self._control = BenchControl(simulated)

    def ask(self, prompt: Prompt) -> Answer:
        """Carry out the task in the prompt and confirm it; other prompts go to the scripted operator."""
        action = prompt.action
        if action["do"] == "cable":
            word = "accept" if action["plugged"] else "refuse"
            self._tell(f"{word} {shlex.quote(action['instrument'])}")
        elif action["do"] != "stand_clear":
            return self._person.ask(prompt)
        self._world.clock.sleep(TASK_TIME_S)
        return Answer(prompt.id, "yes")

    def _tell(self, command: str) -> None:
        reply = json.loads(self._control.handle(command.encode(), lambda: False) or b"{}")
        if not reply.get("ok"):
            raise BenchError("simulation", f"'{command}' failed ({reply.get('error')})", "start again")


def real_evening(
    file: BenchFile, person: Person, log: Wire | None, haste: Haste | None = None
) -> CommissioningSession:
    """Return a commissioning session on a real bench; nothing is opened yet. `haste` shortens waiting times."""
    watch, watched_person = WireWatch(log), CommissioningPerson(person)
    assembly = real_bench(file, watched_person, watch, haste)
    watch.time_s = assembly.clock.now_s
    return _evening(file, assembly, watched_person, watch)


@contextmanager
def dry_evening(
    file: BenchFile, model: ForwardModel, seed: int, log: Wire | None, haste: Haste | None = None
) -> Iterator[CommissioningSession]:
    """Yield a commissioning session on the simulated bench of a bench file, with a scripted person.

    The session's time is simulated time plus the computer's time, because a simulated fault delays responses in
    real time. Raises `BenchError` for a fault that its instrument cannot have.
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
