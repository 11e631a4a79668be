"""The site: its parts made from the code, from stored results and by generators of pictures; its anchors."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from bench.config.bench_file.file import load_bench
from bench.config.shipped import CONFIG, shipped_folder
from bench.model import CATALOGUE
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from benchmarks.blind_trial import page as trial_page
from benchmarks.blind_trial import run
from benchmarks.blind_trial.run import FULL
from docs.generators import PAGES, drawings, gallery, measured, panel_pictures, screens, terminal
from docs.generators.anchors import earlier_anchors, moved
from docs.generators.finishing import ADDED, finish
from docs.generators.gallery import Cell, cells_of
from docs.generators.pictures import DRAWINGS, TAKEN
from docs.generators.workbench import COMMANDS
from tests.support import browsers
from tests.support.pages import DOCS, ROOT, pages

MEASURED_BY = [command for one in measured.stored() for command in one["commands"]]


def test_a_page_gets_what_the_theme_leaves_out_once(tmp_path):
    page = tmp_path / "folder" / "page.html"
    page.parent.mkdir()
    page.write_text("".join(ADDED), encoding="utf-8")
    finish(tmp_path)
    assert page.read_text(encoding="utf-8") == "".join(ADDED.values())
    finish(tmp_path)
    assert page.read_text(encoding="utf-8") == "".join(ADDED.values())


@pytest.mark.parametrize("command", MEASURED_BY)
def test_the_command_of_a_table_is_a_benchmark_with_these_options(command):
    name, *words = command.split()
    files = [*ROOT.glob(f"benchmarks/{name}.py"), *ROOT.glob(f"benchmarks/{name}/*.py")]
    text = "".join(file.read_text(encoding="utf-8") for file in files)
    assert text
    for option in (word for word in words if word.startswith("--")):
        name = option.removeprefix("--")
        assert re.search(rf"--{name}\b|\b{name.replace('-', '_')}\b", text), option


def test_every_table_belongs_to_a_page_that_is_there_and_has_a_cell_for_each_column():
    for one in measured.stored():
        assert (ROOT / "docs" / one["page"]).is_file()
        assert all(len(row) == len(one["columns"]) for row in one.get("rows", []))


PAGE = (Path(__file__).parents[2] / "docs" / "stand.md").read_text(encoding="utf-8")
ROWS = [line.strip("|").split("|") for line in PAGE.splitlines() if re.match(r"\| \d+ \|", line)]


def test_both_tables_have_the_eleven_parts_in_their_order():
    assert [int(row[0]) for row in ROWS] == 2 * list(range(1, 12))


def test_every_effect_of_the_catalogue_shows_on_a_part():
    assert set(re.findall(r"`(\w+)`", PAGES["_parts.md"]())) == CATALOGUE.keys()


EARLIER = ROOT / "tests" / "data" / "earlier-headings.tsv"
"""Page and heading of each heading of an edition that was public, the first three levels."""


def headings(page):
    text = re.sub(r"^```.*?^```$", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.M | re.S)
    return {line.lstrip("# ") for line in text.splitlines() if line.startswith("#")}


def test_every_earlier_heading_is_there_or_has_moved_to_one_that_is():
    lost = []
    for line in EARLIER.read_text(encoding="utf-8").splitlines():
        page, heading = line.split("\t")
        there = headings(page)
        if heading not in there and moved().get(page, {}).get(heading) not in there:
            lost.append(line)
    assert lost == []


def test_what_has_moved_is_no_heading_any_more():
    for page, names in moved().items():
        assert not names.keys() & headings(page), page


def test_a_heading_keeps_the_anchors_of_its_own_and_of_earlier_titles():
    expected = ["8-results", "verify-another-day", "9-verify-another-day"]
    assert earlier_anchors("real-bench.md", "8. Results") == expected


def test_a_page_is_cut_into_texts_and_blocks():
    assert cells_of("# T\n\nA text.\n\n```python\nx = 1\n```\n\n```console\n$ bench runs\n```\n") == [
        Cell("text", "# T\n\nA text."),
        Cell("python", "x = 1"),
        Cell("console", "$ bench runs"),
    ]


def test_the_page_has_each_example_under_its_title():
    page = (DOCS / "gallery.md").read_text(encoding="utf-8")
    for name in gallery.NAMES:
        title, *_ = (gallery.SOURCES / f"{name}.md").read_text(encoding="utf-8").splitlines()
        assert f"#{title}\n\n```{{include}} reference/_gallery-{name}.md\n" in page
    assert {path.stem for path in gallery.SOURCES.glob("*.md")} == set(gallery.NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["calibrate-a-dataframe", "budget-for-my-head"])
def test_an_example_runs_and_its_notebook_has_the_same_cells(name, tmp_path):
    cells = gallery.carried_out(name)
    assert all(cell.printed or cell.figures for cell in cells if cell.kind != "text")
    book = json.loads(json.dumps(gallery.notebook(name)))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    sources = ["".join(cell["source"]) for cell in book["cells"]]
    assert [source.replace("!bench", "$ bench") for source in sources] == [cell.text for cell in cells]
    printed = ["".join(out.get("text", "")) for cell in book["cells"] for out in cell.get("outputs", [])]
    assert [text for text in printed if text] == [cell.printed for cell in cells if cell.printed]
    assert str(tmp_path.parent) not in "".join(printed)


@pytest.fixture(scope="module")
def result():
    return json.loads(trial_page.STORED.read_text(encoding="utf-8"))


def test_the_stored_result_is_of_every_row_of_the_trial(result):
    rows = run.of_share(FULL, result["share"])
    assert [row["row"] for row in result["rows"]] == [row.key for row in rows]
    assert result["cases"] == sum(row.count for row in rows)
    for row, stored in zip(rows, result["rows"], strict=True):
        assert stored["rho"] == row.rho
        assert all(0 <= right <= of <= row.count for right, of in stored["score"].values())


def test_a_result_is_stored_and_its_counts_stand_in_the_tables(result, tmp_path):
    result = json.loads(json.dumps(result))
    result["rows"][0]["score"]["agrees"] = [700, 800]
    trial_page.write(result, tmp_path / "stored.json")
    assert json.loads((tmp_path / "stored.json").read_text(encoding="utf-8")) == result
    assert "| paper 15 uV | 0.875 (700/800; " in trial_page.part(result)


def test_the_site_shows_the_stored_result(result):
    assert PAGES["_blind-trial.md"]() == trial_page.part(result)


def test_a_part_of_the_trial_cannot_be_written_into_the_page(capsys):
    for part in (["--short"], ["--rows", "3"], ["--only", "null"]):
        with pytest.raises(SystemExit):
            run.main(["--page", *part])
        assert "--page is for the whole trial" in capsys.readouterr().err


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
