"""The stand of the trial: its geometry, the runs carried out on it, and the action of effects.

The geometry is exact, in rotations of frames around a fixed vertical. The specific force of a block at rest
is 1 g upwards; its components are followed through the frames: level ground, shaft, head, platform, bracket,
block. It agrees with the paper's equations (3) and (4) to second order in the angles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

ARCSEC: Final = np.pi / 648000
_HALF = np.sqrt(0.5)

AXES: Final[dict[str, Floats]] = {
    "1": np.eye(3),
    "2": np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "1T90": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "2T90": np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]]),
    "1T180": np.array([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]]),
    "2T180": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "V": np.array([[_HALF, _HALF, 0], [-_HALF, _HALF, 0], [0, 0, 1]]),
}
"""Block axes x, y, z as rows in platform axes, by installation; V is turned by 45° about z of the platform."""


def specific_force(
    labels: NDArray[np.str_],
    angle: Floats,
    axis_tilt: Floats | float = 0.0,
    mounting_error: Floats | float = 0.0,
    mounting_roll: Floats | float = 0.0,
) -> Floats:
    """Return the specific force on the block's axes, g, shape (n, 3).

    `labels` (n,) are keys of `AXES`, `angle` (n,) the true head angle (zero offset and setting error included),
    `axis_tilt` α1, `mounting_error` α3, `mounting_roll` α5, all in rad, (n,) or one for all.
    """
    up_y, up_z = np.sin(axis_tilt), np.cos(axis_tilt)
    x, z = up_z * np.sin(angle), up_z * np.cos(angle)
    x, y = (
        x * np.cos(mounting_error) + up_y * np.sin(mounting_error),
        up_y * np.cos(mounting_error) - x * np.sin(mounting_error),
    )
    y, z = (
        y * np.cos(mounting_roll) + z * np.sin(mounting_roll),
        z * np.cos(mounting_roll) - y * np.sin(mounting_roll),
    )
    platform = np.stack(np.broadcast_arrays(x, y, z), axis=1)
    force = np.zeros_like(platform)
    for label in np.unique(labels):
        rows = labels == label
        force[rows] = platform[rows] @ AXES[str(label)].T
    return force


# --- place, time, direction and temperature of each reading ----------------------------------------------


POINT_S: Final = 120.0
INPUT_CHECK_S: Final = 60.0
REMOUNT_S: Final = 2400.0
CYCLE_S: Final = 37 * 60.0
CYCLE_K: Final = 0.15
REFERENCE_TEMPERATURE_C: Final = 23.0
REFERENCE_V: Final = 2.0
EIGHTHS: Final = tuple(range(0, 361, 45))
TWELFTHS: Final = tuple(range(0, 361, 30))


@dataclass(frozen=True)
class Weather:
    """Temperature at the block minus the reference: a cycle of ±0.15 K in 37 min and a slow drift.

    `phase` is in rad, `drift` in K/s, `start` in K.
    """

    phase: float = 0.0
    drift: float = 0.25 / 7200
    start: float = 0.0

    def at(self, time_s: Floats, lag_s: float = 0.0) -> Floats:
        """Return the temperature deviation, K, (n,), of a body that follows with the lag `lag_s`.

        The lag is two first-order delays in series: four fifths and one fifth of it. Initial transients have
        decayed before the run.
        """
        cycle: NDArray[np.complex128] = CYCLE_K * np.exp(1j * (2 * np.pi * time_s / CYCLE_S + self.phase))
        for part in (0.8 * lag_s, 0.2 * lag_s):
            cycle = cycle / (1 + 2j * np.pi * part / CYCLE_S)
        return self.start + cycle.imag + self.drift * (time_s - lag_s)


@dataclass(frozen=True)
class Sweep:
    """One pass over the angles (deg, in rising order) in one direction, and the scan order of the channels.

    `warmer_k` is the temperature that a chamber adds, K.
    """

    label: str
    number: int
    angles: tuple[int, ...] = EIGHTHS
    direction: int = 1
    scan: str = "xyz"
    series: int = 1
    warmer_k: float = 0.0


@dataclass(frozen=True)
class Design:
    """The mountings of a run in order, each with its sweeps, and whether each sweep begins with rows S and R."""

    mountings: tuple[tuple[Sweep, ...], ...]
    input_checks: bool = False


def _at(label: str, sweeps: Sequence[Sweep]) -> tuple[Sweep, ...]:
    """Return the sweeps in another installation."""
    return tuple(replace(sweep, label=label) for sweep in sweeps)


def _design(sweeps: Sequence[Sweep], *, turned: bool = False, input_checks: bool = False) -> Design:
    """Return a design with the sweeps in installations 1 and 2, each repeated once by 180° if `turned`."""
    mountings = []
    for label in "12":
        mountings += [_at(label, sweeps), *([(Sweep(f"{label}T180", 1),)] if turned else [])]
    return Design((*mountings, _VERIFICATION), input_checks)


_VERIFICATION: Final = (Sweep("V", 1, (45, 135, 225, 315)),)
_RISING: Final = tuple(Sweep("1", number) for number in (1, 2, 3))
_OVEN_K: Final = ((1, 0.0), (2, 20.0), (3, -20.0))
DESIGNS: Final[dict[str, Design]] = {
    "paper": _design(_RISING),
    "both": _design([Sweep("1", 1), Sweep("1", 2, direction=-1), Sweep("1", 3)]),
    "turn-12": _design([replace(sweep, angles=TWELFTHS) for sweep in _RISING]),
    "return": Design((_RISING, _at("2", _RISING), (Sweep("1", 1, series=2),), _VERIFICATION)),
    "remount-180": _design(_RISING[:2], turned=True),
    "reordered": _design(
        [Sweep("1", 1), Sweep("1", 2, direction=-1, scan="zyx")], turned=True, input_checks=True
    ),
    "six": Design(
        (
            tuple(replace(sweep, angles=(0, 90, 180, 270)) for sweep in _RISING),
            tuple(replace(sweep, angles=(0, 180)) for sweep in _at("2", _RISING)),
        )
    ),
    "unverified": Design((_RISING, _at("2", _RISING))),
    "oven": _design([Sweep("1", number, TWELFTHS, warmer_k=k) for number, k in _OVEN_K]),
}
"""Designs by name.

