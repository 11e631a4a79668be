"""A diagnosis of free positions as text in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from bench.base.computing import quiet
from bench.base.numbers import quantity, typeset
from bench.diagnosis.free_result import FreeDiagnosis
from bench.results.diagnosis import free_words, words


def print_free(found: FreeDiagnosis, files: Sequence[tuple[str, Path]], out: Console) -> None:
    """Print what was found in free positions, in the order in which it was, and the files that were written."""
    rows, gap = found.rows, found.gap
    out.print(
        f"{len(rows)} free positions, {rows.sensors} sensor{'s' * (rows.sensors > 1)}, {found.records} "
        f"record{'s' * (found.records > 1)}: |a| = 1 g is all that is known of them"
    )
    for note in found.notes:
        if not quiet.get():
            out.print(f"note: {note}")
    for text in found.apart:
        out.print(f"Mistake: outlier: {text}", style="bold")
    for place in found.where:
        out.print(f"  {place['pattern']}: |a| is off by {quantity(place['size'], 'g')} (rms)")
    for one in found.found:
        out.print(f"Found: {free_words.title(one)}", style="bold")
        out.print(typeset(f"  {one.words}"))
        for line in free_words.parameters(one):
            out.print(f"  {line}")
        out.print(typeset(f"  {words.p_in_words(one.p_all_looks)} with all looks counted, rho {one.rho:.1f}"))
    if gap.opened:
        out.print(
            f"Gap on positions held out: reduced chi-square {gap.before:.2f} before, {gap.after:.2f} after "
            f"(noise alone: 1); |a| is off by {quantity(gap.before_rms, 'g')} before, "
            f"{quantity(gap.after_rms, 'g')} after"
        )
    else:
        out.print("Gap: not measured, as no position can be held out; measure more of them, all round")
    if gap.reason:
        out.print(f"  not confirmed: {gap.reason}")
    for what, file in files:
        out.print(f"{what}: {file}")
    if found.of_rest == "confounded" and "model" not in dict(files):
        out.print(f"no model file is written {free_words.why_no_model(found)}")
    told = free_words.gap(found)
    text = free_words.what(found) + (f"; {told}" if told else "")
    out.print(typeset(f"{free_words.named(found)}: {free_words.lead(found).upper()}: {text}"), style="bold")
