"""Hidden effects: those that the catalogue names, and forms that it lacks."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Final

import numpy as np

from benchmarks.third_trial.stand import BLOCK_AXES, Act, Day, Floats, Form, Rng, Stage, day, left, rho, volts

Shape = Callable[[Day, Floats], Floats]
"""A function of the run and of the input of a stage, (n, 3), that returns an addition to this input."""
TURN: Final = 2 * np.pi
XYZ: Final = np.eye(3)


def one(rng: Rng) -> Floats:
    """Draw a channel, as a row vector with a single one."""
    return np.asarray(XYZ[rng.integers(3)])


def error(number: int, shape: Floats) -> Floats:
    """Return a shape (n,) as an addition to error `number` of the stand.

    `number` is 0 for the head's angle, 1 for tilt, 2 for mounting error, 3 for roll.
    """
    return np.asarray(np.outer(shape, np.eye(4)[number]))


def hours(on: Day) -> Floats:
    """Return the time since the start, h, (n, 1)."""
    return on.time_s[:, None] / 3600


def fade(on: Day, tau_min: float, since: Floats | None = None) -> Floats:
    """Return exp(-t / tau), (n, 1), where t is the time since the start, or `since` if given."""
    return np.exp(-(on.time_s if since is None else since) / (tau_min * 60))[:, None]


def loop(on: Day, widths: Sequence[float], weights: Sequence[float]) -> Floats:
    """Return the weighted sum of hysteresis plays (half widths in g), (n, 3); on the way up it rises to 1.

    The head rises from point to point in steps of 1°. It approaches the first point of a mounting from 25°
    below.
    """
    result, width = np.zeros((len(on), 3)), np.array(widths)[:, None]
    for mount in range(3):
        rows = np.flatnonzero(on.mount == mount)
        axes, at, slack = BLOCK_AXES[str(on.label[rows[0]])], np.degrees(on.angle[rows[0]]) - 25.0, None
        for row in rows:
            goal = np.degrees(on.angle[row])
            goal += 360.0 * np.ceil((at - goal) / 360.0 - 1e-9)
            way = np.radians(np.arange(at, goal + 0.5))
            for force in np.stack([np.sin(way), 0 * way, np.cos(way)], axis=1) @ axes.T:
                slack = force if slack is None else np.clip(slack, force - width, force + width)
            at, result[row] = goal, np.array(weights) @ ((force - slack) / width)
    return result


def each(*shapes: Shape) -> list[Shape]:
    """Return the shapes in each channel."""
    return [partial(lambda s, i, on, a: s(on, a) * XYZ[i], s, i) for s in shapes for i in range(3)]


def errors(number: int, *shapes: Callable[[Day], Floats]) -> list[Shape]:
    """Return the shapes as additions to error `number` of the stand."""
    return [partial(lambda s, on, _: error(number, np.ravel(s(on))), s) for s in shapes]


def _families() -> Iterator[tuple[str, Stage, list[Shape]]]:
    """Yield a name of the catalogue, its stage, and shapes that span its additions, for each form and location.

    In a list of shapes of the block, the channels alternate: x, y, z, x, … Besides the catalogue's forms, there
    are forms with two plays or time constants, other lags and other widths.
    """

    def waves(times: int) -> list[Callable[[Day], Floats]]:
        return [lambda on: np.sin(times * on.angle), lambda on: np.cos(times * on.angle)]

    yield "quadratic_nonlinearity", "block", each(lambda _, a: a**2)
    yield "cubic_nonlinearity", "block", each(lambda _, a: a**3)
    yield "odd_quadratic_nonlinearity", "block", each(lambda _, a: a * np.abs(a))
    yield "scale_asymmetry", "block", each(lambda _, a: np.abs(a))
    yield "bias_asymmetry", "block", each(lambda _, a: np.clip(a / 0.005, -1.0, 1.0))
    yield (
        "cross_coupling",
        "block",
        each(
            lambda _, a: a * np.roll(a, -1, 1),
            lambda _, a: a * np.roll(a, -2, 1),
            lambda _, a: np.roll(a, -1, 1) * np.roll(a, -2, 1),
        ),
    )
    yield (
        "cross_quadratic",
        "block",
        each(lambda _, a: np.roll(a, -1, 1) ** 2, lambda _, a: np.roll(a, -2, 1) ** 2),
    )
    for width in ((0.03,), (0.1,), (0.15,), (0.25,), (0.35,), (0.5,), (0.8,), (0.06, 0.4)):
        yield "hysteresis", "block", each(partial(lambda w, on, _: loop(on, w, (1.0, 1.0)[: len(w)]), width))
    for lag in (0, 5, 7, 10, 14, 20, 30):
        yield "thermal_bias", "block", each(partial(lambda g, on, _: on.lagged(60 * g)[:, None], lag))
        yield "thermal_scale", "block", each(partial(lambda g, on, a: on.lagged(60 * g)[:, None] * a, lag))
    for tau in (7, 10, 15, 20, 30, 45, 65):
        yield "warm_up", "block", each(partial(lambda t, on, _: fade(on, t), tau))
        yield "voltmeter_warm_up", "meter", [partial(lambda t, on, _: fade(on, t), tau)]
    for tau in (7, 10, 15, 20):
        yield "warm_up", "block", each(partial(lambda t, on, _: fade(on, t) + fade(on, 2.7 * t), tau))
    for tau in (10, 20, 40, 80):
        settling = partial(lambda t, on: fade(on, t, on.since_mount_s), tau)
        yield "thermal_settling", "block", each(partial(lambda f, on, _: f(on), settling))
        yield "mounting_creep", "stand", [shape for k in (0, 2, 3) for shape in errors(k, settling)]
    yield "bias_drift", "block", each(lambda on, _: hours(on))
    yield "scale_drift", "block", each(lambda on, a: hours(on) * a)
    for first in (1, 2):
        later = partial(lambda m, on: on.mount >= m, first)
        yield "turn_on_shift", "block", each(partial(lambda w, on, _: w(on)[:, None], later))
        yield from _of_gains(later)
    angles = {"axis_tilt": 1, "bracket_tilt": 1, "mounting_error": 2, "mounting_roll": 3}
    for mount in range(2):
        for name, number in (angles | {"mounting_offset": 0, "zero_offset": 0}).items():
            yield name, "stand", errors(number, partial(lambda m, on: on.mount == m, mount))
        yield from _of_passes(mount)
    yield "head_eccentricity", "stand", errors(0, *waves(1))
    yield "head_ellipticity", "stand", errors(0, *waves(2))
    yield "head_graduation", "stand", errors(0, *(partial(lambda k, on: on.eighth == k, k) for k in range(8)))
    for times in (1, 2):
        yield "axis_wobble", "stand", errors(1, *waves(times))
    for period in (3.0, 4.5, 6.0, 7.0, 12.0, 24.0):
        both = [partial(lambda f, p, on: f(TURN * hours(on) / p), f, period) for f in (np.sin, np.cos)]
        yield "foundation_tilt", "stand", errors(0, *both) + errors(1, *both)
    yield "voltmeter_nonlinearity", "meter", [lambda _, v: v**2, lambda _, v: v**3]
    yield "voltmeter_drift", "meter", [lambda on, _: hours(on)]
    yield "channel_crosstalk", "meter", [lambda _, v: -np.diff(v.ravel(), prepend=v[0, 0]).reshape(v.shape)]
    yield (
        "range_offset",
        "meter",
        each(
            lambda _, v: np.where(np.abs(v) < 1.2, 1 + 0 * v, 0), lambda _, v: np.where(np.abs(v) < 1.2, v, 0)
        ),
    )


def _of_gains(place: Callable[[Day], Floats]) -> Iterator[tuple[str, Stage, list[Shape]]]:
    """Yield steps of the gain, by channel and common, in the rows in which `place` is not zero."""
    gain = partial(lambda w, on, v: w(on)[:, None] * v, place)
    yield "scale_step", "block", each(gain)
    yield "reference_step", "meter", [gain]


def _of_passes(mount: int) -> Iterator[tuple[str, Stage, list[Shape]]]:
    """Yield what acts in a pass of a mounting, from it to the end of the mounting, or to the end of the run."""
    for p in (1, 2, 3):
        places = (
            partial(lambda m, p, on: (on.mount == m) & (on.pass_number == p), mount, p),
            partial(lambda m, p, on: (on.mount == m) & (on.pass_number >= p), mount, p),
            partial(lambda m, p, on: on.mount + on.pass_number / 9 >= m + p / 9 - 1e-9, mount, p),
        )
        for place in places[: 1 if p == 1 else 3]:
            yield "block_slip", "stand", [shape for k in (0, 2, 3) for shape in errors(k, place)]
            yield "head_zero_shift", "stand", errors(0, place)
            yield from _of_gains(place)
            for signs in XYZ - XYZ[[1, 2, 0]]:
                yield (
                    "meters_exchanged",
                    "meter",
                    [
                        partial(lambda k, w, s, on, v: w(on)[:, None] * s * v**k, k, place, signs)
                        for k in (0, 1)
                    ],
                )


FAMILIES: Final = list(_families())
NAMES: Final = {name: [k for k, family in enumerate(FAMILIES) if family[0] == name] for name, *_ in FAMILIES}
"""Indices in `FAMILIES` by name of the catalogue."""
ROUGHLY: Final = ("scale_step", "reference_step", "thermal_settling", "mounting_creep")
"""Names of which only common forms are spanned: they can be rivals, but do not show what a name leaves."""
RIVALS: Final = {"mounting_error", "mounting_offset", "zero_offset", "bracket_tilt", *ROUGHLY}
"""Names that are not hidden: within the stand's errors of up to 3′, a second axis tilt, or `ROUGHLY`."""
HIDDEN: Final = [name for name in NAMES if name not in RIVALS]


