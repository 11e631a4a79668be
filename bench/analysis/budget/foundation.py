"""The foundation under the stand: the platform that was levelled tilts on while the block is mounted on it.

The paper's moves 1 to 2 arcseconds a day. Where the level was read again, what it showed is its rate; a bench file
may state one; else, for a platform that was levelled, the paper's is taken. How the platform stood is in the angles
of the mounting already; here is that it did not stand still.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bench.analysis.budget.error_source import ErrorSource
from bench.base.arrays import ARCSEC, Floats
from bench.files.bench.file import BenchFile
from bench.model import Block, Conditions, Installation
from bench.readings.level_columns import drift_rad_s
from bench.readings.levelled import DAY, FOUNDATION
from bench.readings.table import Readings

NAME = "foundation"


@dataclass(frozen=True)
class Foundation:
    """How fast the platform tilts, along the shaft and across it: standard uncertainties, rad/s."""

    along_rad_s: float
    across_rad_s: float
    origin: str
    prior: bool = False
    dof: float = np.inf

    @property
    def shown(self) -> str:
        """Its sizes in words."""
        along, across = (rate * DAY / ARCSEC for rate in (self.along_rad_s, self.across_rad_s))
        return (
            f"{along:.2g} and {across:.2g} arcsec a day" if along != across else f"{along:.2g} arcsec a day"
        )

    def source(self) -> ErrorSource:
        """Return it as one of the errors of a bench, of the larger of both sizes."""
        size = replace(FOUNDATION, limit=max(self.along_rad_s, self.across_rad_s), shape="normal", k=1.0)
        return ErrorSource(NAME, "α1, α2", "rad/s", size, "run", "stand", self.origin, self.dof, self.prior)

    def parts(
        self, conditions: Conditions, block: Block, across: Floats, installations: Mapping[str, Installation],
        functionals: Floats,
    ) -> Floats:  # fmt: skip
        """Return what each of both tilts, one u large, adds to linear functionals (m, n, 3), shape (m, 2).

        `across` (n, 3) is how the signals change with an angle about the shaft.
        """
        tilts = np.stack(tilt_patterns(conditions, block, across, installations))
        return np.asarray(
            np.einsum("mni,qni->mq", functionals, tilts) * [self.along_rad_s, self.across_rad_s]
        )


def tilt_patterns(
    conditions: Conditions, block: Block, across: Floats, installations: Mapping[str, Installation]
) -> tuple[Floats, Floats]:
    """Return what a platform that tilts along the shaft and across it, 1 rad/s, does to the signals, V (n, 3)."""
    time_s = np.nan_to_num(conditions.elapsed_s)
    begun = np.array([time_s[conditions.mount == m].min() for m in range(len(conditions.mounts))])
    gone_s = (time_s - begun[conditions.mount])[:, None]
    known = [installations.get(mount.installation) for mount in conditions.mounts]
    # tilted by α1 the specific force has so much along y of the platform
    on_block = np.stack([np.zeros(3) if i is None else i.block_from_platform[:, 1] for i in known])
    return (on_block @ block.K.T)[conditions.mount] * gone_s, across * gone_s


def foundation_of(readings: Readings | None, bench: BenchFile, *, levelled: bool) -> Foundation | None:
    """Return how the foundation of a bench moves; None where nobody says so and nothing was `levelled`.

    What the level showed with these `readings` counts before what the bench file states.
    """
    seen = None if readings is None else drift_rad_s(readings.extra)
    if seen is not None:
        return Foundation(*seen, "the level, read again after the platform was levelled")
    stated = bench.stand.foundation
    if stated is not None:
        rate = stated.to_distribution().u / DAY
        return Foundation(rate, rate, "bench file", dof=stated.dof)
    if not levelled:
        return None
    return Foundation(FOUNDATION.u, FOUNDATION.u, "not stated: ±2 arcsec a day, the paper's", prior=True)
