"""Observability: which unknowns the readings determine, which are assumed, and the cost of a wrong assumption."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, Floats
from bench.base.languages import message
from bench.calibration.design import FIXED, SYMBOLS, FreeRows, Problem, StandUnknown
from bench.calibration.free import modulus_rows
from bench.calibration.result import CalibrationError
from bench.model.conditions import Conditions
from bench.model.geometry import COEFFICIENTS, STAND_ANGLES, Block, hidden_axes

MEMBER: Final = 0.02
"""An unknown is a member of a null direction if its part exceeds this fraction of the largest part."""
_IN_SPAN: Final = 1e-3
_NOTHING: Final = 1e-6
_MOST_NAMED: Final = 4


class DirectionKind(StrEnum):
    """Kinds of null directions: changes of the unknowns that leave all readings unchanged."""

    UNSEEN = message("no reading depends on it")
    TURN = message("a common turn of the block's axes")
    ALIKE = message("the readings cannot tell them apart")
    MIXED = message("is indistinguishable from a change of coefficients")


@dataclass(frozen=True)
class Direction:
    """A null direction: a change of unknowns that changes no reading.

    `members` maps names to changes, in SI units and the unit of the signals: angles and effects before
    coefficients, the largest first. If the direction is a turn of the block's axes, they are changes per
    radian of the turn, else per unit of the first member. `axis` is the axis of a turn, on block axes, up to
    its sign. `only` says which combination of two angles the readings do show ("sum" or "difference"), else
    it is empty.
    """

    kind: DirectionKind
    members: Mapping[str, float]
    axis: tuple[float, float, float] | None = None
    only: str = ""

    @property
    def others(self) -> list[str]:
        """Names of the stand angles, settings and effects in the direction, except those with small changes."""
        return self._telling([name for name in self.members if name not in COEFFICIENTS])

    @property
    def coefficients(self) -> list[str]:
        """Names of the coefficients in the direction, except those with small changes."""
        return self._telling([name for name in self.members if name in COEFFICIENTS])

    def _telling(self, names: list[str]) -> list[str]:
        largest = max((abs(self.members[name]) for name in names), default=0.0)
        return [name for name in names if abs(self.members[name]) > MEMBER * largest]

    def text(self, unit: str = "V") -> str:
        """Return the direction in words; `unit` is the unit of the signals."""
        if self.kind is DirectionKind.TURN and not self.others:
            return message(f"{self.kind} about {axis_in_words(self.axis)}: {self._changed(unit)}")
        if self.kind is DirectionKind.UNSEEN or not self.others:
            return f"{', '.join(self.others or self.coefficients)}: {self.kind}"
        if self.kind is DirectionKind.ALIKE:
            return f"{self._shown()}; {self.kind}"
        if self.kind is DirectionKind.TURN:
            return message(
                f"{self.kind} about {axis_in_words(self.axis)} ({self._shown()}): {self._changed(unit)}"
            )
        return message(
            f"a change of {self._together()} is indistinguishable from a change of coefficients: "
            f"{self._changed(unit)}"
        )

    def _shown(self) -> str:
        names = self.others
        return (
            message(f"of {names[0]} and {names[1]} only the {self.only} is shown")
            if self.only
            else self._together()
        )

    def _together(self) -> str:
        names = self.others
        if len(names) == 1:
            return names[0]
        ratios = " : ".join(
            f"{self.members[name] / self.members[names[0]]:.2g}" for name in names[:_MOST_NAMED]
        )
        first, more = ", ".join(names[:_MOST_NAMED]), len(names) - _MOST_NAMED
        if more <= 0:
            return message(f"{first} in the ratio {ratios}")
        return message(f"{first} in the ratio {ratios} and {more} more")

    def _changed(self, unit: str) -> str:
        """Return the changes of coefficients in words, per arcsecond if the first member is an angle."""
        angle = self.kind is DirectionKind.TURN or self.others[0].startswith(("alpha", "mounting"))
        size = ARCSEC if angle else 1.0
        micro, shown_unit = (1e6, "µV") if unit == "V" else (1.0, unit)
        changes = (
            message(
                f"{self.members[name] * size * micro:+.3g} {shown_unit}{'' if name[0] == 'U' else '/g'} in {name}"
            )
            for name in self.coefficients[:_MOST_NAMED]
        )
        joined = ", ".join(changes)
        return (
            message(f"1 arcsec is {joined}") if angle else message(f"1 of {self.others[0]} (SI) is {joined}")
        )


class _Directions:
    """A null space, resolved into named directions with as few members as possible.

    `null` (p, d) is an orthonormal basis of the space that remains. All vectors are in scaled unknowns: the
    unknowns times `length` (p,), the norms of their columns.
    """

    def __init__(self, null: Floats, length: Floats, names: tuple[str, ...], block: Block) -> None:
        self._whole = self._null = null
        self._length = length
        self._names = names
        self._fixed = np.array([name in COEFFICIENTS for name in names])
        self._turns = length[:FIXED, None] * _turns(block)

    def all(self) -> tuple[Direction, ...]:
        unseen = np.linalg.norm(self._null, axis=1) > 1 - _IN_SPAN
        found = []
        if np.any(unseen):
            members = dict.fromkeys(np.array(self._names)[unseen].tolist(), 1.0)
            found = [Direction(DirectionKind.UNSEEN, {name: size}) for name, size in members.items()]
            self._take_out(np.eye(len(self._names))[:, unseen])
        alike = self._null @ _null_space(self._null[self._fixed])
        found += [self._direction(DirectionKind.ALIKE, vector) for vector in self._sparse(alike)]
        self._take_out(alike)
        found += self._take_turns()
        found += [self._direction(DirectionKind.MIXED, vector) for vector in self._sparse(self._null)]
        return tuple(found)

    def _take_turns(self) -> list[Direction]:
        """Return the turns of the block that the null space contains, and remove them from it."""
        part = self._null[self._fixed]
        if not part.shape[1]:
            return []
        outside = self._turns - part @ np.linalg.lstsq(part, self._turns, rcond=None)[0]
        axes = _plain_basis(_null_space(outside / np.linalg.norm(self._turns)))
        vectors = self._null @ np.linalg.lstsq(part, self._turns @ axes, rcond=None)[0]
        found = []
        for axis, vector in zip(axes.T, vectors.T, strict=True):
            turn = self._direction(DirectionKind.TURN, vector)
            found.append(replace(turn, axis=(float(axis[0]), float(axis[1]), float(axis[2]))))
        self._take_out(vectors)
        return found

    def _take_out(self, vectors: Floats) -> None:
        """Reduce the null space to its part orthogonal to `vectors` (p, k)."""
        if vectors.shape[1]:
            self._null = self._null @ _null_space(vectors.T @ self._null)

    def _sparse(self, basis: Floats) -> list[Floats]:
        """Return a basis of the same space: each vector has an unknown of its own, zero in all other vectors.

        A coefficient is chosen as this unknown only if no stand angle or effect can be.
        """
        vectors = basis.copy()
        free = np.ones(len(vectors), dtype=bool)
        for k in range(basis.shape[1]):
            weight = np.abs(vectors[:, k:]).max(axis=1) * free
            nuisance = weight * ~self._fixed
            row = int(np.argmax(nuisance if nuisance.max() > _IN_SPAN else weight))
            column = k + int(np.argmax(np.abs(vectors[row, k:])))
            vectors[:, [k, column]] = vectors[:, [column, k]]
            vectors[:, k] /= vectors[row, k]
            rest = [j for j in range(basis.shape[1]) if j != k]
            vectors[:, rest] -= np.outer(vectors[:, k], vectors[row, rest])
            free[row] = False
        return list(vectors.T)

    def _direction(self, kind: DirectionKind, vector: Floats) -> Direction:
        """Return a vector as a direction: stand angles, then effects, then coefficients, each largest first."""
        weight = np.abs(vector)
        weight[weight < _NOTHING * weight.max()] = 0.0
        change = vector / self._length
        rank = {
            j: (bool(self._fixed[j]), -round(float(weight[j]), 6), j) for j in range(len(weight)) if weight[j]
        }
        order = sorted(rank, key=rank.__getitem__)
        lead = float(np.sign(change[order[0]])) if kind is DirectionKind.TURN else change[order[0]]
        members = {self._names[j]: float(change[j] / lead) for j in order}
        found = Direction(kind, members)
        return replace(found, only=self._only([self._names.index(name) for name in found.others], change))

    def _only(self, pair: list[int], change: Floats) -> str:
        """Return which combination of two unknowns the readings show: "sum", "difference" or "" for neither."""
        if len(pair) != 2:
            return ""
        ratio = change[pair[1]] / change[pair[0]]
        kept = self._whole[pair] / self._length[pair, None]
        if abs(abs(ratio) - 1) > MEMBER or np.linalg.norm(
            kept[1] - ratio * kept[0]
        ) > MEMBER * np.linalg.norm(kept):
            return ""
        return "sum" if ratio < 0 else "difference"


def _turns(block: Block) -> Floats:
    """Return the changes of coefficients (12, 3) for turns by 1 rad about x, y, z: dK = K [w]x."""
    cross = np.array([np.cross(np.eye(3), axis) for axis in np.eye(3)])
    columns: Floats = np.zeros((FIXED, 3))
    columns[:9] = np.stack([(block.K @ matrix).ravel() for matrix in cross], axis=1)
    return columns


def _null_space(matrix: Floats) -> Floats:
    """Return an orthonormal basis (n, d) of the vectors that `matrix` (m, n) maps to nearly zero."""
    _, size, directions = np.linalg.svd(matrix)
    size = np.concatenate([size, np.zeros(len(directions) - len(size))])
    return np.asarray(directions[size < _IN_SPAN].T)


def _plain_basis(axes: Floats) -> Floats:
    """Return a basis of the span of axes (3, d); it contains each of x, y and z that lies in the span."""
    within = [k for k in range(3) if np.linalg.norm(axes[k]) > 1 - _IN_SPAN]
    plain = np.eye(3)[:, within]
    rest = axes @ _null_space(plain.T @ axes) if within else axes
    return np.hstack([plain, rest])


def axis_in_words(axis: tuple[float, float, float] | None) -> str:
    """Return an axis in words: "y", or "the axis 0.71 y -0.71 z"."""
    parts = [(a, name) for a, name in zip(axis or (), "xyz", strict=False) if abs(a) > MEMBER]
    if len(parts) == 1:
        return parts[0][1]
    first = parts[0][0]
    sum_of_axes = " ".join(f"{np.sign(first) * a:+.2f} {name}" for a, name in parts).removeprefix("+")
    return message(f"the axis {sum_of_axes}")


TRACELESS: Final = 1e-4
"""A direction is null if its singular value is below this fraction of the largest.

