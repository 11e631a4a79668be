"""plan-points: the test points that reach an uncertainty in the least time, or the most in a given one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.table import Table

from bench.analysis.planning.goals import (
    Goal,
    coefficient_goals,
    delta_g_goals,
    modulus_goals,
    vector_goal,
    whole_goal,
)
from bench.analysis.planning.points import Points, Sites, Stand, best_within, cheapest
from bench.analysis.planning.procedure_text import VERIFICATION_DEG, Times, procedure_text
from bench.analysis.planning.settings import Cost, fitted, settings_of
from bench.base.arrays import Floats
from bench.base.numbers import figures
from bench.base.units import ACCELERATION, DURATION, SCALE_FACTOR, VOLTAGE
from bench.cli import CommandError, printing
from bench.cli.quantities import named, quantity
from bench.cli.source import bench_path, check_target, write_json
from bench.files.bench.file import BenchFile, load_bench
from bench.files.shipped import find_procedure
from bench.model import ForwardModel, Mounting
from bench.model.geometry import specific_force_on_platform
from bench.procedure.check import check as check_against
from bench.procedure.load import load_procedure
from bench.readings.table import UNORIENTED, VERIFICATION
from bench.run.terminal import duration

MOST_ANGLES: Final = 72
_COMPARED: Final = "paper"


@dataclass(frozen=True)
class Request:
    """The options of `bench plan-points`."""

    bench: str | None
    u: Sequence[str]
    delta_g: float | None
    modulus: float | None
    up_to: str | None
    time: str | None
    least: str
    installations: str | None
    angles: int
    visits: int
    most_mountings: int
    most_settings: int
    cost_setting: str
    cost_remount: str
    cost_soak: str
    warm_up: str
    verify: bool
    out: Path | None
    json: str | None


def plan_points(request: Request) -> int:
    """Carry out `bench plan-points`; 1 when a time was given in which the goals are not reached."""
    check_target(request.json)
    _check_options(request)
    bench = load_bench(bench_path(request.bench))
    sizes = {name: d.u for name, d in bench.stand_distributions().items()}
    stand = Stand(ForwardModel(bench.installation_models()), bench.simulated_block(), sizes)
    verified = request.verify and VERIFICATION in stand.model.installations
    goals = _goals(request, bench, stand)
    times = _times(request)
    cost = times.cost(bench.line_frequency, verified=verified)
    sites = Sites(stand, _mounts(request, bench), _angles(request, bench))
    if request.time is None:
        weighed = cost if request.least == "time" else Cost(1.0, 1e-6)
        found = cheapest(stand, sites, goals, weighed, request.most_settings, request.most_mountings)
    else:
        limit_s = _duration("--time", request.time)
        found = best_within(stand, sites, goals, cost, limit_s, request.most_mountings)
    planned = Points(found.visits, found.goals, found.covariance, cost)
    compared = _paper(stand)
    if request.out is not None:
        _write(
            request.out,
            _remarks(planned, bench, asked=bool(_asked(request))),
            planned,
            times,
            bench,
            verified,
        )
    _tell(planned, compared, bench, request)
    write_json([_to_json(planned, compared, bench, request)], request.json)
    return 0 if planned.reached or not _asked(request) else 1


# --- what was asked ---------------------------------------------------------------------------------


def _asked(request: Request) -> bool:
    return bool(request.u) or request.delta_g is not None or request.modulus is not None


def _check_options(request: Request) -> None:
    if not _asked(request) and request.time is None:
        raise CommandError(
            "say what is to be reached (--u Kyx=20e-6, --u all=5e-5, --delta-g 1e-4, --modulus 1e-3 --up-to 5) "
            "or how long it may take (--time 4h)"
        )
    if request.up_to is not None and request.modulus is None:
        raise CommandError("--up-to belongs to --modulus: the uncertainty of |a| up to so many g")
    if request.least not in {"time", "settings"}:
        raise CommandError(f"--least is time or settings, not {request.least!r}")
    if not 3 <= request.angles <= MOST_ANGLES:
        raise CommandError(f"--angles {request.angles}: between 3 and {MOST_ANGLES} angles a turn")
    if request.out is not None and request.out.exists():
        raise CommandError(f"--out {request.out}: this file exists and is not overwritten; give another name")
    if request.out is not None and not request.out.absolute().parent.is_dir():
        raise CommandError(f"--out {request.out}: there is no such folder")


def _goals(request: Request, bench: BenchFile, stand: Stand) -> list[Goal]:
    goals = coefficient_goals(dict(_size(text) for text in request.u))
    if request.delta_g is not None:
        if VERIFICATION not in stand.model.installations:
            raise CommandError(
                "--delta-g needs the installation V of the verification points; state it in the bench file"
            )
        angles = np.radians(np.array(VERIFICATION_DEG, dtype=np.float64))
        turn = stand.model.installations[VERIFICATION].block_from_platform
        force = specific_force_on_platform(angles, np.zeros((len(angles), 5))) @ turn.T
        goals += delta_g_goals(stand.block, force, stand.noise.reading, request.delta_g)
    if request.modulus is not None:
        up_to = bench.unit_under_test.range
        if request.up_to is not None:
            up_to = quantity("--up-to", request.up_to, ACCELERATION)
        goals += modulus_goals(stand.block, up_to, request.modulus)
    return [*goals, whole_goal(stand.block, goals)] if goals else [vector_goal(stand.block)]


def _size(text: str) -> tuple[str, float]:
    """Read "Kyx=20e-6" or "Kyx=20 uV/g": a plain number is in V/g, of a bias in V."""
    name, size = named("--u", text, "Kyx=20e-6 (a standard uncertainty, V/g)")
    return name, quantity("--u", size, VOLTAGE if name.startswith("U0") else SCALE_FACTOR)


def _duration(option: str, text: str) -> float:
    seconds = quantity(option, text, DURATION, plain=False)
    if seconds < 0:
        raise CommandError(f"{option} {text}: a time is not negative")
    return seconds


def _times(request: Request) -> Times:
    times = Times(
        _duration("--cost-setting", request.cost_setting),
        _duration("--cost-remount", request.cost_remount),
        _duration("--cost-soak", request.cost_soak),
        _duration("--warm-up", request.warm_up),
    )
    if times.turn_s <= 0:
        raise CommandError("--cost-setting: a setting takes some time; give at least 1 s")
    return times


def _mounts(request: Request, bench: BenchFile) -> list[Mounting]:
    """The mountings to choose from: without a word 1 and 2, all where the third mounting angle is stated.

    Where it is taken for zero, a plan with other installations would believe them to fix the block's axes.
    """
    known = [label for label in bench.installation_models() if label not in {VERIFICATION, *UNORIENTED}]
    labels = known if _roll_stated(bench) else ["1", "2"]
    if request.installations is not None:
        labels = list(dict.fromkeys(label.strip() for label in request.installations.split(",")))
    strange = [label for label in labels if label not in known]
    if strange:
        raise CommandError(
            f"--installations: {bench.name} has no installation {', '.join(strange)} for a calibration "
            f"(it has {', '.join(known)}); state it in the bench file"
        )
    return [Mounting(series, label) for series in range(1, request.visits + 1) for label in labels]


def _roll_stated(bench: BenchFile) -> bool:
    return bench.stand.mounting_roll is not None and bench.stand.mounting_roll.limit > 0


def _angles(request: Request, bench: BenchFile) -> Floats:
    """The angles of an even turn that the head may come to from both sides, rad."""
    angles = 2 * np.pi * np.arange(request.angles) / request.angles
    if bench.head_limits_rad is None:
        return angles
    low, high = bench.head_limits_rad
    backoff = bench.head_backoff_rad
    allowed = (angles - backoff >= low - 1e-9) & (angles + backoff <= high + 1e-9)
    wrapped = angles - 2 * np.pi
    lower = (wrapped - backoff >= low - 1e-9) & (wrapped + backoff <= high + 1e-9)
    return np.sort(np.concatenate([angles[allowed], wrapped[lower & ~allowed]]))


# --- what was found ---------------------------------------------------------------------------------


def _paper(stand: Stand) -> dict[str, Any]:
    """The paper's procedure on this bench, to compare with."""
    settings = fitted(settings_of(load_procedure(find_procedure(_COMPARED)).expand()))
    return {"settings": len(settings), "covariance": stand.covariance(settings)}


