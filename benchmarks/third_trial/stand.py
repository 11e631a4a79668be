"""The stand of the third trial: orientation of the block, readings of its meters, visible part of effects.

It is written from the paper's description with rotation matrices, and uses nothing of `bench`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
ARCSEC: Final = np.radians(1 / 3600)
K: Final = np.array(
    [[-2.177087, -0.018243, 0.025027], [0.026542, -2.139892, 0.032755], [0.006754, 0.006026, -2.144367]]
)
U0: Final = np.array([0.071469, -0.196485, -0.411789])
"""Equation (11) of the paper, V/g and V."""
READING_V: Final = 15e-6
SETTING: Final = 10 / 3 * ARCSEC
STAND: Final = np.array([5 / 3, 5 / 3, 30.0]) * ARCSEC
"""Zero offset, axis tilt and mounting error of a mounting: the paper's limits as three standard deviations."""
BLOCK_AXES: Final = {
    "1": np.eye(3),
    "2": np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "2T180": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "V": Rotation.from_euler("z", -45, degrees=True).as_matrix(),
}
"""Block axes as rows in platform axes, by mounting."""
DAYS: Final = 4
"""Number of temperature records in the trial; times and angles are the same in all of them."""


@dataclass(frozen=True)
class Day:
    """The rows of a run, as columns (n,); `mount` counts mountings from 0, `sweep` passes from 0."""

    label: NDArray[np.str_]
    mount: NDArray[np.int64]
    pass_number: NDArray[np.int64]
    sweep: NDArray[np.int64]
    point: NDArray[np.int64]
    angle: Floats
    time_s: Floats
    since_mount_s: Floats
    warmth: Floats
    """Temperature at the block above 20 °C, K."""

    def __len__(self) -> int:
        return len(self.angle)

    @property
    def fitted(self) -> NDArray[np.bool_]:
        """The rows of installations 1 and 2."""
        return np.asarray(self.label != "V")

    @property
    def eighth(self) -> NDArray[np.int64]:
        """The index of the head's mark, 0 to 7 for 0° to 315°."""
        return np.asarray(np.round(self.angle / (np.pi / 4)).astype(int) % 8)

    def lagged(self, lag_s: float) -> Floats:
        """Return the temperature above 20 °C behind two equal first-order lags, initially in equilibrium."""
        if lag_s == 0.0:
            return self.warmth
        fine = np.arange(0.0, self.time_s[-1] + 10.0, 10.0)
        warmth = np.interp(fine, self.time_s, self.warmth)
        for _ in range(2):
            behind = warmth.copy()
            for i in range(1, len(fine)):
                behind[i] += np.exp(-20.0 / lag_s) * (behind[i - 1] - behind[i])
            warmth = behind
        return np.asarray(np.interp(self.time_s, fine, warmth))


@cache
def day(number: int) -> Day:
    """Return the run of a day: 9 points, 2 installations, 3 passes, all rising; then 4 verification points."""
    rng, rows, clock, mounted_at = np.random.default_rng([3, number]), [], 0.0, 0.0
    for sweep in range(7):
        mount, earlier = divmod(sweep, 3)
        if sweep in {3, 6}:
            clock = mounted_at = clock + 1500.0
        for index, angle in enumerate(range(0, 361, 45) if mount < 2 else range(45, 316, 90)):
            rows.append(
                ("12V"[mount], mount, earlier + 1, sweep, index + 1, angle, clock, clock - mounted_at)
            )
            clock += 110.0
        clock += 70.0
    label, mounts, passes, sweeps, points, angles, time_s, since = map(np.array, zip(*rows, strict=True))
    phase, trend, start = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 0.4), rng.uniform(2.0, 4.0)
    warmth = start + 0.2 * np.sin(2 * np.pi * time_s / 2900 + phase) + trend * time_s / time_s[-1]
    warmth += 0.05 * np.sin(2 * np.pi * time_s / 1210 + 3 * phase)
    turned = np.radians(angles)
    return Day(label, mounts, passes, sweeps, points, turned, time_s, since, np.round(warmth, 3))


Stage = Literal["stand", "block", "meter"]
Rng = np.random.Generator
Act = Callable[[Day, Floats, Rng, Rng], Floats]
"""A function of the run, the input of the stage (n, 3), a generator with a fixed seed, and one with a free seed."""


@dataclass(frozen=True)
class Form:
    """A hidden effect: its size times `act` is the addition at a `stage` of the signal.

    The stage "stand" has the head's angle, the tilt of its axis, the mounting error and the mounting roll, (n, 4),
    rad; the stage "block" the output in g, (n, 3); the stage "meter" the signal in V, (n, 3).
    """

    name: str
    stage: Stage
    act: Act
    size: float
    scatter: bool = False
    seed: int = 0

    def addition(self, on: Day, seen: Floats, seed: int) -> Floats:
        """Return the addition; for a form with a mean, it is the same for each seed."""
        now = np.random.default_rng([self.seed, 2, seed if self.scatter else 0])
        return self.size * self.act(on, seen, np.random.default_rng(self.seed), now)


@dataclass(frozen=True)
class Truth:
    """The true angles (rad) and labels (of `BLOCK_AXES`) of a run, where they differ from those in its file."""

    angle: Floats | None = None
    label: NDArray[np.str_] | None = None
    other_block: NDArray[np.bool_] | None = None


AS_SAID: Final = Truth()


