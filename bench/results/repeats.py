"""Repeats against their stated uncertainty, as JSON and as a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from pydantic import Field

from bench.base.arrays import CHANNELS
from bench.base.languages import message
from bench.base.result_model import Real, ResultModel
from bench.diagnosis.free_records import BetweenRecords
from bench.stats.repeats import Repeats

MEANING: Final = {
    "restart": message("a value of its own in each repeat"),
    "drift": message("a random walk from one repeat to the next"),
    "scale": message(
        "a value of its own in each repeat, in proportion to u, as where each repeat drifts within itself"
    ),
}


class RatioPart(ResultModel):
    """Scatter of repeats about their predictions, divided by u of the prediction; with 95 % interval."""

    value: float
    low: float
    high: float = Field(description="upper end; repeats, not single values, are independent")


class TermPart(ResultModel):
    """The term that is added to u so that u agrees with the scatter of repeats."""

    name: Literal["restart", "drift", "scale"]
    means: str
    size: list[float]
    """standard deviation for each kind of quantity; for `scale`, in multiples of u"""


class RepeatsPart(ResultModel):
    """The scatter of repeats compared with their stated u."""

    ratio: Real = Field(description="scatter of the repeats divided by their stated u")
    too_small: bool = Field(description="whether u is significantly too small, by a factor above 1.5")
    before: RatioPart | None
    """ratio for repeats held out in turn, with u as stated; null for fewer than three repeats"""
    after: RatioPart | None = Field(description="the same ratio with u widened by `term`")
    term: TermPart | None


def repeats_part(found: Repeats) -> RepeatsPart:
    """Return the part of a result on repeats."""
    term = found.term
    return RepeatsPart.from_object(
        found,
        ratio=found.scatter,
        before=found.held_before,
        after=found.held_after,
        term=term and TermPart(name=term.name, means=MEANING[term.name], size=term.size.tolist()),
    )


def repeats_told(found: Repeats, where: str, sizes: Sequence[str]) -> str:
    """Return a sentence that compares the scatter of repeats with their u.

    `where` says which repeats, such as "between records". `sizes` states the term added to u in words, by channel.
    """
    text = message(f"repeats {where} scatter {found.scatter:.2g} × u")
    if found.held_before is None:
        return message(f"{text}; too few to leave one out")
    if found.term is None or found.held_after is None:
        return message(f"{text}: u is honest")
    after = found.held_after
    return message(
        f"{text}; with the term {found.term.name} ({', '.join(sizes)}; {MEANING[found.term.name]}) one left out "
        f"scatters {after.value:.2g} × u (95 %: {after.low:.2g} to {after.high:.2g}), without it "
        f"{found.held_before.value:.2g} × u"
    )


# --- zeros of free positions in several records ------------------------------------------------------


class HeldOutByRecord(ResultModel):
    """Biases (zeros) of held-out records: scatter about the prediction by other records, over stated u."""

    by: Literal["record"]
    before: Real = Field(description="ratio for constant zeros")
    after: Real = Field(description="ratio with u widened by the term; null if u is not too small")


class BetweenRecordsPart(ResultModel):
    """The changes of the biases (zeros, in g) from record to record, if each record is fitted alone."""

    ratio: Real = Field(description="scatter of the zeros divided by their stated u")
    repeats: RepeatsPart
    u_with_term_g: list[list[list[Real]]] | None
    """standard uncertainty of the zeros with the term, g; null if the stated u is not too small"""
    bench_file: str
    """line for a bench file that includes the term in u of calibrations; may be empty"""
    scatter_g: list[Real]
    common_part: list[Real]
    """fraction of the variance that all sensors share; null for one sensor"""
    held_out: HeldOutByRecord
    zeros_g: list[list[list[Real]]] = Field(description="zeros by sensor, record and channel, g")
    u_g: list[list[list[Real]]]


def between_part(found: BetweenRecords) -> BetweenRecordsPart:
    """Return the part of a result on the biases (zeros) in several records of free positions."""
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
    """Return a sentence on how biases (zeros) scatter between records, and the term to add to their u."""
    sizes = [f"{c} {size}" for c, size in zip(CHANNELS, between.term_sizes(), strict=False)]
    return repeats_told(between.repeats, message("between records"), sizes)
