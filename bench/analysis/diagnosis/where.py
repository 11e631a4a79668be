"""Where readings and model disagree: simple patterns, the largest first, each taken off before the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import special

from bench.analysis.diagnosis.linear import MODULUS, LinearSystem
from bench.analysis.diagnosis.noise_grid import NoiseGrid
from bench.base.arrays import CHANNELS, Floats

SIGNIFICANT: Final = 0.01
MOST_PLACES: Final = 8
HARMONICS: Final = (
    "constant",
    "once per turn",
    "twice per turn",
    "three times per turn",
    "four times per turn",
)
LOW_RANGE_V: Final = 1.2
"""Below it a 34401A with autorange reads on its 1 V range."""


@dataclass(frozen=True)
class Place:
    """One pattern of the disagreement. `size` is its amplitude in the unit of the signal, `p` with all looks."""

    channel: str
    installation: str
    pattern: str
    size: float
    unit: str
    p: float
    p_local: float


@dataclass(frozen=True)
class _Look:
    channel: str
    installation: str
    pattern: str
    columns: Floats


def find_places(
    linear: LinearSystem, grid: NoiseGrid, ratio: int, sigma: float, freedom: int
) -> tuple[Place, ...]:
    """Return the patterns that stand out of the noise with all looks counted, at most `MOST_PLACES`.

    `sigma` is the noise of a reading as the repeats give it, with `freedom`; `ratio` says which of the grid.
    """
    looks = _looks(linear)
    white = [grid.white[ratio] @ look.columns for look in looks]
    left = grid.white[ratio] @ linear.response
    places: list[Place] = []
    basis = np.zeros((len(left), 0))
    while len(places) < MOST_PLACES:
        best = None
        for look, columns in zip(looks, white, strict=True):
            seen = columns - basis @ (basis.T @ columns)
            q, r = np.linalg.qr(seen)
            usable = np.abs(np.diag(r)) > 1e-3 * np.linalg.norm(columns, axis=0)
            if not usable.all():
                continue
            part = q.T @ left
            statistic = float(part @ part) / len(part) / sigma**2
            p = float(special.fdtrc(len(part), freedom, statistic))
            # where p underflows the size of the statistic still orders
            if best is None or (p, -statistic) < best[0]:
                best = ((p, -statistic), look, q, np.linalg.solve(r, part))
        if best is None or best[0][0] * len(looks) > SIGNIFICANT:
            break
        (p, _), look, q, amplitude = best
        size = float(np.max(np.abs(look.columns @ amplitude)))
        places.append(
            Place(
                look.channel, look.installation, look.pattern, size, linear.readings.unit,
                min(1.0, p * len(looks)), p,
            )
        )  # fmt: skip
        left = left - q @ (q.T @ left)
        basis = np.column_stack([basis, q])
    return tuple(places)


def _looks(linear: LinearSystem) -> list[_Look]:
    rows, readings = linear.rows, linear.readings
    label = readings.installation[rows.reading]
    series = readings.series[rows.reading]
    mounts = np.array([i if s == 1 else f"{i}/{s}" for s, i in zip(series, label, strict=True)])
    oriented = linear.setting >= 0
    looks: list[_Look] = []
    for c, channel in enumerate(CHANNELS):
        own = oriented & (rows.channel == c)
        for mount in dict.fromkeys(mounts[own].tolist()):
            looks += _in_mount(linear, own & (mounts == mount), channel, mount)
        looks += _over_run(linear, own, channel)
    modulus = rows.channel == MODULUS
    if modulus.any():
        looks.append(_Look("modulus", "V", "constant", modulus[:, None].astype(np.float64)))
        for row in np.flatnonzero(modulus).tolist():
            looks.append(_Look("modulus", str(label[row]), _point_of(linear, row), _single(linear, row)))
    for row in np.flatnonzero(linear.setting < 0).tolist():
        if rows.channel[row] != MODULUS:
            name = CHANNELS[rows.channel[row]]
            looks.append(_Look(name, str(label[row]), _point_of(linear, row), _single(linear, row)))
    return looks


def _single(linear: LinearSystem, row: int) -> Floats:
    column = np.zeros((len(linear), 1))
    column[row] = 1.0
    return column


def _point_of(linear: LinearSystem, row: int) -> str:
    reading = linear.rows.reading[row]
    readings = linear.readings
    return f"single reading: pass {readings.pass_number[reading]}, point {readings.point[reading]}"


def _in_mount(linear: LinearSystem, own: NDArray[np.bool_], channel: str, mount: str) -> list[_Look]:
    readings, reading = linear.readings, linear.rows.reading
    angle = readings.angle_rad[reading]
    passes = readings.pass_number[reading]
    direction = readings.direction[reading]
    looks = [_Look(channel, mount, HARMONICS[0], own[:, None].astype(np.float64))]
    for k in (1, 2, 3, 4):
        wave = np.column_stack([np.cos(k * angle), np.sin(k * angle)])
        looks.append(_Look(channel, mount, HARMONICS[k], np.where(own[:, None], np.nan_to_num(wave), 0.0)))
    numbers = sorted(set(passes[own].tolist()))
    if len(numbers) > 1:
        for number in numbers:
            mine = (own & (passes == number)).astype(np.float64)
            looks.append(_Look(channel, mount, f"pass {number}", mine[:, None]))
    if len(set(direction[own].tolist())) > 1:
        side = np.where(own, direction, 0.0)
        looks.append(_Look(channel, mount, "direction of approach", side[:, None].astype(np.float64)))
        wave = np.column_stack([np.cos(angle), np.sin(angle)])
        turned = np.where(own[:, None], np.nan_to_num(wave) * direction[:, None], 0.0)
        looks.append(_Look(channel, mount, "direction of approach, once per turn", turned))
    looks += [
        _Look(channel, mount, _point_of(linear, row), _single(linear, row))
        for row in np.flatnonzero(own).tolist()
    ]
    return looks


def _over_run(linear: LinearSystem, own: NDArray[np.bool_], channel: str) -> list[_Look]:
    readings, reading = linear.readings, linear.rows.reading
    looks = []
    for pattern, values in (("time", readings.time_s), ("temperature", readings.temperature_c)):
        at = values[reading]
        if np.all(np.isfinite(at[own])) and np.ptp(at[own]) > 0:
            run = np.where(own, (at - np.mean(at[own])) / np.ptp(at[own]), 0.0)
            looks.append(_Look(channel, "all", f"{pattern}, bias", run[:, None]))
            scale = run * readings.signal[reading, np.minimum(linear.rows.channel, 2)]
            scale = scale / max(float(np.max(np.abs(scale))), 1e-300)
            looks.append(_Look(channel, "all", f"{pattern}, scale factor", scale[:, None]))
    if readings.unit == "V":
        low = own & (np.abs(readings.signal[reading, np.minimum(linear.rows.channel, 2)]) < LOW_RANGE_V)
        if low.any() and (own & ~low).any():
            looks.append(_Look(channel, "all", "signals below 1.2 V", low[:, None].astype(np.float64)))
    return looks
