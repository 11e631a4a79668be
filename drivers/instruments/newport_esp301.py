"""A rotary stage with a Newport ESP301 as dividing head: plain ASCII over a serial port, GPIB or a socket.

A command has no reply. The driver sends it on one line with the query for the oldest error, and the reply to the
query confirms the command. The controller cannot report whether an axis was homed. As its motors are off after
power-on, an axis with its motor off is treated as not homed.
Source: see `drivers.facts.newport_esp301`.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from drivers.angles import format_dms
from drivers.facts import newport_esp301 as facts
from drivers.interfaces import Identity, InstrumentRefused, message
from drivers.motion import MotorisedHead, Travel

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_NUMBER: Final = r" *[+-]?\d+(?:\.\d+)? *"
_ANGLE: Final = r" *[+-]?\d+\.\d+ *"
_STATE: Final = r" *[01] *"
_ERROR: Final = r" *\d{1,4}, *\d+, *[\x20-\x7e]+"
_ERROR_EXAMPLE: Final = message("an error such as 0, 451322, NO ERROR DETECTED")

_HOME: Final = message(
    "home it with the space around it clear and leave its motor on, or allow homing in the bench file"
)
_CHECK_HEAD: Final = message("free the head, check its load, home it, then repeat this step")
_AXIS_REMEDIES: Final = {
    facts.FOLLOWING_ERROR: _CHECK_HEAD,
    **dict.fromkeys(facts.LIMITS, message("check the limits in the bench file against those of the stage")),
    facts.NOT_CONNECTED: message("check the stage's cable and the axis in the bench file"),
    facts.TOO_FAST: message("state a speed in the bench file that the stage can reach"),
    facts.MOTOR_OFF: _HOME,
}


class NewportHead(MotorisedHead):
    """A `DividingHead` on one axis of an ESP301 with the degree as unit; position 0 is 0°.

    `identity` is the pattern of the model. `allow_homing` permits homing, which turns the head to its sensor
    without regard to the limits. `close` leaves the motor on, because the motor holds the head.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        travel: Travel,
        *,
        axis: int = 1,
        identity: str = facts.IDENTITY,
        allow_homing: bool = False,
    ) -> None:
        super().__init__(name, session, clock, travel, identity=Identity(facts.MAKER, ""))
        self._axis = axis
        self._identity_pattern = identity
        self._allow_homing = allow_homing

    # --- the axis -----------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Stop a move in progress, clear old errors, verify the settings; home the head if its motor is off.

        Raises `InstrumentRefused` if a setting differs, or if homing is needed but not allowed.
        """
        if self._turns():
            self.stop()
            self._mover.wait_while(self._turns, self._travel.time_limit_s(0.0))
        self._forget_errors()
        self._refuse_other_settings(message("was switched off or its settings changed"))
        if not self._motor_on():
            self._home()

    def position_rad(self) -> float:
        """Return the angle read back, rad."""
        return math.radians(float(self._angle_text()))

    def start(self, target_rad: float) -> None:
        """Begin to move to an angle."""
        degrees = round(math.degrees(target_rad), facts.DEMAND_DECIMALS) + 0.0  # never -0
        self._tell(f"PA{degrees:.{facts.DEMAND_DECIMALS}f}", message(f"move the axis to {degrees:.10g}°"))

    def moving(self) -> bool:
        """Return whether the axis is moving. Raises `InstrumentRefused` for an error, or if the motor is off."""
        turns = self._turns()
        self._refuse_error("reports error", self._oldest_error())
        if not self._motor_on():
            raise InstrumentRefused(self.name, "its motor went off on the way", _CHECK_HEAD)
        return turns

    def stop(self) -> None:
        """Decelerate and stop. Raises `InstrumentRefused` if the controller reports an error."""
        reply = self._session.urgent(f"{self._axis}ST;TB?", _ERROR, _ERROR_EXAMPLE)
        self._refuse_error(message("was told to stop and reports error"), reply)

    def _home(self) -> None:
        if not self._allow_homing:
            raise InstrumentRefused(
                self.name, "its motor is off: it may have lost its reference, which it cannot report", _HOME
            )
        self._tell("MO", message("switch the motor on"))
        self._tell("OR1", message("home the axis"))
        self._mover.wait_while(self.moving, self._travel.time_limit_s(2.0 * math.tau))

    # --- proof --------------------------------------------------------------------------------------

    def _prove(self) -> None:
        """Identify the controller; set the speed; verify speed, unit and the resolution of angles."""
        model, version = self._introduced()
        self._forget_errors()
        speed_deg_s = math.degrees(self._travel.speed_rad_s)
        self._tell(
            f"VA{speed_deg_s:.{facts.DEMAND_DECIMALS}f}",
            message(f"set the speed to {speed_deg_s:.10g} deg/s"),
        )
        self._refuse_other_settings(message("did not accept the speed"))
        decimals = len(self._angle_text().partition(".")[2])
        shown_rad = math.radians(10.0**-decimals)
        if shown_rad > self._travel.tolerance_rad:
            raise InstrumentRefused(
                self.name,
                f"it shows angles with {decimals} decimals of a degree, coarser than its tolerance of "
                f"{format_dms(self._travel.tolerance_rad, 1)}",
                "let it show more (FP), or widen the tolerance in the bench file",
            )
        self._identity = Identity(facts.MAKER, model, "", version)

    def _introduced(self) -> tuple[str, str]:
        """Return model and firmware. Raises `InstrumentRefused` for another instrument."""
        reply = self._session.ask("*IDN?", r"[\x20-\x7e]+", message("an identity"))
        match = re.fullmatch(r"(\S+) Version (\S.*)", reply.strip())
        if match is None or re.fullmatch(self._identity_pattern, match[1]) is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} is '{reply.strip()}', no model like {self._identity_pattern}",
                "check address and identity in the bench file",
            )
        return match[1], match[2]

    def _refuse_other_settings(self, what: str) -> None:
        """Raise `InstrumentRefused` for another unit or speed; `what` begins the message about the speed."""
        unit = int(self._number("SN?"))
        if unit != facts.DEGREES:
            raise InstrumentRefused(
                self.name,
                f"its axis {self._axis} has unit {unit}, not degrees ({facts.DEGREES})",
                "set the axis up in degrees with the maker's software, its speeds too",
            )
        speed_deg_s = math.degrees(self._travel.speed_rad_s)
        taken_deg_s = self._number("VA?")
        if not math.isclose(taken_deg_s, speed_deg_s, rel_tol=1e-3):
            raise InstrumentRefused(
                self.name,
                f"it {what}: its speed is {taken_deg_s:g} deg/s, not {speed_deg_s:g} deg/s",
                "check its speed and the one in the bench file, then repeat the command or resume the run",
            )

    # --- messages -----------------------------------------------------------------------------------

    def _turns(self) -> bool:
        return self._ask("MD?", _STATE, "0 or 1").strip() == "0"

    def _motor_on(self) -> bool:
        return self._ask("MO?", _STATE, "0 or 1").strip() == "1"

    def _angle_text(self) -> str:
        return self._ask("TP?", _ANGLE, message("an angle such as 45.0000")).strip()

    def _number(self, command: str) -> float:
        return float(self._ask(command, _NUMBER, message("a number")))

    def _ask(self, command: str, pattern: str, expected: str) -> str:
        return self._session.ask(f"{self._axis}{command}", pattern, expected)

    def _oldest_error(self) -> str:
        """Remove and return the oldest error. If the reply is lost, the repeated query returns the next error."""
        return self._session.ask("TB?", _ERROR, _ERROR_EXAMPLE)

    def _forget_errors(self) -> None:
        """Empty the error buffer. Raises `InstrumentRefused` if it does not become empty."""
        for _ in range(facts.MOST_ERRORS + 1):
            error = self._oldest_error()
            if _code(error) == facts.NO_ERROR:
                return
        self._refuse_error(message("keeps reporting errors, the last of them"), error)

    def _tell(self, command: str, purpose: str) -> None:
        """Send a command to the axis once. Raises `InstrumentRefused` with the `purpose` if an error follows."""
        reply = self._session.command(f"{self._axis}{command};TB?", _ERROR, _ERROR_EXAMPLE)
        self._refuse_error(message(f"was told to {purpose} and reports error"), reply)

    def _refuse_error(self, how: str, error: str) -> None:
        code = _code(error)
        if code == facts.NO_ERROR:
            return
        text = error.split(",", 2)[2].strip()
        axis, of_axis = divmod(code, facts.AXIS_ERRORS)
        remedy = _AXIS_REMEDIES.get(of_axis) if axis else None
        raise InstrumentRefused(
            self.name,
            f"the controller {how} {code}, {text}",
            remedy
            or message("check the axis in the bench file and, by its manual, the controller's settings"),
        )


def _code(error: str) -> int:
    return int(error.partition(",")[0])
