"""The twelve coefficients as functions of temperature, with their covariance, and what they make of signals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.base.arrays import Floats, HasCovariance, Ints, Mask, u_of
from bench.base.numbers import finite_or_none
from bench.calibration.result import CalibrationError, LackOfFit, Noise
from bench.model.geometry import COEFFICIENTS, Block


@dataclass(frozen=True)
class PlateauResult:
    """A plateau by itself: its temperature, the side it was reached from (+1, -1, 0), its coefficients.

    `value`, `u` (12,) are None where its readings alone do not determine all twelve.
    """

    temperature_c: float
    branch: int
    readings: int
    value: Floats | None
    u: Floats | None


@dataclass(frozen=True)
class ThermalHysteresis(HasCovariance):
    """Rising minus falling at the same temperature, `size` (12,) with `covariance` (12, 12).

    One size for all temperatures reached from both sides. `p` is that of all twelve together (chi-square),
    `p_each` (12,) those of single coefficients, times twelve for the looks taken (Bonferroni).
    """

    size: Floats
    covariance: Floats
    p: float
    p_each: Floats

    @property
    def scatter(self) -> Floats:
        """Covariance (12, 12) of the coefficients for one who does not know the side.

        Half the size either way; shrunk by what the noise alone makes of it (its chi-square is twelve).
        """
        chi2 = float(self.size @ np.linalg.solve(self.covariance, self.size))
        real = max(1.0 - len(self.size) / chi2, 0.0) if chi2 > 0 else 0.0
        return np.asarray(real * np.outer(self.size, self.size) / 4.0, dtype=np.float64)


@dataclass(frozen=True)
class Compensated:
    """Specific forces (n, 3) in local g, their covariance (n, 3, 3) from the model and the thermometer."""

    specific_force: Floats
    covariance: Floats

    @property
    def u(self) -> Floats:
        """Standard uncertainties, g, shape (n, 3)."""
        return np.asarray(np.sqrt(np.einsum("nii->ni", self.covariance)))


@dataclass(frozen=True)
class TemperatureModel:
    """Coefficient j at temperature T is the sum over d of `values[j, d]` (T - `reference_c`)^d.

    `values` (12, D + 1) in unit/g/K^d and unit/K^d, zero above `degrees` (12,); `covariance`
    (12 (D + 1), 12 (D + 1)) of `values` row after row: a term that was left out has a part in it, the doubt about
    leaving it out. Valid from `minimum_c` to `maximum_c`. `fitted` tells the fit from the noise,
    `curve` the polynomials from coefficients free at each plateau (None where plateaus alone do not
    determine them).
    """

    unit: str
    g_m_s2: float
    reference_c: float
    minimum_c: float
    maximum_c: float
    degrees: Ints
    values: Floats
    covariance: Floats
    hysteresis: ThermalHysteresis | None
    plateaus: tuple[PlateauResult, ...]
    noise: Noise
    fitted: LackOfFit
    curve: LackOfFit | None
    readings: int
    skipped: int
    notes: tuple[str, ...] = ()

    def powers(self, temperature_c: float | Floats) -> Floats:
        """Return (T - reference)^d for d = 0…D, shape (…, D + 1)."""
        offset = np.asarray(temperature_c, dtype=np.float64) - self.reference_c
        return np.asarray(offset[..., None] ** np.arange(self.values.shape[1]), dtype=np.float64)

    def coefficients(self, temperature_c: float | Floats) -> Floats:
        """Return the coefficients at temperatures (…), shape (…, 12), in the order of `COEFFICIENTS`."""
        return self.powers(temperature_c) @ self.values.T

    def block(self, temperature_c: float) -> Block:
        """Return the block at a temperature."""
        return Block.from_vector(self.coefficients(temperature_c))

    def covariance_at(self, temperature_c: float) -> Floats:
        """Return the covariance (12, 12) of the coefficients at a temperature, hysteresis included."""
        spread = np.kron(np.eye(len(COEFFICIENTS)), self.powers(temperature_c))
        covariance: Floats = spread @ self.covariance @ spread.T
        return covariance if self.hysteresis is None else covariance + self.hysteresis.scatter

    def outside(self, temperature_c: float | Floats) -> Mask:
        """Whether temperatures lie outside the valid range: no reading stands behind the polynomial there."""
        t = np.asarray(temperature_c, dtype=np.float64)
        return ~((t >= self.minimum_c) & (t <= self.maximum_c))

    def compensate(
        self, signal: Floats, temperature_c: float | Floats, u_temperature_k: float = 0.0
    ) -> Compensated:
        """Return the specific forces for signals (n, 3) measured at temperatures (n,) or one for all.

        The covariance is that of the coefficients, of hysteresis, and of a thermometer whose error against that of
        the calibration is `u_temperature_k` (K, 1 sigma); noise of the signals themselves is the reader's to
        add. Raises `CalibrationError` for a temperature outside the valid range.
        """
        rows = np.asarray(signal, dtype=np.float64).reshape(-1, 3)
        temperature = np.broadcast_to(np.asarray(temperature_c, dtype=np.float64), (len(rows),))
        if np.any(self.outside(temperature)):
            worst = temperature[self.outside(temperature)][0]
            raise CalibrationError(
                f"{worst:g} °C is outside the range of the temperature model, {self.minimum_c:.1f} to "
                f"{self.maximum_c:.1f} °C; measure there, polynomials are not to be extended"
            )
        force = np.empty_like(rows)
        covariance = np.empty((len(rows), 3, 3))
        slope = self._slope(temperature)
        for i, t in enumerate(temperature):
            block = self.block(float(t))
            inverse = np.linalg.inv(block.K)
            force[i] = inverse @ (rows[i] - block.U0)
            # da = -K^-1 (dK a + dU0), dK, dU0 in the order of the coefficients
            by_output = np.hstack([np.kron(np.eye(3), force[i]), np.eye(3)])
            by_coefficient = -inverse @ by_output
            by_kelvin = by_coefficient @ slope[i] * u_temperature_k
            covariance[i] = by_coefficient @ self.covariance_at(float(t)) @ by_coefficient.T
            covariance[i] += np.outer(by_kelvin, by_kelvin)
        return Compensated(force, covariance)

    def _slope(self, temperature_c: Floats) -> Floats:
        """Return the derivatives of the coefficients by temperature, shape (n, 12), per K."""
        powers = np.arange(1, self.values.shape[1])
        below = self.powers(temperature_c)[:, :-1] * powers
        return np.asarray(below @ self.values[:, 1:].T, dtype=np.float64)

    def to_json(self) -> dict[str, Any]:
        """Return the result; NaN becomes null."""
        u = u_of(self.covariance).reshape(self.values.shape)
        count = self.values.shape[1]
        return {
            "unit": self.unit,
            "g_m_s2": self.g_m_s2,
            "reference_c": self.reference_c,
            "valid_c": [self.minimum_c, self.maximum_c],
            "coefficients": {
                name: {
                    "degree": int(self.degrees[j]),
                    "terms": [{"power": d, "value": self.values[j, d], "u": u[j, d]} for d in range(count)],
                }
                for j, name in enumerate(COEFFICIENTS)
            },
            "order": [[name, d] for name in COEFFICIENTS for d in range(count)],
            "covariance": self.covariance.tolist(),
            "hysteresis": self.hysteresis and _hysteresis_json(self.hysteresis),
            "plateaus": [_plateau_json(plateau) for plateau in self.plateaus],
            "noise": {"reading": self.noise.reading, "setting_rad": self.noise.setting_rad},
            "lack_of_fit": _fit_json(self.fitted),
            "curve": self.curve and _fit_json(self.curve),
            "readings": {"used": self.readings, "skipped": self.skipped},
            "notes": list(self.notes),
        }


def _hysteresis_json(hysteresis: ThermalHysteresis) -> dict[str, Any]:
    rows = zip(COEFFICIENTS, hysteresis.size, hysteresis.u, hysteresis.p_each, strict=True)
    return {
        "rising_minus_falling": {
            name: {"value": float(size), "u": float(u), "p_all_looks": float(p)} for name, size, u, p in rows
        },
        "p": hysteresis.p,
    }


def _plateau_json(plateau: PlateauResult) -> dict[str, Any]:
    return {
        "temperature_c": plateau.temperature_c,
        "branch": plateau.branch,
        "readings": plateau.readings,
        "coefficients": None
        if plateau.value is None or plateau.u is None
        else {
            name: {"value": float(value), "u": float(u)}
            for name, value, u in zip(COEFFICIENTS, plateau.value, plateau.u, strict=True)
        },
    }


def _fit_json(fit: LackOfFit) -> dict[str, float | None]:
    return {name: finite_or_none(getattr(fit, name)) for name in ("rms", "chi2", "dof", "p")}
