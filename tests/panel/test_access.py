"""Who may come in, and what a stranger's request meets."""

import pytest
from starlette.testclient import TestClient

from bench.panel.access.people import Role
from bench.panel.access.store import Access
from bench.panel.app import make_app
from bench.panel.settings import STATE, Settings

HOME = "http://127.0.0.1:8741"
OWN = {"origin": HOME}


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    return tmp_path / "runs"


@pytest.fixture
def client(runs):
    return TestClient(make_app(Settings(runs)), base_url=HOME, follow_redirects=False)


def test_a_stranger_is_led_to_the_sign_in(client):
    reply = client.get("/")
    assert (reply.status_code, reply.headers["location"]) == (303, "/sign-in?next=/")


def test_a_token_signs_in(client, runs):
    token = Access(runs / STATE).new_token("anna", Role.OPERATOR)
    reply = client.post("/sign-in", data={"token": token}, headers=OWN)
    assert (reply.status_code, reply.headers["location"]) == (303, "/")
    assert "SameSite=strict" in reply.headers["set-cookie"]
    assert "HttpOnly" in reply.headers["set-cookie"]
    assert "anna" in client.get("/").text
