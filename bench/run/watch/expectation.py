"""What the model expects of the next reading, and the sign given when a reading does not fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.special import chdtrc

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.model.block import Block
from bench.model.conditions import Conditions, Mounting
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES

COEFFICIENT_COUNT: Final = 12
SETTING: Final = len(STAND_ANGLES)
"""Column of a pose's slopes that belongs to the setting error; the stand's angles come before it."""

STATE: Final = COEFFICIENT_COUNT + len(STAND_ANGLES)

STATED_WORTH: Final = 12.0
"""Degrees of freedom of repeats that the stated noise sizes are worth."""

_STEP_RAD: Final = 1e-5


class ExpectedPose(NamedTuple):
    """How gravity acts on the block at a reading.

    `force` (…, 3) in g at a stand without errors; `slopes` (…, 3, 6) its derivatives by the stand's angles
    and the setting error, g/rad; `addition` (…, 3) what the model's effects add, V.
    """

    force: Floats
    slopes: Floats
    addition: Floats


def poses(
    model: ForwardModel, block: Block, row: Conditions, installations: Sequence[str], angle_rad: Floats
) -> ExpectedPose:
    """Return the poses (v, …) of one reading, if the block sat and the head stood as the v variants say.

    `row` has the conditions of the one reading, `block` is where effects that depend on it are taken.
    Raises `KeyError` for an installation that the model lacks.
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
    errors = np.tile(_STEP_RAD * np.eye(columns, SETTING + 1, k=-1), (variants, 1))
    stand_rad, setting_rad = errors[:, :SETTING], errors[:, SETTING]
    force = model.specific_force(conditions, stand_rad, block, setting_rad)
    addition = np.zeros_like(force)
    if model.effects:
        addition = model.readings(block, conditions, stand_rad, setting_rad) - block.output(force)
    force = force.reshape(variants, columns, 3)
    slopes = (force[:, 1:] - force[:, :1]) / _STEP_RAD
    return ExpectedPose(force[:, 0], np.swapaxes(slopes, 1, 2), addition.reshape(variants, columns, 3)[:, 0])


@dataclass(frozen=True)
class NoiseSizes:
    """Standard deviations of one reading: of each signal, V, and of the setting of the head, rad."""

    reading_v: float
    setting_rad: float


class RepeatNoise:
    """The noise sizes as repeats show them, never below those that the bench file states.

    What is stated covers errors that repeats do not show (the meters' gain, the head's graduation), and counts
    as much as `STATED_WORTH` degrees of freedom of repeats.
    """

    def __init__(self, stated: NoiseSizes) -> None:
        self.stated = stated
        self.sizes = stated
        self._across_v2, self._along_rad2, self._repeats = 0.0, 0.0, 0

    def add(self, difference_v: Floats, slope: Floats) -> None:
        """Take in a repeat's difference (3,) from the visit before; `slope` (3,) is du/dphi, V/rad.

        Along the slope both sizes show, in the two directions across it that of the signals alone.
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


class Judgement(NamedTuple):
    """A reading against its expectation, per member.

    `residual` (m, 3) in V, `covariance` (m, 3, 3) of it, `chi2` (m,) with three degrees of freedom,
    `log_det` (m,) of the covariance, `design` (m, 3, 17) the derivatives by the state.
    """

    residual: Floats
    covariance: Floats
    chi2: Floats
    log_det: Floats
    design: Floats

    @property
    def sigma(self) -> Floats:
        """The residuals in standard deviations, shape (m, 3)."""
        return self.residual / np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    @property
    def p(self) -> float:
        """The probability of so large a misfit of the first member by chance."""
        return float(chdtrc(3, self.chi2[0]))

    def cost(self, most: float) -> Floats:
        """Minus twice the log likelihood up to a constant, shape (m,); a misfit costs no more than `most`."""
        return np.minimum(self.chi2, most) + self.log_det


class Expectation:
    """The state of `members` suppositions: mean (m, 17) and covariance (m, 17, 17), in V/g, V and rad."""

    def __init__(self, mean: Floats, covariance: Floats) -> None:
        self.mean = mean
        self.covariance = covariance

    @classmethod
    def about(cls, block: Block, u: Floats) -> Expectation:
        """One member about a nominal block, with the standard uncertainties `u` (12,)."""
        mean, variance = np.zeros(STATE), np.zeros(STATE)
        mean[:COEFFICIENT_COUNT], variance[:COEFFICIENT_COUNT] = block.vector, u**2
        return cls(mean[None], np.diag(variance)[None])

    def repeated(self, members: int) -> Expectation:
        """Return the first member `members` times over."""
        return Expectation(
            np.repeat(self.mean[:1], members, axis=0), np.repeat(self.covariance[:1], members, axis=0)
        )

    def member(self, index: int) -> Expectation:
        """Return one member alone."""
        return Expectation(self.mean[index : index + 1].copy(), self.covariance[index : index + 1].copy())

    @property
    def scale_factors(self) -> Floats:
        """The matrices K, V/g, shape (m, 3, 3)."""
        return self.mean[:, :9].reshape(-1, 3, 3)

    def remount(self, stand_u: Mapping[str, float]) -> None:
        """Forget the stand's angles of the last mounting; those of the new one are as the bench states."""
        self.mean[:, COEFFICIENT_COUNT:] = 0.0
        self.covariance[:, COEFFICIENT_COUNT:, :] = 0.0
        self.covariance[:, :, COEFFICIENT_COUNT:] = 0.0
        for column, name in enumerate(STAND_ANGLES, start=COEFFICIENT_COUNT):
            self.covariance[:, column, column] = stand_u.get(name, 0.0) ** 2

    def loosen(self, variance: Floats) -> None:
        """Let the coefficients have moved by so much (12,) since the last reading."""
        index = np.arange(COEFFICIENT_COUNT)
        self.covariance[:, index, index] += variance

    def predict(self, pose: ExpectedPose) -> Floats:
        """Return the signals expected at a pose, V, shape (m, 3)."""
        angles = self.mean[:, COEFFICIENT_COUNT:, None]
        force = pose.force[..., None] + pose.slopes[..., :SETTING] @ angles
        return (self.scale_factors @ force)[..., 0] + self.mean[:, 9:12] + pose.addition

    def judge(
        self, signal_v: Floats, pose: ExpectedPose, noise: NoiseSizes, further: Floats | None = None
    ) -> Judgement:
        """Hold a reading (m, 3) against what is expected of it.

        `further` (m, 3) is one more error by which the reading may be off, as one standard deviation of it.
        """
        angles = self.mean[:, COEFFICIENT_COUNT:, None]
        force = pose.force + (pose.slopes[..., :SETTING] @ angles)[..., 0]
        by_angle = self.scale_factors @ pose.slopes
        design = np.zeros((*np.broadcast_shapes(force.shape, self.mean[:, :3].shape), STATE))
        for channel in range(3):
            design[:, channel, 3 * channel : 3 * channel + 3] = force
            design[:, channel, 9 + channel] = 1.0
        design[:, :, COEFFICIENT_COUNT:] = by_angle[..., :SETTING]
        expected = (self.scale_factors @ force[..., None])[..., 0] + self.mean[:, 9:12] + pose.addition
        residual = signal_v - expected
        errors = noise.setting_rad * by_angle[..., SETTING]
        covariance = design @ self.covariance @ np.swapaxes(design, 1, 2)
        covariance += noise.reading_v**2 * np.eye(3) + errors[..., :, None] * errors[..., None, :]
        if further is not None:
            covariance = covariance + further[..., :, None] * further[..., None, :]
        chi2 = (residual * np.linalg.solve(covariance, residual[..., None])[..., 0]).sum(axis=-1)
        return Judgement(residual, covariance, chi2, np.linalg.slogdet(covariance)[1], design)

    def take(self, judged: Judgement, members: Mask | None = None) -> None:
        """Learn from a judged reading, in the members of the mask (m,) alone where one is given."""
        across = self.covariance @ np.swapaxes(judged.design, 1, 2)
        gain = np.swapaxes(np.linalg.solve(judged.covariance, np.swapaxes(across, 1, 2)), 1, 2)
        if members is not None:
            gain = gain * members[:, None, None]
        self.mean = self.mean + (gain @ judged.residual[..., None])[..., 0]
        lessened = self.covariance - gain @ np.swapaxes(across, 1, 2)
        self.covariance = 0.5 * (lessened + np.swapaxes(lessened, 1, 2))


