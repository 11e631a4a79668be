"""Corrections of readings: known instrument errors, tilt of the platform, mistakes made at a bench."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

import numpy as np

from bench.base.arrays import ARCSEC, CHANNELS, HOUR, Floats
from bench.model.geometry import Distribution
from bench.readings.columns import ANGLES, DRIFTS
from bench.readings.table import Readings
from drivers.angles import SLIPS

# --- corrections ------------------------------------------------------------------------------------

Curve = tuple[tuple[float, float], ...]
"""A correction table: pairs of (position, correction) at rising positions, interpolated linearly."""

VOLTS: Final = "V"
AGAIN: Final = 4
"""Fixed-point iterations to invert a correction; few are enough, as a correction is small and smooth."""


@dataclass(frozen=True)
class Corrections:
    """Corrections of head angles, temperatures and signals; a signal U becomes U (1 + `gain`) + `offset_v`.

    `head` lists pairs (angle, correction), rad, and repeats every turn. `thermometer` lists pairs (temperature in
    °C, correction in K). Beyond the listed temperatures, the correction is that of the nearest listed one.
    """

    gain: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_v: tuple[float, float, float] = (0.0, 0.0, 0.0)
    head: Curve = ()
    thermometer: Curve = ()

    @property
    def of_signals(self) -> bool:
        """Whether any signal is corrected."""
        return any(self.gain) or any(self.offset_v)

    def then(self, gain: tuple[float, float, float], offset_v: tuple[float, float, float]) -> Corrections:
        """Return corrections in two steps: first these, then the signals become U (1 + `gain`) + `offset_v`."""
        both = [(1.0 + own) * (1.0 + more) - 1.0 for own, more in zip(self.gain, gain, strict=True)]
        sums = [own * (1.0 + more) + added
                for own, more, added in zip(self.offset_v, gain, offset_v, strict=True)]  # fmt: skip
        return replace(self, gain=(both[0], both[1], both[2]), offset_v=(sums[0], sums[1], sums[2]))

    def __bool__(self) -> bool:
        return self.of_signals or bool(self.head) or bool(self.thermometer)


def corrected(readings: Readings, by: Corrections) -> Readings:
    """Return the readings corrected and marked as corrected; unchanged if already marked or `by` is empty.

    Only signals in volts are corrected. `resolution_read` keeps the resolution before correction.
    """
    if readings.corrected or not by:
        return readings
    angle_rad, temperature_c = readings.angle_rad, readings.temperature_c
    return replace(
        readings,
        **_signals(readings, by, back=False),
        angle_rad=angle_rad + _of_head(by, angle_rad),
        temperature_c=temperature_c + _of_thermometer(by, temperature_c),
        corrected=True,
        resolution_read=readings.resolution,
    )


def as_read(readings: Readings, by: Corrections) -> Readings:
    """Return the readings as read, the inverse of `corrected`; uncorrected readings are returned unchanged."""
    if not readings.corrected or not by:
        return readings
    angle_rad, temperature_c = readings.angle_rad, readings.temperature_c
    for _ in range(AGAIN):
        angle_rad = readings.angle_rad - _of_head(by, angle_rad)
        temperature_c = readings.temperature_c - _of_thermometer(by, temperature_c)
    return replace(
        readings,
        **_signals(readings, by, back=True),
        angle_rad=angle_rad,
        temperature_c=temperature_c,
        corrected=False,
        resolution_read=None,
    )


def _signals(readings: Readings, by: Corrections, *, back: bool) -> dict[str, Any]:
    """Return the signals and their standard deviations with the corrections applied, or undone if `back`."""
    if not by.of_signals or readings.unit != VOLTS:
        return {}
    scale, offset_v = 1.0 + np.array(by.gain), np.array(by.offset_v)
    if back:
        return {"signal": (readings.signal - offset_v) / scale, "signal_sd": readings.signal_sd / scale}
    return {"signal": readings.signal * scale + offset_v, "signal_sd": readings.signal_sd * scale}


def _of_head(by: Corrections, angle_rad: Floats) -> Floats | float:
    return on_scale(by.head, angle_rad) if by.head else 0.0


def _of_thermometer(by: Corrections, temperature_c: Floats) -> Floats | float:
    return np.interp(temperature_c, *np.array(by.thermometer).T) if by.thermometer else 0.0


def on_scale(table: Curve, angle_rad: Floats) -> Floats:
    """Return the head's corrections (n,), rad, at angles (n,) from `table`; NaN for an unknown angle."""
    known_rad, added_rad = np.array(table).T
    return np.asarray(np.interp(angle_rad, known_rad, added_rad, period=math.tau))


