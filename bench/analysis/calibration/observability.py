"""Which unknowns a set of readings determines, and which directions among them leave no trace.

The rank of the Jacobian of the forward model, its columns scaled to unit length. Where readings at which only
the modulus of the specific force is known take part, each adds a row of derivatives of |a|.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from bench.analysis.calibration.design import FIXED, SYMBOLS, FreeRows, Problem, StandUnknown
from bench.analysis.calibration.free import modulus_rows
from bench.analysis.calibration.null_space import MEMBER, Direction, directions_of
from bench.base.arrays import ARCSEC, Floats
from bench.model.block import COEFFICIENTS, Block
from bench.model.conditions import Conditions
from bench.model.geometry import STAND_ANGLES

TRACELESS: Final = 1e-4
"""A direction leaves no trace when its singular value is below this part of the largest.

Angles read back differ from the nominal ones by arcseconds, which lends a null vector about 1e-5 of size.
"""
_NO_COLUMN: Final = 1e-8


@dataclass(frozen=True)
class Observability:
    """Rank of `columns` unknowns, and the directions that leave no trace (as many as the rank falls short)."""

    names: tuple[str, ...]
    rank: int
    directions: tuple[Direction, ...]
    null: Floats

    @property
    def columns(self) -> int:
        """How many unknowns there are."""
        return len(self.names)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The unknowns that take part in a direction without trace: the data alone do not give them."""
        weight = np.abs(self.null).max(axis=1, initial=0.0)
        return tuple(n for n, w in zip(self.names, weight, strict=True) if w > MEMBER)

    @property
    def determined(self) -> tuple[str, ...]:
        """The unknowns that the data alone give."""
        return tuple(name for name in self.names if name not in self.undetermined)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "rank": self.rank,
            "unknowns": self.columns,
            "determined": list(self.determined),
            "undetermined": list(self.undetermined),
            "directions": [
                {"kind": d.kind.name.lower(), "text": d.text(), "members": dict(d.members)}
                for d in self.directions
            ],
        }


# --- columns ----------------------------------------------------------------------------------------


def with_angles(problem: Problem, names: Collection[str]) -> Problem:
    """Return the problem with these stand angles of every mounting as unknowns, and those that it has."""
    taken = {(s.mount, s.column) for s in problem.stand}
    further = tuple(
        StandUnknown(mount, STAND_ANGLES.index(name), ARCSEC)
        for mount in range(len(problem.conditions.mounts))
        for name in STAND_ANGLES
        if name in names and (mount, STAND_ANGLES.index(name)) not in taken
    )
    return replace(problem, stand=problem.stand + further)


@dataclass(frozen=True)
class Columns:
    """Derivatives of readings by unknowns: `rows` (m, p) in unit per SI, one row a signal, and `names` (p,)."""

    rows: Floats
    names: tuple[str, ...]

    def of(self, name: str) -> Floats:
        """Return the column of an unknown, shape (m,)."""
        return np.asarray(self.rows[:, self.names.index(name)])

    def without(self, names: Collection[str]) -> Columns:
        """Return the columns of the other unknowns."""
        kept = [j for j, name in enumerate(self.names) if name not in names]
        return Columns(self.rows[:, kept], tuple(self.names[j] for j in kept))

    def observability(self, block: Block) -> Observability:
        """Return what rows like these determine; `block` tells how a turn of its axes looks."""
        length = np.linalg.norm(self.rows, axis=0)
        seen = length > _NO_COLUMN * max(float(length.max()), 1e-300)
        length = np.where(seen, length, 1.0)
        scaled = np.where(seen, self.rows / length, 0.0)
        _, size, directions = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
        size = np.concatenate([size, np.zeros(len(length) - len(size))])
        null = directions[size <= TRACELESS * max(float(size[0]), 1e-300)].T
        found = directions_of(null, length, self.names, block)
        return Observability(self.names, len(length) - null.shape[1], found, null)


def observability(
    problem: Problem,
    block: Block,
    *,
    modulus: Conditions | None = None,
    common: Collection[str] = (),
    settings: bool = False,
) -> Observability:
    """Return what readings under the problem's conditions determine of its unknowns.

    Taken at zero stand angles, where the null vectors are exact, and at the coefficients of `block`.
    `modulus` are further readings of which only |a| = 1 g is used; stand angles named in `common` are one
    unknown for all mountings; with `settings` the setting error of each point is an unknown, the same in every
    pass. Raises `KeyError` for an installation that the model lacks.
    """
    columns = columns_of(problem, block, modulus)
    for name in common:
        columns = _made_common(columns, SYMBOLS[name])
    if settings:
        columns = _with_settings(columns, problem, block)
    return columns.observability(block)


def columns_of(problem: Problem, block: Block, modulus: Conditions | None = None) -> Columns:
    """Return the derivatives by all unknowns of a problem at zero stand angles; `modulus` as above.

    Free readings of the problem take part by the modulus, too.
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
    return Columns(np.vstack(parts), (*COEFFICIENTS, *problem.names()))


def _made_common(columns: Columns, symbol: str) -> Columns:
    own = [name for name in columns.names if name.startswith(f"{symbol}[")]
    merged = sum((columns.of(name) for name in own), np.zeros(len(columns.rows)))
    rest = columns.without(own)
    return Columns(np.column_stack([rest.rows, merged]), (*rest.names, f"{symbol}[all]"))


def _with_settings(columns: Columns, problem: Problem, block: Block) -> Columns:
    conditions = problem.conditions
    slope = problem.slope(block, problem.prior_mean)
    places = np.stack([conditions.mount, conditions.point], axis=1)
    added, names = [], []
    for mount, point in dict.fromkeys(map(tuple, places.tolist())):
        here = np.all(places == (mount, point), axis=1)
        column = np.zeros(len(columns.rows))
        column[: slope.size] = (slope * here[:, None]).ravel()
        added.append(column)
        names.append(f"alpha4[{conditions.mounts[mount]}, point {point}]")
    return Columns(np.column_stack([columns.rows, *added]), (*columns.names, *names))