MOST_TOLD: Final = 3
"""With more causes than that, equally likely, there is no telling yet; so many are named."""


@dataclass(frozen=True)
class EarlySign:
    """A reading that does not fit those before it.

    `sentence` tells it all; `sigma` are the residuals of x, y, z in standard deviations of the expectation,
    `channels` those that stand out, `p` the probability of so large a misfit by chance; `causes` are the
    mistakes that explain it equally well, likeliest first, empty when none does; `in_a_row` counts readings
    in succession that did not fit; `at_fault` is the place of an earlier reading where that one was wrong (and
    this one fits without it: `in_a_row` is 0). `kinds` are those of the causes. `confident`: the run is to stop and
    ask (`bench.run.watch.causes`); `wrong` is then the reading at fault (series, installation, pass, point).
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
        """Return it as the data of an event."""
        return asdict(self)


def misfit(judged: Judgement, channels: Sequence[str]) -> str:
    """Say by how much the channels of a reading are off."""
    parts = []
    for channel in channels:
        i = CHANNELS.index(channel)
        off_v, u_v = float(judged.residual[0, i]), math.sqrt(judged.covariance[0, i, i])
        parts.append(
            f"channel {channel} is {millivolts(off_v, '+')} from what was expected "
            f"(u = {millivolts(u_v)}, {abs(off_v) / u_v:.0f} sigma)"
        )
    return ", ".join(parts)


def why(causes: Sequence[str], at_fault: str | None) -> str:
    """Say what would explain a misfit; `at_fault` is the place of an earlier reading that was wrong."""
    if at_fault:
        mistake = f"the mistake is at {at_fault}, which does not fit the other readings"
        return f"{mistake}: {' or '.join(causes)}" if causes else mistake
    if not causes:
        return "no single mistake that is known explains it"
    if len(causes) > MOST_TOLD:
        told = " or ".join(causes[:MOST_TOLD])
        return f"{len(causes)} mistakes explain it so far, the likeliest: {told}"
    return f"probable cause: {' or '.join(causes)}"


def millivolts(value_v: float, sign: str = "") -> str:
    """Three digits, without an exponent."""
    digits = 0 if abs(value_v) >= 0.1 else 1 if abs(value_v) >= 0.01 else 2
    return f"{value_v * 1e3:{sign}.{digits}f} mV"
