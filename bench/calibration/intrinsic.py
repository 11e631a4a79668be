"""The nine numbers of a block that do not depend on how it is mounted, and joint coverage factors.

Three sensitivities, three angles between the sensing axes and three offsets are a function of K K^T and U0. If
the block is turned by a rotation R in all installations alike, K becomes K R, and these numbers do not change.
Source: the intrinsic properties of J. Res. NIST 122 (2017) 32 and 126 (2021) 038.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, u_of
from bench.base.languages import message
from bench.base.text import listed
from bench.calibration.budget.whole import dof_through
from bench.calibration.result import COVERAGE_FACTOR, Calibration, Derived, through
from bench.model.geometry import COEFFICIENTS, Block
from bench.readings.table import FREE, VERIFICATION

INTRINSIC: Final = ("Sx", "Sy", "Sz", "theta_xy", "theta_xz", "theta_yz", "bx", "by", "bz")
"""Names of the nine intrinsic numbers, in the order of every vector and table."""

PAIRS: Final = tuple(combinations(range(3), 2))
HELD: Final = 0.1
"""A number depends on limits if a change of K that no reading shows changes it by more than this fraction.

The change of K has the relative size 1.
"""
JOINT_LEVEL: Final = 0.95
JOINED: Final = {
    VERIFICATION: message("the joined verification points"),
    FREE: message("the free positions"),
}
"""Readings that join a fit by their modulus, in words, by their installation."""


def intrinsic_unit(name: str, unit: str) -> str:
    """Return the unit of one of the nine intrinsic numbers (`INTRINSIC`), for signals in `unit`."""
    return f"{unit}/g" if name.startswith("S") else "deg" if name.startswith("theta") else "g"


def intrinsic(block: Block, covariance: Floats) -> Derived:
    """Return the nine intrinsic numbers and their covariance (9, 9) for a block with `covariance` (12, 12).

    S_i = |row i of K| in unit/g, theta_ij = arccos(row_i row_j/(S_i S_j)) in degrees, b_i = U0_i/S_i in g. The
    Jacobian (9, 12) is exact. Raises `numpy.linalg.LinAlgError` if two sensing axes are parallel, or a channel has
    none.
    """
    S = np.linalg.norm(block.K, axis=1)
    if not np.all(S > 0):
        without = CHANNELS[int(np.argmin(S > 0))]
        raise np.linalg.LinAlgError(message(f"channel {without} has no sensitivity; check its readings"))
    axes, b = block.K / S[:, None], block.U0 / S
    values, rows = np.concatenate([S, np.zeros(3), b]), np.zeros((len(INTRINSIC), len(COEFFICIENTS)))
    for i in range(3):
        of_row = slice(3 * i, 3 * i + 3)
        rows[i, of_row] = axes[i]
        rows[6 + i, of_row], rows[6 + i, 9 + i] = -b[i] / S[i] * axes[i], 1.0 / S[i]
    for at, (i, j) in enumerate(PAIRS, 3):
        cosine, sine = float(axes[i] @ axes[j]), float(np.linalg.norm(np.cross(axes[i], axes[j])))
        if sine == 0.0:
            raise np.linalg.LinAlgError(
                message(
                    f"the sensing axes of channels {CHANNELS[i]} and {CHANNELS[j]} are parallel; check that each "
                    "voltmeter has its own accelerometer"
                )
            )
        values[at] = np.degrees(np.arctan2(sine, cosine))
        for one, other in ((i, j), (j, i)):
            slope = -(axes[other] - cosine * axes[one]) / (S[one] * sine)
            rows[at, 3 * one : 3 * one + 3] = np.degrees(slope)
    return Derived(INTRINSIC, values, through(rows, covariance), rows)


@dataclass(frozen=True, kw_only=True)
class Intrinsic(Derived):
    """The nine intrinsic numbers of a calibration.

    `covariance_readings` (9, 9) is the part of the covariance due to readings and stated stand errors; `dof`
    (9,) are the effective degrees of freedom. `held` names the numbers that these readings do not determine:
    limits of the bench file give their u. `mounting` is a sentence on which numbers the mounting can change.
    """

    covariance_readings: Floats
    dof: Floats
    unit: str
    held: tuple[str, ...]
    mounting: str

    @property
    def U(self) -> Floats:  # noqa: N802 - the symbol of the field
        """Expanded uncertainties k u (9,) with k = `COVERAGE_FACTOR`."""
        return COVERAGE_FACTOR * self.u

    @property
    def u_readings(self) -> Floats:
        """Standard uncertainties (9,) from these readings and the stated stand errors alone."""
        return u_of(self.covariance_readings)


def intrinsic_of(found: Calibration) -> Intrinsic | None:
    """Return the nine intrinsic numbers of a calibration; None if undefined, as with a dead channel."""
    try:
        own = intrinsic(found.block, found.covariance)
    except np.linalg.LinAlgError:
        return None
    held = _held(own, found.unseen())
    return Intrinsic(
        own.names, own.values, own.covariance, own.jacobian,
        covariance_readings=through(own.jacobian, found.covariance_readings),
        dof=dof_through(found, own.jacobian), unit=found.unit, held=held, mounting=_mounting(found, held),
    )  # fmt: skip


def least_dof(found: Calibration) -> float:
    """Return the smallest effective dof of the nine intrinsic numbers; infinity if these are undefined."""
    own = intrinsic_of(found)
    return float("inf") if own is None else float(np.min(own.dof))


def _held(own: Derived, unseen: Floats) -> tuple[str, ...]:
    """Return the names of the numbers that depend on limits in the bench file.

    `unseen` (12, d) are changes of K that no reading shows, of relative size 1.
    """
    change = own.jacobian @ unseen
    size = np.concatenate([own.values[:3], np.full(3, np.degrees(1.0)), np.ones(3)])
    moved = np.max(np.abs(change), axis=1, initial=0.0) > HELD * size
    return tuple(np.array(own.names)[moved].tolist())


def _mounting(found: Calibration, held: tuple[str, ...]) -> str:
    turned = message("a turn of the block common to all installations changes none of the nine")
    if found.triangular is not None:
        return message(f"{turned}; no stand enters free positions, which determine all nine and no more")
    if not held:
        return _determined_by(found, turned)
    return message(
        f"{turned}; turns of the installations against each other change {listed(held)}, which "
        f"{'stays' if len(held) == 1 else 'stay'} as uncertain as the bench file's limits: joined verification "
        f"points, free positions or a remount by 90° determine {'it' if len(held) == 1 else 'them'}"
    )


def _determined_by(found: Calibration, turned: str) -> str:
    """Return `turned`, and which readings were used: the installations, and those that joined by their modulus."""
    installations = list(dict.fromkeys(found.fitted.installation.tolist()))
    names = listed(installations)
    used = message(f"installation {names}") if len(installations) == 1 else message(f"installations {names}")
    joined = set() if found.free is None else set(found.free.installation.tolist())
    others = listed([name for label, name in JOINED.items() if label in joined])
    if others:
        return message(f"{turned}, and {used} with {others} determine all nine")
    return message(f"{turned}, and {used} determine all nine")


# --- joint statements -------------------------------------------------------------------------------


@dataclass(frozen=True)
class JointFactor:
    """The coverage factor `k` of an ellipsoid that contains `count` numbers jointly with probability `level`."""

    count: int
    k: float
    dof: float
    level: float = JOINT_LEVEL


def joint_factor(count: int, dof: float = np.inf, level: float = JOINT_LEVEL) -> JointFactor:
    """Return the joint coverage factor of `count` numbers: sqrt(p F(p, dof)) for p numbers.

    For infinite dof the factor is sqrt(chi2(p)): 4.585 for twelve and 4.113 for nine at 95 % (JCGM 102:2011,
    6.5.2). A dof below 1 counts as 1.
    """
    if np.isinf(dof):
        k = np.sqrt(special.chdtri(count, 1.0 - level))
    else:
        k = np.sqrt(count * special.fdtri(count, max(dof, 1.0), level))
    return JointFactor(count, float(k), dof, level)
