"""What the runner costs per reading, and what it costs a run that its questions are on record.

Instruments in memory that answer at once, a virtual clock, the record on the disk of the working folder. In turn:
a head that turns by itself; a manual head asked at each setting, as it was before questions stood in the record
(nothing of a question is recorded, each event is waited for until it is on the disk); the same as it is now, each
question and its answer on record. Beside them an fsync of the same disk. Somebody at the terminal answers at once:

    python -m benchmarks.asking_cost
"""

from __future__ import annotations

import io
import os
import statistics
import tempfile
import time
from pathlib import Path

from rich.console import Console

from bench.config.procedure.plan import Plan
from bench.config.procedure.steps import Mount, Read, Turn
from bench.run import record as record_module
from bench.run.instruments import Instruments
from bench.run.listening import Asker
from bench.run.person import WishAuthor
from bench.run.record import Record
from bench.run.runner import People, Recorder, Runner
from bench.run.terminal import TerminalPerson
from bench.run.workbench import BenchSetup
from drivers.clock import utc_now
from drivers.instruments.manual import ManualHead
from drivers.interfaces import Channel, Direction, HeadPosition, Identity, VoltmeterSettings
from drivers.person import Answer, Prompt
from sim.world.clock import VirtualClock

LATER = record_module.WITH_THE_NEXT
READINGS, ROUNDS = 500, 3
WAYS = ("nothing asked", "asked, before", "asked, now")


class Meter:
    """A voltmeter that answers at once."""

    def __init__(self, channel: Channel) -> None:
        self.name = f"voltmeter.{channel}"
        self.channels: tuple[Channel, ...] = (channel,)

    def open(self) -> Identity:
        return Identity("none", "none")

    def close(self) -> None: ...

    def configure(self, settings: VoltmeterSettings) -> None: ...

    def start(self) -> None: ...

    def fetch(self) -> dict[Channel, tuple[float, ...]]:
        return {self.channels[0]: tuple(1.0 + 1e-6 * i for i in range(10))}


class Head:
    """A head that is there at once."""

    name = "head"

    def open(self) -> Identity:
        return Identity("none", "none")

    def close(self) -> None: ...

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        return HeadPosition(target_rad, direction)


class AtOnce(TerminalPerson):
    """Somebody at a terminal who answers before the question is shown: what is measured is the record."""

    def __init__(self) -> None:
        super().__init__(
            io.StringIO(), Console(file=io.StringIO()), who=WishAuthor("cost", "supervisor", "terminal")
        )

    def ask(self, prompt: Prompt) -> Answer:
        return Answer(prompt.id, "" if prompt.default else "yes")


def plan() -> Plan:
    """A turn and a reading, many times."""
    steps: list[Mount | Turn | Read] = [Mount("m", "1", 1)]
    for n in range(READINGS):
        steps.append(Turn(f"t{n}", "1", 1, 1, n + 1, 0.01 * n, 1))
        steps.append(Read(f"r{n}", "1", 1, 1, n + 1, 0.01 * n, 1, 10, 10.0))
    return Plan("cost", tuple(steps), "")


def once(folder: Path, way: str) -> tuple[float, float]:
    """Return wall and CPU time of a run per reading, ms."""
    record_module.WITH_THE_NEXT = frozenset() if way == WAYS[1] else LATER  # type: ignore[misc]
    record = Record.create(folder, {}, {}, utc_now)
    person = AtOnce()
    asker = Asker(folder, record, lambda kind, data: None, terminal=person) if way == WAYS[2] else None
    asked = asker or person
    head = Head() if way == WAYS[0] else ManualHead("head", asked, tolerance_rad=1e-4)
    instruments = Instruments([Meter(c) for c in ("x", "y", "z")], head)
    begun, begun_cpu = time.perf_counter(), time.process_time()
    setup = BenchSetup(instruments, VirtualClock(), 10.0)
    Runner(plan(), setup, People(asked, asker=asker), Recorder(record)).run()
    spent = time.perf_counter() - begun, time.process_time() - begun_cpu
    record.close()
    return 1e3 * spent[0] / READINGS, 1e3 * spent[1] / READINGS


def fsync_ms(folder: Path) -> float:
    """Return how long the disk takes for 600 bytes, ms."""
    begun = time.perf_counter()
    with (folder / "probe").open("ab", buffering=0) as probe:
        for _ in range(READINGS):
            probe.write(b"x" * 600)
            os.fsync(probe.fileno())
    return 1e3 * (time.perf_counter() - begun) / READINGS


def main() -> None:
    found: dict[str, list[tuple[float, float]]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory(dir=Path()) as folder:
        print(f"fsync of 600 bytes: {fsync_ms(Path(folder)):.3f} ms")
        for number in range(ROUNDS):
            for k, way in enumerate(WAYS):
                found[way].append(once(Path(folder) / f"{number}-{k}", way))
    for column, name in enumerate(("wall", "CPU")):
        medians = [f"{statistics.median(one[column] for one in found[way]):.3f} ms {way}" for way in WAYS]
        pairs = zip(found[WAYS[1]], found[WAYS[2]], strict=True)
        ratio = statistics.median(after[column] / before[column] for before, after in pairs)
        print(f"{name:4} per reading: {', '.join(medians)}; now to before {ratio:.2f}")


if __name__ == "__main__":
    main()
