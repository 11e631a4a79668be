"""What is installed with a bench, and what its licences allow."""

import re
import shutil
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


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
