"""Early warning: each reading is compared with the prediction from the earlier readings."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from bench.base.arrays import CHANNELS, Floats
from bench.base.languages import message
from bench.base.text import listed
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.plan import Plan, Read
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.table import UNORIENTED, Reading, readings_of
from bench.run.causes import Inquiry, Suspect, likeliest
from bench.run.confidence import LOST, Confidence
from bench.run.events import Event, EventType, Mounted
from bench.run.expectation import (
    SETTING,
    EarlySign,
    Expectation,
    ExpectedSignals,
    NoiseSizes,
    ReadingJudgement,
    RepeatNoise,
    Sighting,
    orientations,
    poses,
)
from bench.run.resume import PlanProgress
from drivers.angles import format_dms

SCALE_FACTOR_U: Final = 0.03
CROSS_AXIS_U: Final = 0.03
BIAS_U_G: Final = 0.3
"""Prior standard deviations: of K's diagonal and other elements, relative to K's diagonal; of the bias, g."""

FALSE_ALARM: Final = 0.005
"""Probability that a whole run on a good bench raises any warning."""

PAPER_READINGS: Final = 58
"""Number of readings in the paper's procedure, including verification."""

BIAS_AT_REMOUNT_G: Final = 60e-6
BIAS_PER_ROOT_HOUR_G: Final = 30e-6
SCALE_PER_ROOT_HOUR: Final = 20e-6
BIAS_PER_KELVIN_G: Final = 180e-6
SCALE_PER_KELVIN: Final = 300e-6
"""Standard deviations of changes of a good block (five constants); per kelvin, thrice the plausible ones."""

TEMPERATURE_STEP_K: Final = 0.5
"""Least change of temperature that is taken into account, K; a smaller one may be the thermometer's noise."""

GROWN: Final = 1.25
"""If the estimated noise grows by this factor, the model is fitted to all readings again, with the larger noise."""

NOISY: Final = 2.0
"""If repeats scatter by more than this multiple of the stated noise, an early sign reports it once."""

LEAST_NOISE_G: Final = 10e-6
"""Smallest noise assumed (in g), even if the bench file states no voltmeter error."""

POORLY_KNOWN: Final = 3.0
"""If a residual's standard deviation exceeds this multiple of the noise, a mistake may go unnoticed."""

Place = tuple[int, str, int, int]
"""The identity of a reading: series, installation, pass and point."""

TOLD_SIGMA: Final = 3.0
"""A warning names the channels whose residuals exceed this number of standard deviations."""


STILL: Final = 10.0
STILL_G: Final = 0.2
"""A signal is still if a change of more than `STILL_G` (g) was due, and less than 1/`STILL` of it was seen."""

MOST_LISTED: Final = 3
"""Greatest number of causes named in a sign; if there are more, the sign also states their number."""


