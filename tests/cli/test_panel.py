"""`bench panel`: tokens are told once, listed without their secrets, taken back; where it may listen."""

import json
import socket
from pathlib import Path

import pytest

from bench.panel.access import STATE, Settings, is_loopback
from bench.panel.app import LOCK, SERVER, new_link, open_panel, serve
from bench.run.events import RecordError
from tests.support.commands import printed, refused


def told(text):
    return text.strip().rpartition(" ")[2]


def test_a_token_is_told_once(bench):
    out = printed(bench("panel", "token", "anna", "--role", "viewer"))
    token = told(out)
    assert len(token) > 40
    assert token not in bench("panel", "tokens")[1]
    assert "anna  viewer" in bench("panel", "tokens")[1]
    assert not [file for file in Path("runs", STATE).iterdir() if token in file.read_text()]
    elsewhere = ("panel", "token", "anna", "--runs", "my runs")
    assert bench(*elsewhere)[0] == 0
    assert "use 'bench panel revoke anna --runs 'my runs'' first" in bench(*elsewhere)[2]
    assert bench("panel", "revoke", "anna")[0] == 0
    assert bench("panel", "tokens")[1] == "nobody has a token\n"


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (["token"], "no person is named; give the name: bench panel token NAME"),
        (["revoke", "ben"], "ben: has no token"),
        (["token", "ben", "--role", "king"], "choose from viewer, operator, supervisor"),
        (["link"], "no panel serves this folder; 'bench panel' starts one"),
        (
            ["link", "--runs", "my runs"],
            "no panel serves this folder; 'bench panel --runs 'my runs'' starts one",
        ),
        (["--host", "192.0.2.1"], "there is none; make one with 'bench panel token NAME --role operator'"),
        (["--address", "https://bench.lab"], "there is none"),
        (["--address", "bench.lab"], "give the address as typed in a browser"),
    ],
)
def test_what_cannot_be_is_one_sentence(bench, typed, said):
    refused(bench("panel", *typed), said)


def test_a_port_that_is_taken_is_one_sentence(bench):
    with socket.create_server(("127.0.0.1", 0)) as other:
        status, _, err = bench("panel", "--port", other.getsockname()[1])
    assert status == 2
    assert "choose another --port, 0 for a free one" in err


def test_an_address_of_another_computer_is_none_to_listen_at(bench):
    assert bench("panel", "token", "ben")[0] == 0
    refused(bench("panel", "--host", "192.0.2.1"), "give --host an address of this computer")


@pytest.fixture
def served(tmp_path, monkeypatch):
    """Serve without a server: return what was told."""
    lines = []
    monkeypatch.setattr("uvicorn.Server.run", lambda self, sockets: lines.append(f"serving {len(sockets)}"))

    def call(settings):
        serve(settings, lines.append)
        return lines

    return call


def test_on_loopback_a_link_signs_in_and_leads_to_the_run(tmp_path, served):
    lines = served(Settings(tmp_path, port=0))
    address = json.loads((tmp_path / STATE / SERVER).read_text())["url"]
    assert address.startswith("http://127.0.0.1:")
    assert lines[1].partition(": ")[2].startswith(f"{address}/sign-in?link=")
    assert lines[-1] == "serving 1"
    assert new_link(tmp_path, "/runs/one two/").endswith("&next=/runs/one%20two/")


def test_beyond_loopback_it_says_how_to_put_tls_before_it_and_gives_no_link(tmp_path, served, bench):
    assert bench("panel", "token", "anna", "--runs", tmp_path)[0] == 0
    lines = served(Settings(tmp_path, "0.0.0.0", 0))  # noqa: S104 - nothing is served
    assert "plain HTTP" in lines[1]
    assert "TLS" in lines[1]
    assert not [line for line in lines if "link=" in line]
    with pytest.raises(RecordError, match="where sign-in links do not work"):
        new_link(tmp_path)


def test_one_panel_serves_a_folder(tmp_path, served, monkeypatch):
    from filelock import FileLock

    monkeypatch.setattr("bench.panel.app.LOOKS_S", 0.0)
    served(Settings(tmp_path, port=0))
    with FileLock(tmp_path / STATE / LOCK):
        with pytest.raises(RecordError, match=r"a panel already serves this folder at http://127\.0\.0\.1"):
            served(Settings(tmp_path, port=0))
        assert "/sign-in?link=" in open_panel(tmp_path)


@pytest.mark.parametrize(
    ("host", "own"),
    [("127.0.0.1", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("lab", False)],  # noqa: S104
)
def test_loopback_is_the_computer_itself(host, own):
    assert is_loopback(host) is own


@pytest.mark.parametrize("host", ["127.0.0.1:8741", "localhost:8741", "[::1]:8741"])
def test_behind_a_proxy_pages_are_of_its_address(tmp_path, host):
    behind = Settings(tmp_path, address="https://bench.lab")
    assert not behind.loopback
    assert behind.allows_origin("https://bench.lab", host)
    assert not behind.allows_origin(f"http://{host}", host)
    assert Settings(tmp_path).allows_host(host)
