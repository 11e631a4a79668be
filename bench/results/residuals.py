"""The residuals of each reading as numbers, for plots and for JSON."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from pydantic import Field

from bench.base.result_model import Real, ResultModel
from bench.calibration import Calibration
from bench.diagnosis.show import ModelComparison
from bench.results.plots import mounts_of, sd_of_reading

DIGITS: Final = 6
"""Significant digits of a residual; its uncertainty is known to fewer."""


class ReadingPart(ResultModel):
    """A fitted reading: its place, direction, head angle and time, and its standard deviation by channel."""

    installation: str
    series: int
    pass_number: int = Field(alias="pass")
    point: int
    direction: int = Field(description="1 if the angle rose, -1 if it fell, 0 if unknown")
    angle_deg: float = Field(description="angle of the head, deg")
    time_s: Real = Field(description="time since the start of the run, s; null if unknown")
    u: list[Real] = Field(description="standard deviation of a single reading, by channel")


class ComparedReadingPart(ReadingPart):
    """A reading with its residuals, by channel, from each model of a diagnosis."""

    signal: list[float] = Field(description="measured signal")
    before: list[float] = Field(description="residual from the given model")
    after: list[float] | None = Field(description="residual with the effects found; null if none was found")
    simulated: list[float] = Field(description="residual of a simulated reading, including noise")


class ResidualsPart(ResultModel):
    """The residuals of the fitted readings."""

    unit: str = Field(description="unit of the signals")
    readings: list[ComparedReadingPart]


def fitted_readings(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the members of a `ReadingPart` for each fitted reading, in the order of the table."""
    fitted = calibration.fitted
    u = np.zeros((len(fitted), 3))
    for _, rows in mounts_of(calibration):
        u[rows] = sd_of_reading(calibration, rows, fitted.angle_rad[rows])
    columns = {
        "installation": fitted.installation.tolist(),
        "series": fitted.series.tolist(),
        "pass": fitted.pass_number.tolist(),
        "point": fitted.point.tolist(),
        "direction": fitted.direction.tolist(),
        "angle_deg": np.degrees(fitted.angle_rad).round(9).tolist(),
        "time_s": fitted.time_s.tolist(),
        "u": _rows(u),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def residuals_of(calibration: Calibration) -> list[list[float]]:
    """Return the residuals of the fitted readings, rounded: a list of three numbers for each reading."""
    return _rows(calibration.residuals)


def compared_residuals(shown: ModelComparison) -> ResidualsPart:
    """Return the residuals without and with the effects found, and those of one simulated run."""
    before = shown.before.calibration
    after = None if shown.after is None else residuals_of(shown.after.calibration)
    signal, given = _rows(before.fitted.signal, 9), residuals_of(before)
    simulated = residuals_of(shown.last.repeated)
    readings = [
        ComparedReadingPart(
            **reading,
            signal=signal[i],
            before=given[i],
            after=None if after is None else after[i],
            simulated=simulated[i],
        )
        for i, reading in enumerate(fitted_readings(before))
    ]
    return ResidualsPart(unit=before.unit, readings=readings)


def _rows(values: Any, digits: int = DIGITS) -> list[list[float]]:
    return [[float(f"{value:.{digits}g}") for value in row] for row in np.asarray(values).tolist()]
