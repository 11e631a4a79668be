"""Every shell line of the README in its order, as somebody follows it: the instruments are simulated ones."""

import contextlib
import os
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from bench.base.computing import EXTRAS
from bench.model import ForwardModel
from bench.run.assembly.served import dry_bench
from tests.support.certified_bench import meter_certificate, table_certificate
from tests.support.pages import ROOT, blocks, commands

README = ROOT / "README.md"
SHELL = {"python3", "."}
"""What sets up a computer: the tests run where that was done."""
INTERRUPTED_AT = 30
"""The question at which the run is interrupted that the next line resumes."""


class Interrupting:
    """The operator, who presses Ctrl-C once in the place of an answer."""

    def __init__(self, operator):
        self._operator, self._asked = operator, 0

    def ask(self, prompt):
        self._asked += 1
        if self._asked == INTERRUPTED_AT:
            raise KeyboardInterrupt
        return self._operator.ask(prompt)


@pytest.fixture
def on_simulated_instruments(monkeypatch) -> Iterator[None]:
    """Put simulated instruments in the place of those of a bench, the same from one command to the next."""
    with contextlib.ExitStack() as standing:
        benches = {}

        def real_bench(file, _person, wire=None, haste=None):
            if file.name not in benches:
                truth = ForwardModel(file.installation_models())
                assembly = standing.enter_context(dry_bench(file, truth, 1, wire, haste))
                person = assembly.instruments.head._person = Interrupting(assembly.person)
                benches[file.name] = assembly.__class__(
                    assembly.instruments, person, assembly.clock, assembly.observers
                )
            return benches[file.name]

        for user in ("execution", "instruments"):
            monkeypatch.setattr(f"bench.services.{user}.real_bench", real_bench)
        yield


def lines() -> Iterator[list[str]]:
    """Yield the words of each command; a line has several where they are joined by &&."""
    for block in blocks(README):
        if block.kind == "console" and block.why_not_run:  # the others are carried out with the pages
            for command in commands(block):
                for part in " \0".join(command.words).split("&&"):
                    yield [word.strip() for word in part.split("\0") if word.strip()]


@pytest.mark.slow(5)
def test_every_shell_line_in_its_order(bench, on_simulated_instruments, monkeypatch):
    served = []
    monkeypatch.setattr("bench.panel.app.serve", lambda settings, tell: served.append(settings.runs))
    monkeypatch.setattr("bench.cli.panel.refuse_without_packages", lambda: None)
    for words in lines():
        follow(words, bench)
    assert served == [Path("runs")]
    (certificate,) = Path("config/certificate/register").glob("*.pdf")
    assert not certificate.name.startswith("SIM")


def follow(words, bench):
    """Do what a command says; fail where it cannot be done as it stands."""
    match words:
        case ["make", "test"]:
            assert recipe_of("test")[:3] == ["python", "-m", "pytest"]  # this
        case ["make", target]:
            with pytest.MonkeyPatch.context() as patch:  # it installs none of them
                for package in (one for packages in EXTRAS.values() for one in packages):
                    patch.setitem(sys.modules, package, None)
                follow(recipe_of(target), bench)
        case ["pip", "install", wanted, "-c", constraints]:
            project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
            assert set(re.findall(r"\w+", wanted)) <= set(project["optional-dependencies"])
            assert (ROOT / constraints).is_file()
        case ["cd", folder]:
            os.chdir(folder)
        case ["$EDITOR", pattern]:
            for file in sorted(Path().glob(pattern)):
                edit(file)
        case ["bench", *rest]:
            status, out, err = bench(*rest)
            begun = rest[0] == "run" and "--dry-run" not in rest
            judged = rest[0] in {"resume", "report"} or (
                rest[0] == "run" and "paper" not in rest
            )  # by a verdict
            expected = {2} if begun else {0, 1} if judged else {0}
            assert status in expected, f"{' '.join(words)}: {status}\n{out}\n{err}"
            assert not begun or "bench resume" in err
        case _:
            assert words[0] in SHELL, words


def edit(file):
    """Write what the comments of the lines name, and a certificate of a real run needs."""
    data = yaml.safe_load(file.read_text(encoding="utf-8"))
    if file.name == "laboratory.yaml":
        data["authorised"][0]["name"] = "A. Person"
    elif "instruments" in data:
        for meter in data["instruments"]["voltmeters"]:
            meter["certificate"] = meter_certificate()
        data["instruments"]["head"]["certificate"] = table_certificate(dict.fromkeys(range(0, 360, 45), 0.0))
    file.write_text(yaml.safe_dump(data, allow_unicode=True, sort_keys=False), encoding="utf-8")


def recipe_of(target):
    """Return the command that a target of the Makefile ends with, its program by its name alone."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    told = dict(re.findall(r"^(\w+) [:?]?= (.*)$", makefile, re.M))
    recipe = re.search(rf"^{target}:.*\n((?:\t.*\n)+)", makefile, re.M)[1].splitlines()[-1]
    while "$(" in recipe:
        recipe = re.sub(r"\$\((\w+)\)", lambda name: told[name[1]], recipe)
    program, *rest = recipe.split()
    return [Path(program).name, *rest]
