"""Effects of the block: in g on the channel's own axis, from forms and shapes of the trial's own."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Final

import numpy as np

from benchmarks.blind_trial.designs import Run, head_path
from benchmarks.blind_trial.geometry import Floats
from benchmarks.blind_trial.truth import Draw, Truth, channel_weights

MINUTE: Final = 60.0
HOUR: Final = 3600.0
MICRO: Final = 1e-6

Form = Callable[[Run, Floats], Floats]


def _per_channel(name: str, size: float, form: Form) -> Draw:
    """Return the draw of an effect whose `form(run, force)` (n, 3) or (n, 1) is weighted per channel."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        weights, channels = channel_weights(rng)
        return Truth(
            name, "block", lambda r, force, x: x * size * weights * form(r, force), channels=channels
        )

    return draw


def _shaped(name: str, size: float, shapes: dict[str, Form]) -> Draw:
    """Like `_per_channel`, with one of several shapes drawn."""

    def draw(rng: np.random.Generator, run: Run) -> Truth:
        shape = str(rng.choice(list(shapes)))
        weights, channels = channel_weights(rng)
        form = shapes[shape]
        return Truth(
            name,
            "block",
            lambda r, force, x: x * size * weights * form(r, force),
            channels=channels,
            shape=shape,
        )

    return draw


def _others(force: Floats) -> tuple[Floats, Floats]:
    """Return for each channel the force along the next and along the one after it."""
    return np.roll(force, -1, axis=1), np.roll(force, -2, axis=1)


def _cross_coupling(rng: np.random.Generator, run: Run) -> Truth:
    weights, channels = channel_weights(rng)
    mix = rng.normal(size=3)
    mix /= np.linalg.norm(mix)

    def act(_: Run, force: Floats, x: float) -> Floats:
        j, k = _others(force)
        return np.asarray(
            x * 20 * MICRO * weights * (mix[0] * force * j + mix[1] * force * k + mix[2] * j * k)
        )

    return Truth("cross_coupling", "block", act, channels=channels, parameters=_named("mix", mix))


def _cross_quadratic(rng: np.random.Generator, run: Run) -> Truth:
    weights, channels = channel_weights(rng)
    mix = rng.normal(size=2)
    mix /= np.linalg.norm(mix)

    def act(_: Run, force: Floats, x: float) -> Floats:
        j, k = _others(force)
        return np.asarray(x * 20 * MICRO * weights * (mix[0] * j**2 + mix[1] * k**2))

    return Truth("cross_quadratic", "block", act, channels=channels, parameters=_named("mix", mix))


def _named(name: str, values: Floats) -> dict[str, float]:
    return {f"{name}[{i}]": float(value) for i, value in enumerate(values)}


def _turn_on_shift(rng: np.random.Generator, run: Run) -> Truth:
    weights, channels = channel_weights(rng)
    mount = int(rng.choice(run.calibration_mounts[1:]))

    def act(r: Run, _: Floats, x: float) -> Floats:
        return x * 60 * MICRO * weights * (r.mount >= mount)[:, None]

    return Truth("turn_on_shift", "block", act, channels=channels, shape=f"before mounting {mount + 1}")


def _time_h(run: Run) -> Floats:
    return run.time_s[:, None] / HOUR


def _cooling(minutes: float, quick: float = 0.0) -> Form:
    """Exponential warm-up, of which the part `quick` goes four times faster."""

    def form(run: Run, _: Floats) -> Floats:
        t = run.time_s[:, None] / (minutes * MINUTE)
        return (1 - quick) * np.exp(-t) + quick * np.exp(-4 * t)

    return form


def _lagged(minutes: float) -> Form:
    return lambda run, _: run.temperature(minutes * MINUTE)[:, None]


def _lagged_scale(minutes: float) -> Form:
    return lambda run, force: run.temperature(minutes * MINUTE)[:, None] * force


def _stops(way: Floats, begins: set[int], half_width: float) -> Floats:
    """Saturating friction element (m, 3): the way less a play of `half_width`; at rest after a remount."""
    inside = np.zeros_like(way)
    play = way[0]
    for i, here in enumerate(way):
        play = here if i in begins else np.clip(play, here - half_width, here + half_width)
        inside[i] = (here - play) / half_width
    return inside


def _prandtl(way: Floats, begins: set[int]) -> Floats:
    return 0.6 * _stops(way, begins, 0.15) + 0.4 * _stops(way, begins, 0.4)


def _bouc_wen(way: Floats, begins: set[int]) -> Floats:
    """Bouc-Wen element: dz = dx/w·(1 − |z|·(1 + sign(dx·z))/2), smooth on loading, straight on unloading."""
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
    """State of the friction element of each channel at the readings of a design (n, 3), saturating at 1."""
    way, stops, begins = head_path(design)
    element = {"two plays": _prandtl, "Bouc-Wen": _bouc_wen}[kind]
    return element(way, set(begins.tolist()))[stops]


def _hysteresis(kind: str) -> Form:
    return lambda run, _: _friction(run.design, kind)


BLOCK: Final[dict[str, Draw]] = {
    "quadratic_nonlinearity": _per_channel("quadratic_nonlinearity", 30 * MICRO, lambda _, a: a**2),
    "cubic_nonlinearity": _per_channel("cubic_nonlinearity", 20 * MICRO, lambda _, a: a**3),
    "odd_quadratic_nonlinearity": _per_channel(
        "odd_quadratic_nonlinearity", 20 * MICRO, lambda _, a: a * np.abs(a)
    ),
    # the change of slope is rounded off over 0.02 g, as a servo loop does it
    "scale_asymmetry": _per_channel(
        "scale_asymmetry", 30 * MICRO, lambda _, a: np.sqrt(a**2 + 0.02**2) - 0.02
    ),
    "cross_coupling": _cross_coupling,
    "cross_quadratic": _cross_quadratic,
    "hysteresis": _shaped(
        "hysteresis", 20 * MICRO, {kind: _hysteresis(kind) for kind in ("two plays", "Bouc-Wen")}
    ),
    "thermal_bias": _shaped(
        "thermal_bias", 60 * MICRO, {f"lag {lag} min": _lagged(lag) for lag in (0, 7, 13, 21)}
    ),
    "thermal_scale": _shaped(
        "thermal_scale", 100 * MICRO, {f"lag {lag} min": _lagged_scale(lag) for lag in (0, 7)}
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
    "bias_drift": _per_channel("bias_drift", 30 * MICRO, lambda run, _: _time_h(run)),
    "scale_drift": _per_channel("scale_drift", 20 * MICRO, lambda run, a: _time_h(run) * a),
    "turn_on_shift": _turn_on_shift,
}
