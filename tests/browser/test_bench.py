"""A bench without YAML: from an empty folder to a file that runs on simulated instruments, in the browser alone."""

import pytest

from bench.config.bench_file.file import load_bench
from tests.browser.conftest import empty_panel
from tests.support.browser_runs import simulating


@pytest.fixture
def resources(tmp_path):
    """The simulated instruments of a shipped bench, each on a TCP port, by name."""
    with simulating("bench-lan", tmp_path, "--speed", "1000") as told:
        yield {
            one["name"]: "TCPIP0::{}::{}::SOCKET".format(*one["tcp"].split(":"))
            for one in told["instruments"]
        }


panel = pytest.fixture(empty_panel)


def test_a_bench_is_made_found_written_and_tried_without_a_file_opened(visit, panel, resources):
    page = visit("/", viewport={"width": 390, "height": 844})
    page.click("nav >> text=Benches")
    assert "no bench file yet" in page.inner_text("main")
    page.select_option("#start", "bench-lan")
    page.fill("#new", "hall-3")
    page.click("button >> text=New bench")

    page.fill("#further", "\n".join(resources.values()))
    page.click("text=Ask for identities")
    page.wait_for_selector(".resource >> nth=2")
    page.wait_for_selector("[data-searching]", state="detached")
    assert page.locator(".resource", has_text="MY53200001").count() >= 1
    assert [" shows " in row for row in page.locator(".resource").all_inner_texts()] == [True] * 3
    for number, resource in enumerate(resources.values()):
        assert page.input_value(f"[name='resource:{number}']") == resource
        page.select_option(f"[id='is:{number}']", "xyz"[number])
    page.fill("[id='unit_under_test.serial']", "17-042")
    page.fill("[id='unit_under_test.scale_factors.y']", "-2.14")
    page.fill("[id='line_frequency']", "55 Hz")
    page.click("text=Write the file >> nth=0")
    page.wait_for_selector("[role=alert]")
    assert not (panel.runs.parent / "empty" / "config").exists()
    wrong = page.locator(".field.wrong")
    assert wrong.count() == 2
    assert "without a unit" in wrong.nth(1).inner_text()
    assert page.input_value("[id='unit_under_test.serial']") == "17-042"  # what is typed survives
    page.fill("[id='unit_under_test.scale_factors.y']", "-2.12 V/g")
    page.fill("[id='line_frequency']", "60 Hz")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.click("text=Write the file >> nth=0")
    page.wait_for_selector("text=hall-3.yaml was written")

    file = load_bench(panel.runs.parent / "empty" / "config" / "hall-3.yaml")
    assert [meter.resource for meter in file.instruments.voltmeters] == list(resources.values())
    assert (file.name, file.line_frequency, file.unit_under_test.serial) == ("hall-3", 60.0, "17-042")

    page.click("text=Test the instruments")
    page.wait_for_selector(".results li >> nth=3")
    told = page.inner_text(".results")
    assert told.count("✓") == 4, told
    assert "34461A" in page.locator("fieldset", has_text="Voltmeter of x").nth(0).inner_text()
    page.click("#try >> text=Check and try it")
    page.wait_for_selector("text=completed on simulated instruments")
    assert page.locator("text=Start on the bench").count() == 1


def test_a_choice_shows_its_fields_and_keeps_what_is_typed(visit, panel):
    page = visit("/bench/form?start=paper-stand&name=two", viewport={"width": 1024, "height": 768})
    page.fill("[id='description']", "kept")
    page.select_option("[id='instruments.head.driver']", "zaber")
    page.wait_for_selector("[id='instruments.head.steps_per_degree']")
    assert page.input_value("#description") == "kept"
    page.click("text=More fields of Head")
    page.select_option("[id='form:instruments.head.certificate.values']", "8")
    page.fill("[id='instruments.head.certificate.values[8].angle']", "315")
    page.fill("[id='form:installation']", "U1")
    page.keyboard.press("Tab")  # leaves the field: the new installation has its fields
    page.fill("[id='installations.U1.axes']", "-x, z, y")
    page.select_option("[id='form:voltmeters']", "1")
    page.wait_for_selector("[id='instruments.voltmeters[1].inputs.x']")
    assert page.input_value("[id='installations.U1.axes']") == "-x, z, y"
    wrong = page.locator(
        ".field.wrong", has=page.locator("[id='instruments.head.certificate.values[8].angle']")
    )
    assert "without a unit" in wrong.inner_text()
    assert page.evaluate("document.documentElement.scrollWidth") <= 1024
    assert page.input_value("[id='instruments.voltmeters[1].inputs.z']") == "103"
    assert page.locator("[id='instruments.voltmeters[2].driver']").count() == 0
