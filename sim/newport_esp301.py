"""A simulated rotary stage with a Newport ESP301 controller, on the head of the world.

Its encoder counts from the angle at switch-on until the stage is homed. Source:
`drivers.facts.newport_esp301`. Two points are assumptions of this simulation: a stuck axis ends in a
following error with the motor off, and a target beyond the software limits is refused before the motion
begins.
"""

from __future__ import annotations

import math
import re
from collections import deque
from typing import TYPE_CHECKING, Final

from drivers.facts import newport_esp301 as facts
from sim.wires.session import LineEnds, PlainDialect

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.world.world import World

_COMMAND: Final = re.compile(r"(\d*)([A-Z]{2})(.*)", re.DOTALL)
_NUMBER: Final = re.compile(r"[+-]?(?:\d{1,9}(?:\.\d{0,9})?|\.\d{1,9})")
_TICK_S: Final = 0.0004
"""One count of a time stamp, s."""
_LIKE_IT: Final = "Version 3.04 07/27/01"


class _Mistake(Exception):
    """A command that puts the error `code` into the error buffer."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class Esp301(PlainDialect):
    """One axis of an ESP301 controller.

    With `homed` False the controller was just switched on: motor off, zero at the present angle.
    `speed_deg_s` is the maximum speed; the speed at switch-on is a tenth of it. `lowest_deg` and
    `highest_deg` are the software limits. `unit` is the code of the axis unit; angles in replies have
    `decimals` decimals.
    """

    line_ends = LineEnds((facts.WRITE_TERMINATION.encode(),), reply=facts.READ_TERMINATION.encode())

    def __init__(
        self,
        world: World,
        *,
        axis: int = 1,
        speed_deg_s: float = 20.0,
        lowest_deg: float = -400.0,
        highest_deg: float = 400.0,
        homed: bool = True,
        model: str = "ESP301",
        unit: int = facts.DEGREES,
        decimals: int = 5,
    ) -> None:
        self._world = world
        self._axis = axis
        self._most_deg_s = speed_deg_s
        self._limits_deg = (lowest_deg, highest_deg)
        self._model = model
        self._unit = unit
        self._decimals = decimals
        self._errors: deque[int] = deque(maxlen=facts.MOST_ERRORS)
        self._switch_on()
        if homed:
            self._motor_on, self._zero_rad = True, 0.0
        self._verbs: dict[str, Callable[[str], str | None]] = {
            "PA": self._move,
            "TP": lambda _: f"{self._position_deg:.{self._decimals}f}",
            "MD": lambda _: str(int(not self._turns)),
            "MO": self._power,
            "ST": self._stop,
            "VA": self._speed,
            "SN": lambda _: str(self._unit),
            "OR": self._home,
        }

    # --- called by the wire and the bench -----------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Carry out the commands of a line; the reply has one line for each query."""
        self._notice()
        replies = []
        for part in message.decode("ascii", "replace").upper().split(";"):
            command = "".join(part.split())
            try:
                reply = self._execute(command) if command else None
            except _Mistake as mistake:
                self._errors.append(mistake.code)
                reply = None
            if reply is not None:
                replies.append(reply)
        return facts.READ_TERMINATION.join(replies).encode("ascii") if replies else None

    def input_overflow(self) -> None:
        """Report an overlong line as an unknown command."""
        self._errors.append(facts.UNKNOWN_COMMAND)

    def power_cycle(self) -> None:
        """Switch off and on: the motion ends, the motor is off, and the present angle becomes zero."""
        self._world.stop_head()
        self._switch_on()

    # --- messages -----------------------------------------------------------------------------------

    def _execute(self, command: str) -> str | None:
        if command == "*IDN?":
            return f"{self._model} {_LIKE_IT}"
        if command == "TB?":
            code = self._errors.popleft() if self._errors else facts.NO_ERROR
            return f"{code}, {round(self._world.clock.now_s() / _TICK_S)}, {_message(code)}"
        match = _COMMAND.fullmatch(command)
        if match is None or match[2] not in self._verbs:
            raise _Mistake(facts.UNKNOWN_COMMAND)
        axis, verb, value = match.groups()
        if not axis:
            raise _Mistake(facts.AXIS_MISSING)
        if axis != str(self._axis):
            raise _Mistake(facts.NO_SUCH_AXIS)
        return self._verbs[verb](value)

    def _axis_mistake(self, code: int) -> _Mistake:
        return _Mistake(self._axis * facts.AXIS_ERRORS + code)

    # --- state --------------------------------------------------------------------------------------

    def _switch_on(self) -> None:
        self._motor_on = False
        self._homing = False
        self._zero_rad = self._world.scale_angle_rad
        self._deg_s = 0.1 * self._most_deg_s
        self._errors.clear()

    def _notice(self) -> None:
        """Update the state after a motion: a completed homing sets the zero, a stuck axis causes an error."""
        if self._motor_on and self._world.head_stuck:
            self._errors.append(self._axis * facts.AXIS_ERRORS + facts.FOLLOWING_ERROR)
            self._stop("")
            self._motor_on = False
        elif self._homing and not self._turns:
            self._homing = False
            self._zero_rad = 0.0

    @property
    def _turns(self) -> bool:
        return self._world.head_rate_rad_s != 0.0

    @property
    def _position_deg(self) -> float:
        return math.degrees(self._world.scale_angle_rad - self._zero_rad)

    # --- commands -----------------------------------------------------------------------------------

    def _move(self, value: str) -> None:
        target_deg = _number(value)
        self._refuse_motor_off()
        lowest_deg, highest_deg = self._limits_deg
        if not lowest_deg <= target_deg <= highest_deg:
            raise self._axis_mistake(facts.LIMITS[2] if target_deg > highest_deg else facts.LIMITS[3])
        self._homing = False
        self._turn_to(self._zero_rad + math.radians(target_deg))

    def _home(self, _: str) -> None:
        self._refuse_motor_off()
        self._turn_to(0.0)
        self._homing = True

    def _turn_to(self, scale_rad: float) -> None:
        self._world.move_head(scale_rad, math.radians(self._deg_s))

    def _refuse_motor_off(self) -> None:
        if not self._motor_on:
            raise self._axis_mistake(facts.MOTOR_OFF)

    def _power(self, value: str) -> str | None:
        if value == "?":
            return str(int(self._motor_on))
        self._motor_on = True
        return None

    def _stop(self, _: str) -> None:
        self._homing = False
        self._world.stop_head()

    def _speed(self, value: str) -> str | None:
        if value == "?":
            return f"{self._deg_s:.{self._decimals}f}"
        deg_s = _number(value)
        if deg_s <= 0.0:
            raise _Mistake(facts.BAD_PARAMETER)
        if deg_s > self._most_deg_s * (1.0 + 1e-6):
            raise self._axis_mistake(facts.TOO_FAST)
        self._deg_s = deg_s
        return None


def _number(text: str) -> float:
    if not text:
        raise _Mistake(facts.PARAMETER_MISSING)
    if _NUMBER.fullmatch(text) is None:
        raise _Mistake(facts.BAD_PARAMETER)
    return float(text)


def _message(code: int) -> str:
    axis, of_axis = divmod(code, facts.AXIS_ERRORS)
    return f"AXIS-{axis} {facts.AXIS_MESSAGES[of_axis]}" if axis else facts.MESSAGES[code]
