"""The section of a bench file on the check block: the block, what it is judged by, what follows for a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal

from pydantic import Field, field_validator, model_validator

from bench.base.forms import FileModel
from bench.base.units import SCALE_FACTOR, VOLTAGE, SpanS, parse_quantity
from bench.devices.certificates import Day
from bench.model.block import COEFFICIENTS

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
