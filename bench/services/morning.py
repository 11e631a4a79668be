"""The check of a bench each morning: `bench check --morning`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.calibration.result import CalibrationError
from bench.config.bench_file.file import BenchFile, load_bench
from bench.model.forward import ForwardModel
from bench.readings.table import Reading, readings_of
from bench.run.commission.morning import MorningCourse
from bench.run.expectation import COEFFICIENT_COUNT, STATE, Expectation, NoiseSizes, ReadingJudgement, poses
from bench.services.bench_selection import bench_path
from bench.services.errors import Refused
from bench.services.instruments import CommissioningPlan, commission, free_folder
from bench.services.requests.planning import Check
from bench.services.requests.shared import runs_folder
from drivers.clock import utc_now
from drivers.person import Person


def morning(
    request: Check, person: Person | None, tell: Callable[[str], None]
) -> tuple[dict[str, Any], Path]:
    """Carry out the morning check, simulated without a `person`; return result and folder. Raises `Refused`."""
    path = bench_path(request.bench)
    file = load_bench(path)
    folder = request.out or free_folder("morning-check")
    course = _course(file, path, request, simulated=person is None)
    what = "morning check"
    plan = CommissioningPlan(file, path, folder, person, request.seed, tell, course=course, what=what)
    return commission(plan), folder


def line_of(result: Mapping[str, Any]) -> str:
    """Return the outcome of a morning check in one line: ready, or what to do."""
    troubles = [one for one in result["findings"] if one["state"] not in ("works", "skipped")]
    if not troubles and not result["ended"] and not result["to_do"]:
        left = [
            f"{one['check']} not checked: {one['said']}"
            for one in result["findings"]
            if one["state"] == "skipped"
        ]
        return "; ".join([f"✓ {result['bench']} is ready, {len(result['findings'])} checks", *left])
    words = [f"{one['instrument']}: {one['check']}: {one['said']}; {one['remedy']}" for one in troubles]
    words += [f"{name}: {what}" for name, what in result["to_do"].items()]
    return "\n".join(
        [f"✗ {result['bench']} is not ready", *([result["ended"]] if result["ended"] else []), *words]
    )


def _course(file: BenchFile, path: Path, request: Check, *, simulated: bool) -> MorningCourse:
    from bench.services.check_block import chart_of, check_block_runs

    section, course = file.check_block, MorningCourse(request.reference)
    if section is None:
        return course
    course = replace(course, serial=section.serial, installation=next(iter(file.installation_models())))
    folder = runs_folder(request.runs)
    try:
        chart = chart_of(
            check_block_runs(file, folder, simulated=simulated), section, of_bench=path, folder=folder
        )
    except (Refused, CalibrationError) as why:
        return replace(course, no_chart=str(why))
    runs = [*chart.twelve.baseline, *chart.twelve.later]
    mean, covariance, own = np.zeros(STATE), np.zeros((STATE, STATE)), slice(COEFFICIENT_COUNT)
    mean[own], covariance[own, own] = chart.twelve.expected(utc_now())
    stand_u = {name: one.u for name, one in file.stand_distributions().items()}
    noise = NoiseSizes(max(run.s for run in runs), stand_u["setting_error"])
    model = ForwardModel(file.installation_models())

    def judge(reading: Reading) -> ReadingJudgement:
        row = readings_of([reading], "").conditions()
        expectation = Expectation(mean[None], covariance[None])
        expectation.remount(stand_u)
        pose = poses(model, file.nominal_block(), row, [reading.installation], row.angle_rad)
        return expectation.judge(np.asarray(reading.mean), pose, noise)

    return replace(course, judge=judge)
