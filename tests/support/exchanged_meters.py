"""Files of runs of one block whose voltmeters were exchanged between the channels."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from bench.readings.csv import write_csv
from bench.readings.table import Readings
from bench.run.events import sha256
from bench.services.bench_selection import BenchOrigin, Origin, UnitOrigin
from bench.validation.paper_bench import ARCSEC
from tests.support.learning_bench import Bench, Runs, simulate

SHIPPED = Path(__file__).parents[2] / "config" / "paper-stand.yaml"
TRUTH = Bench(
    np.array([1.0, -1.2, 12.0, 0.0]) * ARCSEC, np.array([0.8, 0.8, 4.0, 4.0]) * ARCSEC,
    np.array([2e-5, 2e-5, 2e-5]), 1.0 * ARCSEC,
)  # fmt: skip
GAIN = {"22": 15e-6, "23": -12e-6, "24": 4e-6}
"""The true gain of the meter at each address."""
STEADY = """
uncertainty:
  temperature: {limit: 0.05 K, distribution: rectangular}
  bias_temperature_coefficient: {limit: 3 ug/K, distribution: rectangular}
  scale_temperature_coefficient: {limit: 3 ppm/K, distribution: rectangular}
"""
"""A chamber and a block that do not hide what the meters do."""


def bench_text(order: str, learned: str = "") -> str:
    """Return a bench file with the meters at addresses 22, 23, 24 on the channels `order`, such as "yzx"."""
    text = SHIPPED.read_text(encoding="utf-8")
    for was, channel in zip("xyz", order, strict=True):
        address = {"x": "22", "y": "23", "z": "24"}[was]
        text = text.replace(
            f'channels: [{was}], resource: "GPIB0::{address}',
            f'channels: [{channel}], resource: "GPIB0::{address}',
        )
    return (f"learned: {learned}\n" if learned else "") + text + STEADY


def of_one_block(rng: np.random.Generator, runs: int) -> Runs:
    """Simulate runs that all have the same block."""
    made = simulate(rng, TRUTH, runs)
    for r in range(1, runs):
        force = np.linalg.solve(made.truths[r, :9].reshape(3, 3), (made.signals[r] - made.truths[r, 9:]).T).T
        made.signals[r] = force @ made.truths[0, :9].reshape(3, 3).T + made.truths[0, 9:]
    made.truths[:] = made.truths[0]
    return made


def leave(
    name: str, table: Readings, order: str, begun: datetime, bench: str | None = None, serial: str = "7"
) -> str:
    """Write a readings file with the gains of its meters, its origin and its bench file; return its name."""
    text = bench_text(order) if bench is None else bench
    file = Path(f"bench-{name}.yaml").absolute()
    file.write_text(text, encoding="utf-8")
    address = dict(zip(order, ("22", "23", "24"), strict=True))
    table.signal[:] *= 1.0 + np.array([GAIN[address[c]] for c in "xyz"])
    path = Path(f"{name}.csv")
    write_csv(table, path)
    origin = Origin(
        simulated=True, run=name, begun=begun.isoformat(), operator="A", procedure="paper", plan_hash="1",
        unit_under_test=UnitOrigin(type="block", serial=serial),
        bench=BenchOrigin(file=str(file), copied_to=str(file), sha256=sha256(file.read_bytes())),
        instruments={f"voltmeter.{c}": "HEWLETT-PACKARD 34401A 0 11-5-2" for c in "xyz"},
        measured_with={},
    )  # fmt: skip
    path.with_name(path.name + ".json").write_text(
        origin.text_beside(path, path.read_bytes()), encoding="utf-8"
    )
    return path.name


def today(days: float = 0.0) -> datetime:
    """Return the current time plus `days`."""
    return datetime.now(UTC) + timedelta(days=days)