`reordered` has both directions, the scan order reversed once, rows S and R in each pass, and a third pass turned
by 180°.
"""


@dataclass(frozen=True)
class Run:
    """Columns over the n readings of a design, in the order of measurement; angles in rad, times in s.

    `mount` (n,) counts the mountings from 0; `input_v` (n,) is the voltage at the voltmeter's input in rows S and
    R, NaN in rows that measure the block. `weather` describes the temperature.
    """

    design: str
    labels: NDArray[np.str_]
    series: NDArray[np.int64]
    pass_number: NDArray[np.int64]
    point: NDArray[np.int64]
    mount: NDArray[np.int64]
    angle: Floats
    direction: NDArray[np.int64]
    time_s: Floats
    scan: NDArray[np.str_]
    warmer_k: Floats
    input_v: Floats
    weather: Weather

    @property
    def fitted(self) -> NDArray[np.bool_]:
        """The rows that a calibration fits."""
        return np.asarray(self.measured & (self.labels != "V"))

    @property
    def measured(self) -> NDArray[np.bool_]:
        """The rows in which the block is measured: fitted and verification rows."""
        return np.asarray(np.isnan(self.input_v))

    @property
    def calibration_mounts(self) -> NDArray[np.int64]:
        """The mountings that a calibration fits."""
        return np.unique(self.mount[self.fitted])

    @property
    def head_angle(self) -> Floats:
        """The head angle (n,), rad, with 0 if none was noted."""
        return np.nan_to_num(self.angle)

    def temperature(self, lag_s: float = 0.0) -> Floats:
        """Return the temperature minus the reference, K, (n,), of a body with a lag."""
        return self.weather.at(self.time_s, lag_s) + self.warmer_k

    def with_weather(self, weather: Weather) -> Run:
        return replace(self, weather=weather)


@lru_cache
def make_run(name: str) -> Run:
    """Return the run of a design of `DESIGNS`, with a time for each reading."""
    design = DESIGNS[name]
    rows: list[tuple[object, ...]] = []
    clock, checks = 0.0, 0
    for mount, sweeps in enumerate(design.mountings):
        clock += REMOUNT_S if mount else 0.0
        for sweep in sweeps:
            if design.input_checks and sweep.label != "V":
                checks += 1
                for label, volts in (("S", 0.0), ("R", REFERENCE_V)):
                    clock += INPUT_CHECK_S
                    rows.append((label, 1, checks, 1, mount, np.nan, 0, clock, sweep.scan, 0.0, volts))
            stops = list(enumerate(sweep.angles, start=1))
            for point, degrees in stops[:: sweep.direction]:
                clock += POINT_S
                place = (sweep.label, sweep.series, sweep.number, point, mount, np.radians(degrees))
                rows.append((*place, sweep.direction, clock, sweep.scan, sweep.warmer_k, np.nan))
    names = ("labels", "series", "pass_number", "point", "mount", "angle", "direction", "time_s", "scan")
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Run(name, **dict(zip((*names, "warmer_k", "input_v"), columns, strict=True)), weather=Weather())


@lru_cache
def head_path(name: str) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Return the specific force along the path of the head, in steps of at most 3°, without errors.

    The result is the force (m, 3), the step at which each row of the run is read, and the steps at which
    mountings begin. The head arrives in the noted direction: it continues over a full turn if necessary, and
    where the direction changes it goes 20° past a stop and back.
    """
    run = make_run(name)
    angles: list[float] = []
    labels: list[str] = []
    stops = np.zeros(len(run.angle), dtype=np.int64)
    begins: list[int] = []
    here, heading, mount = 0.0, 0, -1
    past = np.radians(20)
    for row, (target, direction) in enumerate(zip(run.angle, run.direction, strict=True)):
        if np.isnan(target):
            continue
        if run.mount[row] != mount:
            mount, heading = int(run.mount[row]), 0
            begins.append(len(angles))
            here = target - direction * past
        ahead = float(((target - here) * direction + 1e-6) % (2 * np.pi) - 1e-6)
        turns_back = heading not in (0, direction) and ahead < past
        legs = [-direction * past, direction * (past + ahead)] if turns_back else [direction * ahead]
        for leg in legs:
            steps = max(1, int(np.ceil(abs(leg) / np.radians(3))))
            angles += (here + leg * np.arange(1, steps + 1) / steps).tolist()
            labels += [str(run.labels[row])] * steps
            here += leg
        heading = direction
        stops[row] = len(angles) - 1
    way, of = np.array(angles), np.array(labels)
    level = np.stack([np.sin(way), np.zeros(len(way)), np.cos(way)], axis=1)
    force = np.einsum("nij,nj->ni", np.stack([AXES[label] for label in of]), level)
    return force, stops, np.array(begins)


