"""How far the errors of the same meters may differ between two days."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Final

METERS_DRIFT: Final = timedelta(days=90)
"""In so long a meter may drift through its limits: those of data sheets are of 90 days."""
ONE_SITTING: Final = timedelta(days=1)
"""Within so long a meter stays as it is: data sheets state 24 hours' limits apart, and they are of this kind."""


def drifted(
    first: tuple[Sequence[str], datetime | None], later: tuple[Sequence[str], datetime | None]
) -> float:
    """Return the part of the meters' limits by which their errors may differ, from 0 (they cancel) to 1.

    Each side is the identities of its meters and the time; other meters, unnamed ones and times that nobody told
    cancel nothing.
    """
    (meters, when), (other, then) = first, later
    if not meters or tuple(meters) != tuple(other) or when is None or then is None:
        return 1.0
    apart = abs(then - when)
    return 0.0 if apart <= ONE_SITTING else min(apart / METERS_DRIFT, 1.0)
