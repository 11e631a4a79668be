"""Several people at one run: one holds, one watches, one takes over, and the terminal answers, too."""

import pytest

from bench.panel.access import Role
from tests.support.browser_runs import Begun, answer_on, prompt_of, typed_for, until

ANSWER = """id => fetch("answer", {
    method: "POST", body: JSON.stringify({id, text: "yes"}),
    headers: {"content-type": "application/json", "x-csrf": document.getElementById("live").dataset.csrf},
}).then(reply => reply.status)"""
WIDE = {"width": 1280, "height": 900}


@pytest.fixture
def run(panel):
    """A run that is asked at a terminal and in its folder."""
    begun = Begun(panel.runs, "together", "quick", "terminal")
    begun.wait_for_events()
    yield begun
    begun.close()


def answer_of(run):
    return typed_for(run.of_type("asked")[-1], 0)


def takes_control(page):
    """Take control and wait for it: a page that is left before the reply has taken nothing."""
    page.click("text=Take control")
    page.wait_for_selector("text=You are in control")


def test_one_holds_one_watches_one_takes_over_and_the_terminal_answers(visit, run):
    anna = visit("/runs/together/", viewport=WIDE)
    vera = visit("/runs/together/", "vera", Role.VIEWER, viewport=WIDE)
    takes_control(anna)
    first = prompt_of(anna, "")
    answer_on(anna, answer_of(run))
    second = prompt_of(anna, first)
    assert prompt_of(vera, first) == second
    vera.wait_for_selector("text=anna is in control")
    assert vera.locator("#buttons button:enabled, #control button").count() == 0

    until(lambda: run.of_type("asked")[-1]["id"] == second)
    anna.wait_for_timeout(1000)  # the terminal takes nothing that was typed before its question could be read
    run.type(answer_of(run))
    third = prompt_of(anna, second)
    assert "terminal" in anna.inner_text("#told")

    sam = visit("/runs/together/", "sam", Role.SUPERVISOR, viewport=WIDE)
    sam.click("text=Ask for control")
    anna.click("text=Give it to sam")
    sam.wait_for_selector("text=You are in control")
    anna.wait_for_selector("text=sam is in control")
    assert anna.locator("#buttons button:enabled").count() == 0
    assert anna.evaluate(ANSWER, third) == 403
    answer_on(sam, answer_of(run))
    prompt_of(sam, third)
    who = [(event["by"], event["where"]) for event in run.of_type("answered")]
    assert who[0] == ("anna", "panel")
    assert who[1][1] == "terminal"
    assert who[2] == ("sam", "panel")

    vera.click("text=Stop")  # anybody's
    vera.wait_for_selector("text=interrupted")
    status, said = run.ended()
    assert status == 2
    assert f"resume with 'bench resume {run.folder}'" in said
    assert "anna" in said  # the terminal says who answered elsewhere
    assert run.of_type("run_interrupted")[-1]["by"] == "vera"


def test_a_supervisor_may_force_it_and_an_operator_may_not(visit, run):
    anna = visit("/runs/together/", viewport=WIDE)
    takes_control(anna)
    ben = visit("/runs/together/", "ben", Role.OPERATOR, viewport=WIDE)
    ben.wait_for_selector("text=Ask for control")
    assert ben.locator("text=by force").count() == 0
    sam = visit("/runs/together/", "sam", Role.SUPERVISOR, viewport=WIDE)
    sam.click("text=Take over by force")
    sam.wait_for_selector("text=You are in control")
    anna.wait_for_selector("text=sam is in control")


def test_loaded_again_gone_back_to_in_a_second_tab_and_asleep_the_question_stands(visit, run):
    page = visit("/runs/together/", viewport=WIDE)
    takes_control(page)
    asked = prompt_of(page, "")
    page.reload()
    assert prompt_of(page, "") == asked
    page.wait_for_selector("text=You are in control")
    page.click("nav >> text=Runs")
    page.go_back()
    assert prompt_of(page, "") == asked
    tab = page.context.new_page()
    tab.clock.install()
    tab.goto(page.url)
    assert prompt_of(tab, "") == asked

    tab.clock.fast_forward(60_000)  # as a closed lid: the clock jumps, timers are late
    answer_on(page, answer_of(run))
    following = prompt_of(page, asked)
    assert prompt_of(tab, asked) == following
    tab.wait_for_selector("#lost", state="hidden")
    assert tab.get_attribute("#live", "data-prompt") == following
    assert tab.evaluate(ANSWER, asked) == 409  # a stale answer
    assert len(run.of_type("answered")) == 1
    answer_on(tab, answer_of(run))
    prompt_of(page, following)
    assert [event["answer"] for event in run.of_type("answered")].count("") == 0
    assert len(run.of_type("answered")) == 2
