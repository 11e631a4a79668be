"""A diagnosis of free positions in words, for the page and for the terminal alike."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from bench.diagnosis.free_result import OUTLIER, FreeDiagnosis, FreeFound
from bench.results.diagnosis import words

NOTHING: Final = "the positions agree with nine coefficients of each sensor within their scatter"
LISTED: Final = 2
"""So many readings files are named; of more, the first and how many."""


def lead(found: FreeDiagnosis) -> str:
    """Return the verdict in a word or two."""
    tied = any(one.cannot_tell_from for one in found.found)
    return words.LEAD[found.verdict] if found.verdict != "confounded" or tied else words.UNCONFIRMED


def named(found: FreeDiagnosis) -> str:
    """Return which readings it is of, shortly: of many files the first and the last."""
    parts = found.source.split(" + ")
    return found.source if len(parts) <= LISTED else f"{parts[0]} … {parts[-1]} ({len(parts)} readings files)"


def title(one: FreeFound) -> str:
    """Return what was found, of which channels, and what it cannot be told from."""
    of = f" of {', '.join(one.channels)}" if one.channels else ""
    return " or ".join([one.name + of, *one.cannot_tell_from])


def what(found: FreeDiagnosis) -> str:
    """Return what was found, in one sentence without its end."""
    rest = "; ".join(title(one) if one.in_catalogue else one.words for one in found.found) or NOTHING
    if not found.apart:
        return rest
    count = len(found.apart)
    return f"{OUTLIER}: {count} position{'s' * (count > 1)} stand{'s' * (count == 1)} apart; without: {rest}"


def gap(found: FreeDiagnosis) -> str:
    """Return how far naming closes the gap, or why that does not confirm what was found; nothing where none was."""
    if found.of_rest == "confounded" and found.gap.reason:
        return found.gap.reason
    return words.gap_in_words(found.gap)


def parameters(one: FreeFound) -> list[str]:
    """Return a line for each parameter: "K2 of y = 1980 ± 40 µg/g² (u)", of a sensor by itself with its number."""
    lines = [
        words.parameter_in_words(value, f" of {value.installations}" if value.installations else "")
        for value in one.values
        if value.u is not None
    ]
    shapes = [words.parameter_in_words(value, "") for value in one.values if value.u is None]
    return [*lines, *dict.fromkeys(shapes)]


def what_to_do(found: FreeDiagnosis, models: Sequence[str], copies: Sequence[str]) -> Iterator[str]:
    """Yield what a person does after it, a sentence each, with the commands to type."""
    several = found.records * found.rows.sensors > 1
    if found.apart:
        yield "Measure the positions that stand apart again, at rest" + (
            f"; until then the corrected copy is {', '.join(copies)}" if copies else ""
        )
    for number, model in enumerate(models, start=1):
        of = f" of sensor {number}" if len(models) > 1 else ""
        source = "each record" if several else found.source
        yield f"Take the model{of}: bench calibrate {source} --model {model}"
        yield f"Put it to the proof with new readings{of}: bench confirm NEW --model {model}"
    names = {one.name for one in found.found}
    if "zeros_by_run" in names or "scale_by_run" in names:
        yield (
            "Calibrate each record by itself (bench calibrate RECORD), and write down what differs between "
            "records: when it was switched on, its temperature, who moved it"
        )
    elif found.of_rest == "unknown":
        yield "Measure the same again: what comes back is of the sensor; below stands in which record it acts"
    elif found.of_rest == "confounded":
        yield "Measure again, more positions all round, and diagnose both: bench diagnose … --together"
    elif found.verdict == "agrees":
        yield f"Nothing; the coefficients stand: bench calibrate {'each record' if several else found.source}"


def why_no_model(found: FreeDiagnosis) -> str:
    """Return why there is no model file of what was found, after "no model …"."""
    if found.gap.shrinks is False:
        return "of what makes positions that were held out no smaller a gap: it would not be a better model"
    return "while the positions cannot tell; --accept-first takes the first"
