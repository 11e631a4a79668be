"""What is lost is said loudly, and comes back: the panel's server killed, the program that carries out the
run killed."""

import signal

import pytest

from bench.panel.access import Role
from bench.panel.app import begin_panel, url_of
from bench.run.folder import Run
from bench.run.record import is_being_written
from tests.support.browser_runs import Begun, answer_on, prompt_of, typed_for, until

WIDE = {"width": 1280, "height": 900}


@pytest.fixture
def run(panel):
    begun = Begun(panel.runs, "lost", "quick", "folder")
    begun.wait_for_events()
    yield begun
    begun.close()


def test_a_killed_panel_is_told_loudly_and_the_question_is_there_again(chromium, panel, run):
    token = panel.token("anna", Role.OPERATOR)
    apart = begin_panel(panel.runs, [0]).process
    url = url_of(panel.runs)
    context = chromium.new_context(viewport=WIDE)
    try:
        page = context.new_page()
        page.goto(f"{url}/sign-in")
        page.fill("#token", token)
        page.click("main button[type=submit]")
        page.goto(f"{url}/runs/lost/")
        page.click("text=Take control")
        page.wait_for_selector("text=You are in control")  # a kill before it would take the request along
        asked = prompt_of(page, "")
        assert not page.is_visible("#lost")
        apart.kill()
        apart.wait()
        page.wait_for_selector("#lost", state="visible")
        assert "No connection to the panel" in page.inner_text("#lost")
        assert "not connected" in page.inner_text("#age")
        assert (
            page.locator("#buttons button:enabled, #wishes button:enabled, #stopping button:enabled").count()
            == 0
        )
        assert run.process.poll() is None
        apart = begin_panel(panel.runs, [int(url.rpartition(":")[2])]).process
        page.wait_for_selector("#lost", state="hidden")
        assert page.get_attribute("#live", "data-prompt") == asked
        page.wait_for_selector("text=You are in control")
        answer_on(page, typed_for(run.of_type("asked")[-1], 0))
        prompt_of(page, asked)
        assert [event["by"] for event in run.of_type("answered")] == ["anna"]
    finally:
        context.close()
        apart.kill()
        apart.wait()


def test_a_killed_run_is_told_and_gone_on_with_by_a_button(visit, run):
    page = visit("/runs/lost/", viewport=WIDE)
    page.click("text=Take control")
    asked = prompt_of(page, "")
    answer_on(page, "yes")
    prompt_of(page, asked)
    run.process.send_signal(signal.SIGKILL)
    run.process.communicate()
    page.wait_for_selector("#alarm >> text=ended unexpectedly")
    assert page.locator("#wishes button:enabled").count() == 0
    assert not page.is_visible("#answer")
    page.click("text=Resume this run")
    asked = ""
    while asked := prompt_of(page, asked):
        answer_on(page, typed_for(run.of_type("asked")[-1], 0))
    until(lambda: not is_being_written(run.folder))
    history = Run(run.folder).history
    assert (history.state, history.problems, len(run.of_type("run_resumed"))) == ("finished", (), 1)
    answered = [event["id"] for event in run.of_type("answered")]
    assert len(set(answered)) == len(answered)


def test_without_a_connection_a_run_that_has_ended_is_not_said_to_continue(visit, panel):
    page = visit("/runs/done/", viewport=WIDE)
    page.wait_for_selector("#live[data-ended=true]", state="attached")
    page.route("**/stream", lambda route: route.abort())
    page.evaluate("const late = performance.now.bind(performance); performance.now = () => late() + 60_000")
    page.wait_for_selector("#lost", state="visible")
    assert "this page is out of date" in page.inner_text("#lost")
    assert "continues" not in page.inner_text("#lost")
