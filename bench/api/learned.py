"""What was learned of a bench, as an evaluation takes it: the stand's angles, the noise, effects of the bench.

Never by a run that is among those behind it, nor after its day, nor for signals in another unit.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bench.analysis.budget.alike import KnownMeters, known_meters
from bench.analysis.calibration.known import KnownNoise, KnownStand
from bench.api.meters import learned_meters
from bench.api.taken import BenchTaken
from bench.files.bench.file import BenchFile
from bench.files.bench.learned import LearnedFile
from bench.model import AppliedEffect, Effect, ForwardModel
from bench.readings.corrected import VOLTS

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
