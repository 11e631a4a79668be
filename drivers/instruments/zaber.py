"""A rotary stage with a Zaber controller as dividing head: the ASCII protocol over a serial port or TCP.

Each command has a message number, which its reply repeats, so that a late reply is never assigned to another
command. Alerts are switched off. If an unsolicited line (`!` alert, `#` information) still arrives, the connection
is dropped and the query repeated over a new one. Source: see `drivers.facts.zaber`; section "Warning Flags".
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from drivers.facts import zaber as facts
from drivers.facts.zaber import checksum
from drivers.interfaces import BadReading, Identity, InstrumentRefused, message
from drivers.motion import MotorisedHead, Travel

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_INTEGER: Final = r"-?\d{1,10}"
_WORD: Final = r"[\w.-]+"
_EXPECTED: Final = message("a reply such as @01 0 07 OK IDLE -- 0, with the number of the command")

_FINE: Final = "--"
_NOT_HOMED: Final = ("WR", "WH")
_CHECK_HEAD: Final = message("free the head, check its load, then repeat this step")
_TROUBLES: Final = {
    "FF": (
        message("reports a critical fault of the controller"),
        message("switch it off and have it serviced"),
    ),
    "FD": (
        message("has switched its motor driver off"),
        message("switch the controller off and on and home the head"),
    ),
    "FO": (
        message("has switched its motor driver off (overload)"),
        message("switch the controller off and on"),
    ),
    "FQ": (
        message("cannot trust its encoder"),
        message("check the encoder's cable, home the head, then repeat this step"),
    ),
    "FS": ("has stalled", _CHECK_HEAD),
    "FE": (message("ran into a limit"), _CHECK_HEAD),
    "FB": (message("could not follow its path"), _CHECK_HEAD),
    "WL": (message("met a limit sensor where none should be"), message("home the head and check its limits")),
    "WM": (message("was displaced while it stood"), message("home the head and take this point again")),
    "WV": (message("reports a supply voltage out of range"), message("check the power supply")),
    "WT": (message("reports a temperature out of range"), message("let it cool down")),
    "NC": (message("is being turned by its knob"), message("let nobody turn the knob during a run")),
    "NI": (
        message("was interrupted by another command"),
        message("let nobody else control the head during a run"),
    ),
}
"""Meaning and remedy of each warning flag."""

_REJECTIONS: Final = {
    "BADCOMMAND": message("the controller does not know the command"),
    "BADDATA": message("the value is outside what the controller allows"),
    "BADAXIS": message("it has no such axis"),
    "STATUSBUSY": message("it is moving"),
    "PARKED": message("the axis is parked"),
    "DRIVERDISABLED": message("the motor driver is off"),
}


@dataclass(frozen=True, slots=True)
class _Reply:
    busy: bool
    flag: str
    data: str


class ZaberHead(MotorisedHead):
    """A `DividingHead` on one axis of a Zaber device.

    `steps_per_degree` is the number of microsteps (encoder counts on a direct drive) per degree at the
    setting `resolution`; it is negative if the angle falls with rising steps. Step 0 is 0°. Angles are sent
    and read back as whole steps. `identity` is the pattern of the device id. `allow_homing` permits homing,
    which turns the head to its sensor without regard to the limits. With `checksums` every message has a
    checksum. Raises `ValueError` if `steps_per_degree` is 0 or not finite, the limits exceed the controller's
    step counter, or half a step exceeds the tolerance.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        travel: Travel,
        *,
        steps_per_degree: float,
        resolution: int = facts.RESOLUTION,
        device: int = 1,
        axis: int = 1,
        identity: str = facts.IDENTITY,
        allow_homing: bool = False,
        checksums: bool = False,
    ) -> None:
        super().__init__(name, session, clock, travel, identity=Identity(facts.MAKER, ""))
        self._steps_per_degree = _checked(steps_per_degree, travel)
        self._resolution = resolution
        self._device = device
        self._axis = axis
        self._identity_pattern = identity
        self._allow_homing = allow_homing
        self._checksums = checksums
        self._number = 0

    # --- the axis -----------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Stop a move in progress, clear old warnings, and home the head if its reference is lost.

        Raises `InstrumentRefused` if homing is needed but not allowed, or if another warning remains.
        """
        if self._ask("").busy:
            self.stop()
            # The interruption raises a warning flag, too, which is cleared below.
            self._mover.wait_while(lambda: self._ask("").busy, self._travel.time_limit_s(0.0))
        self._ask("warnings clear")
        flag = self._ask("").flag
        if flag in _NOT_HOMED:
            self._home(flag)
        elif flag != _FINE:
            raise self._trouble(flag)

    def position_rad(self) -> float:
        """Return the angle read back, rad, from whole steps."""
        return math.radians(int(self._ask("get pos", _INTEGER).data) / self._steps_per_degree)

    def start(self, target_rad: float) -> None:
        """Begin to move to the step nearest to an angle.

        The command is not repeated after a lost reply, because a repeat would interrupt the move.
        """
        self._exchange(f"move abs {round(math.degrees(target_rad) * self._steps_per_degree)}")

    def moving(self) -> bool:
        """Return whether the axis is busy. Raises `InstrumentRefused` for a warning flag."""
        return self._busy_without(())

    def stop(self) -> None:
        """Decelerate and stop."""
        self._exchange("stop", urgent=True)

    def _home(self, flag: str) -> None:
        if not self._allow_homing:
            raise InstrumentRefused(
                self.name,
                f"the head was not homed since it was switched on (flag {flag})",
                "home it with the space around it clear, or allow homing in the bench file",
            )
        self._exchange("home")
        limit_s = self._travel.time_limit_s(2.0 * math.tau)
        self._mover.wait_while(lambda: self._busy_without(_NOT_HOMED), limit_s)
        self._busy_without(())

    def _busy_without(self, tolerated: tuple[str, ...]) -> bool:
        """Return whether the axis is busy. Raises `InstrumentRefused` for any warning flag not in `tolerated`."""
        reply = self._ask("")
        if reply.flag not in (_FINE, *tolerated):
            raise self._trouble(reply.flag)
        return reply.busy

    # --- proof --------------------------------------------------------------------------------------

    def _prove(self) -> None:
        """Identify the device, verify its resolution, and set and verify its speed."""
        if self._checksums:
            self._ask("set comm.checksum 1", axis=0)
        self._if_known("set comm.alert 0")
        device_id = self._ask("get deviceid", _INTEGER, axis=0).data
        if re.fullmatch(self._identity_pattern, device_id) is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} has the Zaber device id {device_id}, "
                f"not one like {self._identity_pattern}",
                "check address and identity in the bench file",
            )
        resolution = int(self._ask("get resolution", _INTEGER).data)
        if resolution != self._resolution:
            raise InstrumentRefused(
                self.name,
                f"its resolution is {resolution} microsteps, but the steps per degree in the bench file "
                f"assume {self._resolution}",
                "correct one of them",
            )
        speed_deg_s = math.degrees(self._travel.speed_rad_s)
        speed = round(speed_deg_s * abs(self._steps_per_degree) * facts.SPEED_UNITS)
        self._ask(f"set maxspeed {speed}")
        taken = int(self._ask("get maxspeed", _INTEGER).data)
        if taken != speed:
            raise InstrumentRefused(
                self.name,
                f"its maxspeed is {taken} after it was set to {speed}",
                "state a speed in the bench file that the stage can reach",
            )
        serial, version = self._if_known("get system.serial"), self._if_known("get version")
        self._identity = Identity(facts.MAKER, device_id, serial, version)

    def _if_known(self, text: str) -> str:
        """Return the reply to a command that older firmware may not know; "" if the command is rejected."""
        try:
            return self._ask(text, _WORD, axis=0).data
        except InstrumentRefused:
            return ""

    # --- messages -----------------------------------------------------------------------------------

    def _ask(self, text: str, data: str = r".*?", axis: int | None = None) -> _Reply:
        """Send a command that may be repeated, and repeat it after a transport failure or garbled reply."""
        return self._session.repeating(lambda: self._exchange(text, data, axis))

    def _exchange(
        self, text: str, data: str = r".*?", axis: int | None = None, urgent: bool = False
    ) -> _Reply:
        """Send one command; return its reply. Raises `InstrumentRefused` if the command is rejected.

        `data` is the pattern of the reply's data; `axis` replaces the head's axis (0 for the whole device).
        """
        if not urgent:
            self._session.ensure_proved()
        addressed = self._axis if axis is None else axis
        self._number = self._number % facts.MOST_NUMBERS + 1
        sent = f"{self._device} {addressed} {self._number:02d} {text}".rstrip()
        if self._checksums:
            sent += f":{checksum(sent)}"
        # The reply to a rejected command contains a word for the reason in place of the data.
        pattern = (
            rf"@{self._device:02d} {addressed} {self._number:02d} "
            rf"(?:(OK) (BUSY|IDLE) (\S\S) ({data})|(RJ) (BUSY|IDLE) (\S\S) ([A-Z]+))(:[0-9A-F]{{2}})?"
        )
        send = self._session.urgent if urgent else self._session.command
        line = send(f"/{sent}", pattern, _EXPECTED)
        self._refuse_bad_checksum(line, text)
        match = re.fullmatch(pattern, line)
        groups = [group for group in match.groups() if group is not None] if match else []
        verdict, status, flag, content = groups[:4]
        if verdict == "RJ":
            raise InstrumentRefused(
                self.name,
                f"the controller rejected '{text}' with {content}: "
                f"{_REJECTIONS.get(content, 'look it up in its manual')}{_with_flag(flag)}",
                "check device, axis and limits in the bench file, and the controller's settings",
            )
        return _Reply(status == "BUSY", flag, content)

    def _refuse_bad_checksum(self, line: str, text: str) -> None:
        body, colon, sent = line[1:].rpartition(":")
        wrong = checksum(body) != sent if colon else self._checksums and not text.startswith("set comm")
        if wrong:
            raise BadReading(
                self.name,
                f"the reply {line!r} to '{text}' has a wrong checksum",
                "try again; if the fault returns, check the cable",
            )

    def _trouble(self, flag: str) -> InstrumentRefused:
        if flag in _NOT_HOMED:
            return InstrumentRefused(
                self.name,
                f"the head has lost its reference (flag {flag})",
                "home it, then redo this point",
            )
        cause, remedy = _TROUBLES.get(
            flag, (message("shows an unknown warning"), message("see the protocol manual for its meaning"))
        )
        return InstrumentRefused(self.name, f"the head {cause} (flag {flag})", remedy)


def _with_flag(flag: str) -> str:
    return "" if flag == _FINE else f", flag {flag}"


def _checked(steps_per_degree: float, travel: Travel) -> float:
    """Return `steps_per_degree`; raise the `ValueError` that `ZaberHead` describes."""
    if not math.isfinite(steps_per_degree) or steps_per_degree == 0.0:
        raise ValueError(f"steps_per_degree: state a number other than 0, not {steps_per_degree:g}")
    farthest_deg = math.degrees(max(abs(travel.minimum_rad), abs(travel.maximum_rad)))
    if farthest_deg * abs(steps_per_degree) > facts.MOST_STEPS:
        raise ValueError(
            f"at {steps_per_degree:g} steps per degree, the limits of the head exceed {facts.MOST_STEPS} steps; "
            "narrow the limits"
        )
    if 0.5 / abs(steps_per_degree) > math.degrees(travel.tolerance_rad):
        raise ValueError(
            f"at {steps_per_degree:g} steps per degree, a step of the head is coarser than its tolerance; widen "
            "the tolerance"
        )
    return steps_per_degree
