"""Every page, as it is seen: nothing that keeps people out, from a telephone to a wall, in light and dark."""

import json
import shutil
from datetime import timedelta
from pathlib import Path
from urllib.parse import quote

import pytest

import bench.panel
from bench.base.languages import catalogue, texts_for_scripts
from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.panel.access import STATE, Role, private_folder
from bench.panel.app import ROUTES
from bench.panel.queue import DayQueue, new_item
from bench.run.events import EVENTS, MANIFEST
from bench.run.record import Record
from drivers.clock import utc_now
from tests.browser.conftest import RECORDS
from tests.support.certified_bench import meter_certificate, write_bench
from tests.support.served_panel import served

RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
TEXTS = Path(bench.panel.__file__).parent / "static" / "texts.js"
SCRIPT = "<script>document.title='caught'</script>"
HOSTILE = f"{SCRIPT}<img src=x onerror=document.title='caught'>\x1b[31m\u202egnp.exe ünïcode 日本"
VIEWED = {
    "/": ["/"],
    "/start": ["/start", "/start?after=later", "/start?like=done"],
    "/queue": ["/queue"],
    "/procedures": ["/procedures"],
    "/procedures/form": ["/procedures/form?start=temperature"],
    "/bench": ["/bench"],
    "/bench/form": ["/bench/form?start=bench-stand&name=two", "/bench/form?file=certified"],
    "/catalogue": ["/catalogue", "/catalogue?ask=metre=1"],
    "/catalogue/unit/{unit:path}": ["/catalogue/unit/0001"],
    "/check": ["/check"],
    "/runs/{name}/": [f"/runs/{name}/" for name in ("done", "later", "asked", "mounting", "none", "broken")],
    "/runs/{name}/verdict": ["/runs/done/verdict", "/runs/later/verdict"],
    "/runs/{name}/view/{what}": ["/runs/later/view/report", "/runs/later/view/diagnosis"],
    "/runs/{name}/report": ["/runs/later/report"],
    "/runs/{name}/diagnosis": ["/runs/later/diagnosis"],
    "/runs/{name}/plots": ["/runs/done/plots", "/runs/later/plots"],
}
"""The pages by their routes, with runs in every state."""
ELSEWHERE = {"/sign-in", "/start/{wish}"}
"""Pages that the test comes to by a button."""
APART = ("/runs/later/report", "/runs/later/diagnosis")
"""Pages in a sandbox without scripts: what is sent is judged outside of it."""
NO_PAGES = {
    "/language/{name}", "/static/{hash}/{name}", "/bench/search", "/catalogue/figure/{unit:path}", "/check/chart",
    "/runs/{name}/outcome", "/runs/{name}/figures/{figure}", "/runs/{name}/plots/data",
    "/runs/{name}/plots/previous", "/runs/{name}/plots/{table}.{form}", "/runs/{name}/certificate/{file}",
    "/runs/{name}/state", "/runs/{name}/stream", "/runs/{name}/check-answer",
}  # fmt: skip
"""What is sent to scripts, pictures, and files to save; the outcome is a part of the live page."""
PAGES = tuple(page for pages in VIEWED.values() for page in pages)


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
def panel(tmp_path, plotted):
    """A panel over a finished run, with a catalogue of the plotted ones."""
    shutil.copytree(RECORDS / "finished", tmp_path / "runs" / "done")
    with open_catalogue(tmp_path / "catalogue.sqlite") as catalogue:
        sync(catalogue, [plotted])
    with served(tmp_path / "runs", str(tmp_path / "catalogue.sqlite")) as found:
        yield found


@pytest.fixture
def asked(panel):
    """Two runs that wait for an answer."""
    records = [hold_at(panel.runs, "asked", 40, TURN), hold_at(panel.runs, "mounting", 36, MOUNT)]
    yield
    for record in records:
        record.close()


