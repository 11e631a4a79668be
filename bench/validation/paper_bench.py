"""The paper's bench for tests: its coefficients (equation 11), its 54 readings, and an independent
simulation.

Nothing of `bench.model` is used here. The geometry turns the block's axes as vectors, with scipy's rotations,
and computes the upward component of each. An error in the application's geometry can therefore not cancel.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.readings.table import Readings, make_readings

ARCSEC = np.pi / 648000

# paper (11), V/g and V
K: NDArray[np.float64] = np.array(
    [[-2.177087, -0.018243, 0.025027], [0.026542, -2.139892, 0.032755], [0.006754, 0.006026, -2.144367]]
)
U0 = np.array([0.071469, -0.196485, -0.411789])
TRUTH = np.concatenate([K.ravel(), U0])

# the paper's limits of alpha1, alpha2, alpha3, taken as three standard deviations
STAND_U = {"axis_tilt": 5 / 3 * ARCSEC, "zero_offset": 5 / 3 * ARCSEC, "mounting_error": 30 * ARCSEC}
SETTING_U_RAD = 10 / 3 * ARCSEC


def design(passes: int = 3, points: int = 9) -> tuple[list[str], list[int], list[int], np.ndarray]:
    """Return the paper's order of readings: installation, pass, point and head angle (rad) of each."""
    rows = [(i, p, t) for i in "12" for p in range(1, passes + 1) for t in range(1, points + 1)]
    installation, pass_number, point = (list(column) for column in zip(*rows, strict=True))
    return installation, pass_number, point, np.radians(45.0) * (np.array(point) - 1)


def specific_force(
    installation: list[str],
    phi: np.ndarray,
    alpha1: np.ndarray | float = 0.0,
    alpha2: np.ndarray | float = 0.0,
    alpha3: np.ndarray | float = 0.0,
    alpha4: np.ndarray | float = 0.0,
    alpha5: np.ndarray | float = 0.0,
    psi: float = 0.0,
) -> np.ndarray:
    """Return the specific force (n, 3) on the block's axes in g: the upward component of each axis.

    The shaft is y. Angles are in rad, (n,) or one for all. A right-hand turn about y (the shaft) would carry
    x downwards; the head counts the other way.
    """

    def turn(axis: int, angle: np.ndarray | float) -> Rotation:
        vectors = np.zeros((len(phi), 3))
        vectors[:, axis] = angle
        return Rotation.from_rotvec(vectors)

    x, y, z = 0, 1, 2
    bracket = turn(x, alpha1) * turn(y, -(phi + alpha2 + alpha4)) * turn(z, alpha3) * turn(x, alpha5)
    up_x, up_y, up_z = (bracket * turn(z, psi)).as_matrix()[:, 2, :].T
    second = np.array(installation) == "2"
    return np.stack(
        [np.where(second, -up_x, up_x), np.where(second, up_z, up_y), np.where(second, up_y, up_z)], axis=1
    )


def simulate(
    rng: np.random.Generator | None,
    noise_v: float,
    *,
    passes: int = 3,
    stand_u: dict[str, float] | None = None,
    setting_u_rad: float = SETTING_U_RAD,
    K2: np.ndarray | float = 0.0,
    eccentricity_rad: tuple[float, float] = (0.0, 0.0),
) -> Readings:
    """Return one simulated run of the paper's procedure, in V.

    Stand errors of u `stand_u`, rad (default `STAND_U`), are drawn for each installation, setting error and
    noise for each reading. If `rng` is None, all are zero. `K2` (g/g^2) adds K_ii K2_i a_i^2 to channel i;
    `eccentricity_rad` (cosine, sine) adds e_c cos(phi) + e_s sin(phi) to the head's angle.
    """
    installation, pass_number, point, phi = design(passes)
    n = len(phi)
    errors = np.zeros((3, n))
    setting, noise = np.zeros(n), np.zeros((n, 3))
    if rng is not None:
        sizes = [
            (STAND_U if stand_u is None else stand_u)[name]
            for name in ("axis_tilt", "zero_offset", "mounting_error")
        ]
        drawn = rng.normal(0.0, sizes, (2, 3))
        errors = drawn[[int(i) - 1 for i in installation]].T
        setting = rng.normal(0.0, setting_u_rad, n)
        noise = rng.normal(0.0, noise_v, (n, 3))
    setting = setting + eccentricity_rad[0] * np.cos(phi) + eccentricity_rad[1] * np.sin(phi)
    force = specific_force(installation, phi, errors[0], errors[1], errors[2], setting)
    signal = force @ K.T + U0 + np.diag(K) * K2 * force**2 + noise
    return make_readings(installation, pass_number, point, phi, signal)