OUTSIDE: Final[dict[str, tuple[Stage, Act]]] = {
    "cable tilt": ("stand", lambda on, _, __, ___: error(1, np.sin(on.angle / 2))),
    "cable bias": ("block", lambda on, _, r, __: np.outer(np.sin(on.angle / 2), one(r))),
    "cable winding up": ("block", lambda on, _, r, __: np.outer(on.angle + TURN * on.pass_number, one(r))),
    "dead band": ("block", lambda _, a, r, __: -np.clip(a, -0.3, 0.3) * one(r)),
    "one-sided saturation": ("block", lambda _, a, r, __: -np.maximum(a - 0.6, 0.0) * one(r)),
    "three plays": ("block", lambda on, _, r, __: loop(on, (0.03, 0.12, 0.5), (0.5, 0.8, 1.0)) * one(r)),
    "pick-up": ("meter", lambda on, _, r, __: _pickup(on, r) * one(r)),
    "common pick-up": ("meter", lambda on, _, r, __: _pickup(on, r) * np.ones(3)),
    "jump at a point": ("block", lambda on, _, r, __: np.outer(
        (on.mount == r.integers(2)) & (on.point == r.integers(2, 9)), one(r))),
    # the two other channels change in only one of the installations
    "gain step": ("meter", lambda on, volt, _, __: (on.mount >= 1)[:, None] * volt * XYZ[0]),
    "common gain step": ("meter", lambda on, volt, _, __: (on.mount >= 1)[:, None] * volt),
    "gain of a pass": ("meter", lambda on, volt, r, _: (on.sweep == r.integers(6))[:, None] * one(r) * volt),
    "creep since mounting": ("block", lambda on, _, r, __: (
        fade(on, r.uniform(20, 90), on.since_mount_s) * one(r))),
    "tilt creep since mounting": ("stand", lambda on, _, __, ___: error(1, fade(on, 35, on.since_mount_s))),
    "turn creep since mounting": ("stand", lambda on, _, __, ___: error(0, fade(on, 25, on.since_mount_s))),
    "creep since power-on": ("block", lambda on, _, r, __: np.log1p(hours(on) * r.uniform(12, 60)) * one(r)),
    "scale warm-up": ("block", lambda on, a, r, _: fade(on, 30) * a * one(r)),
    "thermal gradient": ("block", lambda on, a, r, _: (
        fade(on, 8, on.since_mount_s) * (1 + a / 2) * r.normal(size=3))),
    "third harmonic": ("block", lambda on, _, r, __: np.outer(np.sin(3 * on.angle + r.uniform(0, TURN)), one(r))),
    "fourth harmonic": ("block", lambda on, _, r, __: np.outer(np.sin(4 * on.angle + r.uniform(0, TURN)), one(r))),
    "sticking head": ("stand", lambda on, _, __, ___: error(
        0, np.exp((1 - on.point) / 1.5) * (on.pass_number > 1))),
    "gear ratio": ("stand", lambda on, _, __, ___: error(0, on.angle)),
    "three per turn of the head": ("stand", lambda on, _, r, __: error(
        0, np.sin(3 * on.angle + r.uniform(0, TURN)))),
    "quadratic drift": ("block", lambda on, _, r, __: (hours(on) - 1.3) ** 2 * one(r)),
    "late bias step": ("block", lambda on, _, r, __: (hours(on) > r.uniform(0.4, 2.2)) * one(r)),
    "vibration window": ("block", lambda on, _, r, __: np.outer(
        np.abs(np.arange(len(on)) - r.integers(8, 44)) <= 4, r.normal(size=3))),
    "sign of another channel": ("meter", lambda _, volt, r, __: np.roll(np.tanh(4 * volt), 1, 1) * one(r)),
    "fourth power": ("block", lambda _, a, r, __: a**4 * one(r)),
    "cube of another axis": ("block", lambda _, a, r, __: np.roll(a, 1, 1) ** 3 * one(r)),
    "loosening bracket": ("stand", lambda on, _, __, ___: error(3, on.since_mount_s / 3600)),
    "bias walk": ("meter", lambda on, _, r, now: np.outer(np.cumsum(now.normal(size=len(on))), one(r))),
    "gain walk": ("meter", lambda on, volt, _, now: np.cumsum(now.normal(size=len(on)))[:, None] * volt),
    "noisy channel": ("meter", lambda on, _, r, now: np.outer(
        (on.mount == r.integers(2)) * now.normal(size=len(on)), one(r))),
    "noise burst": ("meter", lambda on, _, r, now: np.outer(
        (on.sweep == r.integers(6)) * now.normal(size=len(on)), one(r))),
    "heavy tails": ("meter", lambda on, _, r, now: np.outer(now.standard_t(1.5, len(on)), one(r))),
    "loose setting": ("stand", lambda on, _, r, now: error(
        0, (on.mount == r.integers(2)) * now.normal(size=len(on)))),
}  # fmt: skip
"""Stage and addition of effects outside the catalogue, by name; the last six have mean zero and differ by day."""
SCATTER: Final = tuple(OUTSIDE)[-6:]


