"""The result of `bench check`: the steps of a procedure on a bench, and its problems; as JSON and as text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pydantic import Field
from rich.console import Console

from bench.base.languages import HEADING, message, translated
from bench.base.result_model import ResultModel
from bench.base.tables import table
from bench.base.text import degrees
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.check import switched_before
from bench.config.procedure.plan import FIELDS, Plan, Read, Step, Turn
from bench.config.procedure.steps import scan_in_words
from bench.model.geometry import COEFFICIENTS
from bench.planning.choice import QUANTILES, TimeOutlook
from bench.planning.requirements import Outlook, Remedy
from bench.run.sentences import duration

_REMEDIES_LISTED: Final = 2
_NEARLY_ALL: Final = 0.995


class DiskPart(ResultModel):
    """The disk space that a run needs, and the free space."""

    folder: str
    needed_bytes: int
    free_bytes: int


class OpenCoefficients(ResultModel):
    """The coefficients that the readings at one temperature do not determine."""

    temperature_c: float | None
    coefficients: list[str]


class DirectionPart(ResultModel):
    """A linear combination of coefficients and stand errors; the readings do not determine it."""

    kind: str = Field(description="kind of combination; `turn` is a common turn of the block's axes")
    text: str
    members: dict[str, float]


class ObservabilityPart(ResultModel):
    """The coefficients and stand errors that the readings determine, and those that they do not determine."""

    rank: int
    unknowns: int
    determined: list[str]
    undetermined: list[str]
    directions: list[DirectionPart]
    remedies: list[Remedy] = Field(description="measurements that determine more, cheapest first")


class UntilPart(ResultModel):
    """The predicted time and number of settings of a run that stops at its goals (`--until`)."""

    draws: int
    noise_of_stated: float
    quantiles: list[float]
    time_s: list[float]
    settings: list[float]
    mean_time_s: float
    mean_settings: float
    reached: float | None = Field(description="fraction of runs that reach the goals; null without goals")
    whole_time_s: float
    whole_settings: int


class CheckResult(ResultModel):
    """The steps, expected time and problems of a procedure on a bench, and what its readings determine."""

    procedure: str
    bench: str
    plan_hash: str = Field(description="SHA-256 of the plan; a run is resumed only with the same")
    steps: int
    counts: dict[str, int] = Field(description="number of steps of each kind")
    operator_actions: int
    expected_s: float = Field(description="expected duration, s")
    expected_by_kind_s: dict[str, float]
    expected_by_installation_s: dict[str, float]
    """expected duration by installation, s; the empty name stands for the time before the first mounting"""
    longest_s: float = Field(description="duration with every repetition that failures permit, s")
    disk: DiskPart
    largest_signal_v: float
    not_determined: list[OpenCoefficients]
    """for each temperature, the coefficients that the readings do not determine"""
    observability: ObservabilityPart | None
    problems: list[str] = Field(description="contradictions between procedure and bench")
    dry_run_refuses: list[str] = Field(description="prompts without a default answer, which stop a dry run")
    hints: list[str] = Field(description="probable mistakes that do not prevent a run")
    until: UntilPart | None = Field(default=None, description="predicted duration of a run with this --until")


@dataclass(frozen=True)
class Findings:
    """The result of `bench check`, and the plan, bench and predictions from which its text is made."""

    result: CheckResult
    plan: Plan
    bench: BenchFile
    outlook: Outlook | None
    until: TimeOutlook | None

    @property
    def can_be_tried(self) -> bool:
        """Whether a dry run is possible: no problem, and no prompt that stops a dry run."""
        return not (self.result.problems or self.result.dry_run_refuses)


def observability_part(outlook: Outlook) -> ObservabilityPart:
    """Return the part of a result on the coefficients and stand errors that planned readings determine."""
    found = outlook.found
    return ObservabilityPart.from_object(
        found,
        unknowns=found.columns,
        directions=[
            DirectionPart(kind=d.kind.name.lower(), text=d.text(), members=dict(d.members))
            for d in found.directions
        ],
        remedies=outlook.remedies,
    )


def until_part(found: TimeOutlook) -> UntilPart:
    """Return the part of a result on the duration of a run that stops at its goals."""
    return UntilPart(
        draws=len(found.time_s),
        noise_of_stated=1.0,
        quantiles=list(QUANTILES),
        time_s=found.quantiles(found.time_s),
        settings=found.quantiles(found.settings),
        mean_time_s=np.mean(found.time_s),
        mean_settings=np.mean(found.settings),
        reached=np.mean(found.reached) if found.has_goal else None,
        whole_time_s=found.whole_s,
        whole_settings=found.whole,
    )


# --- text in the terminal -----------------------------------------------------------------------------


def print_findings(found: Findings, out: Console, *, every_step: bool = False) -> None:
    """Print steps (with `every_step`, one a line), expected times, undetermined coefficients and problems."""
    result, plan, bench = found.result, found.plan, found.bench
    if (before := switched_before(plan, bench)) is not None:
        out.print(f"{'before':>13}  {before}")
    for line in listing(plan, every_step=every_step):
        steps = f"{line.first}" if line.first == line.last else f"{line.first}–{line.last}"
        out.print(f"{steps:>13}  {translated(line.text)}")
    by_kind = table("step", ">count", ">expected time")
    for kind, seconds in result.expected_by_kind_s.items():
        by_kind.add_row(translated(kind, HEADING), str(result.counts.get(kind, "")), duration(seconds))
    by_installation = table("installation", ">expected time")
    for name, seconds in result.expected_by_installation_s.items():
        by_installation.add_row(name or translated(message("before", "heading"), HEADING), duration(seconds))
    out.print(by_kind)
    out.print(by_installation)
    longer = result.longest_s > result.expected_s
    at_most = message(f" (at most {duration(result.longest_s)})") if longer else ""
    out.print(
        message(
            f"{result.procedure} on {result.bench}: {result.steps} steps, {result.operator_actions} operator "
            f"actions, about {duration(result.expected_s)}{at_most}; plan {result.plan_hash[:12]}"
        )
    )
    disk = result.disk
    out.print(
        message(
            f"signals reach {result.largest_signal_v:.3g} V at nominal scale factors, on the "
            f"{bench.voltmeter_range_v:g} V range; the run needs about {disk_space(disk.needed_bytes)} of the "
            f"{disk_space(disk.free_bytes)} free in {disk.folder}"
        )
    )
    for sentence in (*_coefficients_in_words(result.not_determined), *_open_in_words(found.outlook)):
        out.print(sentence)
    if found.until is not None:
        out.print(f"--until: {outlook_in_words(found.until)}")
    for lead, sentences in (
        ("note", result.hints),
        (message("cannot be done"), result.problems),
        (message("a dry run refuses it"), result.dry_run_refuses),
    ):
        for sentence in sentences:
            out.print(f"{lead}: {sentence}")


def _coefficients_in_words(not_determined: list[OpenCoefficients]) -> Iterator[str]:
    if not not_determined:
        yield message("no calibration: the procedure has no reading in an installation of known orientation")
    temperatures: dict[tuple[str, ...], list[str]] = {}
    for one in not_determined:
        at = message("the first temperature") if one.temperature_c is None else f"{one.temperature_c:g} °C"
        temperatures.setdefault(tuple(one.coefficients), []).append(at)
    for names, places in temperatures.items():
        where = ", ".join(places) if len(not_determined) > 1 else ""
        determined = ", ".join(name for name in COEFFICIENTS if name not in names)
        if not names:
            said = message("determines all twelve coefficients")
        elif not determined:
            said = message("no calibration: the orientations determine none of the twelve coefficients")
        else:
            said = message(
                f"no calibration by itself: the orientations determine {determined} and leave "
                f"{', '.join(names)} open"
            )
        yield f"at {where}: {said}" if where else said


def _open_in_words(found: Outlook | None) -> Iterator[str]:
    if found is None:
        return
    for sentence in found.open:
        yield message(f"leaves open: {sentence}")
    if found.open:
        ways = "; ".join(map(_remedy_in_words, found.remedies[:_REMEDIES_LISTED]))
        yield (
            message(f"to determine it, choose one: {ways}")
            if ways
            else message("to determine it, choose one: no measurement on this bench does")
        )
    if found.turns:
        yield message(
            f"leaves open, as every procedure on one head: a common turn of the block's axes (about "
            f"{', '.join(found.turns)}); only the limits of the stand's angles bound it"
        )


def _remedy_in_words(remedy: Remedy) -> str:
    if not remedy.cost_s:
        return message(f"{remedy.text} (no further readings)")
    return message(f"{remedy.text} (about {duration(remedy.cost_s)} more)")


def outlook_in_words(found: TimeOutlook) -> str:
    """Return the predicted time and number of settings in words: median, and range of 90 % of all runs."""
    low_s, mid_s, high_s = found.quantiles(found.time_s)
    low, mid, high = (round(n) for n in found.quantiles(found.settings))
    reached = float(np.mean(found.reached))
    noise = message("was learned") if found.learned else message("the bench file states")
    whole = f"{found.whole}"
    if found.has_goal and reached < _NEARLY_ALL:
        whole = message(
            f"{found.whole}; reached in {100 * reached:.0f} % of runs; then the procedure has no more points"
        )
    return message(
        f"at the noise that {noise}: a run takes {duration(mid_s)} (90 % of runs {duration(low_s)} to "
        f"{duration(high_s)}) and {mid} settings ({low} to {high}); the whole procedure has "
        f"{duration(found.whole_s)} and {whole}"
    )


def disk_space(size: float) -> str:
    """Return a size in bytes with a decimal prefix: 1500 -> "1.5 kB"."""
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.4g} GB"


LONGEST_PERIOD: Final = 24
"""Longest pattern of steps, in steps, that the listing searches for."""

FEWEST_PASSES: Final = 6
"""Fewest equal passes that the listing folds into one line."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a listing: its text, and the numbers (from 1) of the first and last step that it describes."""

    first: int
    last: int
    text: str


