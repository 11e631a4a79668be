"""Patterns of the residuals: where readings and model disagree, the largest first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message
from bench.diagnosis.evidence import KNOWN_SIZE
from bench.diagnosis.levels import ALIKE, BY_CHANCE, CHUNK, FAR, INSEPARABLE, LISTED, MARK_DEG
from bench.diagnosis.linear import MODULUS, LinearSystem
from bench.diagnosis.noise_grid import NoiseGrid, make_whitener
from bench.diagnosis.noise_kinds import TAIL_DOF
from bench.diagnosis.posterior import NoiseSize
from bench.model.effects import AppliedEffect
from bench.model.effects.voltmeter import LOW_RANGE_V

HARMONICS: Final = (
    "constant",
    message("once per turn"),
    message("twice per turn"),
    message("three times per turn"),
    message("four times per turn"),
)


@dataclass(frozen=True)
class ResidualPattern:
    """One pattern of the residuals, in a channel and an installation.

    `size` is its amplitude in `unit`. `p` is its p-value, corrected for the number of patterns tried;
    `p_local` is not corrected.
    """

    channel: str
    installation: str
    pattern: str
    size: float
    unit: str
    p: float
    p_local: float


Look = tuple[str, str, str, Floats]
"""A tuple of the channel, the installation, the pattern in words, and the columns (N, 1 or 2) of the pattern."""


def find_places(
    linear: LinearSystem, grid: NoiseGrid, ratio: int, sigma: float, freedom: int
) -> tuple[ResidualPattern, ...]:
    """Return the significant patterns of the residuals, the largest first, at most `LISTED`.

    `ratio` is the index of the noise ratio; `sigma`, the noise from repeats with `freedom`. p-values count all
    patterns.
    """
    looks = list(_looks(linear))
    white = grid.white[ratio] @ np.concatenate([columns for *_, columns in looks], axis=1)
    left = grid.white[ratio] @ linear.response
    wide = np.array([columns.shape[1] for *_, columns in looks])
    starts = np.cumsum(wide) - wide
    alike = [np.flatnonzero(wide == many) for many in np.unique(wide)]
    seen = [np.moveaxis(white[:, starts[own][:, None] + np.arange(wide[own[0]])], 1, 0) for own in alike]
    whole = np.empty(len(looks))
    for own, columns in zip(alike, seen, strict=True):
        whole[own] = np.linalg.norm(columns, axis=1).min(axis=1)
    places: list[ResidualPattern] = []
    while len(places) < LISTED:
        bases: dict[int, tuple[Floats, Floats]] = {}
        square, told = np.empty(len(looks)), np.empty(len(looks), dtype=bool)
        for own, columns in zip(alike, seen, strict=True):
            q, r = np.linalg.qr(columns)
            bases.update(zip(own.tolist(), zip(q, r, strict=True), strict=True))
            square[own] = np.sum((np.swapaxes(q, 1, 2) @ left) ** 2, axis=1) / sigma**2
            # leave out patterns that the earlier ones explain
            least = np.min(np.diagonal(r, axis1=1, axis2=2) ** 2, axis=1)
            told[own] = least <= INSEPARABLE * whole[own] ** 2
        p_each = np.where(told, np.inf, special.fdtrc(wide, freedom, square / wide))
        # if p underflows, the size of the statistic decides
        best = int(np.lexsort((-square / wide, p_each))[0])
        p = float(p_each[best])
        if p * len(looks) > BY_CHANCE:
            break
        q, r = bases[best]
        channel, installation, pattern, columns = looks[best]
        size = float(np.max(np.abs(columns @ np.linalg.solve(r, q.T @ left))))
        p_all = min(1.0, p * len(looks))
        places.append(ResidualPattern(channel, installation, pattern, size, linear.readings.unit, p_all, p))
        left = left - q @ (q.T @ left)
        seen = [own - q @ (q.T @ own) for own in seen]
    return tuple(places)


def _looks(linear: LinearSystem) -> Iterator[Look]:
    rows, readings = linear.rows, linear.readings
    label = readings.installation[rows.reading]
    run = readings.run[rows.reading]
    # with several runs, patterns common to all of them
    series = np.ones_like(run) if run.any() else readings.series[rows.reading]
    mounts = np.array([i if s == 1 else f"{i}/{s}" for s, i in zip(series, label, strict=True)])
    oriented = linear.setting >= 0
    for c, channel in enumerate(CHANNELS):
        own = oriented & (rows.channel == c)
        for mount in dict.fromkeys(mounts[own].tolist()):
            for pattern, columns in _in_mount(linear, own & (mounts == mount)):
                yield channel, mount, pattern, columns
        for pattern, columns in _over_run(linear, own):
            yield channel, "all", pattern, columns
        for number in np.unique(run) if run.any() else ():
            yield channel, "all", f"run {number + 1}", _rows(own & (run == number))
    modulus = rows.channel == MODULUS
    if modulus.any():
        yield "modulus", "V", "constant", _rows(modulus)
    for row in () if run.any() else range(len(linear)):
        i = rows.reading[row]
        pattern = message(f"single reading: pass {readings.pass_number[i]}, point {readings.point[i]}")
        at = str(mounts[row] if oriented[row] else label[row])
        yield _CHANNEL[rows.channel[row]], at, pattern, _rows(np.arange(len(linear)) == row)


def _rows(of: Mask) -> Floats:
    """Return a column (N, 1) with the same value in each row of the mask."""
    return of[:, None].astype(np.float64)


def _in_mount(linear: LinearSystem, own: Mask) -> Iterator[tuple[str, Floats]]:
    """Yield the patterns over the angles, passes and directions in some rows of a mounting."""
    readings, reading = linear.readings, linear.rows.reading
    angle, passes = readings.angle_rad[reading], readings.pass_number[reading]
    direction = readings.direction[reading].astype(np.float64)
    waves = {
        k: np.where(own[:, None], np.column_stack([np.cos(k * angle), np.sin(k * angle)]), 0.0)
        for k in range(1, len(HARMONICS))
    }
    yield HARMONICS[0], _rows(own)
    for k, wave in waves.items():
        yield HARMONICS[k], wave
    numbers = sorted(set(passes[own].tolist()))
    for number in numbers if len(numbers) > 1 else ():
        yield f"pass {number}", _rows(own & (passes == number))
    if len(set(direction[own].tolist())) > 1:
        yield message("direction of approach"), _rows(own) * direction[:, None]
        yield message("direction of approach, once per turn"), waves[1] * direction[:, None]


def _over_run(linear: LinearSystem, own: Mask) -> Iterator[tuple[str, Floats]]:
    """Yield the patterns over the time, the temperature and the voltage in the rows of a channel."""
    readings, reading = linear.readings, linear.rows.reading
    signal = readings.signal[reading, np.minimum(linear.rows.channel, 2)]
    for pattern, values in (
        (message("time"), readings.time_s),
        (message("temperature"), readings.temperature_c),
    ):
        at = values[reading]
        if np.all(np.isfinite(at[own])) and np.ptp(at[own]) > 0:
            run = np.where(own, (at - np.mean(at[own])) / np.ptp(at[own]), 0.0)
            yield message(f"{pattern}, bias"), run[:, None]
            scale = run * signal
            yield message(f"{pattern}, scale factor"), scale[:, None] / max(np.max(np.abs(scale)), 1e-300)
    if readings.unit == "V":
        low = own & (np.abs(signal) < LOW_RANGE_V)
        if low.any() and (own & ~low).any():
            yield message("signals below 1.2 V"), _rows(low)


@dataclass(frozen=True)
class FarReading:
    """A reading that is far from its prediction by a model fitted without it.

    `size_u` is the distance in standard uncertainties. `channel` is x, y, z, "modulus", or "setting" for an error
    in the direction of a setting error. `p` is the probability that noise moves at least one of all readings that
    far.
    """

    installation: str
    pass_number: int
    point: int
    channel: str
    size_u: float
    p: float

    @property
    def words(self) -> str:
        """A clause with the place of the reading and its distance."""
        of = {"modulus": "|a|", "setting": message("the angle")}.get(
            self.channel, message(f"channel {self.channel}")
        )
        return message(
            f"{of} in installation {self.installation}, pass {self.pass_number}, point {self.point} is "
            f"{self.size_u:.0f} u off"
        )


def far_readings(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> tuple[FarReading, ...]:
    """Return the readings that are far from the model with the columns `effects` (N, m), farthest first.

    Distances are deletion residuals: Cook and Weisberg, Residuals and Influence in Regression, 1982, section
    2.2.
    """
    heavy = linear.by_row is not None
    rows = replace(linear.with_random(KNOWN_SIZE * effects), by_row=None)
    white = make_whitener(rows, noise.reading, noise.setting_rad)
    pull = white.weigh(linear.response) / noise.reading
    size = np.abs(pull) / np.sqrt(np.maximum(white.diagonal, 1e-12))
    off = [
        (float(of), int(reading), _CHANNEL[channel])
        for of, reading, channel in zip(size, linear.rows.reading, linear.rows.channel, strict=True)
    ]
    for start in range(0, linear.settings, CHUNK):
        numbers = np.arange(start, min(start + CHUNK, linear.settings))
        own = np.where(linear.setting[:, None] == numbers, linear.slope[:, None], 0.0)
        along, seen = np.abs(pull @ own), np.sum(own * white.weigh(own), axis=0)
        first = linear.rows.reading[np.argmax(linear.setting[:, None] == numbers, axis=0)]
        known = seen > 0.0
        of_settings = zip((along[known] / np.sqrt(seen[known])).tolist(), first[known].tolist(), strict=True)
        off += [(of, reading, "setting") for of, reading in of_settings]
    told: dict[int, FarReading] = {}
    readings, looks = linear.readings, len(size) + linear.settings
    for of, i, channel in sorted((one for one in off if one[0] >= FAR), key=lambda one: -one[0]):
        scaled = of * np.sqrt(TAIL_DOF / (TAIL_DOF - 2.0))
        p = 2.0 * float(special.stdtr(TAIL_DOF, -scaled) if heavy else special.ndtr(-of))
        place = (str(readings.installation[i]), int(readings.pass_number[i]), int(readings.point[i]))
        told.setdefault(i, FarReading(*place, channel, of, float(-np.expm1(looks * np.log1p(-min(p, 0.5))))))
    return tuple(told.values())


_CHANNEL: Final = (*CHANNELS, "modulus")


def looking_like(angle_rad: Floats, order: int) -> tuple[int, ...]:
    """Return the periods per turn, up to one per mark, indistinguishable from `order` at the angles (n,).

    Order 0 is a constant, which the coefficients absorb. Angles within 0.1 deg, or whole turns, count as one.
    """
    tenths = np.round(np.degrees(angle_rad[np.isfinite(angle_rad)]) * 10.0) % 3600.0
    angles = np.radians(np.unique(tenths) / 10.0)
    own = _waves(angles, order)
    others = (k for k in range(1, round(360.0 / MARK_DEG) + 1) if k != order)
    return tuple(k for k in others if _left(_waves(angles, k), own) < ALIKE)


def order_of(applied: AppliedEffect) -> int | None:
    """Return the number of periods per turn of an effect; None if it is not a wave of the head angle."""
    order: int | None = getattr(applied.effect, "order", None)
    if order is not None:
        return order
    harmonic = applied.complete_values().get("harmonic")
    return None if harmonic is None else round(float(harmonic))


def _waves(angle_rad: Floats, order: int) -> Floats:
    """Return cosine and sine (n, 2) of a number of periods per turn, or a constant (n, 1) if it is 0."""
    if order == 0:
        return np.ones((len(angle_rad), 1))
    return np.stack([np.cos(order * angle_rad), np.sin(order * angle_rad)], axis=1)


def _left(waves: Floats, own: Floats) -> float:
    """Return the largest fraction of the square of any of the `waves` that the `own` waves leave unexplained."""
    size = np.maximum(np.sum(waves**2, axis=0), 1e-12 * len(waves))
    fitted = own @ np.linalg.lstsq(own, waves, rcond=INSEPARABLE)[0]
    return float(np.max(np.sum((waves - fitted) ** 2, axis=0) / size, initial=0.0))
