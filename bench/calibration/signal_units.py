"""Signals in another unit than the file says: all of them, those of a channel, of a pass, of an installation.

A wrong prefix multiplies signals by a power of 1000, which nothing else at a bench does. Each channel's size in
each part of the table is compared with the data sheet, or with the smallest where there is none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints, least_squares
from bench.calibration.result import CalibrationError
from bench.model import Block, ForwardModel
from bench.model.geometry import STAND_ANGLES, linear_columns
from bench.readings.table import REFERENCE, SHORTED, Readings

PREFIX: Final = 3.0
"""Powers of ten from a prefix to the next."""
NEAR: Final = 0.3
"""A size is one of these factors off where it is within a factor of 2 of it."""
LEAST_SPAN_G: Final = 0.5
"""Along a channel, in a part of the table: less says nothing of its size."""
PREFIXES: Final = (-2, -1, 0, 1, 2)
MUCH_BETTER: Final = 1e-4
"""A part in which a channel hardly moves has the unit that leaves no more of the sum of squares."""
CLEARLY: Final = 30.0
"""Three signals together are so many times larger or smaller than usual where their unit is another."""
FITS: Final = 0.02
"""Part of the variance of the signals that is left at most where the units are right."""

_NAMES: Final = {
    "V": {1: "mV", 2: "µV"},
    "g": {1: "mg", 2: "µg"},
    "m/s^2": {1: "mm/s²", 2: "µm/s²"},
}


@dataclass(frozen=True)
class WrongUnit:
    """Which signals are in another unit: `power` (n, 3) of 1000 by which each row of the table is too large.

    `part` is what has it in words, empty for all rows; `channels` those that have it; `pass_number` and
    `installation` where it is one of these. `whole` says that it is all signals, which only the data sheet shows.
    """

    power: Ints
    part: str
    channels: tuple[str, ...]
    unit: str
    size: int
    pass_number: int | None = None
    installation: str | None = None

    @property
    def whole(self) -> bool:
        """Whether it is all signals."""
        return not self.part and len(self.channels) == len(CHANNELS)

    @property
    def words(self) -> str:
        """Say which signals, and in which unit they are."""
        what = (
            "all signals" if len(self.channels) == 3 else f"the signals of channel {', '.join(self.channels)}"
        )
        than = "the data sheet, if that is of this block" if self.whole else "the others"
        name = _NAMES.get(self.unit, {}).get(self.size)
        said = f"in {name}, where the file says {self.unit}" if name else "in another unit than the file says"
        return (
            f"{what}{self.part} seem to be {said}: they are {10 ** (3 * abs(self.size))} times too "
            f"{'large' if self.size > 0 else 'small'} beside {than}"
        )

    def corrected(self, readings: Readings) -> Readings:
        """Return a copy with these signals in the unit of the others."""
        factor = 10.0 ** (-PREFIX * self.power)
        return replace(
            readings,
            signal=readings.signal * factor,
            signal_sd=readings.signal_sd * factor,
            resolution_read=None,
        )


def wrong_unit(readings: Readings, model: ForwardModel, nominal: Sequence[float] | None) -> WrongUnit | None:
    """Return which signals are in another unit, None where none are or it is not clear which.

    `nominal` (3,) are the scale factors of the data sheet, in the unit of the signal per g; without them signals
    are compared among themselves.
    """
    oriented = readings.oriented()
    if (
        not len(oriented)
        or not np.isfinite(oriented.signal).all()
        or not np.isfinite(oriented.angle_rad).all()
    ):
        return None
    conditions = oriented.conditions()
    still = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
    plain = replace(model, effects=())
    force = plain.specific_force(conditions, still, Block(np.eye(3), np.zeros(3)))
    for name, labels in _groupings(oriented):
        power = _powers(oriented.signal, force, labels, nominal)
        _with_still_parts(power, oriented.signal, force, labels)
        if not power.any():
            continue
        scaled = oriented.signal * 10.0 ** (-PREFIX * power)
        if _unexplained(force, scaled) > FITS:
            continue
        return _described(readings, oriented, name, labels, power, scaled)
    return None


def refuse_mixed_units(readings: Readings, model: ForwardModel, nominal: Sequence[float] | None) -> None:
    """Refuse signals of which some are in another unit. Raises `CalibrationError`."""
    found = wrong_unit(readings, model, nominal)
    if found is not None and not found.whole:
        raise CalibrationError(
            f"{readings.source}: {found.words}; write them in one unit, or 'bench diagnose' writes a corrected copy"
        )


def _groupings(readings: Readings) -> Iterator[tuple[str, list[str]]]:
    """Yield in which parts of a table units may differ: nowhere, by pass, by installation."""
    yield "", [""] * len(readings)
    yield "pass", [str(number) for number in readings.pass_number]
    yield "installation", [str(label) for label in readings.installation]


def _powers(signal: Floats, force: Floats, labels: list[str], nominal: Sequence[float] | None) -> Ints:
    """Return by which power of 1000 the signals of each row are too large, (n, 3)."""
    names = sorted(set(labels))
    rows = {name: np.array([label == name for label in labels]) for name in names}
    size = np.array([_sizes(signal[rows[name]], force[rows[name]]) for name in names])
    reference = np.log10(np.abs(nominal)) if nominal is not None else np.nanmin(size, initial=np.inf)
    off = (size - reference) / PREFIX
    whole = np.round(off)
    known = np.isfinite(off) & (np.abs(off - whole) <= NEAR / PREFIX)
    power = np.zeros((len(signal), 3), dtype=np.int64)
    for k, name in enumerate(names):
        told = np.unique(whole[k][known[k]])
        # a channel that hardly moves there goes with the others, where these agree
        one = np.where(known[k], whole[k], told[0] if len(told) == 1 else 0.0)
        power[rows[name]] = one.astype(np.int64)
    return power


def _with_still_parts(power: Ints, signal: Floats, force: Floats, labels: list[str]) -> None:
    """Put into `power` the parts in which a channel hardly moves: by the bias that makes them fit the others."""
    for i in range(3):
        own = signal[:, i : i + 1] * 10.0 ** (-PREFIX * power[:, i : i + 1])
        if _unexplained(force, own) <= FITS:
            continue
        for name in sorted(set(labels)):
            rows = np.array([label == name for label in labels])
            if np.isfinite(_sizes(signal[rows], force[rows])[i]):
                continue
            left = {
                c: _left(force, np.where(rows[:, None], own * 10.0 ** (-PREFIX * c), own)) for c in PREFIXES
            }
            best = min(left, key=left.__getitem__)
            if left[best] < MUCH_BETTER * left[0]:
                power[rows, i] += best


def _left(force: Floats, signal: Floats) -> float:
    """Return the sum of squares that the nominal geometry leaves."""
    return float(np.sum(least_squares(linear_columns(force), signal)[1] ** 2))


def _sizes(signal: Floats, force: Floats) -> Floats:
    """Return log10 of each channel's signal per g, (3,); NaN where it hardly moves."""
    low, high = np.percentile(signal, [5, 95], axis=0)
    from_g, to_g = np.percentile(force, [5, 95], axis=0)
    moves = (to_g - from_g >= LEAST_SPAN_G) & (high > low)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moves, np.log10((high - low) / (to_g - from_g)), np.nan)


