"""Connections that never finish a request, too many of them, and broken ones: the panel stays up and quiet."""

import asyncio
import contextlib
import json
import logging
import shutil
import socket

import pytest

from bench.panel import app as connections
from bench.panel.access import LARGEST_BODY, MOST_SESSIONS, STATE, Access, Role, Settings
from bench.panel.app import OncePerMinute
from bench.panel.shared import LOG
from tests.support.panel_client import OWN, Browser, stranger
from tests.support.panel_fuzz import RECORD as RECORDS
from tests.support.panel_fuzz import Request, send
from tests.support.served_panel import served

HEAD = "{} HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n"


@contextlib.contextmanager
def connected(panel):
    with socket.create_connection(("127.0.0.1", panel.port), timeout=10) as wire:
        yield wire


def exchanged(panel, head, rest, *, ended=False):
    """Send bytes and return what comes back until the panel closes; `ended` says that nothing more is sent."""
    with connected(panel) as wire:
        text = HEAD.replace("{}", head).format(host=f"127.0.0.1:{panel.port}") + rest
        wire.sendall(text.encode())
        if ended:
            wire.shutdown(socket.SHUT_WR)
        return until_closed(wire)


def until_closed(wire):
    heard = b""
    with contextlib.suppress(ConnectionError):
        while more := wire.recv(65_536):
            heard += more
    return heard


@pytest.mark.slow
def test_a_request_that_never_ends_is_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(connections, "REQUEST_S", 0.2)
    with served(tmp_path) as panel, connected(panel) as silent, connected(panel) as in_head:
        in_head.sendall(b"GET / HTTP/1.1\r\nHo")
        assert until_closed(silent) == until_closed(in_head) == b""
        with connected(panel) as in_body:
            in_body.sendall(
                HEAD.replace("{}", "POST /sign-in").format(host=f"127.0.0.1:{panel.port}").encode()
                + b"Content-Length: 50\r\n\r\n{"
            )
            assert until_closed(in_body) == b""


@pytest.mark.slow
def test_half_open_connections_do_not_keep_others_out(tmp_path, monkeypatch):
    monkeypatch.setattr(connections, "MOST_CONNECTIONS", 5)
    with served(tmp_path) as panel, contextlib.ExitStack() as many:
        waiting = [many.enter_context(connected(panel)) for _ in range(12)]
        assert exchanged(panel, "GET /sign-in", "Connection: close\r\n\r\n").startswith(b"HTTP/1.1 200")
        assert until_closed(waiting[0]) == b""  # the one that had waited longest


@pytest.mark.slow
def test_what_a_client_breaks_leaves_a_line_and_no_traceback(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(LOG, "callHandlers", written.append)  # behind the filters
    with served(tmp_path) as panel:
        for _ in range(10):
            exchanged(
                panel,
                "POST /sign-in",
                "Content-Length: 50\r\nContent-Type: application/json\r\n\r\n{",
                ended=True,
            )
            exchanged(panel, "POST /sign-in", "Transfer-Encoding: chunked\r\n\r\nzz\r\n")
            # answered before the body had come
            exchanged(panel, "POST /x", "Host: evil\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n")
            exchanged(panel, "PUT /x", "Transfer-Encoding: chunked\r\n\r\n1\r\na\r\nzz\r\n")
        for method in ("GET", "TRACE"):  # a path without a slash
            assert exchanged(panel, f"{method} sign-in", "Connection: close\r\n\r\n").startswith(
                b"HTTP/1.1 40"
            )
        assert exchanged(panel, "GET /sign-in", "Connection: close\r\n\r\n").startswith(b"HTTP/1.1 200")
    assert not [record.getMessage() for record in written if record.levelno > logging.WARNING]
    assert len(written) <= 2


@pytest.mark.slow
def test_a_panel_that_is_stopped_ends_its_live_pages_without_a_traceback(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(LOG, "callHandlers", written.append)  # behind the filters
    shutil.copytree(RECORDS / "finished", tmp_path / "done")
    with contextlib.ExitStack() as still_open:
        with served(tmp_path) as panel:
            page = still_open.enter_context(connected(panel))
            session = Access(tmp_path / STATE).sign_in_by_token(panel.token("anna", Role.VIEWER))
            head = HEAD.replace("{}", "GET /runs/done/stream").format(host=f"127.0.0.1:{panel.port}")
            cookie = Settings(tmp_path, port=panel.port).cookie
            page.sendall(f"{head}Cookie: {cookie}={session.secret}\r\n\r\n".encode())
            assert page.recv(65_536).startswith(b"HTTP/1.1 200")
        until_closed(page)
    assert [record.getMessage() for record in written] == []


def test_a_warning_is_written_once_a_minute_and_an_error_always():
    once = OncePerMinute()

    def passes(level, text, at):
        record = logging.LogRecord("x", level, "", 0, text, None, None)
        record.created = at
        return once.filter(record)

    assert [passes(logging.WARNING, "a", at) for at in (0.0, 59.0, 61.0, 62.0)] == [True, False, True, False]
    assert passes(logging.WARNING, "b", 62.0)
    assert all(passes(logging.ERROR, "a", at) for at in (62.0, 63.0))


def test_a_length_and_an_encoding_together_are_refused(tmp_path):
    headers = {**OWN, "content-length": "5", "transfer-encoding": "chunked"}
    reply = stranger(tmp_path).post("/sign-in", content=b"token", headers=headers)
    assert reply.status_code == 400
    assert "Content-Length" in reply.text


def test_a_body_sent_with_the_request_for_a_stream_is_dropped(tmp_path):
    """A stream waits for its client to go away, and meets the body when its answer has begun."""
    shutil.copytree(RECORDS / "finished", tmp_path / "runs" / "done")
    anna = Browser(tmp_path / "runs", "anna")
    (cookie,) = anna.client.cookies.items()
    headers = [(b"host", b"127.0.0.1:8741"), (b"cookie", "=".join(cookie).encode())]
    body = (b"x" * LARGEST_BODY,) * 3
    request = Request("GET", "/runs/done/stream", b"", tuple(headers), body, entitled=False, who="anna")
    status, heard = asyncio.run(send(anna.client.app, request))
    assert status == 200
    assert heard.startswith(b"event: state\n")


def test_an_object_of_thousands_of_keys_is_refused_and_no_name_is_looked_for_twice(tmp_path):
    many = {f"{k:06x}": "" for k in range(4000)}
    body = json.dumps(many)[:-1] + ', "00002a": ""}'
    headers = {**OWN, "content-type": "application/json"}
    reply = stranger(tmp_path).post("/sign-in", content=json.dumps(many), headers=headers)
    assert (reply.status_code, reply.json()) == (
        400,
        {"problem": "the form has more than 40 fields; send fewer, or change the file in an editor"},
    )
    assert reply.json()["problem"] in stranger(tmp_path).post("/sign-in", data=many, headers=OWN).text
    assert stranger(tmp_path).post("/sign-in", content=body, headers=headers).status_code == 400


def test_who_signs_in_often_ends_sessions_of_their_own_alone(tmp_path):
    access = Access(tmp_path / STATE)
    operator = access.sign_in_by_token(access.new_token("anna", Role.OPERATOR))
    linked = access.sign_in_by_link(access.new_link("root"))
    token = access.new_token("looker", Role.VIEWER)
    sessions = [access.sign_in_by_token(token) for _ in range(MOST_SESSIONS + 1)]
    assert access.person(operator.secret) == operator
    assert access.person(linked.secret) == linked
    assert access.person(sessions[0].secret) is None
    assert all(access.person(one.secret) for one in sessions[1:])
