"""Three descriptions of readings, each with more unknowns than the last, and the test of readings against one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import Floats, Ints
from bench.calibration.design import FIXED, Problem
from bench.calibration.noise import LEAST_REPEATS, repeat_groups, whiten
from bench.calibration.result import Noise
from bench.model import CATALOGUE, STAND_ANGLES, AppliedEffect, Block, Conditions

WIDE_G: Final = 5e-3
"""Prior 1 sigma of a free value of a point, or of a slow change, in g: larger than any effect."""
WIDE_RAD: Final = np.radians(0.1)
"""Prior 1 sigma of a rotation of the block about any axis in each pass, rad."""
COEFFICIENTS_WIDE: Final = 10.0
"""Prior 1 sigma of the coefficients about the first guess, in scale factors: so wide that it has no effect."""
FIRST: Final = 3
"""Number of readings after a remount that hysteresis may shift, because the block came from another orientation."""
FIRST_G: Final = 1e-4
"""Prior 1 sigma of this shift, g."""
HYSTERESIS: Final = CATALOGUE["hysteresis"]
"""The effect that makes first readings differ from their repeats although there is no mistake."""
WIDTHS_G: Final = next(p.grid for p in HYSTERESIS.parameters if p.name == "width_g")
"""Widths of the play that are tried for hysteresis, g."""
RELAXATION_S: Final = (480.0, 960.0, 1920.0, 3840.0)
"""Time constants of slow changes, s."""

NEAR_DEG: Final = 3.0
"""Largest difference, in degrees, between the angles of repeats."""
CANDIDATE: Final = 21.1
"""Chi-square of a reading's three signals (p = 1e-4) above which it is left out as a possible mistake."""
ROUNDS: Final = 3
"""Number of iterations that make noise and weights consistent."""
MEDIANS: Final = (0.4549, 1.3863 / 2)
"""Medians of chi-square with one and with two degrees of freedom, each divided by its degrees of freedom."""
SEEN: Final = 0.05
"""A reading contributes to the noise estimate if the fit leaves at least this fraction of its variance."""


@dataclass(frozen=True)
class Description:
    """A model of the readings without noise: `columns` (n, 3, p), signals per unit of unknowns with priors N(0, 1).

    `stand` (n, 3, q) are the columns of the stand's errors, scaled in the same way.
    """

    columns: Floats
    stand: Floats


@dataclass(frozen=True)
class Situation:
    """Readings minus the model's prediction, `left` (n, 3), with du/dphi `slope` (n, 3) per rad.

    `floor` is the least noise. All are in the unit of the signal.
    """

    left: Floats
    slope: Floats
    floor: float

    @property
    def unit(self) -> Floats:
        """Unit vectors along du/dphi, (n, 3)."""
        length = np.linalg.norm(self.slope, axis=1, keepdims=True)
        return np.asarray(self.slope / np.where(length > 0, length, 1.0))


def situation(problem: Problem, block: Block, signal: Floats, floor: float) -> Situation:
    """Return readings `signal` (n, 3) minus the prediction for a first guess of the block."""
    linear = problem.linear(block, problem.prior_mean)
    return Situation(signal - linear.predicted, linear.slope, floor)


def _points(conditions: Conditions) -> Ints:
    """Return the number of each reading's point (n,): one for each mounting and angle, rounded to 1 degree.

    A reading within `NEAR_DEG` of the median angle of its repeats belongs to their point, so that a wrong
    setting stays with its repeats.
    """
    angle = np.degrees(conditions.angle_rad)
    repeats = repeat_groups(conditions)
    usual = np.array([np.median(angle[repeats == group]) for group in range(repeats.max() + 1)])[repeats]
    near = np.where(np.abs(angle - usual) < NEAR_DEG, usual, angle)
    key = np.stack([conditions.mount, np.round(near).astype(np.int64)], axis=1)
    _, groups = np.unique(key, axis=0, return_inverse=True)
    return groups.ravel()


