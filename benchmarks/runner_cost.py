"""What the runner itself costs per reading, record included, beside an fsync of the same disk in the same run.

Instruments in memory that answer at once, a virtual clock, the record on the disk of the working folder:

    python -m benchmarks.runner_cost
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

from bench.config.procedure.plan import Mount, Plan, Read, Turn
from bench.run.instruments import Instruments
from bench.run.record import Record
from bench.run.runner import People, Recorder, Runner
from bench.run.workbench import BenchSetup
from drivers.clock import utc_now
from drivers.interfaces import Channel, Direction, HeadPosition, Identity, VoltmeterSettings
from drivers.person import Answer, Prompt
from sim.world.clock import VirtualClock

READINGS = 500


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


class Person:
    """Somebody who agrees."""

    def ask(self, prompt: Prompt) -> Answer:
        return Answer(prompt.id, "yes")


def plan() -> Plan:
    """A turn and a reading, many times."""
    steps: list[Mount | Turn | Read] = [Mount("m", "1", 1)]
    for n in range(READINGS):
        steps.append(Turn(f"t{n}", "1", 1, 1, n + 1, 0.01 * n, 1))
        steps.append(Read(f"r{n}", "1", 1, 1, n + 1, 0.01 * n, 1, 10, 10.0))
    return Plan("cost", tuple(steps), "")


def main() -> None:
    with tempfile.TemporaryDirectory(dir=Path()) as folder:
        begun = time.perf_counter()
        with (Path(folder) / "probe").open("ab", buffering=0) as probe:
            for _ in range(READINGS):
                probe.write(b"x" * 600)
                os.fsync(probe.fileno())
        fsync_s = (time.perf_counter() - begun) / READINGS
        record = Record.create(Path(folder) / "run", {}, {}, utc_now)
        instruments = Instruments([Meter(c) for c in ("x", "y", "z")], Head())
        begun = time.perf_counter()
        begun_cpu = time.process_time()
        Runner(
            plan(), BenchSetup(instruments, VirtualClock(), 10.0), People(Person()), Recorder(record)
        ).run()
        wall_s, cpu_s = time.perf_counter() - begun, time.process_time() - begun_cpu
        record.close()
    print(f"fsync of 600 bytes        {1e3 * fsync_s:7.3f} ms")
    print(f"runner, wall, per reading {1e3 * wall_s / READINGS:7.3f} ms (a turn and a reading: four events)")
    print(f"runner, CPU, per reading  {1e3 * cpu_s / READINGS:7.3f} ms")


if __name__ == "__main__":
    main()
