"""The source of an analysis: a run, a readings file or a table, with its bench and model."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from bench.base.arrays import Floats
from bench.base.computing import versions
from bench.base.languages import message
from bench.base.text import as_typed, civil_minute, repeated, shown_path
from bench.calibration.budget.meters import KnownMeters
from bench.calibration.noise import ONE_TEMPERATURE_K, KnownStand
from bench.config.bench_file.file import BenchFile
from bench.config.model_file import ModelFile, load_model
from bench.model import CATALOGUE, Effect, ForwardModel
from bench.model.effects import TEMPERATURE_EFFECTS
from bench.model.effects.formula import SINCE_POWER_ON, FormulaEffect, names_in
from bench.readings.columns import SINCE_POWER_ON_S, ranges_in_words
from bench.readings.corrected import VOLTS, corrected
from bench.readings.table import FREE, UNORIENTED, VERIFICATION, Readings
from bench.results.parts import FailedPart
from bench.run.events import MANIFEST, RecordError, sha256
from bench.run.folder import IMPORTED, Run, find_run
from bench.services import traceability
from bench.services.bench_selection import (
    BenchTaken,
    Origin,
    OriginBeside,
    bench_of,
    origin_beside,
    origin_of_run,
    recorded_sha256,
)
from bench.services.errors import Refused, sentence
from bench.services.requests.shared import Bench, OnReadings, name_to_type, runs_folder

if TYPE_CHECKING:
    from typing import TypeAlias

    import pandas as pd

    Given: TypeAlias = str | Readings | pd.DataFrame
    """Readings to be evaluated: name or path of a run, path of a readings file, or a table in memory."""

T = TypeVar("T")
R = TypeVar("R")

WHAT_IF = "what-if"
NO_GRAVITY_IN_RUN = "gave no local gravity; give --g 9.81 (m/s²), or a bench file with 'gravity' by --bench"
NO_GRAVITY = "gives no local gravity; add 'gravity' to it, or give --g 9.81 (m/s²)"
LEAST_GRAVITY, MOST_GRAVITY = 9.75, 9.85


@dataclass(frozen=True)
class Request:
    """The sources of an analysis, and the options that replace the defaults.

    `runs` is the folder in which runs are found by name, `out` a folder for the files that commands write.
    """

    sources: Sequence[Given]
    runs: Path
    bench: Bench = None
    model: Path | None = None
    g_m_s2: float | None = None
    out: Path | None = None
    skip_bad_rows: bool = False


def reading(asked: OnReadings, *sources: Given | Path, out: Path | None = None) -> Request:
    """Return the `Request` for `sources` with the options `asked`; commands write files into the folder `out`."""
    model, place = getattr(asked, "model", None), out or getattr(asked, "out", None)
    return Request(
        [str(source) if isinstance(source, Path) else source for source in sources],
        runs_folder(asked.runs),
        asked.bench,
        None if model is None else Path(model),
        asked.g,
        None if place is None else Path(place),
        asked.skip_bad_rows,
    )


@dataclass(frozen=True)
class Source:
    """The readings of one run, file or table, with bench and model. `run` is None for readings without a run.

    `taken` is the bench file with the reason for its choice; `bench` is its content, with the unit that was
    measured. `origin` is the origin of the readings, None if it is not recorded. `readings` are corrected by
    the certificates of the instruments (`traced`) and by learned differences of the voltmeters; `as_read` are
    the uncorrected readings. `effects` are the user's own effects: registered in the program, or formulas
    in the bench file or the model file. `known` are the errors of stand and noise learned from other runs (None:
    nothing was learned). `known_meters` are the learned differences of the voltmeters; `learned_of` identifies
    the file with these differences.
    """

    name: str
    readings: Readings
    bench: BenchFile
    taken: BenchTaken
    model: ForwardModel
    g_m_s2: float
    run: Run | None
    origin: Origin | None
    request: Request
    as_read: Readings
    traced: traceability.Traced
    effects: tuple[Effect, ...] = ()
    known: KnownStand | None = None
    known_meters: KnownMeters | None = None
    learned_of: str = ""

    @property
    def typed(self) -> str:
        """The name as a shell takes it; the path of a run that is not in the default folder of runs."""
        run = self.run
        return as_typed(self.name) if run is None or self.name != run.name else name_to_type(run.folder)

    @property
    def simulated(self) -> bool:
        """Whether the readings are recorded as simulated; False if their origin is not recorded."""
        return self.origin is not None and self.origin.simulated

    @property
    def meters(self) -> tuple[str, ...]:
        """The identity, address and bench of each voltmeter; empty if one of them was not recorded.

        The address is included because many voltmeters identify themselves without a serial number.
        """
        told = {} if self.origin is None else self.origin.instruments
        meters = self.bench.instruments.voltmeters
        if not all(told.get(meter.name) for meter in meters):
            return ()
        # meter errors cancel between two calibrations only if both removed the same learned differences
        taken = f", {self.learned_of} taken away" if self.known_meters is not None else ""
        return tuple(f"{told[m.name]} at {m.resource} of {self.bench.name}{taken}" for m in meters)

    @property
    def block_name(self) -> str:
        """Type and serial number of the block; "" if neither the origin nor a requested bench file states them."""
        if self.origin is None and not (self.request.bench or os.environ.get("BENCH_FILE")):
            return ""
        unit = self.bench.unit_under_test
        return f"{unit.type} {unit.serial}".strip()

    @property
    def made_at(self) -> str | None:
        """Civil time (ISO 8601) at which the run was begun; None if no time was recorded."""
        return self.origin.begun or None if self.origin is not None else None

    @property
    def what_if(self) -> bool:
        """Whether a run is evaluated with another bench file, gravity or model than recorded."""
        if self.run is None:
            return False
        asked = self.request
        other_bench = asked.bench is not None and self.taken.sha256 != recorded_sha256(self.run)
        other_g = asked.g_m_s2 is not None and asked.g_m_s2 != self.bench.gravity_m_s2
        return other_bench or other_g or asked.model is not None

    @property
    def stand_u(self) -> dict[str, float]:
        """Standard uncertainties of the stand's errors, rad; "voltmeter_error" in V, 0 if signals are not in V."""
        sizes = {name: d.u for name, d in self.bench.stand_distributions().items()}
        return sizes if self.readings.unit == VOLTS else sizes | {"voltmeter_error": 0.0}

    @property
    def assumed_u(self) -> dict[str, float]:
        """Standard uncertainties (rad), by name, of stand errors that are assumed if the bench file omits them."""
        from bench.calibration.budget.sources import assumed_stand  # a diagnosis does without the budget

        return {name: size.u for name, size in assumed_stand(self.bench).items()}

    def made_from(self) -> dict[str, Any]:
        """Return the members of a result that state its source, bench, date, unit and certificates."""
        unit = self.bench.unit_under_test
        return {
            "source": self.name,
            "bench": self.taken.part(),
            "made_at": self.made_at,
            "unit_under_test": {"type": unit.type, "serial": unit.serial} if self.block_name else None,
            "simulated": self.simulated,
            "corrections": self.traced.parts(),
        }

    def as_certified(self) -> Source:
        """Return the source without what was learned: certificates alone correct it, and stated limits apply."""
        readings = corrected(self.as_read, self.traced.by_certificates)
        return replace(
            self, known=None, known_meters=None, readings=replace(readings, notes=self.readings.notes)
        )

    def output(self, command: str, suffix: str, *, what_if: bool = False) -> Path:
        """Return the path of the file that a command writes for this source.

        The file is in the folder `--out`, if that is given. Otherwise it is in the run's folder (with `what_if`, in
        its subfolder `what-if`) or, without a run, beside the readings file in a folder named after the command.
        """
        file = _output(self.name, self.run, self.request.out, command, suffix)
        aside = what_if and self.run is not None and self.request.out is None
        return file.parent / WHAT_IF / file.name if aside else file