def _unexplained(force: Floats, signal: Floats) -> float:
    """Return the part of the variance that the nominal geometry leaves, the worst channel's."""
    _, left = least_squares(linear_columns(force), signal)
    whole = np.sum((signal - signal.mean(axis=0)) ** 2, axis=0)
    return float(np.max(np.sum(left**2, axis=0) / np.maximum(whole, 1e-300)))


def _described(
    readings: Readings, oriented: Readings, name: str, labels: list[str], power: Ints, scaled: Floats
) -> WrongUnit:
    wrong = sorted({label for label, row in zip(labels, power, strict=True) if row.any()})
    channels = tuple(axis for axis, of in zip(CHANNELS, power.T, strict=True) if of.any())
    alone = wrong[0] if name and len(wrong) == 1 else None
    whole = np.zeros((len(readings), 3), dtype=np.int64)
    whole[readings.is_oriented] = power
    for row in np.flatnonzero(~readings.is_oriented):
        whole[row] = _of_other(readings, int(row), power, scaled, everywhere=not name)
    return WrongUnit(
        whole,
        f" of {name} {', '.join(wrong)}" if name else "",
        channels,
        readings.unit,
        int(power.flat[np.flatnonzero(power)[0]]),
        int(alone) if alone is not None and name == "pass" else None,
        alone if name == "installation" else None,
    )


def _of_other(readings: Readings, row: int, power: Ints, scaled: Floats, *, everywhere: bool) -> Ints:
    """Return the power for a row that is not oriented: that of all, or by the size of its signals."""
    if everywhere or readings.installation[row] in {REFERENCE, SHORTED}:
        return power[0] if everywhere else np.zeros(3, dtype=np.int64)
    usual = float(np.median(np.linalg.norm(scaled, axis=1)))
    if CLEARLY > float(np.linalg.norm(readings.signal[row])) / usual > 1 / CLEARLY:
        return np.zeros(3, dtype=np.int64)
    choices = np.unique(power, axis=0)
    sizes = np.linalg.norm(readings.signal[row] * 10.0 ** (-PREFIX * choices), axis=1)
    return np.asarray(choices[int(np.argmin(np.abs(np.log(np.maximum(sizes, 1e-300) / usual))))])


def sheet_of(unit: str, scale_factors: Sequence[float]) -> Sequence[float] | None:
    """Return what a data sheet says of signals in a unit: scale factors in V/g, of accelerations 1; else None."""
    return {"V": scale_factors or None, "g": (1.0, 1.0, 1.0), "m/s^2": (9.81, 9.81, 9.81)}.get(unit)
