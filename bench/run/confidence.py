"""The decision whether a misfit of a reading stops the run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from scipy.special import chdtri

from bench.model.conditions import Mounting
from bench.run.causes import LASTING, Kind, Suspect
from bench.run.expectation import Sighting

STOP_ALARM: Final = 1e-6
"""Probability that a run on a good bench is stopped because of a misfit by chance alone."""

CLEARLY: Final = 5.0
"""A mistake stops the run only if the misfit, V, is at least this multiple of the largest unexplained one."""
BEYOND_EFFECTS_G: Final = 0.1
"""Largest misfit that an effect of the block may cause; larger unexplained ones do not count for `CLEARLY`."""
BEYOND_EFFECTS_PER_KELVIN_G: Final = 5e-3
"""Largest further misfit per kelvin by which the block's temperature has varied in the run: 3 mg/K of each axis."""
LOST: Final = 3
"""Number of consecutive misfits after which one beyond any effect stops the run, even if no mistake explains it."""


class Confidence:
    """Decides whether a misfit stops the run, and remembers the mistakes that a person has accepted.

    The run has `readings` readings; `scale` (V/g) is the largest nominal scale factor of the block.
    """

    def __init__(self, readings: int, scale: float) -> None:
        self._beyond_effects_v = BEYOND_EFFECTS_G * scale
        self._sure = float(chdtri(3, STOP_ALARM / max(readings, 1)))
        self._per_kelvin_v = BEYOND_EFFECTS_PER_KELVIN_G * scale
        self._last: tuple[Kind, ...] = ()
        self._last_lost: str | None = None
        self._borne: set[str] = set()
        self._accepted: set[tuple[Kind, tuple[Mounting, ...] | None]] = set()
        self._silent = False
        self._unexplained_v = 0.0
        self._undecided: tuple[Sighting, list[Suspect]] | None = None

    def mounted(self) -> None:
        """Allow stops again, because the block was mounted again; forget a misfit with several causes."""
        self._silent, self._undecided = False, None
        self._borne.clear()

    def forget(self) -> None:
        """Allow stops again and forget earlier misfits, because readings are repeated."""
        self._silent, self._undecided, self._unexplained_v = False, None, 0.0
        self._borne.clear()

    def went_on(self, sighting: Sighting) -> None:
        """Accept the cause of the stop; stop no more until a reading fits, is redone or follows a remount.

        Lasting mistakes stay accepted. An unexplained stop is not repeated until a reading is redone or follows a
        remount.
        """
        self._silent = True
        if self._last_lost is not None:
            self._borne.add(self._last_lost)
        for kind in self._last:
            if kind in LASTING:
                mount = sighting.row.mounts if kind in (Kind.INSTALLATION, Kind.ORIENTATION) else None
                self._accepted.add((kind, mount))

    def misfits(
        self,
        sighting: Sighting,
        chi2: float,
        off_v: float,
        causes: Sequence[Suspect],
        in_a_row: int,
        *,
        still: str = "",
        span_k: float = 0.0,
    ) -> bool:
        """Return whether to stop the run at a reading that does not fit and is explained by `causes`.

        `chi2` is that of the residuals, `off_v` their Euclidean norm, V. `in_a_row` is the number of consecutive
        readings that did not fit. Without an explanation, `LOST` of them stop the run if the last is beyond any
        effect; a single one does if `still` names channels whose signals stay the same. `span_k` is the range of
        the block's temperature so far, K.
        """
        self._undecided = None
        somehow = [cause for cause in causes if cause.kind is Kind.EARLIER and cause.free]
        named = [cause for cause in causes if cause not in somehow]
        only_before = somehow and all(cause.kind is Kind.EARLIER for cause in named)
        if not named or only_before or not all(cause.stops for cause in named):
            self._not_explained(off_v)
            borne = still in self._borne if still else bool(self._borne)
            if causes or self._silent or borne or (in_a_row < LOST and not still):
                return False
            lost = off_v > self._beyond_effects_v + self._per_kelvin_v * span_k
            return lost and self._stopped_for(causes, still)
        if off_v < CLEARLY * self._unexplained_v or self._is_accepted(sighting, causes):
            return False
        significant = chi2 > self._sure
        stops = (significant and (len(causes) == 1 or sighting.next_rad is None)) or in_a_row >= 2
        if significant and not stops:
            self._undecided = (sighting, list(causes))
        return self._stopped_for(causes) if stops else False

    def earlier(self, chi2: float, off_v: float, causes: Sequence[Suspect]) -> bool:
        """Return whether to stop the run because `causes` show a mistake in an earlier reading.

        `chi2` is that of the present reading's residuals, `off_v` their Euclidean norm, V.
        """
        if not causes or not all(cause.stops for cause in causes):
            self._not_explained(off_v)
            return False
        if self._silent or chi2 <= self._sure or off_v < CLEARLY * self._unexplained_v:
            return False
        return self._stopped_for(causes)

    def fits(self) -> tuple[Sighting, list[Suspect]] | None:
        """Note a reading that fits; return the undecided reading that it proves wrong, with causes, or None.

        An undecided reading did not fit, but did not stop the run, because several mistakes explained it.
        """
        self._silent = False
        before, self._undecided = self._undecided, None
        if before is None:
            return None
        sighting, causes = before
        causes = [cause for cause in causes if cause.kind not in LASTING] or causes
        self._stopped_for(causes)
        return sighting, causes

    def _not_explained(self, off_v: float) -> None:
        if off_v < self._beyond_effects_v:
            self._unexplained_v = max(self._unexplained_v, off_v)

    def _is_accepted(self, sighting: Sighting, causes: Sequence[Suspect]) -> bool:
        held = {kind for kind, mount in self._accepted if mount in (None, sighting.row.mounts)}
        return self._silent or any(cause.kind in held for cause in causes)

    def _stopped_for(self, causes: Sequence[Suspect], lost: str | None = None) -> bool:
        self._last, self._last_lost = tuple(cause.kind for cause in causes), lost
        return True