def volts(
    on: Day,
    forms: Sequence[Form] = (),
    stand: Floats | None = None,
    setting: Floats | float = 0.0,
    seed: int = 0,
    truth: Truth = AS_SAID,
) -> Floats:
    """Return readings without noise (n, 3), V; `stand` (mountings, 3) has the columns of `STAND`."""
    error = np.zeros((len(on), 4))
    error[:, :3] = 0.0 if stand is None else stand[on.mount]
    for form in (one for one in forms if one.stage == "stand"):
        error += form.addition(on, error, seed)
    angle, tilt, skew, roll = error.T
    angle = angle + setting + (on.angle if truth.angle is None else truth.angle)
    # in a frame turned by an angle, the vertical is turned by the opposite angle
    up = Rotation.from_euler("xyz", np.stack([-tilt, angle, -skew], axis=1)).apply([0.0, 0.0, 1.0])
    up = Rotation.from_rotvec(np.outer(-roll, [1.0, 0.0, 0.0])).apply(up)
    labels = on.label if truth.label is None else truth.label
    force = np.einsum("nij,nj->ni", np.stack([BLOCK_AXES[str(label)] for label in labels]), up)
    result = force @ K.T + U0
    if truth.other_block is not None:
        result[truth.other_block] = force[truth.other_block] @ (K * 1.004 + 0.003).T + U0 * 0.8
    for form in (one for one in forms if one.stage == "block"):
        result = result + np.diag(K) * form.addition(on, force, seed)
    for form in (one for one in forms if one.stage == "meter"):
        result = result + form.addition(on, result, seed)
    return np.asarray(result)


NOISES: Final = {"normal": 0.6, "t4": 0.1, "rounded": 0.1, "by channel": 0.1, "slow": 0.1}
"""Kinds of noise with the share of cases that have them."""


def read(on: Day, kind: str, rng: Rng, forms: Sequence[Form] = (), truth: Truth = AS_SAID) -> Floats:
    """Return readings (n, 3), V, with errors of the stand, setting errors, and noise of a kind."""
    stand, setting = STAND * rng.standard_normal((3, 3)), SETTING * rng.standard_normal(len(on))
    signal = volts(on, forms, stand, setting, int(rng.integers(2**31)), truth)
    noise = (
        rng.standard_t(4, signal.shape) / np.sqrt(2) if kind == "t4" else rng.standard_normal(signal.shape)
    )
    if kind == "by channel":
        noise[:, rng.integers(3)] *= 2
    if kind == "slow":
        slow = rng.standard_normal(signal.shape)
        for i in range(1, len(on)):
            kept = np.exp(-(on.time_s[i] - on.time_s[i - 1]) / 1200)
            slow[i] = kept * slow[i - 1] + np.sqrt(1 - kept**2) * slow[i]
        noise += 0.7 * slow
    signal += READING_V * noise
    return np.round(signal, 5) if kind == "rounded" else signal


def table(on: Day, signal: Floats) -> "pd.DataFrame":
    """Return a table with the columns of a readings file."""
    import pandas as pd

    frame = pd.DataFrame({"installation": on.label, "pass": on.pass_number, "point": on.point})
    frame["angle_deg"] = np.round(np.degrees(on.angle), 9)
    frame["direction"], frame["time_s"] = 1, on.time_s
    frame["temperature_c"] = 20.0 + on.warmth
    frame[["ux_v", "uy_v", "uz_v"]] = signal
    return frame


@cache
def sight(number: int) -> Floats:
    """Return the matrix that maps signals (3n,) of a day to their visible part, in units of normal noise.

    The three readings of each setting are whitened by their covariance; a verification point is visible only
    by its modulus. The part that the twelve coefficients and stand errors (within their sizes) can absorb is
    removed. The norm of the visible part is rho.
    """
    on, inverse = day(number), np.linalg.inv(K)
    plain, step = volts(on), 1e-6
    along = (volts(on, setting=step) - plain) / step
    covariance = READING_V**2 * np.eye(3) + SETTING**2 * along[:, :, None] * along[:, None, :]
    force = (plain - U0) @ inverse.T
    modulus = (force / np.linalg.norm(force, axis=1, keepdims=True)) @ inverse
    modulus /= READING_V * np.linalg.norm(modulus, axis=1, keepdims=True)
    rows = [np.linalg.inv(np.linalg.cholesky(one)) for one in covariance[on.fitted]]
    whitener = block_diag(*rows, *(one[None] for one in modulus[~on.fitted]))
    taken = [np.outer(part, axis) for axis in np.eye(3) for part in (*force.T, np.ones(len(on)))]
    taken += [volts(on, stand=(one * np.tile(STAND, 3)).reshape(3, 3)) - plain for one in np.eye(9)]
    # the prior of a stand error equals a measurement of zero with the u of its size
    design = np.vstack([whitener @ np.array([one.ravel() for one in taken]).T, np.eye(9, 21, 12)])
    base, _ = np.linalg.qr(design / np.linalg.norm(design, axis=0))
    seen = np.vstack([whitener, np.zeros((9, whitener.shape[1]))])
    return np.asarray(seen - base @ (base.T @ seen))


def left(signal: Floats, number: int) -> Floats:
    """Return the visible part of a signal (n, 3) of a day, in units of noise."""
    return np.asarray(sight(number) @ signal.ravel())


def rho(signal: Floats, number: int) -> float:
    """Return the norm of the visible part of a signal (n, 3) of a day, in units of noise."""
    return float(np.linalg.norm(left(signal, number)))
