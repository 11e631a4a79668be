"""Pages made from the code: each thing of the program stands on its page, in links that hold; its messages, too."""

import importlib
import re
from collections import defaultdict
from itertools import pairwise

import numpy as np
import pytest

from bench.calibration import ESTIMATORS
from bench.config.bench_file.file import BenchFile
from bench.config.model_file import load_model
from bench.config.procedure.file import VERBS, ProcedureFile
from bench.model.effects import CATALOGUE
from bench.readings import csv
from benchmarks.messages import ELLIPSIS, PACKAGES, in_code, in_script, in_template, messages
from docs import generators
from docs.generators import PAGES, write_pages
from docs.generators.commands import commands
from docs.generators.forms import anchor, reachable
from docs.generators.instruments import drivers
from tests.support.commands import refused
from tests.support.pages import DOCS, ROOT

LINK = re.compile(r"\]\(([^)\s]*)\)")


@pytest.fixture(scope="module")
def made():
    return {name: page() for name, page in PAGES.items()}


def headings(text):
    return {anchor(line.lstrip("# ")) for line in text.splitlines() if line.startswith("#")}


def test_every_key_of_files_that_people_write_stands_on_a_page(made):
    for root, name in ((BenchFile, "bench-files.md"), (ProcedureFile, "procedure-files.md")):
        for model in reachable(root):
            for key, field in model.model_fields.items():
                assert f"| `{field.alias or key}` |" in made[name], f"{model.__name__}.{key}"


def test_effects_estimators_verbs_columns_drivers_and_commands_stand_on_their_pages(made):
    for page, names in (
        ("effects.md", [f"### {name}\n" for name in CATALOGUE]),
        ("estimators.md", [f"`{name}`" for name in ESTIMATORS]),
        ("procedure-files.md", [f"| `{verb}` |" for verb in VERBS]),
        ("readings.md", [f"| `{name}` |" for name in (*csv.REQUIRED, *csv.OPTIONAL, *csv.AS_TEXT)]),
        ("instruments.md", [f"### {name}\n" for name in drivers()]),
        ("commands.md", [f"## {name}\n" for name in commands()]),
    ):
        assert names
        for name in names:
            assert name in made[page], f"{page}: {name.strip()}"
    assert len(drivers()) >= 10
    assert len(commands()) >= 20


def test_every_option_stands_on_the_page_with_its_help(made):
    for name, command in commands().items():
        section = made["commands.md"].split(f"## {name}\n")[1].split("\n## ")[0]
        for option in command.params:
            for word in option.opts:
                assert word in section or word.upper() in section or (option.metavar or "") in section
        assert "Example: `bench " in section, f"{name} has no example"


def test_the_examples_of_model_files_can_be_loaded(made, tmp_path):
    (example,) = re.findall(r"```yaml\n(.*?)```", made["model-files.md"], re.DOTALL)
    (tmp_path / "m.yaml").write_text(example)
    assert [applied.effect.name for applied in load_model(tmp_path / "m.yaml").applied_effects()] == [
        "quadratic_nonlinearity",
        "warm_up",
    ]


def test_links_lead_to_pages_and_headings_that_are_there(made):
    texts = {f"reference/{name}": text for name, text in made.items()}
    texts |= {path.name: path.read_text(encoding="utf-8") for path in DOCS.glob("*.md")}
    texts["../README.md"] = (ROOT / "README.md").read_text(encoding="utf-8")
    followed = 0
    for page, text in texts.items():
        for link in LINK.findall(re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)):
            if link.startswith(("http:", "https:")):
                continue
            file, _, heading = link.partition("#")
            place = (DOCS / page).parent.joinpath(file).resolve() if file else DOCS / page
            target = str(place.relative_to(ROOT)).removeprefix("docs/") if file else page
            if target.endswith(".md"):
                assert target in texts, f"{page}: {link}"
                assert not heading or heading in headings(texts[target]), f"{page}: {link}"
            else:
                assert place.exists(), f"{page}: {link}"
            followed += 1
    assert followed > 100


def test_pages_are_written_and_stale_ones_go(made, tmp_path, monkeypatch):
    monkeypatch.setattr(generators, "PAGES", {name: lambda text=text: text for name, text in made.items()})
    (tmp_path / "old.md").write_text("of a version before")
    write_pages(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == PAGES.keys()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    write_pages(tmp_path)
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}


def test_the_constants_of_the_method_are_those_of_the_code(made):
    text = (DOCS / "diagnosis-method.md").read_text(encoding="utf-8") + made["_constants.md"]
    for module, name in re.findall(r"`([a-z_.]+)\.([A-Z_\d]+)`", text):
        assert hasattr(importlib.import_module(f"bench.diagnosis.{module}"), name), f"{module}.{name}"
    rows = re.findall(r"^\| `([a-z_.]+)\.([A-Z_\d]+)` \| (ln of )?([\d., ]+) \|", text, flags=re.M)
    assert len(rows) >= 10
    for module, name, logarithm, shown in rows:
        value = getattr(importlib.import_module(f"bench.diagnosis.{module}"), name)
        numbers = np.array([float(number) for number in shown.split(",")])
        expected = np.atleast_1d(list(value.values()) if isinstance(value, dict) else value)
        assert (np.log(numbers) if logarithm else numbers) == pytest.approx(expected), f"{module}.{name}"


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_every_path_that_is_named_in_the_checkout_is_there(page):
    text = re.sub(r"^```.*?^```$", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.M | re.S)
    quoted = re.findall(r"`([\w.*/-]+)`", text)
    paths = [name for name in quoted if "/" in name or name.endswith((".md", ".toml", ".txt", ".cff", ".py"))]
    paths += [link.partition("#")[0] for link in LINK.findall(text) if "://" not in link]
    made = {"docs/_build/html/index.html"}
    assert len(paths) > 5
    assert [path for path in paths if path not in made and not any(ROOT.glob(path))] == []


# --- messages: each is in the list, and the page on troubles quotes only messages of the program ------------

QUOTED = [
    line[1:-1] for line, after in pairwise((DOCS / "troubleshooting.md").read_text(encoding="utf-8").splitlines())
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
