"""Mistakes of an operator or a wirer: what the table says is not what was done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.geometry import Floats
from benchmarks.blind_trial.truth import CHANNELS

OUTLIER_V: Final = (1e-3, 1.0)


def _unchanged(signal: Floats) -> Floats:
    return signal


@dataclass(frozen=True)
class Mistake:
    """One mistake at its place.

    `true_angle` (n,) is where the head really stood, None where it stood as noted; `edit` changes the signals
    (n, 3) on their way into the table; `labels` (n,) are what the table says instead, None if the right ones.
    `accepted` are the names under which nothing tells it from the truth.
    """

    name: str
    place: str
    true_angle: Floats | None = None
    edit: Callable[[Floats], Floats] = _unchanged
    labels: NDArray[np.str_] | None = None
    accepted: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every name that is right."""
        return (self.name, *self.accepted)


def _scope(rng: np.random.Generator, run: Run) -> tuple[NDArray[np.bool_], str]:
    """Draw the whole run or one mounting of the calibration."""
    if rng.random() < 0.5:
        return np.ones(len(run.mount), dtype=bool), "everywhere"
    mount = int(rng.choice(run.calibration_mounts))
    return run.mount == mount, f"mounting {mount + 1}"


def _swapped_channels(rng: np.random.Generator, run: Run) -> Mistake:
    rows, where = _scope(rng, run)
    i, j = np.sort(rng.choice(3, 2, replace=False))

    def edit(signal: Floats) -> Floats:
        swapped = signal.copy()
        swapped[np.ix_(rows, [i, j])] = signal[np.ix_(rows, [j, i])]
        return swapped

    return Mistake("swapped_channels", f"{CHANNELS[i]} and {CHANNELS[j]} {where}", edit=edit)


def _reversed_polarity(rng: np.random.Generator, run: Run) -> Mistake:
    rows, where = _scope(rng, run)
    channel = int(rng.integers(3))

    def edit(signal: Floats) -> Floats:
        turned = signal.copy()
        turned[rows, channel] *= -1
        return turned

    # along x alone the two installations see the sine: with x reversed throughout the head counts backwards
    same = ("reversed_rotation",) if channel == 0 and where == "everywhere" else ()
    return Mistake("reversed_polarity", f"{CHANNELS[channel]} {where}", edit=edit, accepted=same)


def _reversed_rotation(rng: np.random.Generator, run: Run) -> Mistake:
    return Mistake(
        "reversed_rotation", "everywhere", true_angle=-run.head_angle, accepted=("reversed_polarity",)
    )


def _swapped_installations(rng: np.random.Generator, run: Run) -> Mistake:
    swapped = np.select([run.labels == "1", run.labels == "2"], ["2", "1"], run.labels)
    return Mistake("swapped_installations", "1 and 2", labels=swapped)


def _shifted_points(rng: np.random.Generator, run: Run) -> Mistake:
    """In one mounting each reading is of the stop before; the first is of the place where the head rested."""
    mount = int(rng.choice(run.calibration_mounts))
    rows = np.flatnonzero((run.mount == mount) & run.measured)
    angle = run.head_angle.copy()
    before = run.head_angle[rows[0]] - rng.choice([0.0, 1.0]) * (angle[rows[1]] - angle[rows[0]])
    angle[rows] = np.concatenate([[before], run.head_angle[rows[:-1]]])
    return Mistake("shifted_points", f"mounting {mount + 1}", true_angle=angle)


def _wrong_setting(rng: np.random.Generator, run: Run) -> Mistake:
    rows = np.flatnonzero(run.fitted)
    kind = str(rng.choice(["1 deg", "10 arcmin", "1 arcmin", "reflected"]))
    angle = run.head_angle.copy()
    if kind == "reflected":
        rows = rows[np.abs(np.sin(angle[rows])) > 0.1]
    row = int(rng.choice(rows))
    off = {"1 deg": 1.0, "10 arcmin": 1 / 6, "1 arcmin": 1 / 60}
    angle[row] = (
        -angle[row] if kind == "reflected" else angle[row] + rng.choice([-1, 1]) * np.radians(off[kind])
    )
    return Mistake("wrong_setting", f"row {row + 1}, {kind}", true_angle=angle)


def _outlier(rng: np.random.Generator, run: Run) -> Mistake:
    row, channel = int(rng.choice(np.flatnonzero(run.fitted))), int(rng.integers(3))
    size = rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(*np.log(OUTLIER_V)))

    def edit(signal: Floats) -> Floats:
        off = signal.copy()
        off[row, channel] += size
        return off

    return Mistake("outlier", f"row {row + 1}, {CHANNELS[channel]}, {size:.3g} V", edit=edit)


MISTAKES: Final[dict[str, Callable[[np.random.Generator, Run], Mistake]]] = {
    "swapped_channels": _swapped_channels,
    "reversed_polarity": _reversed_polarity,
    "reversed_rotation": _reversed_rotation,
    "swapped_installations": _swapped_installations,
    "shifted_points": _shifted_points,
    "wrong_setting": _wrong_setting,
    "outlier": _outlier,
}
