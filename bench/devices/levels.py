"""The form of the levels of a bench file: a bubble that a person reads, or an electronic one."""

from __future__ import annotations

from typing import ClassVar

from bench.base.arrays import ARCSEC
from bench.base.forms import FileModel
from bench.base.units import AngleRad, Ratio, SizeRad
from bench.devices.device import DeviceSection, Role


class LevelTruth(FileModel):
    """A simulated level: how far its zero is off along the shaft and across, its noise (1 σ), its scale's error."""

    zero_along: AngleRad = 20.0 * ARCSEC
    zero_across: AngleRad = -12.0 * ARCSEC
    noise: SizeRad = 1.0 * ARCSEC
    scale: Ratio = 0.0


class LevelForm(DeviceSection):
    """What every level is told: its name. Its zero need not be known: it is read in two positions."""

    role: ClassVar[Role] = "level"
    certificate: ClassVar[None] = None
    """Of a level none is counted: what matters of its scale at a few arcseconds is less than it reads to."""

    name: str = "level"
