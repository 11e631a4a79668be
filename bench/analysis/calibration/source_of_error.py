"""An error that the readings do not show, and what it adds to the coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench.base.arrays import Floats, u_of
from bench.base.numbers import finite_or_none
from bench.model.block import COEFFICIENTS


@dataclass(frozen=True)
class SourceOfError:
    """An error that these readings do not show, and what it adds: `covariance` (12, 12) of the coefficients.

    `size` says in words how large it is taken, `origin` from where; `prior` that nobody stated it for this bench.
    `cancels` tells that it acts alike wherever the same meters read the block. `of_block` (12, q) is there for
    what the block itself brings wherever it goes: what each draw of it, one u large, adds to the coefficients.
    """

    name: str
    symbol: str
    size: str
    origin: str
    prior: bool
    dof: float
    covariance: Floats
    cancels: bool = False
    of_block: Floats | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "name": self.name,
            "symbol": self.symbol,
            "size": self.size,
            "origin": self.origin,
            "prior": self.prior,
            "dof": finite_or_none(self.dof),
            "u": dict(zip(COEFFICIENTS, u_of(self.covariance).tolist(), strict=True)),
            "cancels_with_the_same_meters": self.cancels,
        }