# --- a hidden effect -------------------------------------------------------------------------------------


Stage = Literal["stand", "block", "voltmeter"]
Act = Callable[[Run, Floats, float], Floats]
Shift = dict[str, Floats | float]
CHANNELS: Final = ("x", "y", "z")


@dataclass(frozen=True)
class Truth:
    """One effect with drawn parameters, ready to act on a run.

    `amplitude` is in units of the plausible size (1 σ of `effects.md`). Its action is one of: `shift(run,
    amplitude)` for the stand: rad (n,) to add to `angle`, `tilt` (α1), `skew` (α3) or `roll` (α5), or `gravity` as
    a relative change; `act(run, force, amplitude)` for the block: g (n, 3), scaled by K_ii; `act(run, volts,
    amplitude)` for the voltmeter: V (n, 3). `shape` names the parameters that do not enter linearly.
    """

    name: str
    stage: Stage
    act: Act | None = None
    shift: Callable[[Run, float], Shift] | None = None
    amplitude: float = 1.0
    channels: tuple[str, ...] = ()
    mounts: tuple[str, ...] = ()
    shape: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)

    def scaled(self, amplitude: float) -> Truth:
        return replace(self, amplitude=amplitude)


Draw = Callable[[np.random.Generator, Run], Truth]
"""A function that draws the parameters of an effect for a run."""


def channel_weights(rng: np.random.Generator) -> tuple[Floats, tuple[str, ...]]:
    """Draw one, two or three channels with signed weights of 0.5 to 1; the weights of other channels are zero."""
    count = int(rng.choice([1, 2, 3], p=[0.5, 0.25, 0.25]))
    chosen = np.sort(rng.choice(3, count, replace=False))
    weights = np.zeros(3)
    weights[chosen] = rng.choice([-1.0, 1.0], count) * rng.uniform(0.5, 1.0, count)
    return weights, tuple(CHANNELS[i] for i in chosen)


def mount_weights(
    rng: np.random.Generator, run: Run, *, after_remount: bool = False
) -> tuple[Floats, tuple[str, ...]]:
    """Draw one or more mountings of the calibration with signed weights of 0.5 to 1.

    With `after_remount`, the first mounting is the reference of the others and has weight zero. Returns the weights
    for the rows (n,) and the labels of the mountings.
    """
    mounts = run.calibration_mounts[1 if after_remount else 0 :]
    count = int(rng.integers(1, len(mounts) + 1))
    chosen = np.sort(rng.choice(mounts, count, replace=False))
    weights = np.zeros(int(run.mount.max()) + 1)
    weights[chosen] = rng.choice([-1.0, 1.0], count) * rng.uniform(0.5, 1.0, count)
    return weights[run.mount], tuple(str(run.labels[(run.mount == m) & run.measured][0]) for m in chosen)