Angles read back differ from nominal ones by arcseconds, which gives a null vector a singular value of about
1e-5.
"""
_NO_COLUMN: Final = 1e-8


@dataclass(frozen=True)
class Observability:
    """The rank of the readings' derivatives by the unknowns `names`, and the null directions.

    There are as many null directions as the number of unknowns minus the rank. `null` (p, d) is an orthonormal
    basis of the null space, in unknowns scaled so that their columns have unit length.
    """

    names: tuple[str, ...]
    rank: int
    directions: tuple[Direction, ...]
    null: Floats

    @property
    def columns(self) -> int:
        """Number of unknowns."""
        return len(self.names)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The unknowns that the data alone do not determine, because they occur in a null direction."""
        weight = np.abs(self.null).max(axis=1, initial=0.0)
        return tuple(n for n, w in zip(self.names, weight, strict=True) if w > MEMBER)

    @property
    def determined(self) -> tuple[str, ...]:
        """The unknowns that the data alone determine."""
        return tuple(name for name in self.names if name not in self.undetermined)


# --- columns ----------------------------------------------------------------------------------------


def with_angles(problem: Problem, names: Collection[str]) -> Problem:
    """Return the problem with the stand angles `names` of every mounting as additional unknowns."""
    taken = {(s.mount, s.column) for s in problem.stand}
    further = tuple(
        StandUnknown(mount, STAND_ANGLES.index(name), ARCSEC)
        for mount in range(len(problem.conditions.mounts))
        for name in STAND_ANGLES
        if name in names and (mount, STAND_ANGLES.index(name)) not in taken
    )
    return replace(problem, stand=problem.stand + further)


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives of signals by unknowns: `rows` (m, p), one row per signal, in the signal's unit per SI unit.

    `names` (p,) are the unknowns.
    """

    rows: Floats
    names: tuple[str, ...]

    def of(self, name: str) -> Floats:
        """Return the derivatives of all readings by the unknown `name`, shape (m,)."""
        return np.asarray(self.rows[:, self.names.index(name)])

    def without(self, names: Collection[str]) -> Sensitivities:
        """Return the sensitivities without the columns of the unknowns `names`."""
        kept = [j for j, name in enumerate(self.names) if name not in names]
        return Sensitivities(self.rows[:, kept], tuple(self.names[j] for j in kept))

    def observability(self, block: Block) -> Observability:
        """Return the observability from `rows`; `block` serves to recognise turns of the block's axes."""
        length = np.linalg.norm(self.rows, axis=0)
        seen = length > _NO_COLUMN * max(float(length.max()), 1e-300)
        length = np.where(seen, length, 1.0)
        scaled = np.where(seen, self.rows / length, 0.0)
        _, size, directions = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
        size = np.concatenate([size, np.zeros(len(length) - len(size))])
        null = directions[size <= TRACELESS * max(float(size[0]), 1e-300)].T
        found = _Directions(null, length, self.names, block).all()
        return Observability(self.names, len(length) - null.shape[1], found, null)


