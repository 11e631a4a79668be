"""What is found out about free positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats, Ints
from bench.base.numbers import without_infinity
from bench.diagnosis.free_records import OWN, BetweenRecords, FreeRows
from bench.diagnosis.gap import Gap
from bench.diagnosis.result import EffectValue, Verdict, nested
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
    values: tuple[EffectValue, ...]
    p: float
    p_all_looks: float
    rho: float
    words: str
    applied: tuple[AppliedEffect, ...] = ()

    @property
    def parameters(self) -> dict[str, Any]:
        """The values by sensor (where each has its own), parameter and channel."""
        return nested(self.values)

    @property
    def in_catalogue(self) -> bool:
        """Whether it has a name."""
        return self.name in CATALOGUE

    def to_dict(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "name": self.name,
            "channels": list(self.channels),
            "cannot_tell_from": list(self.cannot_tell_from),
            "parameters": self.parameters,
            "p": self.p,
            "p_all_looks": self.p_all_looks,
            "rho": self.rho,
            "words": self.words,
        }


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

    def to_dict(self) -> dict[str, Any]:
        """Return the promised result; what free positions alone cannot have is null or empty."""
        nothing: dict[str, Any] = {
            "channels": [],
            "cannot_tell_from": [],
            "parameters": {},
            "p": None,
            "p_all_looks": None,
        }
        outliers = [{"name": OUTLIER, **nothing, "words": words} for words in self.apart]
        whole: dict[str, Any] = {
            "verdict": self.verdict,
            "where": [dict(one) for one in self.where],
            "effects": [*outliers, *(one.to_dict() for one in self.found)],
            "next_measurement": None,
            "hidden": [name for name, effect in CATALOGUE.items() if effect.subsystem.value != "block"],
            "gap": self.gap.to_dict(),
            "model": None,
            "noise": {"reading": self.noise_g, "unit": "g", "stated": self.stated_g, "dof": self.freedom},
            "between_records": None if self.between is None else self.between.to_dict(),
            "sensors": self.rows.sensors,
            "records": self.records,
            "threshold": self.threshold,
            "notes": list(self.notes),
            "source": self.source,
        }
        return {key: without_infinity(value) for key, value in whole.items()}


def place_of(sensor: int) -> slice:
    """Return where the nine coefficients of a sensor stand among those of all."""
    return slice(OWN * sensor, OWN * (sensor + 1))
