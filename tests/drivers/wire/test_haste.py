"""Less patience once a person has asked twice to stop."""

import socket

import pytest

from drivers.clock import Haste
from drivers.interfaces import InstrumentLost
from tests.drivers.wire.test_visa import LONG_S, served, session


def test_in_haste_a_wait_that_is_under_way_is_cut_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.clock.HASTY_S", 0.05)
    monkeypatch.setattr("drivers.wire.visa._SLICE_S", 0.02)
    haste = Haste()

    def silent(connection: socket.socket, line: str) -> None:
        haste.asked = True

    with served(silent) as resource, session(resource, timeout_s=LONG_S, haste=haste) as meter:
        meter.open()
        with pytest.raises(InstrumentLost, match=r"did not answer \*IDN\? within 0.05 s"):
            meter.query("*IDN?")
