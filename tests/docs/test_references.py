"""The reference pages are made from the code: each thing of the program stands on its page, in links that hold."""

import importlib
import re

import numpy as np
import pytest

from bench.calibration import ESTIMATORS
from bench.config.bench_file.file import BenchFile
from bench.config.model_file import load_model
from bench.config.procedure.file import VERBS, ProcedureFile
from bench.model.effects import CATALOGUE
from bench.readings import csv
from docs import generators
from docs.generators import PAGES, write_pages
from docs.generators.commands import commands
from docs.generators.forms import anchor, reachable
from docs.generators.instruments import drivers
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
