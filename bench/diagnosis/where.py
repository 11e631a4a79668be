"""Residual patterns: where readings and model disagree, the largest first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.base.languages import message
from bench.diagnosis.evidence import KNOWN_SIZE
from bench.diagnosis.levels import BY_CHANCE, FAR
from bench.diagnosis.linear import MODULUS, LinearSystem
from bench.diagnosis.noise_grid import NoiseGrid, make_whitener
from bench.diagnosis.noise_kinds import TAIL_DOF
from bench.diagnosis.posterior import NoiseSize
from bench.model.effects import AppliedEffect
from bench.model.effects.voltmeter import LOW_RANGE_V

TOLD: Final = 1e-3
"""A column of which earlier patterns leave at most this fraction is explained by them."""
MOST_PLACES: Final = 8
HARMONICS: Final = (
    "constant",
    message("once per turn"),
    message("twice per turn"),
    message("three times per turn"),
    message("four times per turn"),
)


@dataclass(frozen=True)
class ResidualPattern:
    """One pattern in the residuals.

    `size` is its amplitude in the unit of the signal, `p` its p-value, corrected for all tests.
    """

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
) -> tuple[ResidualPattern, ...]:
    """Return the patterns that stand out of the noise with all looks counted, at most `MOST_PLACES`.

    `sigma` is the noise of a reading as the repeats give it, with `freedom`; `ratio` says which of the grid.
    """
    looks = list(_looks(linear))
    white = grid.white[ratio] @ np.concatenate([look.columns for look in looks], axis=1)
    wide = np.array([look.columns.shape[1] for look in looks])
    first = np.cumsum(wide) - wide
    size_of = np.linalg.norm(white, axis=0)
    left = grid.white[ratio] @ linear.response
    places: list[ResidualPattern] = []
    basis = np.zeros((len(left), 0))
    while len(places) < MOST_PLACES:
        seen = white - basis @ (basis.T @ white)
        square, usable = _explained(seen, left, first, wide > 1, TOLD * size_of)
        statistic = square / wide / sigma**2
        p_each = np.where(usable, special.fdtrc(wide, freedom, statistic), np.inf)
        # where p underflows the size of the statistic still orders
        best = int(np.lexsort((-statistic, p_each))[0])
        p, look = float(p_each[best]), looks[best]
        if p * len(looks) > BY_CHANCE:
            break
        q, r = np.linalg.qr(seen[:, first[best] : first[best] + wide[best]])
        amplitude = np.linalg.solve(r, q.T @ left)
        size = float(np.max(np.abs(look.columns @ amplitude)))
        places.append(
            ResidualPattern(
                look.channel, look.installation, look.pattern, size, linear.readings.unit,
                min(1.0, p * len(looks)), p,
            )
        )  # fmt: skip
        left = left - q @ (q.T @ left)
        basis = np.column_stack([basis, q])
    return tuple(places)


def _explained(seen: Floats, left: Floats, first: Ints, two: Mask, least: Floats) -> tuple[Floats, Mask]:
    """Return the square that each pattern explains of the residuals, and whether the residuals determine its
    columns.

    A pattern has the column `first` of `seen` (N, columns), and with `two` the next column. A column is
    determined where its length exceeds `least`.
    """
    second = np.minimum(first + 1, seen.shape[1] - 1)
    along = seen.T @ left
    own, other = np.sum(seen[:, first] ** 2, axis=0), np.sum(seen[:, second] ** 2, axis=0)
    mixed = np.sum(seen[:, first] * seen[:, second], axis=0)
    usable = np.sqrt(own) > least[first]
    slope = mixed / np.where(usable, own, 1.0)
    rest = np.maximum(other - slope * mixed, 0.0)
    usable &= ~two | (np.sqrt(rest) > least[second])
    square = along[first] ** 2 / np.where(usable, own, 1.0)
    more = (along[second] - slope * along[first]) ** 2 / np.where(usable & two, rest, 1.0)
    return square + np.where(two, more, 0.0), usable


def _looks(linear: LinearSystem) -> Iterator[_Look]:
    rows, readings = linear.rows, linear.readings
    label = readings.installation[rows.reading]
    series = readings.series[rows.reading]
    run = readings.run[rows.reading]
    # of several runs, what is the same in all of them
    visits = series if not run.any() else np.ones_like(series)
    mounts = np.array([i if s == 1 else f"{i}/{s}" for s, i in zip(visits, label, strict=True)])
    oriented = linear.setting >= 0
    for c, channel in enumerate(CHANNELS):
        own = oriented & (rows.channel == c)
        for mount in dict.fromkeys(mounts[own].tolist()):
            yield from _in_mount(linear, own & (mounts == mount), channel, mount)
        yield from _over_run(linear, own, channel)
        if run.any():
            numbers = np.unique(run)
            yield from (_Look(channel, "all", f"run {n + 1}", _rows(own & (run == n))) for n in numbers)
    modulus = rows.channel == MODULUS
    if modulus.any():
        yield _Look("modulus", "V", "constant", _rows(modulus))
    if run.any():
        return
    if modulus.any():
        yield from (
            _single(linear, row, "modulus", str(label[row])) for row in np.flatnonzero(modulus).tolist()
        )
    for row in np.flatnonzero((linear.setting < 0) & ~modulus).tolist():
        yield _single(linear, row, CHANNELS[rows.channel[row]], str(label[row]))


def _rows(of: Mask) -> Floats:
    """Return a column (N, 1) with the same value in each row of the mask."""
    return of[:, None].astype(np.float64)


def _single(linear: LinearSystem, row: int, channel: str, mount: str) -> _Look:
    readings, reading = linear.readings, linear.rows.reading[row]
    pattern = message(
        f"single reading: pass {readings.pass_number[reading]}, point {readings.point[reading]}"
    )
    return _Look(channel, mount, pattern, _rows(np.arange(len(linear)) == row))


def _in_mount(linear: LinearSystem, own: Mask, channel: str, mount: str) -> Iterator[_Look]:
    readings, reading = linear.readings, linear.rows.reading
    angle = readings.angle_rad[reading]
    passes = readings.pass_number[reading]
    direction = readings.direction[reading]
    look = partial(_Look, channel, mount)
    yield look(HARMONICS[0], _rows(own))
    for k in (1, 2, 3, 4):
        wave = np.column_stack([np.cos(k * angle), np.sin(k * angle)])
        yield look(HARMONICS[k], np.where(own[:, None], np.nan_to_num(wave), 0.0))
    numbers = sorted(set(passes[own].tolist()))
    if len(numbers) > 1:
        yield from (look(f"pass {number}", _rows(own & (passes == number))) for number in numbers)
    if len(set(direction[own].tolist())) > 1:
        yield look(message("direction of approach"), np.where(own, direction, 0.0)[:, None])
        wave = np.column_stack([np.cos(angle), np.sin(angle)])
        turned = np.where(own[:, None], np.nan_to_num(wave) * direction[:, None], 0.0)
        yield look(message("direction of approach, once per turn"), turned)
    if not readings.run.any():
        yield from (_single(linear, row, channel, mount) for row in np.flatnonzero(own).tolist())


def _over_run(linear: LinearSystem, own: Mask, channel: str) -> Iterator[_Look]:
    readings, reading = linear.readings, linear.rows.reading
    look = partial(_Look, channel, "all")
    signal = readings.signal[reading, np.minimum(linear.rows.channel, 2)]
    for pattern, values in (
        (message("time"), readings.time_s),
        (message("temperature"), readings.temperature_c),
    ):
        at = values[reading]
        if np.all(np.isfinite(at[own])) and np.ptp(at[own]) > 0:
            run = np.where(own, (at - np.mean(at[own])) / np.ptp(at[own]), 0.0)
            yield look(message(f"{pattern}, bias"), run[:, None])
            scale = run * signal
            scale = scale / max(float(np.max(np.abs(scale))), 1e-300)
            yield look(message(f"{pattern}, scale factor"), scale[:, None])
    if readings.unit == "V":
        low = own & (np.abs(signal) < LOW_RANGE_V)
        if low.any() and (own & ~low).any():
            yield look(message("signals below 1.2 V"), _rows(low))


@dataclass(frozen=True)
class FarReading:
    """A reading that lies `size_u` standard uncertainties from its prediction by a model fitted without it.

    `channel` is x, y, z, "modulus" or "setting" (along the turn of the head). `p` is the probability of such a
    distance anywhere by the fitted noise.
    """

    installation: str
    pass_number: int
    point: int
    channel: str
    size_u: float
    p: float

    @property
    def words(self) -> str:
        """The place and the size in words."""
        of = {"modulus": "|a|", "setting": message("the angle")}.get(
            self.channel, message(f"channel {self.channel}")
        )
        return message(
            f"{of} in installation {self.installation}, pass {self.pass_number}, point {self.point} is "
            f"{self.size_u:.0f} u off"
        )


def far_readings(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> tuple[FarReading, ...]:
    """Return the readings far from the final model with the effects' columns (N, m), the farthest first.

    The sizes are deletion residuals: each is compared with the model fitted without it (Cook and Weisberg,
    Residuals and Influence in Regression, 1982, section 2.2), with the noise of its channel.
    """
    heavy = linear.by_row is not None
    random = np.column_stack([linear.random, KNOWN_SIZE * effects])
    rows = replace(linear, random=random, by_row=None)
    white = make_whitener(rows, noise.reading, noise.setting_rad)
    pull = white.weigh(linear.response) / noise.reading
    size = np.abs(pull) / np.sqrt(np.maximum(white.diagonal, 1e-12))
    looks = len(size) + linear.settings
    found = [
        (float(size[i]), int(linear.rows.reading[i]), _CHANNEL[linear.rows.channel[i]])
        for i in range(len(size))
    ]
    for number in range(linear.settings):
        own = np.where(linear.setting == number, linear.slope, 0.0)[:, None]
        seen = float((own.T @ white.weigh(own))[0, 0])
        if seen > 0.0:
            along = abs(float(own[:, 0] @ pull)) / np.sqrt(seen)
            found.append((along, int(linear.rows.reading[np.argmax(linear.setting == number)]), "setting"))
    far = sorted((one for one in found if one[0] >= FAR), key=lambda one: -one[0])
    told: dict[int, FarReading] = {}
    readings = linear.readings
    for off, i, channel in far:
        scaled = off * np.sqrt(TAIL_DOF / (TAIL_DOF - 2.0))
        p = 2.0 * float(special.stdtr(TAIL_DOF, -scaled) if heavy else special.ndtr(-off))
        place = (str(readings.installation[i]), int(readings.pass_number[i]), int(readings.point[i]))
        told.setdefault(i, FarReading(*place, channel, off, float(-np.expm1(looks * np.log1p(-min(p, 0.5))))))
    return tuple(told.values())


_CHANNEL: Final = (*CHANNELS, "modulus")

MOST_PER_TURN: Final = 72
"""Orders looked at: 72 a turn is a mark every 5 degrees."""
ALIKE: Final = 0.01
"""Fraction of a wave's square that another wave may leave and still count as the same."""
SAME_ANGLE_DEG: Final = 0.1


