"""A whole calibration by answers typed in a browser: readings and result are those of the same answers at a
terminal."""

import json

import pytest

from bench.base.numbers import rounded
from tests.support.browser_runs import Begun, answer_by_keys, answer_on, prompt_of, tab_to, typed_for


@pytest.fixture
def begin(panel):
    begun = []

    def start(*given, **options):
        begun.append(Begun(panel.runs, *given, **options))
        return begun[-1]

    yield start
    for run in begun:
        run.close()


def readings(run):
    return [event["reading"] for event in run.events() if "reading" in event]


def test_a_calibration_by_keys_alone_is_worth_one_at_the_terminal(visit, panel, begin):
    run, terminal = begin("browser", "quick", "folder"), begin("terminal", "quick", "terminal")
    run.wait_for_events()
    page = visit("/runs/browser/", viewport={"width": 1024, "height": 768}, color_scheme="dark")
    tab_to(page, "Take control")
    page.keyboard.press("Enter")
    page.wait_for_selector("text=You are in control")
    typed, asked_id = [], ""
    while asked_id := prompt_of(page, asked_id):
        asked = run.of_type("asked")[-1]
        assert asked["id"] == asked_id
        typed.append(typed_for(asked, len(typed)))
        answer_by_keys(page, typed[-1])
        terminal.type(typed[-1])
    page.wait_for_selector("#outcome[data-outcome=ready] .worst")
    assert page.locator("#outcome .whisker").count() == 4
    assert run.ended()[0] == terminal.ended()[0] == 0
    assert len(readings(run)) == 22
    assert readings(run) == readings(terminal)
    for file in ("calibrate.json", "verify.json"):
        one, two = (
            json.loads((panel.runs / name / file).read_text("utf-8")) for name in ("browser", "terminal")
        )
        assert one.get("coefficients") == two.get("coefficients")
        assert one.get("points") == two.get("points")
    answered = run.of_type("answered")
    assert {(event["by"], event["role"], event["where"]) for event in answered} == {
        ("anna", "operator", "panel")
    }
    assert [event["answer"] for event in answered] == typed
    assert {event["where"] for event in terminal.of_type("answered")} == {"terminal"}

    tab_to(page, "Coefficients, certificate")
    page.keyboard.press("Enter")
    page.wait_for_selector("text=worst |Δg|")
    worst = max(
        json.loads((panel.runs / "browser" / "verify.json").read_text("utf-8"))["points"],
        key=lambda p: abs(p["delta_g"]),
    )
    shown = rounded(abs(worst["delta_g"]) * 1e6, worst["U"] * 1e6)
    assert f"worst |Δg| = {shown} " in page.inner_text("main")


def test_an_angle_is_checked_as_it_is_typed_and_nothing_jumps(visit, panel, begin):
    run = begin("typed", "quick", "folder")
    run.wait_for_events()
    page = visit("/runs/typed/", viewport={"width": 1280, "height": 900})
    page.click("text=Take control")
    asked_id = ""
    while (asked_id := prompt_of(page, asked_id)) and not page.is_visible("#target"):
        answer_on(page, typed_for(run.of_type("asked")[-1], 0))
    # the keyboard alone suffices: what is typed goes into the field without a click
    assert page.evaluate("document.activeElement.id") == "typed"
    before = page.evaluate("[scrollY, document.getElementById('typed').getBoundingClientRect().top]")
    page.keyboard.type("1 0 0")
    page.wait_for_selector("#checked.bad")
    assert "degree" in page.inner_text("#checked")
    assert page.evaluate("document.activeElement.id") == "typed"
    page.reload()
    page.wait_for_selector("#checked.bad")
    assert page.input_value("#typed") == "1 0 0"  # what is half typed survives
    page.focus("#typed")
    page.keyboard.press("Control+A")
    page.keyboard.type("0 0 5")
    page.wait_for_selector("#checked.good")
    assert "0° 00′ 05.0″" in page.inner_text("#checked")
    assert page.evaluate("[scrollY, document.getElementById('typed').getBoundingClientRect().top]") == before
    page.keyboard.press("Control+A")
    page.keyboard.press("Delete")
    page.keyboard.press("Enter")  # the bench file has no default here: Enter alone says nothing
    page.wait_for_selector("#checked.bad")
    assert run.of_type("answered")[-1]["answer"] != ""
    page.keyboard.type("0 0 5")
    page.keyboard.press("Enter")
    prompt_of(page, asked_id)
    assert run.of_type("answered")[-1]["answer"] == "0 0 5"
    assert page.evaluate("document.activeElement.id") == "typed"
    assert page.input_value("#typed") == ""


