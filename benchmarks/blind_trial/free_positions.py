"""Free positions of the trial: a sensor at rest in all orientations, with its own matrix, zeros and effects.

U = S (a + e) + b with |a| = 1: S is a full matrix, a has no preferred direction, and e is the hidden effect,
g. The visibility rho of e is the size of the part of e that nine coefficients cannot absorb, in units of the
noise of |a|.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.readings.table import Readings, make_readings
from benchmarks.blind_trial.stand import Floats

DESIGN: Final = "free"
POSITIONS: Final = 60
RECORDS: Final = 4
OF_A_RECORD: Final = 25
NOISE_G: Final = 100e-6
COUNTS_PER_G: Final = 2050.0
PACE_S: Final = 40.0
LAG_S: Final = 240.0
OUTLIER: Final = (20.0, 60.0)
"""Error of a position that was not at rest, in units of the noise: least and largest."""


@dataclass(frozen=True)
class Positions:
    """Records (m,) of positions (n, 3) on the sensor's axes, g, with their times, s, and temperatures, K."""

    force: tuple[Floats, ...]
    time_s: tuple[Floats, ...]
    warmth_k: tuple[Floats, ...]


@dataclass(frozen=True)
class FreeTruth:
    """A hidden effect: its name, its channels, and its addition to a in each record, g."""

    name: str
    channels: tuple[int, ...]
    added: tuple[Floats, ...]


def _positions(rng: np.random.Generator, records: int, count: int) -> Positions:
    force, time_s, warmth = [], [], []
    for _ in range(records):
        a = rng.standard_normal((count, 3))
        force.append(a / np.linalg.norm(a, axis=1)[:, None])
        t = np.cumsum(PACE_S * rng.uniform(0.7, 1.3, count))
        time_s.append(t)
        turn, phase = rng.choice([-1.0, 1.0]), rng.uniform(0, 2 * np.pi)
        warmth.append(turn * 3.0 * t / t[-1] + 1.5 * np.sin(2 * np.pi * t / 900.0 + phase))
    return Positions(tuple(force), tuple(time_s), tuple(warmth))


# --- effects that may be hidden --------------------------------------------------------------------------


def _of_channel(rng: np.random.Generator, name: str, columns: list[Floats]) -> FreeTruth:
    channel = int(rng.integers(3))
    sign = rng.choice([-1.0, 1.0])
    added = tuple(sign * column[:, channel : channel + 1] * np.eye(3)[channel] for column in columns)
    return FreeTruth(name, (channel,), added)


def _drift(rng: np.random.Generator, of: Positions) -> FreeTruth:
    columns = [np.tile(((t / t[-1]) ** 1.15)[:, None], 3) for t in of.time_s]
    return _of_channel(rng, "bias_drift", columns)


def _warm_up(rng: np.random.Generator, of: Positions) -> FreeTruth:
    columns = [0.7 * np.exp(-t / 300.0) + 0.3 * np.exp(-t / 1000.0) for t in of.time_s]
    return _of_channel(rng, "warm_up", [np.tile(one[:, None], 3) for one in columns])


def _square(rng: np.random.Generator, of: Positions) -> FreeTruth:
    return _of_channel(rng, "quadratic_nonlinearity", [a**2 * (1 + 0.1 * a) for a in of.force])


def _cube(rng: np.random.Generator, of: Positions) -> FreeTruth:
    return _of_channel(rng, "cubic_nonlinearity", [a**3 + 0.15 * a**5 for a in of.force])


def _temperature(rng: np.random.Generator, of: Positions) -> FreeTruth:
    columns = []
    for t, warmth in zip(of.time_s, of.warmth_k, strict=True):
        seen = np.zeros(len(t))
        for i in range(1, len(t)):
            part = 1.0 - np.exp(-(t[i] - t[i - 1]) / LAG_S)
            seen[i] = seen[i - 1] + part * (warmth[i] - seen[i - 1])
        columns.append(np.tile(seen[:, None], 3))
    return _of_channel(rng, "thermal_bias", columns)


def _zeros(rng: np.random.Generator, of: Positions) -> FreeTruth:
    """Return zeros of all channels that differ from record to record."""
    added = tuple(np.tile(rng.standard_normal(3), (len(a), 1)) for a in of.force)
    return FreeTruth("zeros_by_run", (0, 1, 2), added)


def _outlier(rng: np.random.Generator, of: Positions) -> FreeTruth:
    """Return the effect of one position that was read while the sensor moved: an error along a."""
    added = [np.zeros_like(a) for a in of.force]
    row = int(rng.integers(len(added[0])))
    size = rng.choice([-1.0, 1.0]) * rng.uniform(*OUTLIER) * NOISE_G
    added[0][row] = size * of.force[0][row]
    return FreeTruth("outlier", (), tuple(added))


FREE: Final[dict[str, Callable[[np.random.Generator, Positions], FreeTruth] | None]] = {
    "free:null": None, "free:null records": None, "free:drift": _drift, "free:warm_up": _warm_up,
    "free:square": _square, "free:cube": _cube, "free:temperature": _temperature, "free:zeros": _zeros,
    "free:outlier": _outlier,
}  # fmt: skip
SEVERAL: Final = ("free:zeros", "free:null records")
"""Kinds of cases with several records."""


def free_tables(
    rng: np.random.Generator, kind: str, rho: float | None
) -> tuple[tuple[Readings, ...], FreeTruth | None, float]:
    """Return the records of a case, the effect hidden in them, and its rho: as requested, or random if None."""
    records, count = (RECORDS, OF_A_RECORD) if kind in SEVERAL else (1, POSITIONS)
    of = _positions(rng, records, count)
    matrix = COUNTS_PER_G * (np.eye(3) * (1 + rng.normal(0, 0.01, 3)) + rng.normal(0, 0.01, (3, 3)))
    zero = COUNTS_PER_G * rng.normal(0, 0.03, 3)
    draw = FREE[kind]
    truth = None if draw is None else draw(rng, of)
    size = 0.0
    added = [np.zeros_like(a) for a in of.force]
    if truth is not None:
        unscaled = _rho(of, truth.added)
        factor = 1.0 if rho is None else rho / unscaled
        added, size = [factor * one for one in truth.added], factor * unscaled
    tables = []
    for number, (a, e) in enumerate(zip(of.force, added, strict=True)):
        noise = rng.normal(0, NOISE_G, a.shape)
        signal = (a + e + noise) @ matrix.T + zero
        tables.append(
            make_readings(
                ["F"] * len(a),
                [1] * len(a),
                list(range(1, len(a) + 1)),
                np.full(len(a), np.nan),
                np.round(signal, 4),
                source=f"record {number + 1}",
                unit="counts",
                time_s=np.round(of.time_s[number], 2),
                temperature_c=np.round(23.0 + of.warmth_k[number], 3),
            )
        )
    return tuple(tables), truth, size


def _rho(of: Positions, added: tuple[Floats, ...]) -> float:
    """Return the size of an effect on |a| that a matrix and zeros cannot absorb, in units of the noise of |a|."""
    a, e = np.concatenate(of.force), np.concatenate(added)
    moved = np.sum(a * e, axis=1)
    columns = np.column_stack([(a[:, :, None] * a[:, None, :]).reshape(len(a), 9), a])
    left = moved - columns @ np.linalg.lstsq(columns, moved, rcond=None)[0]
    return float(np.linalg.norm(left) / NOISE_G)
