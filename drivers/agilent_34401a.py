"""HP / Agilent / Keysight 34401A, and a Truevolt 34461A set to emulate it: DC volts into memory.

Sources: 34401A User's Guide (34401-90004), chapter 4, "SCPI command summary", "Output data formats",
"Triggering", "RS-232 interface configuration"; chapter 8, "DC characteristics".
"""

from __future__ import annotations

import contextlib
import math
import re
from typing import TYPE_CHECKING, Final, Literal

from drivers.interfaces import (
    BadReading,
    Channel,
    Identity,
    InstrumentLost,
    InstrumentRefused,
    LimitExceeded,
    VoltmeterSettings,
)

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.visa import MessageSession

Interface = Literal["lan", "gpib", "rs232"]

RANGES_V: Final = (0.1, 1.0, 10.0, 100.0, 1000.0)
NPLC: Final = (0.02, 0.2, 1.0, 10.0, 100.0)
MEMORY_SAMPLES: Final = 512
OVERLOAD_V: Final = 9.9e37

_READING: Final = r"[+-]\d\.\d{8}E[+-]\d\d"
_READING_CHARACTERS: Final = 16  # the 15 of a reading and its separator
_NUMBER: Final = r"[+-]?\d+(?:\.\d+)?(?:E[+-]?\d+)?"
_ERROR: Final = r'([+-]?\d+),"([^"]*)"'
_IDENTITY: Final = r"([^,]+),([^,]+),([^,]*),([^,]*)"
_MAKER: Final = r"HEWLETT-PACKARD|HP|Agilent( Technologies)?|Keysight( Technologies)?"
_ERROR_QUEUE: Final = 20

# bits of the standard event register, *ESR?
_POWER_ON: Final = 128
_ERRORS: Final = 4 | 8 | 16 | 32  # query, device, execution, command

_SAMPLE_OVERHEAD_S: Final = 0.01
_PATIENCE: Final = 1.5
_STAYS_REMOTE_S: Final = 300.0


def reading_time_s(settings: VoltmeterSettings, line_hz: float, character_time_s: float = 0.0) -> float:
    """Return the time from INIT until the last character of FETC? has come, s.

    Autozero takes a second integration for each sample; `character_time_s` is that of a slow line.
    """
    sample_s = 2.0 * settings.nplc / line_hz + _SAMPLE_OVERHEAD_S
    return settings.samples * (sample_s + _READING_CHARACTERS * character_time_s)