def load_sources(request: Request) -> list[Source]:
    """Read all sources; number tables in memory of one name. The first unreadable source raises its error."""
    check_gravity(request.g_m_s2)
    check_places(request)
    loaded = [_load(given, request) for given in request.sources]
    twice = repeated(s.name for s in loaded)
    return [replace(s, name=f"{s.name} {n}") if s.name in twice else s for n, s in enumerate(loaded, 1)]


def check_places(request: Request) -> None:
    """Raise `Refused` if two sources would write the same files, or if `out` is an existing file."""
    if request.out is not None and request.out.exists() and not request.out.is_dir():
        raise Refused(f"--out {request.out}: this is a file; name a folder")
    places = []
    for name in request.sources:
        if isinstance(name, str):
            with suppress(Refused, RecordError, OSError):  # one that is not there writes nothing
                places.append(_output(name, _run_of(name, request.runs), request.out, "", ""))
    for place in repeated(map(str, places)):
        raise Refused(one_place(place))


def one_place(place: str) -> str:
    """Return the error message for two sources whose results would be written to the same `place`."""
    return (
        f"two sources would write {place}*; name each source once, and evaluate different sources of one name "
        "separately, each with its own --out DIR"
    )


def _output(name: str, run: Run | None, out: Path | None, command: str, suffix: str) -> Path:
    if run is not None:
        return out / f"{run.name}-{command}{suffix}" if out else run.folder / f"{command}{suffix}"
    return (out or Path(name).parent / command) / f"{Path(name).stem}{suffix}"


