"""Calibrations of one block beside one another, and what a record at rest says of noise and averaging."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from bench.base.files import to_text
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.plan import Read
from bench.history.comparison import Comparison, Snapshot
from bench.history.comparison import compare as compare_snapshots
from bench.history.stability import Stability, StaticRecord, from_columns, read_static, stability_of
from bench.results.compare import BenchOfSource, CompareResult, compare_result, history_figure
from bench.results.stability import StabilityResult, allan_figure, stability_result
from bench.run.events import MANIFEST
from bench.run.folder import BENCH, Run, find_run
from bench.services.bench_selection import BenchTaken, Told, bench_of, origin_beside
from bench.services.calibration import calibration_of
from bench.services.coefficients import date_of, snapshots_in
from bench.services.errors import Refused
from bench.services.requests import history as asked
from bench.services.requests.shared import Bench, runs_folder
from bench.services.source import load_sources, reading

Files = Iterator[tuple[str, Path, str]]
"""What is written: what it is, where, and its text."""


@dataclass(frozen=True)
class Compared:
    """A comparison, and the bench file that was taken for each of its readings."""

    found: Comparison
    taken: tuple[tuple[str, BenchTaken], ...]

    @cached_property
    def result(self) -> CompareResult:
        """The result as `bench compare --json` writes it."""
        bench = [BenchOfSource(source=name, **taken.to_dict()) for name, taken in self.taken]
        return compare_result(self.found, bench)

    def files(self, folder: Path) -> Files:
        """Yield what `bench compare --out` writes."""
        yield "result", folder / "compare.json", to_text(self.result.to_dict())
        yield "figure", folder / "compare.svg", history_figure(self.found)


def compared(request: asked.Compare) -> Compared:
    """Compare results, runs and readings files of one block.

    Raises `Refused` for dates that do not fit, `CalibrationError` where there is nothing to compare.
    """
    taken: list[tuple[str, BenchTaken]] = []
    snapshots = [one for name in request.sources for one in _snapshots(str(name), request, taken)]
    if request.date:
        snapshots = _dated(snapshots, request.date)
    return Compared(compare_snapshots(snapshots), tuple(taken))


def _snapshots(name: str, request: asked.Compare, taken: list[tuple[str, BenchTaken]]) -> list[Snapshot]:
    """Return the calibration of a run or readings file, or those in a result of `calibrate --json`.

    Which bench file is taken for readings is added to `taken`.
    """
    path = Path(name)
    if path.is_file() and path.suffix.lower() == ".json" and path.name != MANIFEST:
        return snapshots_in(path)
    (source,) = load_sources(reading(request, name))
    taken.append((name, source.taken))
    found = calibration_of(source).calibration
    return [
        Snapshot(
            name, date_of(source.made_at, name), source.block_name, found.unit, found.g_m_s2, found.block.vector,
            found.covariance, source.simulated, found.covariance_same_meters, source.meters,
            found.block_terms if found.sources else None, found.wander,
        )
    ]  # fmt: skip


def _dated(snapshots: list[Snapshot], dates: Sequence[str]) -> list[Snapshot]:
    if len(dates) != len(snapshots):
        raise Refused(
            f"--date: {len(dates)} given for {len(snapshots)} calibrations; give one for each, in their order"
        )
    return [replace(s, when=date_of(date, "--date")) for s, date in zip(snapshots, dates, strict=True)]


# --- a record at rest ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class RecordAtRest:
    """What a static record says, the bench file that was taken, what to know of that, and the run, if it is one."""

    found: Stability
    taken: BenchTaken
    notes: tuple[str, ...]
    run: Run | None

    @cached_property
    def result(self) -> StabilityResult:
        """The result as `bench stability --json` writes it."""
        return stability_result(self.found, self.taken.part())

    def files(self, out: Path | None) -> Files:
        """Yield what is written into `out`, or beside the record."""
        path = Path(self.found.record.source)
        if self.run is None:
            stem = (out or path.parent / "stability") / path.stem
        else:
            stem = out / f"{self.run.name}-stability" if out else self.run.folder / "stability"
        yield "result", stem.with_name(f"{stem.name}.json"), to_text(self.result.to_dict())
        yield "figure", stem.with_name(f"{stem.name}.svg"), allan_figure(self.found)


def at_rest(request: asked.Stability) -> RecordAtRest:
    """Return noise, drift and the averaging that a reading deserves.

    Raises `Refused` for a size or an integration time that cannot be, or a run in which the block was turned;
    `ReadingsError` and `CalibrationError` as the reading of a record does.
    """
    size, runs = request.size, runs_folder(request.runs)
    if size is not None and not (math.isfinite(size) and size > 0):
        raise Refused(f"--size {size}: a size is a positive number in the unit of the signals")
    taken, notes = _bench_of(request.record, runs, request.bench)
    bench = taken.file
    record, run, recorded_s = _record(request.record, runs, bench)
    integration_s = request.integration or recorded_s or record.interval_s
    if not 0 < integration_s <= record.interval_s:
        raise Refused(
            f"--integration {integration_s:g}: a sample cannot integrate longer than the {record.interval_s:.4g} s "
            "from one to the next"
        )
    found = stability_of(
        record, integration_s, size, bench.line_frequency, bench.nplc_supported, bench.most_samples
    )
    return RecordAtRest(found, taken, notes, run)


def _bench_of(record: str, runs: Path, bench: Bench) -> tuple[BenchTaken, tuple[str, ...]]:
    """Return the bench file asked for, else that of the run or told beside the record, else the usual one."""
    given = str(bench) if isinstance(bench, Path) else bench
    if Path(record).is_file():
        return bench_of(record, None, origin_beside(Path(record)), given)
    run = next((Run(folder) for folder in (runs / record, Path(record)) if (folder / BENCH).is_file()), None)
    return bench_of(record, run, Told(), given)


def _record(name: str, runs: Path, bench: BenchFile) -> tuple[StaticRecord, Run | None, float | None]:
    """Return the record, and its run with how long each sample integrated where it is one."""
    path = Path(name)
    if path.is_file():
        return read_static(path), None, None
    if path.suffix.lower() in {".csv", ".txt"}:
        raise Refused(f"{name}: no such file; check the name")
    run = find_run(name, runs)
    readings = run.readings()
    settings = set(zip(readings.installation, readings.series, readings.target_rad, strict=True))
    if len(settings) > 1:
        raise Refused(
            f"{name}: the block was turned in this run; a static record is one setting "
            "(procedure 'stability')"
        )
    integrated = {step.samples * step.nplc for step in run.plan.steps if isinstance(step, Read)}
    integration_s = min(integrated) / bench.line_frequency if integrated else None
    return from_columns(name, readings.unit, readings.time_s, readings.signal), run, integration_s
