"""The live page and what its script is sent: told as the record tells it, to who is signed in alone."""

import json
import shutil
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from bench.panel.access import STATE, Access, Role, Settings
from bench.panel.app import make_app
from bench.run.events import EVENTS, MANIFEST
from bench.run.record import Record
from drivers.clock import utc_now

RECORDS = Path(__file__).parents[1] / "data" / "records"
HOME = "http://127.0.0.1:8741"
HOSTILE = "<script>alert(1)</script>\x1b[31m\u202egnp"


@pytest.fixture
def runs(tmp_path):
    folder = tmp_path / "runs"
    shutil.copytree(RECORDS / "finished", folder / "done")
    return folder


@pytest.fixture
def client(runs):
    with TestClient(make_app(Settings(runs)), base_url=HOME, follow_redirects=False) as found:
        token = Access(runs / STATE).new_token("anna", Role.OPERATOR)
        found.post("/sign-in", data={"token": token}, headers={"origin": HOME})
        yield found


@pytest.fixture
def asking(runs):
    """A run that stands at a question, and is carried out."""
    folder = runs / "asking"
    shutil.copytree(RECORDS / "finished", folder)
    lines = (folder / EVENTS).read_bytes().splitlines(keepends=True)
    (folder / EVENTS).write_bytes(b"".join(lines[:40]))
    record, _ = Record.reopen(folder, utc_now)
    prompt = {
        "id": "0012/turn#1@41",
        "kind": "angle",
        "text": "Turn the head to 45°00′00″",
        "default": None,
        "unit": "° ′ ″",
        "choices": [],
        "action": {"do": "turn", "target_rad": 0.7853981633974483, "direction": 1, "tolerance_rad": 3e-4},
    }
    record.append("asked", 1000.0, **prompt)
    yield folder
    record.close()


def test_the_page_of_a_run_says_how_it_stands(client):
    text = client.get("/runs/done/").text
    assert "The run is finished." in text
    assert "plots.js" in text


@pytest.mark.parametrize("address", ["", "state", "stream", "check-answer?id=1&text=2"])
def test_a_stranger_is_told_nothing(client, runs, address):
    client.cookies.clear()
    assert client.get(f"/runs/done/{address}").status_code in {303, 401}


@pytest.mark.parametrize("address", ["", "state", "stream", "check-answer"])
@pytest.mark.parametrize("name", ["other", "%2e%2e%2f", ".panel"])
def test_a_run_that_is_not_there_is_not_found(client, name, address):
    assert client.get(f"/runs/{name}/{address}").status_code in {404, 307, 303}


def test_an_answer_is_checked_as_it_is_typed(client, asking):
    def check(text, prompt_id="0012/turn#1@41"):
        return client.get("/runs/asking/check-answer", params={"id": prompt_id, "text": text})

    assert check("45 00 10").json() == {"problem": "", "understood": "45° 00′ 10.0″"}
    assert "the degree line is one off" in check("46 0 0").json()["problem"]
    assert check("45 00 10", "0011/turn#1@38").status_code == 409
    state = client.get("/runs/asking/state").json()
    assert state["prompt"]["target"] == "45°00′00″"
    assert not state["prompt"]["enter"]
    assert state["prompt"]["drawing"].startswith("<svg")


def test_a_question_of_a_run_that_nobody_carries_out_is_none(client, runs, asking):
    shutil.copytree(asking, runs / "dead")
    state = client.get("/runs/dead/state").json()
    assert state["prompt"] is None
    assert "No program carries this run out" in state["doing"]


def test_what_strangers_wrote_is_shown_as_text(client, runs):
    manifest = runs / "done" / MANIFEST
    told = json.loads(manifest.read_text("utf-8"))
    told |= {"operator": HOSTILE, "unit_under_test": {"type": "t", "serial": HOSTILE}}
    manifest.write_text(json.dumps(told), encoding="utf-8")
    text = client.get("/runs/done/").text
    assert "<script>alert" not in text
    assert "\x1b" not in text
    assert "\u202e" not in text


def test_a_damaged_record_is_said_in_a_sentence(client, runs):
    (runs / "done" / EVENTS).write_bytes(b"{}\n")
    reply = client.get("/runs/done/")
    assert reply.status_code < 500
    assert "line 1: cannot be believed" in reply.text


def test_a_stream_of_a_damaged_record_says_so_as_an_event(client, runs):
    (runs / "done" / EVENTS).write_bytes(b"{}\n")
    reply = client.get("/runs/done/stream")
    assert reply.status_code == 200
    assert reply.text.startswith("event: trouble\n")
    assert "line 1: cannot be believed" in reply.text
