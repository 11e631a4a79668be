"""Every message of the program is in the list, and the page on troubles quotes only messages of the program."""

import re
from collections import defaultdict
from itertools import pairwise

import pytest

from benchmarks.messages import ELLIPSIS, PACKAGES, in_code, in_script, in_template, messages
from tests.support.commands import refused
from tests.support.pages import DOCS, ROOT

pytestmark = pytest.mark.slow  # to list all messages takes seconds
PAGE = DOCS / "troubleshooting.md"
QUOTED = [
    line[1:-1] for line, after in pairwise(PAGE.read_text(encoding="utf-8").splitlines())
    if line.startswith("`") and after.startswith(": ")
]  # fmt: skip


def pattern(quoted):
    """What a text must hold: the words of a quotation; where it has an ellipsis anything may stand."""
    words = [re.escape(piece.strip()) for piece in quoted.split(ELLIPSIS) if piece.strip(" ';,()")]
    return re.compile(".*?".join(words), re.DOTALL)


def is_of_the_program(quoted):
    return any(pattern(quoted).search(one.text) for one in messages())


@pytest.mark.parametrize("quoted", QUOTED)
def test_a_message_on_the_page_is_one_of_the_program(quoted):
    assert len(re.sub(r"\W", "", quoted)) >= 6, "too little of it to be looked for"
    assert is_of_the_program(quoted), quoted


def test_the_page_quotes_many_and_the_check_can_fail():
    assert len(QUOTED) >= 15
    assert not is_of_the_program("the voltmeter is out of sorts")


SOURCE = '''
"""A docstring is none."""

def f(x):
    """Return what is wrong."""
    if x:
        raise Refused(f"{x}: it is broken; " + "mend it")
    problems.append("it is late")
    ask(Prompt(text="Turn the head"))
    out.print("note: all done")
    raise InstrumentLost(x.name, "it is silent", "switch it on")
    return f"no {x['key'] or 'such a thing'} here"
'''


def test_kinds_texts_and_remedies_of_a_module():
    found = [(one.kind, one.line, one.text, one.remedy) for one in in_code("m.py", SOURCE)]
    assert found == [
        ("error", 7, "…: it is broken; mend it", "mend it"),
        ("error", 8, "it is late", ""),
        ("prompt", 9, "Turn the head", ""),
        ("note", 10, "note: all done", ""),
        ("error", 11, "…: it is silent; switch it on", "switch it on"),
        ("part", 12, "no … here", ""),
        ("part", 12, "such a thing", ""),
    ]


def test_texts_of_pages_and_scripts():
    page = (
        "<h1>Two words</h1>{# not me, please #}\n<p title=\"on a title\">{{ 'in it' if x else y }} and more"
    )
    page += "{% if a %}more words{% endif %}"
    assert [one.text for one in in_template("a.j2", page)] == [
        "Two words",
        "on a title",
        "in it",
        "and more",
        "more words",
    ]
    script = "// no, 'not this one'\nsay(`lost the ${connection}`); $('#a b');\n"
    assert [(one.line, one.text) for one in in_script("a.js", script)] == [(2, "lost the …")]


RAISED = re.compile(r"^( *)raise [^\n]*(?:\n\1 +[^\n]*)*", re.M)
LITERAL = re.compile(r"(?<![\w\"'])f?\"((?:[^\"\\\n]|\\.)*)\"")


def test_every_text_that_an_exception_is_raised_with_is_in_the_list():
    """Found here by lines and quotation marks, not by the syntax tree."""
    listed = defaultdict(str)
    for one in messages():
        listed[one.path] += f"{one.text}\n"
    seen = 0
    for path in (path for top in PACKAGES for path in (ROOT / top).rglob("*.py")):
        for raised in RAISED.finditer(path.read_text(encoding="utf-8")):
            for literal in LITERAL.findall(raised[0]):
                pieces = [
                    piece.strip() for piece in re.split(r"\{(?:[^{}]|\{[^{}]*\})*\}|\\.|[{}']", literal)
                ]
                for piece in (piece for piece in pieces if " " in piece):
                    seen += 1
                    assert piece in listed[str(path.relative_to(ROOT))], f"{path}: {literal}"
    assert seen > 800


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", "nothing-there"],
        ["run", "paper", "--bench", "no-such-bench", "--dry-run"],
        ["show", "no-such-run"],
        ["budget", "no-such-procedure"],
        ["require", "--accuracy", "often"],
        ["catalogue", "ask", "--of", "x"],
        ["help", "brew"],
        ["export", "nothing"],
    ],
)
def test_what_a_command_prints_when_it_refuses_is_in_the_list(bench, words):
    line = refused(bench(*words))
    assert any(pattern(one.text).search(line) for one in messages() if len(one.text) > 20), line