class EarlyWarning:
    """The early warning of a run: judges each reading, and observes the run's events.

    `nominal_v_g` are the block's nominal scale factors with their signs, V/g. `stand_u` maps the stand's angles
    (rad), "setting_error" (rad) and "voltmeter_error" (V) to their standard uncertainties. `readings` is the number
    of readings of the whole run. `following` maps the `Place` of a reading (series, installation, pass, point) to
    the head angle (rad) of the next reading on the same mounting.

    The model does not learn from a reading that does not fit. One mistake therefore does not spoil later
    expectations, and a lasting mistake is reported at every reading. Call `recall` first in a resumed run.
    """

    def __init__(
        self,
        nominal_v_g: Sequence[float],
        model: ForwardModel,
        stand_u: Mapping[str, float],
        readings: int = PAPER_READINGS,
        following: Mapping[Place, float | None] | None = None,
    ) -> None:
        scale = np.abs(np.asarray(nominal_v_g, dtype=np.float64))
        self._scale = scale
        self._nominal = Block(np.diag(nominal_v_g), np.zeros(3))
        self._oriented = model.installations.keys() - UNORIENTED
        ways = {label: orientations(model.installations, label) for label in self._oriented}
        self._otherwise = {label: tuple(found) for label, found in ways.items()}
        further = {text: sat for found in ways.values() for text, sat in found.items()}
        self._model = replace(model, installations={**model.installations, **further})
        self._following = following or {}
        self._confidence = Confidence(readings, float(np.max(scale)))
        self._stand_u = dict(stand_u)
        terms = np.where(np.eye(3) == 1, SCALE_FACTOR_U, CROSS_AXIS_U) * scale[:, None]
        self._prior = Expectation.about(self._nominal, np.concatenate([terms.ravel(), BIAS_U_G * scale]))
        self._state = self._prior.repeated(1)
        reading_v = max(stand_u.get("voltmeter_error", 0.0), LEAST_NOISE_G * float(np.min(scale)))
        self._repeats = RepeatNoise(NoiseSizes(reading_v, stand_u.get("setting_error", 0.0)))
        self._learnt_with = self._repeats.sizes
        self._told_noisy = False
        self._most = float(chdtri(3, FALSE_ALARM / max(readings, 1)))
        self._history: list[Sighting] = []
        self._places: dict[tuple[int, str, int, int], Sighting] = {}
        self._visits: dict[tuple[object, ...], Sighting] = {}
        self._of_step: dict[int, Place] = {}
        self._time_s, self._temperature_c = math.nan, math.nan
        self._mounted_anew = True
        self._in_a_row = 0
        self._moved: tuple[Sighting, Suspect] | None = None
        self.judged: ReadingJudgement | None = None
        """The judgement of the last reading against the earlier ones; None if that reading was not judged."""

    @property
    def noise(self) -> NoiseSizes:
        """The present estimate of a reading's standard deviations."""
        return self._repeats.sizes

    def remounted(self) -> None:
        """Note that the block was mounted again, even if the next reading has the same installation and series."""
        self._mounted_anew = True
        self._confidence.mounted()
        self._visits.clear()  # later differences come from the remounting, not from noise

    def strike(self, places: Collection[Place]) -> None:
        """Forget the readings at `places`, because they are repeated; learn again from all other readings."""
        found = [sighting for place in places if (sighting := self._places.pop(place, None)) is not None]
        for sighting in found:
            sighting.struck = True
        if found:
            self._in_a_row, self._moved = 0, None
            self._confidence.forget()
            self._go_through_again()

    def went_on(self) -> None:
        """Note that a person continued the run after the last early sign had stopped it."""
        if self._history:
            self._confidence.went_on(self._history[-1])

    def foresee(self, reading: Reading) -> ReadingJudgement:
        """Return the judgement of a hypothetical reading, without learning from it."""
        ahead = copy.deepcopy(self)
        sighting = ahead._sight(reading)
        return ahead._state.judge(sighting.signal_v, sighting.pose, ahead.noise)

    def expect(self, reading: Reading) -> ExpectedSignals | None:
        """Return the signals expected at a planned reading; None if the block's orientation is unknown."""
        if reading.angle_deg is None or reading.installation not in self._oriented:
            return None
        ahead = copy.deepcopy(self)
        sighting = ahead._sight(reading)
        only_reading = replace(ahead.noise, setting_rad=0.0)
        judged = ahead._state.judge(np.zeros(3), sighting.pose, only_reading)
        slope = (ahead._state.scale_factors @ sighting.pose.slopes)[0, :, SETTING]
        return ExpectedSignals(-judged.residual[0], slope, judged.covariance[0])

    def take(self, reading: Reading) -> list[EarlySign]:
        """Judge a reading and learn from it; return the early signs of a misfit, usually none.

        A reading without a head angle is ignored, and so is one in an installation that the model lacks or that
        is `UNORIENTED` (free position, shorted inputs, reference). A repeated reading replaces the earlier one.
        """
        self.judged = None
        if reading.angle_deg is None or reading.installation not in self._oriented:
            return []
        if (earlier := self._places.pop(reading.place, None)) is not None:
            earlier.struck = True
            self._go_through_again()
        sighting = self._sight(reading)
        self._history.append(sighting)
        self.judged = judged = self._state.judge(sighting.signal_v, sighting.pose, self.noise)
        noise_v = math.hypot(self.noise.reading_v, self.noise.setting_rad * float(np.max(self._scale)))
        sighting.poorly_known = bool(
            np.max(judged.covariance.diagonal(0, 1, 2)) > (POORLY_KNOWN * noise_v) ** 2
        )
        sighting.taken = bool(judged.chi2[0] <= self._most)
        signs: list[EarlySign] = []
        if sighting.taken:
            self._state.take(judged)
            self._in_a_row, self._moved = 0, None
            signs += self._wrong_before(judged)
        else:
            signs.append(self._suspect(sighting, judged))
        self._learn_noise(sighting)
        if self.noise.reading_v > NOISY * self._repeats.stated.reading_v and not self._told_noisy:
            self._told_noisy = True
            signs.append(self._noisy(sighting, judged))
        return signs

    # --- the reading ---------------------------------------------------------------------------------

    def _sight(self, reading: Reading) -> Sighting:
        """Return the `Sighting` of a reading: possible poses, and its place among earlier and planned readings.

        The uncertainty of the state grows by what may have changed since the reading before.
        """
        conditions = readings_of([reading], "").conditions()
        before = self._history[-1] if self._history else None
        new_mount = self._mounted_anew or before is None or before.row.mounts != conditions.mounts
        if new_mount:
            self._confidence.mounted()
        self._mounted_anew = False
        place = message(
            f"installation {conditions.mounts[0]}, pass {reading.pass_number}, point {reading.point} at "
            f"{format_dms(float(conditions.angle_rad[0]))}"
        )
        sighting = Sighting(
            place=place,
            row=conditions,
            signal_v=np.asarray(reading.mean, dtype=np.float64),
            pose=poses(self._model, self._nominal, conditions, [reading.installation], conditions.angle_rad),
            new_mount=new_mount,
            loosened=self._changes(
                float(conditions.time_s[0]), float(conditions.temperature_c[0]), new_mount
            ),
            sat_before=self._sat_before(conditions.mounts[0].installation, new_mount),
            last_rad=None if new_mount or before is None else before.angle_rad,
            pivot_rad=None if new_mount else self._pivot_rad(),
            next_rad=self._next_rad(reading.place),
            reading_place=reading.place,
        )
        self._places[reading.place] = sighting
        if new_mount:
            self._state.remount(self._stand_u)
        self._state.loosen(sighting.loosened)
        return sighting

    def _sat_before(self, label: str, new_mount: bool) -> str | None:
        """Return the installation in which the block was before it came to `label`, None if there was none."""
        if not self._history:
            return None
        last = self._history[-1]
        if not new_mount or last.installation == label:
            return last.sat_before
        return last.installation

    def _next_rad(self, place: Place) -> float | None:
        """Return the angle, rad, planned after the reading at `place`; None if no point follows on its mounting.

        After a remounting the series exceeds every planned one; the last planned series then counts.
        """
        series, *point = place
        places = ((earlier, *point) for earlier in range(series, 0, -1))
        return next((self._following[known] for known in places if known in self._following), None)  # type: ignore[index]

    def _pivot_rad(self) -> float | None:
        """Return the head angle, rad, of the last reading on the present mounting that fitted; None without one."""
        for sighting in reversed(self._history):
            if sighting.taken and not sighting.struck:
                return sighting.angle_rad
            if sighting.new_mount:
                break
        return None

    def _changes(self, time_s: float, temperature_c: float, new_mount: bool) -> Floats:
        """Return the variances (12,) by which the coefficients may have changed since the last reading."""
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

    def _go_through_again(self) -> None:
        """Judge all readings except struck ones again, with the present noise estimate, and learn from them."""
        replay = self._inquiry().replay(self._history)
        self._adopt(replay.taken[:, 0], replay.state)

    def _adopt(self, taken: NDArray[np.bool_], state: Expectation) -> None:
        for sighting, is_taken in zip(self._history, taken, strict=True):
            sighting.taken = bool(is_taken)
        self._state = state

    def _learn_noise(self, now: Sighting) -> None:
        """Increase the noise estimate if repeats scatter more than stated.

        A pair of repeats counts if both readings fit or neither does. Otherwise the block may have slipped.
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
        return Inquiry(
            self._model, self._otherwise, self._nominal, self._prior, self._stand_u, self.noise, self._most
        )

    def _suspect(self, sighting: Sighting, judged: ReadingJudgement) -> EarlySign:
        """Return the sign for a reading that does not fit, with the mistakes that explain the reading."""
        inquiry = self._inquiry()
        of_run, replay = inquiry.of_run(self._history)
        of_reading = inquiry.of_reading(sighting, self._state, replay.before)
        causes = likeliest([*of_reading, *of_run])
        self._in_a_row += 1
        chi2, off_v = float(judged.chi2[0]), float(np.linalg.norm(judged.residual[0]))
        at_fault, still = None, ""
        before = {cause.earlier for cause in causes}
        if len(before) == 1 and (earlier := before.pop()) is not None:
            at_fault = wrong = self._history[earlier]
            causes = self._blame_earlier(earlier)
            confident = wrong.row.mounts == sighting.row.mounts and self._confidence.earlier(
                chi2, off_v, causes
            )
        else:
            causes = self._lasting(sighting, of_reading) or causes
            still = "" if causes else self._still()
            confident = self._confidence.misfits(
                sighting, chi2, off_v, causes, self._in_a_row, still=still, span_k=self._span_k()
            )
        sigma = np.abs(judged.sigma[0])
        channels = tuple(c for c, s in zip(CHANNELS, sigma, strict=True) if s > TOLD_SIGMA)
        channels = channels or (CHANNELS[int(np.argmax(sigma))],)
        found = f"{_misfit(judged, channels)}; {still or _why(causes, at_fault)}"
        text = message(f"the reading of {sighting.place} differs from the prediction: {found}")
        sign = self._sign(sighting, judged, channels, text, causes, at_fault, confident=confident)
        return replace(sign, causes=(still,)) if still else sign

    def _span_k(self) -> float:
        """Return the range of the block's known temperatures so far, K."""
        known = [t for one in self._history if math.isfinite(t := float(one.row.temperature_c[0]))]
        return max(known) - min(known) if known else 0.0

    def _still(self) -> str:
        """Return a phrase on the channels whose signals stay the same while the head turns, empty without any."""
        last = self._history[-LOST:]
        if len(last) < LOST:
            return ""
        seen = np.ptp([one.signal_v for one in last], axis=0) / self._scale
        due = np.ptp([self._nominal.output(one.pose.force[0]) for one in last], axis=0) / self._scale
        still = [
            c for c, has, should in zip(CHANNELS, seen, due, strict=True) if STILL * has < should > STILL_G
        ]
        if not still:
            return ""
        return message(
            f"the signal of {listed(still)} hardly changes while the head turns: check cable, voltmeter and supply"
        )

    def _wrong_before(self, judged: ReadingJudgement) -> list[EarlySign]:
        """Return the sign that an undecided reading was wrong, if the present reading shows this; else []."""
        found = self._confidence.fits()
        if found is None:
            return []
        wrong, causes = found
        now = self._history[-1]
        text = message(f"the reading of {now.place} fits, so {_why(causes, wrong)}")
        return [self._sign(now, judged, (), text, causes, wrong, confident=True)]

    def _noisy(self, sighting: Sighting, judged: ReadingJudgement) -> EarlySign:
        """Return the sign that the bench is noisier than its file states; `take` returns it once in a run."""
        found, stated = self.noise.reading_v, self._repeats.stated.reading_v
        cause = message("the bench is noisier than its file states")
        text = message(
            f"at {sighting.place}: repeats scatter by {_millivolts(found)}, but the bench file states "
            f"{_millivolts(stated)}; this noise may have caused the warnings so far, and it hides smaller mistakes"
        )
        sign = self._sign(sighting, judged, CHANNELS, text, [])
        return replace(sign, causes=(cause,))

    def _sign(
        self,
        sighting: Sighting,
        judged: ReadingJudgement,
        channels: tuple[str, ...],
        text: str,
        causes: Sequence[Suspect],
        at_fault: Sighting | None = None,
        *,
        confident: bool = False,
    ) -> EarlySign:
        return EarlySign(
            sentence=text,
            place=sighting.place,
            channels=channels,
            sigma=tuple(judged.sigma[0].tolist()),
            p=judged.p,
            causes=tuple(cause.text for cause in causes),
            in_a_row=self._in_a_row,
            at_fault=at_fault.place if at_fault else None,
            kinds=tuple(cause.kind for cause in causes),
            confident=confident,
            wrong=(at_fault or sighting).reading_place if confident else None,
        )

    def _blame_earlier(self, index: int) -> list[Suspect]:
        """Strike an earlier reading and relearn the model without it; return the likeliest mistakes in it."""
        wrong = self._history[index]
        replay = self._inquiry().without(self._history, index)
        self._adopt(replay.taken[:, 0], replay.state)
        wrong.struck = True
        self._in_a_row = 0
        if wrong.row.mounts != self._history[-1].row.mounts:
            return []  # the state holds the stand's angles of the present mounting only
        return likeliest(self._inquiry().of_reading(wrong, self._state, 0.0))

    def _lasting(self, sighting: Sighting, suspects: Sequence[Suspect]) -> list[Suspect]:
        """Return a lasting slip as the only cause if the last two readings have the same angle error, else []."""
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
        slipped, since = format_dms(abs(now.moved_rad)), before[0].place
        text = message(
            f"the block has slipped in its mount, or the head on its zero, by {slipped} since {since}"
        )
        return [replace(now, text=text)]

    # --- the run ---------------------------------------------------------------------------------------

    def observe(self, event: Event) -> None:
        """Update the model with an event of the run."""
        match event.type:
            case EventType.STEP_DONE:
                if isinstance(result := event.result, Reading):
                    self._of_step[event.step] = result.place
                elif isinstance(result, Mounted):
                    self.remounted()
            case EventType.REMOUNTED:
                self.remounted()
            case EventType.REDO:
                again = [self._of_step.pop(step) for step in event.steps if step in self._of_step]
                self.strike(again)
            case EventType.WENT_ON:
                self.went_on()

    def recall(self, taken: Sequence[tuple[int, Reading] | None], progress: PlanProgress) -> None:
        """Learn from the recorded readings of a resumed run.

        `taken` holds (step, reading) in the order of measurement, and None for each remounting of the block.
        Readings that were repeated, or will be repeated, are ignored.
        """
        last = {one[0]: number for number, one in enumerate(taken) if one is not None}
        for number, one in enumerate(taken):
            if one is None:
                self.remounted()
                continue
            step, reading = one
            if last[step] != number or step not in progress.done:
                continue
            self._of_step[step] = reading.place
            self.take(reading)
            if step in progress.gone_on:
                self.went_on()


