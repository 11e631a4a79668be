"""Every page, as it is seen: nothing that keeps people out, from a telephone to a wall, in light and dark."""

import json
import shutil
from urllib.parse import quote

import pytest

from bench.panel.access import STATE, Role, private_folder
from bench.panel.queue import DayQueue, new_item
from bench.run.events import EVENTS, MANIFEST
from bench.run.record import Record
from drivers.clock import utc_now
from tests.browser.conftest import RECORDS
from tests.support.plotted_runs import make_plotted

RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
SCRIPT = "<script>document.title='caught'</script>"
HOSTILE = f"{SCRIPT}<img src=x onerror=document.title='caught'>\x1b[31m\u202egnp.exe ünïcode 日本"
PAGES = (
    "/", "/start", "/check", "/runs/done/", "/runs/asked/", "/runs/mounting/", "/runs/done/verdict",
    "/runs/done/view/report", "/runs/none/", "/runs/done/plots", "/runs/later/plots", "/runs/later/verdict",
    "/bench", "/bench/form?start=bench-lan&name=two", "/bench/form?start=bench-multiplexer",
    "/queue", "/procedures", "/procedures/form?start=temperature", "/runs/broken/",
)  # fmt: skip


def hold_at(runs, name, lines, asked):
    """Make a run that stands at a question, and hold its record as a program that carries it out does."""
    folder = runs / name
    shutil.copytree(RECORDS / "finished", folder)
    whole = (folder / EVENTS).read_bytes().splitlines(keepends=True)
    (folder / EVENTS).write_bytes(b"".join(whole[:lines]))
    record, _ = Record.reopen(folder, utc_now)
    record.append("asked", 1000.0, **asked)
    return record


TURN = {
    "id": "0012/turn#1@41",
    "kind": "angle",
    "text": "Turn the head to 45°00′00″: approach with the angle rising, from below; clamp; read again",
    "default": "45°00′00″",
    "unit": "° ′ ″",
    "action": {"do": "turn", "target_rad": 0.7853981633974483, "direction": 1, "tolerance_rad": 3e-4},
}
MOUNT = {
    "id": "0002/mount#1@4",
    "kind": "confirm",
    "text": "Mount the block in installation 2, clamp it",
    "action": {"do": "mount", "installation": "2", "series": 1},
}


@pytest.fixture
def asked(panel):
    """Two runs that wait for an answer."""
    records = [hold_at(panel.runs, "asked", 40, TURN), hold_at(panel.runs, "mounting", 36, MOUNT)]
    yield
    for record in records:
        record.close()


@pytest.fixture
def queued(panel):
    """A queue with units in every state, and a damaged run."""
    queue = DayQueue(private_folder(panel.runs / STATE))
    for unit, run in (
        ("17-042", "done"),
        ("17-043", "broken"),
        ("unit-with-a-serial-number-of-40-letters", ""),
    ):
        item = new_item(unit, "calibration", "bench-lan", "anna", dry_run=not run)
        queue.add([item.model_copy(update={"run": run})])
    shutil.copytree(RECORDS / "finished", panel.runs / "broken")
    (panel.runs / "broken" / EVENTS).write_text("rubbish\n")


@pytest.fixture(scope="module")
def plotted(tmp_path_factory):
    return make_plotted(tmp_path_factory.mktemp("plotted"))


