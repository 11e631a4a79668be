"""Early warning: each reading is held against what the readings before it let the model expect.

A slipped mount, a swapped or reversed channel, a wrong setting or installation is seen at the point where
it happens. Nothing is rejected by it: the record keeps every reading, and the calibration decides later.

The test: the three residuals of a reading are, if all is well, normal with a covariance that is known from
the bench file, the prior and the readings so far; their chi-square with three degrees of freedom exceeds its
bound in one of a run's readings with the probability `FALSE_ALARM` in all. The bench file's sizes are the least
that is taken for noise, since they cover errors that repeats do not show; repeats that scatter more widen it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from bench.base.arrays import CHANNELS, Floats
from bench.model import Block, Conditions, ForwardModel
from bench.run.watch.causes import Inquiry, Replay, Sighting, Suspect, likeliest
from bench.run.watch.expectation import SETTING, Expectation, Judgement, NoiseSizes, RepeatNoise, poses
from drivers.angles import format_dms

SCALE_FACTOR_U: Final = 0.03
CROSS_AXIS_U: Final = 0.03
BIAS_U_G: Final = 0.3
"""Prior 1 σ of the coefficients about the nominal block: parts of the scale factor, and g."""

FALSE_ALARM: Final = 0.005
"""Probability that a whole run on a good bench raises any warning."""

PAPER_READINGS: Final = 58
"""Readings of the paper's procedure, verification included."""

BIAS_AT_REMOUNT_G: Final = 60e-6
BIAS_PER_ROOT_HOUR_G: Final = 30e-6
SCALE_PER_ROOT_HOUR: Final = 20e-6
BIAS_PER_KELVIN_G: Final = 180e-6
SCALE_PER_KELVIN: Final = 300e-6
"""How much a good block may change, 1 σ: what is plausible, threefold for the temperature."""

TEMPERATURE_STEP_K: Final = 0.5
"""Changes of temperature below this are the thermometer's or too small to matter."""

GROWN: Final = 1.25
"""When the noise turns out larger by this factor, what was learnt with the smaller one is learnt anew."""

NOISY: Final = 2.0
"""When repeats scatter by this factor more than the bench file states, it is told once."""

LEAST_NOISE_G: Final = 10e-6
"""A bench file that states no voltmeter error is not believed further than this."""

POORLY_KNOWN: Final = 3.0
"""An expectation this many times less certain than a reading cannot show a small mistake in it."""

MOST_TOLD: Final = 3
"""With more causes than that, equally likely, there is no telling yet."""

TOLD_SIGMA: Final = 3.0
"""Channels off by more standard deviations are named in a warning."""


