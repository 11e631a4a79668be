"""Sections of a bench file on the instruments, the simulation and the check block."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import takewhile
from typing import Annotated, Final, Literal

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
    above_zero,
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
    SizeK,
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
from bench.readings.columns import METER_C, ROOM_C

InstrumentForm = VoltmeterForm | HeadForm | ChamberForm | LevelForm | ThermometerForm | SupplyForm

SURROUNDINGS: Final = {"meter_thermometer": METER_C, "room_thermometer": ROOM_C}
"""The column in the readings for each thermometer away from the block, by its key in the bench file."""


class InstrumentsSection(FileModel):
    """The instruments of a bench; the `driver` of each determines the other keys of its section.

    `thermometer` is at the block. `meter_thermometer` and `room_thermometer` record the temperatures of voltmeters
    and room with each reading. For meters inside the chamber, state the word `chamber` in place of a section: it
    stands for the chamber's air.
    """

    voltmeters: Annotated[
        tuple[Annotated[VoltmeterForm, chosen_by_driver("voltmeter")], ...],
        Field(min_length=1, max_length=len(CHANNELS)),
    ]
    head: Annotated[HeadForm, chosen_by_driver("head")]
    chamber: Annotated[ChamberForm | None, chosen_by_driver("chamber")] = None
    level: Annotated[LevelForm | None, chosen_by_driver("level")] = None
    thermometer: Annotated[ThermometerForm | None, chosen_by_driver("thermometer")] = None
    power_supply: Annotated[SupplyForm | None, chosen_by_driver("power_supply")] = None
    meter_thermometer: Annotated[
        ThermometerForm | Literal["chamber"] | None, chosen_by_driver("thermometer", name="meter_thermometer")
    ] = None
    room_thermometer: Annotated[
        ThermometerForm | Literal["chamber"] | None, chosen_by_driver("thermometer", name="room_thermometer")
    ] = None

    def all(self) -> Iterator[InstrumentForm]:
        """Yield the section of every instrument: voltmeters, head, then the optional instruments."""
        yield from self.voltmeters
        yield self.head
        for further in (self.chamber, self.level, self.thermometer, self.power_supply, *self.around.values()):
            if further is not None:
                yield further

    @property
    def around(self) -> dict[str, ThermometerForm]:
        """The thermometers away from the block, by their keys."""
        stated = {key: getattr(self, key) for key in SURROUNDINGS}
        return {key: section for key, section in stated.items() if isinstance(section, ThermometerForm)}

    @property
    def thermometers(self) -> tuple[ThermometerForm, ...]:
        """All thermometers, beginning with the one at the block."""
        at_block = () if self.thermometer is None else (self.thermometer,)
        return (*at_block, *self.around.values())

    def beside(self, thermometer: ThermometerForm) -> VoltmeterForm | ThermometerForm | None:
        """The first voltmeter or thermometer before `thermometer` with the same resource; None without one."""
        resource = getattr(thermometer, "resource", None)
        listed: tuple[VoltmeterForm | ThermometerForm, ...] = (*self.voltmeters, *self.thermometers)
        before = takewhile(lambda one: one is not thermometer, listed)
        return next((one for one in before if resource and getattr(one, "resource", "") == resource), None)

    @property
    def adapters(self) -> dict[str, str]:
        """The names of the GPIB adapters as instruments ("adapter", "adapter.2", …), by adapter address."""
        places = [section.place for section in self.all() if isinstance(section, WiredForm)]
        known = dict.fromkeys(place.adapter for place in places if place is not None)
        return {
            address: "adapter" if number == 1 else f"adapter.{number}"
            for number, address in enumerate(known, start=1)
        }

    def names(self) -> Iterator[str]:
        """Yield the name of every instrument, then of every GPIB adapter."""
        yield from (section.name for section in self.all())
        yield from self.adapters.values()


DAY_S: Final = 86400.0

Row = Annotated[tuple[ScaleFactor, ...], Field(min_length=3, max_length=3)]


FaultWord = Literal[
    "drop", "refuse", "late", "twice", "cut", "garble", "silence", "hang", "power-cycle", "overload", "local",
    "error",
]  # fmt: skip
"""The faults of a simulated instrument and its wire (`sim.wires.faults.FaultKind`)."""

_TAKE_SECONDS: Final = ("late", "refuse", "hang")


class BlockTruth(FileModel):
    """The true coefficients of the simulated block: K by rows (V/g) and U0 (V)."""

    K: Annotated[tuple[Row, ...], Field(min_length=3, max_length=3)]
    U0: Annotated[tuple[VoltageV, ...], Field(min_length=3, max_length=3)]


class OperatorTruth(FileModel):
    """The simulated operator.

    `setting_deviation` is the standard deviation of the difference between set angle and target. The operator reads
    the scale to `resolution`. A turn takes a time between the two values of `turn_time`. `slip_probability` is the
    probability that a typed angle contains a common mistake (`drivers.angles.SLIPS`).
    """

    setting_deviation: SizeRad = 2 * ARCSEC
    resolution: Annotated[SizeRad, above_zero("state the resolution of the scale, such as '1 arcsec'")] = (
        ARCSEC
    )
    slip_probability: Annotated[Ratio, Field(ge=0.0, lt=1.0)] = 0.01
    turn_time: Annotated[tuple[SpanS, ...], Field(min_length=2, max_length=2)] = (60.0, 180.0)
    mount_time: SpanS = 1200.0

    @field_validator("turn_time")
    @classmethod
    def _in_order(cls, turn_time_s: tuple[float, ...]) -> tuple[float, ...]:
        if turn_time_s[0] > turn_time_s[1]:
            raise ValueError(
                "the shortest time is above the longest; state the shortest first, then the longest"
            )
        return turn_time_s


class FaultSection(FileModel):
    """A fault of the simulated bench, in one `instrument` or, by default, in all that can have it.

    Only commands that contain `matching` count, by default all. The fault strikes each of them with
    `probability`, or only the `at`-th, or all if neither is stated. `seconds` is the delay of a late reply,
    or the time for which connections are refused or the instrument hangs. `error` is the error number of the
    fault "error".
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
            raise ValueError("'probability' and 'at' exclude each other; remove one of the two")
        if self.probability is None and self.at is None and self.matching is None:
            raise ValueError(
                f"nothing says when '{self.fault}' strikes; state 'probability', 'at' or 'matching'"
            )
        if self.seconds and self.fault not in _TAKE_SECONDS:
            raise ValueError(f"'{self.fault}' has no duration; remove 'seconds'")
        if self.fault == "late" and not self.seconds:
            raise ValueError("'late' has no delay; state 'seconds'")
        if self.error is not None and self.fault != "error":
            raise ValueError(f"'{self.fault}' puts no error into the queue; remove 'error'")
        return self


