"""Mistakes of a whole pass: angles misread by a mark of the scale, a stuck channel, another block.

Each description of the pass adds columns with normal priors to the signals of its rows. All descriptions are
compared by their evidence. A mistake must be more probable than all effects that may act in one pass together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import logsumexp

from bench.base.arrays import Floats, Mask
from bench.calibration.design import Problem
from bench.diagnosis.evidence import SIZES
from bench.diagnosis.levels import OFTEN
from bench.diagnosis.mistakes.gross import BIAS_U_G, CROSS_AXIS_U, ODDS, SCALE_U
from bench.diagnosis.mistakes.hypotheses import Table
from bench.diagnosis.noise_grid import RATIOS
from bench.model import CATALOGUE, Block
from bench.readings.corrected import SLIPS_RAD

LIKELIER: Final = 0.5
"""Least posterior probability of a mistake against the effects that may explain the pass."""
ZERO_SHIFT_RAD: Final = CATALOGUE["head_zero_shift"].parameters[0].plausible
ZERO_SHIFTS_RAD: Final = tuple(size * ZERO_SHIFT_RAD for size in SIZES)
"""Prior 1 sigma of a shift of the head's zero, rad, equally probable, since a plausible size is only a guess."""
MARKS_RAD: Final = tuple(
    sign * slip for slip in SLIPS_RAD.values() if slip > ZERO_SHIFTS_RAD[1] for sign in (1.0, -1.0)
)
"""Errors of an angle misread by a mark, 10′ or 1°, rad. An error of 1′ is a plausible shift of the zero."""
LOOK: Final = 1e4
"""Odds of a change of the bench in a pass from which the pass is examined for a mistake."""
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
    """The readings about a block that was fitted without a pass, at the likeliest ratio of the noise sizes.

    `rows` (n,) are those of the pass.
    """

    table: Table
    rows: Mask
    ratio: float

    @classmethod
    def of(cls, table: Table, rows: Mask) -> _Pass:
        """Choose the ratio by the readings beside the pass."""
        free = np.einsum("nk,ij->nikj", np.eye(len(rows))[:, rows], np.eye(3)).reshape(len(rows), 3, -1)
        return cls(table, rows, max(RATIOS, key=lambda ratio: table.seen(ratio, [free]).log_evidence))

    def evidence(self, columns: Floats | None = None, beyond: Floats | float = 0.0) -> float:
        """Return ln of the evidence of `columns` (n, 3, p) with priors N(0, 1) in the pass.

        `beyond` (n, 3) is added to the predicted signals of the pass.
        """
        more = [] if columns is None else [columns * self.rows[:, None, None]]
        left = self.table.left - beyond * self.rows[:, None]
        return replace(self.table, left=left).seen(self.ratio, more=more).log_evidence

    def fitted(self, columns: Floats, beyond: Floats) -> Floats:
        """Return the estimated factors (p,) of `columns` (n, 3, p) in the pass; `beyond` as in `evidence`."""
        inside = columns * self.rows[:, None, None]
        table = replace(self.table, left=self.table.left - beyond * self.rows[:, None])
        seen = table.seen(self.ratio, more=[inside])
        return np.asarray(table.whiten(inside, seen.white).T @ seen.pull)


def find_in_pass(
    problem: Problem, signal: Floats, floor: float, fit: Callable[[Mask], Block]
) -> PassMistake | None:
    """Return the mistake of a whole pass with the highest odds; None if effects or chance are likelier.

    `fit` returns the block fitted to some rows (n,). `floor` is the least noise of the `signal` (n, 3).
    """
    table = Table.of(problem, fit(np.ones(len(signal), dtype=bool)), signal, floor)
    passes = np.unique(table.turn)
    looks = len(passes) * (len(MARKS_RAD) + 4)
    found: list[tuple[float, PassMistake]] = []
    seen = [table.seen(ratio) for ratio in RATIOS]
    base = logsumexp([one.log_evidence for one in seen])
    for rows in (table.turn == number for number in passes if len(passes) > 1):
        columns = table.of_pass(rows)
        if logsumexp([s.log_evidence + s.of_group(columns) for s in seen]) - base < np.log(LOOK):
            continue
        one = _Pass.of(Table.of(problem, fit(~rows), signal, floor), rows)
        nothing = one.evidence()
        effects = list(_of_effects(one))
        mistakes: list[tuple[float, float | None, int | None]]
        mistakes = [(_of_mark(one, off), off, None) for off in MARKS_RAD]
        mistakes += [(_stuck(one, channel), None, channel) for channel in range(3)]
        mistakes.append((one.evidence(_another_block(one)), None, None))
        log_mistake, off, channel = max(mistakes, key=lambda mistake: mistake[0])
        whole = float(logsumexp([log_mistake, nothing, *(log_effect for _, log_effect in effects)]))
        odds = log_mistake - nothing - float(np.log(looks))
        if log_mistake - whole > np.log(LIKELIER) and odds > np.log(ODDS):
            ties = dict.fromkeys(name for name, log_effect in effects if log_effect - whole > np.log(OFTEN))
            p = max(float(np.exp(-odds)), np.finfo(float).tiny)
            found.append((odds, PassMistake(one.rows, off, channel, p, tuple(ties))))
    likeliest = max(found, key=lambda pair: pair[0], default=None)
    return None if likeliest is None else likeliest[1]


