"""A run followed while its record grows, and the live page: half a line is nothing yet."""

import asyncio
import json
import shutil
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from bench.panel.access import STATE, Access, Person, Role, Settings
from bench.panel.app import make_app
from bench.panel.holding import change
from bench.panel.run_events import Tail
from bench.panel.stream import Follower, Followers, as_live
from bench.run.events import EVENTS, MANIFEST, RecordError
from bench.run.record import Record
from drivers.clock import utc_now
from sim.world.clock import VirtualClock

RECORDS = Path(__file__).parents[1] / "data" / "records"
HOME = "http://127.0.0.1:8741"
PROMPT = {
    "id": "0012/turn#1@41",
    "kind": "angle",
    "text": "Turn the head to 45°00′00″",
    "default": None,
    "unit": "° ′ ″",
    "choices": [],
    "action": {"do": "turn", "target_rad": 0.7853981633974483, "direction": 1, "tolerance_rad": 3e-4},
}
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
    record.append("asked", 1000.0, **PROMPT)
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
    assert "ended unexpectedly" in state["doing"]


def test_what_strangers_wrote_is_shown_as_text(client, runs):
    manifest = runs / "done" / MANIFEST
    told = json.loads(manifest.read_text("utf-8"))
    told |= {"operator": HOSTILE, "unit_under_test": {"type": "t", "serial": HOSTILE}}
    manifest.write_text(json.dumps(told), encoding="utf-8")
    text = client.get("/runs/done/").text
    assert "<script>alert" not in text
    assert "\x1b" not in text
    assert "\u202e" not in text


def test_a_stream_of_a_damaged_record_says_so_as_an_event(client, runs):
    (runs / "done" / EVENTS).write_bytes(b"{}\n")
    reply = client.get("/runs/done/stream")
    assert reply.status_code == 200
    assert reply.text.startswith("event: trouble\n")
    assert "line 1: the record cannot be trusted" in reply.text


MOMENTS = ("now",)


@pytest.fixture
def lines():
    return (RECORDS / "finished" / EVENTS).read_bytes().splitlines(keepends=True)


@pytest.fixture
def growing(tmp_path):
    """The folder of a run of which nothing is recorded yet."""
    folder = tmp_path / "run"
    shutil.copytree(RECORDS / "finished", folder)
    (folder / EVENTS).write_bytes(b"")
    return folder


def append(folder, data):
    with (folder / EVENTS).open("ab") as file:
        file.write(data)


def all_of(follower):
    follower.look()
    while follower.residuals.judge_next():
        pass
    state = follower.state()
    return {key: value for key, value in state.items() if key not in MOMENTS}, follower.residuals.plotted


def test_a_line_counts_once_it_is_whole(growing, lines):
    tail = Tail(growing)
    append(growing, lines[0] + lines[1][:40])
    assert [event.number for event in tail.new()] == [1]
    assert list(tail.new()) == []
    append(growing, lines[1][40:] + lines[2])
    assert [event.number for event in tail.new()] == [2, 3]


def test_a_torn_line_that_is_cut_off_was_nothing(growing, lines):
    tail = Tail(growing)
    append(growing, lines[0] + lines[1][:40])
    list(tail.new())
    (growing / EVENTS).write_bytes(lines[0])
    append(growing, lines[1])
    assert [event.number for event in tail.new()] == [2]


@pytest.mark.parametrize("spoilt", [b"", b"{}\n", b"[1]\n", b"not JSON\n"])
def test_a_record_that_has_not_only_grown_is_not_followed(growing, lines, spoilt):
    tail = Tail(growing)
    append(growing, b"".join(lines[:3]))
    list(tail.new())
    (growing / EVENTS).write_bytes(lines[0] if not spoilt else b"".join(lines[:3]) + spoilt)
    with pytest.raises(RecordError, match=r"shorter|cannot be trusted"):
        list(tail.new())


def test_a_fault_is_told_in_words_and_not_by_the_name_of_its_event(growing):
    record, _ = Record.reopen(growing, utc_now)
    for kind in ("step_failed", "run_failed"):
        record.append(kind, 1.0, step=0, key="1", instrument="voltmeter.x", error="voltmeter.x: no answer")
    record.close()
    follower = Follower(growing)
    follower.look()
    told = [line["words"] for line in follower.state()["log"]]
    assert told == ["run failed: voltmeter.x: no answer", "step failed: voltmeter.x: no answer"]