def watcher_of(plan: Plan, bench: BenchFile) -> EarlyWarning:
    """Return the early warning for the readings of a plan on a bench."""
    reads = [step for step in plan.steps if isinstance(step, Read)]
    following = {
        (read.series, read.installation, read.pass_number, read.point): after.target_rad
        if after is not None and (read.series, read.installation) == (after.series, after.installation)
        else None
        for read, after in pairwise([*reads, None])
        if read is not None
    }
    return EarlyWarning(
        bench.unit_under_test.scale_factors.values,
        ForwardModel(bench.installation_models()),
        {name: distribution.u for name, distribution in bench.stand_distributions().items()},
        readings=len(reads),
        following=following,
    )


def _misfit(judged: ReadingJudgement, channels: Sequence[str]) -> str:
    """Return the deviations of the reading from the expectation: "x -30.3 mV (u = 0.45 mV, 67 σ), …"."""
    parts = []
    for channel in channels:
        i = CHANNELS.index(channel)
        off_v, u_v = float(judged.residual[0, i]), math.sqrt(judged.covariance[0, i, i])
        parts.append(
            f"{channel} {_millivolts(off_v, '+')} (u = {_millivolts(u_v)}, {abs(off_v) / u_v:.0f} σ)"
        )
    return ", ".join(parts)


def _why(causes: Sequence[Suspect], at_fault: Sighting | None) -> str:
    """Return a phrase on the causes; `at_fault` is an earlier reading that was wrong, if any."""
    listed = "; ".join(cause.text for cause in causes[:MOST_LISTED])
    why = message(f"probable cause: {listed}")
    if len(causes) > MOST_LISTED:
        why = message(f"so far {len(causes)} mistakes explain it, the likeliest: {listed}")
    elif len(causes) > 1:
        why = message(f"probable causes: {listed}")
    if at_fault is None:
        return why if causes else message("no known single mistake explains it")
    if not causes:
        return message(f"the mistake is at {at_fault.place}, which does not fit the other readings")
    return message(f"the mistake is at {at_fault.place}, which does not fit the other readings; {why}")


def _millivolts(value_v: float, sign: str = "") -> str:
    """Return a voltage in millivolts with its unit, to about three digits: 0.01234 -> "12.3 mV"."""
    digits = 0 if abs(value_v) >= 0.1 else 1 if abs(value_v) >= 0.01 else 2
    return f"{value_v * 1e3:{sign}.{digits}f} mV"
