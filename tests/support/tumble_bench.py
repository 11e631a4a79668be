"""Multi-point tumbles with known truth: geometry of paper_bench.py, nonlinear terms defined here."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bench.base.arrays import Floats
from bench.readings.csv import CentrifugePoints
from bench.readings.table import Readings, make_readings
from bench.validation.paper_bench import SETTING_U_RAD, STAND_U, U0, K, specific_force


@dataclass(frozen=True)
class Terms:
    """Sizes of the nonlinear terms of the three channels, g/g^n, (3,) each."""

    K2: Floats = field(default_factory=lambda: np.zeros(3))
    K3: Floats = field(default_factory=lambda: np.zeros(3))
    Koq: Floats = field(default_factory=lambda: np.zeros(3))
    Kip: Floats = field(default_factory=lambda: np.zeros(3))
    Kpp: Floats = field(default_factory=lambda: np.zeros(3))
    Koo: Floats = field(default_factory=lambda: np.zeros(3))
    K0p: Floats = field(default_factory=lambda: np.zeros(3))
    K1p: Floats = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Terms:
        """Draw K2, K3 and Koq with standard deviations of 20, 10 and 10 ug/g^n."""
        return cls(*(rng.normal(0.0, size * 1e-6, 3) for size in (20, 10, 10)))

    def output(self, a: Floats) -> Floats:
        """Return the terms' contribution to E/K1, g, at specific forces (n, 3), g."""
        x, y, z = a.T
        nxt, then = np.stack([y, z, x], axis=1), np.stack([z, x, y], axis=1)
        return np.asarray(
            self.K2 * a * a
            + self.K3 * a * a * a
            + self.Koq * a * np.abs(a)
            + self.Kip * a * nxt
            + self.Kpp * nxt * nxt
            + self.Koo * then * then
            + self.K0p / 2 * np.clip(a / 0.005, -1, 1)
            + self.K1p / 2 * np.abs(a)
        )


def design(points: int, passes: int) -> tuple[list[str], list[int], list[int], Floats]:
    """Return installation, pass, point and head angle (rad) of turns that end at their first point again."""
    rows = [(i, p, t) for i in "12" for p in range(1, passes + 1) for t in range(1, points + 2)]
    installation, pass_number, point = (list(column) for column in zip(*rows, strict=True))
    return installation, pass_number, point, 2 * np.pi / points * (np.array(point) - 1)


def tumble(
    rng: np.random.Generator | None,
    noise_v: float,
    terms: Terms,
    *,
    points: int = 12,
    passes: int = 3,
    setting_u_rad: float = SETTING_U_RAD,
) -> Readings:
    """Simulate one run, with stand errors per installation and noise per reading; without `rng` no errors."""
    installation, pass_number, point, phi = design(points, passes)
    n = len(phi)
    angles, setting, noise = np.zeros((3, n)), np.zeros(n), np.zeros((n, 3))
    if rng is not None:
        sizes = [STAND_U[name] for name in ("axis_tilt", "zero_offset", "mounting_error")]
        angles = rng.normal(0.0, sizes, (2, 3))[[int(i) - 1 for i in installation]].T
        setting = rng.normal(0.0, setting_u_rad, n)
        noise = rng.normal(0.0, noise_v, (n, 3))
    a = specific_force(installation, phi, angles[0], angles[1], angles[2], setting)
    signal = a @ K.T + U0 + np.diag(K) * terms.output(a) + noise
    return make_readings(installation, pass_number, point, phi, signal)


def centrifuge(
    rng: np.random.Generator | None,
    terms: Terms,
    noise_v: float = 0.0,
    u_ms2: float = 1e-5,
    u_radius: float = 1e-6,
) -> CentrifugePoints:
    """Simulate points at ±2, ±5 and ±10 g along each axis; only the channel of this axis is read."""
    force = (
        np.concatenate([size * np.eye(3)[[k]] for k in range(3) for size in (-10, -5, -2, 2, 5, 10)]) * 9.81
    )
    acting, noise = force / 9.81, np.zeros_like(force)
    if rng is not None:
        along = np.sign(acting) * rng.normal(0.0, u_ms2, (len(force), 1)) / 9.81
        acting = acting * (1 + rng.normal(0.0, u_radius)) + along
        noise = rng.normal(0.0, noise_v, force.shape)
    signal = acting @ K.T + U0 + np.diag(K) * terms.output(acting) + noise
    own = np.where(force != 0.0, signal, np.nan)
    n = len(force)
    return CentrifugePoints("points", force, np.full(n, u_ms2), np.full(n, u_radius), own)


def truth(terms: Terms) -> dict[str, float]:
    """Return the true quantities by name ("x.K0"), each alone and not as a sum with others."""
    found: dict[str, float] = {}
    after = {"x": ("y", "z"), "y": ("z", "x"), "z": ("x", "y")}
    for i, channel in enumerate("xyz"):
        nxt, then = after[channel]
        own = K[i, i]
        found[f"{channel}.K0"] = U0[i] / own
        found[f"{channel}.K1"] = own
        found[f"{channel}.alpha_{nxt}{channel}"] = K[i, "xyz".index(nxt)] / own
        found[f"{channel}.alpha_{then}{channel}"] = -K[i, "xyz".index(then)] / own
        for name in ("K2", "K3", "Koq", "K0p", "K1p"):
            found[f"{channel}.{name}"] = getattr(terms, name)[i]
    return found
