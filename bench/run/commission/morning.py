"""The check of a bench each morning: a short course of a commissioning session."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.base.text import degrees
from bench.config.devices.sections import MotorisedHeadForm
from bench.readings.reading import Reading
from bench.run.commission import meters
from bench.run.commission.course import IDENTITY, who
from bench.run.commission.devices import MANUAL_WAY_RAD
from bench.run.commission.session import CommissioningSession, Figure, Finding, State
from bench.run.expectation import ReadingJudgement
from drivers.interfaces import Instrument, SelfTesting, Voltmeter

SELF_TEST: Final = "self-test"
REFERENCE: Final = "reference"
RETURN: Final = "home and back"
CHECK_BLOCK: Final = "check block"

WAY_RAD: Final = math.radians(45.0)
SAMPLES: Final = 10
SIGMAS: Final = 3.0
"""After the head's return, a difference of more than this many standard deviations is reported."""
LEAST_P: Final = 0.0027
"""A reading of the check block with a smaller p-value is reported; by chance, once in 370 mornings."""


@dataclass(frozen=True)
class MorningCourse:
    """The course of a morning check: tests of instruments and head, and the checks that the fields select.

    `reference_v` is the voltage of the reference, None without one. `judge` compares a reading of the check block
    in `installation` with its control chart; if it is None, `no_chart` says why. `serial` is "" for a bench
    without a check block.
    """

    reference_v: float | None = None
    serial: str = ""
    installation: str = "1"
    judge: Callable[[Reading], ReadingJudgement] | None = None
    no_chart: str = ""

    def __call__(self, evening: CommissioningSession) -> None:
        """Carry out all checks. Raises `SessionEnded` if the person ends them, and `KeyboardInterrupt`."""
        for instrument in evening.instruments.all():
            evening.carry_out(IDENTITY, instrument, partial(who, evening, instrument))
        meters.short_inputs(evening)
        for instrument in evening.instruments.all():
            if isinstance(instrument, SelfTesting) and not evening.section(instrument.name).by_hand:
                evening.carry_out(SELF_TEST, instrument, partial(_tested, instrument), by_answers=False)
        meters.measure_noise(evening)
        if self.reference_v is not None:
            self._reference(evening, self.reference_v)
        evening.confirm(
            "Connect the signals of the block again. Done?",
            action={"do": "select_input", "source": "signal"},
        )
        if self.serial:
            evening.confirm(
                f"Is check block {self.serial} mounted in installation {self.installation}?",
                action={"do": "mount", "installation": self.installation, "series": 1},
            )
        self._head(evening)

    def _reference(self, evening: CommissioningSession, volts: float) -> None:
        evening.confirm(
            f"Take the shorts off and connect the reference of {volts:g} V to all inputs. Done?",
            action={"do": "select_input", "source": "reference", "reference_v": volts},
        )
        for meter in evening.instruments.voltmeters:
            evening.carry_out(REFERENCE, meter, partial(_held, evening, meter, volts), by_answers=False)

    def _head(self, evening: CommissioningSession) -> None:
        """Turn the head home, away and home again; compare the last reading with the check block's chart."""
        last: list[Reading] = []
        head, voltmeters = evening.instruments.head, evening.instruments.voltmeters
        evening.carry_out(
            RETURN, head, partial(self._returned, evening, last), also=voltmeters, by_answers=False
        )
        if not self.serial:
            return
        if self.judge is None or not last:
            why = self.no_chart or "not measured, because the head did not return"
            state = State.SKIPPED if self.no_chart else State.COULD_NOT
            evening.note(Finding(CHECK_BLOCK, self.serial, state, why))
        else:
            evening.note(_judged(self.serial, last[0], self.judge(last[0])))

    def _returned(self, evening: CommissioningSession, last: list[Reading]) -> Finding:
        head = evening.instruments.head
        form = evening.section(head.name)
        home, way = 0.0, MANUAL_WAY_RAD
        if isinstance(form, MotorisedHeadForm):
            home = min(max(home, form.minimum + form.backoff), form.maximum - form.backoff)
            way = min(WAY_RAD, form.maximum - home)
            evening.confirm(
                f"The head will turn to {degrees(home)}, {degrees(home + way)} and back. Is the way clear?",
                action={"do": "stand_clear"},
            )
        found = []
        for number, target in enumerate((home, home + way, home), start=1):
            position = head.move(target, 1, f"morning/head-{number}")
            if target == home:
                found.append((position.angle_rad, _signals(evening)))
        (first_rad, first_v), (second_rad, second_v) = found
        last.append(
            Reading(
                installation=self.installation, series=1, pass_number=1, point=1,
                target_deg=math.degrees(home), angle_deg=math.degrees(second_rad), direction=1,
                mean=(second_v[0], second_v[1], second_v[2]),
            )
        )  # fmt: skip
        return _compared(evening, second_rad - first_rad, second_v - first_v)


