"""Many runs of one bench with known truth: stand errors common to all runs, and those of each mounting.

Nothing of `bench.model` is used: the geometry is that of `paper_bench`, with vectors as axes of the block.
"""

from dataclasses import dataclass, field

import numpy as np

from bench.readings.table import Readings, make_readings
from bench.validation.paper_bench import ARCSEC, U0, K, design, specific_force

KINDS = ("axis_tilt", "zero_offset", "mounting_error", "mounting_roll")
STATED = dict(zip(KINDS, np.array([5 / 3, 5 / 3, 30.0, 30.0]) * ARCSEC, strict=True))
"""The paper's limits as three sigma; the roll as the mounting error."""
QUARTERS = ("", "T90", "T180")


@dataclass
class Bench:
    """The truth of one bench: `means`, `remounts` and `waves` (4,) and `setting`, rad; noise (3,), V."""

    means: np.ndarray
    remounts: np.ndarray
    noise: np.ndarray
    setting: float
    waves: np.ndarray = field(default_factory=lambda: np.zeros(4))
    drift: float = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator, waves: bool = True) -> "Bench":
        """Draw a bench within its stated limits; mean and remounts share each angle's variance at random."""
        stated = np.array(list(STATED.values()))
        part = rng.uniform(0.02, 1.0, 4)
        part[2:] = rng.uniform(0.005, 0.1, 2)
        means = np.sqrt(1 - part) * stated * rng.normal(size=4)
        circle = rng.normal(size=4) * np.array([4, 4, 2, 2]) * ARCSEC * waves
        return cls(
            means, np.sqrt(part) * stated, 1e-4 * rng.uniform(0.4, 1.2, 3), rng.uniform(1, 4) * ARCSEC, circle
        )


Columns = tuple[list[str], list[int], list[int], np.ndarray]
"""Installation, pass, point and angle of each reading of a run."""


@dataclass
class Runs:
    """Signals (n, 3), V, and columns of each run, and the coefficients (runs, 12) of its own block."""

    signals: list[np.ndarray]
    columns: list[Columns]
    truths: np.ndarray

    def tables(self) -> list[Readings]:
        """Return the runs as tables of readings, with settings three minutes apart."""
        return [
            make_readings(
                labels,
                passes,
                points,
                phi,
                signal,
                source=f"run-{r}",
                time_s=np.arange(0.0, 180.0 * len(phi), 180.0),
            )
            for r, ((labels, passes, points, phi), signal) in enumerate(
                zip(self.columns, self.signals, strict=True), start=1
            )
        ]


def simulate(
    rng: np.random.Generator,
    truth: Bench,
    runs: int,
    passes: int = 3,
    turned: tuple[int, ...] = (0,),
    K2: dict[int, float] | None = None,
    drift: dict[int, float] | None = None,
) -> Runs:
    """Simulate runs of installations 1 and 2; `turned` says for each run in turn how both are repeated.

    It counts quarter turns on the platform; 0 means no repeat. `K2` (g/g²) and `drift` (V/h) are by number of
    run.
    """
    made = [
        _run(rng, truth, passes, turned[r % len(turned)], (K2 or {}).get(r, 0.0), (drift or {}).get(r, 0.0))
        for r in range(runs)
    ]
    signals, columns, truths = zip(*made, strict=True)
    return Runs(list(signals), list(columns), np.array(truths))


def _run(
    rng: np.random.Generator, truth: Bench, passes: int, quarters: int, K2: float, drift: float
) -> tuple[np.ndarray, Columns, np.ndarray]:
    parts = [0, quarters] if quarters else [0]
    labels, pass_number, point, force = [], [], [], []
    for turn in parts:
        installation, own_pass, own_point, phi = design(passes)
        mount = (np.array(installation) == "2").astype(int)
        wave = truth.waves @ np.array([np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi)])
        own = truth.means + truth.remounts * rng.normal(size=(2, 4))
        alpha1, alpha2, alpha3, alpha5 = own[mount].T
        alpha4 = wave + truth.setting * rng.normal(size=len(phi))
        force.append(
            specific_force(installation, phi, alpha1, alpha2, alpha3, alpha4, alpha5, psi=turn * np.pi / 2)
        )
        labels += [i + QUARTERS[turn] for i in installation]
        pass_number += own_pass
        point += own_point
    acting = np.concatenate(force)
    block = K * (1 + 0.003 * rng.normal(size=(3, 1))) + 0.005 * rng.normal(size=(3, 3))
    zero = U0 + 0.02 * rng.normal(size=3)
    n = len(acting)
    signal = acting @ block.T + zero + truth.noise * rng.normal(size=(n, 3))
    if truth.drift:
        signal += np.cumsum(truth.drift * np.sqrt(1 / 20) * rng.normal(size=(n, 3)), axis=0)
    signal += K2 * np.diag(block) * acting**2 + (drift * np.arange(n) / 20)[:, None]
    columns = labels, pass_number, point, np.tile(phi, len(parts))
    return signal, columns, np.concatenate([block.ravel(), zero])
