"""Look at the built site as its readers do: `python -m docs.generators.accessible docs/_build/html`.

Every page must have all its pictures, and ask nothing of another host. A handful of pages, one with moving text,
is held against the rules of WCAG 2.2 AA in the light and the dark theme. Without a Chromium nothing is checked.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

PAGES: Final = (
    "index",
    "tutorial",
    "real-bench",
    "stand",
    "diagnosis",
    "panel",
    "gallery",
    "reference/measured",
)
RULES: Final = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
SCHEMES: Final = ("light", "dark")
_BROKEN: Final = (
    "[...document.images].filter(i => !(i.complete && i.naturalWidth)).map(i => i.getAttribute('src'))"
)


def main(site: Path) -> list[str]:
    """Return what is wrong with the pages of a site, a line each."""
    from playwright.sync_api import sync_playwright

    from tests.support.browsers import find_chromium

    wrong: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        page: Any = browser.new_page(viewport={"width": 1300, "height": 900}, reduced_motion="reduce")
        asked: set[str] = set()
        page.on("request", lambda request: asked.add(request.url))
        for path in sorted(site.rglob("*.html")):
            if "_static" not in path.parts:
                page.goto(path.as_uri())
                wrong += [f"{path.relative_to(site)}: no picture {name}" for name in page.evaluate(_BROKEN)]
        wrong += [f"asks for {url}" for url in sorted(asked) if not url.startswith(("file:", "data:"))]
        for scheme in SCHEMES:
            page.emulate_media(color_scheme=scheme)
            for name in PAGES:
                page.goto((site / f"{name}.html").as_uri())
                wrong += [f"{name}.html, {scheme}: {told}" for told in _violations(page)]
        browser.close()
    return wrong


def _violations(page: Any) -> list[str]:
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page, options={"runOnly": {"type": "tag", "values": RULES}}).response["violations"]
    return [f"{rule['id']}: {rule['nodes'][0]['html'][:160]}" for rule in found]


if __name__ == "__main__":
    from tests.support.browsers import what_is_missing

    if missing := what_is_missing():
        sys.stderr.write(f"the site was not looked at: {missing}\n")
        sys.exit(0)
    problems = main(Path(sys.argv[1]).resolve())
    sys.exit("\n".join(problems) or None)
