"""A power supply that a person sets, reads and switches; the readings are checked against the settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Literal

from drivers.angles import SupplyUnit, typed_supply
from drivers.instruments.manual import ByHand
from drivers.interfaces import (
    BadReading,
    InstrumentRefused,
    LimitExceeded,
    OutputSettings,
    OutputState,
    SetOtherwise,
    SupplyLimits,
    message,
)
from drivers.person import ATTEMPTS, Prompt, PromptKind

if TYPE_CHECKING:
    from drivers.person import Action, Person

_SWITCH: Final = ("off", "on")
_YES: Final = frozenset({"y", "yes", "ok", "done"})
_OF_LIMIT: Final = 0.99
"""A current above this fraction of its limit counts as limited."""
_DEAD: Final = 0.02
"""An output below this fraction of its set voltage counts as off."""

Quantity = Literal["set_voltage", "current_limit", "voltage", "current"]
_CALLED: Final[dict[Quantity, tuple[str, SupplyUnit]]] = {
    "set_voltage": (message("the voltage that output {0} is set to"), "V"),
    "current_limit": (message("the current limit of output {0}"), "A"),
    "voltage": (message("the voltage that output {0} gives"), "V"),
    "current": (message("the current that output {0} gives"), "A"),
}


class ManualSupply(ByHand):
    """A `PowerSupply` with these `limits` that a person operates.

    A measured voltage may differ from the set voltage by `tolerance_v`, V.
    """

    model = "power supply"
    asks_person = True

    def __init__(self, name: str, person: Person, *, limits: SupplyLimits, tolerance_v: float) -> None:
        super().__init__(name, person)
        self.outputs = tuple(limits.outputs)
        self._limits = limits
        self._tolerance_v = tolerance_v
        self._set: dict[str, OutputSettings] = {}
        self._on: dict[str, bool] = {}

    def state(self, key: str) -> dict[str, OutputState]:
        """Ask for voltage and current of each output that was set up, and return the states.

        Raises `BadReading` if no number is typed, `NoAnswer` if nobody can answer.
        """
        return {output: self._state(output, key) for output in self._set}

    def set_up(self, settings: Mapping[str, OutputSettings], key: str) -> None:
        """Ask the person to set the outputs that are off, protections first, and to read the settings back.

        Raises `LimitExceeded` before anybody is asked, `SetOtherwise` if an output is on with other settings,
        `InstrumentRefused` if the settings still differ after the last attempt, `BadReading`, `NoAnswer`.
        """
        if wrong := self._limits.transgressions(settings):
            raise LimitExceeded(
                self.name,
                f"cannot do {'; '.join(wrong)}",
                "change 'supply' under unit_under_test in the bench file",
            )
        for output, wanted in settings.items():
            self._on[output] = self._is_on(output, key)
            if self._on[output]:
                if different := self._differences(output, wanted, key):
                    raise SetOtherwise(
                        self.name,
                        f"its output {output} is on, and {' and '.join(different)}",
                        "switch it off or set it as the bench file states, then confirm again",
                    )
            else:
                self._have_set(output, wanted, key)
            self._set[output] = wanted

    def switch(self, output: str, on: bool, key: str) -> None:
        """Ask the person to switch an output; after switching on, ask for the voltage that the supply shows.

        Raises `InstrumentRefused` if nobody confirms, the output did not switch, was not set up before it is
        switched on, or shows a wrong voltage; `BadReading`, `NoAnswer`.
        """
        if on and output not in self._set:
            raise InstrumentRefused(
                self.name, f"its output {output} was not set up", "set it up before it is switched on"
            )
        word = _SWITCH[on]
        confirmation = self._text(
            f"{key}/{output}/{word}",
            f"Switch output {output} of the power supply {word} and confirm.",
            PromptKind.CONFIRM,
            {"do": "switch_supply", "output": output, "on": on},
            default="yes",
        )
        if confirmation.lower() not in _YES:
            raise InstrumentRefused(
                self.name,
                f"nobody confirmed that its output {output} is {word}",
                "switch it and take this step again",
            )
        self._on[output] = on
        if self._is_on(output, f"{key}/after") != on:
            self._on[output] = not on
            remedy = (
                message("check whether a protection has tripped")
                if on
                else message("switch it off, then repeat this step")
            )
            raise InstrumentRefused(self.name, f"its output {output} is not {word}", remedy)
        if on:
            self._refuse_other_voltage(output, key)

    def switch_all_off(self) -> str:
        """Return the task of switching outputs off, for a person; an empty string if no output can be on.

        No question is asked.
        """
        on = [output for output, is_on in self._on.items() if is_on]
        return message(f"switch its output {' and '.join(on)} off by hand") if on else ""

    # --- questions ----------------------------------------------------------------------------------

    def _state(self, output: str, key: str) -> OutputState:
        settings = self._set[output]
        voltage_v = self._number("voltage", output, key)
        current_a = self._number("current", output, key)
        on = self._on.get(output, False) and abs(voltage_v) > _DEAD * abs(settings.voltage_v)
        limiting = on and current_a >= _OF_LIMIT * settings.current_limit_a
        tripped = self._on.get(output, False) and not on
        return OutputState(on, settings, voltage_v, current_a, tripped, limiting)

    def _have_set(self, output: str, wanted: OutputSettings, key: str) -> None:
        """Ask for an output's settings until those read back agree, else raise `InstrumentRefused`."""
        protection = "" if wanted.over_voltage_v is None else f"protection at {wanted.over_voltage_v:g} V, "
        task = (
            f"Set output {output} of the power supply, which stays off: {protection}"
            f"current limit {wanted.current_limit_a:g} A, then {wanted.voltage_v:g} V; confirm."
        )
        different: list[str] = []
        for attempt in range(1, ATTEMPTS + 1):
            trouble = f"Read back, {' and '.join(different)}. " if different else ""
            self._text(
                f"{key}/{output}/set/{attempt}",
                trouble + task,
                PromptKind.CONFIRM,
                {
                    "do": "set_supply",
                    "outputs": {output: (wanted.voltage_v, wanted.current_limit_a, wanted.over_voltage_v)},
                },
                default="yes",
            )
            different = self._differences(output, wanted, f"{key}/{attempt}")
            if not different:
                return
        raise InstrumentRefused(
            self.name,
            f"its output {output} was not set in {ATTEMPTS} attempts: {' and '.join(different)}",
            "check what the display shows, then repeat this step",
        )

    def _differences(self, output: str, wanted: OutputSettings, key: str) -> list[str]:
        """Return one phrase per displayed setting that differs from `wanted`; the protection is not displayed."""
        shown = OutputSettings(
            self._number("set_voltage", output, key),
            self._number("current_limit", output, key),
            wanted.over_voltage_v,
        )
        return self._limits.outputs[output].differences(shown, wanted)

    def _refuse_other_voltage(self, output: str, key: str) -> None:
        wanted_v = self._set[output].voltage_v
        given_v = self._number("voltage", output, key)
        if abs(given_v - wanted_v) > self._tolerance_v:
            raise InstrumentRefused(
                self.name,
                f"its output {output} gives {given_v:g} V, not {wanted_v:g} V within {self._tolerance_v:g} V",
                "check its current limit and the cable to the unit",
            )

    def _is_on(self, output: str, key: str) -> bool:
        text = self._text(
            f"{key}/{output}/switch",
            f"Is output {output} of the power supply on or off?",
            PromptKind.CHOOSE,
            {"do": "read_supply", "output": output, "what": "switch"},
            choices=_SWITCH,
        )
        if text not in _SWITCH:
            raise BadReading(
                self.name,
                f"its output {output} is said to be '{text}'",
                "answer on or off at the next prompt",
            )
        return text == "on"

    def _number(self, what: Quantity, output: str, key: str) -> float:
        """Ask for the number on the display that `what` names. Raises `BadReading` if no attempt gives one."""
        called, unit = _CALLED[what]
        trouble = ""
        for attempt in range(1, ATTEMPTS + 1):
            text = self._text(
                f"{key}/{output}/{what}",
                f"{trouble}Read {called.format(output)} from the power supply, {unit}.",
                PromptKind.NUMBER,
                {"do": "read_supply", "output": output, "what": what},
                unit=unit,
                attempt=attempt,
            )
            try:
                return typed_supply(text, unit)
            except ValueError as error:
                trouble = f"{error} "
        raise BadReading(
            self.name,
            f"no number for {called.format(output)} in {ATTEMPTS} attempts",
            "read the display, then repeat this step",
        )

    def _text(
        self,
        prompt_id: str,
        text: str,
        kind: PromptKind,
        action: Action,
        *,
        default: str | None = None,
        unit: str = "",
        choices: tuple[str, ...] = (),
        attempt: int = 1,
    ) -> str:
        """Show a prompt and return the answer (if empty, the default), or "" if it answers another prompt."""
        prompt = Prompt(
            id=f"{prompt_id}#{attempt}",
            kind=kind,
            text=text,
            default=default,
            unit=unit,
            choices=choices,
            action=action,
        )
        answer = self._person.ask(prompt)
        if answer.prompt_id != prompt.id:
            return ""
        return answer.text.strip().replace("−", "-") or default or ""