def time_of(text: str | None) -> datetime | None:
    """Return an ISO 8601 time, with the time zone of this computer if it names none; None for any other text."""
    try:
        return datetime.fromisoformat(text or "").astimezone()
    except ValueError:
        return None


def data_sha256(readings: Readings) -> str:
    """Return the SHA-256 that identifies readings in a model file: the hash of the readings written as CSV."""
    return _hash(readings, to_the_bit=False)


def refuse_copies(sources: Iterable[Source]) -> None:
    """Raise `Refused` if two sources have the same readings, which would count twice."""
    known: dict[str, Source] = {}
    for source in sources:
        other = known.setdefault(data_sha256(source.as_read), source)
        if other is not source:
            raise Refused(f"{source.name}: has the same readings as {other.name}; give each run once")


def _hash(readings: Readings, *, to_the_bit: bool = True) -> str:
    from bench.readings.csv import format_csv

    return sha256(format_csv(readings, to_the_bit=to_the_bit).encode())


def _knows(stated: str | None, readings: Readings) -> bool:
    """Return whether the hashes in a model file include one of these readings, of this or an earlier version."""
    hashes = (stated or "").split()
    return bool(hashes) and (data_sha256(readings) in hashes or _hash(readings) in hashes)


def _load(given: Given, request: Request) -> Source:
    run = _run_of(given, request.runs) if isinstance(given, str) else None
    told = OriginBeside()
    if run is not None:
        run.trusted_history()
        told = origin_of_run(run)
    elif isinstance(given, str):
        told = origin_beside(Path(given))
    taken, notes = bench_of(given if isinstance(given, str) else "", run, told, request.bench)
    bench, other_unit = _of_unit(taken.file, told.origin)
    notes += other_unit
    if run is not None:
        notes += _on_check_block(run)
    if told.origin is not None:
        notes += told.notes
    readings = _readings_of(given, run, bench, skip_bad_rows=request.skip_bad_rows)
    gravity = bench.gravity_m_s2 if request.g_m_s2 is None else request.g_m_s2
    if gravity is None:
        if run is not None and request.bench is None:  # a run's copy of its bench file must not be edited
            raise Refused(f"{run.folder}: its bench file {NO_GRAVITY_IN_RUN}")
        raise Refused(f"{taken.where}: {NO_GRAVITY}")
    model = ForwardModel(bench.installation_models())
    own = (*CATALOGUE.own, *bench.own_effects())
    if request.model is not None:
        file = load_model(request.model, model.installations)
        model, of_model = _of_model_file(file, readings, model)
        notes += of_model
        own += file.own_effects()
    as_read = readings
    bench, readings, traced = traceability.trace(taken, bench, readings, told.origin)
    learned = _learned(given, taken, bench, as_read, traced, run, told)
    model = traceability.with_effects(model, learned.effects)
    if learned.meters is not None:
        traced = replace(traced, by=traced.by.then(learned.meters.gain, learned.meters.offset_v))
        readings = corrected(as_read, traced.by)
    notes += (*_on_power(own, readings), *_on_copies(as_read), *on_temperature(as_read, model))
    readings = replace(readings, notes=(*notes, *learned.notes, *traced.notes(), *readings.notes))
    name = given if isinstance(given, str) else readings.source
    return Source(
        name, readings, bench, taken, model, gravity, run, told.origin, request, as_read, traced,
        (*own, *learned.own), learned.known, learned.meters, learned.name,
    )  # fmt: skip


