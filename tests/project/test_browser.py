"""Without a browser the tests that need one say so, and no other test needs one."""

import tomllib

import pytest

from tests.project.test_distribution import ROOT
from tests.support import browsers


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
