"""Effects that stand in no catalogue: something is there and it has no name."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from benchmarks.blind_trial.designs import Run
from benchmarks.blind_trial.own_effects import OWN
from benchmarks.blind_trial.stand_effects import wobble
from benchmarks.blind_trial.truth import CHANNELS, Draw, Shift, Truth

SIZE_G: Final = 30e-6


def _one_channel(name: str, rng: np.random.Generator, column: Floats) -> Truth:
    """A course (n,) over the rows added to one channel, in units of 30 µg."""
    channel = int(rng.integers(3))

    def act(_: Run, __: Floats, x: float) -> Floats:
        return np.asarray(x * SIZE_G * column[:, None] * np.eye(3)[channel])

    return Truth(name, "block", act, channels=(CHANNELS[channel],))


def _bias_jump(rng: np.random.Generator, run: Run) -> Truth:
    mount = rng.choice(run.calibration_mounts)
    rows = np.flatnonzero((run.mount == mount) & run.fitted)
    row = int(rng.choice(rows[4:-4]))
    after = (np.arange(len(run.mount)) >= row).astype(float)
    return _one_channel("bias_jump", rng, after)


def _random_walk(rng: np.random.Generator, run: Run) -> Truth:
    return _one_channel("random_walk", rng, np.cumsum(rng.normal(size=len(run.mount))))


def _flicker(rng: np.random.Generator, run: Run) -> Truth:
    """Noise of power 1/f over the readings, by shaping a white spectrum."""
    n = len(run.mount)
    spectrum = np.fft.rfft(rng.normal(size=4 * n))
    spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
    spectrum[0] = 0
    course = np.fft.irfft(spectrum)[:n]
    return _one_channel("flicker_noise", rng, course / np.std(course))


def _cable_torque(rng: np.random.Generator, run: Run) -> Truth:
    return _one_channel("cable_torque", rng, np.sin(run.head_angle / 2))


def _pickup(rng: np.random.Generator, run: Run) -> Truth:
    """The leads run past a magnet in one mounting."""
    mount = rng.choice(run.calibration_mounts)
    course = np.cos(2 * run.head_angle + rng.uniform(0, 2 * np.pi)) * (run.mount == mount)
    return _one_channel("single_installation_pickup", rng, course)


def _sticking_angle(rng: np.random.Generator, run: Run) -> Truth:
    """A pendulum hangs at one angle of one mounting, in each pass."""
    mount = rng.choice(run.calibration_mounts)
    rows = (run.mount == mount) & run.fitted
    angle = rng.choice(np.unique(run.angle[rows])[1:-1])
    return _one_channel("sticking_angle", rng, (rows & (run.angle == angle)).astype(float))


def _quadratic_drift(rng: np.random.Generator, run: Run) -> Truth:
    t = run.time_s / run.time_s[run.fitted].max()
    return _one_channel("quadratic_drift", rng, 4 * (t - 0.5) ** 2)


def _third_harmonic_wobble(rng: np.random.Generator, run: Run) -> Truth:
    phase = rng.uniform(0, 2 * np.pi)

    def shift(r: Run, x: float) -> Shift:
        return {"tilt": wobble(3, phase, r, 5 * x)}

    return Truth("third_harmonic_wobble", "stand", shift=shift)


def _dead_band(rng: np.random.Generator, run: Run) -> Truth:
    """The pendulum does not follow over a short way at some level: what comes after is short of it."""
    channel = int(rng.integers(3))
    level = rng.uniform(-0.85, 0.85)

    def act(_: Run, force: Floats, x: float) -> Floats:
        half = x * SIZE_G
        return np.asarray(-np.clip(force - level, -half, half) * np.eye(3)[channel])

    return Truth("dead_band", "block", act, channels=(CHANNELS[channel],), parameters={"level_g": level})


def _gear_ratio(rng: np.random.Generator, run: Run) -> Truth:
    """The head turns a little too far with every degree, and its counter begins anew at the first point."""
    sign = rng.choice([-1.0, 1.0])

    def shift(r: Run, x: float) -> Shift:
        return {"angle": sign * 10 * x * ARCSEC * r.head_angle / (2 * np.pi)}

    return Truth("gear_ratio_error", "stand", shift=shift)


def _fifth_power(rng: np.random.Generator, run: Run) -> Truth:
    channel = int(rng.integers(3))

    def act(_: Run, force: Floats, x: float) -> Floats:
        return np.asarray(x * SIZE_G * force**5 * np.eye(3)[channel])

    return Truth("fifth_power", "block", act, channels=(CHANNELS[channel],))


def _two_time_constants(rng: np.random.Generator, run: Run) -> Truth:
    """Two junctions in the leads of a channel come to rest, one soon and one late, against each other."""
    late, soon = 90 * 60.0, 12 * 60.0

    def act(r: Run, volts: Floats, x: float) -> Floats:
        course = np.exp(-r.time_s / late) - 0.8 * np.exp(-r.time_s / soon)
        return np.asarray(x * 30e-6 * course[:, None] * np.eye(3)[channel])

    channel = int(rng.integers(3))
    return Truth("two_time_constants", "voltmeter", act, channels=(CHANNELS[channel],))


def _noise_burst(rng: np.random.Generator, run: Run) -> Truth:
    """A channel is noisy in one pass of one mounting."""
    mount = rng.choice(run.calibration_mounts)
    number = rng.choice(np.unique(run.pass_number[(run.mount == mount) & run.fitted]))
    rows = (run.mount == mount) & (run.pass_number == number) & run.fitted
    return _one_channel("noise_burst", rng, rows * rng.normal(size=len(rows)))


def _unknown(draw: Draw) -> Draw:
    """Return an effect that a user's formula describes, where no such formula is given."""

    def drawn(rng: np.random.Generator, run: Run) -> Truth:
        truth = draw(rng, run)
        return replace(truth, name=f"{truth.name} (unknown)")

    return drawn


WITHOUT_MEAN: Final = ("random_walk", "flicker_noise", "noise_burst")
"""What is another course in each run: no form of its mean predicts what was not read."""

OUTSIDE: Final[dict[str, Draw]] = {
    "bias_jump": _bias_jump,
    "random_walk": _random_walk,
    "cable_torque": _cable_torque,
    "single_installation_pickup": _pickup,
    "sticking_angle": _sticking_angle,
    "quadratic_drift": _quadratic_drift,
    "third_harmonic_wobble": _third_harmonic_wobble,
    "dead_band": _dead_band,
    "gear_ratio_error": _gear_ratio,
    "flicker_noise": _flicker,
    **{f"{name} (unknown)": _unknown(draw) for name, draw in OWN.items()},
    "fifth_power": _fifth_power,
    "two_time_constants": _two_time_constants,
    "noise_burst": _noise_burst,
}
