"""The check block of a bench: its calibrations, their control chart, and the check before a run begins."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, time
from pathlib import Path
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats, u_of
from bench.base.files import cache_folder, from_text, read_regular, write_whole
from bench.base.languages import message
from bench.base.text import as_typed, cause_of, listed
from bench.base.yaml_files import load_document, part
from bench.calibration.intrinsic import INTRINSIC
from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import LEAST_ARL, LEAST_SMOOTHING, MOST_ARL, CheckBlockSection
from bench.history.control_chart import CheckRun, ControlChart, KnownDrift, Reference, control_chart
from bench.history.measured import of_gravity, to_gravity
from bench.model.geometry import COEFFICIENTS
from bench.readings.table import Readings
from bench.results.control_chart import CheckBlockChart
from bench.run.events import MANIFEST, RecordError, RunState, UnitUnderTest, sha256
from bench.run.folder import BENCH, Run, all_runs, find_run
from bench.services.arguments import python_call
from bench.services.bench_selection import find_bench_file, own_bench
from bench.services.calibration import CalibrationResult, calibration_of
from bench.services.coefficients import coefficients_of, date_of, dated
from bench.services.errors import NoCheckBlock, Refused
from bench.services.requests.evaluation import Chart
from bench.services.requests.shared import Bench, runs_folder
from bench.services.source import Request, load_sources
from bench.stats.control_charts import BASES, DEFAULT_ARL, Basis, ChartDesign, least_runs, shewhart_arl

FORMAT: Final = 3
"""Version of the cached values. Increment it when their form or the calibration behind them changes."""


@dataclass(frozen=True)
class CheckValues:
    """A calibration of the check block as the control chart uses it: coefficients in `unit` per local g.

    `value` (12,) are the coefficients. `readings` (12, 12) is their covariance from readings and stand, `noise`
    (12,) their standard uncertainty from reading noise alone. `sources` has, by name, the covariance (12, 12) from
    each error that no reading shows. `meters_limits` (12, 12) is the covariance from the meter errors that cancel
    if the same meters are used again. `s` is the standard deviation of a reading, `s_dof` its degrees of freedom.
    `gravity_u`, the relative u of local g, is in no covariance.
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
    gravity_u: float

    def per(self, g_m_s2: float) -> CheckValues:
        """Return the values with K per g of `g_m_s2` (m/s²) in place of this object's g; biases stay the same."""
        factor = to_gravity(self.g_m_s2, g_m_s2)
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

    def check_run(self, between_runs: Sequence[str], g_m_s2: float) -> CheckRun:
        """Return these values as a run of a control chart, with K per g of `g_m_s2`, m/s².

        Errors in `between_runs` vary from run to run.
        """
        here, nothing = self.per(g_m_s2), np.zeros_like(self.readings)
        own = [one for name, one in here.sources.items() if name.partition("[")[0] in between_runs]
        everything = sum(here.sources.values(), nothing)
        fresh = sum(own, nothing)
        return CheckRun(
            self.name,
            self.when,
            here.value,
            here.readings + fresh,
            here.noise,
            self.s,
            self.s_dof,
            self.design,
            self.meters,
            here.meters_limits,
            everything - fresh - here.meters_limits,
            place=self.g_m_s2,
            of_gravity=of_gravity(here.value, self.gravity_u),
        )


def check_values(run: Run) -> CheckValues:
    """Return the calibration of a check-block run; it is read from a cache if the record has not changed.

    Raises `CalibrationError` if the readings give no calibration, `RecordError` if the record is damaged.
    """
    head = run.trusted_history().head
    file = cache_folder("check-block") / f"{sha256(f'{FORMAT} {head}'.encode())}.json"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        return replace(_from_json(json.loads(file.read_text(encoding="utf-8"))), name=run.name)
    (source,) = load_sources(Request([str(run.folder)], run.folder.parent))
    values = _of(run, calibration_of(source))
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        stored = {**vars(values), "when": values.when.isoformat()}
        write_whole(file, json.dumps(stored, default=np.ndarray.tolist))
    return values


def _of(run: Run, result: CalibrationResult) -> CheckValues:
    found = result.calibration
    nothing = np.zeros((len(COEFFICIENTS),) * 2)
    when = date_of(run.created, run.name)
    assert when is not None  # noqa: S101 - every record has one
    return CheckValues(
        name=run.name,
        block=result.source.block_name,
        when=when,
        unit=found.unit,
        g_m_s2=found.g_m_s2,
        simulated=run.simulated,
        design=f"{run.manifest.get('plan_hash', '')} {_measured(found.fitted)}",
        meters=result.source.meters,
        value=found.block.vector,
        readings=found.covariance_readings,
        noise=u_of(np.einsum("pnc,qnc,c->pq", found.gain, found.gain, found.noise.by_channel**2)),
        sources={source.name: source.covariance for source in found.sources},
        meters_limits=sum((s.covariance for s in found.sources if s.cancels), nothing),
        s=found.noise.reading,
        s_dof=found.noise.reading_dof if np.isfinite(found.noise.reading_dof) else 0.0,
        gravity_u=found.gravity_u,
    )


