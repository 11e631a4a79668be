"""What is put into the built pages, and which of its figures a command repeats."""

import re

import pytest

from docs.generators import measured
from docs.generators.finishing import ADDED, finish
from tests.support.pages import ROOT

COMMANDS = [command for one in measured.stored() for command in one["commands"]]


def test_a_page_gets_what_the_theme_leaves_out_once(tmp_path):
    page = tmp_path / "folder" / "page.html"
    page.parent.mkdir()
    page.write_text("".join(ADDED), encoding="utf-8")
    finish(tmp_path)
    assert page.read_text(encoding="utf-8") == "".join(ADDED.values())
    finish(tmp_path)
    assert page.read_text(encoding="utf-8") == "".join(ADDED.values())


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_of_a_table_is_a_benchmark_with_these_options(command):
    name, *words = command.split()
    text = (ROOT / "benchmarks" / f"{name}.py").read_text(encoding="utf-8")
    for option in (word for word in words if word.startswith("--")):
        name = option.removeprefix("--")
        assert re.search(rf"--{name}\b|\b{name.replace('-', '_')}\b", text), option


def test_every_table_belongs_to_a_page_that_is_there_and_has_a_cell_for_each_column():
    for one in measured.stored():
        assert (ROOT / "docs" / one["page"]).is_file()
        assert all(len(row) == len(one["columns"]) for row in one.get("rows", []))
