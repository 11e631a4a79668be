"""Evaluations of several runs: errors of a bench (learning), comparison of calibrations, monitor runs."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from bench.base.arrays import CHANNELS, Floats
from bench.base.files import to_text
from bench.base.languages import message
from bench.base.tables import as_text
from bench.base.text import listed
from bench.calibration.budget.meters import may_move
from bench.calibration.intrinsic import least_dof
from bench.calibration.noise import METERS_DRIFT
from bench.calibration.result import CalibrationError
from bench.config.bench_file.learned import arcsec, learned_for, write_learned
from bench.config.bench_file.sections import DAY_S
from bench.config.model_file import load_model
from bench.history.comparison import Comparison, Snapshot
from bench.history.comparison import compare as compare_snapshots
from bench.history.control_chart import CheckRun, ControlChart
from bench.history.learned import (
    FEW_DOF,
    WAVE_NAMES,
    Contrasts,
    Learned,
    MeterDifferences,
    MeterRun,
    exchanged,
    meter_differences,
)
from bench.history.learning import learn as learn_from
from bench.history.monitor import monitor_chart, monitor_run
from bench.history.run_sums import run_fit
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.model.effects import Subsystem
from bench.model.geometry import STAND_ANGLES, Block
from bench.readings.table import UNORIENTED
from bench.results.compare import BenchOfSource, CompareResult, compare_result, history_figure, print_compare
from bench.results.learning import LearnResult, RecordPart, learn_result, print_learned
from bench.results.monitor import MonitorResult, monitor_figures, monitor_result
from bench.run.events import writing
from bench.services.arguments import python_call
from bench.services.bench_selection import BenchTaken
from bench.services.calibration import calibration_of
from bench.services.coefficients import date_of, dated, is_result, snapshots_in
from bench.services.errors import Refused
from bench.services.requests import evaluation as asked
from bench.services.requests.evaluation import Learn
from bench.services.source import Source, data_sha256, load_sources, reading, refuse_copies, time_of
from bench.services.traceability import voltmeter_names
from drivers.clock import utc_now

USUAL_DAYS: Final = 365
"""Default number of days for which a learned file is valid."""
MOST_DAYS: Final = 36_500
"""Largest number of days for which a learned file can be valid: a century."""
HEAD_EFFECTS: Final = ("head_eccentricity", "head_ellipticity")
ONE_STAND: Final = message(
    "each angle has one mean for all installations; if their brackets differ, --by-installation estimates "
    "a mean for each"
)
OF_THE_REPEATS: Final = message(
    "noise and setting error come from repeats alone, so that model errors do not enlarge them"
)


@dataclass(frozen=True)
class LearningResult:
    """The result of `bench learn`: the errors learned from runs of a bench.

    `sources` are all runs, also those that contradict the others. The learned file contains `effects` and is valid
    until `expires`.
    """

    learned: Learned
    sources: tuple[Source, ...]
    made: datetime.date
    expires: datetime.date
    effects: tuple[AppliedEffect, ...]
    by_installation: bool

    @property
    def bench(self) -> str:
        """The name of the bench, as its bench file states it."""
        return self.sources[0].bench.name

    @property
    def simulated(self) -> bool:
        """Whether the runs were simulated."""
        return self.sources[0].simulated

    @property
    def behind(self) -> tuple[Source, ...]:
        """The sources from which the errors were learned: all but the contradicting runs."""
        return tuple(source for source in self.sources if source.name in self.learned.runs)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader, a sentence each."""
        own = [OF_THE_REPEATS] if self.by_installation else [ONE_STAND, OF_THE_REPEATS]
        if self.simulated:
            own.append(message("these runs are simulated: the result applies to simulated runs only"))
        if self.learned.too_many_contradict:
            own.append(
                message(
                    "more than a third of the runs contradict the others; learn from runs of one bench between "
                    "changes"
                )
            )
        if poor := [source.name for source in self.behind if not _fits(source)]:
            own.append(
                message(
                    f"{listed(poor)}: 'bench calibrate' does not accept the residuals, and their cause acts on the "
                    "learned sizes; find it with 'bench diagnose'"
                )
            )
        return tuple(own)

    @cached_property
    def result(self) -> LearnResult:
        """The result as `bench learn --json` writes it."""
        first = self.sources[0]
        return learn_result(
            self.learned,
            bench=first.taken.part(),
            learned_for=learned_for(first.bench),
            made=self.made.isoformat(),
            expires=self.expires.isoformat(),
            simulated=self.simulated,
            records=[RecordPart(**_record(source)) for source in self.behind],
            effects=[applied.effect.name for applied in self.effects],
            notes=list(self.notes),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench learn --json` writes it."""
        return self.result.to_dict()

    def write(self, path: str | Path) -> None:
        """Write the learned file. Raises `RecordError`; `Refused` if it exists or too many contradict."""
        path = Path(path)
        if path.exists():
            raise Refused(f"{path}: exists, and a learned file is not overwritten; name another with --out")
        if self.learned.too_many_contradict:
            raise Refused(
                f"{path}: not written: more than a third of the runs contradict the others; "
                "learn from runs of one bench between changes"
            )
        with writing(path):
            write_learned(path, self._content(), self.effects)

    def _content(self) -> dict[str, Any]:
        found, first = self.learned, self.sources[0]
        known = found.known
        assert known.noise is not None  # noqa: S101 - learned so
        u = np.sqrt(np.diag(known.covariance))
        noise: dict[str, Any] = {"unit": found.unit}
        for channel, size, dof in zip(CHANNELS, known.noise.channels, known.noise.channel_dof, strict=True):
            noise[channel] = {"size": float(size), "dof": float(dof)}
        noise["setting"] = {"size": arcsec(known.noise.setting_rad), "dof": known.noise.setting_dof}
        return {
            "bench": self.bench,
            "learned_for": learned_for(first.bench),
            "made": self.made.isoformat(),
            "expires": self.expires.isoformat(),
            "simulated": self.simulated,
            "runs": [_record(source) for source in self.behind],
            "stand": {
                "means": [
                    {
                        "angle": name,
                        **({"installation": at} if at else {}),
                        "value": arcsec(value),
                        "u": arcsec(size),
                    }
                    for (name, at), value, size in zip(
                        known.keys, known.mean.tolist(), u.tolist(), strict=True
                    )
                ],
                "covariance_rad2": known.covariance.tolist(),
                "remount": {name: arcsec(size) for name, size in known.remount.items()},
            },
            "noise": noise,
            **({} if isinstance(found.meters, str) else {"meters": written_meters(found.meters)}),
            "sizes": {
                size.name: f"{size.value:.6g} {size.unit}, u {size.u:.3g}, dof {size.dof:.3g}"
                for size in found.sizes()
            },
            "contradicting": [one.sentence for one in found.contradicting],
            "not_identified": found.not_identified(),
        }

    def print_on(self, out: Console) -> None:
        """Print the contradicting runs, the learned errors, and the quantities that these runs do not determine."""
        print_learned(self.learned, self.result, out)

    def __repr__(self) -> str:
        """Return the output of `bench learn`."""
        return as_text(self.print_on)


def learning_of(request: Learn, sources: Sequence[Source] | None = None) -> LearningResult:
    """Estimate the errors that all runs of a bench share, as `bench learn` does.

    `model` is a model file with effects of the bench, found in many runs together; the learned file contains them.
    `by_installation` estimates separate mean angles for each installation. The file is valid until `expires` (a
    year by default). Other parameters are those of `calibrate`; `sources` are the request's, if already read.
    Raises `Refused` for runs of several benches, the `CalibrationError` of `bench.history.learning.learn`.
    """
    made = utc_now().date()
    until = _until(request.expires, made)
    sources = load_sources(reading(request, *request.sources)) if sources is None else sources
    _require_one_bench(sources)
    first = sources[0]
    stand_u = first.stand_u | first.assumed_u
    asked = _effects_of_model(sources)
    certified = first.bench.instruments.head.certificate is not None
    waves = not certified and not {a.effect.name for a in asked} & set(HEAD_EFFECTS)
    own = [_certified(source) for source in sources]
    fits = [run_fit(source.name, source.readings, source.model, stand_u) for source in own]
    found = learn_from(fits, stand_u, by_installation=request.by_installation, waves=waves)
    found = replace(found, meters=differences_of([source for source in own if source.name in found.runs]))
    effects = (*asked, *_circle(found))
    return LearningResult(found, tuple(sources), made, until, effects, request.by_installation)


learn = python_call(Learn, learning_of, "learn")


def _until(expires: datetime.date | str | None, made: datetime.date) -> datetime.date:
    """Return the last valid day of a learned file: the date `expires`, or so many days after `made`.

    Raises `Refused`.
    """
    if expires is None:
        return made + datetime.timedelta(days=USUAL_DAYS)
    if isinstance(expires, str):
        if expires.isascii() and expires.isdecimal() and 0 < int(expires) <= MOST_DAYS:
            return made + datetime.timedelta(days=int(expires))
        try:
            expires = datetime.date.fromisoformat(expires)
        except ValueError:
            raise Refused(
                f"--expires {expires}: expected a date such as 2027-01-31, or 1 to {MOST_DAYS} days from now"
            ) from None
    if expires <= made:
        raise Refused(f"--expires {expires}: is not after {made}; give a later day, or a number of days")
    return expires


def _fits(source: Source) -> bool:
    """Return whether `bench calibrate` accepts the residuals of a run, or refuses it before it judges them."""
    try:
        return calibration_of(source).calibration.lack_of_fit.accepted()
    except CalibrationError:
        return True


def _certified(source: Source) -> Source:
    """Return a source corrected by certificates alone, without effects that were found automatically.

    The model has effects only if the request names a model file.
    """
    plain = source.model if source.request.model else ForwardModel(source.bench.installation_models())
    return replace(source.as_certified(), model=plain)


def _effects_of_model(sources: Sequence[Source]) -> tuple[AppliedEffect, ...]:
    """Return the effects of the requested model file, with u. Raises `Refused` for one that is not of the bench."""
    if sources[0].request.model is None:
        return ()
    # read from the file, because a source in which the model was found has the values without u
    file = load_model(sources[0].request.model, sources[0].model.installations)
    effects = file.applied_effects()
    of_block = [a.effect.name for a in effects if a.effect.subsystem is Subsystem.BLOCK]
    if of_block:
        raise Refused(
            f"{sources[0].request.model}: {', '.join(of_block)} belongs to a block, not to the bench; "
            "give a model without it"
        )
    own = [a for a in effects if a.installations and any("/" in label for label in a.installations)]
    if own:
        raise Refused(
            f"{sources[0].request.model}: {own[0].effect.name} belongs to one mounting, not to the bench; "
            "give a model without it"
        )
    return effects


def _circle(found: Learned) -> list[AppliedEffect]:
    """Return the head's eccentricity and ellipticity as effects with u, as far as the runs show them."""
    m = len(found.keys)
    u: Floats = np.sqrt(np.diag(found.covariance))
    effects = []
    for k in found.shown_waves():
        effect = CATALOGUE[HEAD_EFFECTS[k]]
        values, sizes = {}, {}
        for j in (2 * k, 2 * k + 1):
            parameter = WAVE_NAMES[j].partition(".")[2]
            values[parameter], sizes[parameter] = np.array(found.means[m + j]), np.array(u[m + j])
        effects.append(AppliedEffect(effect, values, CHANNELS, sizes))
    return effects


def _record(source: Source) -> dict[str, str]:
    head = "" if source.run is None else source.run.history.head
    own = {"name": source.name, "readings": data_sha256(source.as_read)}
    return own | ({"head": head} if head else {})


def _require_one_bench(sources: Sequence[Source]) -> None:
    first = sources[0]
    for source in sources[1:]:
        if learned_for(source.bench) != learned_for(first.bench):
            raise Refused(
                f"{source.name} has another bench than {first.name} (stand, head, installations or meters "
                "differ); name one for all with --bench FILE, or learn from runs of one"
            )
        if source.simulated != first.simulated:
            raise Refused(
                f"{source.name} is {'simulated' if source.simulated else 'real'}, but {first.name} is "
                f"{'simulated' if first.simulated else 'real'}; learn from runs of one kind"
            )
    refuse_copies(sources)


# --- how the voltmeters differ --------------------------------------------------------------------------

NOT_RECORDED: Final = (
    "differences between the voltmeters: the sources do not say which voltmeter read which channel; use "
    "runs, or readings files of 'bench export'"
)
BY_ADDRESS: Final = "; no record has their serial numbers, so each address counts as another voltmeter"
NOT_VOLTS: Final = "differences between the voltmeters: the signals are in {unit}"


def differences_of(sources: Sequence[Source]) -> MeterDifferences | str:
    """Return the differences between the voltmeters of a bench, or why these runs do not determine them."""
    if sources[0].readings.unit != "V":
        return NOT_VOLTS.format(unit=sources[0].readings.unit)
    known = [
        (source, by_channel, begun.timestamp() / DAY_S)
        for source in sources
        if source.block_name
        and (by_channel := _by_channel(source)) is not None
        and (begun := time_of(source.made_at)) is not None
    ]
    if not known:
        return NOT_RECORDED
    kept = exchanged([(source.block_name, meters) for source, meters, _ in known])
    runs = [run for i in kept if (run := _meter_run(*known[i])) is not None]
    found = meter_differences(runs)
    by_address = not any(source.origin.serials for source, _, _ in known if source.origin is not None)
    return found + BY_ADDRESS if isinstance(found, str) and by_address and len(kept) > 1 else found


def _by_channel(source: Source) -> tuple[str, str, str] | None:
    of = voltmeter_names(source.bench, source.taken, source.origin, source.name)
    return (of["x"], of["y"], of["z"]) if of else None


def _meter_run(source: Source, meters: tuple[str, str, str], day: float) -> MeterRun | None:
    try:
        found = calibration_of(source).calibration
    except CalibrationError:
        return None
    fresh = [s.covariance for s in found.sources if not s.cancels and s.of_block is None]
    forms = {c: meter for meter in source.bench.instruments.voltmeters for c in meter.channels}
    drift = [[may_move("voltmeter_gain", forms[c]), may_move("voltmeter_offset", forms[c])] for c in CHANNELS]
    return MeterRun.of(
        source.name, source.block_name, meters, day, found.block.vector,
        sum(fresh, found.covariance_readings), found.block_terms, np.array(drift), float(METERS_DRIFT.days),
    )  # fmt: skip


def written_meters(found: MeterDifferences) -> dict[str, Any]:
    """Return the voltmeters' section of a learned file; few degrees of freedom enlarge its covariances."""
    return {
        "meters": list(found.meters),
        "group": list(found.group),
        "day": datetime.date.fromtimestamp(found.day * DAY_S).isoformat(),
        "gain": _written(found.gain),
        "offset_v": _written(found.zero),
        "runs": list(found.runs),
    }


def _written(of: Contrasts) -> dict[str, Any]:
    nu = max(float(np.min(of.freedom)), FEW_DOF)
    covariance: Floats = of.covariance * (nu / (nu - 2.0) if np.isfinite(nu) else 1.0)
    return {"values": of.values.tolist(), "covariance": ((covariance + covariance.T) / 2).tolist()}


Files = Iterator[tuple[str, Path, str]]
"""The files to write: a description, the path and the text of each."""


@dataclass(frozen=True)
class ComparisonResult:
    """A comparison of calibrations; `taken` are pairs of a run or readings file and its bench file."""

    found: Comparison
    taken: tuple[tuple[str, BenchTaken], ...]

    @cached_property
    def result(self) -> CompareResult:
        """The result as `bench compare --json` writes it."""
        bench = [BenchOfSource(source=name, **taken.part().to_dict()) for name, taken in self.taken]
        return compare_result(self.found, bench)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench compare --json` writes it."""
        return self.result.to_dict()

    def __repr__(self) -> str:
        """Return the output of `bench compare`."""
        return as_text(lambda out: print_compare(self.result, out))

    def files(self, folder: Path) -> Files:
        """Yield the files that `bench compare --out` writes into a folder."""
        yield "result", folder / "compare.json", to_text(self.result.to_dict())
        yield message("figure", "heading"), folder / "compare.svg", history_figure(self.found)


def compared(request: asked.Compare) -> ComparisonResult:
    """Compare calibrations of one block. Raises `Refused` for invalid dates, `CalibrationError`."""
    taken: list[tuple[str, BenchTaken]] = []
    snapshots = [one for name in request.sources for one in _snapshots(str(name), request, taken)]
    if request.date:
        snapshots = _dated(snapshots, request.date)
    return ComparisonResult(compare_snapshots(snapshots), tuple(taken))


compare = python_call(asked.Compare, compared, "compare")


def _snapshots(name: str, request: asked.Compare, taken: list[tuple[str, BenchTaken]]) -> list[Snapshot]:
    """Return the calibrations that `name` stands for; `taken` receives the bench file used for readings."""
    if is_result(Path(name)):
        return snapshots_in(Path(name))
    (source,) = load_sources(reading(request, name))
    taken.append((name, source.taken))
    own = calibration_of(source)
    return [dated(own.as_coefficients(), name, least_dof(own.calibration))]


def _dated(snapshots: list[Snapshot], dates: Sequence[str]) -> list[Snapshot]:
    if len(dates) != len(snapshots):
        raise Refused(
            f"--date: {len(dates)} given for {len(snapshots)} calibrations; give one for each, in order"
        )
    return [replace(s, when=date_of(date, "--date")) for s, date in zip(snapshots, dates, strict=True)]


# --- monitors ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Monitored:
    """The control chart of monitor runs (short runs over days), and the sources of these runs."""

    chart: ControlChart
    sources: tuple[Source, ...]

    @property
    def unit(self) -> str:
        """The unit of the signals."""
        return self.sources[0].readings.unit

    @property
    def result(self) -> MonitorResult:
        """The result as `bench monitor --json` writes it."""
        return monitor_result(self.chart, self.unit)

    def files(self, out: Path) -> Files:
        """Yield description, path and text of each file to write into the folder `out`."""
        yield "result", out / "monitor.json", to_text(self.result.to_dict())
        for name, figure in monitor_figures(self.chart, self.unit).items():
            yield "chart", out / f"monitor-{name}.svg", figure


def monitored(request: asked.Monitor) -> Monitored:
    """Chart monitor runs; the first `baseline` set the limits. Raises `Refused`, `CalibrationError`."""
    sources = tuple(load_sources(reading(request, *request.sources)))
    for source in sources:
        if source.made_at is None:
            raise Refused(f"{source.name}: has no date; use runs, or a file that 'bench export' wrote")
    units = sorted({source.readings.unit for source in sources})
    if len(units) > 1:
        raise Refused(
            f"signals in {', '.join(units)} cannot be shown in one chart; name runs whose signals have "
            "one unit"
        )
    refuse_copies(sources)
    return Monitored(monitor_chart([check_run(source) for source in sources], request.baseline), sources)


def check_run(source: Source) -> CheckRun:
    """Return a monitor run for a control chart; an unknown date is 1970-01-01. Raises `CalibrationError`."""
    readings = source.readings
    readings = readings.select(~np.isin(readings.installation, [*UNORIENTED]))
    force = np.zeros((0, 3))
    if len(readings):
        conditions = readings.conditions()
        stand = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
        force = source.model.specific_force(conditions, stand, Block(np.eye(3), np.zeros(3)))
    when = date_of(source.made_at, source.name) or datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    return monitor_run(source.name, when, readings.signal, force)


monitor = python_call(asked.Monitor, monitored)
