"""Attempts to make an instrument safe: what failed is raised, what is left for a person is told."""

import pytest

from drivers.interfaces import InstrumentLost
from drivers.making_safe import Attempts


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
