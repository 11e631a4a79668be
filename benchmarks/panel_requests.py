"""Requests for the panel drawn at random: most are nearly right, as those of who looks for a gap are."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote, urlencode

from bench.panel.access import LARGEST_BODY, Person, Role

HOST = "127.0.0.1:8741"
HOME = f"http://{HOST}"
SECRET = "what lies outside the folder of runs"
COOKIE = "bench_panel_"
CHANGES = frozenset({"POST"})
METHODS = (
    "GET",
    "POST",
    "HEAD",
    "PUT",
    "DELETE",
    "OPTIONS",
    "PATCH",
    "TRACE",
    "CONNECT",
    "get",
    "POST\r\nX: y",
    "",
    "É",
)
FIXED = (
    "/",
    "/start",
    "/sign-in",
    "/sign-out",
    "/nowhere",
    "/start/0123456789ab",
    "/start/0123456789ab/go",
    "//",
    "/runs/",
    "/runs",
)
OF_RUN = (
    "", "state", "stream", "check-answer", "answer", "wish", "control", "resume", "give-up", "verdict", "report",
    "diagnosis", "diagnose", "figures/residuals", "certificate/certificate.pdf", "figures/../report",
    "events.jsonl",
)  # fmt: skip
NAMES = (
    "..", ".", "../outside", "..%2foutside", "....//outside", "linked", "/etc", ".panel", "\0",
    "a" * 5000, "\ud800",
    "C:\\x", "done/../../outside", "%2e%2e", "<svg onload=alert(1)>", "\u202e", "done\n", "*", "~root", "-rf",
)  # fmt: skip
WORDS = (
    "take", "ask", "grant", "deny", "release", "force", "pause", "continue", "stop", "abort", "skip",
    "redo", "yes",
    "120 30 15", "120° 30′ 15″",
    "1e999", "-0", "nan", "９９", "1" * 400, "calibration", "paper-stand",
    "../outside/procedure.yaml", "next:done", "next:../outside", "",
    "\x1b[2J", "\u0000", "é" * 300, "<script>alert(1)</script>", "' OR 1=1 --", "x" * 9000, "--help",
    "1@1", "{{7*7}}",
)  # fmt: skip
FIELDS = (
    "do",
    "to",
    "wish",
    "reason",
    "id",
    "text",
    "procedure",
    "bench",
    "unit",
    "operator",
    "name",
    "practice",
    "token",
    "link",
    "next",
    "csrf",
)
ORIGINS = ("null", "http://evil.example", "https://127.0.0.1:8741", HOME + ".evil", HOME + "/", "", "\xff")
KINDS = (
    "application/x-www-form-urlencoded",
    "application/json",
    "multipart/form-data; boundary=x",
    "text/plain",
    "",
    "\xff",
)
LEAST = {"control": Role.OPERATOR, "answer": Role.OPERATOR, "wish": Role.VIEWER}


@dataclass(frozen=True)
class Actor:
    """Who sends: a session (None of a stranger), and a token."""

    name: str
    person: Person | None
    token: str | None
    cookie: str = COOKIE
    revoked: bool = False


@dataclass(frozen=True)
class Request:
    """A request, as the application is given it. `entitled`: whether who sends it may change anything by it."""

    method: str
    path: str
    query: bytes
    headers: tuple[tuple[bytes, bytes], ...]
    body: tuple[bytes, ...]
    entitled: bool
    who: str

    def scope(self) -> dict[str, Any]:
        """Return what the application is called with."""
        return {
            "type": "http",
            "asgi": {"version": "3.0", "spec_version": "2.3"},
            "http_version": "1.1",
            "method": self.method,
            "scheme": "http",
            "path": self.path,
            "raw_path": quote(self.path, errors="replace").encode(),
            "query_string": self.query,
            "root_path": "",
            "headers": list(self.headers),
            "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 8741),
        }

    def __str__(self) -> str:
        return (
            f"{self.who}: {self.method!r} {self.path[:60]!r} {self.query[:40]!r} {b''.join(self.body)[:80]!r}"
        )


class Requests:
    """Draws requests: by one of the actors, to the runs of these names."""

    def __init__(self, seed: int, actors: Sequence[Actor], runs: Sequence[str]) -> None:
        self._random = random.Random(seed)  # noqa: S311 - a campaign that can be repeated
        self._actors, self._runs = actors, runs

    def draw(self) -> Request:
        """Return the next request."""
        draw = self._random
        actor = draw.choice(self._actors)
        method = draw.choice(METHODS) if draw.random() < 0.1 else draw.choice(("GET", "POST", "POST"))
        path = self._path()
        right_origin, right_form, right_host = (draw.random() < part for part in (0.75, 0.75, 0.9))
        headers = [
            (b"host", HOST.encode() if right_host else self._bytes(("evil.example", "", "\xff", HOST + "x")))
        ]
        if right_origin:
            headers.append((b"origin", HOME.encode()))
        elif draw.random() < 0.8:
            headers.append((b"origin", self._bytes(ORIGINS)))
        right_cookie = self._add_cookie(headers, actor)
        sent = self._sent()
        if actor.token and path == "/sign-in" and draw.random() < 0.5:
            sent["token"] = actor.token
        kind = draw.choice(KINDS[:2]) if draw.random() < 0.8 else draw.choice(KINDS)
        if actor.person is not None and right_form:
            headers.append((b"x-csrf", actor.person.csrf.encode()))
        elif draw.random() < 0.3:
            headers.append((b"x-csrf", self._bytes(("", "0" * 32, "\xff", "x" * 5000))))
        body = self._body(sent, kind)
        headers.append((b"content-type", kind.encode("latin-1")))
        self._add_rest(headers, body)
        signed_in = right_cookie and actor.person is not None and not actor.revoked
        by_session = signed_in and right_form and self._may(actor, path)
        # who signs in makes a session, with a token of one's own
        by_token = path == "/sign-in" and bool(actor.token) and not actor.revoked
        entitled = method == "POST" and right_origin and right_host and (by_session or by_token)
        query = urlencode(self._sent(), errors="replace").encode() if draw.random() < 0.5 else b""
        return Request(method, path, query, tuple(headers), body, entitled, actor.name)

    def raw(self, host: str) -> bytes:
        """Return bytes that are nearly a request, as they come over a wire."""
        draw = self._random
        path = (
            quote(self._path(), safe="/%.\\~", errors="replace")
            if draw.random() < 0.8
            else draw.choice(WORDS)
        )
        lines = [f"{draw.choice(METHODS)} {path} HTTP/{draw.choice(('1.1', '1.0', '2', '9.9', ''))}"]
        lines += [f"Host: {host}"] * draw.choice((0, 1, 1, 1, 2))
        for _ in range(draw.randrange(4)):
            lines.append(draw.choice((
                "Content-Length: -1", "Content-Length: 99999999999", "Transfer-Encoding: chunked",
                "Expect: 100-continue",
                "X: " + "y" * 9000, "Upgrade: websocket", ": empty", "Cookie: \xff=\xff",
                "Content-Length: 5", "no colon", "Transfer-Encoding: chunked\r\nContent-Length: 5",
            )))  # fmt: skip
        text = "\r\n".join(lines) + draw.choice(("\r\n\r\n", "\n\n", "\r\n", ""))
        return text.encode("utf-8", "replace") + draw.randbytes(draw.choice((0, 5, 200)))

    def _path(self) -> str:
        draw = self._random
        if draw.random() < 0.2:
            return draw.choice(FIXED)
        if draw.random() < 0.1:
            return f"/runs/alive/{draw.choice(('check-answer', 'answer', 'control', 'wish'))}"
        name = draw.choice(self._runs) if draw.random() < 0.7 else draw.choice(NAMES)
        path = f"/runs/{name}/{draw.choice(OF_RUN)}"
        if draw.random() < 0.05:
            at = draw.randrange(len(path))
            path = path[:at] + draw.choice(("/", "\0", "%", "?", "\\", "é", ";", "//")) + path[at:]
        return path

    def _may(self, actor: Actor, path: str) -> bool:
        """Whether a person's role lets them change anything at all by this address."""
        least = LEAST.get(path.rpartition("/")[2], Role.VIEWER if path == "/sign-out" else Role.OPERATOR)
        return actor.person is not None and actor.person.role.includes(least)

    def _add_cookie(self, headers: list[tuple[bytes, bytes]], actor: Actor) -> bool:
        draw = self._random
        if actor.person is not None and draw.random() < 0.8:
            headers.append((b"cookie", f"{actor.cookie}={actor.person.secret}".encode()))
            return True
        if draw.random() < 0.3:
            name = actor.cookie or COOKIE
            headers.append(
                (
                    b"cookie",
                    self._bytes((f"{name}=", f"{name}={'x' * 9000}", "\xff\xfe", "=;=;=", f"{name}=\x00")),
                )
            )
        return False

    def _sent(self) -> dict[str, str]:
        draw = self._random
        sent = {draw.choice(FIELDS): draw.choice(WORDS) for _ in range(draw.randrange(5))}
        # the question that stands, so that what is read of an answer is reached
        return sent | ({"id": "1@1", "text": draw.choice(WORDS)} if draw.random() < 0.2 else {})

    def _body(self, sent: dict[str, str], kind: str) -> tuple[bytes, ...]:
        draw = self._random
        whole = json.dumps(sent).encode() if "json" in kind else urlencode(sent, errors="replace").encode()
        match draw.randrange(12):
            case 0:
                whole = whole[: draw.randrange(len(whole) + 1)]
            case 1:
                whole = draw.randbytes(draw.randrange(200))
            case 2:
                whole = b"[" * draw.choice((10, 60_000))
            case 3:
                whole = draw.choice(
                    (
                        b"null",
                        b"[]",
                        b'{"a": {"b": 1}}',
                        b'{"do": 1}',
                        b'"\\ud800"',
                        b'{"do": "\\ud800"}',
                        b"NaN",
                    )
                )
            case 5:  # thousands of keys, one of them twice
                many = {f"{key:06x}": "" for key in range(draw.choice((41, 4000)))}
                whole = json.dumps(many)[:-1].encode() + draw.choice((b"}", b', "00002a": ""}'))
            case 4:
                return tuple(b"x" * 16_384 for _ in range(2 * LARGEST_BODY // 16_384))
        cut = draw.randrange(len(whole) + 1)
        return (whole[:cut], whole[cut:])

    def _add_rest(self, headers: list[tuple[bytes, bytes]], body: tuple[bytes, ...]) -> None:
        draw = self._random
        if draw.random() < 0.5:
            right = str(sum(map(len, body)))
            lies = ("-1", "9" * 30, "x", "0", "1e3", "\xb2")
            headers.append((b"content-length", right.encode() if draw.random() < 0.7 else self._bytes(lies)))
        if draw.random() < 0.05:
            headers.append((b"transfer-encoding", self._bytes(("chunked", "gzip, chunked", "x", "\xff"))))
        if draw.random() < 0.5:
            headers.append(
                (b"accept", self._bytes(("application/json", "text/html", "text/event-stream", "\xff")))
            )
        for _ in range(draw.choice((0, 0, 0, 50))):
            headers.append((b"x-" + draw.randbytes(3).hex().encode(), draw.randbytes(20)))

    def _bytes(self, texts: Sequence[str]) -> bytes:
        return self._random.choice(texts).encode("latin-1", "replace")
