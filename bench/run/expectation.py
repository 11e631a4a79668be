"""The expectation of the next reading, and the early sign of a misfit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations, product
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.special import chdtrc

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message
from bench.calibration.design import STEP_RAD, coefficient_columns
from bench.model.conditions import Conditions, Mounting
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block, Installation

COEFFICIENT_COUNT: Final = 12
SETTING: Final = len(STAND_ANGLES)
"""Column of the setting error in a pose's slopes; the stand's angles occupy the columns before it."""

STATE: Final = COEFFICIENT_COUNT + len(STAND_ANGLES)

STATED_WORTH: Final = 12.0
"""Degrees of freedom with which the stated standard deviations count against those of repeats."""


class ExpectedPose(NamedTuple):
    """The effect of gravity on the block at one reading.

    `force` (…, 3) is the specific force in g on a stand without errors. `slopes` (…, 3, 6) are the derivatives of
    `force` with respect to the stand's angles and the setting error, g/rad. `addition` (…, 3) is what the model's
    effects add to the signals, V.
    """

    force: Floats
    slopes: Floats
    addition: Floats


def poses(
    model: ForwardModel, block: Block, row: Conditions, installations: Sequence[str], angle_rad: Floats
) -> ExpectedPose:
    """Return the poses of one reading for v pairs of installation and head angle, rad (first axis v).

    `row` holds the conditions of the reading. Effects that depend on the block are evaluated at `block`. Raises
    `KeyError` for an installation that the model lacks.
    """
    variants, columns = len(angle_rad), SETTING + 2
    series = row.mounts[0].series
    rows = variants * columns
    mounts = tuple(Mounting(series, label) for label in installations for _ in range(columns))
    repeated: dict[str, Any] = {
        name: np.repeat(getattr(row, name), rows, axis=0)
        for name in ("pass_number", "point", "direction", "time_s", "temperature_c", "scan_order")
    }
    angles = np.repeat(angle_rad, columns)
    conditions = replace(row, mounts=mounts, mount=np.arange(rows), angle_rad=angles, **repeated)
    errors = np.tile(STEP_RAD * np.eye(columns, SETTING + 1, k=-1), (variants, 1))
    stand_rad, setting_rad = errors[:, :SETTING], errors[:, SETTING]
    force = model.specific_force(conditions, stand_rad, block, setting_rad)
    addition = np.zeros_like(force)
    if model.effects:
        addition = model.readings(block, conditions, stand_rad, setting_rad) - block.output(force)
    force = force.reshape(variants, columns, 3)
    slopes = (force[:, 1:] - force[:, :1]) / STEP_RAD
    return ExpectedPose(force[:, 0], np.swapaxes(slopes, 1, 2), addition.reshape(variants, columns, 3)[:, 0])


@dataclass(frozen=True)
class NoiseSizes:
    """Standard deviations of one reading: of each signal (V), and of the setting of the head (rad)."""

    reading_v: float
    setting_rad: float


class RepeatNoise:
    """The standard deviations of a reading, estimated from repeats; never below the bench file's values.

    The bench file's values include errors that repeats do not reveal (the meters' gain, the head's graduation). In
    the estimate, these values count as much as repeats with `STATED_WORTH` degrees of freedom.
    """

    def __init__(self, stated: NoiseSizes) -> None:
        self.stated = stated
        self.sizes = stated
        self._across_v2, self._along_rad2, self._repeats = 0.0, 0.0, 0

    def add(self, difference_v: Floats, slope: Floats) -> None:
        """Update the estimate with a repeat that deviates by `difference_v` (3,) from the earlier reading, V.

        `slope` (3,) is d signal/d angle, V/rad. Along it, noise of the signals and of the head's setting add up; in
        the two perpendicular directions, there is only noise of the signals.
        """
        length = float(np.linalg.norm(slope))
        along2 = (float(difference_v @ slope) / length) ** 2 / 2
        across2 = float(difference_v @ difference_v) / 2 - along2
        self._repeats += 1
        self._across_v2 += across2
        self._along_rad2 += (along2 - across2 / 2) / length**2
        reading = STATED_WORTH * self.stated.reading_v**2 + self._across_v2
        setting = STATED_WORTH * self.stated.setting_rad**2 + self._along_rad2
        self.sizes = NoiseSizes(
            max(self.stated.reading_v, math.sqrt(reading / (STATED_WORTH + 2 * self._repeats))),
            max(self.stated.setting_rad, math.sqrt(max(setting, 0.0) / (STATED_WORTH + self._repeats))),
        )


class ReadingJudgement(NamedTuple):
    """The comparison of a reading with its expectation, for each of m members (supposed mistakes).

    `residual` (m, 3), V, has the covariance matrix `covariance` (m, 3, 3); `log_det` (m,) is the logarithm of the
    determinant. `chi2` (m,) has three degrees of freedom. `design` (m, 3, 17) holds the derivatives of the signals
    with respect to the state.
    """

    residual: Floats
    covariance: Floats
    chi2: Floats
    log_det: Floats
    design: Floats

    @property
    def sigma(self) -> Floats:
        """The residuals divided by their standard deviations, shape (m, 3)."""
        return self.residual / np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    @property
    def p(self) -> float:
        """The probability that chance causes a misfit at least as large as that of the first member."""
        return float(chdtrc(3, self.chi2[0]))

    def cost(self, most: float) -> Floats:
        """Return -2 ln likelihood up to a constant, shape (m,); a chi2 above `most` counts as `most`."""
        return np.minimum(self.chi2, most) + self.log_det


@dataclass
class Expectation:
    """The states of m Kalman filters ("members"); each member supposes a different mistake, or none.

    A state is the 12 coefficients (V/g, V), then the 5 stand angles (rad), with its `mean` (m, 17) and its
    `covariance` (m, 17, 17).
    """

    mean: Floats
    covariance: Floats

    @classmethod
    def about(cls, block: Block, u: Floats) -> Expectation:
        """Return an expectation of one member about a nominal block, with standard uncertainties `u` (12,)."""
        mean, variance = np.zeros(STATE), np.zeros(STATE)
        mean[:COEFFICIENT_COUNT], variance[:COEFFICIENT_COUNT] = block.vector, u**2
        return cls(mean[None], np.diag(variance)[None])

    def repeated(self, members: int) -> Expectation:
        """Return an expectation with `members` copies of the first member."""
        return Expectation(
            np.repeat(self.mean[:1], members, axis=0), np.repeat(self.covariance[:1], members, axis=0)
        )

    @property
    def scale_factors(self) -> Floats:
        """The matrices K, V/g, shape (m, 3, 3)."""
        return self.mean[:, :9].reshape(-1, 3, 3)

    def remount(self, stand_u: Mapping[str, float]) -> None:
        """Reset the stand's angles to 0, with standard uncertainties `stand_u`, rad, for a new mounting."""
        self.mean[:, COEFFICIENT_COUNT:] = 0.0
        self.covariance[:, COEFFICIENT_COUNT:, :] = 0.0
        self.covariance[:, :, COEFFICIENT_COUNT:] = 0.0
        for column, name in enumerate(STAND_ANGLES, start=COEFFICIENT_COUNT):
            self.covariance[:, column, column] = stand_u.get(name, 0.0) ** 2

    def loosen(self, variance: Floats) -> None:
        """Add `variance` (12,) to the variances of coefficients that may have changed since the last reading."""
        index = np.arange(COEFFICIENT_COUNT)
        self.covariance[:, index, index] += variance

    def predict(self, pose: ExpectedPose) -> Floats:
        """Return the signals (m, 3) expected in m poses, V."""
        angles = self.mean[:, COEFFICIENT_COUNT:, None]
        force = pose.force[..., None] + pose.slopes[..., :SETTING] @ angles
        return (self.scale_factors @ force)[..., 0] + self.mean[:, 9:12] + pose.addition

    def judge(
        self, signal_v: Floats, pose: ExpectedPose, noise: NoiseSizes, further: Floats | None = None
    ) -> ReadingJudgement:
        """Compare a reading, signals (3,) or (m, 3) in V, with its expectation.

        `further` (m, 3) is the standard deviation of an additional error, V, fully correlated between the signals.
        """
        angles = self.mean[:, COEFFICIENT_COUNT:, None]
        force = pose.force + (pose.slopes[..., :SETTING] @ angles)[..., 0]
        by_angle = self.scale_factors @ pose.slopes
        design = np.zeros((*np.broadcast_shapes(force.shape, self.mean[:, :3].shape), STATE))
        design[:, :, :COEFFICIENT_COUNT] = coefficient_columns(force)
        design[:, :, COEFFICIENT_COUNT:] = by_angle[..., :SETTING]
        expected = (self.scale_factors @ force[..., None])[..., 0] + self.mean[:, 9:12] + pose.addition
        residual = signal_v - expected
        errors = noise.setting_rad * by_angle[..., SETTING]
        covariance = design @ self.covariance @ np.swapaxes(design, 1, 2)
        covariance += noise.reading_v**2 * np.eye(3) + errors[..., :, None] * errors[..., None, :]
        if further is not None:
            covariance = covariance + further[..., :, None] * further[..., None, :]
        chi2 = (residual * np.linalg.solve(covariance, residual[..., None])[..., 0]).sum(axis=-1)
        return ReadingJudgement(residual, covariance, chi2, np.linalg.slogdet(covariance)[1], design)

    def take(self, judged: ReadingJudgement, members: Mask | None = None) -> None:
        """Update the states with a judged reading; a mask `members` (m,) selects the states to update."""
        across = self.covariance @ np.swapaxes(judged.design, 1, 2)
        gain = np.swapaxes(np.linalg.solve(judged.covariance, np.swapaxes(across, 1, 2)), 1, 2)
        if members is not None:
            gain = gain * members[:, None, None]
        self.mean = self.mean + (gain @ judged.residual[..., None])[..., 0]
        lessened = self.covariance - gain @ np.swapaxes(across, 1, 2)
        self.covariance = 0.5 * (lessened + np.swapaxes(lessened, 1, 2))


