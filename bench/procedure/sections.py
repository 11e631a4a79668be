"""What a procedure says apart from its steps: how a reading is taken, when something has settled, failures."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from bench.base.forms import FileModel
from bench.base.units import DurationS, QuantityKind, SpanS, VoltageV, parse_quantity
from bench.procedure.plan import OnFailure, OperatorTime

Positive = Annotated[int, Field(ge=1)]

MOST_SAMPLES: Final = 1_000_000
"""Of what is waited for to settle."""

TEMPERATURE_DIFFERENCE: Final = QuantityKind("a difference of temperatures", "0.1 K", "K", only=("K", "mK"))


class SettleForm(FileModel):
    """When something has settled: each sample of a `window` within `precision`, one taken each `interval`."""

    precision: float
    window: DurationS
    timeout: DurationS
    interval: DurationS

    @model_validator(mode="after")
    def _can_come_about(self) -> SettleForm:
        if self.precision <= 0.0:
            raise ValueError("the precision is more than nothing: no two samples are ever the same")
        if not 0.0 < self.interval <= self.window:
            raise ValueError("the interval is longer than nothing and no longer than the window")
        if self.timeout > MOST_SAMPLES * self.interval:
            raise ValueError(f"an interval so short takes more than {MOST_SAMPLES} samples until the timeout")
        if self.timeout < self.window + self.interval:
            raise ValueError(
                "the timeout is at least the window and one interval: one sample is older than it"
            )
        return self


class SignalSettle(SettleForm):
    """Settling of the three signals, V."""

    what: Literal["signals"] = "signals"
    precision: VoltageV
    interval: DurationS = 1.0


class TemperatureSettle(SettleForm):
    """Settling of the temperature at the block, K."""

    what: Literal["temperature"] = "temperature"
    precision: Annotated[float, BeforeValidator(lambda text: parse_quantity(text, TEMPERATURE_DIFFERENCE))]
    interval: DurationS = 60.0


def _what_settles(written: Any) -> str:
    what = written.get("what") if isinstance(written, dict) else getattr(written, "what", None)
    return "temperature that settles" if what == "temperature" else "signals that settle"


SettleVerb = Annotated[
    Annotated[SignalSettle, Tag("signals that settle")]
    | Annotated[TemperatureSettle, Tag("temperature that settles")],
    Discriminator(_what_settles),
]


def _form_of_settling(written: Any) -> str:
    return "settling of signals" if isinstance(written, dict | SignalSettle) else "time to settle"


class FailureSection(FileModel):
    """What becomes of a turn or a reading that fails: how often it is repeated, and then?"""

    repeat: Annotated[int, Field(ge=0, le=100)] = 1
    then: Literal["stop", "continue"] = "stop"

    def to_plan(self) -> OnFailure:
        """Return it as a plan holds it."""
        return OnFailure(self.repeat, self.then)


class ReadingSection(FileModel):
    """How a reading is taken unless a step says otherwise: samples, power-line cycles, settling before it.

    `settle` is a plain time to wait, or says when the signals have settled.
    """

    samples: Positive = 10
    nplc: Annotated[float, Field(gt=0.0)] = 10.0
    settle: Annotated[
        Annotated[SpanS, Tag("time to settle")] | Annotated[SignalSettle, Tag("settling of signals")],
        Discriminator(_form_of_settling),
    ] = 5.0
    on_failure: FailureSection | None = None


class OperatorTimeSection(FileModel):
    """Expected times of the operator, for the estimate of a plan's duration alone."""

    turn: SpanS = 120.0
    mount: SpanS = 1200.0
    answer: SpanS = 30.0
    input: SpanS = 60.0

    def to_plan(self) -> OperatorTime:
        """Return the times as a plan holds them."""
        return OperatorTime(self.turn, self.mount, self.answer, self.input)