@dataclass(frozen=True)
class Descriptions:
    """The descriptions of the readings of a `problem`, linearised about a `block`.

    `ladder` has three, from the fewest unknowns to the most: the model with its stand errors; with a free value
    for each point; with slow changes, too. If points are hardly repeated, it has two: the model, and the model
    with slow changes. `drifting` is the model with slow changes. `beginning` is the last of the ladder with
    free shifts of the first readings of each mounting. `model` are the column arrays of the first of the
    ladder.
    """

    ladder: tuple[Description, ...]
    drifting: Description
    beginning: Description
    model: Sequence[Floats]
    problem: Problem
    block: Block

    @cached_property
    def hysteretic(self) -> tuple[Description, ...]:
        """The first of the ladder with hysteresis in every channel: a description for each width in `WIDTHS_G`.

        One description with all widths would be wrong: differences between widths shift a first reading alone,
        which friction cannot do.
        """
        return tuple(
            Description(np.concatenate([*self.model, columns], axis=2), self.drifting.stand)
            for columns in _hysteresis(self.problem, self.block)
        )


def descriptions(problem: Problem, block: Block) -> Descriptions:
    """Return the descriptions of a problem's readings, linearised about a first guess of the block."""
    groups = _points(problem.conditions)
    linear = problem.linear(block, problem.prior_mean)
    scale = np.linalg.norm(block.K, axis=1)
    stand = linear.jacobian[:, :, FIXED:] * problem.prior_u
    model = [linear.jacobian[:, :, :FIXED] * (COEFFICIENTS_WIDE * scale.max()), stand]
    slow = _slow(problem.conditions, linear.predicted - block.U0, block, scale)
    first = _per_channel(_first(problem.conditions), FIRST_G * scale)

    def described(*columns: Floats) -> Description:
        return Description(np.concatenate(columns, axis=2), stand)

    drifting = described(*model, *slow)
    if len(groups) - len(np.unique(groups)) < LEAST_REPEATS:
        return Descriptions(
            (described(*model), drifting), drifting, described(*model, *slow, first), model, problem, block
        )
    point = _per_channel(groups[:, None] == np.unique(groups), WIDE_G * scale)
    return Descriptions(
        (described(*model), described(*model, point), described(*model, point, *slow)),
        drifting,
        described(*model, point, *slow, first),
        model,
        problem,
        block,
    )


def _hysteresis(problem: Problem, block: Block) -> Iterator[Floats]:
    """Yield columns of hysteresis (n, 3, 3), one for each channel, for each width in `WIDTHS_G`."""
    still = np.zeros((len(problem.conditions.mounts), len(STAND_ANGLES)))
    plain = replace(problem.model, effects=())
    without = plain.readings(block, problem.conditions, still)
    for width_g in WIDTHS_G:
        applied = AppliedEffect(HYSTERESIS, {"size": np.full(3, WIDE_G), "width_g": np.asarray(width_g)})
        moved = replace(plain, effects=(applied,)).readings(block, problem.conditions, still) - without
        yield moved[:, :, None] * np.eye(3)


def _first(conditions: Conditions) -> NDArray[np.bool_]:
    """Return a column for each of the first `FIRST` readings after each remount, (n, k)."""
    starts = np.flatnonzero(conditions.remounted)
    rows = np.unique(np.concatenate([starts + i for i in range(FIRST)]))
    return np.asarray(np.arange(len(conditions))[:, None] == rows[rows < len(conditions)])


def turns(conditions: Conditions) -> Ints:
    """Return the number of each reading's pass in its mounting (n,), from 0."""
    key = np.stack([conditions.mount, conditions.pass_number], axis=1)
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()