@dataclass(frozen=True)
class ExpectedSignals:
    """Expected `signals` (3,), V, their `covariance` (3, 3), and `slope` (3,): d signal/d angle, V/rad."""

    signals: Floats
    slope: Floats
    covariance: Floats

    def deviation_rad(self, signals: Floats) -> tuple[float, float]:
        """Return the head's deviation from the commanded angle and its standard uncertainty, rad.

        `signals` (3,) are the measured signals, V. If they do not depend on the angle, the result is (0, inf).
        """
        weighted = np.linalg.solve(self.covariance, self.slope)
        information = float(self.slope @ weighted)
        if information <= 0.0:
            return 0.0, math.inf
        return float(weighted @ (signals - self.signals)) / information, 1.0 / math.sqrt(information)


@dataclass(frozen=True)
class EarlySign:
    """A warning that a reading does not fit the earlier ones.

    `sentence` is the complete message. `sigma` are the residuals of x, y, z divided by their standard deviations;
    `channels` are the channels with large residuals. `p` is the probability that chance causes so large a misfit.
    `causes` are the mistakes that explain the reading equally well, likeliest first, empty if none does; `kinds`
    are their kinds. `in_a_row` is the number of consecutive readings that did not fit. `at_fault` is the place of
    an earlier reading found to be wrong; the present reading fits without it, and `in_a_row` is 0. If `confident`,
    the run has to stop and ask (`bench.run.confidence`); `wrong` then identifies the reading at fault (series,
    installation, pass, point).
    """

    sentence: str
    place: str
    channels: tuple[str, ...]
    sigma: tuple[float, ...]
    p: float
    causes: tuple[str, ...]
    in_a_row: int
    at_fault: str | None = None
    kinds: tuple[str, ...] = ()
    confident: bool = False
    wrong: tuple[int, str, int, int] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the sign as the data of an event."""
        return asdict(self)


def _quarter_turns() -> tuple[tuple[tuple[int, ...], tuple[float, ...], Floats], ...]:
    every = product(permutations(range(3)), product((1.0, -1.0), repeat=3))
    turns = ((order, signs, np.diag(signs) @ np.eye(3)[list(order)]) for order, signs in every)
    return tuple(turn for turn in turns if np.linalg.det(turn[2]) > 0)


QUARTER_TURNS: Final = _quarter_turns()
"""The 24 rotations that map axes to axes: order of the channels, their signs, and the matrix (3, 3)."""


def orientations(installations: Mapping[str, Installation], label: str) -> dict[str, Installation]:
    """Return the other possible orientations of a block on the platform, each keyed by a sentence on it.

    They are installation `label` turned by quarter turns; orientations of known installations are left out.
    """
    own = installations[label].block_from_platform
    known = np.array([other.block_from_platform for other in installations.values()])
    found = {}
    for order, signs, turn in QUARTER_TURNS:
        turned = turn @ own
        if (np.abs(turned - known) < 1e-5).all(axis=(1, 2)).any():
            continue
        axes = ", ".join(("" if signs[i] > 0 else "-") + CHANNELS[order[i]] for i in range(3))
        text = message(
            f"the block is not mounted as in installation {label}: its axes x, y, z are in the places of {axes}"
        )
        found[text] = Installation(text, turned)
    return found


@dataclass
class Sighting:
    """A reading with its data for the early warning.

    `new_mount` says that the block was mounted just before the reading. `loosened` (12,) are the variances by
    which the coefficients may have changed since the previous reading. `taken` means that the model has learnt
    from the reading. `poorly_known` means that the model was too uncertain to reveal a mistake in the reading.
    `struck` means that the reading is known to be wrong or was repeated.

    `poses` are, in this order: the recorded pose, the pose with the head's sense reversed, the poses in other
    installations or orientations, and the poses at head angles set by mistake. `sat_before` is the installation of
    the previous mounting. Three head angles, rad, are None without such a reading: `last_rad` at the previous
    reading on this mounting, `pivot_rad` at the last one that fitted, `next_rad` at the next reading.
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
        """The installation stated in the record."""
        return self.row.mounts[0].installation

    @property
    def angle_rad(self) -> float:
        """The head angle read back, rad."""
        return float(self.row.angle_rad[0])
