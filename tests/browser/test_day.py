"""A day at the panel: a procedure made in a table, units queued by the keyboard alone, a second person beside."""

import pytest

from bench.config.procedure.load import load_procedure
from tests.browser.conftest import empty_panel

PHONE = {"width": 390, "height": 844}


panel = pytest.fixture(empty_panel)


def test_a_procedure_is_picked_changed_and_saved(visit, panel, tmp_path):
    page = visit("/", viewport={"width": 1024, "height": 768})
    page.click("nav >> text=Procedures")
    page.click("text=New from quick")
    page.fill("#new_name", "short")
    page.fill("[id='reading.settle']", "1")
    page.click("text=Check what is typed >> nth=0")
    assert "without a unit" in page.locator(".field.wrong").inner_text()
    page.fill("[id='reading.settle']", "1 s")
    turn = "steps[2].installation.steps[1].turn"
    page.select_option(f"[id='form:{turn}.angles']", "list")  # shows the list at once
    page.wait_for_selector(f"[id='{turn}.angles']")
    page.fill(f"[id='{turn}.angles']", "0 deg, 90 deg, 180 deg, 270 deg")
    page.click("[aria-label='Remove step 1, Wait']")
    page.wait_for_selector("text=17 readings.")
    page.click("text=Write the file >> nth=0")
    page.wait_for_selector("text=short.yaml is written")
    plan = load_procedure(tmp_path / "empty" / "procedures" / "short.yaml").plan
    assert (plan.name, plan.counts()["read"]) == ("short", 4 + 9 + 4)


def test_units_are_queued_by_keys_alone_and_another_person_sees_them(visit, panel):
    page = visit("/queue", viewport=PHONE)
    page.focus("#units")
    page.keyboard.type("17-042\n17-043")
    for key in ("Tab", "q", "Tab", "Tab", "Space", "Tab", "Enter"):
        page.keyboard.press(key)
    page.wait_for_selector("text=0 of 2 done")
    other = visit("/queue", name="bert")
    page.locator("[aria-label^='Move down 17-042']").press("Enter")
    other.wait_for_selector(".queue tbody tr:first-child >> text=17-043")  # without a reload
    assert other.locator(".queue >> text=practice").count() == 2
    other.click("[aria-label^='Begin 17-043']")
    other.wait_for_selector("text=Start the practice")
    page.wait_for_selector(".queue >> text=checked")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
