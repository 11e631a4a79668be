"""Mistakes that the early warning supposes, and readings as it keeps them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import permutations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import CHANNELS, Floats
from bench.model.conditions import Conditions
from bench.model.geometry import Installation
from bench.readings.mistaken import EXCHANGED, REVERSED, SLIPS_RAD, Wiring, reflected_rad
from bench.run.watch.expectation import Expectation, ExpectedPose
from drivers.angles import format_dms, wrapped_rad


class Kind(StrEnum):
    """Kinds of mistakes, as signs name them beside the words."""

    CABLING = "cabling"
    ROTATION = "rotation"
    INSTALLATION = "installation"
    ORIENTATION = "orientation"
    NOT_TURNED = "not_turned"
    NEXT_POINT = "next_point"
    WRONG_WAY = "wrong_way"
    SLIP = "slip"
    MOVED = "moved"
    TILTED = "tilted"
    CHANNEL = "channel"
    EARLIER = "earlier"


LASTING: Final = frozenset({Kind.CABLING, Kind.ROTATION, Kind.INSTALLATION, Kind.ORIENTATION})
"""Mistakes that stay until they are mended; the others are those of one reading."""

FREE: Final = frozenset({Kind.MOVED, Kind.TILTED, Kind.CHANNEL})
"""Shifts of whatever size fits: no rivals of a mistake of one certain size that fits better."""

UNLIKELY: Final[Mapping[str, float]] = {Kind.ORIENTATION: 5.0, Kind.SLIP: 1.0, Kind.EARLIER: 2.0}
"""What a kind costs beforehand (-2 ln of its odds against the plainest ones)."""

FIRST_ORIENTATION: Final = 3.0
"""What it costs more in the first mounting, where nothing known of the block tells it from the cables."""

OTHER_INSTALLATION: Final = 4.0
"""What an installation costs beforehand in which the block did not sit before."""

REVERSED_MEANWHILE: Final = 7.0
"""What it costs that wires of one channel were reversed after readings of the mounting that fitted: a head that was
not turned is the plainer cause where the signal of a channel changes its sign only."""

SAT_RIGHT: Final = 12.0
"""What it costs that a block sits otherwise for one reading, after others of its mounting fitted."""

SAME_RAD: Final = float(np.radians(0.5))
"""Angles nearer than this are one supposition."""


@dataclass(frozen=True)
class Supposed:
    """A supposition in words, its kind, and what it costs beforehand."""

    text: str
    kind: Kind
    unlikely: float = 0.0


@dataclass(frozen=True)
class Elsewhere:
    """A reading supposed to have been taken with the block in another `label`, the head `off_rad` away."""

    supposed: Supposed
    label: str
    off_rad: float = 0.0


def _said(wiring: Wiring) -> str:
    """Say what is wrong with the cables."""
    match wiring.channels:
        case (one,):
            return f"channel {one} is reversed"
        case one, other:
            return f"channels {one} and {other} are swapped"
    return f"the channels are exchanged in turn: {wiring.shown}"


CABLINGS: Final[Mapping[str, Floats]] = {_said(wiring): wiring.matrix for wiring in (*EXCHANGED, *REVERSED)}
"""What may be wrong with the cables, and the matrix (3, 3) that makes it right again."""

REVERSALS: Final = frozenset(_said(wiring) for wiring in REVERSED)
"""Those of them that are one channel's."""

EXCHANGED_IN_TURN: Final = 4.0
"""What it costs beforehand that all three cables are wrong, which looks like a block that sits otherwise."""

CABLED: Final = tuple(
    Supposed(_said(wiring), Kind.CABLING, EXCHANGED_IN_TURN if len(wiring.channels) == 3 else 0.0)
    for wiring in (*EXCHANGED, *REVERSED)
)


def other_installation(actual: str, stated: str, before: str | None) -> Supposed:
    """Suppose that the block sits in another installation; `before` is that of the mounting before."""
    text = f"the block sits in installation {actual}, not in {stated}"
    return Supposed(text, Kind.INSTALLATION, 0.0 if actual == before else OTHER_INSTALLATION)


