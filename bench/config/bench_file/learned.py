"""Learned files: what many runs told of a bench.

A bench file takes one with `learned: FILE`; `bench learn` writes it.
It holds for one stand: `learned_for` is the hash of what the bench file says of stand, head, installations and
meters, and the file is refused where that has changed. Certificates of instruments stand in the bench file and
are never touched: nothing here is an angle of a certified head's table, or a gain.
"""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
import yaml
from pydantic import Field, model_validator

from bench.base.arrays import ARCSEC, Floats
from bench.base.files import write_whole
from bench.base.units import AngleRad, SizeRad
from bench.base.yaml_files import FileMistake, FileMistakes, FileModel, load_validated
from bench.config.devices.certificates import Day
from bench.config.formulas import FormulaEntry
from bench.config.model_file import EffectEntry, WithEffects, written_effects
from bench.model import AppliedEffect

if TYPE_CHECKING:
    from bench.config.bench_file.file import BenchFile

FORMAT: Final = "1"
AngleName = Literal["axis_tilt", "zero_offset", "mounting_error", "mounting_offset", "mounting_roll"]
Dof = Annotated[float, Field(gt=0.0)]


class RunEntry(FileModel):
    """A run behind the file: its name, the head of its chain (empty without one), the hash of its readings."""

    name: str
    head: str = Field("", min_length=0)
    readings: str


class MeanEntry(FileModel):
    """The mean of an angle over all mountings, or over those of one installation, with its standard uncertainty."""

    angle: AngleName
    installation: str = Field("", min_length=0)
    value: AngleRad
    u: SizeRad


class SizeEntry(FileModel):
    """A size of the noise of one channel, in the unit of the signal, with degrees of freedom."""

    size: Annotated[float, Field(gt=0.0)]
    dof: Dof


class AngleSizeEntry(FileModel):
    """The setting error of the head with degrees of freedom."""

    size: SizeRad
    dof: Dof


class NoiseEntry(FileModel):
    """The noise of the channels in `unit`, and the setting error."""

    unit: str
    x: SizeEntry
    y: SizeEntry
    z: SizeEntry
    setting: AngleSizeEntry


class StandEntry(FileModel):
    """The stand's angles: means with their covariance in rad², and what a mounting adds (1 σ)."""

    means: tuple[MeanEntry, ...] = Field(min_length=1)
    covariance_rad2: tuple[tuple[float, ...], ...]
    remount: dict[AngleName, SizeRad]

    @model_validator(mode="after")
    def _one_shape(self) -> StandEntry:
        k = len(self.means)
        matrix = self.covariance
        if matrix.shape != (k, k) or not _symmetric(matrix):
            raise ValueError(f"covariance_rad2 of {k} means has {k} rows of {k} numbers, and is symmetric")
        if np.min(np.linalg.eigvalsh(matrix)) < -1e-9 * np.max(np.abs(matrix)):
            raise ValueError(
                "covariance_rad2 is no covariance: a combination of angles has a negative variance"
            )
        missing = {mean.angle for mean in self.means} - set(self.remount)
        if missing:
            raise ValueError(f"remount lacks {', '.join(sorted(missing))}, of which there is a mean")
        return self

    @property
    def covariance(self) -> Floats:
        """The covariance of the means, rad², (k, k)."""
        ragged = len({len(row) for row in self.covariance_rad2}) > 1
        return np.zeros((0, 0)) if ragged else np.array(self.covariance_rad2, dtype=np.float64)


def _symmetric(covariance: Floats) -> bool:
    """Whether a covariance (k, k) is symmetric, in terms of its own variances: in rad² all of it is tiny."""
    u = np.sqrt(np.abs(np.diag(covariance)))
    return bool(np.all(np.abs(covariance - covariance.T) <= 1e-9 * np.outer(u, u)))


class MeterValuesEntry(FileModel):
    """One quantity of each meter about the mean of its group, SI, with the covariance."""

    values: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]


