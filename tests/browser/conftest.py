"""A panel that is served, and the system's Chromium that looks at it. `make test-browser` runs what stands here."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bench.panel.access import Role
from tests.support.browser_runs import PATIENCE_S
from tests.support.browsers import find_chromium, what_is_missing
from tests.support.plotted_runs import make_plotted
from tests.support.served_panel import ServedPanel, served

HERE = Path(__file__).parent
RECORDS = HERE.parent / "data" / "records"
PATIENCE_MS = 1000 * PATIENCE_S


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what stands here."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.browser)


def pytest_collection_finish(session: pytest.Session) -> None:
    """End at once, in a sentence, where a browser is needed and there is none."""
    wanted = any(item.get_closest_marker("browser") for item in session.items)
    if wanted and not session.config.option.collectonly and (missing := what_is_missing()):
        pytest.exit(missing, returncode=1)


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """The browser, without a window."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def panel(tmp_path: Path) -> Iterator[ServedPanel]:
    """A panel over a folder of its own, in which a run stands that is finished."""
    runs = tmp_path / "runs"
    shutil.copytree(RECORDS / "finished", runs / "done")
    with served(runs) as found:
        yield found


def empty_panel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ServedPanel]:
    """A panel that is begun in an empty folder."""
    folder = tmp_path / "empty"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.delenv("BENCH_FILE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with served(tmp_path / "runs") as found:
        yield found


@pytest.fixture(scope="session")
def plotted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two runs of one unit, of which the later has every plot."""
    return make_plotted(tmp_path_factory.mktemp("plotted"))


Visit = Callable[..., Any]


@pytest.fixture
def visit(chromium: Any, panel: ServedPanel) -> Iterator[Visit]:
    """Open a page of the panel as a person of a role, in a browser of its own; scripts that fail fail the test."""
    contexts: list[Any] = []
    errors: list[str] = []

    def open_page(path: str, name: str = "anna", role: Role = Role.OPERATOR, **options: Any) -> Any:
        context = chromium.new_context(**options)
        contexts.append(context)
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        panel.sign_in(page, name, role)
        page.goto(panel.url + path)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert errors == []
