"""A recorded session of a real meter, repeated."""

from pathlib import Path

import pytest

from drivers.instruments.keysight_34461a import Keysight34461A
from drivers.interfaces import InstrumentLost, VoltmeterSettings
from drivers.wire.replay import replayed


def test_a_session_of_a_34461a():
    with replayed(Path("tests/data/session-wire.log"), "voltmeter.x") as (session, clock):
        meter = Keysight34461A("voltmeter.x", "x", session, clock)
        assert meter.open().model == "34461A"
        meter.configure(VoltmeterSettings(range_v=10.0, nplc=1.0, samples=2))
        meter.start()
        assert meter.fetch() == {"x": (-0.00024, -0.00021)}
        meter.start()
        with pytest.raises(InstrumentLost, match="did not answer"):
            meter.fetch()
        clock.catch_up()  # what others did until the driver was called again
        meter.start()
        assert meter.fetch() == {"x": (-0.37197, -0.37194)}
