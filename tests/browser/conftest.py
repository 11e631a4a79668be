"""A panel that is served, and the system's Chromium that looks at it. `make test-browser` runs what stands here."""

import contextlib
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from bench.panel.access.people import Role
from bench.panel.access.store import Access
from bench.panel.app import make_app
from bench.panel.settings import STATE, Settings
from tests.support.browsers import find_chromium, what_is_missing

HERE = Path(__file__).parent
RECORDS = HERE.parent / "data" / "records"
PATIENCE_MS = 60_000


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


@dataclass
class ServedPanel:
    """A panel that is served at `url` over the folder `runs`, in a thread of the tests."""

    runs: Path
    port: int
    tokens: dict[str, str] = field(default_factory=dict)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def token(self, name: str, role: Role) -> str:
        if name not in self.tokens:
            self.tokens[name] = Access(self.runs / STATE).new_token(name, role)
        return self.tokens[name]


@contextlib.contextmanager
def served(runs: Path) -> Iterator[ServedPanel]:
    """Serve a panel on a free port of the loopback."""
    import uvicorn

    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(64)
        port = listener.getsockname()[1]
        config = uvicorn.Config(
            make_app(Settings(runs, port=port)), log_level="warning", timeout_graceful_shutdown=1
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.01)  # a real server on a real socket
        yield ServedPanel(runs, port)
        server.should_exit = True
        thread.join(10.0)


@pytest.fixture
def panel(tmp_path: Path) -> Iterator[ServedPanel]:
    """A panel over a folder of its own, in which a run stands that is finished."""
    runs = tmp_path / "runs"
    shutil.copytree(RECORDS / "finished", runs / "done")
    with served(runs) as found:
        yield found


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
        page.goto(f"{panel.url}/sign-in")
        page.fill("#token", panel.token(name, role))
        page.click("main button[type=submit]")
        page.wait_for_url(f"{panel.url}/")
        page.goto(panel.url + path)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert errors == []