@dataclass(frozen=True)
class EarlySign:
    """A reading that does not fit those before it.

    `sentence` tells it all; `sigma` are the residuals of x, y, z in standard deviations of the expectation,
    `channels` those that stand out, `p` the probability of so large a misfit by chance; `causes` are the
    mistakes that explain it equally well, likeliest first, empty when none does; `in_a_row` counts readings
    in succession that did not fit; `at_fault` is the place of an earlier reading where that one was wrong (and
    this one fits without it: `in_a_row` is 0).
    """

    sentence: str
    place: str
    channels: tuple[str, ...]
    sigma: tuple[float, float, float]
    p: float
    causes: tuple[str, ...]
    in_a_row: int
    at_fault: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as the data of an event."""
        return asdict(self)


class EarlyWarning:
    """Watches a run reading by reading; to go on with a resumed run give it the recorded readings again.

    `nominal_v_g` are the block's nominal scale factors with their signs, `stand_u` the standard uncertainties
    of the stand's angles (rad), of "setting_error" (rad) and "voltmeter_error" (V), `readings` how many the
    run takes in all. A reading that does not fit teaches the model nothing, so that one mistake does not
    spoil what follows and a lasting one goes on being told.
    """

    def __init__(
        self,
        nominal_v_g: Sequence[float],
        model: ForwardModel,
        stand_u: Mapping[str, float],
        readings: int = PAPER_READINGS,
    ) -> None:
        scale = np.abs(np.asarray(nominal_v_g, dtype=np.float64))
        self._scale = scale
        self._nominal = Block(np.diag(nominal_v_g), np.zeros(3))
        self._model = model
        self._stand_u = dict(stand_u)
        terms = np.where(np.eye(3) == 1, SCALE_FACTOR_U, CROSS_AXIS_U) * scale[:, None]
        self._prior = Expectation.about(self._nominal, np.concatenate([terms.ravel(), BIAS_U_G * scale]))
        self._state = self._prior.member(0)
        reading_v = max(stand_u.get("voltmeter_error", 0.0), LEAST_NOISE_G * float(np.min(scale)))
        self._repeats = RepeatNoise(NoiseSizes(reading_v, stand_u.get("setting_error", 0.0)))
        self._learnt_with = self._repeats.sizes
        self._told_noisy = False
        self._most = float(chdtri(3, FALSE_ALARM / max(readings, 1)))
        self._history: list[Sighting] = []
        self._places: dict[tuple[object, ...], Sighting] = {}
        self._visits: dict[tuple[object, ...], Sighting] = {}
        self._time_s, self._temperature_c = math.nan, math.nan
        self._mounted_anew = True
        self._in_a_row = 0
        self._moved: tuple[Sighting, Suspect] | None = None

    @property
    def noise(self) -> NoiseSizes:
        """The noise sizes that readings are judged with by now."""
        return self._repeats.sizes

    def remounted(self) -> None:
        """Say that the block was mounted anew, where the next row does not show it by its installation."""
        self._mounted_anew = True
        self._visits.clear()  # what differs from now on is the mounting, no noise

    def take(self, row: Mapping[str, Any]) -> list[EarlySign]:
        """Judge a reading, as the run's events hold it, and learn from it; return what is to be told.

        Rows without a known orientation (free, shorted, reference; no angle; an installation that the model
        lacks) are passed over. A reading taken again takes the place of the earlier one.
        """
        if row.get("angle_deg") is None or row["installation"] not in self._model.installations:
            return []
        self._replace_earlier(row)
        sighting = self._sight(row)
        self._history.append(sighting)
        if sighting.new_mount:
            self._state.remount(self._stand_u)
        self._state.loosen(sighting.loosened)
        judged = self._state.judge(sighting.signal_v, sighting.pose, self.noise)
        noise_v = math.hypot(self.noise.reading_v, self.noise.setting_rad * float(np.max(self._scale)))
        sighting.poorly_known = bool(
            np.max(judged.covariance.diagonal(0, 1, 2)) > (POORLY_KNOWN * noise_v) ** 2
        )
        sighting.taken = bool(judged.chi2[0] <= self._most)
        told: list[EarlySign] = []
        if sighting.taken:
            self._state.take(judged)
            self._in_a_row, self._moved = 0, None
        else:
            told.append(self._suspect(sighting, judged))
        self._learn_noise(sighting)
        if self.noise.reading_v > NOISY * self._repeats.stated.reading_v and not self._told_noisy:
            self._told_noisy = True
            told.append(self._noisy(sighting, judged))
        return told

    # --- the reading ---------------------------------------------------------------------------------

    def _sight(self, row: Mapping[str, Any]) -> Sighting:
        """Make a sighting of a row, with what may have changed since the last one."""
        label, angle = str(row["installation"]), math.radians(float(row["angle_deg"]))
        time_s, temperature_c = (_number(row.get(name)) for name in ("time_s", "temperature_c"))
        conditions = Conditions.of(
            [label],
            [angle],
            series=[int(row["series"])],
            pass_number=[int(row["pass"])],
            point=[int(row["point"])],
            direction=[int(row["direction"])],
            time_s=[time_s],
            temperature_c=[temperature_c],
        )
        new_mount = self._mounted_anew or self._history[-1].row.mounts != conditions.mounts
        self._mounted_anew = False
        mount = str(conditions.mounts[0])
        sighting = Sighting(
            place=f"installation {mount}, pass {row['pass']}, point {row['point']} at {format_dms(angle)}",
            row=conditions,
            signal_v=np.asarray(row["mean"], dtype=np.float64),
            pose=poses(self._model, self._nominal, conditions, [label], np.array([angle])),
            new_mount=new_mount,
            loosened=self._changes(time_s, temperature_c, new_mount),
        )
        self._places[_place(row)] = sighting
        return sighting

    def _changes(self, time_s: float, temperature_c: float, new_mount: bool) -> Floats:
        """Variances (12,) by which the coefficients may have changed since the last reading."""
        hours = max(0.0, time_s - self._time_s) / 3600.0 if math.isfinite(time_s - self._time_s) else 0.0
        self._time_s = self._time_s if math.isnan(time_s) else time_s
        kelvin = temperature_c - self._temperature_c
        if math.isnan(self._temperature_c) or abs(kelvin) > TEMPERATURE_STEP_K:
            self._temperature_c = temperature_c
        kelvin = kelvin if abs(kelvin) > TEMPERATURE_STEP_K else 0.0
        scale = SCALE_PER_ROOT_HOUR**2 * hours + (SCALE_PER_KELVIN * kelvin) ** 2
        bias = BIAS_PER_ROOT_HOUR_G**2 * hours + (BIAS_PER_KELVIN_G * kelvin) ** 2
        bias += BIAS_AT_REMOUNT_G**2 * new_mount
        variances = self._scale**2
        return np.concatenate([np.repeat(scale * variances, 3), bias * variances])

    def _replace_earlier(self, row: Mapping[str, Any]) -> None:
        """Strike the reading that this one repeats, and make the model forget it."""
        earlier = self._places.pop(_place(row), None)
        if earlier is None:
            return
        earlier.struck = True
        self._go_through_again()

    def _go_through_again(self) -> None:
        """Judge and learn all readings anew, with what is known by now of the noise and of mistakes."""
        replay = self._inquiry().replay(self._history)
        self._adopt(replay.taken[:, 0], replay.state)

    def _adopt(self, taken: NDArray[np.bool_], state: Expectation) -> None:
        for sighting, is_taken in zip(self._history, taken, strict=True):
            sighting.taken = bool(is_taken)
        self._state = state

    def _learn_noise(self, now: Sighting) -> None:
        """Widen the noise where repeats scatter more than stated.

        Only pairs that both fit or both do not: else the step of a slipped block would pass for noise.
        """
        row = now.row
        key = (row.mounts[0], int(row.point[0]), int(row.direction[0]))
        before = self._visits.get(key)
        self._visits[key] = now
        if before is None or before.struck or before.taken is not now.taken:
            return
        expected = self._state.predict(now.pose) - self._state.predict(before.pose)
        slope = (self._state.scale_factors @ now.pose.slopes)[0, :, SETTING]
        self._repeats.add(now.signal_v - before.signal_v - expected[0], slope)
        found, used = self.noise, self._learnt_with
        if found.reading_v > GROWN * used.reading_v or found.setting_rad > GROWN * used.setting_rad:
            self._learnt_with = found
            self._go_through_again()

    # --- a reading that does not fit -----------------------------------------------------------------

    def _inquiry(self) -> Inquiry:
        return Inquiry(self._model, self._nominal, self._prior, self._stand_u, self.noise, self._most)

    def _suspect(self, sighting: Sighting, judged: Judgement) -> EarlySign:
        """Find the mistakes that explain the reading, and tell them."""
        inquiry = self._inquiry()
        of_run, replay = inquiry.of_run(self._history)
        of_reading = inquiry.of_reading(sighting, self._state, replay.before)
        causes = likeliest([*of_reading, *of_run])
        self._in_a_row += 1
        at_fault, texts = None, [suspect.text for suspect in causes]
        if len(causes) == 1 and causes[0].earlier is not None:
            at_fault, texts = self._blame_earlier(causes[0].earlier, replay, causes[0].member)
        else:
            texts = self._lasting(sighting, of_reading) or texts
        sigma = judged.sigma[0]
        channels = tuple(c for c, s in zip(CHANNELS, np.abs(sigma), strict=True) if s > TOLD_SIGMA)
        channels = channels or (CHANNELS[int(np.argmax(np.abs(sigma)))],)
        sentence = _sentence(sighting, judged, channels, texts, at_fault)
        return _sign(sentence, sighting, judged, channels, texts, self._in_a_row, at_fault)

    def _noisy(self, sighting: Sighting, judged: Judgement) -> EarlySign:
        """Tell, once, that the bench is noisier than its file states."""
        found, stated = self.noise.reading_v, self._repeats.stated.reading_v
        cause = "the bench is noisier than its file states"
        sentence = (
            f"{sighting.place}: repeats scatter by {_millivolts(found)} where the bench file states "
            f"{_millivolts(stated)}; warnings so far may come from that, and mistakes below it cannot be seen"
        )
        return _sign(sentence, sighting, judged, CHANNELS, (cause,), self._in_a_row)

    def _blame_earlier(self, index: int, replay: Replay, member: int) -> tuple[str, list[str]]:
        """Strike an earlier reading and go on from the model without it; return its place and the causes."""
        wrong = self._history[index]
        self._adopt(replay.taken[:, member], replay.state.member(member))
        wrong.struck = True
        self._in_a_row = 0
        if wrong.row.mounts != self._history[-1].row.mounts:
            return wrong.place, []  # the stand's angles of its mounting are forgotten by now
        causes = likeliest(self._inquiry().of_reading(wrong, self._state, 0.0))
        return wrong.place, [suspect.text for suspect in causes]

    def _lasting(self, sighting: Sighting, suspects: Sequence[Suspect]) -> list[str]:
        """Tell a slip that stays from one wrong setting: the same angle as at the reading before."""
        now = next((s for s in suspects if s.moved_rad is not None), None)
        before, self._moved = self._moved, None
        if now is None or now.moved_rad is None:
            return []
        self._moved = (sighting, now)
        if before is None or before[0].row.mounts != sighting.row.mounts or before[1].moved_rad is None:
            return []
        if abs(now.moved_rad - before[1].moved_rad) > TOLD_SIGMA * math.hypot(now.u_rad, before[1].u_rad):
            return []
        self._moved = (before[0], now)
        slipped = format_dms(abs(now.moved_rad))
        return [
            f"the block has slipped in its mount, or the head on its zero, by {slipped} since {before[0].place}"
        ]


def _sign(
    sentence: str,
    sighting: Sighting,
    judged: Judgement,
    channels: Sequence[str],
    causes: Sequence[str],
    in_a_row: int,
    at_fault: str | None = None,
) -> EarlySign:
    x, y, z = (float(value) for value in judged.sigma[0])
    p = float(chdtrc(3, judged.chi2[0]))
    return EarlySign(
        sentence, sighting.place, tuple(channels), (x, y, z), p, tuple(causes), in_a_row, at_fault
    )


def _sentence(
    sighting: Sighting,
    judged: Judgement,
    channels: Sequence[str],
    causes: Sequence[str],
    at_fault: str | None,
) -> str:
    """Tell in one sentence where, by how much, and what would explain it."""
    parts = []
    for channel in channels:
        i = CHANNELS.index(channel)
        off_v, u_v = float(judged.residual[0, i]), math.sqrt(judged.covariance[0, i, i])
        parts.append(
            f"channel {channel} is {_millivolts(off_v, '+')} from what was expected "
            f"(u = {_millivolts(u_v)}, {abs(off_v) / u_v:.0f} sigma)"
        )
    told = ", ".join(parts)
    if at_fault:
        why = f"the mistake is at {at_fault}, which does not fit the other readings"
        why += f": {' or '.join(causes)}" if causes else ""
    elif not causes:
        why = "no single mistake that is known explains it"
    elif len(causes) > MOST_TOLD:
        why = f"{len(causes)} mistakes explain it so far, one of them: {causes[0]}"
    else:
        why = f"probable cause: {' or '.join(causes)}"
    return f"{sighting.place}: {told}; {why}"


def _millivolts(value_v: float, sign: str = "") -> str:
    """Three digits, without an exponent."""
    digits = 0 if abs(value_v) >= 0.1 else 1 if abs(value_v) >= 0.01 else 2
    return f"{value_v * 1e3:{sign}.{digits}f} mV"


def _place(row: Mapping[str, Any]) -> tuple[object, ...]:
    return (row["series"], row["installation"], row["pass"], row["point"])


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
