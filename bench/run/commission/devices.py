"""Checks of the head, the chamber, the level, the thermometer and the power supply."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol, runtime_checkable

from bench.base.arrays import ARCSEC
from bench.base.languages import message
from bench.base.text import APPROACH, degrees
from bench.config.devices.sections import ChamberForm, HeadForm, MotorisedHeadForm, SupplyForm
from bench.run.commission.session import CheckEnded, CommissioningSession, Figure, Finding, State
from bench.run.driver_checks import checked_temperature
from drivers.angles import format_dms
from drivers.interfaces import (
    BenchError,
    Direction,
    DividingHead,
    Inclination,
    Instrument,
    Level,
    LimitExceeded,
    OutputSettings,
    PowerSupply,
    ThermalChamber,
    Thermometer,
)
from drivers.making_safe import SEE_IT_STANDS, Attempts

LIMITS: Final = message("limits", "heading")
MOVE: Final = message("small move")
STOP: Final = message("stop", "heading")

BEYOND_K: Final = 1.0
BEYOND_V: Final = 1.0
"""How far test demands exceed the limits of chamber (K) and supply (V)."""
WAY_IN_BACKOFFS: Final = 2.0
"""Length of a small move, in multiples of the backoff; the head then approaches its target without overshoot."""
STOPPED_AFTER_S: Final = 1.0
"""Intended time from the start of the motion to the stop, s; the stop is half way to the target."""
TIME_MARGIN: Final = 2.0
TIME_MARGIN_S: Final = 2.0
"""A move may last its nominal time times `TIME_MARGIN`, plus this time, s: acceleration, braking, polling."""
MANUAL_WAY_RAD: Final = math.radians(5.0)
_MOST_LOOKS: Final = 40
_LOOK_S: Final = 0.25


@runtime_checkable
class Motor(Protocol):
    """A motorised head that can be stopped during a move (`drivers.motion.Axis`); angles in rad."""

    name: str

    def prepare(self) -> None:
        """Make the axis ready to move."""
        ...

    def position_rad(self) -> float:
        """Return the angle read back."""
        ...

    def start(self, target_rad: float) -> None:
        """Start a motion to an angle, without waiting for its end."""
        ...

    def stop(self) -> None:
        """Stop the motion at the present angle."""
        ...


# --- limits -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Beyond:
    """Demands that exceed the limits of an instrument, each with a phrase that describes the demand.

    `within` describes the permitted range.
    """

    instrument: Instrument
    within: str
    demands: Sequence[tuple[str, Callable[[], object]]]


def check_limits(evening: CommissioningSession) -> None:
    """Make demands beyond the limits of head, chamber and power supply; each must be refused.

    The instruments are not connected yet, so a demand that is not refused cannot be sent.
    """
    for beyond in _beyond(evening):
        evening.carry_out(LIMITS, beyond.instrument, partial(_refused, beyond), opened=False)


def _beyond(evening: CommissioningSession) -> Iterator[Beyond]:
    head, chamber = evening.instruments.head, evening.instruments.chamber
    supply = evening.instruments.power_supply
    form = evening.section(head.name)
    if isinstance(form, MotorisedHeadForm):
        ways: tuple[tuple[float, Direction], ...] = (
            (form.minimum - form.backoff, -1),
            (form.maximum + form.backoff, 1),
            (form.minimum, 1),  # the approach to the limit would begin outside the limits
            (form.maximum, -1),
        )
        yield Beyond(
            head,
            f"{degrees(form.minimum)} to {degrees(form.maximum)}",
            [
                (f"{degrees(rad)}, {APPROACH[side]},", partial(head.move, rad, side, "commission"))
                for rad, side in ways
            ],
        )
    if chamber is not None and isinstance(form := evening.section(chamber.name), ChamberForm):
        yield Beyond(
            chamber,
            f"{form.minimum:g} to {form.maximum:g} °C",
            [
                (f"{c:g} °C", partial(chamber.set_temperature, c, "commission/limits"))
                for c in (form.minimum - BEYOND_K, form.maximum + BEYOND_K)
            ],
        )
    if supply is not None and isinstance(form := evening.section(supply.name), SupplyForm) and form.limits:
        outputs = form.limits.outputs
        demands = []
        for output, limit in outputs.items():
            far_v = max(limit.voltage_v, key=abs)
            settings = OutputSettings(far_v + math.copysign(BEYOND_V, far_v), limit.current_a[0])
            set_up = partial(supply.set_up, {output: settings}, "commission/limits")
            demands.append((f"{settings.voltage_v:g} V on output {output}", set_up))
        yield Beyond(supply, f"the limits of {', '.join(outputs)}", demands)


def _refused(beyond: Beyond) -> Finding:
    for what, demand in beyond.demands:
        refuse_or_say(beyond.instrument.name, what, demand)
    said = f"a demand beyond {beyond.within} is refused before it is sent"
    return Finding(LIMITS, beyond.instrument.name, State.WORKS, said)


def refuse_or_say(name: str, what: str, demand: Callable[[], object]) -> None:
    """Make a demand that must be refused; even an accepted one has no effect on the unconnected instrument.

    `what` describes the demand in the finding. Raises `CheckEnded` if the demand is not refused as beyond the
    limits.
    """
    try:
        demand()
    except LimitExceeded:
        return
    except BenchError as error:
        said = f"{what} was refused only after it was sent ({error.cause})"
    else:
        said = f"{what} was not refused"
    remedy = "do not use it: its driver ignores the limits of the bench file"
    raise CheckEnded(Finding(LIMITS, name, State.OTHER, said, remedy=remedy))


# --- moves ------------------------------------------------------------------------------------------


def check_moves(evening: CommissioningSession) -> None:
    """Turn the head a little both ways, and stop it once during a move; the person confirms before each move."""
    head = evening.instruments.head
    form = evening.section(head.name)
    if isinstance(form, MotorisedHeadForm) and isinstance(head, Motor):
        _with_motor(evening, head, head, form)
    else:
        _by_hand(evening, head)


def _with_motor(
    evening: CommissioningSession, head: DividingHead, motor: Motor, form: MotorisedHeadForm
) -> None:
    angles_rad: list[float] = []

    def stand() -> Finding:
        angles_rad.append(_within(form, motor.position_rad()))
        return Finding("position", head.name, State.WORKS, f"angles_rad at {degrees(angles_rad[0])}")

    evening.carry_out("position", head, stand)
    if not angles_rad:
        return
    here_rad, way_rad = angles_rad[0], WAY_IN_BACKOFFS * form.backoff
    side: Direction = 1 if here_rad + way_rad + form.backoff <= form.maximum else -1
    there_rad = here_rad + side * way_rad
    back: Direction = -1 if side > 0 else 1
    away = evening.carry_out(MOVE, head, partial(_moved, evening, head, form, here_rad, there_rad, side))
    if away.state is State.SKIPPED:
        return
    if away.state in (State.WORKS, State.SLOWER):
        evening.carry_out(STOP, head, partial(_stopped, evening, motor, form, there_rad, side))
    evening.carry_out(MOVE, head, partial(_moved, evening, head, form, None, here_rad, back))


def _within(form: MotorisedHeadForm, angle_rad: float) -> float:
    """Return the head's angle `angle_rad`, or the nearest limit if the angle exceeds it by at most the tolerance.

    Raises `CheckEnded` for a head outside its limits, or without room for a small move.
    """
    low_rad, high_rad = form.minimum, form.maximum
    room_rad = (WAY_IN_BACKOFFS + 1.0) * form.backoff
    said = ""
    if not low_rad - form.tolerance <= angle_rad <= high_rad + form.tolerance:
        said = (
            f"stands at {degrees(angle_rad)}, outside its limits, {degrees(low_rad)} to {degrees(high_rad)}"
        )
        remedy = "bring it back within them by hand, minding the cables; check its zero in the bench file"
    elif high_rad - low_rad < room_rad or max(high_rad - angle_rad, angle_rad - low_rad) < room_rad:
        said = f"stands at {degrees(angle_rad)}, with no room for a move of {degrees(room_rad)}"
        remedy = "turn it by hand to the middle of its limits, or widen these"
    if said:
        raise CheckEnded(Finding("position", form.name, State.OTHER, said, remedy=remedy))
    return min(max(angle_rad, low_rad), high_rad)


def _moved(
    evening: CommissioningSession,
    head: DividingHead,
    form: MotorisedHeadForm,
    from_rad: float | None,
    target_rad: float,
    direction: Direction,
) -> Finding:
    """Move the head after the person has confirmed that its path is clear; return the finding."""
    first = ""
    if from_rad is not None and getattr(form, "allow_homing", False):
        first = " It may first turn to its reference, even beyond its limits, as the bench file allows."
    evening.confirm(
        f"The head will turn to {degrees(target_rad)} with the angle {APPROACH[direction]}, at "
        f"{degrees(form.speed)} a second.{first} Is the way clear, and do all cables hang free?",
        action={"do": "stand_clear"},
    )
    start_rad = from_rad
    if start_rad is None:
        start_rad = head.position_rad() if isinstance(head, Motor) else math.nan
    begun_s = evening.time_s()
    position = head.move(target_rad, direction, "commission")
    took_s = evening.time_s() - begun_s
    least_s = abs(target_rad - start_rad) / form.speed + form.settle
    off_rad = position.angle_rad - target_rad
    figures = (
        Figure(
            "distance from the target",
            math.degrees(off_rad) * 3600.0,
            "″",
            f"±{format_dms(form.tolerance, 1)}",
        ),
        Figure("took", took_s, "s", f"{least_s:.2g} s by its speed and settling"),
    )
    said = f"came to {degrees(target_rad)}, {APPROACH[direction]}"
    if took_s <= TIME_MARGIN * (least_s - form.settle) + form.settle + TIME_MARGIN_S:
        return Finding(MOVE, head.name, State.WORKS, said, figures)
    return Finding(
        MOVE, head.name, State.SLOWER, f"{said}, in {took_s:.2g} s, not {least_s:.2g} s", figures,
        "check its speed in the bench file and in the controller, and its load",
    )  # fmt: skip


def _stopped(
    evening: CommissioningSession, motor: Motor, form: MotorisedHeadForm, here_rad: float, side: Direction
) -> Finding:
    """Start the head and stop it half way; return the finding. After an error, try to stop the head again."""
    room_rad = (form.maximum - here_rad) if side > 0 else (here_rad - form.minimum)
    way_rad = min(max(2.0 * STOPPED_AFTER_S * form.speed, form.backoff), room_rad)
    target_rad = here_rad + side * way_rad
    evening.confirm(
        f"The head will start from {degrees(here_rad)} towards {degrees(target_rad)}; the program stops it "
        "half way. Is the way clear, and your hand at the emergency stop?",
        action={"do": "stand_clear"},
    )
    try:
        motor.prepare()
        motor.start(target_rad)
        evening.clock.sleep(0.5 * way_rad / form.speed)
        told_s = evening.time_s()
        motor.stop()
    except BaseException as error:
        attempts = Attempts()
        if not attempts.make(f"{form.name}: {SEE_IT_STANDS}", motor.stop):
            error.add_note(attempts.end())
        raise
    rest_rad = _at_rest(evening, motor, form)
    took_s = evening.time_s() - told_s
    left_rad = side * (target_rad - rest_rad)
    figures = (
        Figure("stood still after", took_s, "s"),
        Figure("went", math.degrees(side * (rest_rad - here_rad)), "°", f"of {degrees(way_rad)}"),
    )
    if left_rad > form.tolerance and side * (rest_rad - here_rad) > form.tolerance:
        said = f"stopped at {degrees(rest_rad)}, on its way to {degrees(target_rad)}"
        return Finding(STOP, form.name, State.WORKS, said, figures)
    if left_rad > form.tolerance:
        said, remedy = "had not yet moved when it was stopped", "check its load, its motor and its speed"
    else:
        said = f"was commanded to stop half way but continued to {degrees(rest_rad)}"
        remedy = "do not use it until its stop works; use the emergency stop meanwhile"
    return Finding(STOP, form.name, State.OTHER, said, figures, remedy)


def _at_rest(evening: CommissioningSession, motor: Motor, form: MotorisedHeadForm) -> float:
    """Return the angle once two successive readings agree. Raises `CheckEnded` if the head keeps turning."""
    before_rad = motor.position_rad()
    for _ in range(_MOST_LOOKS):
        evening.clock.sleep(_LOOK_S)
        angle_rad = motor.position_rad()
        if abs(angle_rad - before_rad) <= form.tolerance:
            return angle_rad
        before_rad = angle_rad
        if not form.minimum <= angle_rad <= form.maximum:
            break
    with contextlib.suppress(Exception):
        motor.stop()
    said = f"still turns after a stop command, at {degrees(before_rad)}"
    raise CheckEnded(
        Finding(STOP, form.name, State.OTHER, said, remedy="press the emergency stop; have the head repaired")
    )


def _by_hand(evening: CommissioningSession, head: DividingHead) -> None:
    """Ask the person to turn the head a little both ways and to type the angles read from its scale."""
    ways: tuple[tuple[float, Direction], ...] = ((2.0 * MANUAL_WAY_RAD, 1), (MANUAL_WAY_RAD, -1))
    for number, (target_rad, direction) in enumerate(ways, start=1):
        evening.carry_out(MOVE, head, partial(_turned, head, target_rad, direction, number))


def _turned(head: DividingHead, target_rad: float, direction: Direction, number: int) -> Finding:
    position = head.move(target_rad, direction, f"commission/head-{number}")
    off = Figure("distance from the target", math.degrees(position.angle_rad - target_rad) * 3600.0, "″")
    said = f"was turned to {degrees(target_rad)}, {APPROACH[direction]}, and read"
    return Finding(MOVE, head.name, State.WORKS, said, (off,))


READ: Final = message("temperature", "heading")
STANDBY: Final = message("standby", "heading")


def check_standby(evening: CommissioningSession, chamber: ThermalChamber) -> None:
    """Read the chamber and put it into standby."""
    by_hand = evening.section(chamber.name).by_hand
    evening.carry_out(READ, chamber, partial(_read_temperature, chamber, by_hand))
    evening.carry_out(STANDBY, chamber, partial(_standby, evening, chamber, by_hand))


def _read_temperature(chamber: ThermalChamber, by_hand: bool) -> Finding:
    air_c = chamber.temperature("commission/temperature", settling=True)
    air_c = checked_temperature(chamber, "temperature", air_c)
    said = "was read on its thermometer" if by_hand else "shows the temperature of its air"
    return Finding(READ, chamber.name, State.WORKS, said, (Figure("temperature", air_c, "°C"),))


def _standby(evening: CommissioningSession, chamber: ThermalChamber, by_hand: bool) -> Finding:
    if by_hand:
        evening.confirm(
            "Switch the chamber to standby. Is it in standby?", action={"do": "answer"}, default="yes"
        )
        return Finding(STANDBY, chamber.name, State.WORKS, "was put into standby by hand")
    evening.confirm(
        "The program will stop the chamber and put it into standby. May it?", action={"do": "stand_clear"}
    )
    to_do = chamber.make_safe()
    if to_do:
        return Finding(
            STANDBY, chamber.name, State.OTHER, "can be put into standby only by hand", remedy=to_do
        )
    return Finding(STANDBY, chamber.name, State.WORKS, "stopped conditioning, and its driver read that back")


REVERSED: Final = message("half a turn")
BLOCK: Final = message("temperature of the block")
METERS: Final = message("temperature of the voltmeters")
ROOM: Final = message("temperature of the room")


def check_level(evening: CommissioningSession, level: Level) -> None:
    """Read the level in two positions half a turn apart, to determine its zero and the platform's tilt."""
    head = evening.instruments.head
    evening.carry_out(REVERSED, level, partial(_reversed, evening, level), also=[head])


