"""Base class of remote-controlled supplies: it checks limits, reads back, sets only outputs that are off."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from drivers.interfaces import (
    Identity,
    InstrumentRefused,
    LimitExceeded,
    OutputSettings,
    OutputState,
    SetOtherwise,
    SupplyLimits,
    message,
)
from drivers.making_safe import STAYS_REMOTE, Attempts
from drivers.wire.visa import ProvedInstrument

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

NUMBER: Final = r"[+-]?\d{1,3}(?:\.\d{1,8})?(?:E[+-]\d{1,3})?"
"""The pattern of a voltage or current in replies of supplies."""

SWITCHING_S: Final = 0.5
"""Pause after switching, s, in which the unit's in-rush current decays or an output without load discharges."""

_ERRORS_ASKED: Final = 32
"""The most errors to read from a queue: more than any queue holds."""


class WiredSupply(ProvedInstrument):
    """The base class of remote-controlled supplies, a `PowerSupply`.

    A subclass verifies the identity and reads, sets and switches the outputs. `limits` are the limits of the model.
    """

    asks_person = False

    def __init__(self, name: str, session: MessageSession, clock: Clock, *, limits: SupplyLimits) -> None:
        super().__init__(name, session, clock)
        self.outputs = tuple(limits.outputs)
        self._limits = limits
        self._wire = session
        self._set: dict[str, OutputSettings] = {}

    def close(self) -> str:
        """Return the front panel to local control and disconnect; the outputs stay as they are. Never raises.

        Returns what a person must still do, an empty string for nothing.
        """
        attempts = Attempts()
        if self._session.opened and self._wire.connection is not None:
            attempts.make(STAYS_REMOTE, self._go_to_local)
        self._session.close()
        return attempts.end()

    def state(self, key: str) -> dict[str, OutputState]:
        """Return the state of every output. Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`."""
        return self._states()

    def set_up(self, settings: Mapping[str, OutputSettings], key: str) -> None:
        """Set outputs that are off, protections first, and read everything back.

        Raises `LimitExceeded` before anything is sent; `SetOtherwise`, before anything is changed, if an output is
        on with other settings; `InstrumentRefused` for a tripped protection, a supply that is not ready, or a
        setting not applied; `InstrumentLost`, `BadReading`.
        """
        if wrong := self._limits.transgressions(settings):
            raise LimitExceeded(
                self.name,
                f"cannot do {'; '.join(wrong)}",
                "change 'supply' under unit_under_test in the bench file",
            )
        states = self._states()
        self._refuse_tripped(states, settings)
        on = [output for output in settings if states[output].on]
        if differing := [text for o in on for text in self._differences(o, states[o].settings, settings[o])]:
            raise SetOtherwise(
                self.name,
                f"it was found switched on: {' and '.join(differing)}",
                "switch it off, or set it as the bench file states, then resume",
            )
        self._refuse_unready(states, settings)
        self._set = {}
        for output, wanted in settings.items():
            if output not in on:
                self._apply(output, wanted)
        self._refuse_troubles([*self._errors(), *self._all_differences(self._states(), settings)])
        self._set = dict(settings)

    def switch(self, output: str, on: bool, key: str) -> None:
        """Switch an output (all outputs, if they share one switch) and read the states back.

        Raises `InstrumentRefused` if an output to be switched on was not set up or lost its settings, if the
        output did not switch or has tripped, or if an output with another switch changed, too;
        `InstrumentLost`, `BadReading`.
        """
        before = self._states()
        if on:
            self._refuse_not_set_up(output, before)
        self._switch(output, on)
        self._clock.sleep(SWITCHING_S)
        after = self._states()
        self._refuse_tripped(after, [output])
        errors = self._errors()
        if after[output].on != on:
            reported = f" ({', '.join(errors)})" if errors else ""
            raise InstrumentRefused(
                self.name,
                f"its output {output} is {_word(after[output].on)}, not {_word(on)}{reported}",
                "check its display, and let nobody else control it",
            )
        others = [o for o in self.outputs if o != output and after[o].on != before[o].on]
        if others and not self._limits.together:
            raise InstrumentRefused(
                self.name,
                f"switching its output {output} switched its output {' and '.join(others)}, too",
                "end the coupling of its outputs",
            )
        self._refuse_troubles(
            errors, message(f"reports errors after its output {output} was switched {_word(on)}")
        )

    def switch_all_off(self) -> str:
        """Switch every output off and read it back; return "", because nothing is left for a person to do.

        Raises `InstrumentRefused` if an output stays on, `InstrumentLost`, `BadReading`.
        """
        self._switch_all_off()
        if on := [output for output, state in self._states().items() if state.on]:
            raise InstrumentRefused(
                self.name, f"its output {' and '.join(on)} stays on", "switch the supply off by hand"
            )
        return ""

    # --- refusals -----------------------------------------------------------------------------------

    def _refuse_tripped(
        self, states: Mapping[str, OutputState], outputs: Sequence[str] | Mapping[str, object]
    ) -> None:
        if tripped := [output for output in outputs if states[output].tripped]:
            raise InstrumentRefused(
                self.name,
                f"a protection has switched its output {' and '.join(tripped)} off",
                "find the cause, remove it and clear the protection at the supply",
            )

    def _refuse_not_set_up(self, output: str, states: Mapping[str, OutputState]) -> None:
        """Raise `InstrumentRefused` if the output was never set up, or lost its settings as after a power cut."""
        if output not in self._set:
            raise InstrumentRefused(
                self.name, f"its output {output} was not set up", "set it up before it is switched on"
            )
        concerned = self._set if self._limits.together else {output: self._set[output]}
        if differing := self._all_differences(states, concerned):
            raise InstrumentRefused(
                self.name,
                f"its settings changed after the set-up: {' and '.join(differing)}",
                "check its power and who else controls it, then repeat this step",
            )

    def _refuse_troubles(
        self, troubles: Sequence[str], cause: str = message("did not take its settings")
    ) -> None:
        if troubles:
            raise InstrumentRefused(
                self.name,
                f"{cause}: {', '.join(troubles)}",
                "look these up in its manual, and check that nobody else controls it",
            )

    def _all_differences(
        self, states: Mapping[str, OutputState], settings: Mapping[str, OutputSettings]
    ) -> list[str]:
        return [
            text
            for output, wanted in settings.items()
            for text in self._differences(output, states[output].settings, wanted)
        ]

    def _differences(self, output: str, shown: OutputSettings, wanted: OutputSettings) -> Iterator[str]:
        for difference in self._limits.outputs[output].differences(shown, wanted):
            yield message(f"on its output {output} {difference}")

    # --- implemented by each make -------------------------------------------------------------------

    @abstractmethod
    def _states(self) -> dict[str, OutputState]:
        """Return the state of every output; nothing is changed."""

    def _refuse_unready(
        self, states: Mapping[str, OutputState], settings: Mapping[str, OutputSettings]
    ) -> None:
        """Raise an error if the supply's mode forbids these settings, such as outputs that track each other."""

    @abstractmethod
    def _apply(self, output: str, wanted: OutputSettings) -> None:
        """Send the settings of an output that is off, protections first."""

    @abstractmethod
    def _switch(self, output: str, on: bool) -> None:
        """Send the command that switches an output."""

    @abstractmethod
    def _switch_all_off(self) -> None:
        """Send the command that switches all outputs off."""

    def _errors(self) -> list[str]:
        """Return the errors that the supply reports, and clear them in the supply."""
        return []

    def _go_to_local(self) -> None:
        """Return the front panel to local control, if the supply has a command for this."""

    # --- for makes ----------------------------------------------------------------------------------

    def _identify(self, makers: str, models: Sequence[str], called: str) -> None:
        """Query *IDN? and set the identity. Raises `InstrumentRefused` for another instrument.

        `makers` is the pattern of the maker's name; `called` names the expected supply in the error.
        """
        reply = self._session.ask(
            "*IDN?", r"([^,]+),([^,]+),([^,]*),([^,]*)", message("an identity of four fields")
        )
        maker, model, serial, firmware = (part.strip() for part in reply.split(","))
        if model not in models or re.fullmatch(makers, maker, re.IGNORECASE) is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} identifies itself as {reply!r}, not as {called}",
                "check address and model in the bench file",
            )
        self._identity = Identity(maker, model, "" if serial == "0" else serial, firmware)

    def _scpi_errors(self) -> list[str]:
        """Empty the error queue of an SCPI supply and return its errors."""
        errors = []
        for _ in range(_ERRORS_ASKED):
            reply = self._session.ask("SYST:ERR?", r'[+-]?\d+,"[^"]*"', message("an error number and text"))
            if int(reply.partition(",")[0]) == 0:
                break
            errors.append(message(f"error {reply}"))
        return errors


def _word(on: bool) -> str:
    return "on" if on else "off"