def _on_power(own: Iterable[Effect], readings: Readings) -> tuple[str, ...]:
    """Return a note if formulas use the time since power-on, which the readings do not contain."""
    names = [e.name for e in own if isinstance(e, FormulaEffect) and SINCE_POWER_ON in names_in(e.expression)]
    if not names or SINCE_POWER_ON_S in readings.extra:
        return ()
    return (
        f"these readings do not say when the block was switched on (column {SINCE_POWER_ON_S}): "
        f"{SINCE_POWER_ON} of {', '.join(names)} counts from the start of the run",
    )


def on_temperature(readings: Readings, model: ForwardModel) -> Iterator[str]:
    """Yield a note if verification points or free positions were measured outside the temperatures of the settings.

    There is none if the model has an effect of temperature, and for unknown temperatures.
    """
    if any(one.effect.name in TEMPERATURE_EFFECTS for one in model.effects):
        return
    at_c, of = readings.temperature_c, readings.installation
    known = np.isfinite(at_c)
    settings = at_c[known & ~np.isin(of, [VERIFICATION, *UNORIENTED])]
    for label in (VERIFICATION, FREE) if len(settings) else ():
        own = at_c[known & (of == label)]
        if len(own) and max(own.max() - settings.max(), settings.min() - own.min()) > ONE_TEMPERATURE_K:
            yield message(
                f"installation {label} was measured at {_range_c(own)}, the others at {_range_c(settings)}: "
                "Δg and residuals may come from this difference; see thermal_bias and thermal_scale"
            )


def _range_c(at_c: Floats) -> str:
    low, high = f"{at_c.min():.1f}", f"{at_c.max():.1f}"
    return f"{low} °C" if low == high else f"{low} … {high} °C"


FINE: Final = 1e-5
"""Largest step of the last digit, as a fraction of the largest signal, at which repeats differ by their noise."""
LEAST_COPIED: Final = 3
"""Least number of points that two passes must have in common to count as copies."""


def _on_copies(readings: Readings) -> Iterator[str]:
    """Yield a note for each pass whose signals equal those of an earlier pass of the installation exactly."""
    if readings.resolution > FINE * np.max(np.abs(readings.signal), initial=0.0):
        return
    passes: dict[tuple[str, int, int], dict[int, Floats]] = {}
    rows = zip(readings.installation, readings.series, readings.pass_number, readings.point, strict=True)
    for row, (installation, series, number, point) in enumerate(rows):
        own = passes.setdefault((str(installation), int(series), int(number)), {})
        own[int(point)] = readings.signal[row]
    repeats = [
        (later, earlier, common)
        for later, earlier in combinations(reversed(passes), 2)
        if later[0] == earlier[0]
        and len(common := passes[later].keys() & passes[earlier].keys()) >= LEAST_COPIED
    ]
    copies = [
        (later, earlier)
        for later, earlier, common in repeats
        if all(np.array_equal(passes[later][at], passes[earlier][at]) for at in common)
    ]
    for later, earlier in copies:
        copy, original = (f"pass {number} of series {series}" for _, series, number in (later, earlier))
        yield (
            f"{copy} in installation {later[0]} equals {original} in every digit; if its rows were copied, "
            "delete them: they are no repeats and make u too small"
        )