@pytest.fixture
def plots(panel, plotted):
    """Two runs of one unit; the later one has every plot."""
    for name in ("earlier", "later"):
        shutil.copytree(plotted / name, panel.runs / name)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_page_keeps_people_out_or_scrolls_sideways(visit, panel, asked, plots, queued, scheme):
    from axe_playwright_python.sync_playwright import Axe

    page = visit("/", color_scheme=scheme, viewport={"width": 1280, "height": 900})
    found, wide = {}, {}
    for path in PAGES:
        page.goto(panel.url + path)
        if path in {"/runs/done/", "/runs/asked/", "/runs/mounting/"}:
            page.wait_for_selector("#plots[data-newest]")
        if path == "/runs/later/plots":
            page.wait_for_selector("[data-shown]")
            page.locator("text=previous run earlier").first.click()
            page.locator("svg.plot").first.focus()
        told = Axe().run(page, options={"runOnly": {"type": "tag", "values": RULES}}).response
        assert len(told["passes"]) > 8
        found[path] = [
            (rule["id"], [node["target"] for node in rule["nodes"]][:3]) for rule in told["violations"]
        ]
        for width in (360, 390, 1024, 2560):
            page.set_viewport_size({"width": width, "height": 900})
            wide[path, width] = page.evaluate("document.documentElement.scrollWidth") - width
        page.set_viewport_size({"width": 1280, "height": 900})
    page.click("text=Sign out")
    page.wait_for_selector("#token")
    found["/sign-in"] = (
        Axe().run(page, options={"runOnly": {"type": "tag", "values": RULES}}).response["violations"]
    )
    assert {path: rules for path, rules in found.items() if rules} == {}
    assert {place: by for place, by in wide.items() if by > 0} == {}


@pytest.mark.parametrize("size", [(1024, 768), (390, 844)])
def test_stop_is_in_view_wherever_one_scrolls_and_the_angle_is_read_from_afar(visit, panel, asked, size):
    page = visit("/runs/asked/", viewport={"width": size[0], "height": size[1]})
    page.wait_for_selector("#plots[data-newest]")
    for down in (0, 800, 3000):
        page.evaluate(f"scrollTo(0, {down})")
        box = page.locator("#stopping >> text=Stop").bounding_box()
        assert 0 <= box["y"] < box["y"] + box["height"] <= size[1]
        assert 0 <= box["x"] < box["x"] + box["width"] <= size[0]
    page.evaluate("document.body.classList.add('enlarged'); scrollTo(0, 0)")
    size_px = page.evaluate("parseFloat(getComputedStyle(document.getElementById('target-angle')).fontSize)")
    assert size_px >= size[1] / 8
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert page.locator("#alarm").is_hidden()  # a question is no alarm


def test_what_strangers_wrote_is_text_on_every_page(visit, panel, asked):
    for name in ("done", "asked"):
        manifest = panel.runs / name / MANIFEST
        told = json.loads(manifest.read_text("utf-8"))
        told |= {"operator": HOSTILE, "bench": HOSTILE, "procedure": HOSTILE}
        told["unit_under_test"] = {"type": "block", "serial": HOSTILE}
        manifest.write_text(json.dumps(told), encoding="utf-8")
    page = visit("/", name="<b>änna</b>", role=Role.SUPERVISOR)
    for path in ("/", "/runs/done/", "/runs/asked/", "/runs/done/verdict"):
        page.goto(panel.url + path)
        page.wait_for_timeout(300)  # what was caught would have run by then
        assert page.title() != "caught"
        text = page.inner_text("body")
        assert "<b>änna</b>" in text
        assert "\x1b" not in text
        assert "\u202e" not in text
        assert page.locator("img[src=x]").count() == 0
        if path != "/runs/done/verdict":
            assert SCRIPT in text
            assert "ünïcode 日本" in text


def test_a_prompt_that_strangers_wrote_is_text(visit, panel):
    record = hold_at(panel.runs, "odd", 40, {**TURN, "text": HOSTILE, "picture": HOSTILE})
    try:
        page = visit("/runs/" + quote("odd") + "/")
        page.wait_for_selector("#plots[data-newest]")
        assert SCRIPT in page.inner_text("#todo")
        assert "caught" not in page.title()
    finally:
        record.close()


def test_nothing_is_loaded_from_elsewhere(visit, panel, asked):
    page = visit("/")
    asked_for = []
    page.on("request", lambda request: asked_for.append(request.url))
    for path in PAGES:
        page.goto(panel.url + path)
        page.wait_for_timeout(100)
    assert asked_for
    assert [url for url in asked_for if not url.startswith(panel.url)] == []
