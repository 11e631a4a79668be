"""The results of `bench require` and `bench plan-points`, as JSON and as text."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Final, Literal

from pydantic import Field
from rich.console import Console
from rich.table import Table

from bench.base.languages import HEADING, message, translated
from bench.base.numbers import figures
from bench.base.result_model import Matrix, ResultModel
from bench.base.tables import table
from bench.planning.points import ChosenPoints
from bench.planning.requirements import Limit
from bench.results.parts import BenchPart
from bench.run.sentences import duration

_MICRO: Final = 1e-6
_SHOWN: Final = {
    "rad": ("″", math.pi / 648000),
    "rad/s": ("″ a day", math.pi / 648000 / 86400),
    "V": (" µV", _MICRO),
    "1": (" ppm", _MICRO),
    "1/g": (" µg/g²", _MICRO),
    "1/g^2": (" µg/g³", _MICRO),
}
"""Printed unit of each SI unit, with its size in SI."""


# --- requirements ---------------------------------------------------------------------------------------


class LimitPart(ResultModel):
    """The largest permitted u of an error of the bench, and the corresponding limit of its distribution."""

    name: str
    symbol: str
    unit: str
    verdict: Literal["limit", "no limit", "cannot be reached"]
    u: float | None = Field(description="largest permitted standard uncertainty, SI")
    limit: float | None = Field(description="the same as the limit of its `distribution`")
    distribution: str
    k: float
    u_now: float = Field(description="standard uncertainty that the bench file states")
    part: float | None = Field(default=None, description="its fraction of the variance of the present bench")

    @classmethod
    def of_limit(cls, found: Limit, **part: float) -> LimitPart:
        """Return the part of the result on a limit; `part=` (if any) is the error's fraction of the variance."""
        source = found.source
        return cls.from_object(
            source,
            source.distribution,
            verdict=found.verdict,
            u=None if found.stated is None else found.u,
            limit=found.stated,
            distribution=source.distribution.shape,
            u_now=source.u,
            **part,
        )

    @property
    def words(self) -> str:
        """The limit with its printed unit, or the reason why there is no limit."""
        if self.limit is not None:
            return self.shown(self.limit, down=True)
        return message("cannot be reached") if self.verdict == "cannot be reached" else message("no limit")

    @property
    def now(self) -> str:
        """The limit of the error (half-width, or k u) that the bench file states, with its printed unit."""
        return self.shown(self.u_now * (math.sqrt(3.0) if self.distribution == "rectangular" else self.k))

    def shown(self, value: float, *, down: bool = False) -> str:
        """Return a `value` in SI with the printed unit of this error; `down` rounds towards zero."""
        unit, size = _SHOWN.get(self.unit, (f" {self.unit}", 1.0))
        return f"{figures(value / size, down=down)}{unit}"


class AlternativePart(ResultModel):
    """Another estimator or procedure, and the uncertainty that this would give on the present bench."""

    estimator: str
    procedure: str
    settings: int
    time_s: float
    reached: float
    kept: bool
    limit_alone: LimitPart


class RequireResult(ResultModel):
    """The limits of the errors of a bench for a required accuracy."""

    of: str = Field(description="required quantity: delta-g, modulus, acceleration or a coefficient")
    up_to: str | None = Field(description="largest acceleration, as requested")
    accuracy: float = Field(description="requested accuracy")
    unit: str
    k: float = Field(description="number of standard uncertainties that must not exceed the accuracy")
    bench: str
    bench_file: BenchPart
    procedure: str
    estimator: str
    reached: float = Field(description="k u of the bench with its present errors")
    kept: bool = Field(description="whether the present bench meets the accuracy")
    not_counted: float = Field(description="k u of the errors that are not included")
    alone: list[LimitPart] = Field(description="largest size of each error if the others stay as they are")
    share: str = Field(description="how the accuracy is divided among the errors: equal or cost")
    together: list[LimitPart] = Field(description="largest permitted sizes of all errors together")
    why_not_together: str | None
    alternatives: list[AlternativePart]


@dataclass(frozen=True)
class Requirements:
    """The result of `bench require`; its text also has the largest acceleration (g) and uncounted errors."""

    result: RequireResult
    up_to_g: float | None
    left_out: tuple[str, ...]

    def print_on(self, out: Console) -> None:
        """Print the limits, the alternatives, and whether the present bench meets the accuracy."""
        found = self.result
        of = found.of if self.up_to_g is None else message(f"{found.of} up to {self.up_to_g:g} g")
        out.print(
            f"{of}: {found.k:g} u within {_micro(found.accuracy)} µ{found.unit}, by "
            f"{found.estimator} from procedure {found.procedure} on {found.bench}"
        )
        out.print(_limit_table(found))
        if found.why_not_together:
            out.print(f"no balanced set: {found.why_not_together}")
        out.print(_alternative_table(found))
        out.print(
            f"bench as it is: {found.k:g} u = {_micro(found.reached)} µ{found.unit}"
            f"{' by the errors counted' if found.not_counted else ''}: {'KEPT' if found.kept else 'NOT KEPT'}",
            style="bold",
        )
        if found.not_counted:
            joint = translated(message("and", "heading"), HEADING)
            left_out = f" {joint} ".join(map(translated, self.left_out))
            out.print(
                f"not counted: {left_out}: {found.k:g} u = {_micro(found.not_counted)} "
                f"µ{found.unit} by itself"
                f"{', MORE THAN THE ACCURACY' if found.not_counted > found.accuracy else ''}"
            )


