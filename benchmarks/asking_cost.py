"""What it costs a run that its questions are on record: a manual head asked at each setting, now and before.

Before: nothing of a question is recorded, and each event is waited for until it is on the disk, as it was before
questions stood in the record. Now: the same run as it is, each question and its answer on record. Somebody stands
for the terminal who answers at once. Instruments in memory, a virtual clock, the record on the disk of the working
folder, rounds taken in turn:

    python -m benchmarks.asking_cost
"""

from __future__ import annotations

import io
import statistics
import tempfile
import time
from pathlib import Path

from rich.console import Console

from bench.run import record as record_module
from bench.run.instruments import Instruments
from bench.run.listening import Asker
from bench.run.person import Who
from bench.run.record import Record
from bench.run.runner import People, Recorder, Runner
from bench.run.terminal import TerminalPerson
from bench.run.workbench import BenchSetup
from benchmarks.runner_cost import READINGS, Meter, plan
from drivers.clock import utc_now
from drivers.instruments.manual import ManualHead
from drivers.person import Answer, Prompt
from sim.world.clock import VirtualClock

LATER = record_module.WITH_THE_NEXT
ROUNDS = 3


class AtOnce(TerminalPerson):
    """Somebody at a terminal who answers before the question is shown: what is measured is the record."""

    def __init__(self) -> None:
        super().__init__(
            io.StringIO(), Console(file=io.StringIO()), who=Who("cost", "supervisor", "terminal")
        )

    def ask(self, prompt: Prompt) -> Answer:
        return Answer(prompt.id, "" if prompt.default else "yes")


def once(folder: Path, *, on_record: bool) -> tuple[float, float]:
    """Return wall and CPU time of a run per reading, s."""
    record_module.WITH_THE_NEXT = LATER if on_record else frozenset()  # type: ignore[misc]
    record = Record.create(folder, {}, {}, utc_now)
    person = AtOnce()
    asker = Asker(folder, record, lambda kind, data: None, terminal=person) if on_record else None
    asked = asker or person
    head = ManualHead("head", asked, tolerance_rad=1e-4)
    instruments = Instruments([Meter(c) for c in ("x", "y", "z")], head)
    begun, begun_cpu = time.perf_counter(), time.process_time()
    setup = BenchSetup(instruments, VirtualClock(), 10.0)
    Runner(plan(), setup, People(asked, asker=asker), Recorder(record)).run()
    spent = time.perf_counter() - begun, time.process_time() - begun_cpu
    record.close()
    return spent[0] / READINGS, spent[1] / READINGS


def main() -> None:
    found: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    with tempfile.TemporaryDirectory(dir=Path()) as folder:
        for number in range(ROUNDS):
            for on_record in (False, True):
                found[on_record].append(once(Path(folder) / f"{number}{on_record}", on_record=on_record))
    for name, column in (("wall", 0), ("CPU", 1)):
        without, with_ = (1e3 * statistics.median(one[column] for one in found[way]) for way in (False, True))
        ratio = statistics.median(
            b[column] / a[column] for a, b in zip(found[False], found[True], strict=True)
        )
        print(f"{name:4} per reading: {without:.3f} ms before, {with_:.3f} ms now; ratio {ratio:.2f}")


if __name__ == "__main__":
    main()
