"""Files made from many runs: the learned file of a bench, and the prior file of a unit type."""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
import yaml
from pydantic import Field, model_validator

from bench.base.arrays import ARCSEC, Floats
from bench.base.files import write_whole
from bench.base.units import AngleRad, SizeRad
from bench.base.yaml_files import FileMistake, FileMistakes, FileModel, Place, load_validated, part
from bench.config.devices.device import Day
from bench.config.formulas import FormulaEntry
from bench.config.model_file import EffectEntry, OpenShape, WithEffects, written_effects
from bench.model import AppliedEffect
from bench.model.geometry import COEFFICIENTS

if TYPE_CHECKING:
    from bench.config.bench_file.file import BenchFile


FORMAT: Final = "1"
AngleName = Literal["axis_tilt", "zero_offset", "mounting_error", "mounting_offset", "mounting_roll"]
Dof = Annotated[float, Field(gt=0.0)]


class RunEntry(FileModel):
    """A run from which the file was learned.

    `head` is the head of its record's hash chain, empty without a record; `readings` is the hash of its readings.
    """

    name: str
    head: str = Field("", min_length=0)
    readings: str


class MeanEntry(FileModel):
    """The mean of an angle, over all mountings or those in one `installation`, with standard uncertainty `u`."""

    angle: AngleName
    installation: str = Field("", min_length=0)
    value: AngleRad
    u: SizeRad


class SizeEntry(FileModel):
    """The standard deviation of one channel's noise, in the unit of the signal, and its degrees of freedom."""

    size: Annotated[float, Field(gt=0.0)]
    dof: Dof


class AngleSizeEntry(FileModel):
    """The standard deviation of the head's setting error, and its degrees of freedom."""

    size: SizeRad
    dof: Dof


class NoiseEntry(FileModel):
    """Standard deviations of the noise of the three channels, in `unit`, and of the head's setting error."""

    unit: str
    x: SizeEntry
    y: SizeEntry
    z: SizeEntry
    setting: AngleSizeEntry


class StandEntry(FileModel):
    """The learned angles: `means`, their `covariance`, and standard deviations between mountings (`remount`)."""

    means: tuple[MeanEntry, ...] = Field(min_length=1)
    covariance_rad2: tuple[tuple[float, ...], ...]
    remount: dict[AngleName, SizeRad]

    @model_validator(mode="after")
    def _one_shape(self) -> StandEntry:
        k = len(self.means)
        matrix = self.covariance
        if matrix.shape != (k, k) or not _symmetric(matrix):
            raise ValueError(
                f"covariance_rad2 is not symmetric, {k} by {k}, for {k} means; run 'bench learn' again"
            )
        if np.min(np.linalg.eigvalsh(matrix)) < -1e-9 * np.max(np.abs(matrix)):
            raise ValueError(
                "covariance_rad2 is not a covariance: a combination of angles has a negative variance; "
                "run 'bench learn' again"
            )
        missing = {mean.angle for mean in self.means} - set(self.remount)
        if missing:
            raise ValueError(
                f"remount lacks {', '.join(sorted(missing))}, which 'means' has; run 'bench learn' again"
            )
        return self

    @property
    def covariance(self) -> Floats:
        """The covariance matrix of the means, rad², (k, k); (0, 0) if the rows differ in length."""
        ragged = len({len(row) for row in self.covariance_rad2}) > 1
        return np.zeros((0, 0)) if ragged else np.array(self.covariance_rad2, dtype=np.float64)


def _symmetric(covariance: Floats) -> bool:
    """Return whether a covariance (k, k) is symmetric within a tolerance proportional to its variances.

    Values in rad² are so small that any absolute tolerance would accept them.
    """
    u = np.sqrt(np.abs(np.diag(covariance)))
    return bool(np.all(np.abs(covariance - covariance.T) <= 1e-9 * np.outer(u, u)))


class MeterValuesEntry(FileModel):
    """Gain or offset of each meter relative to the mean of its group, and their covariance, in SI."""

    values: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]


class MetersEntry(FileModel):
    """The differences between meters, referred to the date `day`.

    Meters with the same `group` number were compared with each other; `runs` names the runs in which meters were
    exchanged.
    """

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
            raise ValueError(
                f"the {k} meters need {k} different names and {k} groups; run 'bench learn' again"
            )
        for name, entry in (("gain", self.gain), ("offset_v", self.offset_v)):
            lengths = {len(row) for row in entry.covariance}
            if len(entry.values) != k or len(entry.covariance) != k or lengths != {k}:
                raise ValueError(
                    f"{name} needs {k} values and {k} by {k} covariances for {k} meters; run 'bench learn' again"
                )
            matrix = np.array(entry.covariance)
            if not _symmetric(matrix) or np.min(np.linalg.eigvalsh(matrix)) < -1e-9 * np.max(np.abs(matrix)):
                raise ValueError(
                    f"the covariance of {name} is not symmetric or not positive; run 'bench learn' again"
                )
        return self


