"""Requests that no browser would send: methods, paths, headers, bodies, tokens, origins, sizes.

The requests go to the application directly, past any server that would correct them. A fault is
each request that was answered with 5xx, changed a file without the right to, or showed content from outside the
folder of runs.
"""

import asyncio
import json
import math
import random
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import quote, urlencode

from bench.panel.access import LARGEST_BODY, STATE, Access, Person, Role, Settings
from bench.panel.app import make_app, prepare
from bench.panel.holding import JOURNAL
from bench.run.events import EVENTS
from bench.run.person import ANSWERS, CONTROL, asked_to_json, problem_with_answer
from bench.run.record import Record
from drivers.clock import utc_now
from drivers.person import Prompt, PromptKind

# --- random requests; most are nearly valid, like those of an attacker -----------------------------------


HOST = "127.0.0.1:8741"
HOME = f"http://{HOST}"
SECRET = "what lies outside the folder of runs"
COOKIE = "bench_panel_"
CHANGES = frozenset({"POST"})
METHODS = (
    "GET", "POST", "HEAD", "PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "CONNECT", "get", "POST\r\nX: y",
    "", "É",
)  # fmt: skip
FIXED = (
    "/queue", "/queue/0123456789ab", "/procedures", "/procedures/form",
    "/", "/start", "/sign-in", "/sign-out", "/nowhere", "/start/0123456789ab", "/start/0123456789ab/go",
    "//", "/runs/", "/runs",
)  # fmt: skip
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
    "1@1", "{{7*7}}", "add", "begin", "put aside", "remove done", "duty", "quick", "copy:steps[1].wait",
)  # fmt: skip
FIELDS = (
    "do", "to", "wish", "reason", "id", "text", "procedure", "bench", "unit", "operator", "name",
    "dry_run", "token", "link", "next", "csrf", "units", "file", "start", "typed", "f0",
)  # fmt: skip
BODIES = (b"null", b"[]", b'{"a": {"b": 1}}', b'{"do": 1}', b'"\\ud800"', b'{"do": "\\ud800"}', b"NaN")
ORIGINS = ("null", "http://evil.example", "https://127.0.0.1:8741", HOME + ".evil", HOME + "/", "", "\xff")
KINDS = (
    "application/x-www-form-urlencoded", "application/json", "multipart/form-data; boundary=x",
    "text/plain", "", "\xff",
)  # fmt: skip
LEAST = {"control": Role.OPERATOR, "answer": Role.OPERATOR, "wish": Role.VIEWER}


@dataclass(frozen=True)
class Actor:
    """The sender of a request: a session (None for a stranger) and a token."""

    name: str
    person: Person | None
    token: str | None
    cookie: str = COOKIE
    revoked: bool = False


@dataclass(frozen=True)
class Request:
    """A request in the form that the application receives.

    `entitled` says whether its sender may change anything by this request.
    """

    method: str
    path: str
    query: bytes
    headers: tuple[tuple[bytes, bytes], ...]
    body: tuple[bytes, ...]
    entitled: bool
    who: str

    def scope(self) -> dict[str, Any]:
        """Return the ASGI scope with which the application is called."""
        return {
            "type": "http", "asgi": {"version": "3.0", "spec_version": "2.3"}, "http_version": "1.1",
            "method": self.method, "scheme": "http", "path": self.path,
            "raw_path": quote(self.path, errors="replace").encode(), "query_string": self.query,
            "root_path": "", "headers": list(self.headers), "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 8741),
        }  # fmt: skip

    def __str__(self) -> str:
        sent = b"".join(self.body)[:80]
        return f"{self.who}: {self.method!r} {self.path[:60]!r} {self.query[:40]!r} {sent!r}"