def _slow(conditions: Conditions, deflection: Floats, block: Block, scale: Floats) -> list[Floats]:
    """Return column arrays of changes with time, with temperature, and from pass to pass.

    From pass to pass the voltmeters may differ, and the block may have slipped.
    """
    time = conditions.elapsed_s - conditions.elapsed_s.min()
    relaxed = [np.exp(-time / tau) for tau in RELAXATION_S]
    time = time / max(float(time.max()), 1e-300)
    along = [time, *relaxed]
    turn = turns(conditions)
    of_turn = turn[:, None] == np.unique(turn)
    factors = [time]
    if np.ptp(conditions.warmth_k) > 0:
        warmth = conditions.warmth_k / float(np.max(np.abs(conditions.warmth_k)))
        along.append(warmth)
        factors.append(warmth)
    return [
        _per_channel(np.column_stack([*along, of_turn]), WIDE_G * scale),
        *(np.einsum("ni,ij->nij", factor[:, None] * deflection, WIDE_G * np.eye(3)) for factor in factors),
        *(np.einsum("ni,ij->nij", one[:, None] * deflection, WIDE_G * np.eye(3)) for one in of_turn.T),
        *(column * of_turn[:, None, :] * WIDE_RAD for column in _turned(deflection, block)),
    ]


def _turned(deflection: Floats, block: Block) -> Iterator[Floats]:
    """Yield the derivatives of the signals by a rotation of the block about x, y and z, per rad, (n, 3, 1) each."""
    force = deflection @ np.linalg.inv(block.K).T
    for axis in np.eye(3):
        yield (np.cross(force, axis) @ block.K.T)[:, :, None]


def _per_channel(columns: Floats | NDArray[np.bool_], size: Floats) -> Floats:
    """Return columns (n, k), scaled by `size` (3,), for each channel separately: (n, 3, 3k)."""
    n, k = columns.shape
    return np.asarray(
        np.einsum("nk,ij->nikj", columns.astype(np.float64), np.diag(size)).reshape(n, 3, 3 * k)
    )