@pytest.fixture
def queued(panel, monkeypatch):
    """A queue with units in every state, a damaged run, a certificate that expired and one that is due."""
    monkeypatch.chdir(panel.runs.parent)
    today = utc_now().date()
    until = {"x": today - timedelta(2), "y": today + timedelta(9), "z": today + timedelta(999)}
    (Path("config")).mkdir()
    write_bench(
        Path("config"),
        {one: meter_certificate(date="2020-01-01", valid_until=str(day)) for one, day in until.items()},
    )
    queue = DayQueue(private_folder(panel.runs / STATE))
    for unit, run in (
        ("17-042", "done"),
        ("17-043", "broken"),
        ("unit-with-a-serial-number-of-40-letters", ""),
    ):
        item = new_item(unit, "calibration", "bench-lan", "anna", dry_run=not run)
        queue.add([item.model_copy(update={"run": run})])
    queue.add([new_item("17-045", "calibration", "certified", "anna", dry_run=False)])
    shutil.copytree(RECORDS / "finished", panel.runs / "broken")
    (panel.runs / "broken" / EVENTS).write_text("rubbish\n")


@pytest.fixture
def plots(panel, plotted):
    """Two runs of one unit; the later one has every plot."""
    for name in ("earlier", "later"):
        shutil.copytree(plotted / name, panel.runs / name)


def test_every_page_is_looked_at():
    shown = {route.path for route in ROUTES if "GET" in route.methods}
    assert shown == VIEWED.keys() | ELSEWHERE | NO_PAGES


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_page_keeps_people_out_or_scrolls_sideways(visit, panel, asked, plots, queued, scheme):
    from axe_playwright_python.sync_playwright import Axe

    page = visit("/", color_scheme=scheme, viewport={"width": 1280, "height": 900})
    page.goto(panel.url + "/start")
    page.check("[name=procedure][value=quick]")
    page.click("text=Check and try it")
    page.wait_for_selector("text=completed on simulated instruments")
    found, wide = {}, {}
    for path in (*PAGES, page.url.removeprefix(panel.url)):
        if path in APART:
            page.goto("about:blank")
            page.set_content(page.request.get(panel.url + path).text())
        else:
            page.goto(panel.url + path)
        if path in {"/runs/done/", "/runs/asked/", "/runs/mounting/"}:
            page.wait_for_selector("#plots[data-newest]")
        if path == "/queue":
            notes = page.locator(".bench-today .note")
            assert [text[0] for text in notes.all_inner_texts()] == ["✗", "!"]
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
    page.goto(panel.url)
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


def test_the_words_of_a_link_are_in_the_middle_of_its_button(visit):
    page = visit("/check")
    box, words = page.locator("a.button.primary").evaluate(
        "at => { const words = document.createRange(); words.selectNodeContents(at);"
        " return [at, words].map(one => one.getBoundingClientRect()).map(one => (one.top + one.bottom) / 2); }"
    )
    assert words == pytest.approx(box, abs=2.0)


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


def test_a_script_translates_as_the_module_does(chromium):
    texts = [
        "chamber: it shows 90 °C, which is not plausible (-60 to 85 °C).",
        "operator: answered no to: Mount the block in installation 1, clamp it; "
        "remove the reason, then start or resume again",
        "voltmeter.y: ADDRESS was not found, at the command FETC?",
        "Use the model: bench calibrate 2026.12 --model head",
        "It is warm. 44 °C: 21 °C from the 23 °C set. Is that right?",
        "untouched: ADDRESS was not found, at the command FETC?",
        "operator: the input ended before an answer to: Read it. Type it.; resume the run and answer it",
    ]
    page = chromium.new_page()
    page.add_script_tag(content=texts_for_scripts("uk"))
    page.add_script_tag(path=TEXTS)
    assert page.evaluate("texts => texts.map(_)", texts) == [
        catalogue("uk").translate(text) for text in texts
    ]
    page.close()
