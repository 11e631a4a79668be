"""A panel served in a thread, for browsers in tests, for pictures and in benchmarks."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.panel.access import STATE, Access, Role, Settings
from bench.panel.app import config_of, make_app


@dataclass
class ServedPanel:
    """A panel over the folder `runs`, served at `url` in a thread of the tests."""

    runs: Path
    port: int
    tokens: dict[str, str] = field(default_factory=dict)

    @property
    def url(self) -> str:
        """The address of the panel."""
        return f"http://127.0.0.1:{self.port}"

    def token(self, name: str, role: Role) -> str:
        """Return a person's token, which the first call makes."""
        if name not in self.tokens:
            self.tokens[name] = Access(self.runs / STATE).new_token(name, role)
        return self.tokens[name]

    def sign_in(self, page: Any, name: str = "anna", role: Role = Role.OPERATOR) -> None:
        """Sign a person in on a browser's page."""
        page.goto(f"{self.url}/sign-in")
        page.fill("#token", self.token(name, role))
        page.click("main button[type=submit]")
        page.wait_for_url(f"{self.url}/")


@contextlib.contextmanager
def served(runs: Path, catalogue: str = "") -> Iterator[ServedPanel]:
    """Serve a panel on a free loopback port."""
    import uvicorn

    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(64)
        port = listener.getsockname()[1]
        server = uvicorn.Server(config_of(make_app(Settings(runs, port=port, catalogue=catalogue))))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.01)  # a real server on a real socket
        yield ServedPanel(runs, port)
        server.should_exit = True
        thread.join(10.0)