def _write(file: Path, remarks: str, points: Points, times: Times, bench: BenchFile, verified: bool) -> None:
    """Write the procedure, never over another file, and check it against the bench as `bench check` does."""
    text = procedure_text(file.stem, remarks, points.visits, times, verified=verified)
    try:
        with file.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError:
        raise CommandError(
            f"--out {file}: this file exists and is not overwritten; give another name"
        ) from None
    problems = check_against(load_procedure(file).expand(), bench)
    if problems:
        raise CommandError(f"{file}: " + "; ".join(problems))


def _remarks(points: Points, bench: BenchFile, *, asked: bool) -> str:
    worst = points.worst
    told = f"{worst.name}: u = {worst.u(points.covariance):.3g} {worst.unit}"
    if asked:
        told += f" of {worst.asked:.3g} asked"
    return (
        f"Made by bench plan-points for the stand errors of {bench.name}.\n"
        f"{points.count} settings in {len(points.visits)} mountings, about {duration(points.time_s)}.\n"
        f"Least well reached: {told} (standard uncertainty, generalised least squares).\n"
    )


def _worst_by_name(points: Points) -> list[Goal]:
    """Of goals with the same name (directions of an acceleration) the one that is furthest from reached."""
    found: dict[str, Goal] = {}
    for goal in points.goals:
        known = found.get(goal.name)
        if known is None or goal.ratio(points.covariance) > known.ratio(points.covariance):
            found[goal.name] = goal
    return list(found.values())


