"""Errors of procedure: slips between passes or mountings, and mistakes of operator or wiring."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind_trial.stand import ARCSEC, CHANNELS, Floats, Run, Shift, Truth

# --- a slip of the block, another zero, exchanged meters -------------------------------------------------


Rows = NDArray[np.bool_]
Where = Callable[[np.random.Generator, Run, bool], tuple[Rows, str]]


def _of_passes(rng: np.random.Generator, run: Run, lasting: bool) -> tuple[Rows, str]:
    """Return the rows affected: one pass of a mounting or, if `lasting`, possibly all from one pass on."""
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
    """Return the rows affected: a whole mounting after the first or, if `lasting`, possibly all from there on."""
    mount = int(rng.choice(run.calibration_mounts[1:]))
    if lasting and rng.random() < 0.5:
        return run.mount >= mount, f"from mounting {mount + 1} on"
    return run.mount == mount, f"mounting {mount + 1}"


def _of_the_last_visit(rng: np.random.Generator, run: Run, lasting: bool) -> tuple[Rows, str]:
    """Return the rows of the return to an installation that was measured before."""
    mount = int(run.calibration_mounts[-1])
    return run.mount == mount, f"mounting {mount + 1}"


def _slip(where: Where, rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of a block that turns about an axis of the platform, or about a random axis."""
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
    return Truth(
        "head_zero_shift", "stand", shift=lambda _, x: {"angle": sign * 60 * x * ARCSEC * rows}, mounts=(place,)
    )  # fmt: skip


def _exchanged(where: Where, rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of exchanging the meters of two channels; each meter has its own gain and zero."""
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
"""Kinds of case by name, with the functions that draw their effects."""


# --- the table differs from what was done ----------------------------------------------------------------


OUTLIER_V: Final = (1e-3, 1.0)


@dataclass(frozen=True)
class Mistake:
    """One mistake, and the rows that it affects.

    `true_angle` (n,) is the true head angle, None if the table has it; `edit` changes the signals (n, 3) before
    they enter the table; `labels` (n,) are the wrong labels in the table, None if they are right. `accepted` are
    names that are indistinguishable from the true one.
    """

    name: str
    place: str
    true_angle: Floats | None = None
    edit: Callable[[Floats], Floats] = np.asarray
    labels: NDArray[np.str_] | None = None
    accepted: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All right names of the mistake."""
        return (self.name, *self.accepted)


def _scope(rng: np.random.Generator, run: Run) -> tuple[NDArray[np.bool_], str]:
    """Draw the rows of the whole run, or of one mounting that a calibration fits."""
    if rng.random() < 0.5:
        return np.ones(len(run.mount), dtype=bool), "everywhere"
    mount = int(rng.choice(run.calibration_mounts))
    return run.mount == mount, f"mounting {mount + 1}"


def _swapped_channels(rng: np.random.Generator, run: Run) -> Mistake:
    rows, where = _scope(rng, run)
    i, j = np.sort(rng.choice(3, 2, replace=False))
    order = np.arange(3)
    order[[i, j]] = j, i
    return Mistake(
        "swapped_channels", f"{CHANNELS[i]} and {CHANNELS[j]} {where}",
        edit=lambda signal: np.where(rows[:, None], signal[:, order], signal),
    )  # fmt: skip


def _reversed_polarity(rng: np.random.Generator, run: Run) -> Mistake:
    rows, where = _scope(rng, run)
    channel = int(rng.integers(3))
    turned = np.outer(rows, np.arange(3) == channel)
    # both installations have the sine along x only: x reversed in the whole run equals a head that counts backwards
    same = ("reversed_rotation",) if channel == 0 and where == "everywhere" else ()
    return Mistake(
        "reversed_polarity", f"{CHANNELS[channel]} {where}", accepted=same,
        edit=lambda signal: np.where(turned, -signal, signal),
    )  # fmt: skip


def _reversed_rotation(rng: np.random.Generator, run: Run) -> Mistake:
    return Mistake(
        "reversed_rotation", "everywhere", true_angle=-run.head_angle, accepted=("reversed_polarity",)
    )


def _swapped_installations(rng: np.random.Generator, run: Run) -> Mistake:
    swapped = np.select([run.labels == "1", run.labels == "2"], ["2", "1"], run.labels)
    return Mistake("swapped_installations", "1 and 2", labels=swapped)


def _shifted_points(rng: np.random.Generator, run: Run) -> Mistake:
    """Return the mistake that each reading of a mounting belongs to the previous point.

    The first reading belongs to the place where the head rested before.
    """
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
    if kind == "reflected":
        angle[row] = -angle[row]
    else:
        off = {"1 deg": 1.0, "10 arcmin": 1 / 6, "1 arcmin": 1 / 60}
        angle[row] += rng.choice([-1, 1]) * np.radians(off[kind])
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
    "swapped_channels": _swapped_channels, "reversed_polarity": _reversed_polarity,
    "reversed_rotation": _reversed_rotation, "swapped_installations": _swapped_installations,
    "shifted_points": _shifted_points, "wrong_setting": _wrong_setting, "outlier": _outlier,
}  # fmt: skip
