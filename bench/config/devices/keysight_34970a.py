"""HP / Agilent / Keysight 34970A and 34972A with 34901A multiplexer cards."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, field_validator

from bench.base.units import DurationS
from bench.config.devices.device import Device
from bench.config.devices.voltmeters import SerialPortForm, VoltmeterTruth
from drivers.facts import keysight_34970a as multiplexer
from drivers.interfaces import Channel


def _on_a_card(number: int) -> int:
    if number // 100 not in multiplexer.SLOTS or number % 100 not in multiplexer.CARD_CHANNELS:
        raise ValueError(f"a {multiplexer.CARD} has the channels {multiplexer.CHANNELS_TEXT}, not {number}")
    return number


class Keysight34970ASection(SerialPortForm):
    """A 34970A or 34972A with 34901A cards: which signal is on which channel of the multiplexer."""

    facts: ClassVar = multiplexer

    driver: Literal["keysight-34970a"]
    inputs: Annotated[dict[Channel, Annotated[int, AfterValidator(_on_a_card)]], Field(min_length=1)]
    channel_delay: DurationS = multiplexer.CHANNEL_DELAY_S

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The signals in the order of the scan, which is that of the channel numbers."""
        return tuple(sorted(self.inputs, key=lambda signal: self.inputs[signal]))

    @property
    def inputs_used(self) -> dict[Channel, int]:
        """The channel of the multiplexer of each signal."""
        return self.inputs

    @field_validator("inputs")
    @classmethod
    def _one_signal_each(cls, inputs: dict[Channel, int]) -> dict[Channel, int]:
        if len(set(inputs.values())) < len(inputs):
            raise ValueError("two signals are on one channel of the multiplexer")
        return inputs

    @field_validator("channel_delay")
    @classmethod
    def _of_the_multiplexer(cls, delay_s: float) -> float:
        steps = delay_s / multiplexer.CHANNEL_DELAY_STEP_S
        whole = abs(steps - round(steps)) < 1e-3
        longest_s = multiplexer.LONGEST_CHANNEL_DELAY_S
        if not (0.0 <= delay_s <= longest_s and whole):
            raise ValueError(f"a channel delay is 0 to {longest_s:g} s in steps of 1 ms, not {delay_s:g} s")
        return delay_s

    def driver_options(self) -> dict[str, Any]:
        """Return the channel delay."""
        return {"channel_delay_s": self.channel_delay}

    def simulation_options(self, truth: VoltmeterTruth) -> dict[str, Any]:
        """Return what it is given beside: by LAN it is a 34972A, and it holds the cards it takes."""
        return super().simulation_options(truth) | {
            "model": multiplexer.MODELS[self.interface == "lan"],
            "cards": {100 * (number // 100): multiplexer.CARD for number in self.inputs.values()},
        }


DEVICE = Device(
    "keysight-34970a",
    Keysight34970ASection,
    driver="drivers.instruments.keysight_34970a:Keysight34970A",
    simulation="sim.keysight_34970a:Keysight34970A",
    example={
        "inputs": {"x": "101", "y": "102", "z": "103"},
        "resource": "GPIB0::9::INSTR",
        "interface": "gpib",
    },
    simulated=("noise", "accuracy"),
)
