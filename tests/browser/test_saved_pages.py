"""Saved pages of a run, as files: legible on a telephone, nothing that keeps people out."""

import pytest

from tests.browser.test_pages import RULES

WIDTH = "document.documentElement.scrollWidth"


@pytest.mark.figures
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_report_and_diagnosis_fit_a_telephone_and_keep_nobody_out(
    chromium, bench, paper_run, tmp_path, scheme
):
    from axe_playwright_python.sync_playwright import Axe

    assert bench("report", "run")[0] in (0, None)
    assert bench("diagnose", "run")[0] in (0, None)
    context = chromium.new_context(viewport={"width": 390, "height": 844}, color_scheme=scheme)
    try:
        page = context.new_page()
        for name in ("report.html", "diagnose.html"):
            file = next(tmp_path.rglob(name))
            page.goto(file.as_uri())
            assert page.evaluate(WIDTH) <= 391  # a pixel of rounding
            told = Axe().run(page, options={"runOnly": {"type": "tag", "values": RULES}}).response
            assert [rule["id"] for rule in told["violations"]] == []
            assert str(tmp_path) not in page.inner_text("main")
            page.add_style_tag(content="* { letter-spacing:.15em }")  # as in a font a quarter wider
            assert page.evaluate(WIDTH) <= 391
    finally:
        context.close()