class Requests:
    """A generator of random requests by one of the actors, to the runs of these names."""

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
        host = HOST.encode() if right_host else self._bytes(("evil.example", "", "\xff", HOST + "x"))
        headers = [(b"host", host)]
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
        # signing in with one's own token makes a session
        by_token = path == "/sign-in" and bool(actor.token) and not actor.revoked
        entitled = method == "POST" and right_origin and right_host and (by_session or by_token)
        query = urlencode(self._sent(), errors="replace").encode() if draw.random() < 0.5 else b""
        return Request(method, path, query, tuple(headers), body, entitled, actor.name)

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
        """Whether the actor's role permits any change by this address."""
        least = LEAST.get(path.rpartition("/")[2], Role.VIEWER if path == "/sign-out" else Role.OPERATOR)
        return actor.person is not None and actor.person.role.includes(least)

    def _add_cookie(self, headers: list[tuple[bytes, bytes]], actor: Actor) -> bool:
        draw = self._random
        if actor.person is not None and draw.random() < 0.8:
            headers.append((b"cookie", f"{actor.cookie}={actor.person.secret}".encode()))
            return True
        if draw.random() < 0.3:
            name = actor.cookie or COOKIE
            broken = (f"{name}=", f"{name}={'x' * 9000}", "\xff\xfe", "=;=;=", f"{name}=\x00")
            headers.append((b"cookie", self._bytes(broken)))
        return False

    def _sent(self) -> dict[str, str]:
        draw = self._random
        sent = {draw.choice(FIELDS): draw.choice(WORDS) for _ in range(draw.randrange(5))}
        # the open question, so that the program reads the answer
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
                whole = draw.choice(BODIES)
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
            accepted = ("application/json", "text/html", "text/event-stream", "\xff")
            headers.append((b"accept", self._bytes(accepted)))
        for _ in range(draw.choice((0, 0, 0, 50))):
            headers.append((b"x-" + draw.randbytes(3).hex().encode(), draw.randbytes(20)))

    def _bytes(self, texts: Sequence[str]) -> bytes:
        return self._random.choice(texts).encode("latin-1", "replace")


# --- the panel ----------------------------------------------------------------------------------------


RECORD = Path(__file__).parents[1] / "data" / "records"
MAY_CHANGE = {"holding.jsonl", "answers.jsonl", "control.jsonl", ".holding.jsonl.lock"}
"""Files in a run's folder that an entitled person may change."""

QUESTION = Prompt(
    "1@1", PromptKind.ANGLE, "Turn to 120° 30′ 15″",
    action={
        "do": "turn", "target_rad": math.radians(120 + 30.25 / 60), "tolerance_rad": 1e-3, "direction": 1,
    },
)  # fmt: skip
Tree = dict[str, tuple[int, int]]


@dataclass
class Outcome:
    """The outcome of the requests.

    `wrong` are sentences on faults, `statuses` counts by status.
    """

    requests: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    entitled: int = 0
    wrong: list[str] = field(default_factory=list)


class Place:
    """A folder of runs and a secret file outside it, with one run in progress and persons of each role."""

    def __init__(self, folder: Path) -> None:
        self.outside = folder / "outside"
        shutil.copytree(RECORD / "finished", self.outside)
        (self.outside / "report.html").write_text(SECRET)
        (self.outside / "secret").write_text(SECRET)
        self.runs = folder / "runs"
        shutil.copytree(RECORD / "finished", self.runs / "done")
        shutil.copytree(RECORD / "interrupted", self.runs / "alive")
        shutil.copytree(RECORD / "interrupted", self.runs / "<script>\x1b[2J ü")
        (self.runs / "linked").symlink_to(self.outside)
        (self.runs / "done" / "diagnose.html").symlink_to(self.outside / "secret")
        (self.runs / "alive" / "verify.json").write_text('{"passed": [], "limit_g": "x", "points": {}}')
        self.app = make_app(Settings(self.runs))
        access, cookie = Access(self.runs / STATE), Settings(self.runs).cookie
        self.actors = [Actor("stranger", None, None, cookie)]
        for role in Role:
            token = access.new_token(f"the {role}", role)
            person = access.sign_in_by_token(token)
            self.actors.append(Actor(f"the {role}", person, token, cookie))
        access.revoke("the viewer")
        revoked = self.actors[1]
        self.actors[1] = Actor("revoked", revoked.person, revoked.token, cookie, revoked=True)
        token = access.new_token("looker", Role.VIEWER)
        self.actors.append(Actor("looker", access.sign_in_by_token(token), token, cookie))
        # a program carries the run out, and asks a question
        self.record, history = Record.reopen(self.runs / "alive", utc_now)
        bench_s = history.events.last_s
        self.record.append("run_resumed", bench_s, step=1, instruments={})
        self.record.append("asked", bench_s, **asked_to_json(QUESTION))

    def tree(self) -> Tree:
        """Return size and time of every file that only an entitled request may change."""
        found = {}
        for path in (*self.runs.rglob("*"), *self.outside.rglob("*")):
            if path.is_file() and not path.is_symlink():
                told = path.stat()
                found[str(path)] = (told.st_size, told.st_mtime_ns)
        return found

    def allowed(self, path: str, request: Request) -> bool:
        """Whether an entitled request may change the file at `path`."""
        ended = Path(path) != self.runs / "alive" / EVENTS and request.path.endswith(("/give-up", "/wish"))
        if ended and Path(path).name == EVENTS:
            return True
        return Path(path).name in MAY_CHANGE or Path(path).is_relative_to(self.runs / STATE)

    def told(self) -> list[str]:
        """Return sentences on content that files written by entitled requests should not have."""
        wrong = []
        for line in _lines(self.runs / "alive" / CONTROL):
            if line["role"] == Role.VIEWER and line["wish"] != "stop":
                wrong.append(f"a viewer's wish was left: {line}")
        for line in _lines(self.runs / "alive" / ANSWERS):
            fits = line["id"] == QUESTION.id and not problem_with_answer(QUESTION, line["answer"])
            if line["role"] == Role.VIEWER or not fits:
                wrong.append(f"an answer was left that does not fit: {line}")
        for journal in self.runs.glob(f"*/{JOURNAL}"):
            holder = ""
            for line in _lines(journal):
                match line["did"]:
                    case "taken" if holder:
                        wrong.append(f"taken from {holder}: {line}")
                    case "granted" | "denied" | "released" if line["who"] != holder:
                        wrong.append(f"{holder} was in control: {line}")
                    case "forced" if line["role"] != Role.SUPERVISOR:
                        wrong.append(f"forced by no supervisor: {line}")
                if line["did"] in {"taken", "forced", "granted"}:
                    holder = line.get("to") or line["who"]
                elif line["did"] == "released":
                    holder = ""
        return wrong


