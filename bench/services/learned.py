"""What was learned of a bench as an evaluation takes it; its voltmeters by who they are."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.calibration.budget.meters import (
    KnownMeters,
    LearnedDifferences,
    LearnedMeters,
    known_meters,
    may_move,
)
from bench.calibration.noise import METERS_DRIFT, KnownNoise, KnownStand
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile, FileMistakes, load_recorded_bench
from bench.config.bench_file.learned import LearnedFile, MetersEntry
from bench.history.learned import Contrasts, MeterDifferences, MeterRun, exchanged, meter_differences
from bench.model.effects import AppliedEffect, Effect
from bench.model.forward import ForwardModel
from bench.readings.corrected import VOLTS
from bench.services.bench_selection import BenchTaken, Origin, instrument_name

if TYPE_CHECKING:
    from bench.services.source import Source


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
        return datetime.datetime.fromisoformat(source.made_at or "").timestamp() / 86400.0
    except ValueError:
        return None


def _meter_run(source: Source, meters: tuple[str, str, str], day: float) -> MeterRun | None:
    from bench.services.calibration import calibration_of

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
        "day": datetime.date.fromtimestamp(found.day * 86400.0).isoformat(),
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
        LearnedDifferences(np.array(one.values), np.array(one.covariance), entry.group)
        for one in (entry.gain, entry.offset_v)
    )
    return LearnedMeters(entry.meters, entry.day, gain, zero)


SIMULATED: Final = "the sizes of learned file {bench} come from simulated runs"


@dataclass(frozen=True)
class LearnedTaken:
    """What an evaluation takes of a learned file, with notes; nothing where the file does not count for it.

    `name` says which differences of meters it is that `meters` hold.
    """

    known: KnownStand | None = None
    effects: tuple[AppliedEffect, ...] = ()
    own: tuple[Effect, ...] = ()
    notes: tuple[str, ...] = ()
    meters: KnownMeters | None = None
    name: str = ""


NOTHING: Final = LearnedTaken()


def take_learned(
    file: LearnedFile | None,
    day: datetime.date,
    unit: str,
    *,
    head: str = "",
    hashes: tuple[str, ...] = (),
    simulated: bool | None = None,
) -> LearnedTaken:
    """Return what counts of a file for readings of a day in a unit, of a record with this head and these hashes.

    `simulated` says whether the readings are, None where nobody does or there are none.
    """
    if file is None:
        return NOTHING
    told = f"what was learned of bench {file.bench} from {len(file.runs)} runs ({file.made})"
    if file.has(head, hashes):
        why = "these readings are among them, and would count twice"
    elif file.expired(day):
        why = f"it expired on {file.expires}; learn anew"
    elif simulated is False and file.simulated:
        why = "it comes from simulated runs, and these readings do not"
    else:
        notes = [f"{told} stands in place of the stated limits of the stand"]
        if simulated is None and file.simulated:
            notes.append(SIMULATED.format(bench=file.bench))
        if simulated and not file.simulated:
            notes.append("these readings are simulated, what was learned is not")
        known = _known(file, unit)
        if known.noise is None:
            notes.append(
                f"the learned noise is in {file.noise.unit}, these readings in {unit}: it does not count"
            )
        return LearnedTaken(known, file.applied_effects(), file.own_effects(), tuple(notes))
    return LearnedTaken(notes=(f"{told} is not used: {why}; the stated limits count",))


def learned_for_run(bench: BenchFile, path: Path, created: str, *, simulated: bool | None) -> LearnedTaken:
    """Return what counts for a run created at a civil time, by its bench file and where that lies.

    A run's own copies say the same whenever it is looked at. Raises `FileMistakes`.
    """
    file = BenchTaken(bench, str(path), "", "").learned()
    return take_learned(file, datetime.datetime.fromisoformat(created).date(), VOLTS, simulated=simulated)


def with_effects(model: ForwardModel, effects: tuple[AppliedEffect, ...]) -> ForwardModel:
    """Return a model with learned effects of the bench beside its own; one that it has stays as it has it."""
    there = {applied.effect.name for applied in model.effects}
    further = tuple(applied for applied in effects if applied.effect.name not in there)
    return replace(model, effects=(*model.effects, *further)) if further else model


def with_meters(
    found: LearnedTaken, file: LearnedFile, bench: BenchFile, day: datetime.date, meters: Mapping[str, str]
) -> LearnedTaken:
    """Return what was taken with the differences of a bench's voltmeters, by who read each channel."""
    if file.meters is None:
        return found
    if not meters:
        note = "how the voltmeters differ was learned, but not who read here: it does not count"
        return replace(found, notes=(*found.notes, note))
    names = [meters[meter.channels[0]] for meter in bench.instruments.voltmeters]
    known, notes = known_meters(bench, day, names, learned_meters(file.meters))
    return replace(found, meters=known, notes=(*found.notes, *notes), name=f"differences learned {file.made}")


def _known(file: LearnedFile, unit: str) -> KnownStand:
    stand, noise = file.stand, file.noise
    sizes = None
    if noise.unit == unit:
        channels = (noise.x, noise.y, noise.z)
        sizes = KnownNoise(
            np.array([one.size for one in channels]), np.array([one.dof for one in channels]),
            noise.setting.size, noise.setting.dof,
        )  # fmt: skip
    return KnownStand(
        tuple((mean.angle, mean.installation) for mean in stand.means),
        np.array([mean.value for mean in stand.means]),
        stand.covariance,
        dict(stand.remount.items()),
        sizes,
    )
