"""Screenshots of the pages that the program writes: dry runs, their reports, a diagnosis, a control chart.

They are taken when the site is built, in the system's Chromium, each in the light and the dark theme.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

from docs.generators.workbench import workbench

SCHEMES: Final = ("light", "dark")
WIDE: Final[Any] = {"width": 900, "height": 1000}
SHARP: Final = 1.5
"""Pixels of a picture for one of the page."""
FILES: Final = {"report": "runs/first/report.html", "fault": "runs/bent/report.html",
                "diagnosis": "runs/bent/diagnose.html", "tie": "runs/tied/diagnose.html",
                "chart": "chart.html"}  # fmt: skip
"""Where the runs leave the pages."""
_SECTION: Final = "section:has(h2:text-is('{}')) {}"
PLACES: Final = {
    "report-verdict": ("report", "section[aria-label=Verdict]"),
    "report-coefficients": ("report", _SECTION.format("Model and coefficients", "div.wide:has(caption)")),
    "report-residuals": ("report", _SECTION.format("Residuals", "figure >> nth=0")),
    "report-verification": ("report", _SECTION.format("Verification", "figure >> nth=0")),
    "fault-residuals": ("fault", _SECTION.format("Residuals", "figure >> nth=0")),
    "diagnosis-verdict": ("diagnosis", "section[aria-label=Verdict]"),
    "diagnosis-signals": ("diagnosis", _SECTION.format("Measured and simulated", "figure >> nth=0")),
    "diagnosis-found": ("diagnosis", _SECTION.format("What was found", "").strip()),
    "diagnosis-gap": ("diagnosis", _SECTION.format("How far the gap closes", "figure >> nth=0")),
    "diagnosis-tie": ("tie", "section[aria-label=Verdict]"),
    "chart": ("chart", "figure >> nth=0"),
}
"""By the name of a picture the page, and what of it is shown."""
PICTURES: Final = {
    "report-verdict": "The first box of a report: verification passed, the worst error with its U, the "
    "limit, the "
    "rule and its risk; below it fit, readings, unit, procedure and instruments.",
    "report-coefficients": "Table 1 of a report: the twelve coefficients, each with u, the part that the "
    "readings "
    "show, and U.",
    "report-residuals": "Residuals of the three channels against the angle of the head, scattered within "
    "a grey band.",
    "report-verification": "The error of the modulus at four verification points with bars, between "
    "dashed limits.",
    "fault-residuals": "Residuals that leave their grey band in waves, the same in each pass.",
    "diagnosis-verdict": "The first box of a diagnosis: found and named, head eccentricity, how far the "
    "gap closes, "
    "the sizes found, and what to do.",
    "diagnosis-signals": "Signals measured and simulated: left as they are, right magnified after the "
    "model is "
    "removed; points are measured, bars simulated with what was found.",
    "diagnosis-found": "What was found: the name with its sizes, how sure it is, what else it could be, "
    "and bars of "
    "the evidence of the most plausible explanations.",
    "diagnosis-gap": "Reduced chi-square of each held-out part before and after an effect is named; "
    "afterwards it is near 1.",
    "diagnosis-tie": "The first box of a diagnosis that cannot separate two names: the odds of each, "
    "and the "
    "procedure that would decide.",
    "chart": "Control charts of a check block: T squared, its moving average and the scatter of a reading"
    " of each "
    "run after the baseline; the last run is far above the limit.",
}  # fmt: skip
"""By the name of a picture its alternative text."""


def write_screens(folder: Path) -> None:
    """Write the pictures into a folder; none, and a line on standard error, where no Chromium is found."""
    from tests.support.browsers import what_is_missing

    if missing := what_is_missing():
        sys.stderr.write(f"no screenshots: {missing}\n")
        return
    _take(workbench().folder, folder)


def _take(bench: Path, folder: Path) -> None:
    from playwright.sync_api import sync_playwright

    from tests.support.browsers import find_chromium

    folder.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser: Any = playwright.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        for scheme in SCHEMES:
            page: Any = browser.new_page(
                viewport=WIDE,
                device_scale_factor=SHARP,
                color_scheme=scheme,
            )
            page.set_default_timeout(60_000)
            opened = ""
            for name, (of, place) in PLACES.items():
                if of != opened:
                    page.goto((bench / FILES[of]).as_uri())
                    opened = of
                page.locator(place).first.screenshot(
                    path=folder / f"{name}-{scheme}.png", animations="disabled"
                )
            page.close()
        browser.close()
