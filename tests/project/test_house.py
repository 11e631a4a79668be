"""The house itself: no file grows too long, tests stand where what they test stands, nothing bends the path."""

import re
from pathlib import Path

import pytest
import yaml

from docs.generators import rooms
from tests.project.test_distribution import PROJECT, ROOT

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
