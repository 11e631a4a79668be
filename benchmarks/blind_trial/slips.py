"""What is moved or changed between passes or at a visit: a slip of the block, another zero, exchanged meters.

Each is drawn with where it holds. Per pass: from one pass of a mounting on, in one pass alone, or from one on to
the end of the run. Per visit: in a whole mounting after the first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.geometry import ARCSEC, Floats
from benchmarks.blind_trial.truth import CHANNELS, Shift, Truth

Rows = NDArray[np.bool_]
Where = Callable[[np.random.Generator, Run, bool], tuple[Rows, str]]


def _of_passes(rng: np.random.Generator, run: Run, lasting: bool) -> tuple[Rows, str]:
    """From a pass of a mounting on, in one pass, or, where it may be `lasting`, from one on to the end."""
    many = [m for m in run.calibration_mounts if len(set(run.pass_number[run.mount == m].tolist())) > 1]
    mount = int(rng.choice(many))
    own = run.mount == mount
    passes = sorted(set(run.pass_number[own].tolist()))
    how = str(rng.choice(["on", "alone", "last"] if lasting else ["on", "alone"]))
    if how == "alone":
        number = int(rng.choice(passes))
        return own & (run.pass_number == number), f"mounting {mount + 1}, pass {number}"
    number = int(rng.choice(passes[1:]))
    rows = own & (run.pass_number >= number)
    if how == "last":
        rows = rows | (run.mount > mount)
    return rows, f"mounting {mount + 1}, from pass {number} on" + (" to the end" if how == "last" else "")


def _of_a_visit(rng: np.random.Generator, run: Run, lasting: bool) -> tuple[Rows, str]:
    """A whole mounting after the first; where it may be `lasting`, perhaps all after it, too."""
    mount = int(rng.choice(run.calibration_mounts[1:]))
    if lasting and rng.random() < 0.5:
        return run.mount >= mount, f"from mounting {mount + 1} on"
    return run.mount == mount, f"mounting {mount + 1}"


def _of_the_last_visit(rng: np.random.Generator, run: Run, lasting: bool) -> tuple[Rows, str]:
    """The return to an installation that was measured before."""
    mount = int(run.calibration_mounts[-1])
    return run.mount == mount, f"mounting {mount + 1}"


def _slip(where: Where, rng: np.random.Generator, run: Run) -> Truth:
    """The block turns about an axis of the platform, or about any."""
    rows, place = where(rng, run, False)
    axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
    about_x, about_y, about_z = axis / np.linalg.norm(axis) * rng.choice([-1.0, 1.0])

    def shift(_: Run, x: float) -> Shift:
        size = 60 * x * ARCSEC * rows
        return {"roll": about_x * size, "angle": about_y * size, "skew": about_z * size}

    return Truth("block_slip", "stand", shift=shift, mounts=(place,))


def _rezero(where: Where, rng: np.random.Generator, run: Run) -> Truth:
    rows, place = where(rng, run, True)
    sign = rng.choice([-1.0, 1.0])

    def shift(_: Run, x: float) -> Shift:
        return {"angle": sign * 60 * x * ARCSEC * rows}

    return Truth("head_zero_shift", "stand", shift=shift, mounts=(place,))


def _exchanged(where: Where, rng: np.random.Generator, run: Run) -> Truth:
    """Each meter has a gain and a zero of its own; two of them stand at each other's channels."""
    rows, place = where(rng, run, True)
    one, other = (int(i) for i in rng.choice(3, 2, replace=False))
    gains, zeros = 30e-6 * rng.normal(size=2), 100e-6 * rng.normal(size=2)

    def act(_: Run, volts: Floats, x: float) -> Floats:
        shown = np.zeros_like(volts)
        for channel, own, now in ((one, 0, 1), (other, 1, 0)):
            by_own, by_now = ((1 + x * gains[i]) * volts[:, channel] + x * zeros[i] for i in (own, now))
            shown[:, channel] = np.where(rows, by_now - by_own, 0.0)
        return shown

    pair = tuple(CHANNELS[i] for i in sorted((one, other)))
    return Truth("meters_exchanged", "voltmeter", act=act, channels=pair, mounts=(place,))


SLIPS: Final[dict[str, Callable[[np.random.Generator, Run], Truth]]] = {
    "slip": lambda rng, run: _slip(_of_passes, rng, run),
    "slip:visit": lambda rng, run: _slip(_of_the_last_visit, rng, run),
    "rezero": lambda rng, run: _rezero(_of_passes, rng, run),
    "rezero:visit": lambda rng, run: _rezero(_of_the_last_visit, rng, run),
    "exchanged": lambda rng, run: _exchanged(_of_passes, rng, run),
    "exchanged:visit": lambda rng, run: _exchanged(_of_a_visit, rng, run),
}
"""Kinds of case by the name of their rows."""
