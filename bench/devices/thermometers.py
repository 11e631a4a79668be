"""The form of the thermometers at the block: a sensor that an instrument reads, or one that a person does."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from bench.base.forms import FileModel
from bench.base.units import DIFFERENCE, Ratio, reads
from bench.devices.certificates import ChamberCertificate
from bench.devices.chambers import SizeK
from bench.devices.device import DeviceSection, Role


class ThermometerTruth(FileModel):
    """A simulated thermometer at the block: what it is off by, its noise (1 σ), how much of the air it feels."""

    error: Annotated[float, reads(DIFFERENCE)] = 0.0
    noise: SizeK = 0.005
    air_share: Annotated[Ratio, Field(ge=0.0, le=1.0)] = 0.0


class ThermometerForm(DeviceSection):
    """What every thermometer at the block is told; what it shows is the block's temperature of each reading.

    `gradient` is how far the block's accelerometers may be from where it sits, ±0.2 K where it is left out. Without
    a `certificate` it is as exact as its kind.
    """

    role: ClassVar[Role] = "thermometer"

    name: str = "thermometer"
    gradient: SizeK | None = None
    certificate: ChamberCertificate | None = None

    @property
    def tolerance_k(self) -> float:
        """The limit of its error without a certificate, K."""
        raise NotImplementedError