@dataclass(frozen=True, slots=True)
class _Block:
    """A pattern of `period` steps from index `start` on, carried out `times` times in a row.

    Blocks of equal `shape` differ only in point, angle and pass.
    """

    start: int
    period: int
    times: int
    shape: tuple[object, ...]

    @property
    def end(self) -> int:
        return self.start + self.period * self.times


def listing(plan: Plan, *, every_step: bool = False) -> Iterator[Line]:
    """Yield the lines of a plan: similar steps in one line or, with `every_step`, a line for each step."""
    steps = plan.steps
    if every_step:
        yield from (Line(n, n, step.describe()) for n, step in enumerate(steps, start=1))
        return
    blocks = list(_blocks(steps))
    for start, period, times in _folded([block.shape for block in blocks], FEWEST_PASSES):
        for block in blocks[start : start + period]:
            yield Line(block.start + 1, block.end, _block_in_words(steps, block))
        if times > 1:
            rest = blocks[start + period : start + period * times]
            more = message(f"the same {times - 1} times more, to {_where(steps[rest[-1].end - 1])}")
            yield Line(rest[0].start + 1, rest[-1].end, more)


def _blocks(steps: Sequence[Step]) -> Iterator[_Block]:
    within_pass = [_shape(step, _POINT) for step in steps]
    for start, period, times in _folded(within_pass, 2):
        shape = tuple(_shape(step, _POINT_AND_PASS) for step in steps[start : start + period])
        yield _Block(start, period, times, (*shape, times))


