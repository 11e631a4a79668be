"""What is found out about free positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats, Ints
from bench.diagnosis.free_records import OWN, BetweenRecords, FreeRows
from bench.diagnosis.gap import Gap
from bench.diagnosis.result import EffectValue, Verdict
from bench.model import CATALOGUE, AppliedEffect, Block

OUTLIER: Final = "outlier"


@dataclass(frozen=True)
class FreeFound:
    """What was found: an effect of the catalogue, or what has no name; fields as those of `NamedEffect`.

    `applied` has an entry for all sensors alike, or one for each with values of its own.
    """

    name: str
    channels: tuple[str, ...]
    cannot_tell_from: tuple[str, ...]
    parameters: tuple[EffectValue, ...]
    p: float
    p_all_looks: float
    rho: float
    words: str
    applied: tuple[AppliedEffect, ...] = ()

    @property
    def in_catalogue(self) -> bool:
        """Whether it has a name."""
        return self.name in CATALOGUE


@dataclass(frozen=True)
class FreeFit:
    """What a model gives: `block` of each sensor, `u` (sensors, 12) of it, what is `left` of |a| - 1 (N,), g."""

    block: tuple[Block, ...]
    u: Floats
    left: Floats


@dataclass(frozen=True)
class FreeDiagnosis:
    """The diagnosis of free positions.

    `noise_g` is the scatter of a position beside what was found, `stated_g` what its samples imply, NaN where not
    given. `columns` holds for each thing found what its parts do to |a|, (N, p). `apart` says of each position that
    was left out why, `left_out` (k, 2) of which table it is, and its row there. `before` and
    `after` are fits by the model given and with what was found.
    """

    source: str
    rows: FreeRows
    apart: tuple[str, ...]
    left_out: Ints
    found: tuple[FreeFound, ...]
    columns: tuple[Floats, ...]
    gap: Gap
    noise_g: float
    stated_g: float
    freedom: int
    threshold: float
    before: FreeFit
    after: FreeFit
    between: BetweenRecords | None
    where: tuple[Mapping[str, Any], ...]
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """One of agrees, mistake, named, confounded, unknown."""
        return "mistake" if self.apart else self.of_rest

    @property
    def of_rest(self) -> Verdict:
        """The verdict on what is not left out."""
        if not all(one.in_catalogue for one in self.found):
            return "unknown"
        if not self.found:
            return "agrees"
        tied = any(one.cannot_tell_from for one in self.found)
        return "named" if not tied and self.gap.shrinks else "confounded"

    @property
    def records(self) -> int:
        """How many records there are."""
        return len(np.unique(self.rows.record))

    def applied_to(self, sensor: int) -> tuple[AppliedEffect, ...]:
        """Return what was found of a sensor, counted from 0: of all alike, or its own."""
        mine = ((), (f"sensor {sensor + 1}",))
        return tuple(a for one in self.found for a in one.applied if a.installations in mine)

    @property
    def alike(self) -> bool:
        """Whether all that was found is the same in all sensors."""
        return not any(a.installations for one in self.found for a in one.applied)


def place_of(sensor: int) -> slice:
    """Return where the nine coefficients of a sensor stand among those of all."""
    return slice(OWN * sensor, OWN * (sensor + 1))
