"""Which classic mistake explains a reading that does not fit: each is supposed in turn and held against the data.

Mistakes of one reading (a wrong setting) are supposed for that reading alone; mistakes of cabling and of
the procedure also for the whole run or mounting so far, since before the model knows the block they are
taken for a property of it. The likelihood of all readings decides; equally likely ones are all named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import CHANNELS, Floats
from bench.model import Block, Conditions, ForwardModel
from bench.run.watch.expectation import SETTING, Expectation, ExpectedPose, Judgement, NoiseSizes, poses
from bench.run.watch.suppositions import (
    CABLED,
    CABLINGS,
    FIRST_ORIENTATION,
    FREE,
    REVERSALS,
    REVERSED_MEANWHILE,
    SAT_RIGHT,
    UNLIKELY,
    Elsewhere,
    Kind,
    Supposed,
    head_elsewhere,
    other_installation,
)
from drivers.angles import format_dms

TIE: Final = 6.0
"""Two causes whose costs (-2 ln likelihood) differ by less are both named: less than 20 : 1."""

MOVED_RAD: Final = np.radians(1.0)
CHANNEL_OFF_G: Final = 0.1
"""Prior 1 σ of how far a block slips, and of how far a single channel is off (in g)."""

LARGE_RAD: Final = np.radians(0.25)
LARGE_G: Final = 0.02
"""A block that moved, a channel that is off by more: no effect of a block or a stand is as large."""

FEW: Final = 4
"""So many readings of a mounting tell how the block sits; later ones suppose no new orientation of it."""

MOST_CANDIDATES: Final = 12
"""Earlier readings that are suspected at once; it bounds the time that a warning takes in a long run."""


@dataclass
class Sighting:
    """A reading as the early warning keeps it.

    `new_mount` says that the block was mounted before it, `loosened` (12,) by how much the coefficients may
    have moved, as variances. `taken`: the model has learnt from it; `poorly_known`: when it was taken the
    model could not yet have seen a mistake in it; `struck`: known to be wrong, or taken again.
    `poses` are as recorded, with the head's sense reversed, and in each of the other installations.
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

    `earlier` is the reading that is at fault instead, `member` who in the replay left it out. `moved_rad`
    with its uncertainty is set where the head or the block is supposed off by an angle. `stops` says that no
    effect looks like it: a run is stopped for it.
    """

    text: str
    kind: Kind
    cost: float
    stops: bool = True
    earlier: int | None = None
    member: int = 0
    moved_rad: float | None = None
    u_rad: float = 0.0


@dataclass(frozen=True)
class Replay:
    """All readings gone through once more: the state of each member at the end and what it took in.

    `cost` (m,) of all readings, `before` that of the base member without the last one; `taken` (n, m).
    """

    state: Expectation
    cost: Floats
    before: float
    taken: NDArray[np.bool_]


@dataclass(frozen=True)
class Inquiry:
    """What every supposition needs: the model, the start, the stand, the noise, the largest chi2 that fits.

    The model has beside its installations the other ways to sit on the platform; `otherwise` names those of
    each installation.
    """

    model: ForwardModel
    otherwise: Mapping[str, Sequence[str]]
    nominal: Block
    prior: Expectation
    stand_u: Mapping[str, float]
    noise: NoiseSizes
    most: float

    # --- mistakes of one reading ---------------------------------------------------------------------

    def of_reading(self, sighting: Sighting, state: Expectation, before: float) -> list[Suspect]:
        """Suppose mistakes in this reading alone; `state` has one member, `before` is the cost so far."""
        return [
            *self._cabling_now(sighting, state, before),
            *self._elsewhere(sighting, state, before),
            *self._off_by_some(sighting, state, before),
        ]

    def _cabling_now(self, sighting: Sighting, state: Expectation, before: float) -> list[Suspect]:
        signals = np.stack(list(CABLINGS.values())) @ sighting.signal_v
        supposed = [
            replace(one, unlikely=REVERSED_MEANWHILE)
            if one.text in REVERSALS and sighting.pivot_rad is not None
            else one
            for one in CABLED
        ]
        return self._fitting(supposed, state.judge(signals, sighting.pose, self.noise), before)

    def _elsewhere(self, sighting: Sighting, state: Expectation, before: float) -> list[Suspect]:
        """The block in another installation, or the head elsewhere than its scale was read."""
        label, angle = sighting.installation, sighting.angle_rad
        unlikely = 0.0 if sighting.pivot_rad is None else SAT_RIGHT
        supposed = [
            Elsewhere(replace(sat, unlikely=sat.unlikely + unlikely), at)
            for at, sat in self._others(sighting, few=True).items()
        ]
        supposed += head_elsewhere(label, angle, sighting.last_rad, sighting.next_rad, sighting.pivot_rad)
        labels = [one.label for one in supposed]
        angles = angle + np.array([one.off_rad for one in supposed])
        pose = poses(self.model, self.nominal, sighting.row, labels, angles)
        judged = state.judge(sighting.signal_v, pose, self.noise)
        return self._fitting([one.supposed for one in supposed], judged, before)

    def _off_by_some(self, sighting: Sighting, state: Expectation, before: float) -> list[Suspect]:
        """The block moved in the plane of rotation or out of it, or one channel off, by whatever fits."""
        scale = state.scale_factors[0]
        turn = self.model.installations[sighting.installation].block_from_platform
        size = CHANNEL_OFF_G * np.linalg.norm(scale, axis=1)
        further = np.stack(
            [
                MOVED_RAD * (scale @ sighting.pose.slopes[0, :, SETTING]),
                MOVED_RAD * (scale @ turn[:, 1]),
                *np.diag(size),
            ]
        )
        judged = state.judge(sighting.signal_v, sighting.pose, self.noise, further)
        weighed = np.linalg.solve(judged.covariance, further[..., None])[..., 0]
        part = (weighed * judged.residual).sum(axis=-1)
        left = 1.0 - (weighed * further).sum(axis=-1)
        moved, u = MOVED_RAD * part, MOVED_RAD * np.sqrt(np.maximum(left, 0.0))
        about = f"block or head is {format_dms(abs(moved[0]))} off about the shaft"
        tilted = f"the block is tilted by {format_dms(abs(moved[1]))} out of the plane of rotation"
        supposed = [Supposed(about, Kind.MOVED), Supposed(tilted, Kind.TILTED)]
        for i, channel in enumerate(CHANNELS):
            off_v = part[2 + i] * size[i]
            text = f"channel {channel} alone is off by {off_v * 1e3:+.3g} mV (its cable or voltmeter)"
            supposed.append(Supposed(text, Kind.CHANNEL))
        large = [*(np.abs(moved[:2]) > LARGE_RAD), *(np.abs(part[2:]) * CHANNEL_OFF_G > LARGE_G)]
        stops = {one.text: bool(is_large) for one, is_large in zip(supposed, large, strict=True)}
        return [
            replace(suspect, stops=stops[suspect.text], moved_rad=float(moved[0]), u_rad=float(u[0]))
            if suspect.kind is Kind.MOVED
            else replace(suspect, stops=stops[suspect.text])
            for suspect in self._fitting(supposed, judged, before)
        ]

    def _fitting(self, supposed: Sequence[Supposed], judged: Judgement, before: float) -> list[Suspect]:
        cost = judged.cost(self.most)
        return [
            Suspect(one.text, one.kind, before + float(cost[index]) + one.unlikely)
            for index, one in enumerate(supposed)
            if judged.chi2[index] <= self.most
        ]

    def _others(self, sighting: Sighting, *, few: bool) -> dict[str, Supposed]:
        """Return where else the block may sit, by label; after `few` readings other orientations, too."""
        label = sighting.installation
        otherwise = self.otherwise.get(label, ()) if few else ()
        known = {at: other_installation(at, label, sighting.sat_before) for at in self._installations(label)}
        unlikely = UNLIKELY[Kind.ORIENTATION] + (FIRST_ORIENTATION if sighting.sat_before is None else 0.0)
        return known | {at: Supposed(at, Kind.ORIENTATION, unlikely) for at in otherwise}

    def _installations(self, label: str) -> list[str]:
        everywhere = {at for several in self.otherwise.values() for at in several}
        return [other for other in self.model.installations if other != label and other not in everywhere]

    # --- mistakes of the whole run so far ------------------------------------------------------------

    def of_run(self, history: Sequence[Sighting]) -> tuple[list[Suspect], Replay]:
        """Suppose mistakes since the run or the mounting began, or in one earlier reading alone.

        The last of `history` is the reading to be explained. Member 0 of the replay supposes nothing.
        """
        mounted = max(i for i, s in enumerate(history) if s.new_mount)
        others = self._others(history[-1], few=len(history) - mounted <= FEW)
        left_out = candidates(history)
        supposed = [
            Supposed("", Kind.EARLIER),
            *CABLED,
            Supposed("the head counts the other way", Kind.ROTATION),
            Supposed("the head was turned the wrong way since the block was mounted", Kind.ROTATION),
            *others.values(),
            *(
                Supposed(f"{history[k].place} was wrong", Kind.EARLIER, UNLIKELY[Kind.EARLIER])
                for k in left_out
            ),
        ]
        members = len(supposed)
        cabling = np.tile(np.eye(3), (members, 1, 1))
        cabling[1 : 1 + len(CABLINGS)] = np.stack(list(CABLINGS.values()))
        pose = np.zeros((len(history), members), dtype=np.int64)
        rotation = 1 + len(CABLINGS)
        pose[:, rotation] = 1
        pose[mounted:, rotation + 1] = 1
        for number in range(len(others)):
            pose[mounted:, rotation + 2 + number] = 2 + number
        absent = np.zeros((len(history), members), dtype=bool)
        for member, k in enumerate(left_out, start=members - len(left_out)):
            absent[k, member] = True
        replay = self.replay(history, cabling, pose, absent)
        earlier = [None] * (members - len(left_out)) + list(left_out)
        return [
            Suspect(one.text, one.kind, float(replay.cost[j]) + one.unlikely, earlier=earlier[j], member=j)
            for j, one in enumerate(supposed)
            if j and replay.taken[-1, j] and (mounted or j != rotation + 1)
        ], replay

    def replay(
        self,
        history: Sequence[Sighting],
        cabling: Floats | None = None,
        pose: NDArray[np.int64] | None = None,
        absent: NDArray[np.bool_] | None = None,
    ) -> Replay:
        """Go through all readings again; without arguments as they were recorded, with one member.

        `cabling` (m, 3, 3) makes the signals right, `pose` (n, m) chooses among a sighting's poses, `absent`
        (n, m) leaves readings out, which costs as much as one that does not fit.
        """
        members = 1 if cabling is None else len(cabling)
        state = self.prior.repeated(members)
        cost, before, taken = np.zeros(members), 0.0, np.zeros((len(history), members), dtype=bool)
        for i, sighting in enumerate(history):
            if sighting.new_mount:
                state.remount(self.stand_u)
            state.loosen(sighting.loosened)
            at = sighting.pose
            if pose is not None and pose[i].any():
                at = _chosen(self._all_poses(sighting), pose[i])
            signal = sighting.signal_v if cabling is None else cabling @ sighting.signal_v
            judged = state.judge(signal, at, self.noise)
            present = np.ones(members, dtype=bool) if absent is None else ~absent[i]
            taken[i] = (judged.chi2 <= self.most) & present & (not sighting.struck)
            before = float(cost[0])
            if not sighting.struck:
                cost += np.where(present, judged.cost(self.most), self.most + judged.log_det)
            state.take(judged, taken[i])
        return Replay(state, cost, before, taken)

    def _all_poses(self, sighting: Sighting) -> ExpectedPose:
        if sighting.poses is None:
            label, angle = sighting.installation, sighting.angle_rad
            others = list(self._others(sighting, few=True))
            angles = np.array([angle, -angle, *[angle] * len(others)])
            labels = [label, label, *others]
            sighting.poses = poses(self.model, self.nominal, sighting.row, labels, angles)
        return sighting.poses


def candidates(history: Sequence[Sighting]) -> list[int]:
    """Earlier readings in which a mistake could not be seen when they were taken, the latest of them."""
    poor = [i for i, s in enumerate(history[:-1]) if s.taken and s.poorly_known and not s.struck]
    return poor[-MOST_CANDIDATES:]


def likeliest(suspects: Sequence[Suspect]) -> list[Suspect]:
    """Return the suspects that the readings cannot tell from the likeliest one, each text once.

    Beside one of a certain size a shift of whatever size fits is none.
    """
    ranked = {s.text: s for s in sorted(suspects, key=lambda s: -s.cost)}
    best = min(ranked.values(), key=lambda s: s.cost, default=None)
    if best is None:
        return []
    rivals = (s for s in ranked.values() if best.kind in FREE or s.kind not in FREE)
    return sorted((s for s in rivals if s.cost - best.cost < TIE), key=lambda s: s.cost)


def _chosen(pose: ExpectedPose, index: NDArray[np.int64]) -> ExpectedPose:
    return ExpectedPose(pose.force[index], pose.slopes[index], pose.addition[index])
