"""How the block is fed: its rails, the order in which they are switched, its warm-up, what is safe for it."""

from __future__ import annotations

import re
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from bench.base.forms import FileModel
from bench.base.units import DurationS, SizeA, SizeV, SpanS, VoltageV
from drivers.interfaces import OutputSettings

_NAME: Final = re.compile(r"[a-z][a-z0-9]{0,30}")


def _names_a_column(name: str) -> str:
    if _NAME.fullmatch(name) is None:
        raise ValueError(
            f"a rail names columns of the readings: a small letter, then small letters and digits, such as "
            f"'p15', not '{name}'"
        )
    return name


class CurrentWindow(FileModel):
    """What a rail draws in operation, A."""

    minimum: SizeA
    maximum: SizeA


class RailLimits(FileModel):
    """What the block may never be given on a rail: absolute limits of its data sheet."""

    minimum: VoltageV
    maximum: VoltageV
    current: SizeA


class RailSection(FileModel):
    """A rail: the supply's output that feeds it, its voltage with the tolerance it is kept within, its current.

    `limits` are the block's own; `current_limit` and `over_voltage` are what the supply's output is set to before
    it is switched on. A negative rail has negative voltages throughout. What these must be to one another is
    checked with the supply (`bench.files.bench.rail_checks`).
    """

    name: Annotated[str, AfterValidator(_names_a_column)]
    output: str
    voltage: VoltageV
    tolerance: SizeV
    current: CurrentWindow
    limits: RailLimits
    current_limit: SizeA
    over_voltage: VoltageV | None = None

    @property
    def settings(self) -> OutputSettings:
        """What the supply's output is set to."""
        return OutputSettings(self.voltage, self.current_limit, self.over_voltage)

    @property
    def window_v(self) -> tuple[float, float]:
        """Lowest and highest voltage that is as it should be, V."""
        return self.voltage - self.tolerance, self.voltage + self.tolerance


MOST_SAMPLES: Final = 1_000_000
"""Of a warm-up that is waited for."""


class DriftForm(FileModel):
    """Warm once each signal has moved by no more than `drift` for the time `per`; looked at each `interval`.

    What has not come to that within `timeout` is a failure.
    """

    drift: SizeV
    per: DurationS
    timeout: DurationS
    interval: DurationS = 10.0

    @model_validator(mode="after")
    def _can_come_about(self) -> DriftForm:
        if self.drift == 0.0:
            raise ValueError("the drift is more than nothing: no two samples are ever the same")
        if not 0.0 < self.interval <= self.per:
            raise ValueError(
                "the interval is longer than nothing and no longer than the time that the drift is per"
            )
        if self.timeout > MOST_SAMPLES * self.interval:
            raise ValueError(f"an interval so short takes more than {MOST_SAMPLES} samples until the timeout")
        if self.timeout < self.per + self.interval:
            raise ValueError("the timeout is at least the time that the drift is per and one interval")
        return self


def _form_of_warm_up(written: Any) -> str:
    return "warm-up until settled" if isinstance(written, dict | DriftForm) else "time to warm up"


WarmUp = Annotated[
    Annotated[SpanS, Tag("time to warm up")] | Annotated[DriftForm, Tag("warm-up until settled")],
    Discriminator(_form_of_warm_up),
]


class UnitSupplySection(FileModel):
    """The block's supply. Rails are switched on in the order in which they stand, `pause` apart, off in reverse.

    Once off, the block stays off for `least_off`. `warm_up` is a time, or until the signals have settled, from
    switching on. `when_unsafe` says what is safe for the block on every way out of a run: that it stays on, or
    that it is switched off.
    """

    rails: Annotated[tuple[RailSection, ...], Field(min_length=1)]
    pause: SpanS = 0.0
    least_off: SpanS = 0.0
    warm_up: WarmUp
    when_unsafe: Literal["stay-on", "off"]

    @property
    def switching_s(self) -> float:
        """How long it takes to switch all rails on, or off, s."""
        return self.pause * (len(self.rails) - 1)

    @property
    def warm_up_s(self) -> float:
        """The shortest warm-up, s."""
        return self.warm_up if isinstance(self.warm_up, float) else self.warm_up.per + self.warm_up.interval

    @property
    def longest_warm_up_s(self) -> float:
        """The longest warm-up, s."""
        return self.warm_up if isinstance(self.warm_up, float) else self.warm_up.timeout
