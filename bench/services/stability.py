"""Noise and drift of a block at rest, or of meters at a known input, as `bench stability` reports them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from bench.base.files import to_text
from bench.base.tables import as_text
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.plan import Read
from bench.history.stability import (
    Stability,
    StaticRecord,
    from_columns,
    read_static,
    stability_of,
)
from bench.readings.csv import split_table
from bench.readings.table import REFERENCE_V, is_record
from bench.results.stability import StabilityResult, allan_figure, print_stability, stability_result
from bench.run.folder import BENCH, Run, find_run
from bench.services.arguments import python_call
from bench.services.bench_selection import BenchTaken, OriginBeside, bench_of, origin_beside
from bench.services.errors import Refused
from bench.services.record_calibration import OF_METERS, of_meters, record_calibration_of
from bench.services.requests import history as asked
from bench.services.requests.shared import Bench, runs_folder
from bench.services.source import Request, Source, load_sources

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
        yield "figure", stem.with_name(f"{stem.name}.svg"), allan_figure(self.found)


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
