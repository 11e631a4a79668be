"""When an early sign is sure enough to stop a run: one mistake, far beyond chance, in one reading or two in a row.

The rule. A reading is *far beyond chance* where so large a misfit comes by chance in a whole run with a probability
below `STOP_ALARM`. A run is stopped

- at such a reading, where one mistake alone explains it (no other, in it or in a reading before, is within `TIE`
  of its cost, odds of 20 : 1), or several do and no further reading of the mounting will tell them apart;
- at the second of two readings in a row that do not fit, each beyond `FALSE_ALARM` for the run, where mistakes
  explain it: one, or several that these readings cannot tell apart, which are then all named;
- at the reading after one far beyond chance that several mistakes explained, if it fits itself: then the one
  before was wrong alone.

It is never stopped where a cause may also be an effect of the block or the stand (a small shift, a reading
before that was off by nobody knows how much), or where none is known. Once a run has shown a misfit of that sort,
the model lacks something, and what looks like a mistake may be more of it: only a misfit `CLEARLY` larger than all
those stops the run then. The second way comes by chance in `N (FALSE_ALARM / N)**2` of runs of N readings: 4e-7 of
58. So on a good bench fewer than 2e-6 of runs are stopped,
if readings scatter as the bench file says.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from scipy.special import chdtri

from bench.model import Mounting
from bench.run.watch.sighting import Sighting, Suspect
from bench.run.watch.suppositions import LASTING, Kind

STOP_ALARM: Final = 1e-6
"""Probability that a whole run on a good bench has one reading that is far beyond chance."""

CLEARLY: Final = 5.0
"""So many times larger, in volts, is a mistake than what the model lacks."""


class Confidence:
    """Decides of each early sign whether it stops the run, and remembers what a person went on with."""

    def __init__(self, readings: int) -> None:
        self._sure = float(chdtri(3, STOP_ALARM / max(readings, 1)))
        self._last: tuple[Kind, ...] = ()
        self._accepted: set[tuple[Kind, tuple[Mounting, ...] | None]] = set()
        self._silent = False
        self._unexplained_v = 0.0
        self._undecided: tuple[Sighting, list[Suspect]] | None = None

    def mounted(self) -> None:
        """Say that the block was mounted anew: what was accepted of the mounting before is over."""
        self._silent, self._undecided = False, None

    def forget(self) -> None:
        """Say that readings are taken again: nothing about them is undecided any more."""
        self._silent, self._undecided, self._unexplained_v = False, None, 0.0

    def went_on(self, sighting: Sighting) -> None:
        """Say that a person goes on with the mistakes last named: lasting ones are not asked about again."""
        self._silent = True
        for kind in self._last:
            if kind in LASTING:
                mount = sighting.row.mounts if kind in (Kind.INSTALLATION, Kind.ORIENTATION) else None
                self._accepted.add((kind, mount))

    def misfits(
        self, sighting: Sighting, chi2: float, off_v: float, causes: Sequence[Suspect], in_a_row: int
    ) -> bool:
        """Tell whether the run is to be stopped at a reading that does not fit, `in_a_row`-th of such ones.

        `off_v` is by how much its signals are off.
        """
        self._undecided = None
        somehow = [cause for cause in causes if cause.kind is Kind.EARLIER and cause.free]
        named = [cause for cause in causes if cause not in somehow]
        only_before = somehow and all(cause.kind is Kind.EARLIER for cause in named)
        if not named or only_before or not all(cause.stops for cause in named):
            self._unexplained_v = max(self._unexplained_v, off_v)
            return False
        if off_v < CLEARLY * self._unexplained_v or self._is_accepted(sighting, causes):
            return False
        far = chi2 > self._sure
        stops = (far and (len(causes) == 1 or sighting.next_rad is None)) or in_a_row >= 2
        if far and not stops:
            self._undecided = (sighting, list(causes))
        return self._stopped_for(causes) if stops else False

    def earlier(self, chi2: float, off_v: float, causes: Sequence[Suspect]) -> bool:
        """Tell whether the run is to be stopped for an earlier reading, which these causes explain."""
        if not causes or not all(cause.stops for cause in causes):
            self._unexplained_v = max(self._unexplained_v, off_v)
            return False
        if self._silent or chi2 <= self._sure or off_v < CLEARLY * self._unexplained_v:
            return False
        return self._stopped_for(causes)

    def fits(self) -> tuple[Sighting, list[Suspect]] | None:
        """Take note of a reading that fits; return the one before with what explains it, if that was wrong."""
        self._silent = False
        before, self._undecided = self._undecided, None
        if before is None:
            return None
        sighting, causes = before
        causes = [cause for cause in causes if cause.kind not in LASTING] or causes
        self._stopped_for(causes)
        return sighting, causes

    def _is_accepted(self, sighting: Sighting, causes: Sequence[Suspect]) -> bool:
        held = {kind for kind, mount in self._accepted if mount in (None, sighting.row.mounts)}
        return self._silent or any(cause.kind in held for cause in causes)

    def _stopped_for(self, causes: Sequence[Suspect]) -> bool:
        self._last = tuple(cause.kind for cause in causes)
        return True
