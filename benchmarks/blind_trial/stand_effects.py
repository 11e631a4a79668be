"""Effects of the stand: angles in rad that the exact geometry takes."""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.truth import Draw, Shift, Truth, mount_weights


def _per_mount(name: str, arcsec: float, key: str, *, after_remount: bool = False) -> Draw:
    """Return the draw of an effect that adds a constant angle in some mountings."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        weights, mounts = mount_weights(rng, run, after_remount=after_remount)

        def shift(_: Run, x: float) -> Shift:
            return {key: x * arcsec * ARCSEC * weights}

        return Truth(name, "stand", shift=shift, mounts=mounts)

    return draw


def _head_eccentricity(rng: np.random.Generator, run: Run) -> Truth:
    """The scale's centre beside the axis by the part e of its radius, towards the angle `towards`."""
    towards = rng.uniform(0, 2 * np.pi)

    def shift(r: Run, x: float) -> Shift:
        e, seen = 8 * x * ARCSEC, r.head_angle - towards
        return {"angle": np.arctan2(e * np.sin(seen), 1 + e * np.cos(seen))}

    return Truth("head_eccentricity", "stand", shift=shift, parameters={"towards": towards})


def _head_ellipticity(rng: np.random.Generator, run: Run) -> Truth:
    """The scale drawn out along `along`: tan φ on the ellipse is (1 + e) tan φ on the circle."""
    along = rng.uniform(0, np.pi)

    def shift(r: Run, x: float) -> Shift:
        e, seen = 2 * 5 * x * ARCSEC, r.head_angle - along
        turned = np.arctan2((1 + e) * np.sin(seen), np.cos(seen)) - seen
        return {"angle": (turned + np.pi) % (2 * np.pi) - np.pi}

    return Truth("head_ellipticity", "stand", shift=shift, parameters={"along": along})


def _head_graduation(rng: np.random.Generator, run: Run) -> Truth:
    """An error for each mark of the scale, 360° being the mark 0°."""
    errors = rng.normal(size=72)

    def shift(r: Run, x: float) -> Shift:
        marks = np.round(r.head_angle / np.radians(5)).astype(int) % 72
        return {"angle": 4 * x * ARCSEC * errors[marks]}

    return Truth("head_graduation", "stand", shift=shift)


def _backlash(rng: np.random.Generator, run: Run) -> Truth:
    sign = rng.choice([-1.0, 1.0])

    def shift(r: Run, x: float) -> Shift:
        return {"angle": sign * 10 * x * ARCSEC * r.direction / 2}

    return Truth("backlash", "stand", shift=shift)


def wobble(harmonic: int, phase: float, run: Run, arcsec: float) -> Floats:
    """Out-of-plane tilt (n,) in rad that goes round with the head `harmonic` times a turn."""
    return arcsec * ARCSEC * np.sin(harmonic * run.head_angle + phase)


def _axis_wobble(rng: np.random.Generator, run: Run) -> Truth:
    harmonic, phase = int(rng.integers(1, 3)), rng.uniform(0, 2 * np.pi)

    def shift(r: Run, x: float) -> Shift:
        return {"tilt": wobble(harmonic, phase, r, 5 * x)}

    return Truth(
        "axis_wobble", "stand", shift=shift, shape=f"harmonic {harmonic}", parameters={"phase": phase}
    )


def _foundation_tilt(rng: np.random.Generator, run: Run) -> Truth:
    """The pillar leans to and fro along a horizontal direction that lies anywhere to the shaft."""
    hours = float(rng.choice([3.5, 7.0, 24.0]))
    phase, azimuth = rng.uniform(0, 2 * np.pi, 2)

    def shift(r: Run, x: float) -> Shift:
        lean = 3 * x * ARCSEC * np.sin(2 * np.pi * r.time_s / (3600 * hours) + phase)
        return {"angle": lean * np.cos(azimuth), "tilt": lean * np.sin(azimuth)}

    return Truth(
        "foundation_tilt",
        "stand",
        shift=shift,
        shape=f"period {hours:g} h",
        parameters={"phase": phase, "azimuth": azimuth},
    )


STAND: Final[dict[str, Draw]] = {
    "axis_tilt": _per_mount("axis_tilt", 10, "tilt"),
    "zero_offset": _per_mount("zero_offset", 10, "angle"),
    "mounting_error": _per_mount("mounting_error", 90, "skew"),
    "mounting_offset": _per_mount("mounting_offset", 90, "angle", after_remount=True),
    "mounting_roll": _per_mount("mounting_roll", 90, "roll"),
    "head_eccentricity": _head_eccentricity,
    "head_ellipticity": _head_ellipticity,
    "head_graduation": _head_graduation,
    "backlash": _backlash,
    "axis_wobble": _axis_wobble,
    "bracket_tilt": _per_mount("bracket_tilt", 30, "tilt", after_remount=True),
    "foundation_tilt": _foundation_tilt,
}
