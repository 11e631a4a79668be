"""The page on units: its code prints what stands below it."""

import contextlib
import io
import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "units.md"


def test_the_code_prints_what_the_page_says():
    text = PAGE.read_text(encoding="utf-8")
    code, shown = re.findall(r"^```(?:python)?\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, str(PAGE), "exec"), {})  # noqa: S102 - our own page
    assert printed.getvalue() == shown
