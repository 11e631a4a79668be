"""Common mistakes that explain a misfit of a reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.corrected import EXCHANGED, REVERSED, SLIPS_RAD, Wiring, reflected_rad
from bench.run.expectation import (
    SETTING,
    Expectation,
    ExpectedPose,
    NoiseSizes,
    ReadingJudgement,
    Sighting,
    poses,
)
from drivers.angles import format_dms, wrapped_rad


class Kind(StrEnum):
    """The kinds of mistakes that an `EarlySign` can name as causes of a misfit."""

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
"""Mistakes that persist until somebody corrects them; mistakes of any other kind affect a single reading."""

FREE: Final = frozenset({Kind.MOVED, Kind.TILTED, Kind.CHANNEL})
"""Shifts of unknown size; they are not named if the likeliest mistake has a definite size."""

UNLIKELY: Final[Mapping[str, float]] = {Kind.ORIENTATION: 5.0, Kind.SLIP: 1.0, Kind.EARLIER: 2.0}
"""Prior cost of each rarer kind: -2 ln of the odds relative to the most common mistakes."""

FIRST_ORIENTATION: Final = 3.0
"""Additional prior cost of another orientation in the first mounting, where wrong cables look the same."""

OTHER_INSTALLATION: Final = 4.0
"""Prior cost of an installation other than that of the previous mounting."""

REVERSED_MEANWHILE: Final = 7.0
"""Prior cost of reversed wires after fitting readings of the same mounting: a head not turned is likelier."""

SAT_RIGHT: Final = 12.0
"""Prior cost of another orientation at a single reading, after other readings of the mounting have fitted."""

SAME_RAD: Final = float(np.radians(0.5))
"""Suppositions of angles that differ by less than this, rad, count as one."""


@dataclass(frozen=True)
class Supposition:
    """A supposed mistake in words, with its kind; `unlikely` is its prior cost (-2 ln probability)."""

    text: str
    kind: Kind
    unlikely: float = 0.0


@dataclass(frozen=True)
class OtherPose:
    """The supposition of another pose: installation `label`, at the recorded head angle plus `off_rad`."""

    supposed: Supposition
    label: str
    off_rad: float = 0.0


def _said(wiring: Wiring) -> str:
    """Return a phrase on a wiring mistake, such as "the wires of channel x are reversed"."""
    words = {
        "x": message("the wires of channel x are reversed"),
        "y": message("the wires of channel y are reversed"),
        "z": message("the wires of channel z are reversed"),
        "xy": message("the cables of channels x and y are swapped"),
        "xz": message("the cables of channels x and z are swapped"),
        "yz": message("the cables of channels y and z are swapped"),
    }
    words["xyz"] = message("the channels are exchanged in turn: x shows y, y shows z, z shows x")
    if wiring.order[0] == 1:
        words["xyz"] = message("the channels are exchanged in turn: x shows z, y shows x, z shows y")
    return words["".join(wiring.channels)]


CABLINGS: Final[Mapping[str, Floats]] = {_said(wiring): wiring.matrix for wiring in (*EXCHANGED, *REVERSED)}
"""The matrix (3, 3) that turns the recorded signals into the true ones, by phrase on the wiring mistake."""

REVERSALS: Final = frozenset(_said(wiring) for wiring in REVERSED)
"""The phrases of `CABLINGS` on reversed wires of one channel."""

EXCHANGED_IN_TURN: Final = 4.0
"""Prior cost of three exchanged cables, which resemble a block in another orientation."""

CABLED: Final = tuple(
    Supposition(_said(wiring), Kind.CABLING, EXCHANGED_IN_TURN if len(wiring.channels) == 3 else 0.0)
    for wiring in (*EXCHANGED, *REVERSED)
)


def other_installation(actual: str, stated: str, before: str | None) -> Supposition:
    """Return the supposition that the block sits in installation `actual` instead of `stated`.

    `before` is the installation of the previous mounting; a block left in it is the likeliest mistake of this kind.
    """
    text = message(f"the block sits in installation {actual}, not in {stated}")
    return Supposition(text, Kind.INSTALLATION, 0.0 if actual == before else OTHER_INSTALLATION)


def head_elsewhere(
    label: str, angle_rad: float, last_rad: float | None, next_rad: float | None, pivot_rad: float | None
) -> list[OtherPose]:
    """Return the suppositions that the head was at another angle than recorded.

    `last_rad` is the angle of the previous point on the same mounting, `next_rad` that of the next point.
    `pivot_rad` is the angle of the last point that fitted; from there the head may have turned the wrong way.
    """
    found: list[OtherPose] = []

    def add(text: str, kind: Kind, off_rad: float) -> None:
        off_rad = wrapped_rad(off_rad)
        if abs(off_rad) > SAME_RAD and all(
            abs(wrapped_rad(one.off_rad - off_rad)) > SAME_RAD for one in found
        ):
            supposed = Supposition(text, kind, UNLIKELY.get(kind, 0.0))
            found.append(OtherPose(supposed, label, off_rad))

    if last_rad is not None:
        text = message(
            f"the head was not turned: the signals are those of the point before, at {format_dms(last_rad)}"
        )
        add(text, Kind.NOT_TURNED, last_rad - angle_rad)
    if next_rad is not None:
        text = message(f"the head was turned to the next point: it stood at {format_dms(next_rad)}")
        add(text, Kind.NEXT_POINT, next_rad - angle_rad)
    reflected = float(reflected_rad(np.asarray(angle_rad)))
    if pivot_rad is not None:
        stood = 2 * pivot_rad - angle_rad
        at = format_dms(stood % (2 * np.pi))
        text = message(f"the head was turned the wrong way: it stood at {at}")
        if abs(wrapped_rad(stood + angle_rad)) < SAME_RAD:
            text = message(f"the head was turned the wrong way, or 360° - x was read for x: it stood at {at}")
        add(text, Kind.WRONG_WAY, stood - angle_rad)
    add(message("the head stood at 360° - x where x was read"), Kind.SLIP, reflected)
    slips = []
    for name, slip in SLIPS_RAD.items():
        for off in (slip, -slip):
            if all(abs(wrapped_rad(one.off_rad - off)) > SAME_RAD for one in found):
                text = message(f"the setting is {name} off: the head stood at {format_dms(angle_rad + off)}")
                supposed = Supposition(text, Kind.SLIP, UNLIKELY[Kind.SLIP])
                slips.append(OtherPose(supposed, label, off))
    add(message("the head stood on the opposite side of its circle, 180° off"), Kind.SLIP, float(np.pi))
    return [*found, *slips]


SHIFTS: Final = 5
"""Number of shifts of unknown size: the block turned about the shaft or tilted, or an offset of x, y or z."""

AS_IT_IS, ABSENT = SHIFTS, SHIFTS + 1
"""Special values of a shift number: the reading is used as recorded, or left out."""


@dataclass(frozen=True)
class Suspect:
    """A supposed mistake that explains a reading, and its cost (-2 ln likelihood plus prior cost).

    `earlier` is the index of the earlier reading at fault, if any. If the kind is `MOVED`, `moved_rad` is the
    estimated turn about the shaft, `u_rad` its standard uncertainty. `stops` says that the mistake may stop
    the run, because no genuine effect resembles it. `free` says that the mistake is a shift of unknown size.
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
    """One supposed mistake, under which `Inquiry.replay` judges all readings again.

    `cabling` (3, 3) corrects the signals of all readings. `pose` is an index into `Sighting.poses`. It applies
    from reading number `since` on, or only at reading number `reading`, if one is stated. `shift` applies at that
    reading alone: the number of a shift of unknown size, `AS_IT_IS` for none, or `ABSENT` to leave it out.
    """

    supposed: Supposition
    cabling: Floats = field(default_factory=lambda: np.eye(3))
    pose: int = 0
    since: int = 0
    reading: int | None = None
    shift: int = AS_IT_IS

    def pose_at(self, i: int) -> int:
        """Return the index of the pose that applies at reading `i`."""
        return self.pose if i >= self.since and self.reading in (None, i) else 0

    def shift_at(self, i: int) -> int:
        """Return `shift` if `i` is `reading`, otherwise `AS_IT_IS`."""
        return self.shift if self.reading == i else AS_IT_IS


