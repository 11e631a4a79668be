"""Readings minus prediction as one table, on which mistakes compete with changes of the bench.

Every hypothesis adds columns with normal priors to the linear model. All are compared by their evidence, as in the
search for effects: the standard deviation of the noise is integrated out, and the noise ratio is averaged over.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask
from bench.calibration.design import FIXED, Problem
from bench.calibration.noise import repeat_groups, whiten
from bench.calibration.result import Noise
from bench.diagnosis.evidence import SIZES
from bench.diagnosis.levels import MARK_DEG
from bench.diagnosis.noise_grid import RATIOS
from bench.diagnosis.residual_dictionary import shapes
from bench.model import CATALOGUE, STAND_ANGLES, AppliedEffect, Block

ERRORS: Final = (20.0, 1e3, 5e4)
"""Prior standard deviations of an error, in units of the noise: from that of an outlier to the full range."""
WIDE: Final = max(ERRORS)
"""Prior 1 sigma of free values, in units of the noise."""


@dataclass(frozen=True)
class ProjectedReadings:
    """The whitened readings of a table at one noise ratio, with the model and known changes projected out.

    `white` has the noise of a reading and the setting error; `basis` (3n, k) spans model and known changes. `pull`
    (3n,) are the whitened residuals, `square` is their sum of squares. `log_det` is the part of ln of the evidence
    that does not depend on the readings.
    """

    table: Table
    white: Noise
    basis: Floats
    pull: Floats
    square: float
    log_det: float

    @property
    def log_evidence(self) -> float:
        """ln of the evidence of the readings, with the noise integrated out, up to a constant."""
        return self.log_det - 0.5 * self.table.freedom * float(np.log(self.square))

    @property
    def noise(self) -> float:
        """The noise of a reading that the residuals show, in the unit of the signal."""
        free = len(self.pull) - float(np.sum(self.basis**2))
        return self.table.unit * float(np.sqrt(self.square / max(free, 1.0)))

    def of_group(self, columns: Floats) -> float:
        """Return ln of the Bayes factor of a change, against no change.

        `columns` (n, 3, p) are the change by each of p amplitudes, in units of the noise. The amplitudes have
        normal priors, and the evidence is averaged over their standard deviations `SIZES`.
        """
        inside = self.table.whiten(self.table.unit * columns, self.white)
        known = self.basis.T @ inside
        values, vectors = np.linalg.eigh(inside.T @ inside - known.T @ known)
        along = (vectors.T @ (inside.T @ self.pull)) ** 2
        return float(self._factors(np.maximum(values, 0.0)[None], along[None], SIZES)[0])

    def of_readings(self) -> Floats:
        """Return, for each reading, ln of the Bayes factor (n,) of arbitrary errors in all its channels."""
        values, vectors = np.linalg.eigh(self.blocks)
        along = np.einsum("nij,ni->nj", vectors, self.pulls) ** 2
        return self._factors(np.maximum(values, 0.0), along, ERRORS)

    def _factors(self, values: Floats, along: Floats, sizes: Sequence[float]) -> Floats:
        squares = np.square(sizes)[:, None, None]
        explained = np.sum(along / (values + 1.0 / squares), axis=2)
        rest = np.maximum(1.0 - explained / self.square, 1e-12)
        cost = 0.5 * np.sum(np.log1p(squares * values), axis=2)
        of_size = -cost - 0.5 * self.table.freedom * np.log(rest)
        return np.asarray(np.logaddexp.reduce(of_size, axis=0) - np.log(len(sizes)))

    @cached_property
    def _ways(self) -> Floats:
        """The whitened unit errors of the channels x, y and z of each reading, (n, 3, 3)."""
        n = len(self.table.left)
        unit = np.broadcast_to(np.eye(3), (n, 3, 3)) * self.table.unit
        return np.asarray(whiten(unit, self.table.slope, self.white))

    @cached_property
    def blocks(self) -> Floats:
        """The information matrix (3, 3) of the errors of each reading's channels, (n, 3, 3), in units of noise."""
        own = self.basis.reshape(len(self.table.left), 3, -1)
        seen = np.swapaxes(self._ways, 1, 2) @ own
        return np.asarray(np.swapaxes(self._ways, 1, 2) @ self._ways - seen @ np.swapaxes(seen, 1, 2))

    @property
    def pulls(self) -> Floats:
        """For each reading (n, 3), `blocks` times the least-squares estimate of its errors."""
        return np.asarray(np.einsum("nji,nj->ni", self._ways, self.pull.reshape(-1, 3)))


