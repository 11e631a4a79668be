"""The dialogue of the manual: pairs of what is sent and answered."""

from frostline.driver import FrostlineChamber

from drivers.chambers import ChamberLimits
from drivers.interfaces import Identity
from tests.support.scripted_session import ScriptedSession


def test_a_temperature_is_set_and_proved():
    session = ScriptedSession([
        ("ID?", "FROSTLINE 7 1.42"),
        ("SET 40.0", None), ("SET?", "40.0"), ("RUN 1", None), ("RUN?", "1"),
        ("SET?", "40.0"), ("AIR?", "39.8"),
    ])  # fmt: skip
    chamber = FrostlineChamber("chamber", session, session.clock, ChamberLimits(-40.0, 85.0))
    assert chamber.open() == Identity("Frostline", "7")
    chamber.set_temperature(40.0, "1/temperature")
    assert chamber.temperature("2/read") == 39.8
    assert session.left == []