def _limit_table(found: RequireResult) -> Table:
    equal = found.share == "equal"
    shown = table(
        "error", "as", ">now", ">part of variance", ">limit alone",
        ">limits together, equal shares" if equal else ">limits together, by cost",
    )  # fmt: skip
    together = {limit.name: limit.words for limit in found.together}
    limits = translated(message("limits", "heading"), HEADING)
    for limit in found.alone:
        form = limits if limit.distribution == "rectangular" else f"k = {limit.k:g}"
        shown.add_row(
            limit.name, form, limit.now, f"{limit.part or 0:.1%}", limit.words, together.get(limit.name, "")
        )
    return shown


def _alternative_table(found: RequireResult) -> Table:
    name = found.alternatives[0].limit_alone.name if found.alternatives else ""
    shown = table(
        "estimator", "procedure", ">settings", ">time", f">{found.k:g} u", f">limit of {name} alone"
    )
    for other in found.alternatives:
        shown.add_row(
            other.estimator,
            other.procedure,
            str(other.settings),
            duration(other.time_s),
            f"{_micro(other.reached)} µ{found.unit}",
            other.limit_alone.words,
        )
    return shown


def _micro(value: float) -> str:
    return figures(value / _MICRO, 4)


# --- test points ------------------------------------------------------------------------------------------


class GoalPart(ResultModel):
    """A goal of the plan, and the standard uncertainty that the plan reaches."""

    name: str
    unit: str
    asked_u: float | None
    u: float = Field(description="combined u that `calibrate` (for Δg, `verify`) will state")
    u_paper: float = Field(description="the same for the points of the paper")


class PointPart(ResultModel):
    """A planned setting of the head: mounting, pass, point, angle, and direction of approach."""

    installation: str
    series: int
    pass_number: int = Field(alias="pass")
    point: int
    angle_deg: float
    direction: Literal[-1, 1]


class PlanPointsResult(ResultModel):
    """Test points that reach a required uncertainty in the least bench time."""

    bench: str
    bench_file: BenchPart
    settings: int
    mountings: list[str]
    time_s: float
    reached: bool | None = Field(description="whether every goal is met; null without goals")
    goals: list[GoalPart]
    points: list[PointPart]
    lack_of_fit_tested: bool = Field(description="whether there are enough repeats for a lack-of-fit test")
    covariance: Matrix = Field(description="combined covariance of the twelve coefficients")
    procedure: str | None = Field(description="path of the procedure file that was written")


def plan_points_result(
    points: ChosenPoints, u_paper: dict[str, float], bench: BenchPart, procedure: str | None, *, asked: bool
) -> PlanPointsResult:
    """Return the result for the chosen points; `u_paper` has, by goal, the u that the paper's points give."""
    return PlanPointsResult(
        bench=bench.name,
        bench_file=bench,
        settings=points.count,
        mountings=[str(mount) for mount in points.visits],
        time_s=points.time_s,
        reached=points.reached if asked else None,
        goals=[
            GoalPart.from_object(
                goal, asked_u=goal.asked if asked else None, u=points.u(goal), u_paper=u_paper[goal.name]
            )
            for goal in points.worst_by_name()
        ],
        points=[
            PointPart.from_object(
                s,
                s.mount,
                angle_deg=round(math.degrees(s.angle_rad), 9),
                direction=1 if s.direction > 0 else -1,
            )
            for s in points.settings()
        ],
        lack_of_fit_tested=points.fit_is_tested,
        covariance=points.covariance,
        procedure=procedure,
    )


@dataclass(frozen=True)
class PlannedPoints:
    """The result of `bench plan-points`, with additional data for its text.

    `paper_settings` is the number of settings in the paper's procedure. `learned` says whether the bench has a
    file of learned errors, which the plan does not use. `time` is the permitted bench time, None without one.
    """

    result: PlanPointsResult
    paper_settings: int
    learned: bool
    time: str | None

    def print_on(self, out: Console) -> None:
        """Print the points of each mounting, the goals, the time and the warnings."""
        found = self.result
        shown = table("installation", ">settings", "angles (visits where more than one)")
        visits: dict[tuple[int, str], Counter[float]] = {}
        for point in found.points:
            visits.setdefault((point.series, point.installation), Counter())[point.angle_deg] += 1
        for mount, angles in zip(found.mountings, visits.values(), strict=True):
            visited = (f"{angle:.6g}°" + (f"×{n}" if n > 1 else "") for angle, n in sorted(angles.items()))
            shown.add_row(mount, str(angles.total()), " ".join(visited))
        out.print(shown)
        out.print(_goal_table(found, self.paper_settings))
        out.print(
            f"{found.settings} settings in {len(found.mountings)} mountings on {found.bench}: about "
            f"{duration(found.time_s)}, warm-up and verification points included"
        )
        out.print("u is the combined one, which 'bench calibrate' will state; 'bench budget' has its parts")
        if self.learned:
            out.print("the plan uses the limits of the bench file, not what was learned of this bench")
        if not found.lack_of_fit_tested:
            out.print(
                "too few repeats for a calibration's lack-of-fit test: an unstated error may remain hidden"
            )
        if found.procedure is not None:
            out.print(f"procedure: {found.procedure}")
        if found.reached is False:
            times, name = max((goal.u / (goal.asked_u or math.inf), goal.name) for goal in found.goals)
            out.print(f"NOT REACHED in {self.time}: {name} is {times:.3g} times the goal")


def _goal_table(found: PlanPointsResult, paper_settings: int) -> Table:
    asked = found.reached is not None
    of_paper = ">" + translated(message(f"u of the paper's {paper_settings} settings"))
    shown = table("goal", *([">asked u"] if asked else []), ">planned u", of_paper, ">")
    for goal in found.goals:
        sizes = [goal.asked_u, goal.u, goal.u_paper]
        row = (figures(size * 1e6) for size in sizes if size is not None)
        shown.add_row(goal.name, *row, f"µ{goal.unit}")
    return shown