def _tell(points: Points, compared: dict[str, Any], bench: BenchFile, request: Request) -> None:
    out = printing.console(json=request.json)
    table = Table(box=None, pad_edge=False)
    table.add_column("installation")
    table.add_column("settings", justify="right")
    table.add_column("angles (visits where more than one)")
    for mount, angles in points.visits.items():
        told = (f"{math.degrees(a):.6g}°" + (f"×{n}" if n > 1 else "") for a, n in sorted(angles.items()))
        table.add_row(str(mount), str(sum(angles.values())), " ".join(told))
    out.print(table)
    out.print(_goal_table(points, compared, asked=_asked(request)))
    out.print(
        f"{points.count} settings in {len(points.visits)} mountings on {bench.name}: about "
        f"{duration(points.time_s)}, warm-up and verification points included"
    )
    out.print(
        "u is of the stand's errors and the readings' own; 'bench budget' has the voltmeters' gain and others"
    )
    if not points.fit_is_tested:
        out.print(
            "too few repeats for a calibration's lack-of-fit test: an error that no file states may go unseen"
        )
    if not _roll_stated(bench):
        out.print("mounting_roll (alpha5) is not stated in the bench file and taken for zero")
    if request.out is not None:
        printing.written("procedure", request.out, out)
    if _asked(request) and not points.reached:
        worst = points.worst
        out.print(
            f"NOT REACHED in {request.time}: {worst.name} is {worst.ratio(points.covariance):.3g} times "
            "what is asked"
        )


def _goal_table(points: Points, compared: dict[str, Any], *, asked: bool) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("goal")
    for heading in (
        *(["asked u"] if asked else []),
        "planned u",
        f"u of the paper's {compared['settings']} settings",
        "",
    ):
        table.add_column(heading, justify="right")
    for goal in _worst_by_name(points):
        sizes = [goal.u(points.covariance), goal.u(compared["covariance"])]
        row = ([goal.asked] if asked else []) + sizes
        table.add_row(goal.name, *(figures(size * 1e6) for size in row), f"µ{goal.unit}")
    return table


def _to_json(points: Points, compared: dict[str, Any], bench: BenchFile, request: Request) -> dict[str, Any]:
    asked = _asked(request)
    return {
        "bench": bench.name,
        "settings": points.count,
        "mountings": [str(mount) for mount in points.visits],
        "time_s": points.time_s,
        "reached": points.reached if asked else None,
        "goals": [
            {
                "name": goal.name,
                "unit": goal.unit,
                "asked_u": goal.asked if asked else None,
                "u": goal.u(points.covariance),
                "u_paper": goal.u(compared["covariance"]),
            }
            for goal in _worst_by_name(points)
        ],
        "points": [
            {
                "installation": s.mount.installation,
                "series": s.mount.series,
                "pass": s.pass_number,
                "point": s.point,
                "angle_deg": round(math.degrees(s.angle_rad), 9),
                "direction": s.direction,
            }
            for s in points.settings()
        ],
        "lack_of_fit_tested": points.fit_is_tested,
        "covariance": points.covariance.tolist(),
        "procedure": None if request.out is None else str(request.out),
    }
