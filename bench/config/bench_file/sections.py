"""Sections of a bench file on instruments, their simulation, and the check block."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator, model_validator

from bench.base.arrays import ARCSEC, CHANNELS
from bench.base.units import (
    SCALE_FACTOR,
    VOLTAGE,
    Ratio,
    ScaleFactor,
    SizeRad,
    SpanS,
    TemperatureC,
    VoltageV,
    parse_quantity,
)
from bench.base.yaml_files import FileModel
from bench.config.devices.device import Day, WiredForm
from bench.config.devices.registry import chosen_by_driver
from bench.config.devices.sections import (
    ChamberForm,
    ChamberTruth,
    HeadForm,
    HeadTruth,
    LevelForm,
    LevelTruth,
    SupplyForm,
    SupplyTruth,
    ThermometerForm,
    ThermometerTruth,
    VoltmeterForm,
    VoltmeterTruth,
)
from bench.config.formulas import FormulaEntry
from bench.config.model_file import EffectEntry, OpenShape, WithEffects
from bench.model.geometry import COEFFICIENTS

InstrumentForm = VoltmeterForm | HeadForm | ChamberForm | LevelForm | ThermometerForm | SupplyForm


class InstrumentsSection(FileModel):
    """Everything that is opened for a run; the driver chooses what else a section says."""

    voltmeters: Annotated[
        tuple[Annotated[VoltmeterForm, chosen_by_driver("voltmeter")], ...],
        Field(min_length=1, max_length=len(CHANNELS)),
    ]
    head: Annotated[HeadForm, chosen_by_driver("head")]
    chamber: Annotated[ChamberForm | None, chosen_by_driver("chamber")] = None
    level: Annotated[LevelForm | None, chosen_by_driver("level")] = None
    thermometer: Annotated[ThermometerForm | None, chosen_by_driver("thermometer")] = None
    power_supply: Annotated[SupplyForm | None, chosen_by_driver("power_supply")] = None

    def all(self) -> Iterator[InstrumentForm]:
        """Yield the section of every instrument: voltmeters, head, and what else there is."""
        yield from self.voltmeters
        yield self.head
        for further in (self.chamber, self.level, self.thermometer, self.power_supply):
            if further is not None:
                yield further

    @property
    def meter_of_thermometer(self) -> VoltmeterForm | None:
        """The voltmeter of which the thermometer is one channel more; None where it has its own wire, or none."""
        resource = getattr(self.thermometer, "resource", None)
        return next((meter for meter in self.voltmeters if resource and meter.resource == resource), None)

    @property
    def adapters(self) -> dict[str, str]:
        """The GPIB adapters, by the address of each its name on the bench: "adapter", "adapter.2" …."""
        places = [section.place for section in self.all() if isinstance(section, WiredForm)]
        known = dict.fromkeys(place.adapter for place in places if place is not None)
        return {
            address: "adapter" if number == 1 else f"adapter.{number}"
            for number, address in enumerate(known, start=1)
        }

    def names(self) -> Iterator[str]:
        """Yield the name of every instrument, then of every adapter."""
        yield from (section.name for section in self.all())
        yield from self.adapters.values()


class RecordedInstruments(InstrumentsSection):
    """The instruments of a run that is evaluated: of those that nobody here knows what is written is kept."""

    voltmeters: Annotated[
        tuple[Annotated[VoltmeterForm, chosen_by_driver("voltmeter", recorded=True)], ...],
        Field(min_length=1, max_length=len(CHANNELS)),
    ]
    head: Annotated[HeadForm, chosen_by_driver("head", recorded=True)]
    chamber: Annotated[ChamberForm | None, chosen_by_driver("chamber", recorded=True)] = None
    level: Annotated[LevelForm | None, chosen_by_driver("level", recorded=True)] = None
    thermometer: Annotated[ThermometerForm | None, chosen_by_driver("thermometer", recorded=True)] = None
    power_supply: Annotated[SupplyForm | None, chosen_by_driver("power_supply", recorded=True)] = None


Row = Annotated[tuple[ScaleFactor, ...], Field(min_length=3, max_length=3)]


FaultWord = Literal[
    "drop", "refuse", "late", "twice", "cut", "garble", "silence", "hang", "power-cycle", "overload", "local",
    "error",
]  # fmt: skip
"""What can go wrong with a simulated instrument and its wire (`sim.wires.faults.FaultKind`)."""

_TAKE_SECONDS: Final = ("late", "refuse", "hang")


class BlockTruth(FileModel):
    """The simulated block as it is: K row by row (V/g) and U0 (V)."""

    K: Annotated[tuple[Row, ...], Field(min_length=3, max_length=3)]
    U0: Annotated[tuple[VoltageV, ...], Field(min_length=3, max_length=3)]


class OperatorTruth(FileModel):
    """The simulated operator.

    `setting_deviation` is the standard deviation of the angle left on the scale from its target, read to
    `resolution`; a turn takes between the two times of `turn_time`; `slip_probability` is how often the
    angle that is typed has a classic slip.
    """

    setting_deviation: SizeRad = 2 * ARCSEC
    resolution: SizeRad = ARCSEC
    slip_probability: Annotated[Ratio, Field(ge=0.0, lt=1.0)] = 0.01
    turn_time: Annotated[tuple[SpanS, ...], Field(min_length=2, max_length=2)] = (60.0, 180.0)
    mount_time: SpanS = 1200.0

    @field_validator("resolution")
    @classmethod
    def _has_steps(cls, resolution_rad: float) -> float:
        if resolution_rad == 0.0:
            raise ValueError("a scale has steps: expected a resolution such as '1 arcsec'")
        return resolution_rad

    @field_validator("turn_time")
    @classmethod
    def _in_order(cls, turn_time_s: tuple[float, ...]) -> tuple[float, ...]:
        if turn_time_s[0] > turn_time_s[1]:
            raise ValueError("the first is the shortest time, the second the longest")
        return turn_time_s


class FaultSection(FileModel):
    """What goes wrong, when, with which instrument (all that can have it, where it is left out).

    Of the commands that contain `matching`, each is struck with `probability`, or the `at`-th alone, or every
    one. `seconds` is how late a reply comes, how long connections are refused or the instrument hangs.
    """

    fault: FaultWord
    instrument: str | None = None
    probability: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    at: Annotated[int, Field(ge=1)] | None = None
    matching: str | None = None
    seconds: Annotated[float, Field(ge=0.0)] | None = None
    error: int | None = None

    @model_validator(mode="after")
    def _makes_sense(self) -> FaultSection:
        if self.probability is not None and self.at is not None:
            raise ValueError("a fault strikes with a probability or at an exchange, not both")
        if self.probability is None and self.at is None and self.matching is None:
            raise ValueError(f"say when '{self.fault}' strikes: give probability, at or matching")
        if self.seconds and self.fault not in _TAKE_SECONDS:
            raise ValueError(f"'{self.fault}' has no duration; leave out seconds")
        if self.fault == "late" and not self.seconds:
            raise ValueError("'late' needs seconds: by how much")
        if self.error is not None and self.fault != "error":
            raise ValueError(f"'{self.fault}' puts no error into the queue; leave out error")
        return self

    def to_plain(self) -> dict[str, Any]:
        """Return it as written, without what was left out."""
        return self.model_dump(exclude_none=True)


class SimulationSection(WithEffects):
    """What the simulated bench is like; without a block it has the nominal scale factors alone.

    `effects`, with `formulas` and `left_open`, are those of a model file: the simulated bench has them, and nothing
    that evaluates its readings knows of them.
    """

    block: BlockTruth | None = None
    operator: OperatorTruth = OperatorTruth()
    voltmeter: VoltmeterTruth = VoltmeterTruth()
    head: HeadTruth = HeadTruth()
    chamber: ChamberTruth = ChamberTruth()
    level: LevelTruth = LevelTruth()
    thermometer: ThermometerTruth = ThermometerTruth()
    power_supply: SupplyTruth = SupplyTruth()
    ambient_temperature: TemperatureC = 23.0
    faults: tuple[FaultSection, ...] = ()
    formulas: tuple[FormulaEntry, ...] = ()
    effects: tuple[EffectEntry, ...] = ()
    left_open: tuple[OpenShape, ...] = ()


DAY_S: Final = 86400.0
LEAST_SMOOTHING: Final = 0.03
"""Below it the published tables of run lengths end."""
LEAST_ARL: Final = 20.0
MOST_ARL: Final = 1e5


class DriftSection(FileModel):
    """How a coefficient of the check block is known to drift in a year, with its standard uncertainty u."""

    per_year: str
    u: str

    def value(self, coefficient: str) -> tuple[float, float]:
        """Return both, V/g or V. Raises `ValueError` for text that is no quantity of its kind."""
        kind = VOLTAGE if coefficient.startswith("U0") else SCALE_FACTOR
        return parse_quantity(self.per_year, kind), parse_quantity(self.u, kind)


class BaselineDaysSection(FileModel):
    """The days, both included, whose runs of the check block are the baseline."""

    first: Day
    last: Day


class CheckBlockSection(FileModel):
    """A block of known history that is measured before a day's work, and what its control chart does to runs.

    It is known by its serial number and `type` (that of `unit_under_test`, if left out). Its first `baseline`
    runs on this bench that are in control say what the block is; in their place those of `baseline_days`, or
    what `reference` names: runs, or one result of `bench calibrate --json` from elsewhere (its path from
    here). The chart gives a false alarm once in `arl` runs (370), or with `k` as often as one Shewhart chart
    with limits of k standard deviations. `smoothing` is the λ of its EWMA, which begins anew on the day
    `restarted`. Limits are from u as `stated`, from that `scaled` as the baseline shows, or from the `scatter`
    of the baseline alone. `between_runs` names sources of u that come anew with each measurement of the check
    block. With `rule: refuse` no run begins unless the last check is in control and not older than `max_age`;
    with `warn` it is told.
    """

    serial: str
    type: str | None = None
    baseline: Annotated[int, Field(ge=1)] = 10
    baseline_days: BaselineDaysSection | None = None
    reference: tuple[str, ...] = ()
    rule: Literal["refuse", "warn"] = "warn"
    max_age: SpanS = DAY_S
    arl: Annotated[float, Field(ge=LEAST_ARL, le=MOST_ARL)] | None = None
    k: Annotated[float, Field(ge=2.0, le=4.4)] | None = None
    smoothing: Annotated[float, Field(ge=LEAST_SMOOTHING, le=1.0)] = 0.2
    limits: Literal["stated", "scaled", "scatter"] = "scaled"
    between_runs: tuple[
        Literal["foundation", "mounting_roll", "supply_voltage", "temperature", "turn_on",
        "voltmeter_linearity"], ...
    ] = ()  # fmt: skip
    drift: Annotated[dict[str, DriftSection], Field(default_factory=dict)]
    restarted: Day | None = None

    @field_validator("drift")
    @classmethod
    def _of_coefficients(cls, drift: Mapping[str, DriftSection]) -> Mapping[str, DriftSection]:
        for name, section in drift.items():
            if name not in COEFFICIENTS:
                raise ValueError(f"{name} is no coefficient; they are {', '.join(COEFFICIENTS)}")
            if section.value(name)[1] < 0.0:
                raise ValueError(f"{name}: a standard uncertainty is not negative")
        return drift

    @model_validator(mode="after")
    def _one_of_each(self) -> CheckBlockSection:
        if self.arl is not None and self.k is not None:
            raise ValueError("arl and k say the same thing; state one of them")
        if self.baseline_days is not None and self.reference:
            raise ValueError("baseline_days and reference both say what the block is; state one of them")
        return self

    def is_of(self, unit_type: str, serial: str, type_of_bench: str) -> bool:
        """Whether a unit is the check block; `type_of_bench` is what `unit_under_test` states."""
        return (unit_type, serial) == (self.type or type_of_bench, self.serial)
