"""Readings as the early warning keeps them, and what it supposes of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import Floats
from bench.model import Conditions
from bench.run.watch.expectation import Expectation, ExpectedPose
from bench.run.watch.suppositions import Kind, Supposed

SHIFTS: Final = 5
"""So many shifts of whatever size fits: the block about the shaft, tilted, each channel."""

AS_IT_IS, ABSENT = SHIFTS, SHIFTS + 1
"""In the place of a shift: a reading that is taken as it stands, one that is left out."""


@dataclass
class Sighting:
    """A reading as the early warning keeps it.

    `new_mount` says that the block was mounted before it, `loosened` (12,) by how much the coefficients may
    have moved, as variances. `taken`: the model has learnt from it; `poorly_known`: when it was taken the
    model could not yet have seen a mistake in it; `struck`: known to be wrong, or taken again.
    `poses` are as recorded, with the head's sense reversed, in each of the other installations, and with the head
    where it may have been set instead.
    `sat_before` is the installation of the mounting before, `last_rad` where the head stood at the reading
    before on this mounting, `pivot_rad` at the last that fitted, `next_rad` where it goes next, None where there
    is none.
    """

    place: str
    row: Conditions
    signal_v: Floats
    pose: ExpectedPose
    new_mount: bool
    loosened: Floats
    reading_place: tuple[int, str, int, int] = (0, "", 0, 0)
    sat_before: str | None = None
    last_rad: float | None = None
    pivot_rad: float | None = None
    next_rad: float | None = None
    taken: bool = False
    poorly_known: bool = False
    struck: bool = False
    poses: ExpectedPose | None = None

    @property
    def installation(self) -> str:
        """The installation that the record states."""
        return self.row.mounts[0].installation

    @property
    def angle_rad(self) -> float:
        """The angle that was read back."""
        return float(self.row.angle_rad[0])


@dataclass(frozen=True)
class Suspect:
    """A supposition that explains a reading, and its cost.

    `earlier` is the reading that is at fault instead. `moved_rad` with its uncertainty is set where the head or
    the block is supposed off by an angle. `stops` says that no effect looks like it: a run is stopped for it;
    `free` that it is a shift of whatever size fits.
    """

    text: str
    kind: Kind
    cost: float
    stops: bool = True
    earlier: int | None = None
    moved_rad: float | None = None
    u_rad: float = 0.0
    free: bool = False


@dataclass(frozen=True)
class Member:
    """A supposition that a replay follows: of every reading since a certain one, or of one `reading` alone.

    `cabling` (3, 3) makes the signals right, `pose` is the number of the pose among those of a sighting, `shift`
    that of a shift of whatever size fits, or `ABSENT`.
    """

    supposed: Supposed
    cabling: Floats = field(default_factory=lambda: np.eye(3))
    pose: int = 0
    since: int = 0
    reading: int | None = None
    shift: int = AS_IT_IS

    def pose_at(self, i: int) -> int:
        """Return the number of the pose at the reading `i`."""
        return self.pose if i >= self.since and self.reading in (None, i) else 0

    def shift_at(self, i: int) -> int:
        """Return the number of the shift at the reading `i`."""
        return self.shift if self.reading == i else AS_IT_IS


@dataclass(frozen=True)
class Replay:
    """All readings gone through once more: the state of each member at the end and what it took in.

    `cost` (m,) of all readings, `before` that of the base member without the last one; `taken` (n, m).
    """

    state: Expectation
    cost: Floats
    before: float
    taken: NDArray[np.bool_]
