"""Shipped bench files with edited texts, and their dry runs, composed and ready to be opened."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from bench.base.arrays import CHANNELS
from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.shipped import find_bench
from bench.model import ForwardModel
from bench.run.assembly.served import Assembly, dry_bench
from bench.run.instruments import Instruments, leave_safe
from drivers.interfaces import Channel, VoltmeterSettings

READING = VoltmeterSettings(10.0, 1.0, 3)

Change = tuple[str, str]


def edited(folder: Path, name: str, *changes: Change) -> BenchFile:
    """Return a shipped bench file after replacements (old, new) in its text; each old text must occur."""
    text = find_bench(name).read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    path = folder / "bench.yaml"
    path.write_text(text, encoding="utf-8")
    return load_bench(path)


@contextmanager
def composing(folder: Path) -> Iterator[Callable[..., tuple[BenchFile, Assembly]]]:
    """Yield a function that returns an edited bench and its dry run's assembly; at the end, make all safe."""
    with ExitStack() as stack:

        def compose(name: str, *changes: Change) -> tuple[BenchFile, Assembly]:
            bench = edited(folder, name, *changes)
            model = ForwardModel(bench.installation_models())
            assembly = stack.enter_context(dry_bench(bench, model, seed=1))
            stack.callback(leave_safe, assembly.instruments, None)
            return bench, assembly

        yield compose


def read(instruments: Instruments) -> np.ndarray:
    """Return the mean of each signal, V."""
    for meter in instruments.voltmeters:
        meter.configure(READING)
    for meter in instruments.voltmeters:
        meter.start()
    fetched: dict[Channel, tuple[float, ...]] = {}
    for meter in instruments.voltmeters:
        fetched |= meter.fetch()
    return np.array([np.mean(fetched[channel]) for channel in CHANNELS])