def _reversed(evening: CommissioningSession, level: Level) -> Finding:
    form = evening.section(evening.instruments.head.name)
    if not (isinstance(form, HeadForm) and form.turned_by_hand):
        evening.confirm("The head will turn to 0°. Is the way clear?", action={"do": "stand_clear"})
    evening.instruments.head.move(0.0, 1, "commission/level")
    first = _read_platform(evening, level, turned=False)
    second = _read_platform(evening, level, turned=True)
    pairs = (("along", first.along_rad, second.along_rad), ("across", first.across_rad, second.across_rad))
    u = level.sizes.reading_rad / ARCSEC
    figures = [Figure(f"its zero {axis}", (a + b) / 2.0 / ARCSEC, "arcsec") for axis, a, b in pairs]
    figures += [
        Figure(f"the platform {axis}", (a - b) / 2.0 / ARCSEC, "arcsec", f"a reading has u of {u:.2g} arcsec")
        for axis, a, b in pairs
    ]
    said = "was read in both positions: its own zero cancels in half the difference"
    return Finding(REVERSED, level.name, State.WORKS, said, tuple(figures))


def _read_platform(evening: CommissioningSession, level: Level, *, turned: bool) -> Inclination:
    if not level.asks_person:
        how = "half a turn from its first position" if turned else "in its first position, along the shaft"
        evening.confirm(
            f"Put the level on the platform {how}. Is it there?",
            default="yes",
            action={"do": "place_level", "turned": turned},
        )
    return level.inclination(f"commission/level{int(turned)}", turned=turned)


