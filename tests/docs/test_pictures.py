"""Pictures are made by the build: each stands on a page, and what they draw is the model's."""

import re

import numpy as np
import pytest

from bench.config.bench_file.file import load_bench
from bench.config.shipped import CONFIG, shipped_folder
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from docs.generators import drawings, panel_pictures, screens, terminal
from docs.generators.pictures import DRAWINGS, TAKEN
from docs.generators.workbench import COMMANDS
from tests.support import browsers
from tests.support.pages import pages

SHOWN = re.compile(r"^`{3}\{picture\} (\S+)$", re.M)


def test_every_picture_stands_on_a_page_and_every_page_names_pictures_that_are_made():
    shown = {name for page in pages() for name in SHOWN.findall(page.read_text(encoding="utf-8"))}
    assert shown == DRAWINGS.keys() | TAKEN.keys()


def test_every_picture_has_words_for_those_who_do_not_see_it():
    for name, words in {**TAKEN, **{name: words for name, (_, words) in DRAWINGS.items()}}.items():
        assert len(words.split()) >= 8, name


@pytest.mark.parametrize("installation", [INSTALLATION_1, INSTALLATION_2, drawings.verification()])
@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 180.0, 270.0])
def test_the_table_below_the_mountings_says_which_axis_points_up(installation, angle_deg):
    """An axis of the block that points up at an angle of the head feels +1 g; here by turning vectors by hand."""
    turned = np.radians(angle_deg)
    up_on_platform = np.array([np.sin(turned), 0.0, np.cos(turned)])
    expected = [float(axis @ up_on_platform) for axis in installation.block_from_platform]
    assert drawings.forces(installation, angle_deg) == pytest.approx(expected, abs=1e-12)


def test_the_wiring_is_that_of_the_shipped_bench_file():
    bench = load_bench(shipped_folder(CONFIG) / "bench-stand.yaml")
    drawn = drawings.wiring("words")
    wires = [meter.resource for meter in bench.instruments.voltmeters]
    for text in (*wires, bench.instruments.power_supply.resource, "voltmeter z", "output 2: n15"):
        assert text in drawn


def test_the_stand_has_eleven_parts_with_their_keys():
    parts = drawings.parts_of_the_page()
    assert [*parts] == [*range(1, 12)] == [*drawings.PARTS]
    assert parts[9] == ("platform", "stand: zero_offset")


def test_a_session_shows_commands_that_the_build_carries_out():
    assert {command for command, _ in terminal.SESSION} <= set(COMMANDS)


@pytest.mark.parametrize(
    ("module", "write"),
    [(screens, screens.write_screens), (panel_pictures, panel_pictures.write_pictures)],
    ids=["screens", "panel"],
)
def test_without_a_browser_the_build_says_so_and_takes_none(module, write, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(browsers, "what_is_missing", lambda: "there is no Chromium")
    write(tmp_path / "pictures")
    assert "there is no Chromium" in capsys.readouterr().err
    assert not (tmp_path / "pictures").exists()