def test_a_record_that_is_gone_is_not_shown_as_if_it_were_there(growing, lines):
    follower = Follower(growing)
    assert not follower.look()
    append(growing, b"".join(lines[:3]))
    assert follower.look()
    (growing / EVENTS).unlink()
    with pytest.raises(
        RecordError, match=r"cannot be read .*; check its permissions, or restore it from a copy"
    ):
        follower.look()


@pytest.mark.parametrize("kept", [100, 8])
def test_a_record_with_a_changed_line_is_not_followed(growing, lines, monkeypatch, kept):
    monkeypatch.setattr("bench.panel.run_events.KEPT_LINES", kept)
    monkeypatch.setattr("bench.panel.run_events.KEPT_BYTES", 12_000)
    for at in (12, 13, 14):
        changed = lines[at].replace(b'"bench_s": ', b'"bench_s": 1')
        (growing / EVENTS).write_bytes(b"".join([*lines[:at], changed, *lines[at + 1 :]]))
        with pytest.raises(RecordError, match=rf"line {at + 2}: the record cannot be trusted"):
            list(Tail(growing).new())


def test_followed_line_by_line_it_is_what_it_is_at_once(growing, lines):
    follower = Follower(growing)
    for line in lines:
        append(growing, line)
        follower.look()
        follower.residuals.judge_next()
    little_by_little, points = all_of(follower)
    at_once, all_points = all_of(Follower(growing))
    assert little_by_little == at_once
    assert points == all_points
    assert at_once["events"] == len(lines)
    assert (at_once["state"], at_once["alive"]) == ("finished", False)
    assert at_once["where"]["reading"] == at_once["where"]["readings"] == 22


def test_where_a_run_is_while_it_waits_for_the_signals_to_settle(growing, lines):
    number, begun = next(
        (n, json.loads(line))
        for n, line in enumerate(lines)
        if b'"step_started"' in line and b"0010/wait" in line
    )
    append(growing, b"".join(lines[: number + 1]))
    told, _ = all_of(Follower(growing))
    assert begun["step"] == told["where"]["step"] - 1
    assert (told["where"]["installation"], told["where"]["pass"], told["where"]["point"]) == ("1", 1, 3)
    assert told["soak"]["words"] == "settling"
    assert told["angle"]["commanded"] == "90°00′00″"
    assert told["angle"]["read_deg"] == pytest.approx(90.0, abs=0.01)
    assert told["where"]["left_s"] > 3600.0


def test_a_run_without_a_program_says_so_and_one_that_is_written_does_not(growing, lines):
    append(growing, b"".join(lines[:10]))
    told, _ = all_of(Follower(growing))
    assert not told["alive"]
    assert "ended unexpectedly" in told["doing"]
    record, _ = Record.reopen(growing, utc_now)
    try:
        told, _ = all_of(Follower(growing))
    finally:
        record.close()
    assert told["alive"]
    assert "No program" not in told["doing"]


def test_most_residuals_of_a_good_run_lie_within_their_bands(growing, lines):
    append(growing, b"".join(lines))
    _, points = all_of(Follower(growing))
    sigma = [abs(one) for point in points.points for one in point["sigma"]]
    assert len(points.points) == 22
    assert sum(one < 2.0 for one in sigma) / len(sigma) > 0.9
    assert points.since(points)["points"] == ()


def test_all_who_look_share_a_follower_and_hear_what_is_new(growing, lines):
    append(growing, b"".join(lines[:9]))

    async def look():
        change(growing, "take", Person("anna", Role.OPERATOR))
        followers = Followers()
        streams = [followers.stream(growing) for _ in range(3)]
        first = [await anext(stream) for stream in streams]
        assert len(followers._shared) == 1
        append(growing, b"".join(lines[9:12]))
        second = [await next_state(stream) for stream in streams]
        followers.close()
        return first, second

    async def next_state(stream):
        async for event in stream:
            if event.startswith(b"event: state"):
                return event
        return None

    first, second = asyncio.run(look())
    assert len(set(first)) == len(set(second)) == 1
    told = json.loads(second[0].split(b"data: ", 1)[1])
    assert told["events"] == 12
    assert told["control"]["holder"] == "anna"


