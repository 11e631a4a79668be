"""The paper's bench as a `Setup`: its block (equation 11), 54 readings, 4 verification points turned by psi
about z.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from bench.calibration.budget.coefficients import Setup
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.budget.sources import stand_source
from bench.model import AppliedEffect, Block, Conditions, Distribution, ForwardModel, Installation
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.validation.paper_bench import ARCSEC, U0, K, design

ONE_SIGMA = {
    "axis_tilt": 5 * ARCSEC,
    "zero_offset": 5 * ARCSEC,
    "mounting_error": 90 * ARCSEC,
    "setting_error": 10 * ARCSEC,
    "voltmeter_error": 3e-4,
}
"""The paper's limits, all taken as one standard deviation."""

COEFFICIENTS = [f"K{i}{j}" for i in "xyz" for j in "xyz"] + ["U0x", "U0y", "U0z"]


def paper_setup(
    *,
    passes: int = 3,
    points: int = 9,
    psi_deg: float = 45.0,
    effects: Sequence[AppliedEffect] = (),
    meters: tuple[int, int, int] = (0, 1, 2),
) -> Setup:
    installation, pass_number, point, phi = design(passes, points)
    turned = Installation.from_axes("V", ("x", "y", "z"), np.radians(psi_deg), "z")
    model = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2, "V": turned}, tuple(effects))
    conditions = Conditions.of(
        [*installation, *"VVVV"],
        np.concatenate([phi, np.radians([45.0, 135.0, 225.0, 315.0])]),
        pass_number=[*pass_number, 1, 1, 1, 1],
        point=[*point, 1, 2, 3, 4],
    )
    return Setup(model, conditions, Block(K, U0), meters)


def stand(
    sizes: Mapping[str, float] | None = None, dof: Mapping[str, float] | None = None
) -> list[ErrorSource]:
    """Return normal error sources of the stand with these standard uncertainties and degrees of freedom."""
    sizes = ONE_SIGMA if sizes is None else sizes
    return [stand_source(n, Distribution(u), (dof or {}).get(n, np.inf)) for n, u in sizes.items()]