@dataclass(frozen=True)
class Table:
    """Deviations `left` (n, 3) of n readings from the prediction, linearised at the coefficients of `block`.

    `slope` (n, 3) has the derivatives by the head angle, unit of the signal per rad. `coefficients` (n, 3, 12) has
    those by the coefficients, per unit of each coefficient. `stand` (n, 3, p) has the changes by one prior u of
    each other unknown. `unit` is the noise of a reading. `left`, `stand` and `unit` are in the unit of the signal.
    """

    problem: Problem
    block: Block
    left: Floats
    slope: Floats
    coefficients: Floats
    stand: Floats
    unit: float

    @classmethod
    def of(cls, problem: Problem, block: Block, signal: Floats, floor: float) -> Table:
        """Return the table of `signal` (n, 3), linearised at `block`; `floor` is the least noise of a reading."""
        linear = problem.linear(block, problem.prior_mean)
        table = cls(
            problem, block, signal - linear.predicted, linear.slope, linear.jacobian[:, :, :FIXED],
            problem.by_prior(linear.jacobian[:, :, FIXED:]), floor,
        )  # fmt: skip
        return replace(table, unit=max(table._usual(), floor))

    def _usual(self) -> float:
        """Return the noise of a reading, from the median residual after free values of the `points` are fitted."""
        unit = max(float(np.median(np.abs(self.left))), self.unit)
        for _ in range(2):
            table = replace(self, unit=unit)
            seen = table.seen(RATIOS[2], [self.points])
            size = seen.pulls**2 / np.maximum(np.diagonal(seen.blocks, axis1=1, axis2=2), 1e-9)
            told = np.diagonal(seen.blocks, axis1=1, axis2=2) > 0.05
            if not told.any():
                break
            unit *= float(np.sqrt(np.median(size[told]) / special.chdtri(1, 0.5)))
        return unit

    def chi2(self, noise_of: ProjectedReadings) -> float:
        """Return the chi-square of the readings about the model, with the noise and noise ratio of `noise_of`."""
        table = replace(self, unit=noise_of.noise)
        return table.seen(noise_of.white.setting_rad * self.typical_slope / noise_of.table.unit).square

    @property
    def typical_slope(self) -> float:
        """Root mean square length of `slope`, in the unit of the signal per rad; never zero."""
        return max(float(np.sqrt(np.mean(np.sum(self.slope**2, axis=1)))), 1e-300)

    @property
    def freedom(self) -> int:
        """The number of signals minus that of the coefficients."""
        return self.left.size - FIXED

    @cached_property
    def turn(self) -> Ints:
        """The number (n,) of the pass of each reading, from 0, counted over all mountings."""
        conditions = self.problem.conditions
        key = np.stack([conditions.mount, conditions.pass_number], axis=1)
        return np.unique(key, axis=0, return_inverse=True)[1].ravel()

    @cached_property
    def deflection(self) -> Floats:
        """The predicted signals minus the biases, (n, 3), for the coefficients of `block`."""
        return np.asarray(self.problem.predict(self.block, self.problem.prior_mean) - self.block.U0)

    @property
    def force(self) -> Floats:
        """The predicted specific force in block axes, (n, 3), in g."""
        return np.asarray(self.deflection @ np.linalg.inv(self.block.K).T)

    def whiten(self, columns: Floats, white: Noise) -> Floats:
        """Return `columns` (n, 3, p) multiplied by the inverse root of the covariance of `white`, (3n, p).

        `columns` are in the unit of the signal. `white` has the noise of a reading and the setting error; after
        whitening, the noise of all 3n rows is independent, of variance 1.
        """
        return whiten(columns, self.slope, white).reshape(self.left.size, -1)

    def seen(
        self, ratio: float, known: Sequence[Floats] = (), more: Sequence[Floats] = ()
    ) -> ProjectedReadings:
        """Return the readings at a noise ratio, with the model and further columns (n, 3, p) projected out.

        Columns `known` are in units of the noise, with a wide prior; columns `more`, in the unit of the signal,
        have standard normal priors.
        """
        white = Noise(self.unit, ratio * self.unit / self.typical_slope, np.inf, "grid")
        wide = self.coefficients * (WIDE * self.unit / np.max(np.abs(self.coefficients)))
        columns = np.concatenate(
            [wide, self.stand, *(WIDE * self.unit * one for one in known), *more], axis=2
        )
        y, design = self.whiten(self.left[:, :, None], white)[:, 0], self.whiten(columns, white)
        q, r = np.linalg.qr(np.vstack([design, np.eye(design.shape[1])]))
        basis = q[: len(y)]
        pull = y - basis @ (basis.T @ y)
        length2 = np.sum(self.slope**2, axis=1) * (white.setting_rad / self.unit) ** 2
        log_det = -float(np.sum(np.log(np.abs(np.diag(r))))) - 0.5 * float(np.sum(np.log1p(length2)))
        return ProjectedReadings(self, white, basis, pull, max(float(y @ pull), 1e-300), log_det)

    @cached_property
    def points(self) -> Floats:
        """Indicator columns (n, 3, p): a free value of each channel at each angle that a mounting repeats.

        Repeats are within half of `MARK_DEG` of their median, so that a slightly wrong setting counts as a repeat.
        """
        conditions = self.problem.conditions
        angle, repeats = np.degrees(conditions.angle_rad), repeat_groups(conditions)
        usual = np.array([np.median(angle[repeats == group]) for group in range(repeats.max() + 1)])[repeats]
        near = np.where(np.abs(angle - usual) < MARK_DEG / 2.0, usual, angle)
        key = np.stack([conditions.mount, np.round(near).astype(np.int64)], axis=1)
        group = np.unique(key, axis=0, return_inverse=True)[1].ravel()
        return per_channel(group[:, None] == np.unique(group)[np.bincount(group) > 1])

    def changes_of_passes(self) -> Iterator[tuple[Mask, Floats]]:
        """Yield the mask (n,) of each of several passes, and unit changes of the bench in it (`of_pass`)."""
        passes = np.unique(self.turn)
        for rows in (self.turn == number for number in passes if len(passes) > 1):
            yield rows, self.of_pass(rows)

    def changes_of_run(self) -> Iterator[Floats]:
        """Yield unit changes of the bench in all passes that may resemble wrong readings, as columns (n, 3, p)."""
        if self.points.shape[2]:
            yield self.points
        conditions, deflection = self.problem.conditions, self.deflection
        time = conditions.elapsed_s - conditions.elapsed_s.min()
        course = [np.exp(-time / tau) for tau in shapes("warm_up", "tau")]
        course.append(time / max(float(time.max()), 1e-300))
        if np.ptp(conditions.warmth_k) > 0:
            course.append(conditions.warmth_k / float(np.max(np.abs(conditions.warmth_k))))
        unit = deflection / np.max(np.abs(deflection))
        slow = [per_channel(np.stack(course, axis=1)), *(scaled(unit, one) for one in course[-2:])]
        yield np.concatenate(slow, axis=2)
        if not self.turn.any():
            yield self.of_pass(self.turn == 0)
        yield from _hysteresis(self.problem, self.block)

    def of_pass(self, rows: Mask) -> Floats:
        """Return a bias, a gain and a rotation of the block in the rows of the mask (n,), as columns (n, 3, 9)."""
        unit = self.deflection / np.max(np.abs(self.deflection))
        turned = self.rotations * rows[:, None, None] / np.max(np.abs(self.block.K))
        return np.concatenate([per_channel(rows[:, None]), scaled(unit, rows), turned], axis=2)

    @cached_property
    def rotations(self) -> Floats:
        """The derivatives (n, 3, 3) of the channels by rotations of the block about its three axes, per rad."""
        return np.stack([np.cross(self.force, axis) @ self.block.K.T for axis in np.eye(3)], axis=2)


