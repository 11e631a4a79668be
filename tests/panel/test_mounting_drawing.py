"""What pages are made of: assets, escaped text, and the drawing against the model of the stand."""

import ast
import math
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from jinja2 import PackageLoader
from markupsafe import escape

import bench.panel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2, Installation, specific_force_on_platform
from bench.panel.app import LATE, LATE_OF_CATALOGUE
from bench.panel.mounting_drawing import in_words, mounting, turn
from bench.panel.shared import ASSETS, _environment, asset, load, read_asset
from bench.panel.shared import rendered as page

TURNED = Installation.from_axes("1 turned", ("x", "y", "z"), math.pi)
CASES = [
    (installation, degrees)
    for installation in (INSTALLATION_1, INSTALLATION_2, TURNED)
    for degrees in range(0, 360, 45)
]


def force(installation, degrees):
    """What the model says that the block's axes feel, g."""
    on_platform = specific_force_on_platform(np.radians([float(degrees)]), np.zeros((1, 5)))
    return installation.block_from_platform @ on_platform[0]


def drawn_shapes(svg):
    return list(ElementTree.fromstring(svg).iter())  # noqa: S314 - our own drawing


def ends(svg, data):
    """Begin and end of the line that carries a data attribute, on the sheet."""
    shape = next(one for one in drawn_shapes(svg) if data in one.attrib)
    points = [tuple(map(float, pair.split())) for pair in re.split("[ML]", shape.attrib["d"])[1:]]
    return np.array(points[0]), np.array(points[-1])


def arrow(svg, channel):
    """The way of a block's axis on the sheet, right and up."""
    found = None
    for shape in drawn_shapes(svg):
        if shape.attrib.get("data-axis") == channel:
            found = [tuple(map(float, pair.split())) for pair in re.split("[ML]", shape.attrib["d"])[1:]]
    (x1, y1), (x2, y2) = found
    return np.array([x2 - x1, y1 - y2])


@pytest.mark.parametrize(("installation", "degrees"), CASES)
def test_an_axis_that_feels_gravity_is_drawn_upright_and_the_others_are_not(installation, degrees):
    drawn = mounting(installation, math.radians(degrees))
    for channel, felt in zip("xyz", force(installation, degrees), strict=True):
        way = arrow(drawn, channel)
        if abs(abs(felt) - 1.0) < 1e-9:
            assert abs(way[0]) < 0.2
            assert np.sign(way[1]) == np.sign(felt)
        elif (
            abs(felt) < 1e-9 and abs(way[1]) > 0.2
        ):  # along the shaft, which is drawn aslant, both ways alike
            assert way[0] * way[1] > 0
        else:
            assert np.sign(way[1]) == np.sign(round(felt, 9))


@pytest.mark.parametrize("installation", [INSTALLATION_1, INSTALLATION_2])
def test_two_thirds_up_is_two_thirds_of_the_length(installation):
    whole = max(abs(arrow(mounting(installation), channel)[1]) for channel in "xyz")
    drawn = mounting(installation, math.radians(30.0))
    across = [c for c in "xyz" if abs(force(installation, 37.0)[ord(c) - ord("x")]) > 1e-9]
    for channel, felt in zip("xyz", force(installation, 30.0), strict=True):
        if channel in across:
            assert arrow(drawn, channel)[1] / whole == pytest.approx(felt, abs=0.01)


@pytest.mark.parametrize("degrees", [0, 45, 135, 180, 270])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("before", [None, 20.0, 300.0])
def test_the_arrow_arrives_from_the_side_that_is_asked_for(degrees, direction, before):
    drawn = turn(
        INSTALLATION_1, None if before is None else math.radians(before), math.radians(degrees), direction
    )
    start, end = ends(drawn, "data-direction")
    whole = drawn_shapes(turn(None, None, math.radians(degrees), direction))
    zero = next(one for one in whole if one.attrib.get("class") == "zero")
    rim = np.array([float(zero.attrib["x2"]), float(zero.attrib["y2"])])
    opposite = np.array([float(zero.attrib["x1"]), float(zero.attrib["y1"])])
    centre = rim + (opposite - rim) / 0.1  # the mark at 0° reaches in by a tenth of the radius
    (ax, ay), (bx, by) = start - centre, end - centre
    against_the_clock = ay * bx - ax * by  # the sheet's second axis points down
    assert np.sign(against_the_clock) == direction
    # the arrow ends where the platform's zero comes to stand
    assert np.cross([*(end - centre), 0.0], [*(rim - centre), 0.0])[2] == pytest.approx(0.0, abs=60.0)
    assert (end - centre) @ (rim - centre) > 0


def test_words_say_where_each_axis_points():
    assert (
        in_words(INSTALLATION_1, 0.0) == "x points right, y points away from you along the shaft, z points up"
    )
    assert (
        in_words(INSTALLATION_2, 0.0) == "x points left, y points up, z points away from you along the shaft"
    )
    assert in_words(INSTALLATION_1, math.pi / 2).startswith("x points up")
    assert "z points left" in in_words(INSTALLATION_1, math.pi / 2)


def test_a_label_is_text_in_the_drawing():
    label = '"><script>alert(1)</script>'
    drawn = mounting(Installation(label, np.eye(3)))
    root, *shapes = drawn_shapes(drawn)
    assert not [one for one in shapes if one.tag.endswith("script")]
    assert label in root.attrib["aria-label"]


def test_a_drawing_has_no_style_of_its_own():
    assert "style" not in turn(INSTALLATION_2, 0.0, 1.0, 1)


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
