"""Effects outside the catalogue: user formulas, unnamed effects, the supply, known properties of benches."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.blind_trial.effects import common, per_channel, turned, wobble
from benchmarks.blind_trial.stand import CHANNELS, Draw, Floats, Run, Stage, Truth, channel_weights

# --- effects that a user states as formulas (`own-effects.yaml`), implemented independently --------------


FORMULAS: Final = Path(__file__).with_name("own-effects.yaml")
"""The user formulas that the diagnosis gets; the truths below do not use them."""


def _turns(run: Run) -> Floats:
    """Return the number of whole turns since the block was mounted, for a head that never reverses."""
    return (run.pass_number - 1) + run.head_angle / (2 * np.pi)


def _after_effect(rng: np.random.Generator, _: Run) -> Truth:
    """Return a relaxation with two time constants, neither of which the diagnosis tries."""
    weights, channels = channel_weights(rng)
    length = float(rng.choice([0.35, 0.7, 1.4]))

    def act(run: Run, _: Floats, x: float) -> Floats:
        turns = _turns(run)
        left = 0.8 * np.exp(-turns / length) + 0.2 * np.exp(-turns / (0.3 * length))
        return np.asarray(x * 100e-6 * weights * left[:, None])

    return Truth("after_effect", "block", act, channels=channels, shape=f"{length:g} turns")


def _others_sizes(_: Run, volts: Floats) -> Floats:
    size = np.abs(volts)
    return np.roll(size, 1, axis=1) + np.roll(size, 2, axis=1)


OWN: Final[dict[str, Draw]] = {
    "cable_pull": turned("cable_pull", 20, "skew", _turns),
    "fourth_power": per_channel("fourth_power", 20e-6, lambda _, force: np.square(np.square(force))),
    "after_effect": _after_effect,
    "rectified_crosstalk": common("rectified_crosstalk", 25e-6, _others_sizes, ()),
}


# --- effects without a name ------------------------------------------------------------------------------


SIZE: Final = 30e-6


Column = Floats | Callable[[Floats], Floats]
"""A series (n,) over the rows, or a function of the input of a stage."""


def _one_channel(
    name: str, column: Callable[[np.random.Generator, Run], Column], stage: Stage = "block"
) -> Draw:
    """Return a `Draw` of an effect that adds a column to one channel, in units of 30 µg or 30 µV."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        drawn, channel = column(rng, run), int(rng.integers(3))

        def act(_: Run, seen: Floats, x: float) -> Floats:
            added = drawn(seen) if callable(drawn) else drawn[:, None]
            return np.asarray(x * SIZE * added * np.eye(3)[channel])

        return Truth(name, stage, act, channels=(CHANNELS[channel],))

    return draw


def _jump(rng: np.random.Generator, run: Run) -> Floats:
    mount = rng.choice(run.calibration_mounts)
    rows = np.flatnonzero((run.mount == mount) & run.fitted)
    row = int(rng.choice(rows[4:-4]))
    return (np.arange(len(run.mount)) >= row).astype(float)


def _flicker(rng: np.random.Generator, run: Run) -> Floats:
    """Return noise with a 1/f power spectrum over the readings, made by shaping a white spectrum."""
    n = len(run.mount)
    spectrum = np.fft.rfft(rng.normal(size=4 * n))
    spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
    spectrum[0] = 0
    course = np.fft.irfft(spectrum)[:n]
    return np.asarray(course / np.std(course))


def _pickup(rng: np.random.Generator, run: Run) -> Floats:
    """Return the effect of leads that pass a magnet in one mounting."""
    mount = rng.choice(run.calibration_mounts)
    return np.asarray(np.cos(2 * run.head_angle + rng.uniform(0, 2 * np.pi)) * (run.mount == mount))


def _sticking_angle(rng: np.random.Generator, run: Run) -> Floats:
    """Return the effect of a pendulum that sticks at one angle of one mounting, in each pass."""
    mount = rng.choice(run.calibration_mounts)
    rows = (run.mount == mount) & run.fitted
    angle = rng.choice(np.unique(run.angle[rows])[1:-1])
    return np.asarray(rows & (run.angle == angle), dtype=float)


def _burst(rng: np.random.Generator, run: Run) -> Floats:
    """Return the noise of a channel that is noisy in one pass of one mounting."""
    mount = rng.choice(run.calibration_mounts)
    number = rng.choice(np.unique(run.pass_number[(run.mount == mount) & run.fitted]))
    rows = (run.mount == mount) & (run.pass_number == number) & run.fitted
    return np.asarray(rows * rng.normal(size=len(rows)))


def _third_harmonic_wobble(rng: np.random.Generator, run: Run) -> Truth:
    phase = rng.uniform(0, 2 * np.pi)
    return Truth("third_harmonic_wobble", "stand", shift=lambda r, x: {"tilt": wobble(3, phase, r, 5 * x)})