def _tested(instrument: Instrument) -> Finding:
    said = instrument.self_test() if isinstance(instrument, SelfTesting) else ""
    if not said:
        return Finding(SELF_TEST, instrument.name, State.WORKS, "passed")
    remedy = "disconnect its input and test again; if it fails again, have it serviced"
    return Finding(SELF_TEST, instrument.name, State.OTHER, f"failed: {said}", remedy=remedy)


def _held(evening: CommissioningSession, meter: Voltmeter, volts: float) -> Finding:
    """Return the finding on the errors of a meter's channels at the reference voltage `volts`."""
    meter.configure(meters.slow(evening, meter, SAMPLES))
    samples, _ = meters.reading(evening, meter)
    stated_v = evening.file.stand_distributions()["voltmeter_error"].limit
    limit_v = max(meters.limit_v(evening, meter, volts), stated_v)
    off = {channel: float(np.mean(values)) - volts for channel, values in samples.items()}
    figures = tuple(
        Figure(f"{channel} less the reference", 1e6 * value, "µV", f"±{1e6 * limit_v:.3g} µV")
        for channel, value in off.items()
    )
    wrong = [
        channel
        for channel, value in off.items()
        if abs(value)
        > limit_v + SIGMAS * float(np.std(samples[channel], ddof=1)) / math.sqrt(len(samples[channel]))
    ]
    if not wrong:
        return Finding(REFERENCE, meter.name, State.WORKS, f"reads {volts:g} V within its limits", figures)
    said = f"{', '.join(wrong)} differs from {volts:g} V by more than {1e6 * limit_v:.3g} µV"
    remedy = "check the reference and its cables; if the others agree with it, have this meter adjusted"
    return Finding(REFERENCE, meter.name, State.OTHER, said, figures, remedy)


def _signals(evening: CommissioningSession) -> Floats:
    """Return the means of the three channels, V."""
    means: dict[str, float] = {}
    for meter in evening.instruments.voltmeters:
        meter.configure(meters.slow(evening, meter, SAMPLES))
        meter.start()
        means |= {channel: float(np.mean(values)) for channel, values in meter.fetch().items()}
    return np.array([means[channel] for channel in CHANNELS])


def _compared(
    evening: CommissioningSession,
    turned_rad: float,
    changed_v: Floats,
) -> Finding:
    """Return the finding on the head's return home, from the changes since the start.

    `turned_rad` is the change of the angle read, `changed_v` (3,) the change of the signals.
    """
    stand = evening.file.stand_distributions()
    setting_rad = stand["setting_error"].u
    scale = np.abs(evening.file.unit_under_test.scale_factors.values)
    most_rad = SIGMAS * math.sqrt(2.0) * setting_rad
    most_v = SIGMAS * math.sqrt(2.0) * np.hypot(stand["voltmeter_error"].u, setting_rad * scale)
    arcsec = 3600.0 * math.degrees(1.0)
    figures = (
        Figure("second angle less first", turned_rad * arcsec, "″", f"±{most_rad * arcsec:.2g}″"),
        *(
            Figure(f"{channel} changed by", 1e6 * float(change), "µV", f"±{1e6 * float(most):.3g} µV")
            for channel, change, most in zip(CHANNELS, changed_v, most_v, strict=True)
        ),
    )
    name = evening.instruments.head.name
    beyond = [
        channel
        for channel, change, most in zip(CHANNELS, changed_v, most_v, strict=True)
        if abs(change) > most
    ]
    if abs(turned_rad) <= most_rad and not beyond:
        return Finding(
            RETURN, name, State.WORKS, f"came back to within {abs(turned_rad) * arcsec:.1f}″", figures
        )
    said = f"came back with an error of {turned_rad * arcsec:+.1f}″" + (
        f"; {', '.join(beyond)} changed" if beyond else ""
    )
    remedy = "check the clamping of block and head, and let block and voltmeters warm up; then check again"
    return Finding(RETURN, name, State.OTHER, said, figures, remedy)


def _judged(serial: str, reading: Reading, judged: ReadingJudgement) -> Finding:
    """Return the finding on whether a reading of the check block agrees with the control chart."""
    figures = tuple(
        Figure(
            f"{channel} less expected", 1e6 * float(off), "µV", f"u {1e6 * math.sqrt(float(variance)):.3g} µV"
        )
        for channel, off, variance in zip(
            CHANNELS, judged.residual[0], np.diagonal(judged.covariance[0]), strict=True
        )
    )
    where = f"installation {reading.installation} at {degrees(math.radians(reading.target_deg or 0.0))}"
    if judged.p >= LEAST_P:
        return Finding(CHECK_BLOCK, serial, State.WORKS, f"{where} agrees with its control chart", figures)
    said = f"{where} differs from its control chart (p = {judged.p:.1g})"
    remedy = (
        "check mounting and warm-up; if the difference remains, measure the check block with its whole "
        "procedure and run 'bench chart'"
    )
    return Finding(CHECK_BLOCK, serial, State.OTHER, said, figures, remedy)