class Agilent34401A:
    """A `Voltmeter` with one signal.

    `interface` is what the meter is set to, whatever carries it: over RS-232 it must first be told to be
    remote. `clock` tells how long an RS-232 meter was left alone: after some ten minutes it may have
    dropped back to local.
    """

    def __init__(
        self,
        name: str,
        channel: Channel,
        session: MessageSession,
        clock: Clock,
        *,
        interface: Interface = "lan",
        line_hz: float = 50.0,
    ) -> None:
        self.name = name
        self.channels: tuple[Channel, ...] = (channel,)
        self._session = session
        self._clock = clock
        self._interface = interface
        self._line_hz = line_hz
        self._settings: VoltmeterSettings | None = None
        self._connection: int | None = None  # the one over which the settings were proved
        self._started = False
        self._spoke_s = -math.inf

    def open(self) -> Identity:
        """Connect, prove the identity by pattern (the serial number is 0 or not), empty the error queue.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused` for another instrument.
        """
        self._connection = None
        self._session.open()
        self._be_remote()
        reply = self._session.query("*IDN?", pattern=_IDENTITY, expected="an identity of four fields")
        maker, model, serial, firmware = (field.strip() for field in reply.split(","))
        if model != "34401A" or re.fullmatch(_MAKER, maker, re.IGNORECASE) is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} is {reply!r}, not a 34401A",
                "check the address in the bench file (a 34461A must be told SYST:IDEN HP34401A once)",
            )
        self._session.write("*CLS")
        return Identity(maker, model, "" if serial == "0" else serial, firmware)

    def configure(self, settings: VoltmeterSettings) -> None:
        """Send the settings, read each back and ask for errors.

        Raises `LimitExceeded` before anything is sent, `InstrumentRefused` with all that differs,
        `InstrumentLost`, `BadReading`.
        """
        self._check_limits(settings)
        self._connection = None
        self._started = False
        self._be_remote()
        # CONF presets the trigger and INP:IMP:AUTO OFF (10 MOhm), so it comes first.
        differences = [
            *self._set(f"CONF:VOLT:DC {settings.range_v:g}", "FUNC?", '"VOLT"'),
            *self._set(None, "VOLT:DC:RANG?", settings.range_v),
            *self._set(None, "VOLT:DC:RANG:AUTO?", 0.0),
            *self._set(f"VOLT:DC:NPLC {settings.nplc:g}", "VOLT:DC:NPLC?", settings.nplc),
            *self._set("ZERO:AUTO ON", "ZERO:AUTO?", 1.0),
            *self._set("INP:IMP:AUTO ON", "INP:IMP:AUTO?", 1.0),
            *self._set("TRIG:SOUR IMM", "TRIG:SOUR?", "IMM"),
            *self._set("TRIG:COUN 1", "TRIG:COUN?", 1.0),
            *self._set(f"SAMP:COUN {settings.samples}", "SAMP:COUN?", float(settings.samples)),
        ]
        self._refuse(differences + self._errors(), "did not take its settings")
        self._settings = settings
        self._connection = self._session.connection

    def start(self) -> None:
        """Begin a reading; over a connection that was made anew, prove identity and settings first.

        Raises what `open` and `configure` raise, `InstrumentRefused` when nothing was configured yet.
        """
        if self._settings is None:
            raise InstrumentRefused(
                self.name, "no range, NPLC and samples were set", "configure it before a reading"
            )
        if self._connection is None or self._connection != self._session.connection:
            self.open()
            self.configure(self._settings)
        elif self._clock.now_s() - self._spoke_s > _STAYS_REMOTE_S:
            self._be_remote()
        self._session.write("INIT")
        self._started = True

    def fetch(self) -> dict[Channel, tuple[float, ...]]:
        """Wait for the reading; return its samples in volts, `{"x": (1.2, …)}`.

        Raises `BadReading` for an overload, another form or number of samples, or a reading that was not
        started over this connection; `InstrumentLost`, also when the meter was switched off meanwhile;
        `InstrumentRefused` for errors that the meter reports.
        """
        settings = self._settings
        if settings is None or not self._started or self._connection != self._session.connection:
            raise BadReading(
                self.name, "no reading was started over this connection", "start the reading again"
            )
        self._started = False
        line_s = self._session.serial.character_time_s if self._interface == "rs232" else 0.0
        reply = self._session.query(
            "FETC?",
            timeout_s=self._session.timeout_s + _PATIENCE * reading_time_s(settings, self._line_hz, line_s),
            # Some firmware prints a comma after the last reading.
            pattern=rf"{_READING}(?:,{_READING}){{{settings.samples - 1}}},?",
            expected=f"{settings.samples} readings such as +1.23456780E+00",
        )
        self._refuse_interruption()
        values = tuple(float(text) for text in reply.rstrip(",").split(","))
        if any(abs(value) >= OVERLOAD_V for value in values):
            raise BadReading(
                self.name,
                f"the signal of channel {self.channels[0]} overloads the {settings.range_v:g} V range",
                "choose a higher range in the procedure, or check the wiring and power of the block",
            )
        self._spoke_s = self._clock.now_s()
        return {self.channels[0]: values}

    def close(self) -> None:
        """Leave the meter in local and let it go. Never raises, may be called twice."""
        if self._interface == "rs232" and self._session.connection is not None:
            with contextlib.suppress(Exception):
                self._session.write("SYST:LOC")
        self._connection = None
        self._started = False
        self._session.close()

    def _be_remote(self) -> None:
        """Over RS-232 the meter takes commands only in remote; by any other interface it is so by itself."""
        if self._interface == "rs232":
            self._session.write("SYST:REM")
        self._spoke_s = self._clock.now_s()

    def _check_limits(self, settings: VoltmeterSettings) -> None:
        wrong = []
        if settings.range_v not in RANGES_V:
            wrong.append(f"a range of {settings.range_v:g} V (it has {_listed(RANGES_V)} V)")
        if settings.nplc not in NPLC:
            wrong.append(f"an integration of {settings.nplc:g} NPLC (it has {_listed(NPLC)})")
        if not 1 <= settings.samples <= MEMORY_SAMPLES:
            wrong.append(f"{settings.samples} samples (its memory holds 1 to {MEMORY_SAMPLES})")
        if wrong:
            raise LimitExceeded(self.name, f"cannot do {', '.join(wrong)}", "change the procedure")

    def _set(self, command: str | None, question: str, wanted: str | float) -> list[str]:
        """Send a command, if any, and return how what is read back differs, as none or one phrase.

        Asking after each command also keeps an RS-232 meter's input buffer of 100 characters from filling.
        """
        if command is not None:
            self._session.write(command)
        if isinstance(wanted, str):
            reply = self._session.query(question)
            taken = reply == wanted
        else:
            reply = self._session.query(question, pattern=_NUMBER, expected="a number")
            taken = math.isclose(float(reply), wanted, rel_tol=1e-6)
        return [] if taken else [f"{question} answers {reply}, not {_plain(wanted)}"]

    def _errors(self) -> list[str]:
        """Empty the error queue and return what stood in it."""
        errors = []
        for _ in range(_ERROR_QUEUE + 1):
            reply = self._session.query("SYST:ERR?", pattern=_ERROR, expected="an error number and text")
            if int(reply.partition(",")[0]) == 0:
                break
            errors.append(f"error {reply}")
        return errors

    def _refuse(self, troubles: list[str], cause: str) -> None:
        if troubles:
            raise InstrumentRefused(
                self.name,
                f"{cause}: {', '.join(troubles)}",
                "see what these mean in the meter's manual, and check that nobody else controls the meter",
            )

    def _refuse_interruption(self) -> None:
        """Refuse a reading that came from a meter which lost its settings, or reports errors.

        On GPIB and RS-232 the connection outlives the meter's power: only its event register tells.
        """
        reply = self._session.query("*ESR?", pattern=r"[+-]?\d{1,3}", expected="a register of 0 to 255")
        events = int(reply)
        if events & _POWER_ON:
            self._connection = None
            raise InstrumentLost(
                self.name,
                "the meter was switched off and on since it was set up",
                "check its power, then take this reading again",
            )
        if events & _ERRORS:
            self._refuse(self._errors(), "reports errors with a reading")


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _plain(wanted: str | float) -> str:
    return wanted if isinstance(wanted, str) else f"{wanted:g}"
