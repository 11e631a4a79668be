"""What the simulated meters of the 34401A's line share: remote control, errors, overload, power.

Source: 34401A User's Guide (34401-90004), chapters 3-5; 34970A User's Guide (34970-90003), chapter 5.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Final, Literal

from sim.scpi.instrument import Command, ScpiInstrument
from sim.scpi.status import ScpiError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sim.agilent_34401a.converter import Converter
    from sim.agilent_34401a.cycle import MeasuringCycle

Interface = Literal["gpib", "rs232", "lan"]

VOLT_OVERLOAD: Final = 1
"""The bit of the questionable data register."""

_ERRORS: Final = {
    514: "Command allowed only with RS-232",
    521: "Input buffer overflow",
    522: "Output buffer overflow",
    532: "Cannot achieve requested resolution",
    550: "Command not allowed in local",
}
_REMOTE_COMMANDS: Final = ("SYSTem:LOCal", "SYSTem:REMote", "SYSTem:RWLock")
_ALLOWED_IN_LOCAL: Final = (*_REMOTE_COMMANDS, "SYSTem:ERRor?", "*IDN?", "*CLS", "*ESR?", "*STB?")
_SCPI_VERSION: Final = "1994.0"


class LineMeter(ScpiInstrument):
    """The base of the meters.

    `interface` is what a meter believes to be connected by: "rs232" refuses (+550) all but identification,
    errors and SYSTem:REMote until that was sent, "gpib" refuses the SYSTem:REMote family (+514), "lan" takes
    both and needs neither. `errors` are the texts that the model has beside those of the line.
    """

    beside_measuring: tuple[str, ...] = ()
    """The commands that do not wait for a measurement under way."""

    def __init__(self, identity: str, errors: Mapping[int, str], interface: Interface) -> None:
        super().__init__(identity, {**_ERRORS, **errors})
        self.interface = interface
        self._remote = False
        self._locked = False
        self.add(self._remote_commands())

    # --- what a model says --------------------------------------------------------------------------

    @property
    @abstractmethod
    def cycle(self) -> MeasuringCycle:
        """Its trigger system."""

    @property
    @abstractmethod
    def converters(self) -> Sequence[Converter]:
        """Its converter, as each of its inputs has it."""

    # --- what the wire and the bench do -------------------------------------------------------------

    def admit(self, command: Command) -> None:
        """Refuse what the interface does not allow, and wait for a measurement under way."""
        if self.interface == "gpib" and command.notation in _REMOTE_COMMANDS:
            raise ScpiError(514)
        if self.interface == "rs232" and not self._remote and command.notation not in _ALLOWED_IN_LOCAL:
            raise ScpiError(550)
        if command.notation not in self.beside_measuring:
            self.cycle.complete()

    def device_clear(self) -> None:
        """Stop measuring and go to idle; settings, errors and status stay."""
        self.cycle.abort()

    def input_overflow(self) -> None:
        """Take note that a message was longer than the input buffer."""
        self.report(521)

    def power_cycle(self) -> None:
        """Switch off and on: the settings are gone, all but what a model keeps."""
        super().power_cycle()
        self._set_remote(False)

    def press_local(self) -> None:
        """Press LOCAL on the front panel: an RS-232 meter refuses commands until SYSTem:REMote.

        Locked by SYSTem:RWLock the key does nothing.
        """
        if not self._locked:
            self._remote = False

    @property
    def overloaded(self) -> bool:
        """Whether the voltage at every input is beyond every range, whatever the sources say."""
        return any(converter.overloaded for converter in self.converters)

    @overloaded.setter
    def overloaded(self, overloaded: bool) -> None:
        for converter in self.converters:
            converter.overloaded = overloaded

    # --- commands -----------------------------------------------------------------------------------

    def _remote_commands(self) -> list[Command]:
        return [
            Command("SYSTem:VERSion?", lambda: _SCPI_VERSION),
            Command("SYSTem:LOCal", lambda: self._set_remote(False)),
            Command("SYSTem:REMote", lambda: self._set_remote(True)),
            Command("SYSTem:RWLock", lambda: self._set_remote(True, locked=True)),
        ]

    def _set_remote(self, remote: bool, locked: bool = False) -> None:
        self._remote = remote
        self._locked = locked
