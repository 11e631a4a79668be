"""A plan as a list to read: steps that go on in the same way stand in one line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final, get_args

from bench.base.text import APPROACH, degrees
from bench.config.procedure.plan import Plan, Read, Step, Turn
from bench.config.procedure.steps import scan_in_words

LONGEST_PERIOD: Final = 24
"""Steps of one point at most that are looked at as a pattern."""

FEWEST_PASSES: Final = 6
"""Fewer blocks of points that differ by their pass alone are listed one by one."""


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a listing: the first and the last step that it stands for (from 1), and what they do."""

    first: int
    last: int
    text: str


@dataclass(frozen=True, slots=True)
class _Block:
    """Steps `start` … that repeat the first `period` of them `times` times, but for point and angle."""

    start: int
    period: int
    times: int
    shape: tuple[object, ...]

    @property
    def end(self) -> int:
        return self.start + self.period * self.times


def listing(plan: Plan, *, every_step: bool = False) -> Iterator[Line]:
    """Yield the lines of a plan; with `every_step` each step has its own."""
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
            more = f"the same {times - 1} times more, to {_where(steps[rest[-1].end - 1])}"
            yield Line(rest[0].start + 1, rest[-1].end, more)


def _blocks(steps: Sequence[Step]) -> Iterator[_Block]:
    """Divide steps into runs that repeat the same few; a block's shape leaves out its pass."""
    within_pass = [_shape(step, _POINT) for step in steps]
    for start, period, times in _folded(within_pass, 2):
        shape = tuple(_shape(step, _POINT_AND_PASS) for step in steps[start : start + period])
        yield _Block(start, period, times, (*shape, times))


def _folded(shapes: Sequence[object], fewest: int) -> Iterator[tuple[int, int, int]]:
    """Yield start, period and times of the patterns in a sequence, the one that covers most at each place.

    A pattern occurs at least `fewest` times, what is none stands alone.
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
    """Return how often the `period` codes from `start` on stand one after the other."""
    end = start + period
    while end < len(codes) and codes[end] == codes[end - period]:
        end += 1
    return (end - start) // period


_POINT: Final = frozenset({"key", "point", "target_rad"})
_POINT_AND_PASS: Final = _POINT | {"pass_number"}
_FIELDS: Final = {kind: tuple(f.name for f in fields(kind)) for kind in get_args(Step)}


def _shape(step: Step, without: frozenset[str]) -> tuple[Any, ...]:
    """Return what makes a step the same as another at other points."""
    return (type(step), *(getattr(step, name) for name in _FIELDS[type(step)] if name not in without))


# --- in words ---------------------------------------------------------------------------------------


def _block_in_words(steps: Sequence[Step], block: _Block) -> str:
    """Say what a block does."""
    if block.times == 1 and block.period == 1:
        return steps[block.start].describe()
    unit = steps[block.start : block.start + block.period]
    last = steps[block.end - block.period : block.end]
    doing = ", ".join(_doing(step) for step in unit)
    turns = [(a, b) for a, b in zip(unit, last, strict=True) if isinstance(a, Turn) and isinstance(b, Turn)]
    reads = [(a, b) for a, b in zip(unit, last, strict=True) if isinstance(a, Read) and isinstance(b, Read)]
    places = turns or reads
    if not places:
        return f"{block.times} times: {doing}"
    first, final = places[0]
    return f"{_where(first)} to {final.point}{_span(*turns[0]) if turns else ''}: {doing}"


def _where(step: Step) -> str:
    """Say at which point a step is done; what belongs to none is described."""
    if not isinstance(step, Turn | Read):
        return step.describe()
    return step.where()


def _span(first: Turn, last: Turn) -> str:
    return f", {APPROACH[first.direction]}, {degrees(first.target_rad)} to {degrees(last.target_rad)}"


def _doing(step: Step) -> str:
    """Say what a step does at any point."""
    match step:
        case Turn():
            return "turn"
        case Read():
            return f"read {step.samples} × {step.nplc:g} NPLC{scan_in_words(step)}"
        case _:
            return step.describe()