def _folded(shapes: Sequence[object], fewest: int) -> Iterator[tuple[int, int, int]]:
    """Yield start index, period and number of repetitions of each pattern in the sequence `shapes`.

    At each element, the pattern that covers most elements is chosen, if it repeats at least `fewest` times;
    otherwise period and repetitions are 1.
    """
    numbers: dict[object, int] = {}
    codes = [numbers.setdefault(shape, len(numbers)) for shape in shapes]
    at = 0
    while at < len(codes):
        period, times = 1, 1
        for longer in range(1, LONGEST_PERIOD + 1):
            found = _times(codes, at, longer)
            if found >= fewest and found * longer > period * times:
                period, times = longer, found
        yield at, period, times
        at += period * times


def _times(codes: Sequence[int], start: int, period: int) -> int:
    """Return how many times in a row the `period` codes from index `start` on occur in `codes`."""
    end = start + period
    while end < len(codes) and codes[end] == codes[end - period]:
        end += 1
    return (end - start) // period


_POINT: Final = frozenset({"key", "point", "target_rad"})
_POINT_AND_PASS: Final = _POINT | {"pass_number"}


def _shape(step: Step, without: frozenset[str]) -> tuple[Any, ...]:
    """Return the shape of a step: its type, and its fields not in `without`; equal for similar steps."""
    return (type(step), *(getattr(step, name) for name in FIELDS[type(step)] if name not in without))


# --- in words ---------------------------------------------------------------------------------------


def _block_in_words(steps: Sequence[Step], block: _Block) -> str:
    if block.times == 1 and block.period == 1:
        return steps[block.start].describe()
    unit = steps[block.start : block.start + block.period]
    last = steps[block.end - block.period : block.end]
    doing = ", ".join(_doing(step) for step in unit)
    turns = [(a, b) for a, b in zip(unit, last, strict=True) if isinstance(a, Turn) and isinstance(b, Turn)]
    reads = [(a, b) for a, b in zip(unit, last, strict=True) if isinstance(a, Read) and isinstance(b, Read)]
    places = turns or reads
    if not places:
        return message(f"{block.times} times: {doing}")
    first, final = places[0]
    span = _span(*turns[0]) if turns else ""
    return f"{translated(_where(first))} {_to()} {final.point}{span}: {doing}"


def _where(step: Step) -> str:
    """Return in words the point of a step or, if it has none, the description of the step."""
    if not isinstance(step, Turn | Read):
        return step.describe()
    return step.where()


def _span(first: Turn, last: Turn) -> str:
    rising = message("rising", "heading") if first.direction > 0 else message("falling", "heading")
    return f", {translated(rising, HEADING)}, {degrees(first.target_rad)} {_to()} {degrees(last.target_rad)}"


def _to() -> str:
    return translated(message("to", "heading"), HEADING)


def _doing(step: Step) -> str:
    """Return in words what a step does, without the point: "turn", "read 10 × 1 NPLC", in the current language."""
    match step:
        case Turn():
            return translated(message("turn", "heading"), HEADING)
        case Read():
            return translated(message(f"read {step.samples} × {step.nplc:g} NPLC{scan_in_words(step)}"))
        case _:
            return translated(step.describe())