def observability(problem: Problem, block: Block, *, modulus: Conditions | None = None) -> Observability:
    """Return which of the problem's unknowns are determined by readings under the problem's conditions.

    The derivatives are taken at zero stand angles, where null vectors are exact, for the coefficients of `block`.
    `modulus` are additional readings of which only |a| = 1 g is used. Raises `KeyError` for an installation that
    the model lacks.
    """
    return columns_of(problem, block, modulus).observability(block)


def columns_of(problem: Problem, block: Block, modulus: Conditions | None = None) -> Sensitivities:
    """Return the derivatives by all unknowns of a problem at zero stand angles.

    `modulus` is as in `observability`. Free readings of the problem contribute by their modulus, too.
    """
    others = problem.prior_mean
    parts = [np.zeros((0, FIXED + len(others)))]
    if len(problem.conditions):
        parts.append(problem.jacobian(block, others).reshape(-1, parts[0].shape[1]))
    typical = float(np.max(np.abs(block.K)))
    if problem.free is not None:
        parts.append(typical * modulus_rows(problem, block, others).jacobian)
    if modulus is not None:
        level = np.zeros((len(modulus.mounts), len(STAND_ANGLES)))
        free = FreeRows(problem.model.readings(block, modulus, level), modulus)
        parts.append(typical * modulus_rows(replace(problem, free=free), block, others).jacobian)
    return Sensitivities(np.vstack(parts), (*COEFFICIENTS, *problem.names()))


