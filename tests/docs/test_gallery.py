"""The gallery: page and notebook hold the same. The build of the site carries out every example."""

import json

import pytest

from docs.generators import gallery
from docs.generators.gallery import Cell, cells_of
from tests.support.pages import DOCS


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
