"""A diagnosis of free positions as text in the terminal."""

from __future__ import annotations

from rich.console import Console

from bench.analysis.diagnosis.free_positions import FreeDiagnosis
from bench.base.numbers import quantity, typeset
from bench.base.progress import quiet
from bench.report.diagnosis import words


def print_free(found: FreeDiagnosis, out: Console) -> None:
    """Print what was found in free positions, in the order in which it was."""
    rows = found.rows
    records = len(set(rows.record.tolist()))
    out.print(
        f"{len(rows)} free positions, {rows.sensors} sensor{'s' * (rows.sensors > 1)}, {records} "
        f"record{'s' * (records > 1)}: |a| = 1 g is all that is known of them"
    )
    for note in found.notes:
        if not quiet.get():
            out.print(f"note: {note}")
    for text in found.apart:
        out.print(f"Mistake: outlier: {text}", style="bold")
    for place in found.where:
        out.print(f"  {place['pattern']}: |a| is off by {quantity(place['size'], 'g')} (rms)")
    for one in found.found:
        ties = f", or {', '.join(one.cannot_tell_from)}" if one.cannot_tell_from else ""
        of = f" of {', '.join(one.channels)}" if one.channels else ""
        out.print(f"Found: {one.name}{of}{ties}", style="bold")
        out.print(typeset(f"  {one.words}"))
        out.print(typeset(f"  {words.p_in_words(one.p_all_looks)} with all looks counted, rho {one.rho:.1f}"))
    gap = found.gap
    out.print(
        f"Gap on positions held out: reduced chi-square {gap['before']:.2f} before, {gap['after']:.2f} after "
        f"(noise alone: 1); |a| is off by {quantity(gap['before_rms'], 'g')} before, "
        f"{quantity(gap['after_rms'], 'g')} after"
    )
    lead = words.LEAD[found.verdict].upper()
    told = "; ".join(
        [*(["positions stand apart"] if found.apart else []), *(one.words for one in found.found)]
    )
    nothing = "the positions agree with nine coefficients of each sensor within their scatter"
    out.print(typeset(f"{found.source}: {lead}: {told or nothing}"), style="bold")