@dataclass(frozen=True)
class ReplayedReadings:
    """The result of replaying n readings under m supposed mistakes ("members").

    `state` holds each member's Kalman filter after the last reading. `cost` (m,) is each member's cost (-2 ln
    likelihood) of all readings; `before` is the cost of member 0 without the last reading. `taken` (n, m) says
    which readings updated each member's filter; `unexplained_v2` (m,) sums the squared residuals, V^2, of the rest.
    """

    state: Expectation
    cost: Floats
    before: float
    taken: Mask
    unexplained_v2: Floats


TIE: Final = 6.0
"""Causes whose costs (-2 ln likelihood) differ by less are all named: the odds are below 20 : 1 (2 ln 20 = 6)."""

MOVED_RAD: Final = np.radians(1.0)
CHANNEL_OFF_G: Final = 0.1
"""Prior standard deviations of the slip angle of a block (rad), and of the error of a single channel (g)."""

LARGE_RAD: Final = np.radians(0.25)
LARGE_G: Final = 0.02
"""Least slip (rad) and channel error (g) that stop a run; no genuine effect of a block or a stand is as large."""

FEW: Final = 4
"""Another orientation of the whole mounting is supposed only up to this number of readings on it."""

MOST_CANDIDATES: Final = 12
"""Greatest number of earlier readings tested for a mistake at once; it limits the computing time in a long run."""


