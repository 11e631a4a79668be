"""Wrong settings, outliers, and passes with a mistake in all readings, compared with changes of the bench."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Final

import numpy as np
from scipy import special
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.calibration.design import Problem
from bench.diagnosis.evidence import SIZES
from bench.diagnosis.levels import FEW, HARDLY_EVER, MARK_DEG, OFTEN, ONE_DIRECTION
from bench.diagnosis.mistakes.gross import SHEET_U, p_of, sheet_u
from bench.diagnosis.mistakes.hypotheses import ProjectedReadings, Table
from bench.diagnosis.noise_grid import RATIOS
from bench.model import CATALOGUE, Block
from bench.readings.corrected import SLIPS_RAD, MistakeName, reflected_rad

BEYOND_TAILS: Final = 17.0
"""Least size of an outlier, in units of the noise of a reading.

A smaller deviation may be a tail of the noise: a comparison of hypotheses on the noise and on single readings
decides. In 7 of 1,000 runs of the paper's length, noise distributed as Student's t (4 degrees of freedom,
scale estimated a fifth too small) exceeds this size. An outlier of 20 times the noise still exceeds it if the
noise is estimated 15 % too large.
"""
SLIP_PART: Final = ONE_DIRECTION
"""Relative u of the signal shift that a wrong setting causes: its direction is known within this angle, rad.

