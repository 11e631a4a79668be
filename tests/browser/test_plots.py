"""Plots that one can ask: by keyboard, by mouse, by touch; zoom, choice, overlay, and what they save."""

import csv
import io
import re
import shutil

import pytest

Y_ANGLE = 'svg[data-channel="y"][data-along="angle"]'


@pytest.fixture
def runs(panel, plotted):
    for name in ("earlier", "later"):
        shutil.copytree(plotted / name, panel.runs / name)
    return panel.runs


@pytest.fixture
def page(visit, runs):
    return opened(visit, {"width": 1100, "height": 900})


def opened(visit, size, **options):
    page = visit("/runs/later/plots", viewport=size, **options)
    page.wait_for_selector("[data-shown]")
    return page


@pytest.fixture
def told(page, panel):
    return page.request.get(f"{panel.url}/runs/later/plots/data").json()


def test_a_rounded_zero_has_no_sign(page):
    for value, shown in ((-1e-4, "0"), (1e-4, "0"), (-0.6, "−600"), (0.6, "+600")):
        assert page.evaluate(f"BenchDrawing.withU({value}, 0.645, 'V')") == f"{shown} ± 645 mV"


def part(page, name="residuals"):
    return page.locator(f'section[data-plots="{name}"]').first


def test_the_keyboard_reads_every_point_with_its_numbers(page, told):
    plot = part(page).locator(Y_ANGLE)
    plot.focus()
    page.keyboard.press("End")
    said = part(page).locator(".plot-said").inner_text()
    value, u, unit, angle = re.match(r"y: ([+−][\d.]+) ± ([\d.]+) (.)V \(u\); (−?[\d.]+)°", said).groups()
    size = {"µ": 1e-6, "m": 1e-3}[unit]
    found = [
        p for p in told["residuals"]["points"]
        if abs(p["residual"][1] / size - float(value.replace("−", "-"))) < 0.6 * 10 ** -len(value.partition(".")[2])
        and abs(p["angle_deg"] - float(angle.replace("−", "-"))) < 1e-4
    ]  # fmt: skip
    assert len(found) == 1
    assert float(u) == pytest.approx(found[0]["u"][1] / size, rel=0.06)
    assert f"installation {found[0]['installation']}, pass {found[0]['pass']}" in said
    assert "; ".join(plot.locator(".label-line").all_text_contents()) == said
    places = {said}
    for _ in told["residuals"]["points"]:
        page.keyboard.press("ArrowLeft")
        places.add(part(page).locator(".plot-said").inner_text())
    assert len(places) == len(told["residuals"]["points"])
    page.keyboard.press("ArrowDown")
    assert part(page).locator(".plot-said").inner_text().startswith("z: ")
    assert page.evaluate("document.activeElement.dataset.channel") == "z"
    page.keyboard.press("Escape")
    assert page.locator(".label-line").count() == 0


def test_a_mark_under_the_mouse_or_finger_says_its_numbers(visit, runs, page):
    mark = part(page, "delta-g").locator("svg").first.locator(".mark").nth(1)
    mark.hover()
    assert part(page, "delta-g").locator(".label-line").first.text_content().startswith("Δg: ")
    phone = opened(visit, {"width": 390, "height": 844}, has_touch=True, is_mobile=True, name="ben")
    part(phone, "delta-g").locator("svg").first.locator(".mark").nth(1).tap()
    assert "U, k = 2" in part(phone, "delta-g").locator(".plot-said").inner_text()


def ticks(page):
    return part(page).locator(Y_ANGLE).locator(".tick").all_text_contents()


