"""Test points: what is to be reached, what there is to choose from, the procedure that is made of them."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console

from bench.base.arrays import Floats
from bench.base.units import ACCELERATION, DURATION, SCALE_FACTOR, VOLTAGE
from bench.calibration.budget.coefficients import meters_of
from bench.calibration.budget.sources import assumed_stand, signed_sources
from bench.calibration.noise import KnownStand
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.check import check as check_against
from bench.config.procedure.load import load_procedure
from bench.config.shipped import find_procedure
from bench.model import ForwardModel, Mounting
from bench.model.geometry import specific_force_on_platform
from bench.planning.optimal_design import (
    Goal,
    Stand,
    coefficient_goals,
    delta_g_goals,
    modulus_goals,
    vector_goal,
    whole_goal,
)
from bench.planning.points import (
    VERIFICATION_DEG,
    Points,
    Sites,
    Times,
    best_within,
    cheapest,
    procedure_text,
)
from bench.planning.settings import Cost, Setting, fitted, settings_of
from bench.readings.table import UNORIENTED, VERIFICATION
from bench.results.planning import PlanPointsResult, plan_points_result, print_points
from bench.run.sentences import duration
from bench.services.bench_selection import find_bench_file
from bench.services.errors import Refused, named, quantity
from bench.services.requests.planning import PlanPoints
from drivers.clock import utc_now

MOST_ANGLES: Final = 72


@dataclass(frozen=True)
class Planned:
    """The result of `bench plan-points`, with what its text needs beside.

    `paper_settings` are those of the paper's procedure, `learned` is whether something was learned of the bench,
    `time` the one that was allowed.
    """

    result: PlanPointsResult
    paper_settings: int
    learned: bool
    time: str | None

    def print_on(self, out: Console) -> None:
        """Print the points of each mounting, the goals and the time."""
        print_points(
            self.result, out, paper_settings=self.paper_settings, learned=self.learned, time=self.time
        )


def planned(request: PlanPoints) -> Planned:
    """Return the test points that reach goals in the least bench time, or the most in a given time.

    Raises `Refused` for what cannot be asked, `CalibrationError` for goals that nothing reaches, `FileMistakes`.
    """
    _refuse_contradictions(request)
    taken = find_bench_file(request.bench)
    file = taken.file
    stand = stand_of(file, ForwardModel(file.installation_models()), day=utc_now().date())
    verified = request.verify and VERIFICATION in stand.model.installations
    goals = _goals(request, stand, file)
    times = _times(request)
    cost = times.cost(file.line_frequency, verified=verified)
    sites = Sites(
        stand, mountings(file, request.installations, request.visits), even_angles(file, request.angles)
    )
    if request.time is None:
        weighed = cost if request.least == "time" else Cost(1.0, 1e-6)
        found = cheapest(stand, sites, goals, weighed, request.most_settings, request.most_mountings)
        found = replace(found, cost=cost)
    else:
        limit_s = duration_s("--time", request.time)
        found = best_within(stand, sites, goals, cost, limit_s, request.most_mountings)
    paper_settings, u_paper = _of_paper(stand, goals)
    written = None
    if request.out is not None:
        _write_procedure(request.out, found, times, file, verified=verified, asked=request.has_goals)
        written = str(request.out)
    result = plan_points_result(found, u_paper, taken.part(), written, asked=request.has_goals)
    return Planned(result, paper_settings, taken.learned_path is not None, request.time)


def _refuse_contradictions(request: PlanPoints) -> None:
    """Raise `Refused` for options that do not go together, before anything is computed."""
    if not request.has_goals and request.time is None:
        raise Refused(
            "say what is to be reached (--u Kyx=20e-6, --u all=5e-5, --delta-g 1e-4, --modulus 1e-3 --up-to 5) "
            "or how long it may take (--time 4h)"
        )
    if request.up_to is not None and request.modulus is None:
        raise Refused("--up-to belongs to --modulus: the uncertainty of |a| up to so many g")
    if request.least not in {"time", "settings"}:
        raise Refused(f"--least is time or settings, not {request.least!r}")
    if not 3 <= request.angles <= MOST_ANGLES:
        raise Refused(f"--angles {request.angles}: between 3 and {MOST_ANGLES} angles a turn")
    out = request.out
    if out is not None and out.exists():
        raise Refused(f"--out {out}: this file exists and is not overwritten; give another name")
    if out is not None and not out.absolute().parent.is_dir():
        raise Refused(f"--out {out}: there is no such folder")


def stand_of(
    bench: BenchFile, model: ForwardModel, known: KnownStand | None = None, day: datetime.date | None = None
) -> Stand:
    """Return the bench as a plan for it sees it, with everything that a calibration signs.

    `known` is what was learned of it, `day` that of the readings: what a certificate states has drifted by then.
    Raises `CalibrationError` for a bench file that states no noise.
    """
    sizes = {name: d.u for name, d in (bench.stand_distributions() | assumed_stand(bench)).items()}
    hidden = signed_sources(bench, model, day)
    meters = meters_of([meter.channels for meter in bench.instruments.voltmeters])
    return Stand(model, bench.simulated_block(), sizes, known, hidden, meters)


def _goals(request: PlanPoints, stand: Stand, bench: BenchFile) -> list[Goal]:
    """Return what is to be reached: u of coefficients, of Δg, of |a| up to a size; else all alike."""
    goals = coefficient_goals(dict(_size(text) for text in request.u or ()))
    if request.delta_g is not None:
        goals += delta_g_of(stand, request.delta_g, "--delta-g")
    if request.modulus is not None:
        up_to_g = bench.unit_under_test.range
        if request.up_to is not None:
            up_to_g = quantity("--up-to", request.up_to, ACCELERATION)
        goals += modulus_goals(stand.block, up_to_g, request.modulus)
    return [*goals, whole_goal(stand.block, goals)] if goals else [vector_goal(stand.block)]


def delta_g_of(stand: Stand, asked_g: float, option: str) -> list[Goal]:
    """Return the goals of Δg at the verification points of the bench, as an option asks for them."""
    if VERIFICATION not in stand.model.installations:
        raise Refused(
            f"{option} needs the installation V of the verification points; state it in the bench file"
        )
    angles = np.radians(np.array(VERIFICATION_DEG, dtype=np.float64))
    turn = stand.model.installations[VERIFICATION].block_from_platform
    force = specific_force_on_platform(angles, np.zeros((len(angles), 5))) @ turn.T
    at = [Setting(Mounting(1, VERIFICATION), 1, i, float(a), 1) for i, a in enumerate(angles, start=1)]
    return delta_g_goals(stand.block, force, stand.noise.reading, asked_g, at)


def _size(text: str) -> tuple[str, float]:
    """Read "Kyx=20e-6" or "Kyx=20 uV/g": a plain number is in V/g, of a bias in V."""
    name, size = named("--u", text, "Kyx=20e-6 (a standard uncertainty, V/g)")
    return name, quantity("--u", size, VOLTAGE if name.startswith("U0") else SCALE_FACTOR)


def duration_s(option: str, text: str) -> float:
    """Return a time that an option gives, s. Raises `Refused` for one that is none."""
    seconds = quantity(option, text, DURATION, plain=False)
    if seconds < 0:
        raise Refused(f"{option} {text}: a time is not negative")
    return seconds


def _times(request: PlanPoints) -> Times:
    """Return what the steps of a procedure take. Raises `Refused` for a time that is none."""
    times = Times(
        duration_s("--cost-setting", request.cost_setting),
        duration_s("--cost-remount", request.cost_remount),
        duration_s("--cost-soak", request.cost_soak),
        duration_s("--warm-up", request.warm_up),
    )
    if times.turn_s <= 0:
        raise Refused("--cost-setting: a setting takes some time; give at least 1 s")
    return times


def mountings(bench: BenchFile, installations: str | None, visits: int) -> list[Mounting]:
    """Return the mountings to choose from: without a word all installations of the bench."""
    known = [label for label in bench.installation_models() if label not in {VERIFICATION, *UNORIENTED}]
    labels = known
    if installations is not None:
        labels = list(dict.fromkeys(label.strip() for label in installations.split(",")))
    strange = [label for label in labels if label not in known]
    if strange:
        raise Refused(
            f"--installations: {bench.name} has no installation {', '.join(strange)} for a calibration "
            f"(it has {', '.join(known)}); state it in the bench file"
        )
    return [Mounting(series, label) for series in range(1, visits + 1) for label in labels]


def even_angles(bench: BenchFile, count: int) -> Floats:
    """Return the angles of an even turn that the head may come to from both sides, rad."""
    angles = 2 * np.pi * np.arange(count) / count
    if bench.head_limits_rad is None:
        return angles
    low, high = bench.head_limits_rad
    backoff = bench.head_backoff_rad
    allowed = (angles - backoff >= low - 1e-9) & (angles + backoff <= high + 1e-9)
    wrapped = angles - 2 * np.pi
    lower = (wrapped - backoff >= low - 1e-9) & (wrapped + backoff <= high + 1e-9)
    return np.sort(np.concatenate([angles[allowed], wrapped[lower & ~allowed]]))


def _of_paper(stand: Stand, goals: Sequence[Goal]) -> tuple[int, dict[str, float]]:
    """Return how many settings the paper's procedure has, and the largest u that it gives of goals by name."""
    settings = fitted(settings_of(load_procedure(find_procedure("paper")).expand()))
    promise = stand.promise(settings, goals)
    u: dict[str, float] = {}
    for goal in promise.goals:
        u[goal.name] = max(goal.u(promise.readings), u.get(goal.name, 0.0))
    return len(settings), u


def _write_procedure(
    file: Path, points: Points, times: Times, bench: BenchFile, *, verified: bool, asked: bool
) -> None:
    """Write the procedure, never over another file, and check it against the bench as `bench check` does."""
    text = procedure_text(
        file.stem, _remarks(points, bench, asked=asked), points.visits, times, verified=verified
    )
    try:
        with file.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError:
        raise Refused(f"--out {file}: this file exists and is not overwritten; give another name") from None
    problems = check_against(load_procedure(file).expand(), bench)
    if problems:
        raise Refused(f"{file}: " + "; ".join(problems))


def _remarks(points: Points, bench: BenchFile, *, asked: bool) -> str:
    worst = points.worst
    least = f"{worst.name}: u = {points.u(worst):.3g} {worst.unit}"
    if asked:
        least += f" of {worst.asked:.3g} asked"
    return (
        f"Made by bench plan-points for the errors of {bench.name}.\n"
        f"{points.count} settings in {len(points.visits)} mountings, about {duration(points.time_s)}.\n"
        f"Least well reached: {least} (standard uncertainty, generalised least squares).\n"
    )
