"""A panel in the test's own process, and browsers of signed-in persons."""

import json
import warnings
from pathlib import Path
from typing import Any

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # the client tells of a successor of what it stands on
    from starlette.testclient import TestClient

from bench.panel.access import STATE, Access, Role, Settings
from bench.panel.app import make_app

HOME = "http://127.0.0.1:8741"
OWN = {"origin": HOME}


def stranger(runs: Path, catalogue: str = "") -> TestClient:
    """Return a browser in which nobody is signed in."""
    runs.mkdir(exist_ok=True)
    return TestClient(make_app(Settings(runs, catalogue=catalogue)), base_url=HOME, follow_redirects=False)


class Browser:
    """A browser in which a person is signed in."""

    def __init__(self, runs: Path, name: str, role: Role = Role.OPERATOR, catalogue: str = "") -> None:
        self.client = stranger(runs, catalogue)
        access = Access(runs / STATE)
        self.token = access.new_token(name, role)
        assert self.client.post("/sign-in", data={"token": self.token}, headers=OWN).status_code == 303
        person = access.person(next(iter(self.client.cookies.values())))
        assert person is not None
        self.csrf = person.csrf

    def get(self, path: str, **given: Any) -> Any:
        """Get a page."""
        return self.client.get(path, **given)

    def post(self, path: str, **sent: str) -> Any:
        """Send a form as a page of the panel does, with its token."""
        return self.client.post(path, data={"csrf": self.csrf, **sent}, headers=OWN)

    def ask(self, path: str, **sent: str) -> tuple[int, dict[str, Any]]:
        """Send JSON as the panel's script does; return status and content of the reply."""
        reply = self.client.post(path, json=sent, headers={**OWN, "x-csrf": self.csrf})
        return reply.status_code, json.loads(reply.text)
