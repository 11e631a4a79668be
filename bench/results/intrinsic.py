"""The nine numbers that do not depend on the mounting, and joint coverage factors: as JSON, text and pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from pydantic import Field
from rich.table import Table

from bench.base.arrays import Floats
from bench.base.languages import message
from bench.base.numbers import fixed, places, scale_for, uncertainty
from bench.base.result_model import Matrix, ResultModel
from bench.base.tables import table
from bench.calibration.intrinsic import (
    JOINT_LEVEL,
    Intrinsic,
    JointFactor,
    intrinsic_of,
    intrinsic_unit,
    joint_factor,
)
from bench.calibration.result import COVERAGE_FACTOR, Calibration
from bench.results.parts import CoefficientPart, CovarianceOfReadings, by_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POINTS: Final = 90


class IntrinsicValuePart(CoefficientPart):
    """One of the nine numbers; `u` is the combined standard uncertainty."""

    unit: str = Field(description="unit of the signal per g, deg, or g")


class IntrinsicPart(ResultModel):
    """The nine numbers that do not depend on the mounting: sensitivities, angles between the sensing axes, offsets.

    S_i = ‖row i of K‖, cos θ_ij = row_i·row_j/(S_i S_j), b_i = U0_i/S_i.
    """

    values: dict[str, IntrinsicValuePart]
    """`Sx`, `Sy`, `Sz`, `theta_xy`, `theta_xz`, `theta_yz`, `bx`, `by`, `bz`"""
    order: list[str] = Field(description="names of the nine in the order of `covariance`")
    covariance: Matrix = Field(description="combined covariance, 9 × 9, in the units of the values")
    covariance_readings: CovarianceOfReadings
    held_by_limits: list[str]
    """numbers that follow from the limits of the bench file because these readings do not determine them"""
    mounting: str = Field(description="what the mounting can change, a sentence")


class JointPart(ResultModel):
    """The joint coverage factor k: an ellipsoid of half-widths k u holds all true values jointly (95 %)."""

    count: int = Field(description="number of values with an uncertainty")
    k: float = Field(description="joint coverage factor: √(p F(p, dof)), or √χ²(p) for infinite dof")
    dof: float | None = Field(description="smallest effective degrees of freedom; null: infinite")
    level: float = Field(description="coverage probability")


def intrinsic_part(own: Intrinsic) -> IntrinsicPart:
    """Return the nine intrinsic numbers as the part `intrinsic` of the result."""
    units = [intrinsic_unit(name, own.unit) for name in own.names]
    values = by_name(own.names, IntrinsicValuePart, own, value=own.values, k=COVERAGE_FACTOR, unit=units)
    return IntrinsicPart.from_object(own, values=values, order=own.names, held_by_limits=own.held)


def joint_part(u: Floats, dof: Floats) -> JointPart:
    """Return the part on the joint coverage factor that `joint_of` returns."""
    found = joint_of(u, dof)
    return JointPart.from_object(found, dof=found.dof if np.isfinite(found.dof) else None)


def joint_of(u: Floats, dof: Floats, level: float = JOINT_LEVEL) -> JointFactor:
    """Return the joint coverage factor of numbers with `u` (m,) above 0, for their smallest `dof` (m,)."""
    known = u > 0
    return joint_factor(int(np.sum(known)), float(np.min(dof[known], initial=np.inf)), level)


def joint_members(found: Calibration) -> dict[str, Any]:
    """Return the members `intrinsic` and `joint` of the result of a calibration."""
    own = intrinsic_of(found)
    joint = {"twelve": joint_part(found.u, found.dof)}
    if own is None:
        return {"intrinsic": None, "joint": joint}
    return {"intrinsic": intrinsic_part(own), "joint": {**joint, "nine": joint_part(own.u, own.dof)}}


# --- as text and pictures -----------------------------------------------------------------------------


def shown_rows(own: Intrinsic) -> list[list[str]]:
    """Return the cells for each number: name, value, unit of value, u from the readings, u, U, unit of these u."""
    rows = []
    for name, value, *sizes in zip(own.names, own.values, own.u_readings, own.u, own.U, strict=True):
        unit = intrinsic_unit(name, own.unit)
        factor, small = small_unit(name, float(sizes[1]), own.unit)
        of_value = [name, fixed(float(value), places(float(sizes[1]))), "°" if unit == "deg" else unit]
        rows.append([*of_value, *(uncertainty(float(size) / factor) for size in sizes), small])
    return rows


def small_unit(name: str, u: float, unit: str) -> tuple[float, str]:
    """Return the printed unit for differences of about `u` in the number `name`: its size and its symbol.

    The size is in `unit`/g for a sensitivity, in degrees for an angle, in g for an offset.
    """
    if name.startswith("theta"):
        return 1.0 / 3600.0, "″"
    scale = scale_for(u, unit if name.startswith("S") else "g")
    return scale.size, scale.per_g if name.startswith("S") else scale.unit


def intrinsic_table(own: Intrinsic) -> Table:
    """Return a table of the nine intrinsic numbers with u, U (k = 2) and the u from the readings alone."""
    shown = table("mounting-free", ">value", "", ">u", ">U (k=2)", ">u, readings", "")
    for name, value, unit, of_readings, u, U, small in shown_rows(own):
        shown.add_row(name, value, unit, u, U, of_readings, small)
    return shown


def joint_in_words(found: Calibration, own: Intrinsic | None) -> str:
    """Return the joint coverage factors in a sentence."""
    sizes = [(found.u, found.dof), *([] if own is None else [(own.u, own.dof)])]
    said = [
        message(f"k = {joint.k:.3f} for all {joint.count}")
        for joint in (joint_of(u, dof) for u, dof in sizes)
    ]
    return message(f"jointly at 95 %: {', '.join(dict.fromkeys(said))} (ellipsoid)")


def ellipses(own: Intrinsic) -> str:
    """Return plots of the joint 95 % ellipsoid of the nine numbers, projected on pairs; dashed: their U (k = 2)."""
    from bench.results.plots import BLUE, GREY, svg_figure, symbol

    joint, turn = joint_of(own.u, own.dof), np.linspace(0.0, 2.0 * np.pi, _POINTS)
    circle = np.stack([np.cos(turn), np.sin(turn)])

    def draw(figure: Figure) -> None:
        grid = figure.subplots(3, 3)
        for row, first in enumerate((0, 3, 6)):
            for column, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
                pair = [first + i, first + j]
                scales = [small_unit(own.names[at], float(own.u[at]), own.unit) for at in pair]
                size = np.array([scale for scale, _ in scales])
                root = np.linalg.cholesky(own.covariance[np.ix_(pair, pair)]) / size[:, None]
                outline, U = joint.k * root @ circle, own.U[pair] / size
                axes = grid[row, column]
                axes.plot(outline[0], outline[1], color=BLUE)
                axes.plot(
                    U[0] * np.array([-1, 1, 1, -1, -1]), U[1] * np.array([-1, -1, 1, 1, -1]),
                    color=GREY, linestyle="--", linewidth=0.8,
                )  # fmt: skip
                axes.set_xlabel(f"{symbol(own.names[pair[0]])} / {scales[0][1]}")
                axes.set_ylabel(f"{symbol(own.names[pair[1]])} / {scales[1][1]}")

    return svg_figure(
        "ellipses", (7.4, 6.4), draw, message("The joint 95 % ellipsoid of the nine, as shadows on pairs")
    )
