"""Mistakes of a whole pass: angles misread by a mark of the scale, a stuck channel, another block.

Each description of the pass adds columns with normal priors to the signals of its rows. All descriptions are
compared by their evidence. A mistake must be more probable than all effects that may act in one pass together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special
from scipy.special import logsumexp

from bench.base.arrays import Floats, Ints, Mask
from bench.calibration.design import FIXED, Problem
from bench.calibration.noise import whiten
from bench.calibration.result import Noise
from bench.diagnosis.mistakes.describing import (
    Description,
    Situation,
    descriptions,
    examine,
    finish,
    situation,
    turns,
    weigh,
)
from bench.diagnosis.mistakes.gross import BIAS_U_G, CROSS_AXIS_U, ODDS, SCALE_U
from bench.model import CATALOGUE, Block
from bench.readings.corrected import SLIPS_RAD

LIKELIER: Final = 0.5
"""Least posterior probability of a mistake against the effects that may explain the pass."""
TIED: Final = 0.05
"""Posterior probability from which an effect is tied with the mistake."""
ZERO_SHIFT_RAD: Final = CATALOGUE["head_zero_shift"].parameters[0].plausible
ZERO_SHIFTS_RAD: Final = tuple(size * ZERO_SHIFT_RAD for size in (1.0, 4.0, 20.0))
"""Prior 1 sigma of a shift of the head's zero, rad, equally probable, since a plausible size is only a guess."""
MARKS_RAD: Final = tuple(
    sign * slip for slip in SLIPS_RAD.values() if slip > ZERO_SHIFTS_RAD[1] for sign in (1.0, -1.0)
)
"""Errors of an angle misread by a mark, 10′ or 1°, rad. An error of 1′ is a plausible shift of the zero."""
SEVERAL: Final = 2
"""Number of strange readings from which a pass is examined for a mistake."""
LOOK: Final = 1e-4
"""A pass is also examined if a shift of the head's zero improves chi-square with a p-value below this."""
STEPS: Final = 3
"""Gauss-Newton steps for a rotation of the block. Each step leaves a hundredth of a rotation of 1°."""


@dataclass(frozen=True)
class PassMistake:
    """A mistake in all readings of a pass, the rows `rows` (n,).

    It is an angle wrong by `off_rad`, a stuck `channel` (0, 1, 2), or, if both are None, another block. `p` is
    the number of looks divided by the odds against readings without a mistake. `ties` are names of effects that
    may explain the pass as well.
    """

    rows: Mask
    off_rad: float | None
    channel: int | None
    p: float
    ties: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Pass:
    """Readings minus the prediction of a block that was fitted without a pass; `rows` (n,) are those of the pass.

    `kept` (n,) are the rows that are used; `noise` is that of the other passes.
    """

    problem: Problem
    block: Block
    about: Situation
    model: Description
    rows: Mask
    kept: Mask
    noise: Noise

    @property
    def force(self) -> Floats:
        """The specific force on the block, (n, 3), in g."""
        predicted = self.problem.predict(self.block, self.problem.prior_mean)
        return np.asarray((predicted - self.block.U0) @ np.linalg.inv(self.block.K).T)

    def evidence(self, columns: Floats, beyond: Floats | float = 0.0) -> float:
        """Return ln of the evidence of `columns` (n, 3, p) with priors N(0, 1) in the pass.

        The noise is integrated out. `beyond` (n, 3) is added to the predicted signals of the pass.
        """
        described, left = self._with(columns), self.about.left - self._inside(beyond)
        y = whiten(left[:, :, None], self.about.slope, self.noise)[self.kept].ravel()
        design = whiten(described.columns, self.about.slope, self.noise)[self.kept].reshape(len(y), -1)
        unit = np.eye(design.shape[1])
        q, r = np.linalg.qr(np.vstack([design, unit]))
        rest = y - q[: len(y)] @ (q[: len(y)].T @ y)
        log_det = float(np.sum(np.log(np.abs(np.diag(r)))))
        return -log_det - 0.5 * (len(y) - FIXED) * float(np.log(y @ rest))

    def fitted(self, columns: Floats, beyond: Floats) -> Floats:
        """Return the estimated factors (p,) of `columns` (n, 3, p) in the pass; `beyond` as in `evidence`."""
        described = self._with(columns)
        about = replace(self.about, left=self.about.left - self._inside(beyond))
        pull = weigh(described, about, self.noise).without(np.flatnonzero(~self.kept).tolist()).pull
        design = whiten(described.columns, about.slope, self.noise).reshape(len(pull), -1)
        return np.asarray((design.T @ pull)[-columns.shape[2] :])

    def _with(self, columns: Floats) -> Description:
        inside = columns * self.rows[:, None, None]
        return Description(np.concatenate([self.model.columns, inside], axis=2), self.model.stand)

    def _inside(self, beyond: Floats | float) -> Floats:
        return np.asarray(beyond * self.rows[:, None])


