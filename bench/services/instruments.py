"""Instruments of a bench opened, tested and read in parallel; commissioning sessions; the morning check."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.arrays import ARCSEC
from bench.base.computing import versions
from bench.base.files import to_text, write_whole
from bench.base.languages import message, translated
from bench.base.numbers import without_infinity
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.devices.sections import ChamberForm, HeadForm, SupplyForm
from bench.model.forward import ForwardModel
from bench.readings.table import Reading, readings_of
from bench.results.records import CommissionedPart, CommissionResult, InstrumentPart, render_commissioning
from bench.run.assembly.served import dry_evening, real_bench, real_evening
from bench.run.commission.course import HasScale, go_through
from bench.run.commission.morning import MorningCourse
from bench.run.commission.session import CommissioningSession, SessionEnded, status_of
from bench.run.driver_checks import (
    checked_identity,
    checked_inclination,
    checked_samples,
    checked_temperature,
    named_fault,
)
from bench.run.expectation import COEFFICIENT_COUNT, STATE, Expectation, NoiseSizes, ReadingJudgement, poses
from bench.run.instruments import leave_safe
from bench.run.interrupts import Interrupts
from bench.run.workbench import QUICK_NPLC
from bench.services.bench_selection import bench_path
from bench.services.errors import Refused, refusing
from bench.services.own_effects import simulated_truth
from bench.services.requests.measuring import Check
from bench.services.requests.shared import runs_folder
from drivers.angles import format_dms
from drivers.clock import Clock, Haste, utc_now
from drivers.interfaces import (
    BenchError,
    Identity,
    Instrument,
    InstrumentLost,
    Level,
    NoAnswer,
    PowerSupply,
    SelfTesting,
    ThermalChamber,
    Thermometer,
    Voltmeter,
    VoltmeterSettings,
)
from drivers.making_safe import let_go
from drivers.person import Answer, Person, Prompt
from drivers.wire.replay import WireLog, logged_wire

_LONGEST_S: Final = 180.0
"""Time (s) after which a driver is reported as lost if its own timeouts have not ended it."""

_BY_HAND: Final = "manual"
_NO_TEST: Final = "none"
_PASSED: Final = "passed"


class Nobody:
    """A `Person` that answers no question, so that manual instruments are left alone."""

    def ask(self, prompt: Prompt) -> Answer:
        """Raise `NoAnswer`."""
        raise NoAnswer("operator", "nobody is asked here", "carry out a run to be asked")


@dataclass
class InstrumentLook:
    """The findings on one instrument; `failure` is the first fault.

    `samples` is the number of samples of a voltmeter's reading. If the instrument could not be made safe, `to_do`
    states what a person must do.
    """

    name: str
    address: str
    settings: str
    identity: Identity | None = None
    self_test: str = ""
    shows: str = ""
    value: dict[str, float] | float | None = None
    failure: BenchError | None = None
    samples: int = 1
    to_do: str = ""

    @property
    def test_failed(self) -> bool:
        """Whether the self-test reported a fault."""
        return self.self_test not in ("", _NO_TEST, _BY_HAND, _PASSED)

    @property
    def failures(self) -> list[BenchError]:
        """All faults, including a failed self-test."""
        found = [self.failure] if self.failure is not None else []
        if self.test_failed:
            remedy = "disconnect its input and test again; if it fails again, have it serviced"
            found.append(BenchError(self.name, f"its self-test failed: {self.self_test}", remedy))
        if self.to_do:
            found.append(BenchError(self.name, "it could not be made safe", self.to_do))
        return found

    @property
    def absent(self) -> bool:
        """Whether the instrument could not be opened, or was lost while it was tested or read."""
        return self.failure is not None and (
            self.identity is None or isinstance(self.failure, InstrumentLost)
        )

    @property
    def part(self) -> InstrumentPart:
        """The findings as a part of the result."""
        return InstrumentPart.from_object(self)


def look_at(file: BenchFile, wire: WireLog | None, haste: Haste | None = None) -> list[InstrumentLook]:
    """Open, test, read and close all instruments in parallel; `haste` ends the wait for missing answers."""
    assembly = real_bench(file, Nobody(), wire, haste)
    instruments = assembly.instruments.all()
    rows = [_row(file, instrument) for instrument in instruments]
    _look_at_all(instruments, rows, file.voltmeter_range_v, assembly.clock)
    return rows


def _row(file: BenchFile, instrument: Instrument) -> InstrumentLook:
    """Return an `InstrumentLook` with only the instrument's address and settings from the bench file."""
    section = next(section for section in file.instruments.all() if section.name == instrument.name)
    address = getattr(section, "resource", None)
    settings = ""
    if isinstance(section, HeadForm):
        settings = f"within {format_dms(section.tolerance)}"
    elif isinstance(section, ChamberForm):
        settings = f"{section.minimum:g} to {section.maximum:g} °C"
    elif isinstance(section, SupplyForm) and section.limits is not None:
        settings = f"outputs {', '.join(section.limits.outputs)}"
    where = "by hand" if address is None else str(address)
    return InstrumentLook(instrument.name, where, settings, samples=file.least_samples)


