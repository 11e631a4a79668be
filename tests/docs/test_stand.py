"""The page on the paper's stand: eleven parts, and no effect that the catalogue has not."""

import re
from pathlib import Path

from bench.model import CATALOGUE

PAGE = (Path(__file__).parents[2] / "docs" / "stand.md").read_text(encoding="utf-8")
ROWS = [line.strip("|").split("|") for line in PAGE.splitlines() if re.match(r"\| \d+ \|", line)]
OF_THE_BLOCK = {"block"}
"""What the page sums up as the effects of the block."""


def test_both_tables_have_the_eleven_parts_in_their_order():
    assert [int(row[0]) for row in ROWS] == 2 * list(range(1, 12))


def test_effects_are_those_of_the_catalogue_and_none_of_the_stand_is_missing():
    named = {name for row in ROWS[11:] for name in re.findall(r"`(\w+)`", row[-1])}
    assert named <= CATALOGUE.keys()
    outside = {name for name, effect in CATALOGUE.items() if effect.subsystem not in OF_THE_BLOCK}
    assert outside <= named