def _lines(file: Path) -> list[dict[str, str]]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


async def send(app: Any, request: Request) -> tuple[int, bytes]:
    """Send a request to the application; for an event stream, disconnect after the first event."""
    gone = asyncio.Event()
    parts = list(request.body)
    told: list[int] = []
    body = bytearray()

    async def receive() -> dict[str, Any]:
        if parts:
            return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}
        await gone.wait()
        return {"type": "http.disconnect"}

    async def heard(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            told.append(message["status"])
        else:
            body.extend(message.get("body", b""))
            gone.set()

    await asyncio.wait_for(app(request.scope(), receive, heard), 60)
    return told[0], bytes(body)


async def fuzz(place: Place, count: int, seed: int) -> Outcome:
    """Send `count` requests and return the outcome."""
    names = sorted(run.name for run in place.runs.iterdir())
    outcome, requests = Outcome(), Requests(seed, place.actors, names)
    prepare(place.app.state.panel)
    before = place.tree()
    with mock.patch("bench.panel.launching.subprocess.Popen", side_effect=OSError(12, "no process")) as popen:
        for _ in range(count):
            request = requests.draw()
            started = popen.call_count
            try:
                status, body = await send(place.app, request)
            except Exception as error:
                outcome.wrong.append(f"{request}: {type(error).__name__}: {error}")
                continue
            outcome.requests += 1
            outcome.statuses[status] += 1
            outcome.entitled += request.entitled
            after = place.tree()
            changed = {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
            before = after
            outcome.wrong += judged(place, request, status, body, changed, started=popen.call_count - started)
    outcome.wrong += place.told()
    return outcome


def judged(
    place: Place, request: Request, status: int, body: bytes, changed: set[str], *, started: int
) -> list[str]:
    """Return sentences on faults in the answer to a request, and in the changes that it made."""
    wrong = []
    if status >= 500:
        wrong.append(f"{request}: answered {status}: {body[:200]!r}")
    if SECRET.encode() in body:
        wrong.append(f"{request}: showed what lies outside")
    if b"<script>\x1b" in body or b"\x1b" in body:
        wrong.append(f"{request}: a name acts on the page")
    # a new lock file does not count as a change
    changed = {path for path in changed if not path.endswith(".lock")}
    if (changed or started) and not request.entitled:
        done = f"changed {sorted(changed)}, started {started}"
        wrong.append(f"{request}: {done} without the right to ({status})")
    if any(not place.allowed(path, request) for path in changed):
        wrong.append(f"{request}: changed {sorted(changed)} ({status})")
    if request.method in CHANGES and not request.entitled and status < 300:
        wrong.append(f"{request}: answered {status} without the right to")
    return wrong