def test_a_record_that_cannot_be_read_is_said_to_who_looks(growing, lines):
    append(growing, lines[0])

    async def look():
        followers = Followers()
        stream = followers.stream(growing)
        await anext(stream)
        append(growing, b"no event\n")
        told = [event async for event in stream]
        with pytest.raises(RecordError, match="line 2"):
            await followers.state(growing)
        followers.close()
        return told

    told = asyncio.run(look())
    assert told[-1].startswith(b"event: trouble")
    assert b"line 2" in told[-1]


def test_a_question_of_a_program_that_is_gone_is_none_even_when_another_goes_on(growing, lines):
    append(growing, b"".join(lines[:40]))
    asked = {"id": "1", "kind": "confirm", "text": "Done?", "action": {"do": "answer"}}
    clock = VirtualClock()
    record, _ = Record.reopen(growing, utc_now)
    record.append("asked", 1.0, **asked)
    follower = Follower(growing, clock)
    follower.look()
    assert follower.prompt is not None
    record.close()
    clock.sleep(2.0)
    follower.look()
    assert follower.prompt is None
    record, _ = Record.reopen(growing, utc_now)
    clock.sleep(2.0)
    follower.look()
    assert follower.prompt is None
    record.append("run_resumed", 2.0, step=1, instruments={})
    record.append("asked", 2.0, **{**asked, "id": "2"})
    follower.look()
    assert follower.prompt is not None
    assert follower.prompt.prompt.id == "2"
    record.close()


def test_a_question_that_is_asked_before_its_program_was_looked_for_stands(growing, lines):
    """Whether somebody writes is looked for once a second: another program may have asked by then."""
    append(growing, b"".join(lines[:40]))
    clock = VirtualClock()
    follower = Follower(growing, clock)
    follower.look()
    record, _ = Record.reopen(growing, utc_now)
    record.append("run_resumed", 2.0, step=1, instruments={})
    record.append("asked", 2.0, id="1", kind="confirm", text="Done?", action={"do": "answer"})
    clock.sleep(0.1)
    follower.look()
    assert follower.prompt is not None
    clock.sleep(2.0)
    follower.look()
    assert follower.prompt is not None
    record.close()


def test_of_a_long_record_the_beginnings_of_old_steps_are_passed_over_and_nothing_is_told_otherwise(
    growing, lines, monkeypatch
):
    append(growing, b"".join(lines[:100]))
    whole, points = all_of(Follower(growing))
    monkeypatch.setattr("bench.panel.run_events.KEPT_LINES", 8)
    monkeypatch.setattr("bench.panel.run_events.KEPT_BYTES", 12_000)
    numbers = [event.number for event in Tail(growing).new()]
    assert len(numbers) < 80
    assert numbers[-20:] == list(range(81, 101))
    skimmed, same_points = all_of(Follower(growing))
    assert skimmed == whole
    assert same_points == points


def test_a_live_value_is_sent_while_its_question_waits(growing, lines):
    async def heard():
        followers = Followers()
        stream = followers.stream(growing)
        found = []
        async for event in stream:
            found.append(event)
            if event.startswith(b"event: live"):
                break
        followers.close()
        return found

    append(growing, b"".join(lines[:40]))
    record, _ = Record.reopen(growing, utc_now)
    try:
        told = {"prompt": "1", "time": "2026-11-22T00:00:00+00:00", "signals_v": [1.0, 2.0, 3.0]}
        record.append("asked", 1000.0, **PROMPT)
        (growing / "live.json").write_text(json.dumps(told), encoding="utf-8")
        event = asyncio.run(asyncio.wait_for(heard(), 20.0))[-1]
    finally:
        record.close()
    assert json.loads(event.split(b"data: ")[1]) == told


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff", b'{"a": NaN}'])
def test_a_broken_live_value_is_none(content):
    assert as_live(content) == b"event: live\ndata: {}\n\n"
