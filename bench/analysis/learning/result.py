"""What was learned of a bench: each size with u, degrees of freedom, what it is of, and the runs behind all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from scipy import special

from bench.analysis.calibration.known import KnownStand
from bench.base.arrays import ARCSEC, CHANNELS, Floats
from bench.base.numbers import finite_or_none

if TYPE_CHECKING:
    from bench.analysis.learning.contradictions import Contradiction
    from bench.analysis.learning.meters import MeterDifferences

NONE: Final = 1e-6
"""A variance that is no larger part of what was stated is none."""
FEW_DOF: Final = 4.0
"""With no more degrees of freedom a size is told by its upper end alone."""
SHOWN_P: Final = 0.01
"""A wave of the head is taken for one where chance alone makes as large a one less often."""
HARDLY_BETTER: Final = 0.95
WAVE_NAMES: Final = (
    "head_eccentricity.cosine", "head_eccentricity.sine", "head_ellipticity.cosine", "head_ellipticity.sine",
)  # fmt: skip
NEVER: Final = (
    "absolute gain of the voltmeters: 1 ppm of it is 1 ppm of every coefficient of every block",
    "absolute zero of the voltmeters: it goes whole into the biases of every block",
)


@dataclass(frozen=True)
class Size:
    """One learned size in `unit`, with its standard uncertainty and degrees of freedom."""

    name: str
    value: float
    u: float
    unit: str
    dof: float
    told: bool = True

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "value": self.value, "u": self.u, "unit": self.unit, "dof": finite_or_none(self.dof), "told": self.told,
        }  # fmt: skip


@dataclass(frozen=True)
class Variance:
    """A variance component: `theta` and its u in terms of `unit` squared; `held` where it keeps its prior."""

    name: str
    theta: float
    u_theta: float
    unit: float
    held: bool

    @property
    def dof(self) -> float:
        """Degrees of freedom of the variance, 2 v^2/u(v)^2."""
        return 2.0 * self.theta**2 / max(self.u_theta**2, 1e-300)

    @property
    def size(self) -> float:
        """The standard deviation, SI."""
        return float(np.sqrt(self.theta)) * self.unit if self.theta > NONE else 0.0

    @property
    def u(self) -> float:
        """Standard uncertainty of the standard deviation, SI, by its degrees of freedom."""
        if self.dof > FEW_DOF:
            return self.size / float(np.sqrt(2.0 * (self.dof - 2.0)))
        return (float(np.sqrt(self.theta + self.u_theta)) - float(np.sqrt(self.theta))) * self.unit

    @property
    def u_next(self) -> float:
        """The standard deviation as it counts for a further run, SI: widened, and never nothing."""
        if self.held:
            return self.size
        nu = max(self.dof, FEW_DOF)
        z = self.theta / max(self.u_theta, 1e-300)
        tail = float(np.exp(-0.5 * z**2 - special.log_ndtr(z)) / np.sqrt(2.0 * np.pi))
        return float(np.sqrt(max(self.theta * nu / (nu - 2.0), self.theta + self.u_theta * tail))) * self.unit


@dataclass(frozen=True)
class Learned:
    """What runs of one bench share.

    `means` (m + waves,) rad by `keys` (name of the angle, installation or empty), then the waves of the head, with
    `covariance`; `stated` (m,) their u before, rad. `variances` are those of remounts by kind, then of the drift by
    channel (unit of the signal, per root hour), with `variances_covariance` (k, k) of their squares. `noise`
    (4,) are the sizes of x, y, z and of the setting (rad). `known` is what a further calibration takes of it.
    `meters` are the differences of the voltmeters, or a sentence on why they are not told.
    """

    runs: tuple[str, ...]
    unit: str
    keys: tuple[tuple[str, str], ...]
    means: Floats
    covariance: Floats
    means_dof: Floats
    stated: Floats
    waves: int
    variances: tuple[Variance, ...]
    variances_covariance: Floats
    noise: Floats
    noise_dof: Floats
    known: KnownStand
    not_told: Mapping[str, str]
    contradicting: tuple[Contradiction, ...] = ()
    too_many_contradict: bool = False
    meters: MeterDifferences | str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the means and waves."""
        own = [f"{name}[{installation}]" if installation else name for name, installation in self.keys]
        return (*own, *WAVE_NAMES[: self.waves])

    def sizes(self) -> Iterator[Size]:
        """Yield every size: means, remounts, noise, setting error, drift, waves of the head."""
        u = np.sqrt(np.diag(self.covariance))
        for j, name in enumerate(self.names):
            told = j >= len(self.stated) or u[j] < HARDLY_BETTER * self.stated[j]
            label = name if j >= len(self.stated) else f"{name}.mean"
            yield Size(
                label, self.means[j] / ARCSEC, u[j] / ARCSEC, "arcsec", float(self.means_dof[j]), bool(told)
            )
        kinds = len(self.variances) - 3
        for v in self.variances[:kinds]:
            yield Size(f"{v.name}.remount", v.size / ARCSEC, v.u / ARCSEC, "arcsec", v.dof, not v.held)
        for j, channel in enumerate(CHANNELS):
            nu = float(self.noise_dof[j])
            yield Size(f"noise[{channel}]", float(self.noise[j]), _u(self.noise[j], nu), self.unit, nu)
        nu = float(self.noise_dof[3])
        size = self.noise[3] / ARCSEC
        yield Size("setting_error", float(size), _u(size, nu), "arcsec", nu)
        for v in self.variances[kinds:]:
            yield Size(v.name, v.size, v.u, f"{self.unit}/sqrt(h)", v.dof)
        if not isinstance(self.meters, str):
            yield from self.meters.sizes()

    def shown_waves(self) -> list[int]:
        """Return which harmonics of the head, counted from 0, are larger than chance makes them."""
        m, found = len(self.keys), []
        for k in range(self.waves // 2):
            at = slice(m + 2 * k, m + 2 * k + 2)
            chi2 = float(self.means[at] @ np.linalg.solve(self.covariance[at, at], self.means[at]))
            if special.chdtrc(2, chi2) < SHOWN_P:
                found.append(k)
        return found

    def not_identified(self) -> list[str]:
        """Return sentences on what these runs do not tell, and why."""
        told = [
            f"{name}.remount: {why}; it keeps its prior, a part of the stated limit that nobody knows"
            for name, why in self.not_told.items()
        ]
        told += [
            f"{size.name}: the runs leave it as the bench file states it; it keeps its prior"
            for size in self.sizes()
            if not size.told and size.name.endswith(".mean")
        ]
        if isinstance(self.meters, str):
            return [*told, *NEVER, *filter(None, [self.meters])]
        return [*told, *NEVER, *self.meters.not_told()]

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "runs": list(self.runs),
            "contradicting": [one.to_json() for one in self.contradicting],
            "sizes": {size.name: size.to_json() for size in self.sizes()},
            "means": {"order": list(self.names), "covariance_rad2": self.covariance.tolist()},
            "variances": {
                "order": [v.name for v in self.variances],
                "covariance": self.variances_covariance.tolist(),
            },
            "meters": None if isinstance(self.meters, str) else self.meters.to_json(),
            "not_identified": self.not_identified(),
        }


def _u(size: float, dof: float) -> float:
    """Return u of a standard deviation; with few degrees of freedom how far its upper end is."""
    if dof > FEW_DOF:
        return float(size / np.sqrt(2.0 * (dof - 2.0)))
    return float(size * (np.sqrt(1.0 + np.sqrt(2.0 / max(dof, 1e-30))) - 1.0))
