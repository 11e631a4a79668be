"""What a calibration returns: coefficients with their covariance, and everything needed to judge them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.model.block import COEFFICIENTS, Block
from bench.readings import Readings

Floats = NDArray[np.float64]

ARCSEC = np.pi / 648000


HARDLY_BETTER = 0.95
"""An uncertainty that is left to such a part of what it was before has learnt nothing worth the name."""


class CalibrationError(ValueError):
    """The readings cannot give what was asked of them; the text says why and what would."""


@dataclass(frozen=True)
class Estimate:
    """A value with its standard uncertainty, both in `unit`; `prior_u` is what was known before the data."""

    value: float
    u: float
    unit: str
    prior_u: float = float("inf")

    @property
    def told_by_data(self) -> bool:
        """Whether the data made it any better known than it was before."""
        return self.u < HARDLY_BETTER * self.prior_u

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        return {"value": self.value, "u": self.u, "unit": self.unit, "told_by_data": self.told_by_data}


@dataclass(frozen=True)
class Noise:
    """Sizes of what is fresh at each reading, 1 sigma.

    `reading` (unit of the signal) is fresh in each channel of each reading, `setting_rad` in each setting
    of the head and common to its three channels. `dof` are the degrees of freedom of the estimate (counted
    in single signals), infinite when given. `source` says where the sizes come from. `setting_limits_rad` are
    the values between which the setting error lies with about 95 %: repeats often tell little of it.
    """

    reading: float
    setting_rad: float
    dof: float
    source: str
    setting_limits_rad: tuple[float, float] | None = None

    def widened(self) -> Noise:
        """Return the sizes as they enter an uncertainty: larger where they are estimates themselves.

        An estimate s with nu degrees of freedom stands for a scaled t distribution, whose standard deviation
        is s sqrt(nu/(nu - 2)) (JCGM 101:2008, 6.4.9.4). Two of three signals tell of the reading noise, the
        third mostly of the setting error.
        """
        if np.isinf(self.dof):
            return self
        nu = max(2 * self.dof / 3, 4.0)
        factor = float(np.sqrt(nu / (nu - 2)))
        return replace(self, reading=factor * self.reading, setting_rad=factor * self.setting_rad)


@dataclass(frozen=True)
class LackOfFit:
    """Residuals of the fit: their root mean square, and the part that repeats cannot explain.

    `chi2` with `dof` is what the model leaves beyond the scatter of repeats, in units of that scatter; `p`
    the probability of more (F test against the scatter). NaN where there are not enough repeats. Where the
    noise was given, all that is left is compared with it. The closed form has `chi2` and `p` of the least
    squares on the same readings: they judge the model, not the estimator.
    """

    rms: float
    chi2: float
    dof: int
    p: float


@dataclass(frozen=True)
class Calibration:
    """The twelve coefficients and what belongs to them.

    `covariance` (12, 12) in the order of `COEFFICIENTS`; K in unit/g with g = `g_m_s2`, biases in unit.
    `stand` holds what the data tell of the stand ("alpha1[1]"), `effects` the fitted parameters of effects.
    `fitted` are the readings used, `residuals` (n, 3) measured minus fitted with the stand's angles and the
    effects at their estimates. `assumed` lists sentences on what these data cannot show.
    """

    estimator: str
    unit: str
    g_m_s2: float
    block: Block
    covariance: Floats
    noise: Noise
    lack_of_fit: LackOfFit
    fitted: Readings
    residuals: Floats
    skipped: int
    model: str
    stand: Mapping[str, Estimate] = field(default_factory=dict)
    effects: Mapping[str, Estimate] = field(default_factory=dict)
    assumed: tuple[str, ...] = ()

    @property
    def u(self) -> Floats:
        """Standard uncertainties of the twelve coefficients, shape (12,)."""
        root: Floats = np.sqrt(np.diag(self.covariance))
        return root

    def to_json(self) -> dict[str, Any]:
        """Return the promised result (standard uncertainties; NaN becomes null)."""
        fit = self.lack_of_fit
        return {
            "estimator": self.estimator,
            "unit": self.unit,
            "g_m_s2": self.g_m_s2,
            "coefficients": {
                name: {"value": float(value), "u": float(u)}
                for name, value, u in zip(COEFFICIENTS, self.block.vector, self.u, strict=True)
            },
            "order": list(COEFFICIENTS),
            "covariance": self.covariance.tolist(),
            "stand": {name: estimate.to_json() for name, estimate in self.stand.items()},
            "effects": {name: estimate.to_json() for name, estimate in self.effects.items()},
            "not_observable": list(self.assumed),
            "residual": {
                "rms": fit.rms,
                "chi2": _number(fit.chi2),
                "dof": fit.dof,
                "p": _number(fit.p),
            },
            "noise": {
                "reading_v": self.noise.reading,
                "setting_arcsec": self.noise.setting_rad / ARCSEC,
                "setting_limits_arcsec": self._setting_limits_arcsec(),
                "dof": _number(self.noise.dof),
                "source": self.noise.source,
            },
            "readings": {"used": len(self.fitted), "skipped": self.skipped},
            "model": self.model,
        }

    def _setting_limits_arcsec(self) -> list[float | None] | None:
        limits = self.noise.setting_limits_rad
        return None if limits is None else [_number(limit / ARCSEC) for limit in limits]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
