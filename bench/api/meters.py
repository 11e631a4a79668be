"""The voltmeters of a bench by who they are, and what runs with exchanged ones tell of how they differ."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.analysis.budget.alike import LearnedMeters, Told
from bench.analysis.budget.meters import may_move
from bench.analysis.calibration import CalibrationError
from bench.analysis.calibration.same_meters import METERS_DRIFT
from bench.analysis.learning.meters import Contrasts, MeterDifferences, MeterRun, exchanged, meter_differences
from bench.api.origin import Origin, instrument_name
from bench.api.taken import BenchTaken
from bench.base.arrays import CHANNELS, Floats
from bench.files.bench.file import BenchFile, FileMistakes, load_recorded_bench
from bench.files.bench.learned import MetersEntry

if TYPE_CHECKING:
    from bench.api.source import Source

FEW_DOF: Final = 4.0
NOT_RECORDED: Final = (
    "differences between the voltmeters: no record says which voltmeter read which channel of which block; runs "
    "do, and readings files that 'bench export' wrote from them"
)
BY_ADDRESS: Final = (
    "; no record has their serial numbers, so that a voltmeter at another address passes for another (real runs "
    "keep them; in a dry run only a bench file with certificates does)"
)
NOT_VOLTS: Final = "differences between the voltmeters: the signals are in {unit}"


def voltmeter_names(
    bench: BenchFile, taken: BenchTaken, origin: Origin | None, readings: str
) -> dict[str, str]:
    """Return who read each channel, by the record and its own bench file; empty where they do not tell."""
    recorded = None if origin is None else _recorded(bench, taken, origin, readings)
    if origin is None or recorded is None:
        return {}
    meters = recorded.instruments.voltmeters
    if not all(origin.instruments.get(meter.name) for meter in meters):
        return {}
    return {
        channel: instrument_name(
            origin.instruments[m.name], origin.serials.get(m.name, ""), m.resource, recorded.name
        )
        for m in meters
        for channel in m.channels
    }


def _recorded(bench: BenchFile, taken: BenchTaken, origin: Origin, readings: str) -> BenchFile | None:
    """Return the bench file of the record: one that was asked for in its place may have the meters otherwise."""
    if taken.sha256 == origin.bench.sha256:
        return bench
    path = origin.bench_file(Path(readings))
    try:
        return None if path is None else load_recorded_bench(path)
    except FileMistakes:
        return None


def differences_of(sources: Sequence[Source]) -> MeterDifferences | str:
    """Return how the voltmeters of runs of one bench differ, or why these runs do not tell it.

    The calibrations that it takes are with the stated limits of the stand, in whose rows' lengths these hardly are.
    """
    if sources[0].readings.unit != "V":
        return NOT_VOLTS.format(unit=sources[0].readings.unit)
    known = [
        (source, by_channel, day)
        for source in sources
        if source.block_name
        and (by_channel := _by_channel(source)) is not None
        and (day := _day(source)) is not None
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


def _day(source: Source) -> float | None:
    """Return the day of a record, counted from year 1; None where it is not told."""
    try:
        return datetime.fromisoformat(source.made_at or "").timestamp() / 86400.0
    except ValueError:
        return None


def _meter_run(source: Source, meters: tuple[str, str, str], day: float) -> MeterRun | None:
    from bench.api.calibration import calibration_of

    try:
        found = calibration_of(source).calibration
    except CalibrationError:
        return None
    anew = [s.covariance for s in found.sources if not s.cancels and s.of_block is None]
    forms = {c: meter for meter in source.bench.instruments.voltmeters for c in meter.channels}
    drift = [[may_move("voltmeter_gain", forms[c]), may_move("voltmeter_offset", forms[c])] for c in CHANNELS]
    return MeterRun.of(
        source.name, source.block_name, meters, day, found.block.vector,
        sum(anew, found.covariance_readings), found.block_terms, np.array(drift), float(METERS_DRIFT.days),
    )  # fmt: skip


# --- to a learned file and back -------------------------------------------------------------------------


def written_meters(found: MeterDifferences) -> dict[str, Any]:
    """Return the section of a learned file; covariances are widened for the few degrees of freedom."""
    return {
        "meters": list(found.meters),
        "group": list(found.group),
        "day": date.fromtimestamp(found.day * 86400.0).isoformat(),
        "gain": _written(found.gain),
        "offset_v": _written(found.zero),
        "runs": list(found.runs),
    }


def _written(of: Contrasts) -> dict[str, Any]:
    nu = max(float(np.min(of.freedom)), FEW_DOF)
    covariance: Floats = of.covariance * (nu / (nu - 2.0) if np.isfinite(nu) else 1.0)
    return {"values": of.values.tolist(), "covariance": ((covariance + covariance.T) / 2).tolist()}


def learned_meters(entry: MetersEntry) -> LearnedMeters:
    """Return the section of a learned file as a calibration takes it."""
    gain, zero = (
        Told(np.array(one.values), np.array(one.covariance), entry.group)
        for one in (entry.gain, entry.offset_v)
    )
    return LearnedMeters(entry.meters, entry.day, gain, zero)
