"""Base class of the SCPI voltmeters, which identifies, configures, starts and reads a meter.

A model's driver states the accepted identities, the settings, and the replies that confirm them. It also
overrides the commands for triggering, readings, errors and remote control that differ from a 34401A's. This
module handles communication, lost connections and power cuts for all models.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

from drivers.facts import agilent_34401a as line
from drivers.interfaces import (
    BadReading,
    Channel,
    Identity,
    InstrumentLost,
    InstrumentRefused,
    LimitExceeded,
    VoltmeterLimits,
    VoltmeterSettings,
    message,
)
from drivers.making_safe import STAYS_REMOTE, Attempts

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

Interface = Literal["lan", "gpib", "rs232"]

_NUMBER: Final = r"[+-]?\d+(?:\.\d+)?(?:E[+-]?\d+)?"
IDENTITY: Final = r"([^,]+),([^,]+),([^,]*),([^,]*)"
_NONE: Final = -1
"""A value that differs from every connection number."""

# bits of the standard event register (*ESR?)
_POWER_ON: Final = 128
_ERRORS: Final = 4 | 8 | 16 | 32  # query, device, execution, command

_PATIENCE: Final = 1.5


_ASKED_AGAIN: Final = ("FUNC?", "RANG?", "NPLC?")
"""Ends of the queries that are asked after each reading: a wrong answer means a wrong number."""


@dataclass(frozen=True, slots=True)
class ProvenSetting:
    """A setting: the command that makes it, the query that verifies it, and the expected reply.

    `command` is None if an earlier command makes this setting, too. If `wanted` is a tuple, it holds one
    value per channel, and commas separate the values in the reply.
    """

    command: str | None
    question: str
    wanted: str | float | tuple[float, ...]


class ScpiVoltmeter(ABC):
    """The base class of the SCPI voltmeters: a `Voltmeter` that lacks only the model's own commands.

    `channels` are the signals in scan order, or the only signal. `interface` is the interface selected at the
    meter, even if an adapter is between; over RS-232 the driver first sets the meter to remote. `clock`
    measures how long an RS-232 meter was idle: after some ten minutes it may have returned to local.
    `line_hz` is the mains frequency, Hz, which determines how long a reading takes.
    """

    # Overridden by each model; the defaults are those of a 34401A.
    makers: str = line.MAKERS
    """Pattern of the makers' names in the identity."""
    models: tuple[str, ...] = ()
    """The names of the accepted models in the identity."""
    not_live: str = ""
    """The reason why the meter must not be sampled between readings; empty if it may be."""
    called: str = ""
    """The expected meter in the error for a wrong instrument: "a 34401A"."""
    hint: str = ""
    """A setting of the meter that a person should check if the meter does not respond; may be empty."""
    start_command: str = "INIT"
    fetch_query: str = "FETC?"
    reading: str = line.READING
    """Pattern of one reading as sent; below, an example and the length in characters with the separator."""
    reading_example: str = line.READING_EXAMPLE
    reading_characters: int = line.READING_CHARACTERS
    equally_long: bool = False
    """Whether all readings of a reply have one length, so that a shorter one lost a digit."""
    overload_v: float = line.OVERLOAD_V
    sample_overhead_s: float = line.SAMPLE_OVERHEAD_S
    """Overhead of a sample in addition to its two integrations, s."""
    error_query: str = "SYST:ERR?"
    error_reply: str = r'([+-]?\d+),"([^"]*)"'
    """Pattern of an entry of the error queue; its first group is the number, 0 for no error."""
    errors_kept: int = line.ERRORS_KEPT
    remote_command: str = "SYST:REM"
    local_command: str = "SYST:LOC"
    """Command that returns an RS-232 meter to local, empty if there is none; `remote_command` sets it to remote."""
    self_test_s: float = line.SELF_TEST_S
    stays_remote_s: float = line.STAYS_REMOTE_S

    def __init__(
        self,
        name: str,
        channels: Channel | tuple[Channel, ...],
        session: MessageSession,
        clock: Clock,
        *,
        interface: Interface = "lan",
        line_hz: float = 50.0,
    ) -> None:
        self.name = name
        self.channels = (channels,) if isinstance(channels, str) else channels
        self._session = session
        self._clock = clock
        self._interface = interface
        self._line_hz = line_hz
        self._settings: VoltmeterSettings | None = None
        self._connection: int | None = None  # the connection over which the settings were proved
        self._identity: Identity | None = None  # as the first `open` found it
        self._identified: int | None = None  # the connection of the last proved identity, None before `open`
        self._started = False
        self._spoke_s = -math.inf

    # --- implemented or overridden by each model ----------------------------------------------------

    @property
    @abstractmethod
    def limits(self) -> VoltmeterLimits:
        """The limits of the model."""

    @abstractmethod
    def _setup(self, settings: VoltmeterSettings) -> Sequence[ProvenSetting]:
        """Return the commands for these settings with their verifying queries, in order."""

    def _accept(self, identity: Identity, reply: str) -> None:
        """Raise `InstrumentRefused` with the `reply` to *IDN? unless this driver supports the identity."""
        if identity.model in self.models and re.fullmatch(self.makers, identity.maker, re.IGNORECASE):
            return
        raise InstrumentRefused(
            self.name,
            f"{self._session.resource} identifies itself as {reply!r}, not as {self.called}",
            f"check the address in the bench file{f' ({self.hint})' if self.hint else ''}",
        )

    def reading_time_s(self, settings: VoltmeterSettings, character_time_s: float = 0.0) -> float:
        """Return the time from the start until the last character of the readings has arrived, s.

        Autozero adds a second integration to each sample. `character_time_s` is the time per character on a
        serial line.
        """
        sample_s = 2.0 * settings.nplc / self._line_hz + self.sample_overhead_s
        return settings.samples * len(self.channels) * (sample_s + self.reading_characters * character_time_s)

    # --- methods of `Voltmeter` ---------------------------------------------------------------------

    def open(self) -> Identity:
        """Connect, verify and return the identity, and clear the error queue.

        Raises `InstrumentLost`, `BadReading`, and `InstrumentRefused` for another instrument, also for another one
        of its kind than at the first call: its gain and offset are others.
        """
        self._identified = _NONE
        self._connection = None
        self._started = False
        self._session.open()
        self._be_remote()
        reply = self._session.query("*IDN?", pattern=IDENTITY, expected=message("an identity of four fields"))
        maker, model, serial, firmware = (field.strip() for field in reply.split(","))
        identity = Identity(maker, model, "" if serial == "0" else serial, firmware)
        self._accept(identity, reply)
        if self._identity is not None:
            self._identity.refuse_other(self.name, identity)
        self._identity = identity
        self._session.write("*CLS")
        self._identified = self._session.connection
        return identity

    def configure(self, settings: VoltmeterSettings) -> None:
        """Send the settings, read each back and query errors; over a new connection verify the identity first.

        Raises `LimitExceeded` before anything is sent, `InstrumentRefused` that lists all settings not accepted,
        `InstrumentLost`, `BadReading`.
        """
        if wrong := self.limits.transgressions(settings):
            raise LimitExceeded(self.name, f"cannot do {', '.join(wrong)}", "change the procedure")
        self._connection = None
        opened = self._identified is not None
        if opened and self._identified != self._session.connection:
            self.open()  # also clears errors and events left by the failed connection
        elif self._started:
            self._discard()
        self._be_remote()
        differences = [phrase for setting in self._setup(settings) for phrase in self._set(setting)]
        troubles = differences + self._errors()
        if troubles and opened:
            self._identified = _NONE
        self._refuse(troubles, message("did not accept its settings"))
        self._settings = settings
        self._connection = self._session.connection

    def start(self) -> None:
        """Start a reading; over a new connection verify identity and settings first.

        A reading that was started but never fetched (because another meter failed) is awaited and discarded
        first: a meter that is still measuring ignores a new start.
        Raises the errors of `open` and `configure`, and `InstrumentRefused` before the first `configure`.
        """
        if self._settings is None:
            raise InstrumentRefused(
                self.name, "no range, NPLC and samples were set", "configure it before a reading"
            )
        if self._connection is None or self._connection != self._session.connection:
            self.open()
            self.configure(self._settings)
        elif self._clock.now_s() - self._spoke_s > self.stays_remote_s:
            self._be_remote()
        if self._started:
            self._discard()
        self._session.write(self.start_command)
        self._started = True

    def fetch(self) -> dict[Channel, tuple[float, ...]]:
        """Wait for the reading; return its samples in volts, `{"x": (1.2, …)}`.

        Raises `BadReading` for an overload, a wrong format or number of samples, or if no reading was started over
        this connection. Raises `InstrumentLost`, also if the meter lost power since it was configured, and
        `InstrumentRefused` for errors that the meter reports.
        """
        settings = self._settings
        if settings is None or not self._started or self._connection != self._session.connection:
            raise BadReading(
                self.name, "no reading was started over this connection", "start the reading again"
            )
        reply = self._fetch(settings)
        self._refuse_interruption()
        self._refuse_other_settings(settings)
        texts = reply.rstrip(",").split(",")
        values = tuple(map(float, texts))
        # A scan reads every channel once, so the samples of the channels are interleaved.
        signals = {
            channel: values[index :: len(self.channels)] for index, channel in enumerate(self.channels)
        }
        self._refuse_overload(signals, settings)
        if self.equally_long:
            self._refuse_lost_digits(texts)
        self._spoke_s = self._clock.now_s()
        return signals

    def disturbed(self) -> None:
        """Note that somebody else used the meter, so that it is verified and configured before the next reading."""
        self._connection = None
        self._started = False

    def self_test(self) -> str:
        """Run the self-test (*TST?, some 10 s on a 34401A); return the errors found, "" for none.

        A signal at the input may disturb the test. Raises `InstrumentLost`, `BadReading`.
        """
        self._be_remote()
        self._connection = None  # a self-test may lose the settings: configure again
        self._started = False
        reply = self._session.query(
            "*TST?",
            timeout_s=self._session.timeout_s + self.self_test_s,
            pattern=r"[+-]?\d{1,5}",
            expected=message("the result of the self-test, 0 or 1"),
        )
        errors = self._errors()
        self._spoke_s = self._clock.now_s()
        return "" if int(reply) == 0 else ", ".join([f"*TST? answers {reply}", *errors])

    def _fetch(self, settings: VoltmeterSettings) -> str:
        """Wait for the reading that was started; return the raw reply."""
        self._started = False
        readings = settings.samples * len(self.channels)
        character_s = self._session.serial.character_time_s if self._interface == "rs232" else 0.0
        return self._session.query(
            self.fetch_query,
            timeout_s=self._session.timeout_s + _PATIENCE * self.reading_time_s(settings, character_s),
            # Some firmware prints a comma after the last reading.
            pattern=rf"{self.reading}(?:,{self.reading}){{{readings - 1}}},?",
            expected=message(f"{readings} readings such as {self.reading_example}"),
        )

    def _discard(self) -> None:
        """Wait for a reading that was not fetched, and discard it."""
        if self._settings is not None:
            self._fetch(self._settings)

    def close(self) -> str:
        """Disconnect, over RS-232 after a return to local; return what a person must still do. Never raises."""
        attempts = Attempts()
        if self._interface == "rs232" and self.local_command and self._session.connection is not None:
            attempts.make(STAYS_REMOTE, partial(self._session.write, self.local_command))
        self._connection = None
        self._started = False
        self._session.close()
        return attempts.end()

    # --- settings, errors ---------------------------------------------------------------------------

    def _be_remote(self) -> None:
        """Set a meter on RS-232 to remote, so that it accepts commands; other interfaces do not need this."""
        if self._interface == "rs232" and self.remote_command:
            self._session.write(self.remote_command)
        self._spoke_s = self._clock.now_s()

    def _set(self, setting: ProvenSetting) -> list[str]:
        """Send the command of a setting, if it has one, and query the setting; return differences as phrases.

        A query after each command also keeps an RS-232 meter's 100-character input buffer from overflowing.
        """
        if setting.command is not None:
            self._session.write(setting.command)
        question, wanted = setting.question, setting.wanted
        if isinstance(wanted, str):
            reply = self._session.query(question)
            taken = reply == wanted
        else:
            numbers = wanted if isinstance(wanted, tuple) else (wanted,)
            reply = self._session.query(
                question,
                pattern=rf"{_NUMBER}(?:,{_NUMBER}){{{len(numbers) - 1}}}",
                expected="a number" if len(numbers) == 1 else f"{len(numbers)} numbers",
            )
            answered = [float(text) for text in reply.split(",")]
            taken = all(math.isclose(a, w, rel_tol=1e-6) for a, w in zip(answered, numbers, strict=True))
        return [] if taken else [message(f"{question} answers {reply}, not {_plain(wanted)}")]

    def _errors(self) -> list[str]:
        """Empty the error queue and return its errors."""
        errors = []
        for _ in range(self.errors_kept + 1):
            reply = self._session.query(
                self.error_query, pattern=self.error_reply, expected=message("an error number and text")
            )
            number = re.fullmatch(self.error_reply, reply)
            if number is None or int(number[1]) == 0:
                break
            errors.append(message(f"error {reply}"))
        return errors

    def _refuse(self, troubles: list[str], cause: str) -> None:
        if troubles:
            raise InstrumentRefused(
                self.name,
                f"{cause}: {', '.join(dict.fromkeys(troubles))}",
                "look these up in the meter's manual, and check that nobody else controls the meter",
            )

    def _refuse_overload(
        self, signals: Mapping[Channel, tuple[float, ...]], settings: VoltmeterSettings
    ) -> None:
        over = [c for c, values in signals.items() if any(abs(value) >= self.overload_v for value in values)]
        if over:
            raise BadReading(
                self.name,
                f"the signal of channel {' and '.join(over)} overloads the {settings.range_v:g} V range",
                "choose a higher range in the procedure, or check the wiring and power of the block",
            )

    def _refuse_lost_digits(self, texts: list[str]) -> None:
        """Raise `BadReading` if readings differ in length: then a serial port has lost a digit of one of them."""
        digits = [text.lstrip("+-") for text in texts]
        shortest, longest = min(digits, key=len), max(digits, key=len)
        if len(shortest) < len(longest):
            raise BadReading(
                self.name,
                f"the reading {shortest} is shorter than {longest}: a digit was lost on the wire",
                "try again, and if the fault returns, check the cable or lower the baud rate",
            )

    def _refuse_interruption(self) -> None:
        """Raise `InstrumentLost` if the meter lost power since configured, `InstrumentRefused` if it has errors.

        On GPIB and RS-232 the connection survives a power cut of the meter: only the event register shows it.
        """
        reply = self._session.query(
            "*ESR?", pattern=r"[+-]?\d{1,3}", expected=message("a register of 0 to 255")
        )
        events = int(reply)
        if events & _POWER_ON:
            self._connection = None
            raise InstrumentLost(
                self.name,
                "the meter was switched off and on since it was set up",
                "check its power, then repeat this reading",
            )
        if events & _ERRORS:
            self._refuse(self._errors(), message("reports errors with a reading"))

    def _refuse_other_settings(self, settings: VoltmeterSettings) -> None:
        """Raise `InstrumentRefused` if function, range or integration are no longer as `configure` proved them.

        Another program or a key at the meter changes them without an error.
        """
        again = [one for one in self._setup(settings) if one.question.split()[0].endswith(_ASKED_AGAIN)]
        if troubles := [phrase for one in again for phrase in self._set(replace(one, command=None))]:
            self._connection = None
            self._refuse(troubles, message("no longer has its settings"))


def _plain(wanted: str | float | tuple[float, ...]) -> str:
    if isinstance(wanted, str):
        return wanted
    return ", ".join(f"{value:g}" for value in (wanted if isinstance(wanted, tuple) else (wanted,)))