DAY: Final = 24.0 * HOUR

FOUNDATION: Final = Distribution(2.0 * ARCSEC / DAY, "rectangular")
"""Prior of a foundation's tilt rate if not measured, rad/s; the paper states 1 to 2 arcseconds a day."""
FOUNDATION_ARCSEC_H: Final = FOUNDATION.u * HOUR / ARCSEC
REFUTED: Final = 3.0
"""The prior `FOUNDATION` is discarded if two readings differ by more than this many standard uncertainties."""


@dataclass(frozen=True)
class LevelReading:
    """A reading of the level `time_s` seconds after the start of the run: α1 and α2 with their u, arcsec.

    `mounting` is (series, installation); `levelled` says whether the platform was levelled just before.
    """

    time_s: float
    mounting: tuple[int, str]
    levelled: bool
    alpha_arcsec: tuple[float, float]
    u_arcsec: tuple[float, float]


def with_levels(readings: Readings, seen: Sequence[LevelReading]) -> Readings:
    """Return the readings with text columns of the platform's tilt; unchanged if no mounting was levelled.

    `seen` are all level readings in the order of time. The angles of a mounting without levelling are empty.
    """
    found = {
        mounting: of for mounting in {s.mounting for s in seen} if (of := _mounting_level(seen, mounting))
    }
    if not found:
        return readings
    drifts = [drift for _, drift in found.values() if drift]
    columns: dict[str, list[str]] = {name: [] for name in (*ANGLES, *(DRIFTS if drifts else ()))}
    for place in zip(readings.series.tolist(), readings.installation.tolist(), strict=True):
        known = found.get(place)
        for k, name in enumerate(ANGLES):
            columns[name].append("" if known is None else f"{known[0][k]:.4f}")
        for k, name in enumerate(DRIFTS if drifts else ()):
            columns[name].append(f"{math.sqrt(sum(drift[k] ** 2 for drift in drifts) / len(drifts)):.5f}")
    cells = {name: np.array(column, dtype=np.str_) for name, column in columns.items()}
    return replace(readings, extra={**readings.extra, **cells})


