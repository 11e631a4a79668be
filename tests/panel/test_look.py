"""What pages are made of: everything in the package, all text escaped, assets by what is in them."""

import re

import pytest
from markupsafe import escape

from bench.panel.look import ASSETS, asset, page, read_asset


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
