"""The check of a bench each morning: a short course of a commissioning session."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal, Protocol, runtime_checkable

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.base.languages import message
from bench.base.text import degrees
from bench.config.devices.sections import HeadForm, MotorisedHeadForm
from bench.readings.table import Reading
from bench.run.commission import meters
from bench.run.commission.course import BENCH, IDENTITY, HasScale, who
from bench.run.commission.devices import MANUAL_WAY_RAD
from bench.run.commission.session import CommissioningSession, Figure, Finding, SessionEnded, Skipped, State
from bench.run.expectation import ReadingJudgement
from drivers.angles import format_dms, wrapped_rad
from drivers.interfaces import Direction, HeadPosition, Instrument, SelfTesting, Voltmeter
from drivers.person import SwitchInputs, watching

SELF_TEST: Final = message("self-test", "heading")
REFERENCE: Final = message("reference", "heading")
INPUTS: Final = message("inputs", "heading")
HOME: Final = message("home", "heading")
TURN: Final = message("away and back")
RETURN: Final = message("home and back")
CHECK_BLOCK: Final = message("check block")

WAY_RAD: Final = math.radians(45.0)
KEY: Final = "morning/head"
SHORTED_S: Final = 120.0
"""Time from shorting the inputs to reading their noise, s: the hand has warmed the contacts."""
LOOK_S: Final = 1.0
"""Interval at which the program checks whether a job is due while the person turns the head, s."""
SAMPLES: Final = 10
SIGMAS: Final = 3.0
"""When signals or angles are compared, a difference up to this many standard deviations counts as chance."""
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
        """Carry out all checks.

        Raises `SessionEnded` if the person ends them or no voltmeter responds, and `KeyboardInterrupt`.
        """
        head = evening.instruments.head
        form = evening.section(head.name)
        with_head = partial(
            evening.carry_out, instrument=head, also=evening.instruments.voltmeters, by_answers=False
        )
        stands: list[_Stand] = []
        returned_rad: list[float] = []
        for instrument in evening.instruments.all():
            evening.carry_out(IDENTITY, instrument, partial(who, evening, instrument))
        if not any(meter.name in evening.identities for meter in evening.instruments.voltmeters):
            raise SessionEnded(
                "no voltmeter responds, so nothing else was checked; check the meters' power, "
                "cables and addresses"
            )
        if not isinstance(form, MotorisedHeadForm):
            with_head(HOME, look=partial(_at_home, evening, stands))
        jobs = _jobs(
            evening,
            shorted=_connected(evening, f"{meters.SHORT_INPUTS}. Are all inputs shorted?", "short"),
        )
        if stands:
            look = partial(_there_and_back, evening, stands[0].angle_rad, returned_rad)
            _meanwhile(evening, jobs, partial(evening.carry_out, TURN, head, look))
        for job in jobs:
            job.wait_and_carry_out(evening)
        if self.reference_v is None:
            evening.note(Finding(REFERENCE, BENCH, State.SKIPPED, "no --reference is given"))
        else:
            self._reference(evening, self.reference_v)
        block = (
            f"check block {self.serial} in installation {self.installation}" if self.serial else "the block"
        )
        if _connected(evening, f"Connect the signals of {block} again. Done?", "signal"):
            if isinstance(form, MotorisedHeadForm):
                with_head(RETURN, look=partial(_moved, evening, form, stands))
            elif returned_rad:
                with_head(RETURN, look=partial(_back, evening, stands, returned_rad[0]))
        evening.note(self._check_block(stands))

    def _reference(self, evening: CommissioningSession, volts: float) -> None:
        text = f"Take the shorts off and connect the reference of {volts:g} V to all inputs. Done?"
        if _connected(evening, text, "reference", volts):
            meters.SharedReading(evening, SAMPLES).checks(REFERENCE, partial(_held, evening, volts))

    def _check_block(self, stands: list[_Stand]) -> Finding:
        if not self.serial:
            return Finding(CHECK_BLOCK, BENCH, State.SKIPPED, "the bench file states none")
        if self.judge is None or len(stands) < 2:
            why = self.no_chart or message("not measured, because the head did not return")
            return Finding(CHECK_BLOCK, self.serial, State.SKIPPED if self.no_chart else State.COULD_NOT, why)
        last = stands[-1]
        x, y, z = last.signals_v
        reading = Reading(
            installation=self.installation, series=1, pass_number=1, point=1,
            target_deg=math.degrees(last.target_rad), angle_deg=math.degrees(last.angle_rad), direction=1,
            mean=(x, y, z),
        )  # fmt: skip
        return _judged(self.serial, reading, self.judge(reading))


@runtime_checkable
class _TurnedByPerson(Protocol):
    """A head whose scale a person reads (`drivers.instruments.manual.ManualHead`)."""

    def stands_at(self, key: str) -> float:
        """Ask for the angle at which the head stands, rad."""
        ...

    def return_to(
        self, target_rad: float, direction: Direction, key: str, *, by_way_of_rad: float
    ) -> HeadPosition:
        """Ask the person to turn to `by_way_of_rad`, then to `target_rad`; return the last angle."""
        ...


@dataclass(frozen=True)
class _Stand:
    """The head at rest near `target_rad`: the angle read, rad, and the three signals there, V."""

    target_rad: float
    angle_rad: float
    signals_v: Floats


@dataclass(frozen=True)
class _Job:
    """A check that needs no person, to be carried out at the time `due_s` of the clock or later."""

    due_s: float
    carry_out: Callable[[], object]

    def wait_and_carry_out(self, evening: CommissioningSession) -> None:
        left_s = self.due_s - evening.clock.now_s()
        if left_s > 0.0:
            evening.tell(f"Waiting {left_s:.0f} s: the shorted inputs take the temperature of the room.")
            evening.clock.sleep(left_s)
        self.carry_out()


def _jobs(evening: CommissioningSession, *, shorted: bool) -> list[_Job]:
    jobs = [
        _Job(0.0, partial(evening.carry_out, SELF_TEST, one, partial(_tested, one), by_answers=False))
        for one in evening.instruments.all()
        if isinstance(one, SelfTesting) and not evening.section(one.name).by_hand
    ]
    if shorted:
        jobs.append(_Job(evening.clock.now_s() + SHORTED_S, partial(meters.measure_noise, evening)))
    return jobs


def _connected(
    evening: CommissioningSession,
    text: str,
    source: Literal["signal", "short", "reference"],
    reference_v: float | None = None,
) -> bool:
    """Ask the person to connect the inputs of the voltmeters; return whether it is done."""
    action: SwitchInputs = {"do": "select_input", "source": source}
    if reference_v is not None:
        action["reference_v"] = reference_v
    try:
        evening.confirm(text, action=action)
    except Skipped as why:
        evening.note(Finding(INPUTS, BENCH, State.SKIPPED, str(why)))
        return False
    return True


def _meanwhile(evening: CommissioningSession, jobs: list[_Job], ask: Callable[[], object]) -> None:
    """Ask the person; meanwhile carry out the first jobs that are due, and remove them from `jobs`.

    Lines that the jobs tell are shown afterwards. If the head has an encoder, no job is carried out: the program
    would not see the head's approach.
    """
    if not isinstance(evening.instruments.head, _TurnedByPerson):
        ask()
        return
    told: list[str] = []
    tell, evening.tell = evening.tell, told.append

    def look() -> None:
        if jobs and jobs[0].due_s <= evening.clock.now_s():
            jobs.pop(0).carry_out()

    try:
        with watching(evening.person, look, LOOK_S, evening.clock):
            ask()
    finally:
        evening.tell = tell
        for line in told:
            tell(line)


# --- the head ---------------------------------------------------------------------------------------


def _at_home(evening: CommissioningSession, stands: list[_Stand]) -> Finding:
    """Read the signals at 0°. A head that was left there is not turned."""
    head = evening.instruments.head
    form = evening.section(head.name)
    angle_rad = math.inf
    if isinstance(head, _TurnedByPerson):
        angle_rad = head.stands_at(f"{KEY}-0")
    elif isinstance(head, HasScale):
        angle_rad = wrapped_rad(head.position_rad())
    if not isinstance(form, HeadForm) or abs(angle_rad) > form.tolerance:
        angle_rad = head.move(0.0, 1, f"{KEY}-1").angle_rad
    stands.append(_Stand(0.0, angle_rad, _signals(evening)))
    return Finding(HOME, head.name, State.WORKS, f"stands at {format_dms(angle_rad)}")


def _there_and_back(evening: CommissioningSession, home_rad: float, returned_rad: list[float]) -> Finding:
    """Have the head turned away and back to the angle at which it stood; note the angle read then."""
    head = evening.instruments.head
    if isinstance(head, _TurnedByPerson):
        position = head.return_to(home_rad, 1, f"{KEY}-2", by_way_of_rad=MANUAL_WAY_RAD)
    else:
        if not isinstance(head, HasScale):  # an encoder itself sees that the head leaves its angle
            head.move(MANUAL_WAY_RAD, 1, f"{KEY}-2")
        position = head.move(home_rad, 1, f"{KEY}-3")
    returned_rad.append(position.angle_rad)
    said = f"was turned away and back to {format_dms(position.angle_rad)}"
    return Finding(TURN, head.name, State.WORKS, said)


def _back(evening: CommissioningSession, stands: list[_Stand], angle_rad: float) -> Finding:
    """Read the signals after the return, and compare them with the signals before."""
    stands.append(_Stand(0.0, angle_rad, _signals(evening)))
    return _compared(evening, *stands)


def _moved(evening: CommissioningSession, form: MotorisedHeadForm, stands: list[_Stand]) -> Finding:
    """Move a motorised head home, away and home again; read the signals at home both times, and compare."""
    head = evening.instruments.head
    home = min(max(0.0, form.minimum + form.backoff), form.maximum - form.backoff)
    way = min(WAY_RAD, form.maximum - home)
    evening.confirm(
        f"The head will turn to {degrees(home)}, {degrees(home + way)} and back. Is the way clear?",
        action={"do": "stand_clear"},
    )
    for number, target in enumerate((home, home + way, home), start=1):
        position = head.move(target, 1, f"{KEY}-{number}")
        if target == home:
            stands.append(_Stand(home, position.angle_rad, _signals(evening)))
    return _compared(evening, *stands)


def _tested(instrument: Instrument) -> Finding:
    said = instrument.self_test() if isinstance(instrument, SelfTesting) else ""
    if not said:
        return Finding(SELF_TEST, instrument.name, State.WORKS, "passed")
    remedy = "disconnect its input and test again; if it fails again, have it serviced"
    return Finding(SELF_TEST, instrument.name, State.OTHER, f"failed: {said}", remedy=remedy)


def _held(
    evening: CommissioningSession, volts: float, meter: Voltmeter, shared: meters.SharedReading
) -> Finding:
    _, samples, _ = shared.of(meter)
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
    shared = meters.SharedReading(evening, SAMPLES)
    means: dict[str, float] = {}
    for meter in evening.instruments.voltmeters:
        _, samples, _ = shared.of(meter)
        means |= {channel: float(np.mean(values)) for channel, values in samples.items()}
    return np.array([means[channel] for channel in CHANNELS])


def _compared(evening: CommissioningSession, first: _Stand, second: _Stand) -> Finding:
    turned_rad, changed_v = second.angle_rad - first.angle_rad, second.signals_v - first.signals_v
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
    remedy = (
        "check the clamping of block and head and the cables of the signals, and let block and voltmeters warm "
        "up; then check again"
    )
    return Finding(RETURN, name, State.OTHER, said, figures, remedy)


def _judged(serial: str, reading: Reading, judged: ReadingJudgement) -> Finding:
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