class MetersEntry(FileModel):
    """How meters differ, about `day`: those of one `group` were compared, by the `runs` that exchanged them."""

    meters: Annotated[tuple[str, ...], Field(min_length=2)]
    group: tuple[int, ...]
    day: Day
    gain: MeterValuesEntry
    offset_v: MeterValuesEntry
    runs: tuple[str, ...]

    @model_validator(mode="after")
    def _one_shape(self) -> MetersEntry:
        k = len(self.meters)
        if len(self.group) != k or len(set(self.meters)) != k:
            raise ValueError(f"each of {k} meters is named once and has a group")
        for name, entry in (("gain", self.gain), ("offset_v", self.offset_v)):
            lengths = {len(row) for row in entry.covariance}
            if len(entry.values) != k or len(entry.covariance) != k or lengths != {k}:
                raise ValueError(f"{name} of {k} meters has {k} values and a covariance of {k} rows of {k}")
            matrix = np.array(entry.covariance)
            if not _symmetric(matrix) or np.min(np.linalg.eigvalsh(matrix)) < -1e-9 * np.max(np.abs(matrix)):
                raise ValueError(f"the covariance of {name} is none: it is symmetric and never negative")
        return self


class LearnedFile(WithEffects):
    """What runs told of a bench; `sizes`, `contradicting` and `not_identified` are for the reader of the file."""

    learned_file: Literal["1"]
    bench: str
    learned_for: str
    made: Day
    expires: Day
    simulated: bool
    runs: tuple[RunEntry, ...] = Field(min_length=1)
    stand: StandEntry
    noise: NoiseEntry
    meters: MetersEntry | None = None
    formulas: tuple[FormulaEntry, ...] = ()
    effects: tuple[EffectEntry, ...] = ()
    sizes: dict[str, Any] = Field(default_factory=dict)
    contradicting: tuple[str, ...] = ()
    not_identified: tuple[str, ...] = ()

    def has(self, head: str, readings: Sequence[str]) -> bool:
        """Whether a record by the head of its chain, or readings by any of their hashes, are behind the file."""
        return any((head and run.head == head) or run.readings in readings for run in self.runs)

    def expired(self, day: datetime.date) -> bool:
        """Whether readings of a day come too late for it."""
        return day > self.expires


def learned_for(bench: BenchFile) -> str:
    """Return the hash of what learned sizes are sizes of: stand, head, installations, meters."""
    own = {
        "stand": bench.stand.model_dump(mode="json"),
        "installations": {label: one.model_dump(mode="json") for label, one in bench.installations.items()},
        "head": bench.instruments.head.model_dump(mode="json"),
        "meters": [
            {"driver": m.driver, "channels": list(m.channels), "range": m.range}
            # the same kinds on the same channels, in whichever order, exchanged or not
            for m in sorted(bench.instruments.voltmeters, key=lambda m: m.channels)
        ],
    }
    return hashlib.sha256(json.dumps(own, sort_keys=True, default=str).encode()).hexdigest()


def load_learned(path: Path, bench: BenchFile) -> LearnedFile:
    """Read a learned file for a bench. Raises `FileMistakes`, also where it is of another stand."""
    file = load_validated(path, LearnedFile)
    if file.learned_for != learned_for(bench):
        text = (
            f"learned of bench {file.bench} with another stand, head, installations or meters than {bench.name} "
            "has now; learn anew ('bench learn'), or take 'learned' out of the bench file"
        )
        raise FileMistakes(path, [FileMistake(0, "learned_for", text)])
    return file


def write_learned(path: Path, content: Mapping[str, Any], effects: Sequence[AppliedEffect]) -> None:
    """Write a learned file that `load_learned` reads back to the same values. Raises `OSError`."""
    whole = {"learned_file": int(FORMAT), **content, **written_effects(effects)}
    write_whole(path, yaml.safe_dump(whole, sort_keys=False, allow_unicode=True, width=110))


def arcsec(angle_rad: float) -> str:
    """Return an angle as a learned file states it."""
    return f"{angle_rad / ARCSEC!r} arcsec"