def _of_effects(one: _Pass) -> Iterator[tuple[str, float]]:
    """Yield the name of each effect that may act in one pass, with ln of its evidence.

    In order: another zero of the head, other voltmeters, a slip of the block, a slip with other voltmeters, one
    or two accelerometers with other coefficients, and one channel with arbitrary signals.
    """
    table = one.table
    scale = np.linalg.norm(table.block.K, axis=1)
    zero = [size * table.slope[:, :, None] for size in ZERO_SHIFTS_RAD]
    yield "head_zero_shift", float(logsumexp([one.evidence(columns) for columns in zero]) - np.log(len(zero)))
    turn = table.rotations * CROSS_AXIS_U
    gain = (table.deflection + table.block.U0)[:, :, None] * np.eye(3) * SCALE_U
    meters = np.concatenate([gain, np.broadcast_to(np.diag(scale * BIAS_U_G), gain.shape)], axis=2)
    yield "meters_exchanged", one.evidence(meters)
    for columns in (turn, np.concatenate([turn, meters], axis=2)):
        yield "block_slip", one.evidence(columns, _bent(one, columns))
    coefficients = _another_block(one).reshape(len(turn), 3, 4, 3)
    for chosen in ([0], [1], [2], [0, 1], [0, 2], [1, 2]):
        yield "scale_step", one.evidence(coefficients[:, :, :, chosen].reshape(len(turn), 3, -1))
    free = np.eye(len(turn))[:, one.rows]
    for channel in range(3):
        yield "unnamed_form", one.evidence(free[:, None, :] * (scale * np.eye(3)[channel])[:, None])


def _bent(one: _Pass, columns: Floats) -> Floats:
    """Return the nonlinear part (n, 3) of the signals' change by a rotation of the block.

    The first three of `columns` are the derivatives by the rotation; its size is fitted to the pass.
    """
    force, K = one.table.force, one.table.block.K
    bent = np.zeros_like(one.table.left)
    for _ in range(STEPS):
        angle = one.fitted(columns, bent)[:3] * CROSS_AXIS_U
        bent = (_turned(force, -angle) - force) @ K.T - columns[:, :, :3] @ (angle / CROSS_AXIS_U)
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
    problem, block = one.table.problem, one.table.block
    moved = replace(problem.conditions, angle_rad=problem.conditions.angle_rad + off_rad)
    there = replace(problem, conditions=moved).predict(block, problem.prior_mean)
    here = problem.predict(block, problem.prior_mean)
    return one.evidence(None, there - here) - float(np.log(len(MARKS_RAD)))


def _stuck(one: _Pass, channel: int) -> float:
    """Return ln of the evidence of a `channel` (0, 1, 2) with the same unknown reading throughout the pass."""
    table = one.table
    deaf = np.outer(one.rows, np.eye(3)[channel]) == 1.0
    hearing = replace(
        table,
        coefficients=np.where(deaf[:, :, None], 0.0, table.coefficients),
        stand=np.where(deaf[:, :, None], 0.0, table.stand),
        slope=np.where(deaf, 0.0, table.slope),
    )
    same = (BIAS_U_G * float(np.linalg.norm(table.block.K[channel])) * deaf)[:, :, None]
    return replace(one, table=hearing).evidence(same, np.where(deaf, -table.deflection, 0.0))


def _another_block(one: _Pass) -> Floats:
    """Return columns (n, 3, 12) of changed coefficients by channel, with the data sheet's tolerances as 1 sigma."""
    columns = np.concatenate([one.table.force, np.ones((len(one.rows), 1))], axis=1)
    size = np.vstack([np.where(np.eye(3) == 1, SCALE_U, CROSS_AXIS_U), np.full(3, BIAS_U_G)])
    scale = np.linalg.norm(one.table.block.K, axis=1)
    each = np.einsum("na,ai,ij->niaj", columns, size * scale, np.eye(3))
    return np.asarray(each.reshape(len(columns), 3, 12))