AS_RECORDED: Final = Member(Supposition("", Kind.EARLIER))
"""The replay member that supposes no mistake."""


@dataclass(frozen=True)
class Inquiry:
    """The search for the mistakes that explain a reading.

    `model` contains the procedure's installations and the other possible orientations of the block. `otherwise`
    maps each installation to the labels of its other orientations. `nominal` is the nominal block, `prior` the
    `Expectation` before the first reading. `stand_u` are the standard uncertainties of the stand, and `noise` the
    standard deviations of a reading. A reading fits if its chi2 is at most `most`.
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
        """Return the suspected mistakes that affect this reading alone and explain it.

        Wrong wires or another installation that hardly change this reading are no such mistakes: they show at other
        points, and a small effect of the block resembles them.

        `state` is the expectation (one member) from other readings, `before` their cost (-2 ln likelihood).
        """
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
        judged = state.judge(signals, sighting.pose, self.noise)
        found = self._fitting(supposed, judged, before)
        off_g = np.linalg.norm((signals - sighting.signal_v) / np.abs(np.diag(self.nominal.K)), axis=1)
        hardly = {one.text for one, size in zip(CABLED, off_g, strict=True) if size < LARGE_G}
        return [one for one in found if one.text not in hardly]

    def _elsewhere(self, sighting: Sighting, state: Expectation, before: float) -> list[Suspect]:
        label, angle = sighting.installation, sighting.angle_rad
        unlikely = 0.0 if sighting.pivot_rad is None else SAT_RIGHT
        others = self._others(sighting, few=True)
        force = poses(self.model, self.nominal, sighting.row, [*others], np.full(len(others), angle)).force
        supposed = [
            OtherPose(replace(sat, unlikely=sat.unlikely + unlikely), at)
            for (at, sat), here in zip(others.items(), force, strict=True)
            if np.linalg.norm(here - sighting.pose.force[0]) > LARGE_G
        ]
        supposed += head_elsewhere(label, angle, sighting.last_rad, sighting.next_rad, sighting.pivot_rad)
        angles = angle + np.array([one.off_rad for one in supposed])
        pose = poses(self.model, self.nominal, sighting.row, [one.label for one in supposed], angles)
        judged = state.judge(sighting.signal_v, pose, self.noise)
        return self._fitting([one.supposed for one in supposed], judged, before)

    def _off_by_some(self, sighting: Sighting, state: Expectation, before: float) -> list[Suspect]:
        """Return the suspected mistakes of unknown size: block turned or tilted, or one channel offset."""
        further = self._shifts(sighting, state)
        judged = state.judge(sighting.signal_v, sighting.pose, self.noise, further)
        weighed = np.linalg.solve(judged.covariance, further[..., None])[..., 0]
        part = (weighed * judged.residual).sum(axis=-1)
        left = 1.0 - (weighed * further).sum(axis=-1)
        moved, u = MOVED_RAD * part, MOVED_RAD * np.sqrt(np.maximum(left, 0.0))
        about = message(f"block or head has an angle error of {format_dms(abs(moved[0]))}")
        tilted = message(f"the block is tilted out of the plane of rotation by {format_dms(abs(moved[1]))}")
        supposed = [Supposition(about, Kind.MOVED), Supposition(tilted, Kind.TILTED)]
        for i, channel in enumerate(CHANNELS):
            off_mv = f"{part[2 + i] * further[2 + i, i] * 1e3:+.3g} mV"
            text = message(f"channel {channel} alone, by its cable or voltmeter, is off by {off_mv}")
            supposed.append(Supposition(text, Kind.CHANNEL))
        large = [*(np.abs(moved[:2]) > LARGE_RAD), *(np.abs(part[2:]) * CHANNEL_OFF_G > LARGE_G)]
        stops = {one.text: bool(is_large) for one, is_large in zip(supposed, large, strict=True)}
        return [
            replace(suspect, stops=stops[suspect.text], moved_rad=float(moved[0]), u_rad=float(u[0]))
            if suspect.kind is Kind.MOVED
            else replace(suspect, stops=stops[suspect.text])
            for suspect in self._fitting(supposed, judged, before)
        ]

    def _fitting(
        self, supposed: Sequence[Supposition], judged: ReadingJudgement, before: float
    ) -> list[Suspect]:
        cost = judged.cost(self.most)
        return [
            Suspect(one.text, one.kind, before + float(cost[index]) + one.unlikely, free=one.kind in FREE)
            for index, one in enumerate(supposed)
            if judged.chi2[index] <= self.most
        ]

    def _others(self, sighting: Sighting, *, few: bool) -> dict[str, Supposition]:
        """Return the suppositions of other installations by label, and with `few` those of other orientations."""
        label = sighting.installation
        otherwise = self.otherwise.get(label, ()) if few else ()
        everywhere = {label, *(at for several in self.otherwise.values() for at in several)}
        known = {
            at: other_installation(at, label, sighting.sat_before)
            for at in self.model.installations
            if at not in everywhere
        }
        unlikely = UNLIKELY[Kind.ORIENTATION] + (FIRST_ORIENTATION if sighting.sat_before is None else 0.0)
        return known | {at: Supposition(at, Kind.ORIENTATION, unlikely) for at in otherwise}

    # --- mistakes of the whole run so far ------------------------------------------------------------

    def of_run(self, history: Sequence[Sighting]) -> tuple[list[Suspect], ReplayedReadings]:
        """Return the mistakes that began with the run or the mounting, or that affect one earlier reading.

        The last sighting of `history` is the reading to be explained; only mistakes that explain it are returned. A
        mistake of the run or the mounting must leave smaller misfits than no mistake does. The second value is the
        replay of all readings, in which member 0 supposes no mistake.
        """
        mounted = max(i for i, s in enumerate(history) if s.new_mount)
        others = self._others(history[-1], few=len(history) - mounted <= FEW)
        wrong_way = Supposition(
            message("the head was turned the wrong way since the block was mounted"), Kind.ROTATION
        )
        members = [
            AS_RECORDED,
            *(Member(one, cabling) for one, cabling in zip(CABLED, CABLINGS.values(), strict=True)),
            Member(Supposition(message("the head counts the other way"), Kind.ROTATION), pose=1),
            *([Member(wrong_way, pose=1, since=mounted)] if mounted else []),
            *(Member(one, pose=2 + i, since=mounted) for i, one in enumerate(others.values())),
            *(member for k in candidates(history) for member in self._wrong_before(history[k], k)),
        ]
        replay = self.replay(history, members)
        better = replay.unexplained_v2 < replay.unexplained_v2[0]
        return [
            Suspect(
                member.supposed.text,
                member.supposed.kind,
                float(replay.cost[j]) + member.supposed.unlikely,
                earlier=member.reading,
                free=member.shift != AS_IT_IS,
            )
            for j, member in enumerate(members)
            if j and replay.taken[-1, j] and (better[j] or member.reading is not None)
        ], replay

    def _wrong_before(self, sighting: Sighting, k: int) -> list[Member]:
        """Return the members (supposed mistakes) with reading `k` left out, shifted, or at another setting."""
        unlikely = UNLIKELY[Kind.EARLIER]
        somehow = Supposition(message(f"a wrong reading: {sighting.place}"), Kind.EARLIER, unlikely)
        first = 2 + len(self._others(sighting, few=True))
        settings = [
            Supposition(
                message(f"a wrong setting at {sighting.place}: {at.text}"),
                Kind.EARLIER,
                unlikely + at.unlikely,
            )
            for at in (one.supposed for one in _settings(sighting))
        ]
        return [
            *(Member(somehow, reading=k, shift=shift) for shift in (ABSENT, *range(SHIFTS))),
            *(Member(one, pose=first + i, reading=k) for i, one in enumerate(settings)),
        ]

    def without(self, history: Sequence[Sighting], k: int) -> ReplayedReadings:
        """Replay all readings except the reading with index `k`."""
        return self.replay(history, [replace(AS_RECORDED, reading=k, shift=ABSENT)])

    def replay(
        self, history: Sequence[Sighting], members: Sequence[Member] = (AS_RECORDED,)
    ) -> ReplayedReadings:
        """Replay all readings for each member, that is, for each supposed mistake.

        The default is one member that uses the readings as recorded. A reading that a member leaves out costs this
        member (-2 ln likelihood) as much as a reading that does not fit.
        """
        state = self.prior.repeated(len(members))
        cabling = np.stack([member.cabling for member in members])
        cost, before, unexplained_v2 = np.zeros(len(members)), 0.0, np.zeros(len(members))
        taken = np.zeros((len(history), len(members)), dtype=bool)
        for i, sighting in enumerate(history):
            if sighting.new_mount:
                state.remount(self.stand_u)
            state.loosen(sighting.loosened)
            pose = np.array([member.pose_at(i) for member in members])
            at = sighting.pose
            if pose.any():
                at = ExpectedPose(*(each[pose] for each in self._all_poses(sighting)))
            shift = np.array([member.shift_at(i) for member in members])
            further = None
            if (shift < SHIFTS).any():
                further = np.concatenate([self._shifts(sighting, state), np.zeros((2, 3))])[shift]
            judged = state.judge(cabling @ sighting.signal_v, at, self.noise, further)
            present = shift != ABSENT
            taken[i] = (judged.chi2 <= self.most) & present & (not sighting.struck)
            before = float(cost[0])
            if not sighting.struck:
                cost += np.where(present, judged.cost(self.most), self.most + judged.log_det)
                unexplained_v2 += (judged.residual**2).sum(axis=1) * (present & ~taken[i])
            state.take(judged, taken[i])
        return ReplayedReadings(state, cost, before, taken, unexplained_v2)

    def _all_poses(self, sighting: Sighting) -> ExpectedPose:
        if sighting.poses is None:
            label, angle = sighting.installation, sighting.angle_rad
            others = list(self._others(sighting, few=True))
            settings = [angle + one.off_rad for one in _settings(sighting)]
            angles = np.array([angle, -angle, *[angle] * len(others), *settings])
            labels = [label, label, *others, *[label] * len(settings)]
            sighting.poses = poses(self.model, self.nominal, sighting.row, labels, angles)
        return sighting.poses

    def _shifts(self, sighting: Sighting, state: Expectation) -> Floats:
        """Return the prior standard deviations, V, (5, 3), of the signals for the five mistakes of unknown size.

        They are a turn of the block, a tilt of the block, and an offset of x, of y or of z.
        """
        scale = state.scale_factors[0]
        turn = self.model.installations[sighting.installation].block_from_platform
        return np.stack(
            [
                MOVED_RAD * (scale @ sighting.pose.slopes[0, :, SETTING]),
                MOVED_RAD * (scale @ turn[:, 1]),
                *np.diag(CHANNEL_OFF_G * np.linalg.norm(scale, axis=1)),
            ]
        )


def _settings(sighting: Sighting) -> list[OtherPose]:
    at, label = sighting.angle_rad, sighting.installation
    found = head_elsewhere(label, at, sighting.last_rad, sighting.next_rad, sighting.pivot_rad)
    return [one for one in found if abs(one.off_rad) > LARGE_RAD]


def candidates(history: Sequence[Sighting]) -> list[int]:
    """Return the indices of earlier readings that may hide a mistake, at most the latest `MOST_CANDIDATES`."""
    poor = [i for i, s in enumerate(history[:-1]) if s.taken and s.poorly_known and not s.struck]
    return poor[-MOST_CANDIDATES:]


def likeliest(suspects: Sequence[Suspect]) -> list[Suspect]:
    """Return the likeliest suspect, and the suspects that the readings cannot distinguish from it.

    Of suspects with the same text, only the likeliest is returned. Shifts of unknown size are left out,
    unless the likeliest suspect of all is one.
    """
    ranked = {s.text: s for s in sorted(suspects, key=lambda s: -s.cost)}
    best = min(ranked.values(), key=lambda s: s.cost, default=None)
    if best is None:
        return []
    rivals = (s for s in ranked.values() if best.free or not s.free)
    return sorted((s for s in rivals if s.cost - best.cost < TIE), key=lambda s: s.cost)
