"""The page on bringing an instrument: the folder that it shows is used as it is."""

import os
import random
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bench.config.devices.registry import devices
from drivers.chambers import ChamberLimits
from drivers.interfaces import BenchError
from sim.wires.session import DROP, SILENCE, WireFault
from tests.support.simulated_stand import a_world, served

PAGE = Path(__file__).parents[2] / "docs" / "writing-a-driver.md"
ROOT = PAGE.parent.parent
DEVICES = PAGE.parent / "examples"
LIMITS = ChamberLimits(-40.0, 85.0)
SEED = 7


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of devices that the page shows, without their tests."""
    made = tmp_path_factory.mktemp("my-devices")
    for name in ("frostline", "turnwell"):
        shutil.copytree(DEVICES / name, made / name, ignore=shutil.ignore_patterns("__pycache__"))
    return made


@pytest.fixture
def page(folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The classes of the folder, and the tests of the page; it is one of those that are searched."""
    monkeypatch.setenv("BENCH_DEVICES", str(folder))
    monkeypatch.syspath_prepend(str(DEVICES))
    device = devices().get("frostline")
    assert device is not None, devices().troubles
    names = {
        "FrostlineChamber": device.class_of("driver"),
        "Frostline7": device.class_of("simulation"),
    }
    for path in sorted((DEVICES / "tests").glob("test_*.py")):
        names |= runpy.run_path(str(path))
    return names


def test_the_page_is_short_and_names_what_exists() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 130
    shown = re.findall(r"^```\{literalinclude\} examples/(\S+)$", text, re.M)
    assert sorted(shown) == sorted(str(path.relative_to(DEVICES)) for path in DEVICES.glob("*/*.py"))
    for path in re.findall(r"`((?:bench|drivers|sim|tests)/[\w/]+\.py)`", text):
        assert (ROOT / path).is_file(), path


def test_the_pages_own_test_passes(page: dict[str, Any]) -> None:
    page["test_a_temperature_is_set_and_proved"]()


def test_the_pages_session_is_gone_through_again(
    page: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    page["test_a_session_of_a_34461a"]()


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


@pytest.mark.slow(9)
def test_it_passes_what_every_instrument_must_do(folder):
    suite = [sys.executable, "-m", "pytest", "tests/conformance", "-n", "0", "-k"]
    suite.append("frostline or turnwell or gustline or voltwerk or all_devices")
    folders = os.pathsep.join(map(str, (folder, ROOT / "tests" / "data" / "own-devices")))
    environment = {**os.environ, "BENCH_DEVICES": folders, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(suite, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)  # noqa: S603
    assert done.returncode == 0, done.stdout[-3000:]
    assert int(re.search(r"(\d+) passed", done.stdout)[1]) > 60
