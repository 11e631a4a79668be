"""What a calibration returns: coefficients with their covariance, and everything needed to judge them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from bench.base.arrays import ARCSEC, Floats, HasCovariance, rms
from bench.base.numbers import finite_or_none
from bench.model.block import COEFFICIENTS, Block
from bench.readings.table import Readings

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

    @property
    def reading_dof(self) -> float:
        """Degrees of freedom of the reading noise: two of three signals tell of it, the third of the setting.

        Where no setting is known, as for free positions, all of them do.
        """
        return 2 * self.dof / 3 if self.setting_rad > 0 else self.dof

    def widened(self) -> Noise:
        """Return the sizes as they enter an uncertainty: larger where they are estimates themselves.

        An estimate s with nu degrees of freedom stands for a scaled t distribution, whose standard deviation
        is s sqrt(nu/(nu - 2)) (JCGM 101:2008, 6.4.9.4).
        """
        if np.isinf(self.dof):
            return self
        nu = max(self.reading_dof, 4.0)
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
class Outlier:
    """A signal that the model and the other readings contradict; it keeps its place in the record.

    `row` counts the rows of the table from 1; `channel` is x, y, z, "head" for a setting that was off by
    `size`, or "modulus" for a free position. `sigma` is the size over its standard uncertainty, `weight` what
    is left of the signal's weight in the fit.
    """

    row: int
    series: int
    installation: str
    pass_number: int
    point: int
    channel: str
    size: float
    unit: str
    sigma: float
    weight: float = 0.0

    def text(self) -> str:
        """Say it in words."""
        visit = "" if self.series == 1 else f"series {self.series}, "
        size = f"{self.size:+.3g} {self.unit}"
        return (
            f"row {self.row} ({visit}installation {self.installation}, pass {self.pass_number}, point "
            f"{self.point}), {self.channel}: off by {size}, {abs(self.sigma):.3g} sigma"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        result = asdict(self)
        result["pass"] = result.pop("pass_number")
        return result


@dataclass(frozen=True)
class Triangular:
    """The nine numbers of a = T S (U - b), a in m/s^2, with standard uncertainties.

    `T` (3, 3) is unit upper triangular, `scale` (3,) the diagonal of S in m/s^2 per unit, `bias` (3,) in the
    unit of the signal.
    """

    bias: Floats
    scale: Floats
    T: Floats
    u_bias: Floats
    u_scale: Floats
    u_skew: Floats

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "convention": "a = T S (u - b) in m/s^2, T unit upper triangular, S diagonal and positive",
            "bias": {"value": self.bias.tolist(), "u": self.u_bias.tolist()},
            "scale_ms2_per_unit": {"value": self.scale.tolist(), "u": self.u_scale.tolist()},
            "T": {"value": self.T.tolist(), "u": self.u_skew.tolist()},
        }


def values_with_u(values: Floats, u: Floats) -> dict[str, dict[str, float]]:
    """Return the first of the twelve coefficients (m,) by name, each with its standard uncertainty."""
    rows = zip(COEFFICIENTS, values.tolist(), u.tolist(), strict=False)
    return {name: {"value": value, "u": u} for name, value, u in rows}


@dataclass(frozen=True)
class Calibration(HasCovariance):
    """The twelve coefficients and what belongs to them.

    `covariance` (12, 12) in the order of `COEFFICIENTS`; K in unit/g with g = `g_m_s2`, biases in unit.
    `stand` holds what the data tell of the stand ("alpha1[1]"), `effects` the fitted parameters of effects.
    `fitted` are the readings used, `residuals` (n, 3) measured minus fitted with the stand's angles and the
    effects at their estimates. `free` are the readings that joined by their modulus, `modulus_error` (m,)
    |a| - 1 of each in g. `outliers` have no weight in the estimate; `notes` says what a reader should know.
    `triangular` is there for free positions alone. `assume` gives the sentences of `assumed`.
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
    assume: Callable[[], tuple[str, ...]] = tuple
    free: Readings | None = None
    modulus_error: Floats = field(default_factory=lambda: np.zeros(0))
    outliers: tuple[Outlier, ...] = ()
    notes: tuple[str, ...] = ()
    triangular: Triangular | None = None
    angles: str = "read back"

    @cached_property
    def assumed(self) -> tuple[str, ...]:
        """Sentences on what these data cannot show, and what it costs; worked out when first asked for."""
        return self.assume()

    @property
    def used(self) -> int:
        """Readings in the fit, oriented and free."""
        return len(self.fitted) + len(self.modulus_error)

    @property
    def modulus_rms_g(self) -> float:
        """Root mean square of |a| - 1 over the free readings that are no outliers, g; NaN where there are none."""
        if self.free is None:
            return float("nan")
        out = {(o.series, o.installation, o.pass_number, o.point) for o in self.outliers}
        of = self.free
        columns = (of.series, of.installation, of.pass_number, of.point)
        places = zip(*(column.tolist() for column in columns), strict=True)
        kept = np.array([place not in out for place in places])
        return rms(self.modulus_error[kept])

    def to_json(self) -> dict[str, Any]:
        """Return the promised result (standard uncertainties; NaN becomes null)."""
        fit = self.lack_of_fit
        return {
            "estimator": self.estimator,
            "unit": self.unit,
            "g_m_s2": self.g_m_s2,
            "per": "g",
            "coefficients": values_with_u(self.block.vector, self.u),
            "coefficients_per_ms2": self._per_ms2(),
            "order": list(COEFFICIENTS),
            "covariance": self.covariance.tolist(),
            "stand": {name: estimate.to_json() for name, estimate in self.stand.items()},
            "effects": {name: estimate.to_json() for name, estimate in self.effects.items()},
            "not_observable": list(self.assumed),
            "residual": {
                **{name: finite_or_none(number) for name, number in asdict(fit).items()},
                "dof": fit.dof,
            },
            "noise": {
                "reading_v": self.noise.reading,
                "setting_arcsec": self.noise.setting_rad / ARCSEC,
                "setting_limits_arcsec": self._setting_limits_arcsec(),
                "dof": finite_or_none(self.noise.dof),
                "source": self.noise.source,
            },
            "readings": {"used": self.used, "skipped": self.skipped},
            "model": self.model,
            "angles": self.angles,
            "outliers": [outlier.to_json() for outlier in self.outliers],
            "free_positions": self._free_json(),
            "triangular": None if self.triangular is None else self.triangular.to_json(),
        }

    def _per_ms2(self) -> dict[str, Any]:
        """K in unit/(m/s^2), from K per g by the g that is stated, whose own uncertainty is not in u."""
        scale = values_with_u(self.block.vector[:9] / self.g_m_s2, self.u[:9] / self.g_m_s2)
        return {"unit": f"{self.unit}/(m/s^2)", **scale}

    def _free_json(self) -> dict[str, Any] | None:
        if self.free is None:
            return None
        rows = zip(self.free.installation, self.free.pass_number, self.free.point, strict=True)
        return {
            "used": len(self.free),
            "rms_g": rms(self.modulus_error),
            "rms_g_without_outliers": self.modulus_rms_g,
            "rows": [
                {"installation": str(i), "pass": int(p), "point": int(t), "delta_g": float(e)}
                for (i, p, t), e in zip(rows, self.modulus_error, strict=True)
            ],
        }

    def _setting_limits_arcsec(self) -> list[float | None] | None:
        limits = self.noise.setting_limits_rad
        return None if limits is None else [finite_or_none(limit / ARCSEC) for limit in limits]
