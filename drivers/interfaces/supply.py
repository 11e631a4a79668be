"""A power supply: outputs that are set with their protections, proved, switched, and watched.

A voltage has the sign of its output: a negative one is set to -12 V, its protection to -13 V. A current is what
the output gives, never negative.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Final, Protocol, runtime_checkable

from drivers.interfaces.errors import InstrumentRefused
from drivers.interfaces.instruments import Instrument

_HALF_STEP: Final = 0.51
"""A setting read back may differ by half a step and a little more, for the rounding."""


class SetOtherwise(InstrumentRefused):
    """A supply was found switched on and set otherwise than demanded; it was left so: a person is to be asked."""


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """What an output is set to: V, current limit in A, over-voltage protection in V (None: it is set to none)."""

    voltage_v: float
    current_limit_a: float
    over_voltage_v: float | None = None

    def __str__(self) -> str:
        protection = "" if self.over_voltage_v is None else f", protected at {self.over_voltage_v:g} V"
        return f"{self.voltage_v:g} V up to {self.current_limit_a:g} A{protection}"


@dataclass(frozen=True, slots=True)
class OutputState:
    """How an output is: on or not, what it is set to, the V and A that the supply measures at it.

    `tripped`: a protection of its own has switched it off, and keeps it so until somebody clears it.
    `limiting`: it is on and gives the current of its limit, not the voltage that it is set to.
    """

    on: bool
    settings: OutputSettings
    voltage_v: float
    current_a: float
    tripped: bool = False
    limiting: bool = False


@dataclass(frozen=True, slots=True)
class OutputLimits:
    """What an output can do: lowest and highest voltage (V) and current limit (A), and the steps of both.

    `over_voltage_v` are lowest and highest setting of its over-voltage protection, None where it has none.
    """

    voltage_v: tuple[float, float]
    current_a: tuple[float, float]
    voltage_step_v: float
    current_step_a: float
    over_voltage_v: tuple[float, float] | None = None
    over_voltage_step_v: float = 0.1

    def transgressions(self, settings: OutputSettings) -> list[str]:
        """Return what of the settings the output cannot do, one phrase for each."""
        wrong = []
        if not _inside(settings.voltage_v, self.voltage_v):
            wrong.append(f"{settings.voltage_v:g} V (it has {_span(self.voltage_v)} V)")
        if not _inside(settings.current_limit_a, self.current_a):
            wrong.append(
                f"a current limit of {settings.current_limit_a:g} A (it has {_span(self.current_a)} A)"
            )
        protection_v = settings.over_voltage_v
        if protection_v is not None and self.over_voltage_v is None:
            wrong.append("an over-voltage protection (it has none)")
        elif protection_v is not None and self.over_voltage_v is not None:
            if not _inside(protection_v, self.over_voltage_v):
                has = _span(self.over_voltage_v)
                wrong.append(f"an over-voltage protection at {protection_v:g} V (it has {has} V)")
            elif abs(protection_v) <= abs(settings.voltage_v):
                at = f"{protection_v:g} V with {settings.voltage_v:g} V set"
                wrong.append(f"an over-voltage protection at {at} (it would trip at once)")
        return wrong

    def differences(self, shown: OutputSettings, wanted: OutputSettings) -> list[str]:
        """Return in what the settings shown are not those wanted, one phrase each; half a step does not count.

        Where no protection is wanted, one that is set is no difference: it can but switch off.
        """
        pairs = [
            ("the voltage", shown.voltage_v, wanted.voltage_v, self.voltage_step_v, "V"),
            ("the current limit", shown.current_limit_a, wanted.current_limit_a, self.current_step_a, "A"),
        ]
        if wanted.over_voltage_v is not None:
            if shown.over_voltage_v is None:
                return [
                    *_different(pairs),
                    f"the over-voltage protection is off, not {wanted.over_voltage_v:g} V",
                ]
            protections = (shown.over_voltage_v, wanted.over_voltage_v)
            pairs.append(("the over-voltage protection", *protections, self.over_voltage_step_v, "V"))
        return _different(pairs)


def _different(pairs: Iterable[tuple[str, float, float, float, str]]) -> list[str]:
    return [
        f"{what} is {shown:g} {unit}, not {wanted:g} {unit}"
        for what, shown, wanted, step, unit in pairs
        if not abs(shown - wanted) <= _HALF_STEP * step
    ]


def _inside(value: float, span: tuple[float, float]) -> bool:
    return span[0] <= value <= span[1]


def _span(span: tuple[float, float]) -> str:
    return f"{span[0]:g} to {span[1]:g}"


@dataclass(frozen=True, slots=True)
class SupplyLimits:
    """What a supply can do: its outputs by name. `together`: one switch is for all of its outputs.

    Its facts state them once: what a bench file may ask is held against the same ones.
    """

    outputs: Mapping[str, OutputLimits] = field(default_factory=dict)
    together: bool = False

    @classmethod
    def of(cls, facts: ModuleType, model: str | None = None) -> SupplyLimits:
        """Return the limits of a model, of the only one where the `facts` have one; they are those of a supply.

        Raises `KeyError` for a model that they do not know.
        """
        outputs = next(iter(facts.OUTPUTS.values())) if model is None else facts.OUTPUTS[model]
        limits = {name: OutputLimits(**stated) for name, stated in outputs.items()}
        return cls(limits, facts.SWITCHED_TOGETHER)

    def transgressions(self, settings: Mapping[str, OutputSettings]) -> list[str]:
        """Return what of the settings the supply cannot do, one phrase for each, with its output."""
        wrong = []
        for name, wanted in settings.items():
            if name not in self.outputs:
                wrong.append(f"an output {name} (it has {', '.join(self.outputs)})")
            else:
                wrong += [
                    f"on its output {name} {what}" for what in self.outputs[name].transgressions(wanted)
                ]
        return wrong


@runtime_checkable
class PowerSupply(Instrument, Protocol):
    """What feeds the unit under test: one or more outputs.

    It goes on as it is when it is opened and when it is closed: a unit that is switched on stays so.
    """

    outputs: tuple[str, ...]
    """Its outputs by the names that the make gives them."""

    asks_person: bool
    """Whether `state` costs a person answers: then it is asked at each mounting only."""

    def state(self, key: str) -> dict[str, OutputState]:
        """Return how every output is now, as the supply tells it; nothing is changed.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused` (errors that it reports), `NoAnswer`.
        """
        ...

    def set_up(self, settings: Mapping[str, OutputSettings], key: str) -> None:
        """Set outputs, protections first, and read everything back. None is switched.

        An output that is on must be set so already. Raises `LimitExceeded` before anything is sent,
        `SetOtherwise` with what is set before anything is changed, `InstrumentRefused` for a setting not taken
        or a protection that has tripped, `InstrumentLost`, `BadReading`, `NoAnswer`.
        """
        ...

    def switch(self, output: str, on: bool, key: str) -> None:
        """Switch an output on or off and read it back; with it all others, where the supply has one switch.

        Raises `InstrumentRefused` for one that was never set up, was not taken, or has tripped since;
        `InstrumentLost`, `BadReading`, `NoAnswer`.
        """
        ...

    def switch_all_off(self) -> str:
        """Switch every output off and read it back; return what a person must still do, empty for nothing.

        Raises `BenchError` where the supply does not obey; it may be called on every way out of a run.
        """
        ...
