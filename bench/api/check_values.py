"""What a run of the check block gives to its chart; kept in the user's cache, as a calibration takes seconds."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from bench.analysis.control_charts.chart import CheckRun
from bench.api.calibration import CalibrationResult, calibration_of
from bench.api.source import Request, load_sources
from bench.base.arrays import Floats, u_of
from bench.base.cache import cache_folder
from bench.base.whole import write_whole
from bench.model.block import COEFFICIENTS
from bench.run.folder import Run
from bench.run.manifest import sha256

FORMAT: Final = 1
"""Rises where what is kept changes, or how a calibration finds it."""


@dataclass(frozen=True)
class CheckValues:
    """A calibration of the check block as its chart needs it: coefficients in `unit` per local g.

    `readings` (12, 12) is the covariance of readings and stand, `noise` (12,) the part that reading noise makes;
    `sources` (12, 12) by name are the errors that no reading shows, `meters_limits` (12, 12) those of the meters
    that cancel where the same ones read again.
    """

    name: str
    block: str
    when: datetime
    unit: str
    g_m_s2: float
    simulated: bool
    design: str
    meters: tuple[str, ...]
    value: Floats
    readings: Floats
    noise: Floats
    sources: dict[str, Floats]
    meters_limits: Floats
    s: float
    s_dof: float

    def per(self, g_m_s2: float) -> CheckValues:
        """Return it with scale factors per another local gravity: the same per m/s²."""
        factor = np.where(np.arange(len(COEFFICIENTS)) < 9, g_m_s2 / self.g_m_s2, 1.0)
        both = np.outer(factor, factor)
        return replace(
            self,
            g_m_s2=g_m_s2,
            value=self.value * factor,
            readings=self.readings * both,
            noise=self.noise * factor,
            sources={name: own * both for name, own in self.sources.items()},
            meters_limits=self.meters_limits * both,
        )

    def check_run(self, between_runs: Sequence[str]) -> CheckRun:
        """Return it for a chart; what comes anew with each run are readings and stand, and the sources named."""
        nothing = np.zeros_like(self.readings)
        own = [one for name, one in self.sources.items() if name.partition("[")[0] in between_runs]
        everything = sum(self.sources.values(), nothing)
        anew = sum(own, nothing)
        return CheckRun(
            self.name,
            self.when,
            self.value,
            self.readings + anew,
            self.noise,
            self.s,
            self.s_dof,
            self.design,
            self.meters,
            self.meters_limits,
            everything - anew - self.meters_limits,
        )


def check_values(run: Run) -> CheckValues:
    """Return the values of a run of the check block; from the cache where its record has not changed since.

    Raises `CalibrationError` where its readings give no calibration, `RecordError` where it cannot be believed.
    """
    head = run.trusted_history().head
    file = cache_folder("check-block") / f"{sha256(f'{FORMAT} {head}'.encode())}.json"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        return replace(_from_json(json.loads(file.read_text(encoding="utf-8"))), name=run.name)
    (source,) = load_sources(Request([str(run.folder)], run.folder.parent))
    values = _of(run, calibration_of(source))
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps(_to_json(values)))
    return values


def _of(run: Run, result: CalibrationResult) -> CheckValues:
    found = result.calibration
    nothing = np.zeros((len(COEFFICIENTS),) * 2)
    when = datetime.fromisoformat(run.created)
    return CheckValues(
        name=run.name,
        block=result.source.block_name,
        when=when if when.tzinfo else when.replace(tzinfo=UTC),
        unit=found.unit,
        g_m_s2=found.g_m_s2,
        simulated=run.simulated,
        design=str(run.manifest.get("plan_hash", "")),
        meters=result.source.meters,
        value=found.block.vector,
        readings=found.covariance_readings,
        noise=u_of(np.einsum("pnc,qnc,c->pq", found.gain, found.gain, found.noise.by_channel**2)),
        sources={source.name: source.covariance for source in found.sources},
        meters_limits=sum((s.covariance for s in found.sources if s.cancels), nothing),
        s=found.noise.reading,
        s_dof=found.noise.reading_dof if np.isfinite(found.noise.reading_dof) else 0.0,
    )


_ARRAYS: Final = ("value", "readings", "noise", "meters_limits")


def _to_json(values: CheckValues) -> dict[str, Any]:
    own = dict(vars(values))
    own |= {name: own[name].tolist() for name in _ARRAYS}
    own |= {
        "when": values.when.isoformat(),
        "meters": list(values.meters),
        "sources": {name: one.tolist() for name, one in values.sources.items()},
    }
    return own


def _from_json(data: dict[str, Any]) -> CheckValues:
    own = dict(data)
    own |= {name: np.array(own[name]) for name in _ARRAYS}
    own |= {
        "when": datetime.fromisoformat(own["when"]),
        "meters": tuple(own["meters"]),
        "sources": {name: np.array(one) for name, one in own["sources"].items()},
    }
    return CheckValues(**own)
