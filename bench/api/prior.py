"""A calibration with what the units of its type tell: `calibrate --prior`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.analysis.calibration.result import Calibration
from bench.analysis.intercomparison.measured import STANDARD_GRAVITY
from bench.analysis.intercomparison.prior import CONFLICT_P, Joined, Prior, join
from bench.api.errors import Refused
from bench.base.arrays import u_of
from bench.files.prior import PriorFile, load_prior
from bench.model.block import COEFFICIENTS, Block

if TYPE_CHECKING:
    from bench.api.source import Source


@dataclass(frozen=True)
class PriorTaken:
    """A prior that a calibration was held against, and what became of it; `alone_u` is u without it, (12,)."""

    file: str
    prior: Prior
    joined: Joined
    notes: tuple[str, ...]
    alone_u: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "file": self.file,
            "type": self.prior.kind,
            "units": len(self.prior.units),
            "dof": self.prior.dof,
            "used": self.joined.used,
            "chi2": self.joined.chi2,
            "p": self.joined.p,
            "pull": dict(zip(COEFFICIENTS, self.joined.pull.tolist(), strict=True)),
            "u_without": dict(zip(COEFFICIENTS, self.alone_u, strict=True)),
        }


def read_prior(path: Path) -> Prior:
    """Read a prior file. Raises `FileMistakes`, or `Refused` where it is per another g."""
    file: PriorFile = load_prior(path)
    if file.per_g_m_s2 != STANDARD_GRAVITY:
        raise Refused(f"{path}: per_g_m_s2 is {file.per_g_m_s2:g}, expected {STANDARD_GRAVITY}")
    rows = [file.coefficients[name] for name in COEFFICIENTS]
    return Prior(
        kind=file.type,
        signal=file.signal,
        mean=np.array([row.mean for row in rows]),
        covariance=np.array(file.covariance),
        between=np.array([row.between_units for row in rows]),
        mean_u=np.array([row.u_mean for row in rows]),
        dof=file.dof,
        shrunk=file.shrunk,
        units=file.units,
        benches=file.benches,
        calibrations=file.calibrations,
        last=file.last,
        simulated=file.simulated,
        notes=file.notes,
    )


def with_prior(found: Calibration, source: Source, path: Path) -> tuple[Calibration, PriorTaken]:
    """Return a calibration joined with a prior of its unit's type, and what became of the prior.

    Where readings and prior disagree the calibration stands as it was, and says so. Raises `Refused` for a prior
    of another type, signal or kind of instruments, or one that has the unit itself behind it.
    """
    prior = read_prior(path)
    unit = source.bench.unit_under_test
    _refuse_other(prior, found, source, path)
    alike = found.covariance - found.covariance_readings
    joined = join(found.block.vector, found.covariance_readings, alike, prior, found.g_m_s2)
    notes = []
    if not unit.serial:
        notes.append(
            f"which unit this is was not recorded: that it is none of the {len(prior.units)} behind {path} is "
            "taken for granted"
        )
    if joined.used:
        notes.append(
            f"prior of type {prior.kind} ({len(prior.units)} units, {path}) counts beside the readings: they agree "
            f"(p = {joined.p:.2g}); residuals and noise are those of the readings alone"
        )
    else:
        worst = np.argsort(-np.abs(joined.pull))[:3]
        off = ", ".join(f"{COEFFICIENTS[k]} by {joined.pull[k]:+.1f} u" for k in worst)
        notes.append(
            f"prior of type {prior.kind} NOT USED: it contradicts the readings (p = {joined.p:.1g}, below "
            f"{CONFLICT_P:g}; {off}); this unit, its mounting or the type is another"
        )
    taken = PriorTaken(str(path), prior, joined, tuple(notes), tuple(u_of(found.covariance).tolist()))
    if not joined.used:
        return found, taken
    changed = replace(
        found,
        block=Block.from_vector(joined.vector),
        covariance=joined.covariance,
        covariance_readings=joined.covariance - alike,
        gain=np.tensordot(np.eye(len(COEFFICIENTS)) - joined.part, found.gain, axes=1),
    )
    return changed, taken


def _refuse_other(prior: Prior, found: Calibration, source: Source, path: Path) -> None:
    unit = source.bench.unit_under_test
    name = " ".join(filter(None, (unit.type, unit.serial)))
    if found.triangular is not None:
        raise Refused(
            "--prior: free positions alone leave the block's orientation open, and a prior states it"
        )
    if (unit.type or "") != prior.kind:
        raise Refused(
            f"{path}: is of type {prior.kind!r}, the unit here is of type {(unit.type or 'unknown')!r}"
        )
    if found.unit != prior.signal:
        raise Refused(f"{path}: coefficients in {prior.signal}/g, but the readings are in {found.unit}")
    if source.simulated != prior.simulated:
        its, here = ("simulated", "real") if prior.simulated else ("real", "simulated")
        raise Refused(f"{path}: made of {its} calibrations, this one is {here}: they are not mixed")
    if unit.serial and name in prior.units:
        raise Refused(
            f"{path}: {name} is among the units behind it, and would count twice; make one without it: bench fleet "
            f"prior 'type={prior.kind}' 'unit!={name}' --prior-out FILE"
        )
