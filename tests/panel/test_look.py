"""What pages are made of: everything in the package, all text escaped, assets by what is in them."""

import ast
import re
from pathlib import Path

import pytest
from jinja2 import PackageLoader
from markupsafe import escape

import bench.panel
from bench.panel.app import LATE, LATE_OF_CATALOGUE
from bench.panel.shared import ASSETS, _environment, asset, load, read_asset
from bench.panel.shared import rendered as page


@pytest.mark.parametrize("name", ASSETS)
def test_an_asset_has_an_address_of_its_content_and_loads_nothing_from_elsewhere(name):
    assert re.fullmatch(rf"/static/[0-9a-f]{{12}}/{re.escape(name)}", asset(name))
    text = read_asset(name).decode().replace('xmlns="http://www.w3.org/2000/svg"', "")
    text = text.replace('"http://www.w3.org/2000/svg"', "")
    assert not re.search(r"https?://|//cdn|@import", text)


def test_nothing_but_an_asset_is_read():
    for name in ("../look.py", "style.css.j2", "", "panel.css/../../look.py"):
        with pytest.raises(KeyError):
            read_asset(name)


def test_what_is_put_into_a_page_is_text():
    name = "<script>alert(1)</script>\x1b[31m\u202e"
    text = page("base.html.j2", person={"name": name, "role": "viewer"})
    assert "<script>" not in text
    assert str(escape("<script>alert(1)</script>")) in text
    assert "\x1b" not in text
    assert "\\x1b[31m\\u202e" in text


def test_a_page_has_neither_script_nor_style_of_its_own():
    text = page("base.html.j2")
    assert not re.search(r"<style|<script(?![^>]*src=)|\sstyle=|\son\w+=", text)


def test_no_first_page_has_to_be_compiled(monkeypatch):
    _environment.cache_clear()
    load()
    monkeypatch.setattr(PackageLoader, "get_source", lambda *_: pytest.fail("a page was compiled"))
    templates = list((Path(bench.panel.__file__).parent / "templates").glob("*.j2"))
    assert len(templates) >= 10
    for file in templates:
        assert _environment().get_template(file.name)


def test_what_pages_import_late_is_loaded_while_the_panel_begins_to_serve():
    """A page that imports when it is first asked for keeps its first reader waiting for a second."""
    package = Path(bench.panel.__file__).parent
    late = {
        inner.module
        for file in (*(package / "pages").glob("*.py"), package / "results.py")
        for outer in ast.walk(ast.parse(file.read_text("utf-8")))
        if isinstance(outer, ast.FunctionDef | ast.AsyncFunctionDef)
        for inner in ast.walk(outer)
        if isinstance(inner, ast.ImportFrom) and (inner.module or "").startswith("bench.")
    }
    assert late
    assert late == {*LATE, *LATE_OF_CATALOGUE}
