"""plan-points: the test points that reach an uncertainty in the least time, or the most in a given one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from bench.base.numbers import figures
from bench.cli import printing, progress
from bench.cli.options import BenchOption, JsonOption, app
from bench.services.errors import Refused

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from bench.planning.points import Points
    from bench.services.bench_selection import BenchTaken
    from bench.services.points import PaperPoints

MOST_ANGLES: Final = 72


@app.command("plan-points", epilog="Example: bench plan-points --u all=1.2e-4 --out procedures/short.yaml")
def plan_points(
    bench: BenchOption = None,
    u: Annotated[
        list[str] | None,
        typer.Option(
            "--u",
            metavar="NAME=U",
            help="Combined standard uncertainty asked for: Kyx=90e-6 (V/g), U0, K, all.",
        ),
    ] = None,
    delta_g: Annotated[
        float | None, typer.Option("--delta-g", help="u(Δg) asked for at the verification points, g.")
    ] = None,
    modulus: Annotated[
        float | None, typer.Option(help="u(|a|) asked for in every direction, g: see --up-to.")
    ] = None,
    up_to: Annotated[
        str | None, typer.Option(help="Largest |a| for --modulus, g (default: the block's range).")
    ] = None,
    time: Annotated[
        str | None, typer.Option(help="The most uncertainty taken away in so much bench time, such as 4h.")
    ] = None,
    least: Annotated[str, typer.Option(help="What is to be least: time or settings.")] = "time",
    installations: Annotated[
        str | None,
        typer.Option(help="Installations to choose from, such as 1,2,1T90 (default: all)."),
    ] = None,
    angles: Annotated[int, typer.Option(help="Angles in a turn to choose from.")] = 24,
    visits: Annotated[int, typer.Option(help="How often an installation may be mounted.", min=1, max=4)] = 1,
    most_mountings: Annotated[int, typer.Option(help="Mountings of a plan at most.", min=1, max=6)] = 3,
    most_settings: Annotated[int, typer.Option(help="Settings of a plan at most.", min=4)] = 300,
    cost_setting: Annotated[str, typer.Option(help="Time to set the head once.")] = "2min",
    cost_remount: Annotated[str, typer.Option(help="Time to mount the block.")] = "20min",
    cost_soak: Annotated[str, typer.Option(help="Time in which the block settles after it.")] = "10min",
    warm_up: Annotated[str, typer.Option(help="Time before the first reading.")] = "1h",
    verify: Annotated[
        bool, typer.Option("--verify/--no-verify", help="Verification points at the end of the procedure.")
    ] = True,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Procedure file to write; never overwritten.")
    ] = None,
    json: JsonOption = None,
) -> int:
    """Test points that reach an uncertainty in the least bench time, or the most in a given time."""
    asked = bool(u) or delta_g is not None or modulus is not None
    printing.check_target(json)
    if not asked and time is None:
        raise Refused(
            "say what is to be reached (--u Kyx=20e-6, --u all=5e-5, --delta-g 1e-4, --modulus 1e-3 --up-to 5) "
            "or how long it may take (--time 4h)"
        )
    if up_to is not None and modulus is None:
        raise Refused("--up-to belongs to --modulus: the uncertainty of |a| up to so many g")
    if least not in {"time", "settings"}:
        raise Refused(f"--least is time or settings, not {least!r}")
    if not 3 <= angles <= MOST_ANGLES:
        raise Refused(f"--angles {angles}: between 3 and {MOST_ANGLES} angles a turn")
    if out is not None and out.exists():
        raise Refused(f"--out {out}: this file exists and is not overwritten; give another name")
    if out is not None and not out.absolute().parent.is_dir():
        raise Refused(f"--out {out}: there is no such folder")

    from bench.model import ForwardModel
    from bench.planning.points import Points, Sites, best_within, cheapest
    from bench.planning.settings import Cost
    from bench.readings.table import VERIFICATION
    from bench.services import points as api
    from bench.services.bench_selection import find_bench_file
    from drivers.clock import utc_now

    taken = find_bench_file(bench)
    file = taken.file
    stand = api.stand_of(file, ForwardModel(file.installation_models()), day=utc_now().date())
    verified = verify and VERIFICATION in stand.model.installations
    goals = api.stated_goals(stand, file, tuple(u or ()), delta_g, modulus, up_to)
    times = api.stated_times(cost_setting, cost_remount, cost_soak, warm_up)
    cost = times.cost(file.line_frequency, verified=verified)
    sites = Sites(stand, api.mountings(file, installations, visits), api.even_angles(file, angles))
    if time is None:
        weighed = cost if least == "time" else Cost(1.0, 1e-6)
        with progress.shown():
            found = cheapest(stand, sites, goals, weighed, most_settings, most_mountings)
    else:
        limit_s = api.duration_s("--time", time)
        with progress.shown():
            found = best_within(stand, sites, goals, cost, limit_s, most_mountings)
    planned = Points(found.visits, found.promise, cost)
    paper = api.paper_points(stand, goals)
    if out is not None:
        api.write_procedure(out, planned, times, file, verified=verified, asked=asked)
    printing.bench_file(taken, json)
    _print(planned, paper, taken, out, printing.console(json=json), asked=asked, time=time)
    printing.write_json([_to_json(planned, paper, taken, out, asked=asked)], json)
    return 0 if planned.reached or not asked else 1


def _print(
    points: Points,
    paper: PaperPoints,
    taken: BenchTaken,
    procedure: Path | None,
    out: Console,
    *,
    asked: bool,
    time: str | None,
) -> None:
    from bench.run.sentences import duration

    table = printing.table("installation", ">settings", "angles (visits where more than one)")
    for mount, angles in points.visits.items():
        visited = (f"{math.degrees(a):.6g}°" + (f"×{n}" if n > 1 else "") for a, n in sorted(angles.items()))
        table.add_row(str(mount), str(sum(angles.values())), " ".join(visited))
    out.print(table)
    out.print(_goal_table(points, paper, asked=asked))
    out.print(
        f"{points.count} settings in {len(points.visits)} mountings on {taken.file.name}: about "
        f"{duration(points.time_s)}, warm-up and verification points included"
    )
    out.print("u is the combined one, which 'bench calibrate' will sign; 'bench budget' has its parts")
    if taken.learned_path is not None:
        out.print("what was learned of this bench is not in it: a plan goes by the limits of the bench file")
    if not points.fit_is_tested:
        out.print(
            "too few repeats for a calibration's lack-of-fit test: an error that no file states may go unseen"
        )
    if procedure is not None:
        printing.written("procedure", procedure, out)
    if asked and not points.reached:
        worst = points.worst
        out.print(
            f"NOT REACHED in {time}: {worst.name} is {points.u(worst) / worst.asked:.3g} times what is asked"
        )


def _goal_table(points: Points, paper: PaperPoints, *, asked: bool) -> Table:
    from bench.services.points import worst_by_name

    of_paper = f">u of the paper's {paper.settings} settings"
    table = printing.table("goal", *([">asked u"] if asked else []), ">planned u", of_paper, ">")
    for goal in worst_by_name(points):
        sizes = [points.u(goal), paper.u[goal.name]]
        row = ([goal.asked] if asked else []) + sizes
        table.add_row(goal.name, *(figures(size * 1e6) for size in row), f"µ{goal.unit}")
    return table


def _to_json(
    points: Points, paper: PaperPoints, taken: BenchTaken, procedure: Path | None, *, asked: bool
) -> dict[str, Any]:
    from bench.services.points import worst_by_name

    return {
        "bench": taken.file.name,
        "bench_file": taken.to_dict(),
        "settings": points.count,
        "mountings": [str(mount) for mount in points.visits],
        "time_s": points.time_s,
        "reached": points.reached if asked else None,
        "goals": [
            {
                "name": goal.name,
                "unit": goal.unit,
                "asked_u": goal.asked if asked else None,
                "u": points.u(goal),
                "u_paper": paper.u[goal.name],
            }
            for goal in worst_by_name(points)
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
        "procedure": None if procedure is None else str(procedure),
    }
