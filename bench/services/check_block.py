"""The check block of a bench: values of its runs, their control chart, what that says of a new run."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.base.arrays import Floats, u_of
from bench.base.files import cache_folder, from_text, read_regular, write_whole
from bench.base.yaml_files import load_document, part
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import LEAST_ARL, LEAST_SMOOTHING, MOST_ARL, CheckBlockSection
from bench.history.control_chart import CheckRun, ControlChart, KnownDrift, Reference, control_chart
from bench.model.geometry import COEFFICIENTS
from bench.run.events import RecordError, RunState, sha256
from bench.run.folder import BENCH, Run, all_runs, find_run
from bench.services.calibration import CalibrationResult, calibration_of
from bench.services.coefficients import coefficients_of
from bench.services.errors import Refused
from bench.services.source import Request, load_sources
from bench.stats.control_charts import BASES, DEFAULT_ARL, Basis, Design, least_runs, shewhart_arl

if TYPE_CHECKING:
    from bench.run.events import UnitUnderTest


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


RESULT_FILE: Final = ".json"


@dataclass(frozen=True)
class CheckBlockChart:
    """The control chart of a check block, of which `block`, and what was left out (`notes`)."""

    chart: ControlChart
    block: str
    unit: str
    g_m_s2: float
    simulated: bool
    notes: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Whether the last run of the check block was in control."""
        return self.chart.in_control

    def sentence(self) -> str:
        """Return what the chart says of its last run."""
        if not self.chart.verdicts:
            first = self.chart.baseline[-1].name
            return f"NO VERDICT yet: {first} is the first, and nothing is there to hold it against"
        last = self.chart.verdicts[-1]
        if last.accepted:
            return f"IN CONTROL: {last.run}"
        return f"OUT OF CONTROL: {last.run}: {'; '.join(last.reasons)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the result as `bench chart --json` writes it."""
        return {
            "block": self.block,
            "unit": self.unit,
            "g_m_s2": self.g_m_s2,
            "simulated": self.simulated,
            **self.chart.to_json(),
            "notes": [*self.notes, *self.chart.notes],
        }


def is_check_block(bench: BenchFile, unit: UnitUnderTest) -> bool:
    """Whether a unit is the check block of a bench."""
    section = bench.check_block
    return section is not None and section.is_of(
        str(unit["type"]), str(unit["serial"]), bench.unit_under_test.type
    )


def check_block_runs(bench: BenchFile, runs: Path, *, simulated: bool) -> list[Run]:
    """Return the finished runs of the check block of a bench, oldest first.

    Simulated and real ones are never on one chart; of a bench are those whose bench file has its name.
    """
    found = []
    for run in all_runs(runs):
        try:
            unit = run.manifest.get("unit_under_test")
            own = unit is not None and is_check_block(bench, unit) and run.simulated == simulated
            if not own or part(load_document(run.folder / BENCH).data, "name") != bench.name:
                continue
            if run.history.state == RunState.FINISHED:
                found.append(run)
        except (RecordError, OSError, ValueError):
            continue
    return found


def chart_of(
    runs: Sequence[Run],
    section: CheckBlockSection,
    *,
    of_bench: Path | None = None,
    folder: Path = Path("runs"),
) -> CheckBlockChart:
    """Return the chart of runs of one check block.

    `of_bench` is where the bench file is, from which a reference is looked for; `folder` where runs are that it
    names. Raises `Refused` where there are none, or they are not of one kind.
    """
    values, notes = _values(runs)
    if not values:
        raise Refused(
            "no run of the check block that gives a calibration; measure it: bench run … --unit SERIAL"
        )
    _refuse_mixed(values)
    g = values[0].g_m_s2
    taken = {one.name: one.per(g).check_run(section.between_runs) for one in values}
    baseline, later, reference = _parts(taken, section, of_bench, folder, g)
    basis, on_basis = _basis(section.limits, len(baseline), reference)
    design = Design(_arl(section), section.smoothing, basis)
    try:
        chart = control_chart(
            baseline, later, design, reference=reference, drift=_drift(section), restarted=_restarted(section)
        )
    except CalibrationError as reason:
        raise Refused(str(reason)) from reason
    return CheckBlockChart(
        chart, values[-1].block, values[-1].unit, g, values[-1].simulated, (*notes, *on_basis)
    )


def _values(runs: Iterable[Run]) -> tuple[list[CheckValues], tuple[str, ...]]:
    values, notes = [], []
    for run in runs:
        try:
            values.append(check_values(run))
        except CalibrationError as reason:
            notes.append(f"{run.name} is left out, no calibration follows from it: {reason}")
    return sorted(values, key=lambda one: one.when), tuple(notes)


def _refuse_mixed(values: Sequence[CheckValues]) -> None:
    for what, own in (
        ("blocks", {one.block for one in values}),
        ("units", {one.unit for one in values}),
        ("kinds, real and simulated", {str(one.simulated) for one in values}),
    ):
        if len(own) > 1:
            raise Refused(
                f"these runs are of different {what} ({', '.join(sorted(own))}); a chart is of one: name its runs"
            )


def _arl(section: CheckBlockSection) -> float:
    if section.k is not None:
        return shewhart_arl(section.k)
    return DEFAULT_ARL if section.arl is None else section.arl