It allows for effects missing in the model, too.
"""


@dataclass(frozen=True)
class WrongReadings:
    """A mistake in one reading, or in all readings of a pass; `rows` are indices among the oriented readings.

    `off_rad` is the true minus the recorded angle, None if the readings are useless. `ties` are mistakes or effects
    that explain the readings equally well. `p` is the number of hypotheses divided by the odds. For one reading,
    `shift` (3,) is the error, unit of the signal, and `sigma` is its largest component among the `channels`, in
    units of the noise. For a pass, `shift` is empty.
    """

    name: MistakeName
    rows: Ints
    channels: tuple[str, ...]
    off_rad: float | None
    ties: tuple[str, ...]
    p: float
    shift: Floats
    sigma: float = np.inf

    @property
    def whole(self) -> bool:
        """Whether the mistake is in all readings of a pass."""
        return not len(self.shift)


@dataclass(frozen=True)
class TermSearch:
    """A search for wrong readings in the table `signal` (n, 3).

    `floor` is the least noise of a reading, unit of the signal; `fit` returns the block fitted to the readings
    in a mask (n,).
    """

    problem: Problem
    signal: Floats
    floor: float
    fit: Callable[[Mask], Block]

    @cached_property
    def table(self) -> Table:
        """The readings minus the prediction for a block fitted to all of them."""
        return self._without(np.zeros(len(self.signal), dtype=bool))

    def _without(self, rows: Mask) -> Table:
        return Table.of(self.problem, self.fit(~rows), self.signal, self.floor)

    def find(self, significance: float) -> list[WrongReadings]:
        """Return the pass in which all readings are wrong, or else single wrong readings, the largest error first.

        One by one, the likeliest error of a reading or change of the bench joins the model, until no reading
        and no single pass has odds above 1/`significance`. A change of a pass joins only if no mistake in
        this pass explains it. The result is empty if too many readings would be wrong.
        """
        table, n = self.table, len(self.signal)
        changes: list[tuple[Mask | None, Floats]] = list(table.changes_of_passes())
        of_run = table.changes_of_run()  # seldom needed, therefore computed late
        known: list[Floats] = []
        rows: list[int] = []
        enough = -float(np.log(significance))
        while True:
            beside = _Beside.of(table, [*known, *(_error(n, row) for row in rows)])
            of_rows = np.where(np.isin(np.arange(n), rows), -np.inf, beside.of_readings())
            best = int(np.argmax(of_rows))
            odds = [beside.of_group(columns) for _, columns in changes]
            of_passes = [of for of, (rows_of, _) in zip(odds, changes, strict=True) if rows_of is not None]
            if max([of_rows[best], *of_passes]) < enough:
                break
            late = [(None, columns) for columns in of_run]
            odds += [beside.of_group(columns) for _, columns in late]
            changes += late
            if max(odds, default=-np.inf) > of_rows[best]:
                in_pass, columns = changes.pop(int(np.argmax(odds)))
                wrong = None if in_pass is None else self._of_pass(in_pass)
                if wrong is not None:
                    return [wrong]
                known.append(columns)
            elif len(rows) < max(FEW * n, 6):
                rows.append(best)
            else:
                return []
        slips = _slips(self._without(np.isin(np.arange(n), rows))) if rows else []
        found = []
        for row in rows:
            beside = _Beside.of(table, [*known, *(_error(n, other) for other in rows if other != row)])
            log_odds = float(beside.of_readings()[row])
            if log_odds >= enough:
                found.append(_classified(beside.likeliest(row), row, slips, p_of(log_odds, 0.0)))
        told = [m for m in found if m.off_rad is not None or m.sigma >= BEYOND_TAILS]
        return sorted(told, key=lambda m: -m.sigma)

    def _of_pass(self, rows: Mask) -> WrongReadings | None:
        """Return the likeliest mistake in the pass `rows` (n,); None if effects or chance are likelier."""
        one = _Pass.of(self._without(rows), rows)
        nothing, effects = one.evidence(), list(_of_effects(one))
        mistakes = list(_of_mistakes(one))
        log_mistake, name, off, channels = max(mistakes, key=lambda mistake: mistake[0])
        others = float(logsumexp([nothing, *(log_effect for _, log_effect in effects)]))
        log_looks = float(np.log(len(np.unique(one.table.turn)) * len(mistakes)))
        odds = log_mistake - nothing
        if log_mistake <= others or odds - log_looks <= -np.log(HARDLY_EVER):
            return None
        tied = np.logaddexp(log_mistake, others) + np.log(OFTEN)
        ties = dict.fromkeys(name for name, log_effect in effects if log_effect > tied)
        places = np.flatnonzero(rows)
        return WrongReadings(name, places, channels, off, tuple(ties), p_of(odds, log_looks), np.zeros(0))


@dataclass(frozen=True)
class _Beside:
    """The readings at each noise ratio, with the known columns projected out.

    `weight` is ln of the probability of the ratio.
    """

    seen: tuple[ProjectedReadings, ...]
    weight: Floats

    @classmethod
    def of(cls, table: Table, known: Sequence[Floats]) -> _Beside:
        seen = tuple(table.seen(ratio, known) for ratio in RATIOS)
        evidence = np.array([one.log_evidence for one in seen])
        return cls(seen, evidence - logsumexp(evidence))

    @cached_property
    def _of_readings(self) -> Floats:
        return self.weight[:, None] + [one.of_readings() for one in self.seen]

    def of_readings(self) -> Floats:
        """Return ln of the odds (n,) of an error of each reading, with prior odds of 1/n each."""
        return np.asarray(logsumexp(self._of_readings, axis=0) - np.log(self._of_readings.shape[1]))

    def likeliest(self, row: int) -> ProjectedReadings:
        """Return the item of `seen` whose noise ratio makes an error of the reading `row` most probable."""
        return self.seen[int(np.argmax(self._of_readings[:, row]))]

    def of_group(self, columns: Floats) -> float:
        """Return ln of the odds of a change of the bench, described by `columns` (n, 3, p)."""
        return float(logsumexp(self.weight + [one.of_group(columns) for one in self.seen]))


# --- single readings --------------------------------------------------------------------------------


def _error(n: int, row: int) -> Floats:
    return np.asarray((np.arange(n) == row)[:, None, None] * np.eye(3))


def _moved(table: Table, off_rad: Floats | float) -> Floats:
    """Return the change of the signals (n, 3) if the head angles are changed by `off_rad` (n,)."""
    problem = table.problem
    moved = replace(problem.conditions, angle_rad=problem.conditions.angle_rad + off_rad)
    there = replace(problem, conditions=moved).predict(table.block, problem.prior_mean)
    return np.asarray(there - problem.predict(table.block, problem.prior_mean))


def _slips(table: Table) -> list[tuple[Floats, Floats]]:
    """Return, for each kind of wrong setting, the errors of angles (n,), rad, and signals (n, 3).

    The kinds are slips below half of `MARK_DEG`, with which repeats are still recognised, an angle counted
    backwards, and the neighbouring stops.
    """
    angle, turn = table.problem.conditions.angle_rad, table.turn
    sizes = [slip for slip in SLIPS_RAD.values() if slip < np.radians(MARK_DEG / 2.0)]
    offs = [np.full(len(angle), sign * slip) for slip in sizes for sign in (1.0, -1.0)]
    step = np.where(turn[1:] == turn[:-1], np.diff(angle), 0.0)
    for off in (reflected_rad(angle), np.append(0.0, -step), np.append(step, 0.0)):
        offs.append(np.where(np.abs(off) < min(sizes), np.nan, off))
    return [(off, _moved(table, np.nan_to_num(off))) for off in offs]


def _classified(
    seen: ProjectedReadings, row: int, slips: Sequence[tuple[Floats, Floats]], p: float
) -> WrongReadings:
    """Return the wrong reading `row`: a setting if one of `slips` explains its signals, else an outlier."""
    table, block, pull = seen.table, seen.blocks[row], seen.pulls[row]
    shift = np.linalg.solve(block, pull)
    free = len(seen.pull) - float(np.sum(seen.basis**2)) - 3.0
    noise = float(np.sqrt((seen.square - pull @ shift) / free))
    precision = block / noise**2
    name, channels = MistakeName.OUTLIER, _outlier(shift, precision)
    ties: tuple[str, ...] = ()
    off, least = None, float(special.chdtri(3, HARDLY_EVER))
    for offs, moved in slips:
        expected = moved[row] / table.unit
        known = SLIP_PART * float(np.linalg.norm(expected))
        missed = shift - expected
        chi2 = float(missed @ np.linalg.solve(np.linalg.inv(precision) + known**2 * np.eye(3), missed))
        if np.isfinite(offs[row]) and chi2 < least:
            off, least = float(offs[row]), chi2
    if off is not None:
        name = MistakeName.WRONG_SETTING
        ties = (MistakeName.OUTLIER,) if len(channels) == 1 else ()
        large = np.abs(shift) > SLIP_PART * np.max(np.abs(shift))
        channels = tuple(c for c, of in zip(CHANNELS, large, strict=True) if of)
    sigma = max(abs(shift[CHANNELS.index(c)]) for c in channels) / noise
    return WrongReadings(name, np.array([row]), channels, off, ties, p, table.unit * shift, float(sigma))


def _outlier(shift: Floats, precision: Floats) -> tuple[str, ...]:
    """Return the smallest set of channels whose errors explain a reading."""
    pull = precision @ shift
    for number in (1, 2):
        left = {}
        for chosen in combinations(range(3), number):
            own = list(chosen)
            explained = pull[own] @ np.linalg.solve(precision[np.ix_(own, own)], pull[own])
            left[chosen] = float(shift @ pull - explained)
        best = min(left, key=left.__getitem__)
        if left[best] < special.chdtri(3 - number, HARDLY_EVER):
            return tuple(CHANNELS[i] for i in best)
    return CHANNELS


# --- whole passes -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Pass:
    """One pass, `rows` (n,) of a table, about a block fitted to all other passes, at the likeliest noise ratio."""

    table: Table
    rows: Mask
    ratio: float

    @classmethod
    def of(cls, table: Table, rows: Mask) -> _Pass:
        """Return the pass, with the noise ratio that is most probable for all other readings."""
        free = np.einsum("nk,ij->nikj", np.eye(len(rows))[:, rows], np.eye(3)).reshape(len(rows), 3, -1)
        return cls(table, rows, max(RATIOS, key=lambda ratio: table.seen(ratio, [free]).log_evidence))

    def seen(self, columns: Floats, beyond: Floats | float = 0.0) -> ProjectedReadings:
        """Return the readings of `table` with changes of the pass, `columns` (n, 3, p), projected out.

        The known signals `beyond` (n, 3) in the pass are subtracted first.
        """
        table = replace(self.table, left=self.table.left - beyond * self.rows[:, None])
        return table.seen(self.ratio, more=[columns * self.rows[:, None, None]])

    def evidence(self, columns: Floats | None = None, beyond: Floats | float = 0.0) -> float:
        """Return ln of the evidence of the readings with the changes of the pass in the model (`seen`)."""
        return self.seen(
            np.zeros((len(self.rows), 3, 0)) if columns is None else columns, beyond
        ).log_evidence

    @property
    def another_block(self) -> Floats:
        """The change (n, 3, 12) of the signals if each coefficient changes by its tolerance in the data sheet."""
        columns = np.column_stack([self.table.force, np.ones(len(self.rows))])
        size = sheet_u(np.linalg.norm(self.table.block.K, axis=1))
        each = np.einsum("na,ai,ij->niaj", columns, size, np.eye(3))
        return np.asarray(each.reshape(len(columns), 3, 12))


def _of_mistakes(one: _Pass) -> Iterator[tuple[float, MistakeName, float | None, tuple[str, ...]]]:
    """Yield ln of the evidence of each mistake of a pass, its name, the error of the angle, and the channels."""
    marks = [slip for slip in SLIPS_RAD.values() if slip > SIZES[1] * _zero_shift_rad()]
    for off in (sign * slip for slip in marks for sign in (1.0, -1.0)):
        log_mark = one.evidence(None, _moved(one.table, off)) - float(np.log(2 * len(marks)))
        yield log_mark, MistakeName.WRONG_SETTING, off, ()
    for channel in range(3):
        yield _stuck(one, channel), MistakeName.STUCK_CHANNEL, None, (CHANNELS[channel],)
    yield one.evidence(one.another_block), MistakeName.ANOTHER_BLOCK, None, CHANNELS


def _zero_shift_rad() -> float:
    return CATALOGUE["head_zero_shift"].parameters[0].plausible


def _of_effects(one: _Pass) -> Iterator[tuple[str, float]]:
    """Yield the name of each effect that may act in one pass, with ln of its evidence."""
    table, n = one.table, len(one.rows)
    scale = np.linalg.norm(table.block.K, axis=1)
    zero = [one.evidence(size * _zero_shift_rad() * table.slope[:, :, None]) for size in SIZES]
    yield "head_zero_shift", float(logsumexp(zero) - np.log(len(zero)))
    of_gain, of_turn, of_bias = SHEET_U
    turn = table.rotations * of_turn
    gain = (table.deflection + table.block.U0)[:, :, None] * np.eye(3) * of_gain
    meters = np.concatenate([gain, np.broadcast_to(np.diag(scale * of_bias), gain.shape)], axis=2)
    yield "meters_exchanged", one.evidence(meters)
    for columns in (turn, np.concatenate([turn, meters], axis=2)):
        yield "block_slip", one.evidence(columns, _bent(one, columns, of_turn))
    coefficients = one.another_block.reshape(n, 3, 4, 3)
    for chosen in ([0], [1], [2], [0, 1], [0, 2], [1, 2]):
        yield "scale_step", one.evidence(coefficients[:, :, :, chosen].reshape(n, 3, -1))
    free = np.eye(n)[:, one.rows]
    for channel in range(3):
        yield "unnamed_form", one.evidence(free[:, None, :] * (scale * np.eye(3)[channel])[:, None])


def _bent(one: _Pass, columns: Floats, unit: float) -> Floats:
    """Return the nonlinear part (n, 3) of a rotation of the block, fitted to the pass.

    The first three of `columns` are its derivatives, in a `unit` of rad.
    """
    force, K = one.table.force, one.table.block.K
    bent = np.zeros_like(one.table.left)
    for _ in range(3):  # for a rotation of 1°, each step leaves a hundredth of the error
        seen = one.seen(columns, bent)
        inside = seen.table.whiten(columns * one.rows[:, None, None], seen.white)
        angle = (inside.T @ seen.pull)[:3]
        turned = Rotation.from_rotvec(-unit * angle).apply(force)
        bent = (turned - force) @ K.T - columns[:, :, :3] @ angle
    return bent


def _stuck(one: _Pass, channel: int) -> float:
    """Return ln of the evidence that a `channel` (0, 1, 2) gives one unknown value in the whole pass."""
    table = one.table
    deaf = np.outer(one.rows, np.eye(3)[channel]) == 1.0
    hearing = replace(
        table,
        coefficients=np.where(deaf[:, :, None], 0.0, table.coefficients),
        stand=np.where(deaf[:, :, None], 0.0, table.stand),
        slope=np.where(deaf, 0.0, table.slope),
    )
    same = (SHEET_U[2] * float(np.linalg.norm(table.block.K[channel])) * deaf)[:, :, None]
    return replace(one, table=hearing).evidence(same, np.where(deaf, -table.deflection, 0.0))
