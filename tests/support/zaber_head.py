"""A Zaber head as a bench file would state it."""

from __future__ import annotations

import math

from drivers.instruments.zaber import ZaberHead
from drivers.motion import Travel
from tests.support.scripted_session import Clock

DEG = math.pi / 180
ARCSEC = DEG / 3600
STEPS = 12800 / 3
"""Microsteps per degree of a stage with 0.9 arcsec steps."""
TRAVEL = Travel(
    minimum_rad=-10 * DEG,
    maximum_rad=370 * DEG,
    tolerance_rad=10 * ARCSEC,
    speed_rad_s=10 * DEG,
    settle_s=0.5,
)


def head(session: object, clock: object | None = None, **options: object) -> ZaberHead:
    options = {"steps_per_degree": STEPS} | options
    return ZaberHead("head", session, clock or Clock(), TRAVEL, **options)  # type: ignore[arg-type]
