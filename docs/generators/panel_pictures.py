"""Pictures of the panel's pages, taken from dry runs in the system's Chromium, in the light and the dark theme."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from bench.panel.access import Role
from docs.generators.workbench import standing_in, told

SCHEMES: Final = ("light", "dark")
TURNS: Final = 13
"""So many angles are answered before the picture of the live page."""
ENDED: Final = {
    "panel-sign-in": "/sign-in",
    "panel-runs": "/",
    "panel-start": "/start",
    "panel-benches": "/bench",
    "panel-verdict": "/runs/unit-17/verdict",
    "panel-plots": "/runs/unit-17/plots",
}
"""Pages that are there once a run has ended, by the name of their picture."""
WAITED: Final = {"panel-plots": "#plots-sections svg"}
"""What a page must have before its picture is taken."""
PICTURES: Final = {
    "panel-sign-in": "The page to sign in: a field for the token.",
    "panel-runs": "The list of runs: state, verdict, unit, bench, operator, and a button to resume.",
    "panel-start": "The page to start a run: a card for each procedure with its points, duration and mountings.",
    "panel-benches": "The list of bench files, and the shipped files that a new one may begin from.",
    "panel-verdict": "The verdict of a finished run: passed, the risk, and the error at each verification point.",
    "panel-plots": "Residuals against angle and time for each channel, with buttons to choose and to save.",
    "panel-mount": "A question: mount the block in installation 2, with a drawing of platform, block and axes.",
    "panel-live": "The live page at a turn: the task with its drawing, angle, controls, last reading, residuals.",
    "panel-watching": "The same run on a telephone, for somebody who may only look and stop.",
}
WIDE: Final[Any] = {"width": 1280, "height": 1000}
NARROW: Final[Any] = {"width": 390, "height": 844}


def write_pictures(folder: Path) -> None:
    """Write the pictures into a folder; none, and a line on standard error, where no Chromium is found."""
    from tests.support.browsers import what_is_missing

    if missing := what_is_missing():
        sys.stderr.write(f"no pictures of the panel: {missing}\n")
        return
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as above, standing_in(Path(above)):
        told("init my-lab")
        with standing_in(Path("my-lab")):
            _take(Path(above) / "my-lab" / "runs", folder)


def _take(runs: Path, folder: Path) -> None:
    from playwright.sync_api import sync_playwright

    from tests.support.browser_runs import Begun
    from tests.support.browsers import find_chromium
    from tests.support.served_panel import served

    runs.mkdir()
    finished = Begun(runs, "unit-17", "quick", None)
    finished.ended()
    going = Begun(runs, "unit-18", "quick", "folder")
    try:
        going.wait_for_events()
        with served(runs) as panel, sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
            page = browser.new_page(viewport=WIDE)
            page.goto(f"{panel.url}/sign-in")
            _shoot(page, folder, "panel-sign-in")
            panel.sign_in(page)
            for name, path in ENDED.items():
                if name != "panel-sign-in":
                    page.goto(panel.url + path)
                    page.wait_for_selector(WAITED.get(name, "main"))
                    _shoot(page, folder, name)
            _walk(page, f"{panel.url}/runs/unit-18/", going, folder)
            viewer = browser.new_page(viewport=NARROW)
            panel.sign_in(viewer, "vera", Role.VIEWER)
            viewer.goto(f"{panel.url}/runs/unit-18/")
            viewer.wait_for_selector("#plots[data-newest]")
            _shoot(viewer, folder, "panel-watching")
            browser.close()
    finally:
        going.close()


def _shoot(page: Any, folder: Path, name: str) -> None:
    """Take a page in both themes, without the empty part below its content."""
    size = page.viewport_size
    low = page.evaluate("Math.ceil(document.querySelector('main').getBoundingClientRect().bottom)")
    clip = {"x": 0, "y": 0, "width": size["width"], "height": min(size["height"], low)}
    for scheme in SCHEMES:
        page.emulate_media(color_scheme=scheme)
        page.screenshot(path=folder / f"{name}-{scheme}.png", animations="disabled", clip=clip)


def _walk(page: Any, address: str, run: Any, folder: Path) -> None:
    """Answer the questions of a run up to the middle of it, and take the live page there."""
    from tests.support.browser_runs import answer_on, prompt_of, typed_for

    page.goto(address)
    page.click("text=Take control")
    asked_id = ""
    for number in range(TURNS + 4):
        asked_id = prompt_of(page, asked_id)
        asked = run.of_type("asked")[-1]
        if asked["action"]["do"] == "mount":
            _shoot(page, folder, "panel-mount")
        answer_on(page, typed_for(asked, number))
    prompt_of(page, asked_id)
    page.wait_for_selector("#plots[data-newest]")
    _shoot(page, folder, "panel-live")
