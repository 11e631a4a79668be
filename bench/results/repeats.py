"""Repeats against their stated uncertainty, as JSON and as a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

from pydantic import Field

from bench.base.result_model import Real, ResultModel
from bench.stats.repeats import Ratio, Repeats

MEANING: Final = {
    "restart": "a value of its own in each repeat",
    "drift": "a random walk from one repeat to the next",
    "scale": "u times one factor, as where each repeat drifts within itself",
}


class RatioPart(ResultModel):
    """Scatter of repeats left out in turn over the u of their prediction, with a 95 % interval."""

    value: float
    low: float
    high: float = Field(description="repeats are the units of the interval")


class TermPart(ResultModel):
    """The term that widens u until repeats agree with it."""

    name: Literal["restart", "drift", "scale"]
    means: str
    size: list[float] = Field(description="of each kind of quantity; a factor of u for scale")


class RepeatsPart(ResultModel):
    """Repeats against their u."""

    ratio: Real = Field(description="scatter of the repeats over their stated u")
    too_small: bool = Field(description="whether u is too small by more than 1.5, and not by chance")
    before: RatioPart | None = Field(
        description="left out in turn, with u as stated; null below three repeats"
    )
    after: RatioPart | None = Field(description="the same with the term")
    term: TermPart | None


def repeats_part(found: Repeats) -> RepeatsPart:
    """Return the part of a result on repeats."""
    return RepeatsPart(
        ratio=found.scatter,
        too_small=found.too_small,
        before=_ratio(found.held_before),
        after=_ratio(found.held_after),
        term=None
        if found.term is None
        else TermPart(name=found.term.name, means=MEANING[found.term.name], size=found.term.size.tolist()),
    )


def _ratio(of: Ratio | None) -> RatioPart | None:
    return None if of is None else RatioPart.from_object(of)


def repeats_told(found: Repeats, where: str, sizes: Sequence[str]) -> str:
    """Return a sentence on repeats `where`; `sizes` are those of the term in words."""
    text = f"repeats {where} scatter {found.scatter:.2g} × u"
    if found.term is None or found.held_before is None or found.held_after is None:
        return text + ("; too few to leave one out" if found.held_before is None else ": u is honest")
    after = found.held_after
    return (
        f"{text}; with the term {found.term.name} ({', '.join(sizes)}; {MEANING[found.term.name]}) one left out "
        f"scatters {after.value:.2g} × u (95 %: {after.low:.2g} to {after.high:.2g}), without it "
        f"{found.held_before.value:.2g} × u"
    )