# --- looking ----------------------------------------------------------------------------------------


def _look_at_all(
    instruments: Sequence[Instrument], rows: Sequence[InstrumentLook], range_v: float, clock: Clock
) -> None:
    """Open, test, read and close each instrument in a thread of its own, so that none waits for another."""
    threads = [
        threading.Thread(target=_look_at, args=(instrument, row, range_v), name=row.name, daemon=True)
        for instrument, row in zip(instruments, rows, strict=True)
    ]
    deadline_s = clock.now_s() + _LONGEST_S
    for thread in threads:
        thread.start()
    try:
        try:
            for thread, row in zip(threads, rows, strict=True):
                thread.join(max(0.0, deadline_s - clock.now_s()))
                if thread.is_alive():
                    row.failure = InstrumentLost(
                        row.name, f"did not end within {_LONGEST_S:g} s", "switch it off and on"
                    )
        finally:
            for thread, instrument, row in zip(threads, instruments, rows, strict=True):
                if thread.is_alive():
                    row.to_do = let_go(instrument)
    except KeyboardInterrupt:
        if to_do := [f"{row.name}: {row.to_do}" for row in rows if row.to_do]:
            raise BenchError(
                "instruments", "stopped, but not everything could be made safe", "; ".join(to_do)
            ) from None
        raise


def _look_at(instrument: Instrument, row: InstrumentLook, range_v: float) -> None:
    try:
        row.identity = checked_identity(instrument, instrument.open())
        if row.identity.maker == _BY_HAND:
            row.self_test = row.shows = _BY_HAND
            return
        row.self_test = _NO_TEST
        if isinstance(instrument, SelfTesting):
            row.self_test = ""
            row.self_test = instrument.self_test() or _PASSED
        _read(instrument, row, range_v)
    except BenchError as error:
        row.failure = error
    except Exception as error:  # one driver's mistake must not hide what the others show
        cause = f"the driver failed with {type(error).__name__} ({error})"
        unknown = BenchError(row.name, cause, "repeat it with --wire-log FILE and report the log")
        row.failure = named_fault(error, [instrument]) or unknown
    finally:
        row.to_do = let_go(instrument)


