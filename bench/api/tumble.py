"""The view of a tumble by IEEE Std 1293, of a run or of readings, with the whole uncertainty of its bench."""

from __future__ import annotations

from collections.abc import Sequence

from bench.analysis.budget.sources import assumed_stand
from bench.analysis.tumble.terms import DEFAULT
from bench.analysis.tumble.view import TumbleView, tumble_view
from bench.analysis.tumble.whole import combine
from bench.api.source import Source


def tumble_of(source: Source, terms: Sequence[str] = DEFAULT) -> TumbleView:
    """Return each axis of a source in the terms asked for. Raises `CalibrationError` where that cannot be."""
    assumed = {name: size.u for name, size in assumed_stand(source.bench).items()}
    view = tumble_view(source.readings, source.model, source.stand_u, source.g_m_s2, terms, assumed_u=assumed)
    return combine(view, source.bench, source.model, terms, source.traced.day)
