"""Repeats against their stated uncertainty, as JSON and as a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from pydantic import Field

from bench.base.arrays import CHANNELS
from bench.base.result_model import Real, ResultModel
from bench.diagnosis.free_records import BetweenRecords
from bench.stats.repeats import Ratio, Repeats

MEANING: Final = {
    "restart": "a value of its own in each repeat",
    "drift": "a random walk from one repeat to the next",
    "scale": "u times one factor, as where each repeat drifts within itself",
}


class RatioPart(ResultModel):
    """The ratio of the scatter of repeats to the u of their prediction from the others, with its 95 % interval."""

    value: float
    low: float
    high: float = Field(description="repeats are the units of the interval")


class TermPart(ResultModel):
    """The term that is added to u until it agrees with the scatter of repeats."""

    name: Literal["restart", "drift", "scale"]
    means: str
    size: list[float] = Field(description="of each kind of quantity; a factor of u for scale")


class RepeatsPart(ResultModel):
    """The scatter of repeats compared with their stated u."""

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
    """Return a sentence on the scatter of repeats; `where` says of what, `sizes` are the sizes of the term in
    words.
    """
    text = f"repeats {where} scatter {found.scatter:.2g} × u"
    if found.term is None or found.held_before is None or found.held_after is None:
        return text + ("; too few to leave one out" if found.held_before is None else ": u is honest")
    after = found.held_after
    return (
        f"{text}; with the term {found.term.name} ({', '.join(sizes)}; {MEANING[found.term.name]}) one left out "
        f"scatters {after.value:.2g} × u (95 %: {after.low:.2g} to {after.high:.2g}), without it "
        f"{found.held_before.value:.2g} × u"
    )


# --- zeros of free positions in several records ------------------------------------------------------


class HeldOutByRecord(ResultModel):
    """The ratio of scatter to stated u of the zeros of held-out records, predicted from the other records."""

    by: Literal["record"]
    before: Real = Field(description="with zeros that stay")
    after: Real = Field(description="with the term that widens u, where it is too small")


class BetweenRecordsPart(ResultModel):
    """The changes of the zeros between records, with each record fitted alone."""

    ratio: Real = Field(description="scatter of the zeros over their stated u")
    repeats: RepeatsPart
    u_with_term_g: list[list[list[Real]]] | None = Field(
        description="u of the zeros with the term; null where u is honest"
    )
    bench_file: str = Field(
        description="line of a bench file that puts the term into u of calibrations; may be empty"
    )
    scatter_g: list[Real]
    common_part: list[Real] = Field(
        description="part of the variance that the sensors share; null for one sensor"
    )
    held_out: HeldOutByRecord
    zeros_g: list[list[list[Real]]] = Field(description="by sensor, record and channel")
    u_g: list[list[list[Real]]]


def between_part(found: BetweenRecords) -> BetweenRecordsPart:
    """Return the part of a result on zeros of free positions in several records."""
    repeats = found.repeats
    before = np.nan if repeats.held_before is None else repeats.held_before.value
    return BetweenRecordsPart(
        ratio=repeats.scatter,
        repeats=repeats_part(repeats),
        u_with_term_g=None if repeats.term is None else repeats.term.u.tolist(),
        bench_file=found.in_bench_file(),
        scatter_g=found.scatter.tolist(),
        common_part=found.common.tolist(),
        held_out=HeldOutByRecord(
            by="record",
            before=before,
            after=before if repeats.held_after is None else repeats.held_after.value,
        ),
        zeros_g=found.zero.tolist(),
        u_g=found.u.tolist(),
    )


def repeats_between(between: BetweenRecords) -> str:
    """Return how zeros scatter between records, with the term by which u must be widened."""
    sizes = [f"{c} {size}" for c, size in zip(CHANNELS, between.term_sizes(), strict=False)]
    return repeats_told(between.repeats, "between records", sizes)