# --- assumptions in words -------------------------------------------------------------------------


MATTERS: Final = 0.02
"""A coefficient is named if it changes by more than this fraction of the largest change."""
MOST_NAMED: Final = 8
"""Largest number of stand angles that are named in words; more are listed by their symbols."""

GAIN: Final = message("voltmeter gain: 1 ppm of it is 1 ppm of every coefficient, and no reading shows it")
GRAVITY: Final = message(
    "local gravity: a wrong value changes only what is computed in m/s^2, as coefficients are per local g"
)


def require_rank(force: Floats) -> None:
    """Raise `CalibrationError` if specific forces (n, 3) do not determine the twelve coefficients.

    The error names the coefficients and axes that are not determined.
    """
    hidden = hidden_axes(force)
    if not hidden:
        return
    axes = [axis for axis in hidden if axis != "0"]
    lost = [f"K{i}{axis}" for i in "xyz" for axis in axes]
    raise CalibrationError(
        f"{len(force)} reading{' does' if len(force) == 1 else 's do'} not determine "
        f"{', '.join(lost) or 'the biases'}: the acceleration along "
        f"{', '.join(axes) or 'every axis'} hardly changes; add the other installation or further angles "
        "to the procedure"
    )


def assumptions(problem: Problem, block: Block, gain: Floats, unit: str) -> tuple[str, ...]:
    """Return sentences on the assumptions of the fit, each with the change of coefficients if it is wrong.

    `gain` (12, n, 3) is the estimator's map from readings to coefficients.
    """
    unknown = {STAND_ANGLES[s.column] for s in problem.stand}
    assumed = [name for name in _ASSUMED if name not in unknown]
    columns = columns_of(with_angles(problem, assumed), block)
    beyond = [name for name in columns.names if name.startswith(tuple(f"{SYMBOLS[a]}[" for a in assumed))]
    sentences = [_absent(problem, columns, block, gain, unit, name) for name in assumed]
    sentences += _undetermined(columns.without(beyond).observability(block), unit)
    sentences += [
        GAIN,
        message(f"voltmeter offset: it adds fully to the biases, {unit} for {unit}, and no reading shows it"),
        GRAVITY,
    ]
    return tuple(sentences)


_ASSUMED: Final = ("mounting_roll",)
"""Stand angles that every bracket has and that a bench file may leave out."""


def unseen_coefficients(problem: Problem, block: Block) -> Floats:
    """Return d changes (12, d) of the coefficients that readings cannot distinguish from stand angles.

    The third mounting angle counts as unknown, too. In each change the largest element equals the largest of K.
    """
    if problem.upper:
        return np.zeros((FIXED, 0))
    columns = columns_of(with_angles(problem, _ASSUMED), block)
    length = np.linalg.norm(columns.rows, axis=0)
    found = columns.observability(block).null / np.where(length > 0, length, np.inf)[:, None]
    basis, size, _ = np.linalg.svd(found[:FIXED], full_matrices=False)
    basis = basis[:, size > _IN_SPAN * max(float(size.max(initial=0.0)), 1e-300)]
    return np.asarray(basis * (np.max(np.abs(block.K)) / np.max(np.abs(basis), axis=0, initial=1e-300)))