def _pickup(on: Day, rng: Rng) -> Floats:
    return np.sin(TURN * hours(on) * 60 / rng.uniform(5, 15) + rng.uniform(0, TURN))


def _drawn(name: str, seed: int) -> Form:
    rng = np.random.default_rng([seed, 1])
    if name in OUTSIDE:
        stage, act = OUTSIDE[name]
        return Form(name, stage, act, 1e-6 * rng.choice([-1, 1]), name in SCATTER, seed)
    _, stage, shapes = FAMILIES[rng.choice(NAMES[name])]
    if stage == "block":
        shapes = shapes[rng.integers(3) :: 3]
    sizes = rng.normal(size=len(shapes))
    parts = list(zip(sizes, shapes, strict=True))
    return Form(name, stage, lambda on, a, _, __: sum(k * s(on, a) for k, s in parts), 1e-6)


def hidden(name: str, size: float, number: int, seed: int) -> Form:
    """Return a form of this size, in units of noise, on a day.

    It is drawn until it is smaller than 6′, 8 mg or 8 mV.
    """
    largest = {"stand": 2e-3, "block": 8e-3, "meter": 8e-3}
    for again in range(20):
        form = _drawn(name, seed + again)
        for _ in range(3):
            seen = max(rho(signature(form, number), number), 1e-3)
            form = replace(form, size=np.clip(form.size * size / seen, -1.0, 1.0))
        if np.abs(form.addition(day(number), volts(day(number)), 0)).max() < largest[form.stage]:
            return form
    raise ValueError(f"{name} shows on no day at a plausible size")


def signature(form: Form, number: int) -> Floats:
    """Return the change of the readings of a day by a form, (n, 3), V."""
    return volts(day(number), [form]) - volts(day(number))


@cache
def spaces(number: int) -> dict[str, list[Floats]]:
    """Return orthonormal bases, in units of noise, of the residuals that each name can cause on a day."""
    found: dict[str, list[Floats]] = {name: [] for name in NAMES}
    for name, stage, shapes in FAMILIES:
        forms = [Form(name, stage, partial(lambda s, on, a, _, __: s(on, a), s), 1e-6) for s in shapes]
        columns = np.array([left(signature(form, number), number) for form in forms])
        u, s, _ = np.linalg.svd(columns.T, full_matrices=False)
        found[name].append(u[:, (s > 1e-3 * s[0]) & (s > 1e-9)])
    return found


def left_by(names: Sequence[str], seen: Floats, number: int) -> float:
    """Return the part of a residual, in units of noise, that the effects `names` leave unexplained."""
    for name in names:
        parts = [seen - base @ (base.T @ seen) for base in spaces(number)[name]]
        seen = min(parts, key=lambda part: float(np.linalg.norm(part)))
    return float(np.linalg.norm(seen))