def looking_like(angle_rad: Floats, order: int) -> tuple[int, ...]:
    """Return the other orders whose waves are indistinguishable at these angles (n,) from waves of `order`.

    Order 0 stands for no wave: a wave that is constant at all angles, which the coefficients take up.
    """
    angles = _different(angle_rad)
    own = _waves(angles, order)
    others = (k for k in range(1, MOST_PER_TURN + 1) if k != order)
    return tuple(k for k in others if _left(_waves(angles, k), own) < ALIKE)


def order_of(applied: AppliedEffect) -> int | None:
    """Return the number of periods per turn of an effect; None if it is no wave of the head angle."""
    order: int | None = getattr(applied.effect, "order", None)
    if order is not None:
        return order
    harmonic = applied.complete_values().get("harmonic")
    return None if harmonic is None else round(float(harmonic))


def _different(angle_rad: Floats) -> Floats:
    """Return the angles that differ by more than settings scatter, within a turn, rad."""
    degrees = np.sort(np.degrees(angle_rad[np.isfinite(angle_rad)]) % 360.0)
    kept = degrees[np.concatenate([[True], np.diff(degrees) > SAME_ANGLE_DEG])] if len(degrees) else degrees
    around = len(kept) > 1 and kept[0] + 360.0 - kept[-1] < SAME_ANGLE_DEG
    return np.asarray(np.radians(kept[:-1] if around else kept))


def _waves(angle_rad: Floats, order: int) -> Floats:
    """Return cosine and sine of a number of periods a turn, (n, 2); for none a constant, (n, 1)."""
    if order == 0:
        return np.ones((len(angle_rad), 1))
    return np.stack([np.cos(order * angle_rad), np.sin(order * angle_rad)], axis=1)


def _left(waves: Floats, own: Floats) -> float:
    """Return the largest fraction of a wave's square that the other waves leave."""
    size = np.maximum(np.sum(waves**2, axis=0), 1e-12 * len(waves))
    fitted = own @ np.linalg.lstsq(own, waves, rcond=1e-6)[0]
    return float(np.max(np.sum((waves - fitted) ** 2, axis=0) / size, initial=0.0))
