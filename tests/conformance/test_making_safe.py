"""Every command that makes an instrument safe fails in turn: the others are sent, and the operator is told.

The instrument refuses the command, or the wire is lost at it. The operator is told on the way out of a run.
"""

import re
from collections.abc import Callable
from typing import Any, get_args

import pytest

from bench.config.devices.device import Device
from bench.run.instruments import Instruments, leave_safe
from bench.run.power import Feeding, UnitPower
from drivers.instruments.manual import ManualHead
from drivers.interfaces import InstrumentLost
from sim.wires.faults import Fault, FaultKind
from tests.support.fed_bench import N15, P15
from tests.support.fed_runs import section_of
from tests.support.instrument_stand import Between, Stand, known, skip_if_own, standing, turned_by

MOVING = [*turned_by("motor"), *known("chamber"), *known("power_supply")]

BY_HAND = re.compile(r"by hand|by itself|emergency stop|at the controller")
NEVER_ALONE = {":mode:rate 1": ":demand:rate 1"}
"""What is not sent after another failed, for it would do harm: the rate mode without rate 0."""


UNANSWERED = ("LOCAL",)
"""What gives a front panel back has no reply by which a refusal shows."""


class Failing:
    """Makes one command fail, from when it is named: the instrument does not know it, or does not get it."""

    def __init__(self, how: str) -> None:
        self.how = how
        self.command = ""

    def __call__(self, dialect: Any) -> Between:
        failing = self

        class Faulty(Between):
            def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
                if not failing.command or failing.command != what(message.decode("latin-1")):
                    return super().handle(message, interrupted)
                if failing.how == "lost":
                    return None
                unknown = re.sub(rb"[A-Za-z]+", _other, message, count=1)
                return super().handle(unknown, interrupted)

        return Faulty(dialect)


def _other(word: re.Match[bytes]) -> bytes:
    """Return a word of the same length that no instrument knows; X stops some."""
    letter = b"Q" if set(word[0].upper()) == set(b"X") else b"X"
    return letter * len(word[0])


def interfaces(device: Device) -> tuple[str, ...]:
    """Return what an instrument can be set to, where its bench file says to what it is."""
    field = device.section.model_fields.get("interface")
    return get_args(field.annotation) if field else ()


def what(message: str) -> str:
    """Return a message without the address and number that a Zaber's has."""
    return re.sub(r"^/\d+ \d+ \d\d ", "", message)


def commands(sent: list[str]) -> list[str]:
    """Return what was commanded of what was sent: questions are none."""
    return [what(text) for text in sent if not text.partition(";")[0].partition(" ")[0].endswith("?")]


def begun(stand: Stand) -> Instruments:
    """Have the instrument do what must not go on; return the bench on which it is left."""
    driver, world = stand.driver, stand.world
    driver.open()
    head = ManualHead("head", None, tolerance_rad=1.0)  # type: ignore[arg-type]
    if stand.device.role == "head":
        driver.move(0.5, 1, "1/turn")
        world.move_head(3.0, 0.01)
        return Instruments((), driver, opened={driver.name})
    if stand.device.role == "chamber":
        driver.set_temperature(60.0, "1/temperature")
        return Instruments((), head, chamber=driver, opened={driver.name})
    return Instruments((), head, power_supply=driver, opened={driver.name})


def feeding(stand: Stand) -> UnitPower | None:
    """Feed the block from every output that can give it 5 V, where the instrument is a supply."""
    if stand.device.role != "power_supply":
        return None
    rails = []
    for output, limits in stand.section.limits.outputs.items():
        volts = 5.0 if limits.voltage_v[1] >= 5.0 else -5.0
        of_sign = P15 if volts > 0 else N15
        protected = {"over_voltage": f"{1.1 * volts:g} V"} if limits.over_voltage_v else {}
        rails.append(
            {
                **of_sign,
                "name": f"r{output}".lower(),
                "output": output,
                "voltage": f"{volts:g} V",
                **protected,
            }
            | {"current": {"minimum": "0 A", "maximum": "1 A"}, "current_limit": "150 mA"}
        )
    fed = Feeding(section_of(rails=rails), stand.section.limits)
    clock = stand.world.clock
    power = UnitPower(stand.driver, fed, None, clock, clock.now_s, lambda: None, lambda kind, data: None)  # type: ignore[arg-type]
    power.have_on("1/power")
    return power


def is_safe(stand: Stand) -> bool:
    if stand.device.role == "head":
        return stand.world.head_rate_rad_s == 0.0
    if stand.device.role == "power_supply":
        now_s = stand.world.clock.now_s()
        return not any(stand.world.power.stage(output, now_s).on for output in stand.driver.outputs)
    return True


def left(stand: Stand, failing: Failing | None = None, command: str = "") -> tuple[list[str], str]:
    """Leave the instrument safe, with a command failing; return what was commanded, and what a person is told."""
    instruments = begun(stand)
    power = feeding(stand)
    stand.sent.clear()
    if failing is not None:
        failing.command = command
        if failing.how == "lost":
            stand.served.arm(Fault(FaultKind.DROP, matching=command, instrument=stand.driver.name))
    told = leave_safe(instruments, 60.0, power)
    return commands(stand.sent), told.get(stand.driver.name, "")


@pytest.mark.slow
@pytest.mark.parametrize("how", ["refused", "lost"])
@pytest.mark.parametrize("device", MOVING, ids=lambda device: device.name)
def test_each_command_that_makes_safe_fails_in_turn(device, tmp_path, how):
    with standing(device, tmp_path) as stand:
        well, told = left(stand)
        assert told == ""
        assert is_safe(stand)
    assert well
    for command in dict.fromkeys(one for one in well if one not in UNANSWERED):
        failing = Failing(how)
        with standing(device, tmp_path, failing) as stand:
            sent, told = left(stand, failing, command)
            unsent = {other for other in well if other not in sent}
            assert all(command.startswith(NEVER_ALONE.get(other, "?")) for other in unsent), (command, unsent)
            assert BY_HAND.search(told), (command, told)
            if len(set(well)) > 1:
                assert is_safe(stand), command


@pytest.mark.parametrize("device", turned_by("motor"), ids=lambda device: device.name)
def test_a_stop_over_a_new_connection_is_sent_before_the_instrument_is_proved(device, tmp_path):
    first = []
    for reconnected in (False, True):
        with standing(device, tmp_path) as stand:
            begun(stand)
            if reconnected:
                stand.session.close()
                stand.session.open()
            stand.sent.clear()
            stand.driver.stop()
            first.append(what(stand.sent[0]))
            assert is_safe(stand)
    assert first[0] == first[1]


LOCKED = [
    d
    for role in ("voltmeter", "thermometer", "power_supply")
    for d in known(role)
    if "rs232" in interfaces(d)
]


@pytest.mark.parametrize("device", LOCKED, ids=lambda device: device.name)
def test_a_front_panel_that_was_not_given_back_is_told(device, tmp_path):
    with standing(device, tmp_path, interface="rs232") as stand:
        stand.driver.open()
        tried = []

        def write(command):
            tried.append(command)
            raise InstrumentLost(stand.driver.name, "it is gone", "check the cable")

        stand.session.write = write
        said = stand.driver.close()
        if not tried:
            skip_if_own(device, "it sends nothing when it is closed")
        assert said == "its front panel stays in remote: press its local key. Cause: it is gone"