def _basis(wanted: Basis, baseline: int, reference: Reference | None) -> tuple[Basis, tuple[str, ...]]:
    """Return what limits can be from, with a note where that is not what was asked for."""
    if reference is not None:
        return "stated", ()
    order: tuple[Basis, ...] = ("scatter", "scaled", "stated")
    for basis in order[order.index(wanted) :]:
        if baseline >= least_runs(basis, len(COEFFICIENTS)):
            break
    if basis == wanted:
        return basis, ()
    need = least_runs(wanted, len(COEFFICIENTS))
    return basis, (
        f"limits are from '{basis}' until the baseline has {need} runs, for '{wanted}': it has {baseline}",
    )


def _parts(
    taken: dict[str, CheckRun], section: CheckBlockSection, of_bench: Path | None, folder: Path, g_m_s2: float
) -> tuple[list[CheckRun], list[CheckRun], Reference | None]:
    """Return the baseline, the runs that are judged by it, and the reference in its place, if there is one."""
    runs = list(taken.values())
    files = [name for name in section.reference if name.endswith(RESULT_FILE)]
    if files:
        if len(section.reference) > 1:
            raise Refused("check_block: reference: one result of 'bench calibrate --json', or runs; not both")
        return [], runs, _reference((of_bench or Path()).parent / files[0], g_m_s2)
    if section.reference:
        named = [_named(name, taken, section, folder, g_m_s2) for name in section.reference]
        names = {run.name for run in named}
        return named, [run for run in runs if run.name not in names], None
    days = section.baseline_days
    if days is not None:
        inside = [run for run in runs if days.first <= run.when.astimezone().date() <= days.last]
        if not inside:
            raise Refused(f"no run of the check block from {days.first} to {days.last}; see baseline_days")
        return inside, [run for run in runs if run not in inside and run.when > inside[0].when], None
    return *_begun(runs, section), None


def _begun(runs: Sequence[CheckRun], section: CheckBlockSection) -> tuple[list[CheckRun], list[CheckRun]]:
    """Return the first runs that are in control, each judged by those before it, and all others.

    The last run is always judged, so that it is no part of its own baseline.
    """
    baseline: list[CheckRun] = [runs[0]]
    later: list[CheckRun] = []
    for run in runs[1:-1]:
        if len(baseline) >= section.baseline:
            later.append(run)
            continue
        basis, _ = _basis(section.limits, len(baseline), None)
        design = Design(_arl(section), 1.0, basis)
        fits = control_chart(baseline, [run], design, drift=_drift(section)).in_control
        (baseline if fits else later).append(run)
    return baseline, [*later, *runs[1:][-1:]]


def _named(
    name: str, taken: dict[str, CheckRun], section: CheckBlockSection, folder: Path, g_m_s2: float
) -> CheckRun:
    return taken.get(name) or check_values(find_run(name, folder)).per(g_m_s2).check_run(section.between_runs)


def _reference(path: Path, g_m_s2: float) -> Reference:
    try:
        data = from_text(read_regular(path).decode())
    except (OSError, ValueError) as error:
        raise Refused(
            f"check_block: reference: {path}: no result of 'bench calibrate --json' ({error})"
        ) from error
    found = coefficients_of(data[0] if isinstance(data, list) and data else data, str(path))
    if not found.made_at:
        raise Refused(f"check_block: reference: {path}: says no date (made_at); a drift could not be counted")
    factor = np.where(np.arange(len(COEFFICIENTS)) < 9, g_m_s2 / found.g_m_s2, 1.0)
    when = datetime.fromisoformat(found.made_at)
    return Reference(
        path.name,
        when if when.tzinfo else when.replace(tzinfo=UTC),
        found.block.vector * factor,
        found.covariance * np.outer(factor, factor),
    )


def _drift(section: CheckBlockSection) -> KnownDrift | None:
    if not section.drift:
        return None
    stated = {name: one.value(name) for name, one in section.drift.items()}
    rows = np.array([stated.get(name, (0.0, 0.0)) for name in COEFFICIENTS])
    return KnownDrift(rows[:, 0], rows[:, 1])


def _restarted(section: CheckBlockSection) -> datetime | None:
    if section.restarted is None:
        return None
    return datetime.combine(section.restarted, time()).astimezone()


def with_options(
    section: CheckBlockSection,
    *,
    baseline: int | None = None,
    arl: float | None = None,
    smoothing: float | None = None,
    limits: str | None = None,
) -> CheckBlockSection:
    """Return a section with what is asked for in place of what the bench file says. Raises `Refused`."""
    if smoothing is not None and not LEAST_SMOOTHING <= smoothing <= 1.0:
        raise Refused(f"--smoothing {smoothing:g}: λ of an EWMA lies between {LEAST_SMOOTHING:g} and 1")
    if arl is not None and not LEAST_ARL <= arl <= MOST_ARL:
        raise Refused(f"--arl {arl:g}: a mean run length between {LEAST_ARL:g} and {MOST_ARL:g}")
    if limits is not None and limits not in BASES:
        raise Refused(f"--limits {limits}: limits are from {', '.join(BASES)}")
    asked: dict[str, Any] = {"smoothing": smoothing, "limits": limits}
    if baseline is not None:
        asked |= {"baseline": baseline}
        section = section.model_copy(update={"baseline_days": None, "reference": ()})
    if arl is not None:
        asked |= {"arl": arl}
        section = section.model_copy(update={"k": None})
    return section.model_copy(update={name: value for name, value in asked.items() if value is not None})
