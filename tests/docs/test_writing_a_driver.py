"""The pages of `docs`: what they show as code is run as it stands there."""

from __future__ import annotations

import random
import re
from pathlib import Path
from typing import Any

import pytest

from drivers.chambers import ChamberLimits
from drivers.interfaces import (
    BenchError,
    Identity,
    InstrumentLost,
    InstrumentRefused,
    LimitExceeded,
    ThermalChamber,
    VoltmeterSettings,
)
from drivers.keysight_34461a.driver import Keysight34461A
from drivers.wire.replay import replayed
from sim.wires.session import DROP, SILENCE, WireFault
from tests.support.scripted_session import ScriptedSession
from tests.support.simulated_stand import a_world, served

PAGE = Path(__file__).parents[2] / "docs" / "writing-a-driver.md"
ROOT = PAGE.parent.parent
LIMITS = ChamberLimits(-40.0, 85.0)
SEED = 7


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """The names that the page's code blocks define, each block carried out after the other."""
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 4
    names: dict[str, Any] = {
        **{"ScriptedSession": ScriptedSession, "__name__": "page", "Path": Path, "pytest": pytest},
        **{"replayed": replayed, "Keysight34461A": Keysight34461A},
        **{"VoltmeterSettings": VoltmeterSettings, "InstrumentLost": InstrumentLost},
    }
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)  # noqa: S102 - our own page
    return names


def test_the_page_is_short_and_names_what_exists() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 156
    for path in re.findall(r"`((?:bench|drivers|sim|tests)/[\w/]+\.py)`", text):
        assert (ROOT / path).is_file(), path


def test_the_pages_own_test_passes(page: dict[str, Any]) -> None:
    page["test_a_temperature_is_set_and_proved"]()


def test_the_pages_session_is_gone_through_again(
    page: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    page["test_a_session_of_a_34461a"]()


def test_the_driver_runs_against_the_simulated_chamber(page: dict[str, Any]) -> None:
    world = a_world()
    with served(page["Frostline7"](world), "chamber", world) as session:
        chamber = page["FrostlineChamber"]("chamber", session, world.clock, LIMITS)
        assert isinstance(chamber, ThermalChamber)
        assert chamber.open() == Identity("Frostline", "7")
        with pytest.raises(LimitExceeded):
            chamber.set_temperature(90.0, "1/temperature")
        chamber.set_temperature(40.0, "1/temperature")
        world.clock.sleep(3 * 3600.0)
        assert chamber.temperature("2/read") == pytest.approx(40.0, abs=0.05)
        assert world.chamber_c == pytest.approx(40.0, abs=0.05)
        assert chamber.make_safe() == ""
        world.clock.sleep(24 * 3600.0)
        assert world.chamber_c == pytest.approx(23.0, abs=0.1)
        chamber.close()
        chamber.close()


def test_the_driver_refuses_another_instrument_and_a_chamber_that_forgot(page: dict[str, Any]) -> None:
    world = a_world()
    dialect = page["Frostline7"](world)
    with served(dialect, "chamber", world) as session:
        chamber = page["FrostlineChamber"]("chamber", session, world.clock, LIMITS)
        chamber.open()
        chamber.set_temperature(40.0, "1/temperature")
        dialect.power_cycle()
        with pytest.raises(InstrumentRefused, match=r"set point is 23 °C, not the 40 °C"):
            chamber.temperature("2/read")
    other = ScriptedSession([("ID?", "ICEMAKER 7")])
    with pytest.raises(InstrumentRefused, match="ICEMAKER"):
        page["FrostlineChamber"]("chamber", other, other.clock, LIMITS).open()


def test_on_a_wire_that_fails_the_driver_tells_the_truth_or_why_not(page: dict[str, Any]) -> None:
    world = a_world()
    generator = random.Random(SEED)  # noqa: S311
    arrived = 0
    messages: list[str] = []

    def spoil(message: bytes, reply: bytes | None) -> WireFault | None:
        if generator.random() > 0.1:
            return None
        text = reply or b""
        twice = WireFault(lines=(text, text))
        return generator.choice((DROP, SILENCE, WireFault.cut(reply, 2), WireFault.garble(reply), twice))

    with served(page["Frostline7"](world), "chamber", world, fault=spoil, timeout_s=0.1) as session:
        chamber = page["FrostlineChamber"]("chamber", session, world.clock, LIMITS)
        for target_c in (40.0, -20.0, 10.0) * 5:
            try:
                chamber.open()
                chamber.set_temperature(target_c, "1/temperature")
                world.clock.sleep(3 * 3600.0)
                shown_c = chamber.temperature("2/read")
            except BenchError as error:
                messages.append(str(error))
                continue
            arrived += 1
            assert shown_c == pytest.approx(world.chamber_c, abs=0.06)
            assert shown_c == pytest.approx(target_c, abs=0.06)
        chamber.close()
    assert arrived >= 3
    assert messages
    assert all(message.startswith("chamber: ") for message in messages)
