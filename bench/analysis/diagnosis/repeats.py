"""The size of the noise from repeats alone: what no model of the bench, right or wrong, could explain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.analysis.diagnosis.linear import LinearSystem
from bench.base.arrays import Floats

LEAST_FREEDOM: Final = 6
"""Settings beyond the saturated description below which repeats tell too little."""


@dataclass(frozen=True)
class Repeats:
    """Noise of a reading (unit of the signal) from what repeats of a setting leave; `freedom` in settings."""

    sigma: float
    freedom: int


def noise_of_repeats(linear: LinearSystem, resolution: float) -> Repeats:
    """Return the scatter about a free value for each mounting and angle, each pass, and a slope in each mounting.

    A pass is free in its bias and in a wave once a turn: what slips, is set anew or exchanged between passes is
    no noise. The part along du/dphi has the setting error in it and is left out of `sigma`. Where there are too
    few repeats, the scatter about the model stands in. Never below rounding to `resolution`.
    """
    oriented = linear.setting >= 0
    readings = linear.readings
    reading = linear.rows.reading[oriented][::3]
    left = linear.response[oriented].reshape(-1, 3)
    slope = linear.slope[oriented].reshape(-1, 3)
    design = _saturated(
        _mounts(linear),
        np.round(np.degrees(readings.angle_rad[reading]) / 5.0).astype(int),
        readings.pass_number[reading],
        readings.angle_rad[reading],
    )
    u, size, _ = np.linalg.svd(design, full_matrices=False)
    basis = u[:, size > 1e-9 * size[0]]
    freedom = len(left) - basis.shape[1]
    if freedom < LEAST_FREEDOM:
        whole = np.concatenate([linear.fixed, linear.random], axis=1)[oriented]
        rest = (left.ravel() - whole @ np.linalg.lstsq(whole, left.ravel(), rcond=None)[0]).reshape(-1, 3)
        freedom = max(len(left) - 4, 1)
        free = np.full(len(left), freedom / len(left))
    else:
        rest = left - basis @ (basis.T @ left)
        free = 1.0 - np.sum(basis**2, axis=1)
    unit = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)
    floor = max(resolution / np.sqrt(12.0), 1e-11 * float(np.max(np.abs(readings.signal))))
    across = rest - np.sum(rest * unit, axis=1, keepdims=True) * unit
    # of unequal channels what is left across du/dphi is that of the two that turn least with it
    share = np.sum(linear.by_channel**2 * (1.0 - unit**2) * free[:, None]) / (2 * np.sum(free))
    sigma = max(float(np.sqrt(np.sum(across**2) / (2 * freedom) / share)), floor)
    return Repeats(sigma, freedom)


def cells_of(linear: LinearSystem) -> NDArray[np.int64]:
    """Number the settings by mounting and angle, to 5 deg: those of a number repeat each other, shape (n,)."""
    reading = linear.rows.reading[linear.setting >= 0][::3]
    angle = np.round(np.degrees(linear.readings.angle_rad[reading]) / 5.0).astype(int)
    keys = list(zip(_mounts(linear), angle.tolist(), strict=True))
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([number[key] for key in keys], dtype=np.int64)


def _mounts(linear: LinearSystem) -> list[str]:
    readings, reading = linear.readings, linear.rows.reading[linear.setting >= 0][::3]
    return [f"{s}/{i}" for s, i in zip(readings.series[reading], readings.installation[reading], strict=True)]


def _saturated(
    mount: list[str], angle: NDArray[np.int64], passes: NDArray[np.int64], angle_rad: Floats
) -> Floats:
    cells = list(zip(mount, angle.tolist(), strict=True))
    turns = list(zip(mount, passes.tolist(), strict=True))
    columns = [[c == key for c in cells] for key in dict.fromkeys(cells)]
    of_pass = np.array([[t == key for t in turns] for key in dict.fromkeys(turns)], dtype=np.float64)
    waves = [*(of_pass * np.cos(angle_rad)), *(of_pass * np.sin(angle_rad))]
    rank = np.arange(len(mount), dtype=np.float64) / len(mount)
    slopes = [np.where(np.array(mount) == key, rank, 0.0) for key in dict.fromkeys(mount)]
    return np.column_stack([*np.array(columns, dtype=np.float64), *of_pass, *waves, *slopes])
