"""A run of the paper's procedure with verification points, times and temperatures, simulated for tests.

The readings come from `paper_bench`, whose geometry is not the application's.
"""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from bench.base.arrays import Floats
from bench.diagnosis import Threshold, ThresholdCache
from bench.diagnosis.candidates import Candidates, make_candidates
from bench.diagnosis.evidence import Whitened
from bench.diagnosis.linear import LinearSystem, make_linear
from bench.diagnosis.noise_grid import NoiseGrid, make_noise_grid
from bench.diagnosis.residual_dictionary import SIZE_NAMES
from bench.model import AppliedEffect, ForwardModel, Installation
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.table import Readings, make_readings
from bench.validation.paper_bench import SETTING_U_RAD, STAND_U, U0, K, specific_force

PSI = np.radians(45.0)
MODEL = ForwardModel(
    {
        "1": INSTALLATION_1,
        "2": INSTALLATION_2,
        "V": Installation.from_axes("V", ("x", "y", "z"), PSI, "z"),
    }
)
NOISE_V = 15e-6
STAND = {**STAND_U, "setting_error": SETTING_U_RAD}


def paper_run(
    rng: np.random.Generator | None,
    *,
    directions: tuple[int, ...] = (1, 1, 1),
    noise_v: float = NOISE_V,
    K2: tuple[float, float, float] = (0.0, 0.0, 0.0),
    drift_v_per_h: tuple[float, float, float] = (0.0, 0.0, 0.0),
    backlash_rad: float = 0.0,
    verification: bool = True,
) -> Readings:
    """Simulate one run; stand errors are drawn per mounting. Without `rng` there are no random errors."""
    rows = [
        (label, number, point, direction)
        for label in "12"
        for number, direction in enumerate(directions, start=1)
        for point in (range(1, 10) if direction > 0 else range(9, 0, -1))
    ]
    rows += [("V", 1, point, 1) for point in (1, 2, 3, 4)] if verification else []
    label, number, point, direction = (list(column) for column in zip(*rows, strict=True))
    n = len(rows)
    step = np.array([90.0 if name == "V" else 45.0 for name in label])
    phi = np.radians(step * (np.array(point) - 1) + np.where(np.array(label) == "V", 45.0, 0.0))
    mount = np.array(["12V".index(name) for name in label])
    time_s = 120.0 * np.arange(n) + 2400.0 * mount
    errors = np.zeros((3, 3))
    setting, noise = np.zeros(n), np.zeros((n, 3))
    temperature_c = 23.0 + 0.15 * np.sin(2 * np.pi * time_s / 2220.0)
    if rng is not None:
        sizes = [STAND_U[name] for name in ("axis_tilt", "zero_offset", "mounting_error")]
        errors = rng.normal(0.0, sizes, (3, 3))
        setting = rng.normal(0.0, SETTING_U_RAD, n)
        noise = rng.normal(0.0, noise_v, (n, 3))
    setting = setting + 0.5 * backlash_rad * np.array(direction)
    e = errors[mount].T
    force = np.zeros((n, 3))
    turned = np.array(label) == "V"
    for mine, psi in ((~turned, 0.0), (turned, PSI)):
        if mine.any():
            names = ["1" if name == "V" else name for name in np.array(label)[mine]]
            force[mine] = specific_force(
                names, phi[mine], e[0][mine], e[1][mine], e[2][mine], setting[mine], psi=psi
            )
    signal = force @ K.T + U0 + np.diag(K) * np.array(K2) * force**2 + noise
    signal += np.outer(time_s / 3600.0, drift_v_per_h)
    return make_readings(
        label, number, point, phi, signal, direction=direction, time_s=time_s, temperature_c=temperature_c
    )


class OneThreshold(ThresholdCache):
    """A cache that returns one threshold for any design, by default about that of the paper's design."""

    def __init__(self, *sizes: float) -> None:
        super().__init__(None)
        self.given = Threshold(*(sizes or (1.2, 0.006, -0.3, 0.05, 0.7, 2000)))

    def threshold(self, linear: LinearSystem, whitened: Whitened, setting_rad: float) -> Threshold:
        """Return the same threshold for any design."""
        return self.given


class Set:
    """Readings prepared for the search; slow parts are computed on first use."""

    def __init__(self, linear: LinearSystem, sigma: float) -> None:
        self.linear, self.sigma = linear, sigma

    @cached_property
    def grid(self) -> NoiseGrid:
        """The noise ratios with their maps to white noise."""
        return make_noise_grid(self.linear, self.sigma, SETTING_U_RAD)

    @cached_property
    def candidates(self) -> Candidates:
        """All candidates."""
        return make_candidates(self.linear, self.sigma)

    @cached_property
    def whitened(self) -> Whitened:
        """The candidates in units of the noise."""
        return Whitened.of(self.grid, self.candidates)


def set_up(readings: Readings, model: ForwardModel = MODEL, sigma: float = NOISE_V) -> Set:
    """Linearise readings for a search with all candidates, in units of the noise."""
    return Set(make_linear(readings, model, STAND_U), sigma)


def columns_by_model(listed: Any, system: Any) -> Iterator[tuple[Floats, Floats]]:
    """Yield each column of the dictionary term `listed`, and the forward model's column of equal size."""
    term, channel, columns = listed
    effect = term.effect("one", per_channel=channel is not None)
    values = {p.name: np.asarray(p.default) for p in effect.parameters if p.is_shape}
    for parameter, column in zip(SIZE_NAMES, columns, strict=False):
        size = term.unit.plausible
        one = np.asarray(size) if channel is None else size * np.eye(3)[channel]
        yield column, system.effect_column(AppliedEffect(effect, {**values, parameter: one}))