def drag(page, plot, across, down):
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    at = [
        (box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in zip(across, down, strict=True)
    ]
    page.mouse.move(*at[0])
    page.mouse.down()
    page.mouse.move(*at[1], steps=4)
    assert plot.locator(".zoom-box").count() == 1
    page.mouse.up()


def test_dragging_zooms_and_a_double_click_shows_the_whole_again(page):
    whole, plot = ticks(page), part(page).locator(Y_ANGLE)
    drag(page, plot, (0.45, 0.75), (0.2, 0.7))
    near = ticks(page)
    assert near != whole
    assert "0" not in near[:4]
    assert "360" not in near
    plot.dblclick()
    assert ticks(page) == whole
    part(page).get_by_role("button", name="Zoom in").click()
    assert ticks(page) != whole
    part(page).get_by_role("button", name="Zoom out").click()
    assert ticks(page) == whole
    plot.focus()
    page.keyboard.press("+")
    assert ticks(page) != whole
    part(page).get_by_role("button", name="Reset").click()
    assert ticks(page) == whole


def test_a_finger_zooms_along_the_axis_and_still_scrolls_the_page(visit, runs):
    phone = opened(visit, {"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    whole, plot = ticks(phone), part(phone).locator(Y_ANGLE)
    plot.scroll_into_view_if_needed()
    session, box = phone.context.new_cdp_session(phone), plot.bounding_box()

    def swipe(across, down):
        for kind, i in (
            ("touchStart", 0),
            ("touchMove", 0.3),
            ("touchMove", 0.7),
            ("touchMove", 1),
            ("touchEnd", None),
        ):
            at = [] if i is None else [
                {"x": box["x"] + box["width"] * 0.4 + i * across, "y": box["y"] + box["height"] * 0.5 + i * down}
            ]  # fmt: skip
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    swipe(100, 2)
    near = ticks(phone)
    assert near != whole
    before = phone.evaluate("scrollY")
    swipe(2, -150)
    phone.wait_for_timeout(300)
    assert phone.evaluate("scrollY") > before
    assert ticks(phone) == near


def seen(page):
    return [
        (one.get_attribute("data-channel"), one.get_attribute("data-along"))
        for one in part(page).locator("svg.plot:visible").all()
    ]


def test_channel_and_axis_are_chosen_by_buttons(page):
    assert len(seen(page)) == 6
    part(page).get_by_role("button", name="y", exact=True).click()
    assert seen(page) == [("y", "angle"), ("y", "time")]
    assert page.evaluate("document.activeElement.textContent") == "y"
    part(page).get_by_role("button", name="time").click()
    assert seen(page) == [("y", "time")]
    part(page).get_by_role("button", name="all").click()
    assert seen(page) == [("x", "time"), ("y", "time"), ("z", "time")]


def test_the_previous_run_lies_in_grey_below(page, told, panel):
    plot = part(page).locator(Y_ANGLE)
    assert plot.locator(".grey").count() == 0
    button = part(page).get_by_role("button", name="previous run earlier")
    button.click()
    assert button.get_attribute("aria-pressed") == "true"
    assert plot.locator(".grey").count() == len(told["previous"]["residuals"]["points"])
    assert "grey dots: run earlier" in part(page).inner_text()
    button.click()
    assert plot.locator(".grey").count() == 0
    page.goto(f"{panel.url}/runs/earlier/plots")
    page.wait_for_selector("[data-shown]")
    assert page.get_by_role("button", name="previous run").count() == 0


def test_models_of_the_diagnosis_are_chosen_by_buttons(page, told):
    diagnosed = part(page, "diagnosis")
    label = diagnosed.locator(Y_ANGLE).get_attribute("aria-label")
    diagnosed.get_by_role("button", name="after").click()
    assert diagnosed.locator(Y_ANGLE).get_attribute("aria-label") != label
    bars = part(page, "ranking").locator(".bar")
    assert bars.count() == len(told["diagnosis"]["ranking"][0]["rivals"])


def saved(page, name, text):
    with page.expect_download() as download:
        part(page, name).locator(".plot-tools").get_by_text(text, exact=True).click()
    return download.value.suggested_filename, download.value.path().read_bytes()


def test_tables_and_pictures_are_saved_and_the_table_is_the_json(page, told):
    name, content = saved(page, "residuals", "CSV")
    assert name == "later-residuals.csv"
    lines = [line for line in content.decode().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(io.StringIO("\n".join(lines))))
    points = [p for one in (told, told["previous"]) for p in one["residuals"]["points"]]
    assert [[float(row[f"residual_{c}"]) for c in "xyz"] for row in rows] == [p["residual"] for p in points]
    assert [float(row["time_s"]) for row in rows] == [p["time_s"] for p in points]
    assert saved(page, "residuals", "Excel")[1][:2] == b"PK"
    asked_for = []
    page.on("request", lambda request: asked_for.append(request.url))
    name, content = saved(page, "delta-g", "PNG")
    assert (name, content[:8]) == ("later-delta-g.png", b"\x89PNG\r\n\x1a\n")
    name, content = saved(page, "delta-g", "SVG")
    assert name == "later-delta-g.svg"
    assert b"SIMULATED" in content
    assert b"<style" not in content
    assert [url for url in asked_for if not url.startswith("blob:")] == []


def test_the_live_page_has_the_same_plots_with_the_previous_run(page, panel):
    page.goto(f"{panel.url}/runs/later/")
    page.wait_for_selector("#plots[data-newest]")
    page.locator("#plots svg[data-channel=x][data-along=time] .mark").nth(57).wait_for()
    plots = page.locator("#plots")
    plots.locator(Y_ANGLE).focus()
    assert plots.locator(".plot-said").inner_text().startswith("y: ")
    plots.get_by_role("button", name="previous run").click()
    page.wait_for_selector("#plots .grey")
    assert plots.locator(Y_ANGLE).locator(".grey").count() == 58
    size = page.evaluate(
        "performance.getEntriesByType('resource').filter((one) => one.name.endsWith('.js'))"
        ".reduce((sum, one) => sum + one.decodedBodySize, 0)"
    )
    assert 0 < size <= 200_000