def _measured(fitted: Readings) -> str:
    """Return the hash of the readings at each point: of one plan, those of a run with skipped steps are fewer."""
    at = zip(fitted.installation.tolist(), fitted.point.tolist(), fitted.direction.tolist(), strict=True)
    return sha256(repr(sorted(at)).encode())


def _from_json(data: dict[str, Any]) -> CheckValues:
    arrays = {name: np.array(data[name]) for name in ("value", "readings", "noise", "meters_limits")}
    sources = {name: np.array(one) for name, one in data["sources"].items()}
    when = datetime.fromisoformat(data["when"])
    return CheckValues(
        **{**data, **arrays, "sources": sources, "when": when, "meters": tuple(data["meters"])}
    )


RESULT_FILE: Final = ".json"


def is_check_block(bench: BenchFile, unit: UnitUnderTest) -> bool:
    """Whether a unit is the check block of a bench."""
    section = bench.check_block
    return section is not None and section.is_of(
        str(unit["type"]), str(unit["serial"]), bench.unit_under_test.type
    )


def check_block_runs(bench: BenchFile, runs: Path, *, simulated: bool) -> list[Run]:
    """Return the finished runs of a bench's check block, oldest first; a bench is known by its name."""
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
    """Return the control chart of the runs of a check block.

    `of_bench` is the path of the bench file; the path of a reference is relative to it. `folder` holds the runs
    that the section names. Raises `Refused` if no run gives a calibration, and for mixed runs.
    """
    values, notes = _values(runs)
    if not values:
        raise Refused("no run of the check block gives a calibration; measure it: bench run … --unit SERIAL")
    _refuse_mixed(values)
    g = values[0].g_m_s2
    if away := [one.name for one in values if one.g_m_s2 != g]:
        notes = (
            *notes,
            message(
                f"local gravity differs from that of {values[0].name}: {listed(away)}; between places, the limits "
                "include the u of both values of g; runs of one place show smaller changes"
            ),
        )
    taken = {one.name: one.check_run(section.between_runs, g) for one in values}
    baseline, later, reference = _parts(taken, section, of_bench, folder, values[0])
    try:
        (nine, on_basis), (twelve, _) = (
            _charted(baseline, later, reference, section, in_nine=which) for which in (True, False)
        )
    except CalibrationError as reason:
        raise Refused(str(reason)) from reason
    return CheckBlockChart(
        nine, twelve, values[-1].block, values[-1].unit, g, values[-1].simulated, (*notes, *on_basis)
    )


def _charted(
    baseline: Sequence[CheckRun],
    later: Sequence[CheckRun],
    reference: Reference | None,
    section: CheckBlockSection,
    *,
    in_nine: bool,
    smoothing: float | None = None,
) -> tuple[ControlChart, tuple[str, ...]]:
    """Return the chart of the nine or the twelve numbers; a note says so if the limits are not those requested."""
    drift = _drift(section)
    if in_nine:
        if drift is not None:
            drift = drift.in_nine(reference.value if reference is not None else baseline[0].value)
        reference = None if reference is None else reference.in_nine()
        baseline, later = ([run.in_nine() for run in runs] for runs in (baseline, later))
    count = len(INTRINSIC if in_nine else COEFFICIENTS)
    # one run of each further place shows no scatter
    alike = len(baseline) - max(len({run.place for run in baseline}) - 1, 0)
    basis, on_basis = _basis(section.limits, alike, reference, count)
    design = ChartDesign(_arl(section), section.smoothing if smoothing is None else smoothing, basis)
    begin = section.restarted
    restarted = None if begin is None else datetime.combine(begin, time()).astimezone()
    chart = control_chart(baseline, later, design, reference=reference, drift=drift, restarted=restarted)
    return chart, on_basis


def _values(runs: Iterable[Run]) -> tuple[list[CheckValues], tuple[str, ...]]:
    values, notes = [], []
    for run in runs:
        try:
            values.append(check_values(run))
        except CalibrationError as reason:
            notes.append(message(f"{run.name} is left out, because it gives no calibration: {reason}"))
    return sorted(values, key=lambda one: one.when), tuple(notes)