def _learned(
    given: Given,
    taken: BenchTaken,
    bench: BenchFile,
    readings: Readings,
    traced: traceability.Traced,
    run: Run | None,
    told: OriginBeside,
) -> traceability.LearnedTaken:
    file = taken.learned()
    if file is None:
        return traceability.NOTHING_LEARNED
    name = given if isinstance(given, str) else ""
    found = traceability.take_learned(
        file,
        traced.day,
        readings.unit,
        head="" if run is None else run.history.head,
        hashes=(data_sha256(readings), _hash(readings)),
        simulated=None if told.origin is None else told.origin.simulated,
    )
    if found.known is None or readings.unit != VOLTS or readings.corrected:
        return found
    return traceability.with_meters(
        found, file, bench, traced.day, traceability.voltmeter_names(bench, taken, told.origin, name)
    )


def _on_check_block(run: Run) -> tuple[str, ...]:
    """Return a note if a run was begun although the check block was not in control."""
    told = run.manifest.get("check_block")
    if told is None or "said" not in told or told.get("state") == "in control":
        return ()
    reason = told.get("despite")
    went_on = f"the run was started nevertheless: {reason}" if reason else "the bench file's rule is to warn"
    return (f"check block: {told['said']}; {went_on}",)


def _of_unit(bench: BenchFile, origin: Origin | None) -> tuple[BenchFile, tuple[str, ...]]:
    """Return the bench with the unit that was measured, and a note if the bench file names another unit."""
    stated = bench.unit_under_test
    unit = origin.unit_under_test if origin is not None else None
    if unit is None or (unit.type, unit.serial) == (stated.type, stated.serial):
        return bench, ()
    note = message(
        f"the readings are of unit {unit.type} {unit.serial}; the bench file names {stated.type} {stated.serial}"
    )
    own = stated.model_copy(update={"type": unit.type, "serial": unit.serial})
    return bench.model_copy(update={"unit_under_test": own}), (note,)


def _readings_of(given: Given, run: Run | None, bench: BenchFile, *, skip_bad_rows: bool) -> Readings:
    if isinstance(given, Readings):
        return given
    if isinstance(given, str) and run is not None and not run.imported:
        return run.readings()
    from bench.readings.csv import read_csv, read_frame

    installations = bench.installation_models()
    if not isinstance(given, str):
        return read_frame(given, installations, skip_bad_rows=skip_bad_rows)
    file = Path(given) if run is None else run.folder / IMPORTED
    return read_csv(file, installations, skip_bad_rows=skip_bad_rows)


def _of_model_file(
    file: ModelFile, readings: Readings, plain: ForwardModel
) -> tuple[ForwardModel, tuple[str, ...]]:
    """Return the model of a model file, with notes; values found in these same readings are estimated again."""
    model = replace(plain, effects=file.applied_effects(), name=file.name)
    dark: tuple[str, ...] = ()
    if file.dark_uncertainty is not None:
        dark = (
            f"model {file.name} leaves {file.dark_uncertainty} in each reading unexplained (dark uncertainty): "
            "it has unnamed terms",
        )
    if not _knows(file.data_sha256, readings):
        return model, dark
    note = message(
        f"model {file.name} was found in these same readings: its values are estimated again, not used as "
        "prior values"
    )
    return replace(model, effects=tuple(replace(a, u={}) for a in model.effects)), (note, *dark)


def _run_of(name: str, runs: Path) -> Run | None:
    """Return the run of this name; None for a readings file. Raises `Refused` if neither exists."""
    path = Path(name)
    if path.is_file() and path.name != MANIFEST:
        return None
    if path.suffix.lower() in {".csv", ".txt"} and not (runs / name).is_dir():
        raise Refused(f"{name}: no such readings file; check the name")
    return find_run(name, runs)


