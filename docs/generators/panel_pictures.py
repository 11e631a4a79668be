"""Pictures of the panel's pages, taken from a dry run in the system's Chromium; without one the page says so."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from bench.panel.access import Role

THERE: Final = Path(__file__).parents[1] / "reference"
FOLDER: Final = "panel"
TURNS: Final = 13
"""So many angles are answered before the picture of the live page."""

PICTURES: Final = {
    "sign-in": "Signing in with a token.",
    "runs": "The runs: state, verdict, unit, bench, operator, and how to go on.",
    "start": "A run is chosen, then checked and tried on simulated instruments before anything moves.",
    "mount": "A question: the mounting is a drawing made from the installation of the bench file.",
    "live": "The live page at a turn, for the one in control.",
    "watching": "The same run on a telephone, in dark, for a viewer.",
    "verdict": "The verdict of a finished run.",
}
WIDE: Final[Any] = {"width": 1600, "height": 1000}
NARROW: Final[Any] = {"width": 390, "height": 844}


def write_pictures(folder: Path) -> None:
    """Write the pictures into a folder of their own, which is empty where they cannot be taken; say then why."""
    from tests.support.browsers import what_is_missing

    shutil.rmtree(folder / FOLDER, ignore_errors=True)
    if missing := what_is_missing():
        sys.stderr.write(f"no pictures of the panel: {missing}\n")
        return
    (folder / FOLDER).mkdir(parents=True)
    with tempfile.TemporaryDirectory() as runs:
        _take(Path(runs), folder / FOLDER)


def fragment() -> str:
    """Return the pictures as a part of a page."""
    if not all((THERE / FOLDER / f"{name}.png").is_file() for name in PICTURES):
        return "*There are no pictures here: no Chromium was found when this site was built.*"
    return "\n\n".join(
        f"![{words}](reference/{FOLDER}/{name}.png)\n\n*{words}*" for name, words in PICTURES.items()
    )


def _take(runs: Path, folder: Path) -> None:
    from playwright.sync_api import sync_playwright

    from tests.support.browser_runs import Begun
    from tests.support.browsers import find_chromium
    from tests.support.served_panel import served

    finished = Begun(runs, "unit-17", "quick", None)
    finished.ended()
    going = Begun(runs, "unit-18", "quick", "folder")
    try:
        going.wait_for_events()
        with served(runs) as panel, sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
            page = browser.new_page(viewport=WIDE)
            page.goto(f"{panel.url}/sign-in")
            page.screenshot(path=folder / "sign-in.png")
            panel.sign_in(page)
            for name, path in (("runs", "/"), ("start", "/start"), ("verdict", "/runs/unit-17/verdict")):
                page.goto(panel.url + path)
                page.screenshot(path=folder / f"{name}.png")
            _walk(page, f"{panel.url}/runs/unit-18/", going, folder)
            viewer = browser.new_page(viewport=NARROW, color_scheme="dark")
            panel.sign_in(viewer, "vera", Role.VIEWER)
            viewer.goto(f"{panel.url}/runs/unit-18/")
            viewer.wait_for_selector("#plots[data-newest]")
            viewer.screenshot(path=folder / "watching.png")
            browser.close()
    finally:
        going.close()


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
            page.screenshot(path=folder / "mount.png")
        answer_on(page, typed_for(asked, number))
    prompt_of(page, asked_id)
    page.wait_for_selector("#plots[data-newest]")
    page.screenshot(path=folder / "live.png", full_page=True)