def _read(instrument: Instrument, row: InstrumentLook, range_v: float) -> None:
    """Take one reading of a voltmeter, chamber, supply, thermometer, level or head, and note it in its row."""
    if isinstance(instrument, Voltmeter):
        settings = VoltmeterSettings(range_v, QUICK_NPLC, row.samples)
        instrument.configure(settings)
        row.settings = f"{range_v:g} V, {QUICK_NPLC:g} NPLC"
        instrument.start()
        taken = checked_samples(instrument, instrument.fetch(), settings)
        row.value = {channel: samples[0] for channel, samples in taken.items()}
        row.shows = ", ".join(f"{channel} {value:+.6f} V" for channel, value in row.value.items())
    elif isinstance(instrument, ThermalChamber):
        row.value = checked_temperature(instrument, "temperature", instrument.temperature("instruments"))
        row.shows = f"{row.value:.1f} °C"
    elif isinstance(instrument, PowerSupply):
        states = instrument.state("instruments")
        row.value = {output: state.voltage_v for output, state in states.items()}
        row.shows = ", ".join(
            f"{output} {f'{state.voltage_v:.3f} V {state.current_a:.4f} A' if state.on else 'off'}"
            for output, state in states.items()
        )
    elif isinstance(instrument, Thermometer):
        row.value = checked_temperature(instrument, "block_c", instrument.block_c("instruments"))
        row.shows = f"{row.value:.2f} °C, {instrument.sensor}"
    elif isinstance(instrument, Level):
        found = checked_inclination(instrument, instrument.inclination("instruments", turned=False))
        row.value = {"along": found.along_rad, "across": found.across_rad}
        row.shows = ", ".join(f"{axis} {value / ARCSEC:+.1f} arcsec" for axis, value in row.value.items())
    elif isinstance(instrument, HasScale):
        row.value = instrument.position_rad()
        row.shows = format_dms(row.value)


PAGE: Final = "commissioning.html"
RESULT: Final = "commissioning.json"
WIRE_LOG: Final = "wire.log"


@dataclass(frozen=True)
class CommissioningPlan:
    """The options of a commissioning: the bench, the person and the folder of the page.

    Without a `person`, a script answers on a simulated bench with the random `seed`. `tell` shows a line to the
    person. `course` is the function that carries out the checks; `what` is their name on the page.
    """

    file: BenchFile
    path: Path
    folder: Path
    person: Person | None
    seed: int = 1
    tell: Callable[[str], None] = lambda line: None
    course: Callable[[CommissioningSession], None] = go_through
    what: str = "commissioning"


def free_folder(what: str) -> Path:
    """Return the default folder, named after the time, for a session of checks called `what`."""
    return Path(f"{what}-{utc_now().astimezone():%Y%m%d-%H%M%S}")