def find_in_pass(
    problem: Problem, signal: Floats, floor: float, fit: Callable[[Mask], Block]
) -> tuple[PassMistake | None, int]:
    """Return the mistake of a whole pass with the highest odds, and the number of looks.

    The mistake is None if effects or chance are likelier. `fit` returns the block fitted to some rows (n,).
    `floor` is the least noise of the `signal` (n, 3).
    """
    turn = turns(problem.conditions)
    passes = _strange_passes(problem, signal, floor, turn, fit)
    looks = max(len(np.unique(turn)) * (len(MARKS_RAD) + 4), 1)
    found: list[tuple[float, PassMistake]] = []
    for number in passes:
        one = _make(problem, signal, floor, turn == number, fit)
        nothing = one.evidence(np.zeros((len(turn), 3, 0)))
        effects = list(_of_effects(one))
        mistakes: list[tuple[float, float | None, int | None]]
        mistakes = [(_of_mark(one, off), off, None) for off in MARKS_RAD]
        mistakes += [(_stuck(one, channel), None, channel) for channel in range(3)]
        mistakes.append((one.evidence(_another_block(one)), None, None))
        log_mistake, off, channel = max(mistakes, key=lambda mistake: mistake[0])
        whole = float(logsumexp([log_mistake, nothing, *(log_effect for _, log_effect in effects)]))
        odds = log_mistake - nothing - float(np.log(looks))
        if log_mistake - whole > np.log(LIKELIER) and odds > np.log(ODDS):
            ties = dict.fromkeys(name for name, log_effect in effects if log_effect - whole > np.log(TIED))
            p = max(float(np.exp(-odds)), np.finfo(float).tiny)
            found.append((odds, PassMistake(one.rows, off, channel, p, tuple(ties))))
    likeliest = max(found, key=lambda pair: pair[0], default=None)
    return None if likeliest is None else likeliest[1], looks