class LearnedFile(WithEffects):
    """A validated learned file: the errors of a bench, as its runs show them.

    `sizes` (the learned standard deviations), `contradicting` runs and `not_identified` errors are texts for
    the reader of the file; nothing is computed from them.
    """

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
    left_open: tuple[OpenShape, ...] = ()
    sizes: dict[str, Any] = Field(default_factory=dict)
    contradicting: tuple[str, ...] = ()
    not_identified: tuple[str, ...] = ()

    def has(self, head: str, readings: Sequence[str]) -> bool:
        """Whether the file was learned from the record with this chain `head`, or from any of these readings.

        `readings` are hashes. An empty `head` matches no record.
        """
        return any((head and run.head == head) or run.readings in readings for run in self.runs)

    def expired(self, day: datetime.date) -> bool:
        """Whether the file has expired for readings of a day."""
        return day > self.expires


def learned_for(bench: BenchFile) -> str:
    """Return a hash of those parts of a bench that learned values describe: stand, head, installations, meters."""
    own = {
        "stand": bench.stand.model_dump(mode="json"),
        "installations": {label: one.model_dump(mode="json") for label, one in bench.installations.items()},
        "head": bench.instruments.head.model_dump(mode="json"),
        "meters": [
            {"driver": m.driver, "channels": list(m.channels), "range": m.range}
            # sorted by channel: neither the order of the meters nor an exchange between equal ones matters
            for m in sorted(bench.instruments.voltmeters, key=lambda m: m.channels)
        ],
    }
    return hashlib.sha256(json.dumps(own, sort_keys=True, default=str).encode()).hexdigest()


def load_learned(path: Path, bench: BenchFile) -> LearnedFile:
    """Read a learned file. Raises `FileMistakes`, also if its `learned_for` is not that of `bench`."""
    file = load_validated(path, LearnedFile)
    if file.learned_for != learned_for(bench):
        text = (
            f"learned of bench {file.bench} with another stand, head, installations or meters than {bench.name} "
            "has now; learn again ('bench learn'), or remove 'learned' from the bench file"
        )
        raise FileMistakes(path, [FileMistake(0, "learned_for", text)])
    return file


def write_learned(path: Path, content: Mapping[str, Any], effects: Sequence[AppliedEffect]) -> None:
    """Write a learned file that `load_learned` reads back with equal values. Raises `OSError`."""
    whole = {"learned_file": int(FORMAT), **content, **written_effects(effects)}
    write_whole(path, yaml.safe_dump(whole, sort_keys=False, allow_unicode=True, width=110))


def arcsec(angle_rad: float) -> str:
    """Return an angle as text for a learned file, such as "1.5 arcsec"."""
    return f"{angle_rad / ARCSEC!r} arcsec"


Row = Annotated[tuple[float, ...], Field(min_length=len(COEFFICIENTS), max_length=len(COEFFICIENTS))]


class PriorCoefficient(FileModel):
    """The prior of one coefficient of a new unit: its `mean` and standard uncertainty `u`.

    `between_units` is the standard deviation between units, `u_mean` the standard uncertainty of the mean.
    """

    mean: float
    u: Annotated[float, Field(gt=0)]
    between_units: Annotated[float, Field(ge=0)]
    u_mean: Annotated[float, Field(ge=0)]


class PriorFile(FileModel):
    """A validated prior file: the expected coefficients of a further unit of a type.

    Scale factors are in the unit `signal` per g, where 1 g is `per_g_m_s2` in m/s². `last` is the date of the
    last of the `calibrations`. `covariance` (12, 12) has `dof` degrees of freedom; in its part between units,
    correlations were reduced by the fraction `shrunk`.
    """

    type: str
    signal: str
    per_g_m_s2: Annotated[float, Field(gt=0)]
    simulated: bool
    units: Annotated[tuple[str, ...], Field(min_length=1)]
    benches: Annotated[tuple[str, ...], Field(min_length=1)]
    calibrations: Annotated[int, Field(gt=0)]
    last: str
    dof: Annotated[int, Field(gt=0)]
    shrunk: Annotated[float, Field(ge=0, le=1)]
    coefficients: dict[str, PriorCoefficient]
    covariance: Annotated[tuple[Row, ...], Field(min_length=len(COEFFICIENTS), max_length=len(COEFFICIENTS))]
    notes: tuple[str, ...] = ()

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield the mistakes in the names of coefficients and in the covariance matrix."""
        named = part(data, "coefficients")
        if isinstance(named, dict):
            missing = [name for name in COEFFICIENTS if name not in named]
            if missing or len(named) > len(COEFFICIENTS):
                yield ("coefficients",), f"expected {', '.join(COEFFICIENTS)}, each once"
        try:
            matrix = np.array(part(data, "covariance"), dtype=float)
            size = np.sqrt(np.diag(matrix))
            usable = bool(np.all(size > 0)) and np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0)
            usable = usable and bool(np.linalg.eigvalsh(matrix / np.outer(size, size))[0] > 0)
        except (TypeError, ValueError):
            return  # its form is reported by the field itself
        if not usable:
            yield (
                ("covariance",),
                "the matrix is no covariance (not symmetric or not positive); make the file again with 'bench "
                "fleet prior'",
            )


def load_prior(path: Path) -> PriorFile:
    """Read a prior file. Raises `FileMistakes` with every mistake in the file."""
    return load_validated(path, PriorFile)