def commission(setting: CommissioningPlan) -> dict[str, Any]:
    """Carry out a commissioning; write result, page and wire log into its folder, and return the result.

    After an error or a signal, too, the bench is left safe and the page is written. Raises `Refused`, and
    `BenchError` for a bench that cannot be simulated.
    """
    folder = setting.folder
    if (folder / PAGE).exists() or (folder / WIRE_LOG).exists():
        raise Refused(f"{folder}: already holds a commissioning; name another folder with --out")
    with refusing("name another folder with --out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / WIRE_LOG).touch()
    began = utc_now()
    with logged_wire(setting.folder / WIRE_LOG) as log, Interrupts() as interrupts:
        entered: AbstractContextManager[CommissioningSession]
        if setting.person is None:
            truth = simulated_truth(setting.file, None)
            entered = dry_evening(setting.file, truth, setting.seed, log, interrupts.haste)
        else:
            entered = nullcontext(real_evening(setting.file, setting.person, log, interrupts.haste))
        with entered as evening:
            evening.tell = setting.tell
            begun_s = evening.clock.now_s()
            ended = _gone_through(setting.course, evening, interrupts)
            took_s = evening.clock.now_s() - begun_s
            to_do = leave_safe(evening.instruments, None)
        result = _result(setting, evening, began, took_s, ended, to_do)
        with refusing("the bench is safe; the findings are on the screen only"):
            write_whole(setting.folder / RESULT, to_text(result))
            write_whole(setting.folder / PAGE, render_commissioning(result))
    return result


def _gone_through(
    course: Callable[[CommissioningSession], None], evening: CommissioningSession, interrupts: Interrupts
) -> str:
    """Carry out checks; return why they stopped early, or "". From then on, a signal raises no exception."""
    try:
        try:
            course(evening)
        finally:
            interrupts.hold()
    except SessionEnded as why:
        return str(why)
    except KeyboardInterrupt:
        return "stopped by a signal"
    except Exception as error:  # a mistake of the program must not keep the page from being written
        return f"the program failed with {type(error).__name__} ({error})"
    return ""


def _result(
    setting: CommissioningPlan,
    evening: CommissioningSession,
    began: datetime,
    took_s: float,
    ended: str,
    to_do: dict[str, str],
) -> dict[str, Any]:
    instruments = []
    for section in setting.file.instruments.all():
        identity = evening.identities.get(section.name)
        address = str(getattr(section, "resource", "by hand"))
        shown = None if identity is None else str(identity)
        instruments.append(CommissionedPart(name=section.name, address=address, identity=shown))
    result = CommissionResult(
        what=setting.what,
        bench=setting.file.name,
        bench_file=str(setting.path),
        simulated=setting.person is None,
        began=began.isoformat(),
        took_s=took_s,
        status=status_of(evening.findings, whole=not ended),
        ended=ended,
        instruments=instruments,
        findings=evening.findings,
        to_do=to_do,
        wire_log=WIRE_LOG,
        versions=versions(),
    )
    checked: dict[str, Any] = without_infinity(result.to_dict())
    return checked


# --- the check of a bench each morning -------------------------------------------------------------------


def morning(
    request: Check, person: Person | None, tell: Callable[[str], None]
) -> tuple[dict[str, Any], Path]:
    """Carry out the morning check, simulated without a `person`; return result and folder. Raises `Refused`."""
    path = bench_path(request.bench)
    file = load_bench(path)
    folder = request.out or free_folder("morning-check")
    course = _course(file, path, request, simulated=person is None)
    what = "morning check"
    plan = CommissioningPlan(file, path, folder, person, request.seed, tell, course=course, what=what)
    return commission(plan), folder


def line_of(result: Mapping[str, Any]) -> str:
    """Return the outcome of a morning check in one line: ready, or what to do."""
    troubles = [one for one in result["findings"] if one["state"] not in ("works", "skipped")]
    if not troubles and not result["ended"] and not result["to_do"]:
        left = [
            message(f"{one['check']} not checked: {one['said']}")
            for one in result["findings"]
            if one["state"] == "skipped"
        ]
        ready = message(f"✓ {result['bench']} is ready, {len(result['findings'])} checks")
        return "; ".join(map(translated, [ready, *left]))
    told = (
        map(translated, (one["instrument"], one["check"], one["said"], one["remedy"])) for one in troubles
    )
    words = ["{}: {}: {}; {}".format(*one) for one in told]
    words += [f"{translated(name)}: {translated(what)}" for name, what in result["to_do"].items()]
    return "\n".join(
        [
            message(f"✗ {result['bench']} is not ready"),
            *([result["ended"]] if result["ended"] else []),
            *words,
        ]
    )


def _course(file: BenchFile, path: Path, request: Check, *, simulated: bool) -> MorningCourse:
    from bench.services.check_block import chart_of, check_block_runs

    section, course = file.check_block, MorningCourse(request.reference)
    if section is None:
        return course
    course = replace(course, serial=section.serial, installation=next(iter(file.installation_models())))
    folder = runs_folder(request.runs)
    try:
        chart = chart_of(
            check_block_runs(file, folder, simulated=simulated), section, of_bench=path, folder=folder
        )
    except (Refused, CalibrationError) as why:
        return replace(course, no_chart=str(why))
    runs = [*chart.twelve.baseline, *chart.twelve.later]
    mean, covariance, own = np.zeros(STATE), np.zeros((STATE, STATE)), slice(COEFFICIENT_COUNT)
    mean[own], covariance[own, own] = chart.twelve.expected(utc_now())
    stand_u = {name: one.u for name, one in file.stand_distributions().items()}
    noise = NoiseSizes(max(run.s for run in runs), stand_u["setting_error"])
    model = ForwardModel(file.installation_models())

    def judge(reading: Reading) -> ReadingJudgement:
        row = readings_of([reading], "").conditions()
        expectation = Expectation(mean[None], covariance[None])
        expectation.remount(stand_u)
        pose = poses(model, file.nominal_block(), row, [reading.installation], row.angle_rad)
        return expectation.judge(np.asarray(reading.mean), pose, noise)

    return replace(course, judge=judge)
