"""The report on the prose: it counts a hand-made page right."""

from benchmarks.prose import BANNED, banned_in, prose_of, sentences

PAGE = """---
title: no sentence
---
# A heading is none

Turn the head to 45.5 degrees. Read `bench run x --y` [here](a.md#b), e.g. twice! Whoever
asks is told.

- One item
- Another one. With two.

| a table | has none. None at all. |
|---|---|

<!-- checked: A comment. Not counted. -->
```console
$ bench run. It is told.
```

    indented. Code.

![a picture](one.png)
"""


def test_a_page_is_counted_right():
    found = prose_of("page.md", PAGE, ["whoever", "is told", "as"])
    assert [len(one.split()) for one in sentences(PAGE)] == [6, 5, 4, 2, 2, 2]
    assert found.lengths == (6, 5, 4, 2, 2, 2)
    assert found.words == len(PAGE.split())
    assert found.mean == 21 / 6
    assert found.long_share == 0
    assert found.pictures == 1
    assert found.banned == ("whoever", "is told")


def test_what_a_command_writes_into_a_page_does_not_count():
    table = "<!-- records: made by python -m one --page -->\n\n| a | b |\n\n<!-- end of the records -->\n"
    assert prose_of("", f"One word.\n{table}Two words.", []).words == 4


def test_a_long_sentence_is_one_over_25_words():
    assert prose_of("", "a " * 26 + ".", []).long_share == 1
    assert prose_of("", "a " * 25 + ".", []).long_share == 0


def test_banned_phrases_are_lower_case_and_each_once():
    lines = BANNED.read_text(encoding="utf-8").splitlines()
    assert lines == sorted({line.strip().lower() for line in lines})


def test_a_banned_phrase_is_found_over_line_ends_and_between_literals():
    text = 'x = (\n    "Whoever asks is"\n    f"told: {this}"\n)\n# it goes\n# round. Is toldly, basis told\n'
    assert list(banned_in(text, ["goes round", "is told", "whoever"])) == [
        (5, "goes round"),
        (2, "is told"),
        (2, "whoever"),
    ]