def _dead_band(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of a pendulum with a dead band: beyond some level its output is too small."""
    channel = int(rng.integers(3))
    level = rng.uniform(-0.85, 0.85)

    def act(_: Run, force: Floats, x: float) -> Floats:
        half = x * SIZE
        return np.asarray(-np.clip(force - level, -half, half) * np.eye(3)[channel])

    return Truth("dead_band", "block", act, channels=(CHANNELS[channel],), parameters={"level_g": level})


def _unknown(draw: Draw) -> Draw:
    """Return an effect that a user's formula would describe, drawn for a diagnosis without that formula."""

    def drawn(rng: np.random.Generator, run: Run) -> Truth:
        truth = draw(rng, run)
        return replace(truth, name=f"{truth.name} (unknown)")

    return drawn


WITHOUT_MEAN: Final = ("random_walk", "flicker_noise", "noise_burst")
"""Effects that differ from run to run: their mean is zero, so that they do not predict held-out readings."""

OUTSIDE: Final[dict[str, Draw]] = {
    "bias_jump": _one_channel("bias_jump", _jump),
    "random_walk": _one_channel("random_walk", lambda rng, run: np.cumsum(rng.normal(size=len(run.mount)))),
    "cable_torque": _one_channel("cable_torque", lambda _, run: np.sin(run.head_angle / 2)),
    "single_installation_pickup": _one_channel("single_installation_pickup", _pickup),
    "sticking_angle": _one_channel("sticking_angle", _sticking_angle),
    "quadratic_drift": _one_channel(
        "quadratic_drift", lambda _, run: 4 * (run.time_s / run.time_s[run.fitted].max() - 0.5) ** 2
    ),
    "third_harmonic_wobble": _third_harmonic_wobble,
    "dead_band": _dead_band,
    # a head that turns slightly too far per degree, counted from the first point
    "gear_ratio_error": turned("gear_ratio_error", 10, "angle", lambda run: run.head_angle / (2 * np.pi)),
    "flicker_noise": _one_channel("flicker_noise", _flicker),
    **{f"{name} (unknown)": _unknown(draw) for name, draw in OWN.items()},
    "fifth_power": _one_channel("fifth_power", lambda _, __: lambda force: force**5),
    # two opposed thermal junctions in the leads of a channel, one fast and one slow
    "two_time_constants": _one_channel("two_time_constants", lambda _, run: (
        np.exp(-run.time_s / (90 * 60.0)) - 0.8 * np.exp(-run.time_s / (12 * 60.0))
    ), "voltmeter"),
    "noise_burst": _one_channel("noise_burst", _burst),
}  # fmt: skip


# --- a block that is fed by two rails whose voltages are recorded ----------------------------------------


SENSITIVE: Final = "supply"
DRIFTING: Final = "supply:drift"
SUPPLIED: Final = (SENSITIVE, DRIFTING)
NOMINAL_V: Final = (15.0, -15.0)
NAMES: Final = ("p15", "n15")


def courses(rng: np.random.Generator, run: Run) -> Floats:
    """Return the voltages of the two rails over time minus their nominal values, V, shape (n, 2)."""
    apart_h = np.diff(run.time_s, prepend=run.time_s[0]) / 3600.0
    rails = []
    for _ in NOMINAL_V:
        wandered = np.cumsum(rng.normal(0, 0.05, len(run.time_s)) * np.sqrt(apart_h))
        period_s, phase = rng.uniform(40, 120) * 60, rng.uniform(0, 2 * np.pi)
        cycle = rng.uniform(0.05, 0.2) * np.sin(2 * np.pi * run.time_s / period_s + phase)
        rails.append(rng.normal(0, 0.05) + cycle + wandered)
    return np.stack(rails, axis=1)


def sensitive(rng: np.random.Generator, run: Run, above_v: Floats) -> Truth:
    """Return the effect of a bias, a scale factor or both that follow one of the rails."""
    weights, channels = channel_weights(rng)
    rail = int(rng.integers(len(NAMES)))
    bias, scale = ((1.0, 0.0), (0.0, 1.0), (0.7, -0.7))[int(rng.integers(3))]
    return Truth(
        "supply_sensitivity", "block", channels=channels, shape=NAMES[rail],
        act=lambda _, force, x: x * 20e-6 * weights * above_v[:, rail, None] * (bias + scale * force),
    )  # fmt: skip


def recorded(rng: np.random.Generator, above_v: Floats) -> dict[str, Any]:
    """Return the columns of a readings table that state the rail voltages."""
    columns: dict[str, Any] = {}
    for name, nominal_v, above in zip(NAMES, NOMINAL_V, above_v.T, strict=True):
        measured = np.round(nominal_v + above + rng.normal(0, 1e-3, len(above)), 3)
        columns[f"rail_{name}_v"] = np.array([f"{v:.3f}" for v in measured])
        columns[f"rail_{name}_nominal_v"] = np.array([f"{nominal_v:g}"] * len(above))
    return columns


# --- known properties of a bench, and effects besides a mistake ------------------------------------------


OTHER_PSI: Final = "other_psi"
COMMON_VOLTS: Final = "common_volts"
HAND_SET: Final = "hand_set"
REPAIRED: Final = "repaired"
TILT_RAD: Final = float(np.radians(0.5))
ELECTRICS: Final = frozenset({"voltmeter_warm_up", "voltmeter_drift"})
NOT_TOLD: Final = frozenset({"voltmeter_gain", "wrong_gravity"})


def stated_psi_deg(rng: np.random.Generator) -> float:
    """Draw the angle (°) that a bench file states for the verification points, which are truly at 45°."""
    return float(rng.choice([rng.uniform(5, 35), rng.uniform(55, 85)]))


def common_volts(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of a decaying voltage common to all channels.

    Two thirds of it decay in 8 to 15 min, one third in 25 to 50 min.
    """
    fast, slow = rng.uniform(8, 15) * 60, rng.uniform(25, 50) * 60
    part = 0.67 * np.exp(-run.time_s / fast) + 0.33 * np.exp(-run.time_s / slow)
    return common("voltmeter_warm_up", 100e-6, lambda _, volts: np.broadcast_to(part[:, None], volts.shape))(
        rng, run
    )


def hand_set(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of setting errors of the head at each setting, in its plane and out of it."""
    off = dict(zip(("angle", "skew", "roll"), rng.normal(0, TILT_RAD, (3, len(run.mount))), strict=True))
    return Truth("hand_set", "stand", shift=lambda _, x: {key: x * each for key, each in off.items()})