def check_thermometer(evening: CommissioningSession) -> None:
    """Read the thermometers at the block, at the voltmeters and in the room."""
    around = {"meter_temperature_c": METERS, "room_c": ROOM}
    at = {BLOCK: evening.instruments.thermometer}
    at |= {around[c]: by for c, by in evening.instruments.around.items() if by != "chamber"}
    for place, thermometer in at.items():
        if thermometer is not None:
            evening.carry_out(place, thermometer, partial(_temperature, place, thermometer))


def _temperature(place: str, thermometer: Thermometer) -> Finding:
    shown_c = checked_temperature(thermometer, "block_c", thermometer.block_c("commission/temperature"))
    figures = (Figure("temperature", shown_c, "°C"),)
    return Finding(place, thermometer.name, State.WORKS, f"shows it ({thermometer.sensor})", figures)


OUTPUTS: Final = message("outputs", "heading")


def check_outputs(evening: CommissioningSession, supply: PowerSupply) -> None:
    """Read the state of every output of the power supply."""
    evening.carry_out(OUTPUTS, supply, partial(_read_outputs, supply))


def _read_outputs(supply: PowerSupply) -> Finding:
    states = supply.state("commission/outputs")
    if not states:
        return Finding(OUTPUTS, supply.name, State.WORKS, "is read by hand after it is set up")
    said = ", ".join(
        f"{output} {'on' if state.on else 'off'}, set to {state.settings}" for output, state in states.items()
    )
    figures = tuple(Figure(f"output {output}", state.voltage_v, "V") for output, state in states.items())
    return Finding(OUTPUTS, supply.name, State.WORKS, f"shows its outputs: {said}", figures)
