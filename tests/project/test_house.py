"""The house itself: files, folders, packages and what is installed with them."""

import re
import shutil
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

from docs.generators import rooms
from tests.support import browsers

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MOST_LINES = 600
PACKAGES = ("bench", "drivers", "sim")
SOURCES = [path for top in (*PACKAGES, "benchmarks", "tests") for path in sorted((ROOT / top).rglob("*.py"))]
NOT_ROOMS = {"browser", "conformance", "data", "project", "support"}


def test_no_file_is_too_long():
    lengths = {str(path.relative_to(ROOT)): len(path.read_text("utf-8").splitlines()) for path in SOURCES}
    assert len(lengths) > 300
    assert {path: lines for path, lines in lengths.items() if lines > MOST_LINES} == {}


def test_folders_of_tests_mirror_the_rooms():
    folders = {path.parent.relative_to(ROOT / "tests") for path in (ROOT / "tests").rglob("test_*.py")}
    rooms = {folder for folder in folders if folder.parts[0] not in NOT_ROOMS}
    assert Path("run") in rooms
    assert {room for room in rooms if not any((ROOT / top / room).is_dir() for top in ("", "bench"))} == set()


def test_nobody_bends_the_path():
    bent = re.compile(r"sys\.path\.(insert|append|extend)|sys\.path\s*\+?=")
    assert [str(path) for path in SOURCES if bent.search(path.read_text("utf-8"))] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_carry_their_types(package):
    assert (ROOT / package / "py.typed").read_bytes() == b""


def test_the_citation_is_of_this_version_and_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])
    (paper,) = citation["references"]
    assert paper["title"] in " ".join((ROOT / "README.md").read_text("utf-8").split())
    assert [author["family-names"] for author in paper["authors"]] == ["Chernyak", "Palyushok", "Baranovska"]


def test_the_changes_begin_with_what_is_not_released_and_know_this_version():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## \[(.+?)\]", text, re.MULTILINE)
    assert versions[0] == "Unreleased"
    assert PROJECT["version"] in versions


def test_the_hooks_before_a_commit_are_our_own_tools():
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    assert repository["repo"] == "local"
    linted = re.findall(r"^\t\$\(VENV\)/bin/([\w-]+)", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    for hook in repository["hooks"]:
        tool = Path(hook["entry"].split()[0])
        assert tool.parent == Path(".venv/bin")
        assert tool.name in linted


def test_the_list_of_rooms_for_contributors_is_that_of_the_code():
    text = rooms.CONTRIBUTING.read_text(encoding="utf-8")
    assert text == rooms.listing(text), "call docs.generators.rooms.write()"


def test_every_script_of_the_benchmarks_is_named_where_contributors_look():
    places = [
        ROOT / "Makefile",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "docs").glob("*.md"),
        ROOT / "docs/measured.yaml",
    ]
    told = {word for place in places for word in re.findall(r"\w+", place.read_text(encoding="utf-8"))}
    scripts = {
        path.stem if path.parent.name == "benchmarks" else path.parent.name
        for path in (ROOT / "benchmarks").rglob("*.py")
        if path.name == "__main__.py"
        or (path.parent.name == "benchmarks" and "__main__" in path.read_text("utf-8"))
    }
    assert len(scripts) > 20
    assert scripts - told == set()


def name_of(requirement):
    return re.sub(r"[-_.]+", "-", requirement.name).lower()


def installed_with(name, found):
    """Add to `found` what is installed with a distribution, as its metadata tell."""
    if name in found:
        return
    found.add(name)
    for text in metadata.requires(name) or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            installed_with(name_of(requirement), found)


def runtime():
    """Names of all distributions that a bench brings."""
    found = set()
    for text in PROJECT["dependencies"]:
        installed_with(name_of(Requirement(text)), found)
    return found


def licence_of(name):
    told = metadata.metadata(name)
    classifiers = [c for c in told.get_all("Classifier") or () if c.startswith("License ::")]
    return told.get("License-Expression") or " ".join(classifiers) or str(told.get("License"))


def test_a_bench_installs_no_tool_of_tests_or_of_documentation():
    found = runtime()
    assert {"numpy", "scipy", "typing-extensions"} <= found
    assert found.isdisjoint({"allantools", "pytest", "sphinx", "numpydoc", "docutils", "hypothesis", "gtc"})


def test_a_dry_run_installs_the_program_alone():
    """`make -n` says what would be done and does nothing."""
    make = shutil.which("make")
    if make is None:
        pytest.skip("there is no make")
    told = {}
    for target in ("dry-run", "test"):
        command = [make, "--dry-run", "--always-make", target]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)  # noqa: S603
        told[target] = re.findall(r"pip install .*--editable (\S+)", done.stdout)
    assert told == {"dry-run": ["."], "test": [".", "'.[test,dev]'"]}


def test_no_licence_of_what_a_bench_installs_forbids_apache_2():
    """All of them permit; one that asks for its own terms (GPL) would not."""
    permissive = re.compile(r"\b(MIT|BSD|Apache|PSF|Python Software Foundation|ISC|HPND|Zlib|0BSD)\b")
    assert PROJECT["license"] == "Apache-2.0"
    told = {name: licence_of(name) for name in runtime()}
    assert {name: text for name, text in told.items() if not permissive.search(text) or "GPL" in text} == {}


def test_what_is_missing_is_one_sentence_that_names_it(monkeypatch, tmp_path):
    monkeypatch.delenv(browsers.NAMED, raising=False)
    if any(browsers.find_spec(name) is None for name in browsers.PACKAGES):
        pytest.skip("the packages that drive a browser are not installed here")
    said = browsers.what_is_missing(str(tmp_path))
    assert "chromium" in said
    assert "apt install" in said
    assert "\n" not in said


def test_missing_packages_are_named(monkeypatch):
    monkeypatch.setattr(browsers, "find_spec", lambda name: None)
    assert "playwright" in browsers.what_is_missing()
    assert "triaxial-bench[browser]" in browsers.what_is_missing()


def test_make_test_needs_no_browser_and_the_gate_runs_both():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["pytest"]["ini_options"]
    assert "-m 'not browser'" in settings["addopts"]
    makefile = (ROOT / "Makefile").read_text("utf-8")
    assert '-m "not slow and not browser"' in makefile
    assert "-m browser" in makefile
    commands = (ROOT / ".ci" / "run").read_text("utf-8").splitlines()
    assert commands.index("make test-browser") == commands.index("make test") + 1
    marked = [path.name for path in (ROOT / "tests" / "browser").glob("test_*.py")]
    assert marked
