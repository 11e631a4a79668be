"""Noise and drift of a block at rest; the calibration of meters at a known input, and their noise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from bench.base.arrays import CHANNELS
from bench.base.files import to_text, write_whole
from bench.base.languages import message
from bench.base.tables import as_text
from bench.calibration.budget.sources import meter_gain_sources, unread_sources
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.plan import Read
from bench.diagnosis.record_calibration import RecordCalibration, calibrate_record
from bench.history.stability import Stability, StaticRecord, from_columns, on_grid, read_static, stability_of
from bench.readings.csv import split_table
from bench.readings.table import REFERENCE_V, is_record
from bench.results.known_input import (
    print_record_calibration,
    record_calibrate_result,
    render_record_calibration,
)
from bench.results.stability import StabilityResult, allan_figure, print_stability, stability_result
from bench.run.events import writing
from bench.run.folder import BENCH, Run, find_run
from bench.services.arguments import python_call
from bench.services.bench_selection import BenchTaken, OriginBeside, bench_of, origin_beside
from bench.services.errors import Refused
from bench.services.requests import evaluation as asked
from bench.services.requests.shared import Bench, runs_folder
from bench.services.source import Request, Source, load_sources, provenance

OF_METERS: Final = (
    "a record at a known input is of the meters, not of a block at rest; let a reading of a meter average as long "
    "as its averaging time above"
)


@dataclass(frozen=True, repr=False)
class RecordCalibrationResult:
    """Gain and offset of each channel, with u, from a record at a known input."""

    source: Source
    calibration: RecordCalibration

    @property
    def bench(self) -> str:
        """The name of the bench file, with the reason for it."""
        return self.source.taken.words

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the reader of the result, a sentence each."""
        readings = self.source.readings
        return (*self.calibration.notes, *readings.notes, *readings.skipped)

    @property
    def accepted(self) -> bool:
        """Always true: a record at a known input is not judged against a limit."""
        return True

    strictly_accepted = accepted

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench calibrate --json` writes it."""
        source = self.source
        return record_calibrate_result(
            self.calibration, source.model.name, source.readings.skipped, source.made_from()
        ).to_dict()

    def html(self) -> str:
        """Return the report as a page, with the stability of the residuals."""
        noise: Stability | str
        try:
            noise = meters_at_rest(self.source, self.calibration)
        except CalibrationError as reason:
            noise = str(reason)
        return render_record_calibration(
            self.calibration, noise, f"Calibration of {self.source.name}", provenance(self.source), self.notes,
            simulated=self.source.simulated,
        )  # fmt: skip

    def report(self, path: str | Path) -> None:
        """Write the report as one self-contained HTML page. Raises `RecordError`."""
        with writing(path) as file:
            write_whole(file, self.html())

    def print_on(self, out: Console) -> None:
        """Print gain, offset and drift of each channel, and the notes."""
        print_record_calibration(self.source.name, self.calibration, self.notes, out)

    def __repr__(self) -> str:
        """Return the output of `bench calibrate`, with the bench file that was used."""
        return f"{as_text(self.print_on)}\nbench: {self.bench}"


def record_calibration_of(source: Source) -> RecordCalibrationResult:
    """Calibrate meters at a known input, corrected for the model's effects. Raises `CalibrationError`."""
    hidden = (
        *unread_sources(source.bench, source.model), *meter_gain_sources(source.bench, source.traced.day)
    )  # fmt: skip
    return RecordCalibrationResult(source, calibrate_record(source.readings, source.model.effects, hidden))


def meters_at_rest(source: Source, found: RecordCalibration) -> Stability:
    """Return noise and drift of the residuals of meters at a known input. Raises `CalibrationError`."""
    bench, record = source.bench, of_meters(source, found)
    stable = stability_of(
        record, record.interval_s, None, bench.line_frequency, bench.nplc_supported, bench.most_samples
    )
    return replace(stable, advice=None, no_advice=OF_METERS)


def of_meters(source: Source, found: RecordCalibration) -> StaticRecord:
    """Return the residuals of meters at a known input, without outliers, as a static record.

    Gain, offset and the model's effects are subtracted.
    """
    readings, used = source.readings, found.record.used
    channels = tuple(CHANNELS[i] for i in found.record.channels)
    made = on_grid(source.name, readings.time_s[used], found.residual_of(readings)[used], channels)
    told = "signal less gain, reference, offset" + ", effects of the model" * bool(source.model.effects)
    return replace(made, notes=(f"{told}: what the meters add to a known input", *found.notes, *made.notes))


Files = Iterator[tuple[str, Path, str]]


@dataclass(frozen=True)
class RecordAtRest:
    """Noise and drift of a static record, the bench file, notes on its choice, and the run, if any."""

    found: Stability
    taken: BenchTaken
    notes: tuple[str, ...]
    run: Run | None

    @cached_property
    def result(self) -> StabilityResult:
        """The result as `bench stability --json` writes it."""
        return stability_result(self.found, self.taken.part())

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench stability --json` writes it."""
        return self.result.to_dict()

    def __repr__(self) -> str:
        """Return the output of `bench stability`."""
        return as_text(lambda out: print_stability(self.found, out))

    def files(self, out: Path | None) -> Files:
        """Yield description, path and text of each file, in `out` or, if that is None, beside the record."""
        path = Path(self.found.record.source)
        if self.run is None:
            stem = (out or path.parent / "stability") / path.stem
        else:
            stem = out / f"{self.run.name}-stability" if out else self.run.folder / "stability"
        yield "result", stem.with_name(f"{stem.name}.json"), to_text(self.result.to_dict())
        yield message("figure", "heading"), stem.with_name(f"{stem.name}.svg"), allan_figure(self.found)


def at_rest(request: asked.Stability) -> RecordAtRest:
    """Return noise and drift of a static record, and recommended settings of a reading. Raises `Refused`."""
    size, runs = request.size, runs_folder(request.runs)
    if size is not None and not (math.isfinite(size) and size > 0):
        raise Refused(f"--size {size}: give a positive number in the unit of the signals")
    taken, notes = _bench_of(request.record, runs, request.bench)
    bench = taken.file
    source = _known_input(request, runs)
    if source is not None:
        record, run, recorded_s = (
            of_meters(source, record_calibration_of(source).calibration),
            source.run,
            None,
        )
    elif request.model is not None:
        raise Refused("--model: a record at rest is evaluated without a model; leave out --model")
    else:
        record, run, recorded_s = _record_at_rest(request.record, runs, bench)
    integration_s = request.integration or recorded_s or record.interval_s
    if not 0 < integration_s <= record.interval_s:
        raise Refused(
            f"--integration {integration_s:g}: a sample cannot take longer than the time between samples; give "
            f"more than 0 and at most {_rounded_down(record.interval_s):.4g} s"
        )
    found = stability_of(
        record, integration_s, size, bench.line_frequency, bench.nplc_supported, bench.most_samples
    )
    if source is not None:
        found = replace(found, advice=None, no_advice=OF_METERS)
    return RecordAtRest(found, taken, (*notes, *record.notes), run)


stability = python_call(asked.Stability, at_rest, "stability")


def _bench_of(record: str, runs: Path, bench: Bench) -> tuple[BenchTaken, tuple[str, ...]]:
    """Return the bench file to use, and notes: `bench`, else that of the run or origin file, else the default."""
    if Path(record).is_file():
        return bench_of(record, None, origin_beside(Path(record)), bench)
    run = next((Run(folder) for folder in (runs / record, Path(record)) if (folder / BENCH).is_file()), None)
    return bench_of(record, run, OriginBeside(), bench)


def _known_input(request: asked.Stability, runs: Path) -> Source | None:
    """Return the record as a source if its input is known; None for any other file or run."""
    path = Path(request.record)
    if path.is_file():
        if REFERENCE_V not in split_table(path, REFERENCE_V)[0]:
            return None
    elif not any(Run(folder).imported for folder in (runs / request.record, path) if folder.is_dir()):
        return None
    model = None if request.model is None else Path(request.model)
    (source,) = load_sources(Request([request.record], runs, request.bench, model))
    return source if is_record(source.readings) else None


def _rounded_down(number: float) -> float:
    """Return a positive number rounded down to four digits, so that a limit is accepted as a message states it."""
    step = 10.0 ** (math.floor(math.log10(number)) - 3)
    return math.floor(number / step) * step


def _record_at_rest(name: str, runs: Path, bench: BenchFile) -> tuple[StaticRecord, Run | None, float | None]:
    """Return the record `name`; if it is a run, also the run and the integration time (s) of a sample."""
    path = Path(name)
    if path.is_file():
        return read_static(path), None, None
    if path.suffix.lower() in {".csv", ".txt"}:
        raise Refused(f"{name}: no such file; check the name")
    run = find_run(name, runs)
    readings = run.readings()
    settings = set(zip(readings.installation, readings.series, readings.target_rad, strict=True))
    if len(settings) > 1:
        raise Refused(f"{name}: the block was turned in this run; record one setting (procedure 'stability')")
    integrated = {step.samples * step.nplc for step in run.plan.steps if isinstance(step, Read)}
    integration_s = min(integrated) / bench.line_frequency if integrated else None
    return from_columns(name, readings.unit, readings.time_s, readings.signal), run, integration_s
