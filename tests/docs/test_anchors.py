"""Links into earlier editions of the pages still lead to what they meant."""

import re

from docs.generators.anchors import earlier_anchors, moved
from tests.support.pages import DOCS, ROOT

EARLIER = ROOT / "tests" / "data" / "earlier-headings.tsv"
"""Page and heading of each heading of an edition that was public, the first three levels."""


def headings(page):
    text = re.sub(r"^```.*?^```$", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.M | re.S)
    return {line.lstrip("# ") for line in text.splitlines() if line.startswith("#")}


def test_every_earlier_heading_is_there_or_has_moved_to_one_that_is():
    lost = []
    for line in EARLIER.read_text(encoding="utf-8").splitlines():
        page, heading = line.split("\t")
        there = headings(page)
        if heading not in there and moved().get(page, {}).get(heading) not in there:
            lost.append(line)
    assert lost == []


def test_what_has_moved_is_no_heading_any_more():
    for page, names in moved().items():
        assert not names.keys() & headings(page), page


def test_a_heading_keeps_the_anchors_of_its_own_and_of_earlier_titles():
    expected = ["8-results", "verify-another-day", "9-verify-another-day"]
    assert earlier_anchors("real-bench.md", "8. Results") == expected
