"""The trial's own implementation of effects of stand, block and voltmeter, with the names of `bench diagnose`."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC
from benchmarks.blind_trial.stand import (
    CHANNELS,
    Draw,
    Floats,
    Run,
    Shift,
    Stage,
    Truth,
    channel_weights,
    head_path,
    mount_weights,
)

# --- of the stand: angles in rad that the exact geometry takes -------------------------------------------


def _per_mount(name: str, arcsec: float, key: str, *, after_remount: bool = False) -> Draw:
    """Return a `Draw` of an effect that adds a constant angle in some mountings."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        weights, mounts = mount_weights(rng, run, after_remount=after_remount)
        return Truth(name, "stand", shift=lambda _, x: {key: x * arcsec * ARCSEC * weights}, mounts=mounts)

    return draw


def _head_eccentricity(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of an eccentric scale: its centre is off by e radii, at the angle `towards`."""
    towards = rng.uniform(0, 2 * np.pi)

    def shift(r: Run, x: float) -> Shift:
        e, seen = 8 * x * ARCSEC, r.head_angle - towards
        return {"angle": np.arctan2(e * np.sin(seen), 1 + e * np.cos(seen))}

    return Truth("head_eccentricity", "stand", shift=shift, parameters={"towards": towards})


def _head_ellipticity(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of a scale elongated along `along`: tan φ is 1 + e times that on the circle."""
    along = rng.uniform(0, np.pi)

    def shift(r: Run, x: float) -> Shift:
        e, seen = 2 * 5 * x * ARCSEC, r.head_angle - along
        turned = np.arctan2((1 + e) * np.sin(seen), np.cos(seen)) - seen
        return {"angle": (turned + np.pi) % (2 * np.pi) - np.pi}

    return Truth("head_ellipticity", "stand", shift=shift, parameters={"along": along})


def _head_graduation(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of an error of each mark of the scale; 360° is the same mark as 0°."""
    errors = rng.normal(size=72)

    def shift(r: Run, x: float) -> Shift:
        marks = np.round(r.head_angle / np.radians(5)).astype(int) % 72
        return {"angle": 4 * x * ARCSEC * errors[marks]}

    return Truth("head_graduation", "stand", shift=shift)


def turned(name: str, arcsec: float, key: str, form: Callable[[Run], Floats], shape: str = "") -> Draw:
    """Return a `Draw` of an effect of either sign that adds `form(run)` (n,) to one of the stand's angles."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        sign = rng.choice([-1.0, 1.0])
        return Truth(
            name, "stand", shift=lambda r, x: {key: sign * arcsec * x * ARCSEC * form(r)}, shape=shape
        )

    return draw


def wobble(harmonic: int, phase: float, run: Run, arcsec: float) -> Floats:
    """Return an out-of-plane tilt (n,), rad, of `harmonic` periods per turn of the head."""
    return arcsec * ARCSEC * np.sin(harmonic * run.head_angle + phase)


def _axis_wobble(rng: np.random.Generator, run: Run) -> Truth:
    harmonic, phase = int(rng.integers(1, 3)), rng.uniform(0, 2 * np.pi)
    return Truth(
        "axis_wobble", "stand", shift=lambda r, x: {"tilt": wobble(harmonic, phase, r, 5 * x)},
        shape=f"harmonic {harmonic}", parameters={"phase": phase},
    )  # fmt: skip


def _foundation_tilt(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of a pillar that sways along a random horizontal direction."""
    hours = float(rng.choice([3.5, 7.0, 24.0]))
    phase, azimuth = rng.uniform(0, 2 * np.pi, 2)

    def shift(r: Run, x: float) -> Shift:
        lean = 3 * x * ARCSEC * np.sin(2 * np.pi * r.time_s / (3600 * hours) + phase)
        return {"angle": lean * np.cos(azimuth), "tilt": lean * np.sin(azimuth)}

    return Truth(
        "foundation_tilt", "stand", shift=shift, shape=f"period {hours:g} h",
        parameters={"phase": phase, "azimuth": azimuth},
    )  # fmt: skip


STAND: Final[dict[str, Draw]] = {
    "axis_tilt": _per_mount("axis_tilt", 10, "tilt"),
    "zero_offset": _per_mount("zero_offset", 10, "angle"),
    "mounting_error": _per_mount("mounting_error", 90, "skew"),
    "mounting_offset": _per_mount("mounting_offset", 90, "angle", after_remount=True),
    "mounting_roll": _per_mount("mounting_roll", 90, "roll"), "head_eccentricity": _head_eccentricity,
    "head_ellipticity": _head_ellipticity, "head_graduation": _head_graduation,
    "backlash": turned("backlash", 10, "angle", lambda run: run.direction / 2), "axis_wobble": _axis_wobble,
    "bracket_tilt": _per_mount("bracket_tilt", 30, "tilt", after_remount=True),
    "foundation_tilt": _foundation_tilt,
}  # fmt: skip


# --- of the block: in g on the channel's own axis --------------------------------------------------------


MINUTE: Final = 60.0
HOUR: Final = 3600.0
MICRO: Final = 1e-6

Form = Callable[[Run, Floats], Floats]


def per_channel(name: str, size: float, form: Form, stage: Stage = "block") -> Draw:
    """Return a `Draw` of an effect whose `form(run, seen)` (n, 3) or (n, 1) is weighted per channel."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        weights, channels = channel_weights(rng)
        return Truth(name, stage, lambda r, seen, x: x * size * weights * form(r, seen), channels=channels)

    return draw


def _shaped(name: str, size: float, shapes: dict[str, Form]) -> Draw:
    """Return a `Draw` of an effect as `per_channel` does, with one of several shapes chosen at random."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        shape = str(rng.choice(list(shapes)))
        return replace(per_channel(name, size, shapes[shape])(rng, run), shape=shape)

    return draw


def _others(force: Floats) -> tuple[Floats, Floats]:
    """Return for each channel the force along the next axis and along the one after it."""
    return np.roll(force, -1, axis=1), np.roll(force, -2, axis=1)


def _mixed(name: str, size: float, *forms: Form, thermal: bool = False) -> Draw:
    """Return a `Draw` of a random mixture of forms, weighted per channel; `thermal`: times temperature."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        weights, channels = channel_weights(rng)
        mix = rng.normal(size=len(forms))
        mix /= np.linalg.norm(mix)

        def act(r: Run, force: Floats, x: float) -> Floats:
            form = sum(part * one(r, force) for part, one in zip(mix, forms, strict=True))
            warmth = r.temperature(0.0)[:, None] if thermal else 1.0
            return np.asarray(x * size * weights * form * warmth)

        parts = {f"mix[{i}]": float(part) for i, part in enumerate(mix)}
        return Truth(name, "block", act, channels=channels, parameters=parts)

    return draw


def _turn_on_shift(rng: np.random.Generator, run: Run) -> Truth:
    weights, channels = channel_weights(rng)
    mount = int(rng.choice(run.calibration_mounts[1:]))

    def act(r: Run, _: Floats, x: float) -> Floats:
        return x * 60 * MICRO * weights * (r.mount >= mount)[:, None]

    return Truth("turn_on_shift", "block", act, channels=channels, shape=f"before mounting {mount + 1}")


def _time_h(run: Run) -> Floats:
    return run.time_s[:, None] / HOUR


def _cooling(minutes: float, quick: float = 0.0) -> Form:
    """Return the form of an exponential warm-up, of which the fraction `quick` is four times faster."""

    def form(run: Run, _: Floats) -> Floats:
        t = run.time_s[:, None] / (minutes * MINUTE)
        return (1 - quick) * np.exp(-t) + quick * np.exp(-4 * t)

    return form


def _lagged(minutes: float, *, scale: bool = False) -> Form:
    return lambda run, force: run.temperature(minutes * MINUTE)[:, None] * (force if scale else 1.0)


def _stops(way: Floats, begins: set[int], half_width: float) -> Floats:
    """Return the state (m, 3) of a saturating friction element with a play of `half_width`; 0 after a remount."""
    inside = np.zeros_like(way)
    play = way[0]
    for i, here in enumerate(way):
        play = here if i in begins else np.clip(play, here - half_width, here + half_width)
        inside[i] = (here - play) / half_width
    return inside


def _prandtl(way: Floats, begins: set[int]) -> Floats:
    return 0.6 * _stops(way, begins, 0.15) + 0.4 * _stops(way, begins, 0.4)


def _bouc_wen(way: Floats, begins: set[int]) -> Floats:
    """Return the state of a Bouc-Wen element: smooth on loading, linear on unloading.

    It follows dz = dx/w·(1 − |z|·(1 + sign(dx·z))/2).
    """
    state = np.zeros_like(way)
    z = np.zeros(3)
    for i in range(len(way)):
        if i in begins:
            z = np.zeros(3)
        else:
            dx = (way[i] - way[i - 1]) / 0.25
            z = z + dx * (1 - np.abs(z) * (1 + np.sign(dx * z)) / 2)
        state[i] = z
    return state


@lru_cache
def _friction(design: str, kind: str) -> Floats:
    """Return the state (n, 3) of each channel's friction element at the readings of a design; it saturates at 1."""
    way, stops, begins = head_path(design)
    element = {"two plays": _prandtl, "Bouc-Wen": _bouc_wen}[kind]
    return element(way, set(begins.tolist()))[stops]


def _hysteresis(kind: str) -> Form:
    return lambda run, _: _friction(run.design, kind)


BLOCK: Final[dict[str, Draw]] = {
    "quadratic_nonlinearity": per_channel("quadratic_nonlinearity", 30 * MICRO, lambda _, a: a**2),
    "cubic_nonlinearity": per_channel("cubic_nonlinearity", 20 * MICRO, lambda _, a: a**3),
    "odd_quadratic_nonlinearity": per_channel(
        "odd_quadratic_nonlinearity", 20 * MICRO, lambda _, a: a * np.abs(a)
    ),
    # the change of slope is rounded off over 0.02 g, as a servo loop does it
    "scale_asymmetry": per_channel(
        "scale_asymmetry", 30 * MICRO, lambda _, a: np.sqrt(a**2 + 0.02**2) - 0.02
    ),
    "cross_coupling": _mixed(
        "cross_coupling",
        20 * MICRO,
        lambda _, a: a * _others(a)[0],
        lambda _, a: a * _others(a)[1],
        lambda _, a: np.multiply(*_others(a)),
    ),
    "cross_quadratic": _mixed(
        "cross_quadratic", 20 * MICRO, lambda _, a: _others(a)[0] ** 2, lambda _, a: _others(a)[1] ** 2
    ),
    "hysteresis": _shaped(
        "hysteresis", 20 * MICRO, {kind: _hysteresis(kind) for kind in ("two plays", "Bouc-Wen")}
    ),
    "thermal_bias": _shaped(
        "thermal_bias", 60 * MICRO, {f"lag {lag} min": _lagged(lag) for lag in (0, 7, 13, 21)}
    ),
    "thermal_scale": _shaped(
        "thermal_scale", 100 * MICRO, {f"lag {lag} min": _lagged(lag, scale=True) for lag in (0, 7)}
    ),
    "warm_up": _shaped(
        "warm_up",
        150 * MICRO,
        {
            "tau 12 min": _cooling(12),
            "tau 25 min": _cooling(25),
            "tau 50 min": _cooling(50),
            "tau 25 min and a quarter": _cooling(25, quick=0.2),
        },
    ),
    "bias_drift": per_channel("bias_drift", 30 * MICRO, lambda run, _: _time_h(run)),
    "scale_drift": per_channel("scale_drift", 20 * MICRO, lambda run, a: _time_h(run) * a),
    "turn_on_shift": _turn_on_shift,
    # a spring that leaves zero within a few milli-g, not a step
    "bias_asymmetry": per_channel("bias_asymmetry", 10 * MICRO, lambda _, a: a / np.sqrt(a**2 + 0.004**2)),
    "thermal_nonlinearity": _mixed(
        "thermal_nonlinearity", 0.3 * MICRO, lambda _, a: a * a, lambda _, a: a * a * a, thermal=True
    ),
    "thermal_misalignment": _mixed(
        "thermal_misalignment", MICRO, lambda _, a: _others(a)[0], lambda _, a: _others(a)[1], thermal=True
    ),
}


# --- of voltmeter and wiring: in V on what is read -------------------------------------------------------


MICROVOLT: Final = 1e-6
PPM: Final = 1e-6
FULL: Final = 2.5
AUTORANGE_BELOW_V: Final = 1.2


def _voltmeter_nonlinearity(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of the same nonlinearity in every channel: a power, or half a period of a cosine or sine.

    Real converters have such shapes.
    """
    shapes: dict[str, Callable[[Floats], Floats]] = {
        "square": lambda u: u**2,
        "cube": lambda u: u**3,
        "even bow": lambda u: 1 - np.cos(np.pi * u / 2),
        "odd bow": lambda u: np.sin(np.pi * u),
    }
    shape = str(rng.choice(list(shapes)))
    bow = shapes[shape]
    truth = common("voltmeter_nonlinearity", 10 * MICROVOLT, lambda _, volts: bow(volts / FULL))(rng, run)
    return replace(truth, shape=shape)


def common(name: str, size: float, form: Form, channels: tuple[str, ...] = CHANNELS) -> Draw:
    """Return a `Draw` of an effect of either sign that all channels have alike."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        sign = rng.choice([-1.0, 1.0])
        return Truth(
            name, "voltmeter", lambda r, volts, x: sign * size * x * form(r, volts), channels=channels
        )

    return draw


def _range_offset(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of range offsets in all channels (one autoranging meter) or in one of the three."""
    offset, gain = rng.normal(size=2) * (40 * MICROVOLT, 20 * PPM)
    one = rng.random() < 0.5
    weights = np.eye(3)[rng.integers(3)] if one else np.ones(3)

    def act(_: Run, volts: Floats, x: float) -> Floats:
        return np.asarray(x * weights * (np.abs(volts) < AUTORANGE_BELOW_V) * (offset + gain * volts))

    return Truth(
        "range_offset",
        "voltmeter",
        act,
        channels=tuple(c for c, w in zip(CHANNELS, weights, strict=True) if w),
        shape="one meter of three" if one else "one meter for all",
        parameters={"offset_v": float(offset), "gain": float(gain)},
    )


def _channel_crosstalk(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of an input that still shows part of the channel read before it.

    The first channel of a reading follows an open input.
    """
    sign = rng.choice([-1.0, 1.0])

    def act(r: Run, volts: Floats, x: float) -> Floats:
        order = np.where((r.scan == "zyx")[:, None], [2, 1, 0], [0, 1, 2])
        in_turn = np.take_along_axis(volts, order, axis=1).ravel()
        memory = (np.concatenate([[0.0], in_turn[:-1]]) - in_turn).reshape(-1, 3)
        return np.asarray(sign * 25 * PPM * x * np.take_along_axis(memory, np.argsort(order, axis=1), axis=1))

    return Truth("channel_crosstalk", "voltmeter", act, channels=CHANNELS)


VOLTMETER: Final[dict[str, Draw]] = {
    "voltmeter_nonlinearity": _voltmeter_nonlinearity,
    "voltmeter_drift": common(
        "voltmeter_drift", 15 * MICROVOLT, lambda run, volts: _time_h(run) * np.ones_like(volts)
    ),
    "range_offset": _range_offset,
    "channel_crosstalk": _channel_crosstalk,
}


def _wrong_gravity(rng: np.random.Generator, run: Run) -> Truth:
    sign = rng.choice([-1.0, 1.0])
    return Truth("wrong_gravity", "stand", shift=lambda _, x: {"gravity": sign * 300 * PPM * x})


def _common_turn(rng: np.random.Generator, run: Run) -> Truth:
    """Return the effect of turning all axes together in the housing, which the coefficients absorb."""
    axis = rng.normal(size=3)
    axis *= 90 * ARCSEC / np.linalg.norm(axis)
    return Truth("common_turn", "block", lambda _, force, x: np.cross(force, x * axis), channels=CHANNELS)


HIDDEN: Final[dict[str, Draw]] = {
    "voltmeter_gain": common("voltmeter_gain", 30 * PPM, lambda _, volts: volts),
    "voltmeter_offset": common("voltmeter_offset", 50 * MICROVOLT, lambda _, volts: np.ones_like(volts)),
    "thermal_emf": per_channel(
        "thermal_emf", 5 * MICROVOLT, lambda _, volts: np.ones_like(volts), "voltmeter"
    ),
    "wrong_gravity": _wrong_gravity, "axis_wobble": turned(
        "axis_wobble", 5, "tilt", lambda run: np.sin(run.head_angle + np.pi / 2), "cosine once a turn"
    ), "common_turn": _common_turn,
}  # fmt: skip
"""Effects that the coefficients absorb completely, so that no residual shows them, with their draws.

`common_turn` has no name in the catalogue.
"""


# --- all of them -----------------------------------------------------------------------------------------


SEEN_IN_VERIFICATION: Final = "mounting_roll"
CATALOGUE: Final[dict[str, Draw]] = {
    name: draw for name, draw in {**BLOCK, **STAND, **VOLTMETER}.items() if name != SEEN_IN_VERIFICATION
}
"""Effects that residuals of a calibration can show, with their draws.

Only verification points show `mounting_roll`.
"""

CLASSES: Final[dict[str, tuple[str, ...]]] = {
    "even": ("quadratic_nonlinearity", "cross_quadratic", "scale_asymmetry", "voltmeter_nonlinearity"),
    "odd": ("cubic_nonlinearity", "odd_quadratic_nonlinearity", "bias_asymmetry", "head_ellipticity"),
    "product": ("cross_coupling", "axis_wobble"),
    "time": (
        "warm_up",
        "bias_drift",
        "turn_on_shift",
        "thermal_bias",
        "voltmeter_drift",
        "bracket_tilt",
        "axis_tilt",
    ),
    "mount": (
        "mounting_error",
        "mounting_offset",
        "zero_offset",
        "backlash",
        "hysteresis",
        "foundation_tilt",
    ),
    "scale": ("scale_drift", "thermal_scale", "thermal_nonlinearity", "thermal_misalignment"),
    "head": ("head_eccentricity", "head_graduation"),
    "range": ("range_offset",),
    "memory": ("channel_crosstalk",),
}
"""Classes of effects that resemble each other in the paper's design; the effects of a pair are of two classes."""

CLASS_OF: Final = {name: kind for kind, names in CLASSES.items() for name in names}