def _refuse_mixed(values: Sequence[CheckValues]) -> None:
    first = values[0]
    if other := next((one for one in values if one.block != first.block), None):
        raise Refused(
            f"runs of different blocks cannot share a chart ({first.name} is of {first.block}, {other.name} of "
            f"{other.block}); name only runs of one block"
        )
    if other := next((one for one in values if one.unit != first.unit), None):
        raise Refused(
            f"runs in different units cannot share a chart ({first.name} is in {first.unit}, {other.name} in "
            f"{other.unit}); name only runs of one unit"
        )
    if other := next((one for one in values if one.simulated != first.simulated), None):
        raise Refused(
            f"real and simulated runs cannot share a chart ({first.name} is simulated, {other.name} real); "
            "name only runs of one kind"
            if first.simulated
            else f"real and simulated runs cannot share a chart ({first.name} is real, {other.name} simulated); "
            "name only runs of one kind"
        )


def _arl(section: CheckBlockSection) -> float:
    if section.k is not None:
        return shewhart_arl(section.k)
    return DEFAULT_ARL if section.arl is None else section.arl


def _basis(
    wanted: Basis, baseline: int, reference: Reference | None, count: int
) -> tuple[Basis, tuple[str, ...]]:
    """Return the basis of limits that `baseline` runs allow for `count` numbers; a note if it is not `wanted`."""
    if reference is not None:
        return "stated", ()
    order: tuple[Basis, ...] = ("scatter", "scaled", "stated")
    for basis in order[order.index(wanted) :]:
        if baseline >= least_runs(basis, count):
            break
    if basis == wanted:
        return basis, ()
    need = least_runs(wanted, count)
    return basis, (
        message(
            f"give limits from '{basis}' until the baseline has {need} runs, for '{wanted}': it has {baseline}"
        ),
    )


def _parts(
    taken: dict[str, CheckRun],
    section: CheckBlockSection,
    of_bench: Path | None,
    folder: Path,
    first: CheckValues,
) -> tuple[list[CheckRun], list[CheckRun], Reference | None]:
    """Return the baseline runs, the later runs, and the reference that replaces the baseline (or None)."""
    runs = list(taken.values())
    files = [name for name in section.reference if name.endswith(RESULT_FILE)]
    if files:
        if len(section.reference) > 1:
            raise Refused(
                "check_block: reference: a result of 'bench calibrate --json' is listed with other entries; "
                "state this result alone, or runs alone"
            )
        return [], runs, _reference((of_bench or Path()).parent / files[0], first.g_m_s2, first.gravity_u)
    if section.reference:
        named = [
            taken.get(name)
            or check_values(find_run(name, folder)).check_run(section.between_runs, first.g_m_s2)
            for name in section.reference
        ]
        names = {run.name for run in named}
        return named, [run for run in runs if run.name not in names], None
    days = section.baseline_days
    if days is not None:
        inside = [run for run in runs if days.first <= run.when.astimezone().date() <= days.last]
        if not inside:
            raise Refused(
                f"no run of the check block from {days.first} to {days.last}; correct 'baseline_days', or "
                "measure the check block"
            )
        return inside, [run for run in runs if run not in inside and run.when > inside[0].when], None
    return *_begun(runs, section), None


def _begun(runs: Sequence[CheckRun], section: CheckBlockSection) -> tuple[list[CheckRun], list[CheckRun]]:
    """Return the baseline, which is the first runs in control, and all other runs.

    Each run is judged against those before it. The last of several runs is left for the chart to judge.
    """
    baseline: list[CheckRun] = [runs[0]]
    later: list[CheckRun] = []
    for run in runs[1:-1]:
        if len(baseline) >= section.baseline:
            later.append(run)
            continue
        fits = _charted(baseline, [run], None, section, in_nine=True, smoothing=1.0)[0].in_control
        (baseline if fits else later).append(run)
    return baseline, [*later, *runs[1:][-1:]]


def _reference(path: Path, g_m_s2: float, gravity_u: float) -> Reference:
    try:
        data = from_text(read_regular(path).decode())
    except (OSError, ValueError) as error:
        raise Refused(
            f"check_block: reference: {path}: not a result of 'bench calibrate --json' ({cause_of(error)}); "
            "name one"
        ) from error
    found = coefficients_of(data[0] if isinstance(data, list) and data else data, str(path))
    when = date_of(found.made_at, str(path))
    if when is None:
        raise Refused(
            f"check_block: reference: {path}: has no date (made_at), which its drift needs; "
            "make it with 'bench calibrate --json'"
        )
    # at another place, the errors of both values of g are in the difference from the bench's own runs
    there = dated(found, path.name, math.inf).per(g_m_s2, gravity_u)
    return Reference(path.name, when, there.vector, there.covariance)