def _absent(
    problem: Problem, columns: Sensitivities, block: Block, gain: Floats, unit: str, name: str
) -> str:
    """Return a sentence on a stand angle assumed zero, with the change of coefficients per arcsecond."""
    oriented = gain[:FIXED].reshape(FIXED, -1)
    mounts = problem.conditions.mounts
    parts = []
    for installation in dict.fromkeys(mount.installation for mount in mounts):
        own = [mount for mount in mounts if mount.installation == installation]
        # the modulus does not depend on the stand's angles: its rows, after those of the gain, do not change
        shifts = [columns.of(f"{SYMBOLS[name]}[{mount}]")[: oriented.shape[1]] * ARCSEC for mount in own]
        change = max((oriented @ shift for shift in shifts), key=lambda one: float(np.max(np.abs(one))))
        largest = float(np.max(np.abs(change)))
        changed = [j for j in np.argsort(-np.abs(change)) if abs(change[j]) > max(MATTERS * largest, 1e-15)]
        if changed:
            where = message(f"one of the {len(own)} mountings") if len(own) > 1 else ""
            where = f"{where} in installation {installation}".strip().removeprefix("in ")
            what = ", ".join(f"{_small(change[j], unit)}/g into {COEFFICIENTS[j]}" for j in changed[:3])
            parts.append(message(f"1 arcsec in {where} puts {what}"))
    return (
        f"{name} ({SYMBOLS[name]}, the third mounting angle) is assumed zero and "
        f"{_shown(columns, oriented.shape[1], block, name)}: "
        + ("; ".join(parts) if parts else "it does not act here")
    )


def _shown(columns: Sensitivities, oriented: int, block: Block, name: str) -> str:
    """Return in words how well readings show the assumed angle `name`, up to a common turn of all axes."""
    if _is_hidden(columns, block, name):
        return message("nothing in these readings shows it")
    if not _is_hidden(Sensitivities(columns.rows[:oriented], columns.names), block, name):
        return message("these readings would show it if the bench file stated its size")
    pairs = [
        f"the {d.only} of {' and '.join(sorted(d.others))}"
        for d in columns.observability(block).directions
        if d.kind is DirectionKind.TURN and d.only and d.others[0].startswith(f"{SYMBOLS[name]}[")
    ]
    what = " and ".join(pairs) or message("the part other than a common turn of the block's axes")
    return message(
        f"of it the readings that joined by |a| = 1 g would show {what}, if the bench file stated its size; "
        "until then it changes the coefficients"
    )


def _is_hidden(columns: Sensitivities, block: Block, name: str) -> bool:
    found = columns.observability(block).directions
    hidden = {member for d in found if d.kind is not DirectionKind.TURN for member in d.members}
    return any(member.startswith(f"{SYMBOLS[name]}[") for member in hidden)


def _small(value: float, unit: str) -> str:
    """Return a small amount of a signal as text, volts in microvolts."""
    return f"{value * 1e6:+.3g} µV" if unit == "V" else f"{value:+.3g} {unit}"


def _together(names: list[str]) -> str:
    """Return stand angles in words, or by their symbols if there are many."""
    if len(names) <= MOST_NAMED:
        return ", ".join(names)
    symbols = dict.fromkeys(name.partition("[")[0] for name in names)
    mountings = dict.fromkeys(name.partition("[")[2] for name in names)
    return message(f"{', '.join(symbols)} of {len(mountings)} mountings")


def _undetermined(found: Observability, unit: str) -> list[str]:
    """Return sentences on unknowns confined only by limits: one for all turns, one per other direction."""
    turns = [d for d in found.directions if d.kind is DirectionKind.TURN]
    sentences = []
    if turns:
        taking_part = {member for d in turns for member in d.others}
        names = _together([name for name in found.names if name in taking_part])
        axes = ", ".join(axis_in_words(d.axis) for d in turns)
        sentences.append(
            message(
                f"{names}: in some combination a common turn of the block's axes (about {axes}), which no "
                "reading shows; only the bench file limits it"
            )
        )
    return sentences + [
        message(f"{d.text(unit)}; only the bench file limits it")
        for d in found.directions
        if d.kind is not DirectionKind.TURN
    ]