def _mounting_level(
    seen: Sequence[LevelReading], mounting: tuple[int, str]
) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Return the platform's tilt at the middle time of a mounting; None if it was not levelled before.

    The first tuple has α1, α2, u(α1) and u(α2), arcsec; the second their rms rates, arcsec/h, empty if unknown.
    """
    own = [s for s in seen if s.mounting == mounting]
    last = max((k for k, s in enumerate(own) if s.levelled), default=None)
    if last is None:
        return None
    first, again = own[last], own[-1]
    hours = (again.time_s - first.time_s) / HOUR
    if again is first or hours <= 0.0:
        return (*first.alpha_arcsec, *first.u_arcsec), ()
    along, across = (
        _middle_and_rate(
            (first.alpha_arcsec[k], again.alpha_arcsec[k]), (first.u_arcsec[k], again.u_arcsec[k]), hours
        )
        for k in (0, 1)
    )
    return (along[0], across[0], along[1], across[1]), (along[2], across[2])


def _middle_and_rate(
    alpha: tuple[float, float], u: tuple[float, float], hours: float
) -> tuple[float, float, float]:
    """Return the angle at the middle time between two level readings, its u, and its rms rate of change.

    The angle is assumed to change linearly. The rate has the prior 0 ± `FOUNDATION`; if the readings refute this
    prior (`REFUTED`), it becomes 0 ± the observed rate.
    """
    moved = alpha[1] - alpha[0]
    rate_u = FOUNDATION_ARCSEC_H
    if abs(moved) > REFUTED * math.hypot(*u, rate_u * hours):
        rate_u = abs(moved) / hours
    rows = np.array(
        [[1.0 / u[0], -hours / (2.0 * u[0])], [1.0 / u[1], hours / (2.0 * u[1])], [0.0, 1.0 / rate_u]]
    )
    covariance = np.linalg.inv(rows.T @ rows)
    middle, rate = covariance @ rows.T @ np.array([alpha[0] / u[0], alpha[1] / u[1], 0.0])
    u_middle, u_rate = np.sqrt(np.diag(covariance))
    return float(middle), float(u_middle), float(math.hypot(rate, u_rate))


# --- mistakes made at a bench -----------------------------------------------------------------------
# The early warning tests a run for these mistakes, the diagnosis a table of readings.
# The scale-reading mistakes are those for which a person is asked to read again (`drivers.angles.SLIPS`).


class MistakeName(StrEnum):
    """The names of mistakes in results."""

    SWAPPED_CHANNELS = "swapped_channels"
    REVERSED_POLARITY = "reversed_polarity"
    REVERSED_ROTATION = "reversed_rotation"
    SWAPPED_INSTALLATIONS = "swapped_installations"
    SHIFTED_POINTS = "shifted_points"
    WRONG_SETTING = "wrong_setting"
    OUTLIER = "outlier"
    WRONG_UNIT = "wrong_unit"
    ANOTHER_BLOCK = "another_block"
    STUCK_CHANNEL = "stuck_channel"
    OTHER_MOUNTING = "other_mounting"
    """The block was mounted in some other orientation; other mistakes may resemble this one."""


@dataclass(frozen=True)
class Wiring:
    """The connection of the three signals to the channels; a mistake may have swapped or reversed some.

    For each true signal x, y, z, `order` holds the channel (0, 1, 2) that shows it, and `signs` the sign, +1 or -1,
    with which the channel shows it.
    """

    order: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def matrix(self) -> Floats:
        """The matrix (3, 3) that turns the three channels as read into the true signals."""
        return np.diag(self.signs) @ np.eye(3)[list(self.order)]

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that show a wrong signal or a wrong sign."""
        return tuple(CHANNELS[i] for i in range(3) if self.order[i] != i or self.signs[i] < 0)

    @property
    def shown(self) -> str:
        """The wiring in words, without the signs: "x shows z, y shows x, z shows y"."""
        return ", ".join(f"{CHANNELS[i]} shows {CHANNELS[self.order.index(i)]}" for i in range(3))


RIGHT: Final = Wiring()
"""The correct wiring: each channel shows its own signal."""

EXCHANGED: Final = tuple(Wiring(order) for order in ((1, 0, 2), (2, 1, 0), (0, 2, 1), (2, 0, 1), (1, 2, 0)))
"""Wirings with two channels exchanged, or with all three permuted cyclically."""

REVERSED: Final = tuple(
    Wiring(signs=signs) for signs in ((-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, -1.0))
)
"""Wirings with one channel reversed."""

OPPOSITE_RAD: Final = float(np.pi)
SLIPS_RAD: Final = {
    size: float(np.radians(degrees)) for size, degrees, _ in SLIPS if np.radians(degrees) < OPPOSITE_RAD
}
"""Size of the angle error, rad, of each common mistake in reading the scale, by name; either sign is possible."""


def reflected_rad(angle_rad: Floats) -> Floats:
    """Return the error of an angle φ, rad, wrapped to [-π, π), if 360° - φ was read instead of φ."""
    return np.remainder(-2 * angle_rad + np.pi, 2 * np.pi) - np.pi
