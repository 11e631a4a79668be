"""What chambers share, and attempts to make an instrument safe."""

import math

import pytest

from drivers.chambers import ChamberLimits, refuse_other_set_point
from drivers.interfaces import BadReading, InstrumentLost, InstrumentRefused, LimitExceeded
from drivers.making_safe import Attempts

LIMITS = ChamberLimits(-40.0, 85.0, band_c=2.0)


@pytest.mark.parametrize("target_c", [-40.1, 85.1, math.nan, math.inf])
def test_a_demand_outside_the_limits(target_c: float) -> None:
    with pytest.raises(LimitExceeded, match="outside -40 to 85 °C"):
        LIMITS.check("chamber", target_c)


def test_demands_at_the_limits_pass() -> None:
    for target_c in (-40.0, 85.0):
        LIMITS.check("chamber", target_c)


def test_band_and_plausibility() -> None:
    assert LIMITS.in_band("chamber", 61.9, 60.0) == 61.9
    assert LIMITS.in_band("chamber", 23.0, None) == 23.0
    assert ChamberLimits(-40.0, 85.0).in_band("chamber", 23.0, 60.0) == 23.0
    with pytest.raises(InstrumentRefused, match=r"the air is at 57\.9 °C, more than 2 °C from the 60 °C"):
        LIMITS.in_band("chamber", 57.9, 60.0)
    with pytest.raises(BadReading, match="not plausible"):
        LIMITS.in_band("chamber", 999.9, None)


def test_a_set_point_may_differ_by_rounding_only() -> None:
    refuse_other_set_point("chamber", 25.0, 25.05, 0.1)
    with pytest.raises(InstrumentRefused, match=r"set point is 25 °C, not the 25\.1 °C demanded"):
        refuse_other_set_point("chamber", 25.0, 25.1, 0.1)
    with pytest.raises(InstrumentRefused, match="its set point is nan"):
        refuse_other_set_point("chamber", float("nan"), 25.0, 0.1)


@pytest.mark.parametrize(("low", "high", "band"), [(10.0, 10.0, None), (0.0, 50.0, 0.0)])
def test_limits_that_cannot_be_are_refused(low: float, high: float, band: float | None) -> None:
    with pytest.raises(ValueError, match="the chamber"):
        ChamberLimits(low, high, band)


def _lose() -> None:
    raise InstrumentLost("head", "no reply", "look at the cable")


def test_a_task_that_is_left_is_no_failure() -> None:
    attempts = Attempts()
    assert attempts.make("by hand", lambda: "press its local key")
    attempts.refuse_failed("head", "it did not stop", "stop it")
    assert attempts.end() == "press its local key"


def test_what_failed_is_raised_with_its_cause_beside_a_task_that_is_left() -> None:
    attempts = Attempts()
    attempts.make("by hand", lambda: "press its local key")
    attempts.make("by hand", _lose)
    with pytest.raises(InstrumentLost, match="it did not stop: no reply"):
        attempts.refuse_failed("head", "it did not stop", "stop it")
