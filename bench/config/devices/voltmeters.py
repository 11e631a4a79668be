"""The form of the voltmeters of a bench file: what each may be told, and what its kind can do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from bench.base.units import DurationS, VoltageV
from bench.base.yaml_files import FileModel
from bench.config.devices.certificates import VoltmeterCertificate, of_known_ranges
from bench.config.devices.device import Role, WiredForm, any_resource, usual_baud_rate
from drivers.interfaces import Channel, VoltmeterLimits

VOLTMETER_FACTS: Final = (
    "RANGES_V", "OVER_RANGE", "NPLC", "MEMORY_READINGS", "LEAST_SAMPLES", "ACCURACY_90_DAYS", "LINEARITY",
)  # fmt: skip
"""What the facts of a voltmeter must say (see those of a 34401A); with a serial port `BAUD_RATES`, too."""

DAYS_90: Final = 90.0 / 365.25
"""The time of the shorter limits of error, years."""


@dataclass(frozen=True)
class VoltmeterKind:
    """What voltmeters of a driver can do: limits for one channel, and what no driver need know.

    `over_range` is the part of a range up to which it reads. `accuracy` gives for each range the limits of error
    of DC volts within 90 days at 23 ± 5 °C, parts of the reading and of the range; `linearity` the limits of its
    converter's integral nonlinearity alike; `accuracy_of_year` what `accuracy` is within a year, of the ranges for
    which that is known; `resolution`, where it is known, from an integration (NPLC) on the
    part of the range to which it resolves.
    """

    limits: VoltmeterLimits
    over_range: float
    accuracy: Mapping[float, tuple[float, float]]
    linearity: tuple[float, float]
    resolution: Mapping[float, float] = field(default_factory=dict)
    accuracy_of_year: Mapping[float, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, facts: ModuleType) -> VoltmeterKind:
        """Return the kind that the facts of a voltmeter describe."""
        return cls(
            VoltmeterLimits.of(facts),
            facts.OVER_RANGE,
            facts.ACCURACY_90_DAYS,
            facts.LINEARITY,
            getattr(facts, "RESOLUTION", {}),
            getattr(facts, "ACCURACY_1_YEAR", {}),
        )

    def limits_after(self, years: float, range_v: float) -> tuple[float, float]:
        """Return the limits of error on a range some time after its calibration, parts of reading and of range.

        Those of 90 days, then those of a year; where none are known, and after a year, they grow with the time.
        """
        of_90_days = self.accuracy[range_v]
        if years <= DAYS_90:
            return of_90_days
        known = self.accuracy_of_year.get(range_v)
        limits, since = (of_90_days, DAYS_90) if known is None else (known, 1.0)
        times = max(1.0, years / since)
        return limits[0] * times, limits[1] * times


CERTIFICATE: Final = "certificate"
"""The word for simulated voltmeters that have the errors of their certificates."""


class VoltmeterTruth(FileModel):
    """The simulated voltmeters: with noise or not; without errors, with some within the maker's limits of 90 days,
    or with those that their certificates state."""

    noise: bool = True
    accuracy: Literal["90 days", "certificate"] | None = None


class SerialSection(FileModel):
    """How a meter's serial port is set on its front panel; with a parity it has 7 data bits, without one 8."""

    baud_rate: int = 9600
    parity: Literal["none", "even", "odd"] = "none"

    @property
    def data_bits(self) -> Literal[7, 8]:
        """Data bits of a character."""
        return 8 if self.parity == "none" else 7

    def settings(self) -> dict[str, Any]:
        """Return what it says of the port."""
        return {"baud_rate": self.baud_rate, "parity": self.parity, "data_bits": self.data_bits}


class VoltmeterForm(WiredForm):
    """What every voltmeter is told. The range is fixed: a meter that changes it also changes its errors.

    `interface` says how the meter is set, apart from the wire that carries its messages.
    """

    role: ClassVar[Role] = "voltmeter"

    stated_name: str | None = Field(None, alias="name")
    resource: Annotated[str, AfterValidator(any_resource)]
    timeout: DurationS = 5.0
    range: VoltageV = 10.0
    interface: Literal["lan", "gpib", "rs232"] = "lan"
    certificate: VoltmeterCertificate | None = None

    if TYPE_CHECKING:

        @property
        def channels(self) -> tuple[Channel, ...]:
            """The signals in the order in which it reads them."""

    @property
    def name(self) -> str:
        """Name of the instrument: as stated, else "voltmeter.x"."""
        return self.stated_name or f"voltmeter.{''.join(self.channels)}"

    @property
    def kind(self) -> VoltmeterKind:
        """What it can do."""
        return VoltmeterKind.of(self.facts)

    @property
    def inputs_used(self) -> Channel | dict[Channel, int]:
        """The signal at its input; of one with several, the number of the input of each."""
        raise NotImplementedError

    @field_validator("range")
    @classmethod
    def _of_the_meter(cls, range_v: float, info: ValidationInfo) -> float:
        known = cls.facts.RANGES_V
        if range_v not in known:
            listed = ", ".join(f"{r:g} V" for r in known)
            raise ValueError(f"the {info.data.get('driver')} has the ranges {listed}, not {range_v:g} V")
        return range_v

    @field_validator("certificate")
    @classmethod
    def _of_its_ranges(cls, certificate: VoltmeterCertificate | None) -> VoltmeterCertificate | None:
        if certificate is not None:
            of_known_ranges(certificate, cls.facts.RANGES_V)
        return certificate

    def simulation_options(self, truth: VoltmeterTruth) -> dict[str, Any]:
        """Return what every simulated voltmeter is given."""
        accuracy: str | dict[float, tuple[float, float]] | None = truth.accuracy
        if truth.accuracy == CERTIFICATE:
            accuracy = {} if self.certificate is None else self.certificate.errors()
        return {"interface": self.interface, "noise": truth.noise, "accuracy": accuracy}


class OneChannelForm(VoltmeterForm):
    """A voltmeter with one signal."""

    channels: Annotated[tuple[Channel, ...], Field(min_length=1, max_length=1)]

    @property
    def inputs_used(self) -> Channel:
        """The signal at its input."""
        return self.channels[0]


class SerialPortForm(VoltmeterForm):
    """A voltmeter that may have a serial port."""

    serial: SerialSection = SerialSection()

    @field_validator("serial")
    @classmethod
    def _speed_of_the_meter(cls, serial: SerialSection) -> SerialSection:
        usual_baud_rate(serial.baud_rate, cls.facts.BAUD_RATES)
        return serial


def written_channels(voltmeter: Any) -> tuple[str, list[Any]] | None:
    """Return the key under which a voltmeter as written says its signals, and these; None where it does not."""
    if not isinstance(voltmeter, dict):
        return None
    for key in ("channels", "inputs"):
        signals = voltmeter.get(key)
        if isinstance(signals, list | dict):
            return key, list(signals)
    return None
