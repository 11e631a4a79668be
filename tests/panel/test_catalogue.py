"""The pages on units: a search, a unit's page, for whoever may look; nothing is written."""

import sys

import pytest

from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.panel.access import Role
from tests.support.laboratory import write_run
from tests.support.panel_client import Browser, stranger

ADDRESSES = ("/catalogue", "/catalogue/unit/17", "/catalogue/figure/17")


@pytest.fixture
def where(tmp_path):
    for k in range(3):
        write_run(tmp_path / "all" / f"a{k}", serial="17", created=f"202{k}-03-01T08:00:00+00:00")
    write_run(tmp_path / "all" / "b", serial="<b>/18", kind="block & co", verdict="fail")
    file = tmp_path / "catalogue.sqlite"
    with open_catalogue(file) as catalogue:
        sync(catalogue, [tmp_path / "all"])
    return str(file)


@pytest.fixture
def viewer(tmp_path, where):
    return Browser(tmp_path / "runs", "vera", Role.VIEWER, where)


def test_units_are_searched_by_a_part_of_their_name_or_by_a_question(viewer):
    every = viewer.get("/catalogue").text
    assert "block A 17" in every
    assert "block &amp; co &lt;b&gt;/18" in every
    assert '<a href="/catalogue">Units</a>' in viewer.get("/").text
    assert "block A 17" not in viewer.get("/catalogue?ask=18").text
    assert "1 units" in viewer.get("/catalogue?ask=verdict=fail").text
    wrong = viewer.get("/catalogue?ask=metre=1")
    assert (wrong.status_code, "no key metre" in wrong.text) == (409, True)


def test_without_its_package_a_page_says_what_installs_it(viewer, monkeypatch):
    monkeypatch.setitem(sys.modules, "sqlalchemy", None)
    shown = viewer.get("/catalogue/unit/17")
    assert shown.status_code == 409
    assert "the package sqlalchemy is not installed: pip install" in shown.text


def test_a_unit_has_its_coefficients_runs_and_date(viewer):
    text = viewer.get("/catalogue/unit/17").text
    assert "Due on 20" in text
    assert ">Kxx<" in text
    assert "a2" in text
    drawn = viewer.get("/catalogue/figure/block%20A%2017")
    assert drawn.headers["content-type"] == "image/svg+xml"
    assert drawn.text.startswith("<?xml")


def test_names_are_text_and_nothing_else(viewer):
    page = viewer.get("/catalogue/unit/block%20%26%20co%20%3Cb%3E%2F18")
    assert page.status_code == 200
    assert "<b>/18" not in page.text
    assert "style=" not in page.text
    assert "default-src 'none'" in page.headers["content-security-policy"]


@pytest.mark.parametrize("address", ADDRESSES)
def test_a_stranger_sees_nothing_and_nobody_writes(tmp_path, where, viewer, address):
    assert stranger(tmp_path / "runs", where).get(address).status_code in (303, 401)
    assert viewer.post(address).status_code == 405


@pytest.mark.parametrize("address", ADDRESSES)
def test_without_a_catalogue_there_are_no_such_pages(tmp_path, address):
    browser = Browser(tmp_path / "runs", "vera", Role.VIEWER)
    assert browser.get(address).status_code == 404
    assert "/catalogue" not in browser.get("/").text


def test_a_unit_that_nobody_knows_is_a_sentence(viewer):
    reply = viewer.get("/catalogue/unit/99")
    assert (reply.status_code, "no such unit" in reply.text) == (409, True)