def _strange_passes(
    problem: Problem, signal: Floats, floor: float, turn: Ints, fit: Callable[[Mask], Block]
) -> list[int]:
    """Return the numbers of the passes with several strange readings, or with a shift of the head's zero."""
    everything = np.ones(len(turn), dtype=bool)
    if len(np.unique(turn)) < 2:
        return []
    block = fit(everything)
    about, model = situation(problem, block, signal, floor), descriptions(problem, block).ladder[0]
    examined = examine(model, about, None, len(turn) // 8)
    strange = np.bincount(turn[list(examined.strange)], minlength=int(turn.max()) + 1) >= SEVERAL
    of_pass = about.slope[:, :, None] * (turn[:, None] == np.arange(len(strange)))[:, None]
    precision = weigh(model, about, examined.noise)
    shifted = whiten(of_pass, about.slope, examined.noise).reshape(len(precision.pull), -1)
    left = np.sum(shifted**2, axis=0) - np.sum((precision.basis.T @ shifted) ** 2, axis=0)
    gain = (shifted.T @ precision.pull) ** 2 / np.maximum(left, 1e-300)
    return np.flatnonzero(strange | (gain > special.chdtri(1, LOOK / len(strange)))).tolist()


def _make(problem: Problem, signal: Floats, floor: float, rows: Mask, fit: Callable[[Mask], Block]) -> _Pass:
    """Return the pass `rows` with the noise of the other readings; strange ones among the others are not `kept`."""
    block = fit(~rows)
    about, model = situation(problem, block, signal, floor), descriptions(problem, block).ladder[0]
    free = np.einsum("nk,ij->nikj", np.eye(len(rows))[:, rows], np.eye(3)).reshape(len(rows), 3, -1)
    size = float(np.max(np.linalg.norm(block.K, axis=1)))
    beside = Description(np.concatenate([model.columns, size * free], axis=2), model.stand)
    examined = examine(beside, about, None, len(rows) // 8)
    kept = ~np.isin(np.arange(len(rows)), examined.strange) | rows
    noise = finish(beside, about, examined.noise, np.flatnonzero(~kept).tolist()).noise
    return _Pass(problem, block, about, model, rows, kept, noise)


def _of_effects(one: _Pass) -> Iterator[tuple[str, float]]:
    """Yield the name of each effect that may act in one pass, with ln of its evidence.

    In order: another zero of the head, other voltmeters, a slip of the block, a slip with other voltmeters, one
    or two accelerometers with other coefficients, and one channel with arbitrary signals.
    """
    force = one.force
    scale = np.linalg.norm(one.block.K, axis=1)
    zero = [size * one.about.slope[:, :, None] for size in ZERO_SHIFTS_RAD]
    yield "head_zero_shift", float(logsumexp([one.evidence(columns) for columns in zero]) - np.log(len(zero)))
    turn = np.stack([np.cross(force, axis) @ one.block.K.T for axis in np.eye(3)], axis=2) * CROSS_AXIS_U
    gain = (force @ one.block.K.T + one.block.U0)[:, :, None] * np.eye(3) * SCALE_U
    meters = np.concatenate([gain, np.broadcast_to(np.diag(scale * BIAS_U_G), gain.shape)], axis=2)
    yield "meters_exchanged", one.evidence(meters)
    for columns in (turn, np.concatenate([turn, meters], axis=2)):
        yield "block_slip", one.evidence(columns, _bent(one, columns))
    coefficients = _another_block(one).reshape(len(force), 3, 4, 3)
    for chosen in ([0], [1], [2], [0, 1], [0, 2], [1, 2]):
        yield "scale_step", one.evidence(coefficients[:, :, :, chosen].reshape(len(force), 3, -1))
    free = np.eye(len(force))[:, one.rows]
    for channel in range(3):
        yield "unnamed_form", one.evidence(free[:, None, :] * (scale * np.eye(3)[channel])[:, None])


def _bent(one: _Pass, columns: Floats) -> Floats:
    """Return the nonlinear part (n, 3) of the signals' change by a rotation of the block.

    The first three of `columns` are the derivatives by the rotation; its size is fitted to the pass.
    """
    bent = np.zeros_like(one.about.left)
    for _ in range(STEPS):
        angle = one.fitted(columns, bent)[:3] * CROSS_AXIS_U
        turned = _turned(one.force, -angle)
        linear = columns[:, :, :3] @ (angle / CROSS_AXIS_U)
        bent = (turned - one.force) @ one.block.K.T - linear
    return bent


def _turned(force: Floats, angle: Floats) -> Floats:
    """Return vectors (n, 3) rotated by a rotation vector (3,), rad (Rodrigues)."""
    size = float(np.linalg.norm(angle))
    if not size > 0.0:
        return force
    axis = angle / size
    along = np.outer(force @ axis, axis)
    return np.asarray(along + np.cos(size) * (force - along) + np.sin(size) * np.cross(axis, force))


def _of_mark(one: _Pass, off_rad: float) -> float:
    """Return ln of the evidence of a pass with an angle that is wrong by `off_rad`, one of `MARKS_RAD`."""
    angle = one.problem.conditions.angle_rad + off_rad
    there = replace(one.problem, conditions=replace(one.problem.conditions, angle_rad=angle))
    mean = one.problem.prior_mean
    moved = there.predict(one.block, mean) - one.problem.predict(one.block, mean)
    return one.evidence(np.zeros((*moved.shape, 0)), moved) - float(np.log(len(MARKS_RAD)))


def _stuck(one: _Pass, channel: int) -> float:
    """Return ln of the evidence of a `channel` (0, 1, 2) with the same unknown reading throughout the pass."""
    deaf = np.outer(one.rows, np.eye(3)[channel]) == 1.0
    model = np.where(deaf[:, :, None], 0.0, one.model.columns)
    about = replace(one.about, slope=np.where(deaf, 0.0, one.about.slope))
    scale = float(np.linalg.norm(one.block.K[channel]))
    same = (BIAS_U_G * scale * deaf)[:, :, None]
    stuck = replace(one, model=replace(one.model, columns=model), about=about)
    return stuck.evidence(same, np.where(deaf, -(one.force @ one.block.K.T), 0.0))


def _another_block(one: _Pass) -> Floats:
    """Return columns (n, 3, 12) of changed coefficients by channel, with the data sheet's tolerances as 1 sigma."""
    columns = np.concatenate([one.force, np.ones((len(one.force), 1))], axis=1)
    size = np.vstack([np.where(np.eye(3) == 1, SCALE_U, CROSS_AXIS_U), np.full(3, BIAS_U_G)])
    scale = np.linalg.norm(one.block.K, axis=1)
    each = np.einsum("na,ai,ij->niaj", columns, size * scale, np.eye(3))
    return np.asarray(each.reshape(len(columns), 3, 12))
