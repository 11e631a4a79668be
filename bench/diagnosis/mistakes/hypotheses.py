"""Readings less the model as one table of hypotheses: mistakes, and changes of the bench that resemble them.

Every hypothesis adds columns with normal priors to the model. All are compared by their evidence, with the size of
the noise integrated out and its ratio to the setting error averaged, as in the search for effects.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy import special
from scipy.special import logsumexp

from bench.base.arrays import Floats, Ints, Mask
from bench.calibration.design import FIXED, Problem
from bench.calibration.noise import repeat_groups, whiten
from bench.calibration.result import Noise
from bench.diagnosis.evidence import SIZES
from bench.diagnosis.noise_grid import RATIOS
from bench.diagnosis.residual_dictionary import shapes
from bench.model import CATALOGUE, STAND_ANGLES, AppliedEffect, Block

WIDE: Final = 1e5
"""Prior 1 sigma of what is left free, in units of the noise: wider than any signal."""
ERRORS: Final = (20.0, 1e3, 5e4)
"""Prior 1 sigma of the errors of a wrong reading, in units of the noise, equally probable."""
NEAR_DEG: Final = 3.0
"""Largest difference, in degrees, between the angles of repeats."""


@dataclass(frozen=True)
class ProjectedReadings:
    """Whitened readings at one ratio of the noise sizes, with the model and everything known projected out.

    `white` holds the noise sizes, with the noise of a reading as the unit. `basis` (3n, k) spans the directions
    projected out, `pull` (3n,) are the remaining readings, `square` their squared length, and `log_det` completes
    the evidence.
    """

    table: Table
    white: Noise
    basis: Floats
    pull: Floats
    square: float
    log_det: float

    @property
    def log_evidence(self) -> float:
        """ln of the evidence, integrated over the size of the noise."""
        return self.log_det - 0.5 * self.table.freedom * float(np.log(self.square))

    @property
    def noise(self) -> float:
        """The noise of a reading, in the unit of the signal."""
        free = len(self.pull) - float(np.sum(self.basis**2))
        return self.table.unit * float(np.sqrt(self.square / max(free, 1.0)))

    def of_group(self, columns: Floats) -> float:
        """Return ln of the Bayes factor of a change; its columns (n, 3, p) have the plausible size of the noise."""
        inside = self.table.whiten(self.table.unit * columns, self.white)
        known = self.basis.T @ inside
        values, vectors = np.linalg.eigh(inside.T @ inside - known.T @ known)
        along = (vectors.T @ (inside.T @ self.pull)) ** 2
        return float(self._factors(np.maximum(values, 0.0)[None], along[None], SIZES)[0])

    def of_readings(self) -> Floats:
        """Return ln of the Bayes factor (n,) of arbitrary errors in all channels of each reading."""
        values, vectors = np.linalg.eigh(self.blocks)
        along = np.einsum("nij,ni->nj", vectors, self.pulls) ** 2
        return self._factors(np.maximum(values, 0.0), along, ERRORS)

    def _factors(self, values: Floats, along: Floats, sizes: Sequence[float]) -> Floats:
        of_size = []
        for size in sizes:
            explained = np.sum(along / (values + size**-2), axis=1)
            rest = np.maximum(1.0 - explained / self.square, 1e-12)
            cost = 0.5 * np.sum(np.log1p(size**2 * values), axis=1)
            of_size.append(-cost - 0.5 * self.table.freedom * np.log(rest))
        return np.asarray(logsumexp(np.stack(of_size), axis=0) - np.log(len(sizes)))

    @cached_property
    def _ways(self) -> Floats:
        """Whitened unit errors of x, y and z in each reading, (n, 3, 3)."""
        n = len(self.table.left)
        unit = np.broadcast_to(np.eye(3), (n, 3, 3)) * self.table.unit
        return np.asarray(whiten(unit, self.table.slope, self.white))

    @cached_property
    def blocks(self) -> Floats:
        """Information on an error of each reading from all others, per unit of noise, (n, 3, 3)."""
        own = self.basis.reshape(len(self.table.left), 3, -1)
        seen = np.swapaxes(self._ways, 1, 2) @ own
        return np.asarray(np.swapaxes(self._ways, 1, 2) @ self._ways - seen @ np.swapaxes(seen, 1, 2))

    @property
    def pulls(self) -> Floats:
        """The right sides (n, 3) that belong to `blocks`."""
        return np.asarray(np.einsum("nji,nj->ni", self._ways, self.pull.reshape(-1, 3)))


@dataclass(frozen=True)
class Table:
    """Readings of a `problem` less its prediction for a first guess of the block, `left` (n, 3).

    `slope` (n, 3) is du/dphi per rad; `coefficients` and `stand` (n, 3, p) have their columns, the stand's as wide
    as its priors. `unit` is the noise of a reading as the bulk of them shows it. All are in the unit of the
    signal.
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
        """Return the table of readings `signal` (n, 3); `floor` is the least noise."""
        linear = problem.linear(block, problem.prior_mean)
        table = cls(
            problem, block, signal - linear.predicted, linear.slope, linear.jacobian[:, :, :FIXED],
            linear.jacobian[:, :, FIXED:] * problem.prior_u, floor,
        )  # fmt: skip
        return replace(table, unit=max(table._usual(), floor))

    def _usual(self) -> float:
        """Return the noise from the median residual beside free values of the points."""
        unit = max(float(np.median(np.abs(self.left))), self.unit)
        for _ in range(2):
            table = replace(self, unit=unit)
            seen = table.seen(RATIOS[2], [table.points])
            size = seen.pulls**2 / np.maximum(np.diagonal(seen.blocks, axis1=1, axis2=2), 1e-9)
            told = np.diagonal(seen.blocks, axis1=1, axis2=2) > 0.05
            if not told.any():
                break
            unit *= float(np.sqrt(np.median(size[told]) / special.chdtri(1, 0.5)))
        return unit

    def chi2(self, noise_of: ProjectedReadings) -> float:
        """Return the chi-square of the readings given the model, in the noise that the other readings show."""
        size = noise_of.noise
        table = replace(self, unit=size)
        return table.seen(noise_of.white.setting_rad * self.typical_slope / noise_of.table.unit).square

    @property
    def typical_slope(self) -> float:
        """Root mean square length of du/dphi, in the unit of the signal per rad."""
        return max(float(np.sqrt(np.mean(np.sum(self.slope**2, axis=1)))), 1e-300)

    @property
    def freedom(self) -> int:
        """The number of signals beyond the coefficients."""
        return self.left.size - FIXED

    @property
    def turn(self) -> Ints:
        """The number of each reading's pass in its mounting (n,), from 0."""
        conditions = self.problem.conditions
        key = np.stack([conditions.mount, conditions.pass_number], axis=1)
        return np.unique(key, axis=0, return_inverse=True)[1].ravel()

    @property
    def deflection(self) -> Floats:
        """The signals (n, 3) minus the signals at zero force that the first guess predicts."""
        return np.asarray(self.problem.predict(self.block, self.problem.prior_mean) - self.block.U0)

    @property
    def force(self) -> Floats:
        """The specific force on the block, (n, 3), in g."""
        return np.asarray(self.deflection @ np.linalg.inv(self.block.K).T)

    def whiten(self, columns: Floats, white: Noise) -> Floats:
        """Return columns (n, 3, p) as rows of unit noise, (3n, p)."""
        return whiten(columns, self.slope, white).reshape(self.left.size, -1)

    def seen(
        self, ratio: float, known: Sequence[Floats] = (), more: Sequence[Floats] = ()
    ) -> ProjectedReadings:
        """Return the readings at a ratio of the noise sizes, beside other columns (n, 3, p).

        What is `known` is in units of the noise, and left free; `more` has priors N(0, 1).
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
        """A free value of each channel at each angle of a mounting, (n, 3, p).

        A reading within `NEAR_DEG` of the median angle of its repeats belongs to their point, so that a wrong
        setting stays with its repeats.
        """
        conditions = self.problem.conditions
        angle, repeats = np.degrees(conditions.angle_rad), repeat_groups(conditions)
        usual = np.array([np.median(angle[repeats == group]) for group in range(repeats.max() + 1)])[repeats]
        near = np.where(np.abs(angle - usual) < NEAR_DEG, usual, angle)
        key = np.stack([conditions.mount, np.round(near).astype(np.int64)], axis=1)
        group = np.unique(key, axis=0, return_inverse=True)[1].ravel()
        return per_channel(group[:, None] == np.unique(group)[np.bincount(group) > 1])

    def changes(self) -> Iterator[tuple[Mask | None, Floats]]:
        """Yield the changes of the bench that may resemble wrong readings, as columns (n, 3, p) of unit size.

        Before the columns is a mask (n,) of the pass, where there are several and the change is of one.
        """
        if self.points.shape[2]:
            yield None, self.points
        conditions, deflection = self.problem.conditions, self.deflection
        time = conditions.elapsed_s - conditions.elapsed_s.min()
        course = [np.exp(-time / tau) for tau in shapes("warm_up", "tau")]
        course.append(time / max(float(time.max()), 1e-300))
        if np.ptp(conditions.warmth_k) > 0:
            course.append(conditions.warmth_k / float(np.max(np.abs(conditions.warmth_k))))
        unit = deflection / np.max(np.abs(deflection))
        slow = [per_channel(np.stack(course, axis=1)), *(scaled(unit, one) for one in course[-2:])]
        yield None, np.concatenate(slow, axis=2)
        passes = np.unique(self.turn)
        for rows in (self.turn == number for number in passes):
            yield rows if len(passes) > 1 else None, self.of_pass(rows)
        yield from ((None, columns) for columns in _hysteresis(self.problem, self.block))

    def of_pass(self, rows: Mask) -> Floats:
        """Return columns (n, 3, 9) of other zeros and gains and of a rotation of the block in some rows."""
        unit = self.deflection / np.max(np.abs(self.deflection))
        turned = self.rotations * rows[:, None, None] / np.max(np.abs(self.block.K))
        return np.concatenate([per_channel(rows[:, None]), scaled(unit, rows), turned], axis=2)

    @cached_property
    def rotations(self) -> Floats:
        """The derivatives (n, 3, 3) of the signals by rotations of the block about its axes, per rad."""
        return np.stack([np.cross(self.force, axis) @ self.block.K.T for axis in np.eye(3)], axis=2)


def _hysteresis(problem: Problem, block: Block) -> Iterator[Floats]:
    """Yield columns of hysteresis (n, 3, 3), one for each channel, for each width that the catalogue tries."""
    effect = CATALOGUE["hysteresis"]
    still = np.zeros((len(problem.conditions.mounts), len(STAND_ANGLES)))
    plain = replace(problem.model, effects=())
    without = plain.readings(block, problem.conditions, still)
    for width_g in shapes("hysteresis", "width_g"):
        applied = AppliedEffect(effect, {"size": np.full(3, 1e-3), "width_g": np.asarray(width_g)})
        moved = replace(plain, effects=(applied,)).readings(block, problem.conditions, still) - without
        yield scaled(moved / max(float(np.max(np.abs(moved))), 1e-300), np.ones(len(moved)))


def per_channel(columns: Floats | Mask) -> Floats:
    """Return columns (n, k) for each channel separately: (n, 3, 3k)."""
    each = np.einsum("nk,ij->nikj", columns.astype(np.float64), np.eye(3))
    return np.asarray(each.reshape(len(columns), 3, -1))


def scaled(signal: Floats, by: Floats | Mask) -> Floats:
    """Return columns (n, 3, 3): the signal (n, 3) of each channel alone times a course (n,)."""
    return np.asarray(signal[:, :, None] * np.eye(3) * np.asarray(by, dtype=np.float64)[:, None, None])