class RoomTruth(FileModel):
    """The simulated room, whose temperature swings by ± `swing` about `ambient_temperature`.

    The swing is a sine of the given `period`. The voltmeters follow it with the time constant `meter_lag`.
    """

    swing: SizeK = 0.0
    period: Annotated[SpanS, above_zero("state a period above 0, such as '24 h'")] = DAY_S
    meter_lag: SpanS = 0.0


class AdapterTruth(FileModel):
    """The simulated GPIB adapter: the version that it answers, and whether it sends a NUL after each reply."""

    version: str = Field("Prologix GPIB-ETHERNET Controller version 01.06.06.00", pattern=r"^[\x20-\x7e]+$")
    nul: bool = False


class SimulationSection(WithEffects):
    """The true state of the simulated bench; without `block`, the block has nominal scale factors only.

    `effects`, `formulas` and `left_open` are written as in a model file. They affect the simulated readings; the
    evaluation of these readings does not use them.
    """

    block: BlockTruth | None = None
    operator: OperatorTruth = OperatorTruth()
    voltmeter: VoltmeterTruth = VoltmeterTruth()
    adapter: AdapterTruth = AdapterTruth()
    head: HeadTruth = HeadTruth()
    chamber: ChamberTruth = ChamberTruth()
    level: LevelTruth = LevelTruth()
    thermometer: ThermometerTruth = ThermometerTruth()
    power_supply: SupplyTruth = SupplyTruth()
    ambient_temperature: TemperatureC = 23.0
    room: RoomTruth = RoomTruth()
    faults: tuple[FaultSection, ...] = ()
    formulas: tuple[FormulaEntry, ...] = ()
    effects: tuple[EffectEntry, ...] = ()
    left_open: tuple[OpenShape, ...] = ()


LEAST_SMOOTHING: Final = 0.03
"""The smallest smoothing constant in the published tables of run lengths."""
LEAST_ARL: Final = 20.0
MOST_ARL: Final = 1e5


class DriftSection(FileModel):
    """The known drift per year of a coefficient of the check block, with its standard uncertainty `u`."""

    per_year: str
    u: str

    def value(self, coefficient: str) -> tuple[float, float]:
        """Return the drift per year and its u, in V/g or V. Raises `ValueError` for a quantity of another kind."""
        kind = VOLTAGE if coefficient.startswith("U0") else SCALE_FACTOR
        return parse_quantity(self.per_year, kind), parse_quantity(self.u, kind)


class BaselineDaysSection(FileModel):
    """The first and the last day (both included) of the check block's baseline runs."""

    first: Day
    last: Day


class CheckBlockSection(FileModel):
    """The check block, which is measured before a day's work, and the rules of its control chart.

    The block is identified by its serial number and `type` (default: the type in `unit_under_test`). The baseline
    is its first `baseline` accepted runs on this bench. `baseline_days` or `reference` replaces these runs.
    `reference` names other runs, or one result of `bench calibrate --json` from elsewhere (a path relative to this
    file).

    The chart gives one false alarm in `arl` runs on average (default 370). With `k` instead, it gives as many false
    alarms as a Shewhart chart with limits of k standard deviations. `smoothing` is the λ of its EWMA, which starts
    again on the day `restarted`. `limits` selects the basis of the control limits: the "stated" u of a run, the
    stated u "scaled" by a factor from the baseline, or the "scatter" of the baseline. `between_runs` names the
    sources of u that vary from run to run. With `rule: refuse`, a run starts only if the last check was in control
    and is no older than `max_age`; with `warn`, the run only warns.
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
                raise ValueError(f"{name} is not a coefficient; choose from {', '.join(COEFFICIENTS)}")
            if section.value(name)[1] < 0.0:
                raise ValueError(f"{name}: the standard uncertainty is negative; state 0 or more")
        return drift

    @model_validator(mode="after")
    def _one_of_each(self) -> CheckBlockSection:
        if self.arl is not None and self.k is not None:
            raise ValueError("'arl' and 'k' state the same limit; remove one")
        if self.baseline_days is not None and self.reference:
            raise ValueError("'baseline_days' and 'reference' both state the block's values; remove one")
        return self

    def is_of(self, unit_type: str, serial: str, type_of_bench: str) -> bool:
        """Whether a unit is the check block; `type_of_bench` is the type in `unit_under_test`."""
        return (unit_type, serial) == (self.type or type_of_bench, self.serial)