def _hysteresis(problem: Problem, block: Block) -> Iterator[Floats]:
    effect = CATALOGUE["hysteresis"]
    still = np.zeros((len(problem.conditions.mounts), len(STAND_ANGLES)))
    plain = replace(problem.model, effects=())
    without = plain.readings(block, problem.conditions, still)
    for width_g in shapes("hysteresis", "width_g"):
        applied = AppliedEffect(effect, {"size": np.full(3, 1e-3), "width_g": np.asarray(width_g)})
        moved = replace(plain, effects=(applied,)).readings(block, problem.conditions, still) - without
        yield scaled(moved / max(float(np.max(np.abs(moved))), 1e-300), np.ones(len(moved)))


def per_channel(columns: Floats | Mask) -> Floats:
    """Return columns (n, 3, 3k) for k time courses (n, k), each in one channel only."""
    each = np.einsum("nk,ij->nikj", columns.astype(np.float64), np.eye(3))
    return np.asarray(each.reshape(len(columns), 3, -1))


def scaled(signal: Floats, by: Floats | Mask) -> Floats:
    """Return columns (n, 3, 3), one for each channel of `signal` (n, 3), multiplied by the course `by` (n,)."""
    return np.asarray(signal[:, :, None] * np.eye(3) * np.asarray(by, dtype=np.float64)[:, None, None])