def check_gravity(g_m_s2: float | None) -> None:
    """Raise `Refused` for a local gravity (m/s²) that does not occur on Earth."""
    if g_m_s2 is not None and not LEAST_GRAVITY <= g_m_s2 <= MOST_GRAVITY:
        raise Refused(f"--g {g_m_s2:g}: give local gravity between 9.75 and 9.85 m/s²")


# --- several sources, each by itself: a failure does not stop the others -------------------------------


@dataclass(frozen=True)
class Failed:
    """A source that could not be evaluated; `problem` is the reason, in a sentence."""

    name: str
    problem: str

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object that takes the place of the source's result."""
        return FailedPart(source=self.name, problem=self.problem).to_dict()

    def __str__(self) -> str:
        """Return the problem as a sentence that begins with the name of the source."""
        return self.problem if self.problem.startswith(self.name) else f"{self.name}: {self.problem}"


def attempted(name: str, work: Callable[[], R]) -> R | Failed:
    """Return the result of `work`, or a `Failed` with the reason."""
    try:
        return work()
    except Exception as error:
        return Failed(name, sentence(error))


def load_each(request: Request) -> list[Source | Failed]:
    """Return each source, or a `Failed` if it cannot be read; a single source raises its error."""
    if len(request.sources) == 1:
        return [*load_sources(request)]
    check_gravity(request.g_m_s2)
    check_places(request)
    return [
        attempted(str(name), lambda name=name: load_sources(replace(request, sources=[name]))[0])  # type: ignore[misc]
        for name in request.sources
    ]


def each(loaded: Sequence[Source | Failed], work: Callable[[Source], R]) -> list[R | Failed]:
    """Return for each source the result of `work`, or a `Failed`; a single source raises its error."""
    if len(loaded) == 1:
        return [work(source) for source in done(loaded)]
    return [
        one if isinstance(one, Failed) else attempted(one.name, lambda one=one: work(one))  # type: ignore[misc]
        for one in loaded
    ]


def done(results: Iterable[T | Failed]) -> list[T]:
    """Return the results that are not a `Failed`."""
    return [one for one in results if not isinstance(one, Failed)]


def failures(results: Iterable[object]) -> list[Failed]:
    """Return the results that are a `Failed`."""
    return [one for one in results if isinstance(one, Failed)]


# --- where the numbers come from, for the record and the page ------------------------------------------


def provenance(source: Source) -> dict[str, str]:
    """Return the provenance of a result for the report: texts by label, in the order in which they are printed."""
    run, origin = source.run, source.origin
    stated = {
        "source": shown_path(source.name),
        "unit under test": source.block_name or message("not stated"),
        "bench": message(f"{source.taken.words} (SHA-256 {source.taken.sha256})"),
        "model": source.model.name,
        **source.traced.stated(),
    }
    if run is not None:
        stated["run"] = run.name
        if run.imported:
            stated["imported from"] = str(run.manifest["imported"])
        if checked := run.manifest.get("check_block"):
            stated["check block"] = checked.get("said", "")
    if origin is not None and origin.run != stated.get("run"):
        stated["exported from run"] = origin.run
    if origin is not None:
        stated.update(_measured(origin))
    if supply := ranges_in_words({name: cells.tolist() for name, cells in source.readings.extra.items()}):
        stated["supply of the block"] = supply
    if run is not None:
        head = run.record_head
        stated["record"] = message(f"{head['events']} events, chain of hashes complete, head {head['head']}")
    if origin is not None:
        stated["measured with"] = _listed(origin.measured_with)
    stated["evaluated with"] = _listed(versions())
    return stated


def _measured(origin: Origin) -> dict[str, str]:
    stated = {"begun": civil_minute(origin.begun), "operator": origin.operator or message("not stated")}
    if origin.procedure:
        stated["procedure"] = message(f"{shown_path(origin.procedure)} (plan SHA-256 {origin.plan_hash})")
        stated["instruments"] = message("simulated") if origin.simulated else message("real")
    return stated | origin.instruments


def _listed(versions_by_name: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions_by_name.items())