def _quarter_turns() -> tuple[tuple[tuple[int, ...], tuple[float, ...], Floats], ...]:
    every = product(permutations(range(3)), product((1.0, -1.0), repeat=3))
    turns = ((order, signs, np.diag(signs) @ np.eye(3)[list(order)]) for order, signs in every)
    return tuple(turn for turn in turns if np.linalg.det(turn[2]) > 0)


QUARTER_TURNS: Final = _quarter_turns()
"""The 24 rotations that bring axes upon axes: the order and the signs of the channels, and the matrix (3, 3)."""


def orientations(installations: Mapping[str, Installation], label: str) -> dict[str, Installation]:
    """Return the ways in which a block may sit on the platform otherwise, by what is said of each.

    They are the quarter turns of installation `label`, without those that another installation has.
    """
    own = installations[label].block_from_platform
    known = np.array([other.block_from_platform for other in installations.values()])
    found = {}
    for order, signs, turn in QUARTER_TURNS:
        turned = turn @ own
        if np.isclose(turned, known, atol=1e-6).all(axis=(1, 2)).any():
            continue
        axes = [("" if signs[i] > 0 else "-") + CHANNELS[order[i]] for i in range(3)]
        where = ", ".join(
            f"{CHANNELS[i]} where {axes[i]} belongs" for i in range(3) if axes[i] != CHANNELS[i]
        )
        text = f"the block sits otherwise than in installation {label}: {where}"
        found[text] = Installation(text, turned)
    return found


def head_elsewhere(
    label: str, angle_rad: float, last_rad: float | None, next_rad: float | None, pivot_rad: float | None
) -> list[Elsewhere]:
    """Suppose that the head stood elsewhere than its scale was read.

    `last_rad` is the angle at the point before on the same mounting, `next_rad` that of the point to come,
    `pivot_rad` that of the last point that fitted: from there the head may have been turned the wrong way.
    """
    found: list[Elsewhere] = []

    def add(text: str, kind: Kind, off_rad: float) -> None:
        off_rad = wrapped_rad(off_rad)
        if abs(off_rad) > SAME_RAD and all(
            abs(wrapped_rad(one.off_rad - off_rad)) > SAME_RAD for one in found
        ):
            supposed = Supposed(text, kind, UNLIKELY.get(kind, 0.0))
            found.append(Elsewhere(supposed, label, off_rad))

    if last_rad is not None:
        add(
            f"the head was not turned: the signals are those of the point before, at {format_dms(last_rad)}",
            Kind.NOT_TURNED,
            last_rad - angle_rad,
        )
    if next_rad is not None:
        text = f"the head was turned to the next point: it stood at {format_dms(next_rad)}"
        add(text, Kind.NEXT_POINT, next_rad - angle_rad)
    reflected = float(reflected_rad(np.asarray(angle_rad)))
    if pivot_rad is not None:
        stood = 2 * pivot_rad - angle_rad
        also = ", or 360° - x was read for x" if abs(wrapped_rad(stood + angle_rad)) < SAME_RAD else ""
        text = f"the head was turned the wrong way{also}: it stood at {format_dms(stood % (2 * np.pi))}"
        add(text, Kind.WRONG_WAY, stood - angle_rad)
    add("the head stood at 360° - x where x was read", Kind.SLIP, reflected)
    slips = [
        Elsewhere(
            Supposed(
                f"the setting is {name} off: the head stood at {format_dms(angle_rad + off)}",
                Kind.SLIP,
                UNLIKELY[Kind.SLIP],
            ),
            label,
            off,
        )
        for name, slip in SLIPS_RAD.items()
        for off in (slip, -slip)
        if all(abs(wrapped_rad(one.off_rad - off)) > SAME_RAD for one in found)
    ]
    add("the head stood on the opposite side of its circle (180°)", Kind.SLIP, float(np.pi))
    return [*found, *slips]


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