SLOW = """(() => { const add = EventSource.prototype.addEventListener;
  EventSource.prototype.addEventListener = function (kind, hear) {
    add.call(this, kind, (event) => {
      const told = kind === "state" ? JSON.parse(event.data) : {};
      if (kind !== "state" || told.prompt || told.ended) hear(event); }); }; })()"""
"""A page that misses every moment without a question, as one on a busy machine may."""

SAME_ANGLE = """\
procedure: same
reading: {samples: 1, nplc: 1, settle: 1 s}
steps:
  - installation:
      label: 1
      steps: [{repeat: {directions: [rising, falling], steps: [{turn: {angles: [0 deg]}}]}}]
"""


def test_a_question_for_the_same_angle_begins_with_an_empty_field(visit, panel, begin, tmp_path):
    (tmp_path / "same.yaml").write_text(SAME_ANGLE, "utf-8")
    run = begin("same", str(tmp_path / "same.yaml"), "folder", more=("--dry-run", "--bench", "bench-lan"))
    run.wait_for_events()
    page = visit("/")
    page.add_init_script(SLOW)
    page.goto(f"{panel.url}/runs/same/")
    page.click("text=Take control")
    asked_id = prompt_of(page, "")
    answer_on(page, "yes")
    for typed in ('+3"', "+12'", '+5"'):  # the second is refused: typing again replaces it
        asked_id = asked_id if typed == '+5"' else prompt_of(page, asked_id)
        page.wait_for_function(
            "() => document.activeElement.id === 'typed' && !document.activeElement.readOnly"
        )
        page.keyboard.type(typed)
        page.keyboard.press("Enter")
        if typed == "+12'":
            page.wait_for_function("() => document.getElementById('message').className.includes('bad')")
    assert run.ended()[0] in {0, 1}
    assert [event["answer"] for event in run.of_type("answered")] == ["yes", '+3"', '+5"']


def test_what_is_half_typed_survives_a_pause_but_no_answer(visit, panel, begin, tmp_path):
    (tmp_path / "same.yaml").write_text(SAME_ANGLE, "utf-8")
    run = begin("paused", str(tmp_path / "same.yaml"), "folder", more=("--dry-run", "--bench", "bench-lan"))
    run.wait_for_events()
    page = visit("/runs/paused/")
    page.click("text=Take control")
    asked_id = prompt_of(page, "")
    answer_on(page, "yes")
    asked_id = prompt_of(page, asked_id)
    page.keyboard.type("+3")
    page.click("[data-wish=pause]")
    asked_id = prompt_of(page, asked_id)
    assert page.is_hidden("#typed")
    page.click("[data-wish=continue]")
    asked_id = prompt_of(page, asked_id)
    assert page.input_value("#typed") == "+3"
    page.keyboard.press("End")
    page.keyboard.type('"')
    page.keyboard.press("Enter")
    asked_id = prompt_of(page, asked_id)
    for _ in range(2):  # the point is redone: the same step asks again, from an empty field
        page.click("[data-wish=redo]")
    assert prompt_of(page, asked_id).split("#")[0] == run.of_type("answered")[-1]["id"].split("#")[0]
    assert page.input_value("#typed") == ""


TONES = """(() => { window.tones = []; const start = OscillatorNode.prototype.start;
  OscillatorNode.prototype.start = function (at) { tones.push(this.frequency.value); start.call(this, at); };
})()"""


def test_without_hands_the_head_is_heard_to_be_read(visit, panel, begin, tmp_path):
    (tmp_path / "two.yaml").write_text(SAME_ANGLE.replace("[0 deg]", "[10 deg]"), "utf-8")
    more = ("--dry-run", "--bench", "bench-encoder")
    run = begin("hands-free", str(tmp_path / "two.yaml"), "folder", more=more)
    run.wait_for_events()
    page = visit("/runs/hands-free/", viewport={"width": 390, "height": 844})
    page.evaluate(TONES)
    page.click("#sound")
    page.click("text=Take control")
    asked_id = ""
    while asked_id := prompt_of(page, asked_id):
        asked = next(one for one in run.of_type("asked") if one["id"] == asked_id)
        if asked["action"]["do"] != "turn":
            answer_by_keys(page, typed_for(asked, 0))
    assert run.ended()[0] in {0, 1}
    turns = [one["id"] for one in run.of_type("asked") if one["action"]["do"] == "turn"]
    assert [one["by"] for one in run.of_type("answered") if one["id"] in turns] == ["encoder"] * 2
    assert len(readings(run)) == 2
    assert page.evaluate("tones.filter(one => one === 587).length") == 2
    assert page.evaluate("tones.length") > 4  # questions are heard, too
