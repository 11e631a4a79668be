"""A day at the panel: a procedure made in a table, units queued by the keyboard alone, a second person beside."""

import pytest

from bench.config.procedure.load import load_procedure
from bench.run.folder import Run
from tests.browser.conftest import empty_panel
from tests.browser.test_calibration import SAME_ANGLE
from tests.support.browser_runs import answer_by_keys, prompt_of, tab_to

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


def press(page, words):
    tab_to(page, words)
    page.keyboard.press("Enter")


def begun_by_keys(page, number):
    """Begin the unit of the queue with this number and start its practice."""
    press(page, f"Begin {number}")
    page.wait_for_selector("text=Start the practice")
    press(page, "Start the practice")
    page.wait_for_selector("text=You are in control")


def test_units_are_queued_given_up_and_measured_again_by_keys_alone(visit, panel, tmp_path):
    (tmp_path / "empty" / "procedures").mkdir()
    (tmp_path / "empty" / "procedures" / "brief.yaml").write_text(SAME_ANGLE, "utf-8")
    page = visit("/queue", viewport=PHONE, color_scheme="dark")
    page.focus("#units")
    page.keyboard.type("17-042\n17-043")
    tab_to(page, "procedure")
    page.keyboard.type("brief")
    tab_to(page, "bench")
    page.keyboard.type("bench-lan")
    for key in ("Tab", "Space", "Tab", "Enter"):
        page.keyboard.press(key)
    page.wait_for_selector("text=0 of 2 done")
    other = visit("/queue", name="bert")
    press(page, "Move down 17-042")
    other.wait_for_selector(".queue tbody tr:first-child >> text=17-043")  # without a reload
    assert other.locator(".queue >> text=practice").count() == 2

    begun_by_keys(page, "17-043")
    prompt_of(page, "")
    tab_to(page, "reason")
    page.keyboard.type("dropped")
    tab_to(page, "Give up the run")
    page.keyboard.press("Enter")
    page.keyboard.press("Enter")
    page.wait_for_selector("#live[data-ended=true]")
    other.wait_for_selector(".queue tbody tr:first-child >> text=aborted")
    page.goto(f"{panel.url}/queue")
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    press(page, "Put back 17-043")
    page.wait_for_selector("[aria-label^='Begin 17-043']")
    begun_by_keys(page, "17-043")
    asked_id = ""
    while asked_id := prompt_of(page, asked_id):
        answer_by_keys(page, '+3"' if page.is_visible("#typed") else "yes")
    other.wait_for_selector("text=1 of 2 done")
    runs = [Run(folder) for folder in panel.runs.iterdir() if folder.name[0] != "."]
    assert sorted(str(run.history.state) for run in runs) == ["aborted", "finished"]