@dataclass(frozen=True)
class Precision:
    """Whitened readings y (3n,) and the inverse of their covariance, P = I - B B^T with its `basis` B (3n, k).

    `pull` (3n,) is P y. For a reading that is left out, its rows and columns of P are zero. Let P_i be the 3×3
    block of P of reading i and p_i its part of P y. The difference of the reading from its prediction by all
    others is then P_i^(-1) p_i, with covariance P_i^(-1).
    """

    whitened: Floats
    basis: Floats
    pull: Floats

    def without(self, rows: Sequence[int]) -> Precision:
        """Return the precision with the readings `rows` left out."""
        basis, pull = self.basis, self.pull
        for row in rows:
            own = slice(3 * row, 3 * row + 3)
            columns = -basis @ basis[own].T
            columns[own] += np.eye(3)
            size, vectors = np.linalg.eigh(columns[own])
            # of a reading that has a free value of its own nothing is left but rounding
            inverse = vectors / np.sqrt(np.maximum(size, np.finfo(float).eps))
            taken = columns @ inverse
            pull = pull - taken @ (inverse.T @ pull[own])
            basis = np.column_stack([basis, taken])
            pull[own] = 0.0
        return Precision(self.whitened, basis, pull)

    @property
    def blocks(self) -> Floats:
        """The diagonal 3×3 blocks of P, one for each reading, (n, 3, 3)."""
        of_reading = self.basis.reshape(len(self.pull) // 3, 3, -1)
        return np.asarray(np.eye(3) - of_reading @ np.swapaxes(of_reading, 1, 2))

    @property
    def pulls(self) -> Floats:
        """P y of each reading, (n, 3)."""
        return self.pull.reshape(-1, 3)

    @property
    def chi2(self) -> float:
        """Chi-square of the readings, y^T P y; it includes the priors' part."""
        return float(self.whitened @ self.pull)


@dataclass(frozen=True)
class Examination:
    """The test of readings against a description: the noise, all readings, and the rows that are `strange`.

    A reading is strange if the other readings make it improbable. `dof` are the degrees of freedom of the noise
    along du/dphi and perpendicular to it.
    """

    noise: Noise
    precision: Precision
    strange: tuple[int, ...]
    dof: tuple[float, float]


def expected_chi2(
    precision: Precision, description: Description, situation: Situation, noise: Noise
) -> float:
    """Return the expectation of chi-square if the stand errors are present and all other free values are zero."""
    basis = precision.basis
    stand = whiten(description.stand, situation.slope, noise).reshape(len(basis), -1)
    trace = len(basis) - float(np.sum(basis**2))
    return trace + float(np.sum(stand**2)) - float(np.sum((basis.T @ stand) ** 2))


def examine(description: Description, situation: Situation, start: Noise | None, most: int) -> Examination:
    """Test readings against a description, leaving out those that the others make improbable (`most` + 1 at most).

    The noise is estimated by medians first, then from all readings that are not left out.
    """
    noise = start or _first_noise(situation)
    for _ in range(ROUNDS):
        noise, _ = _noise(weigh(description, situation, noise), noise, situation, by_medians=True)
    strange: tuple[int, ...] = ()
    for _ in range(2):
        precision = weigh(description, situation, noise)
        strange = _strange(precision, most + 1)
        noise, _ = _noise(precision.without(strange), noise, situation, by_medians=False)
    return finish(description, situation, noise, strange)


def finish(
    description: Description, situation: Situation, noise: Noise, strange: Sequence[int]
) -> Examination:
    """Return the examination with the noise of the readings that are not left out."""
    precision = weigh(description, situation, noise)
    noise, dof = _noise(precision.without(strange), noise, situation, by_medians=False)
    return Examination(noise, weigh(description, situation, noise), tuple(strange), dof)


def _first_noise(situation: Situation) -> Noise:
    size = 1e-5 * float(np.max(np.linalg.norm(situation.slope, axis=1)))
    return Noise(max(size, situation.floor), 1e-5, np.inf, "guess")


def weigh(description: Description, situation: Situation, noise: Noise) -> Precision:
    """Return readings and description whitened with a noise, as a precision."""
    columns = whiten(description.columns, situation.slope, noise)
    y = whiten(situation.left[:, :, None], situation.slope, noise).ravel()
    size, p = len(y), columns.shape[2]
    q, _ = np.linalg.qr(np.vstack([columns.reshape(size, p), np.eye(p)]))
    basis = q[:size]
    return Precision(y, basis, y - basis @ (basis.T @ y))


def _strange(precision: Precision, most: int) -> tuple[int, ...]:
    """Return the rows that the other readings make improbable, one after another, the largest chi-square first."""
    found: list[int] = []
    while len(found) < most:
        blocks = precision.blocks
        blocks[found] = np.eye(3)
        solved = np.linalg.solve(blocks, precision.pulls[:, :, None])[:, :, 0]
        chi2 = np.sum(precision.pulls * solved, axis=1)
        worst = int(np.argmax(chi2))
        if chi2[worst] <= CANDIDATE:
            break
        found.append(worst)
        precision = precision.without([worst])
    return tuple(found)


def _noise(
    precision: Precision, noise: Noise, situation: Situation, by_medians: bool
) -> tuple[Noise, tuple[float, float]]:
    """Return a new estimate of the noise, and its degrees of freedom along du/dphi and perpendicular to it."""
    unit = situation.unit
    blocks, pulls = precision.blocks, precision.pulls
    along_part = np.einsum("ni,nij,nj->n", unit, blocks, unit)
    across_part = np.trace(blocks, axis1=1, axis2=2) - along_part
    along = np.einsum("ni,ni->n", unit, pulls) ** 2
    across = np.sum(pulls**2, axis=1) - along
    dof = float(along_part.sum()), float(across_part.sum())
    if by_medians:
        ratios = [
            float(np.median(square[part > SEEN] / part[part > SEEN])) / median if np.any(part > SEEN) else 1.0
            for square, part, median in zip((along, across), (along_part, across_part), MEDIANS, strict=True)
        ]
    else:
        ratios = [float(along.sum()) / max(dof[0], 1e-9), float(across.sum()) / max(dof[1], 1e-9)]
    slope2 = max(float(np.mean(np.sum(situation.slope**2, axis=1))), 1e-300)
    along_v2 = ratios[0] * (noise.reading**2 + noise.setting_rad**2 * slope2)
    reading = max(float(np.sqrt(ratios[1])) * noise.reading, situation.floor)
    setting = np.sqrt(max(along_v2 - reading**2, 0.0) / slope2)
    return Noise(reading, float(setting), sum(dof), "repeats"), dof