def _drift(section: CheckBlockSection) -> KnownDrift | None:
    if not section.drift:
        return None
    stated = {name: one.value(name) for name, one in section.drift.items()}
    rows = np.array([stated.get(name, (0.0, 0.0)) for name in COEFFICIENTS])
    return KnownDrift(rows[:, 0], rows[:, 1])


def _with_options(section: CheckBlockSection, request: Chart) -> CheckBlockSection:
    smoothing, arl, limits = request.smoothing, request.arl, request.limits
    if smoothing is not None and not LEAST_SMOOTHING <= smoothing <= 1.0:
        raise Refused(f"--smoothing {smoothing:g}: give a λ of the EWMA between {LEAST_SMOOTHING:g} and 1")
    if arl is not None and not LEAST_ARL <= arl <= MOST_ARL:
        raise Refused(f"--arl {arl:g}: give a mean run length between {LEAST_ARL:g} and {MOST_ARL:g}")
    if limits is not None and limits not in BASES:
        raise Refused(f"--limits {limits}: give limits from {', '.join(BASES)}")
    asked = {"smoothing": smoothing, "limits": limits, "baseline": request.baseline, "arl": arl}
    update: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    if "baseline" in update:
        update |= {"baseline_days": None, "reference": ()}
    if "arl" in update:
        update["k"] = None
    return section.model_copy(update=update)


# --- which runs a chart is of ---------------------------------------------------------------------------


def charted(request: Chart) -> CheckBlockChart:
    """Return the control chart of a check block, as `bench chart` computes it.

    `runs` are runs of the check block by name or path, or a folder of runs (default: BENCH_RUNS, else ./runs).
    `bench` states the check block; the default is the bench file that the latest run recorded. `real` selects the
    real (True) or simulated (False) runs of a folder; by default those of the same kind as the latest run. Raises
    `Refused`.
    """
    folder = runs_folder(request.folder)
    named = [request.runs] if isinstance(request.runs, str | Path) else request.runs or [folder]
    place = Path(named[0])
    if len(named) == 1 and place.is_dir() and not (place / MANIFEST).is_file():
        runs, section, path = _in_folder(place, request.bench, request.real)
    else:
        runs = [find_run(str(name), folder) for name in named]
        file, path = _bench_file(request.bench, runs[-1])
        section = file.check_block or CheckBlockSection(serial=file.unit_under_test.serial, drift={})
    return chart_of(runs, _with_options(section, request), of_bench=path, folder=folder)


chart = python_call(Chart, charted, "chart")


def _bench_file(bench: Bench, run: Run) -> tuple[BenchFile, Path]:
    if bench or os.environ.get("BENCH_FILE"):
        taken = find_bench_file(bench)
        return taken.file, Path(taken.where)
    return own_bench(run)


def _in_folder(folder: Path, bench: Bench, real: bool | None) -> tuple[list[Run], CheckBlockSection, Path]:
    kinds = (True, False) if real is None else (not real,)
    file, path, latest = _of_folder(folder, bench, kinds)
    section = file.check_block
    if section is None:
        raise Refused(
            f"{path}: the bench file has no section check_block; add it, or name the runs of the check block"
        )
    simulated = latest.simulated if latest is not None else kinds[0]
    runs = check_block_runs(file, folder, simulated=simulated)
    if not runs:
        dry = " --dry-run" if real is False else ""
        raise Refused(
            f"{folder}: no finished run of the check block {section.serial} of {file.name} there; measure it "
            f"with 'bench run PROCEDURE --bench FILE --unit {as_typed(section.serial)}{dry}'"
        )
    return runs, section, path


def _of_folder(folder: Path, bench: Bench, kinds: Sequence[bool]) -> tuple[BenchFile, Path, Run | None]:
    """Return the bench file, its path, and the latest run of its check block (None if there is none)."""
    asked = bench or os.environ.get("BENCH_FILE")
    given = find_bench_file(bench) if asked else None
    for run in reversed(all_runs(folder)):
        try:
            unit = run.manifest.get("unit_under_test")
            if unit is None or run.simulated not in kinds:
                continue
            file, path = (given.file, Path(given.where)) if given else _bench_file(None, run)
        except (RecordError, OSError, ValueError):
            continue
        if is_check_block(file, unit):
            return file, path, run
    if given:
        return given.file, Path(given.where), None
    raise NoCheckBlock(
        f"{folder}: no run of a check block there; name the block in `check_block` of a bench file, then "
        "measure it: bench run PROCEDURE --bench FILE --unit SERIAL"
    )
