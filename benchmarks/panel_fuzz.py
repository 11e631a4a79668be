"""The panel under requests that nobody at it would send: methods, paths, headers, bodies, tokens, origins, sizes.

`python -m benchmarks.panel_fuzz --requests 10000 --seed 1` sends them to the application itself, past any server
that would tidy them, and tells of each that was answered with 5xx, changed a file without the right to or showed
what lies outside the folder of runs, how memory grew, and how long the slowest took. `--socket 500` sends raw bytes
to a real server beside, which must log no traceback.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import logging
import math
import shutil
import socket
import tempfile
import time
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

from bench.panel import connections
from bench.panel.access import Access, Role
from bench.panel.app import make_app, prepare
from bench.panel.holding import JOURNAL
from bench.panel.serving import config_of
from bench.panel.settings import STATE, Settings
from bench.run.events import EVENTS
from bench.run.person import ANSWERS, CONTROL, asked_to_json, problem_with_answer
from bench.run.record import Record
from benchmarks.panel_requests import CHANGES, HOST, SECRET, Actor, Request, Requests
from drivers.clock import utc_now
from drivers.person import Prompt, PromptKind

RECORD = Path(__file__).parents[1] / "tests" / "data" / "records"
MAY_CHANGE = {"holding.jsonl", "answers.jsonl", "control.jsonl", ".holding.jsonl.lock"}
"""What a person with the right to may bring about in a run's folder."""

QUESTION = Prompt(
    id="1@1",
    kind=PromptKind.ANGLE,
    text="Turn to 120° 30′ 15″",
    action={
        "do": "turn",
        "target_rad": math.radians(120 + 30.25 / 60),
        "tolerance_rad": 1e-3,
        "direction": 1,
    },
)

TOLD = 5
"""So many of the slowest requests are told."""

Tree = dict[str, tuple[int, int]]


@dataclass
class Outcome:
    """What became of the requests: `wrong` are sentences, `statuses` counts, `grown` bytes from a quarter on.

    `took` are the requests with the seconds that each took and the CPU time of it, s.
    """

    requests: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    entitled: int = 0
    wrong: list[str] = field(default_factory=list)
    grown: int = 0
    took: list[tuple[float, float, str]] = field(default_factory=list)

    def times(self) -> Iterator[str]:
        """Yield what the requests took: the median, and those that took longest, by the clock and of CPU time."""
        for name, by_clock in (("of CPU", False), ("by the clock", True)):
            ranked = sorted(((wall if by_clock else cpu), wall, cpu, sent) for wall, cpu, sent in self.took)
            yield f"{name}: median {1e3 * ranked[len(ranked) // 2][0]:.1f} ms, longest"
            for _, wall, cpu, sent in ranked[: -TOLD - 1 : -1]:
                yield f"  {1e3 * wall:.0f} ms ({1e3 * cpu:.0f} ms of CPU) {sent}"


class Place:
    """A folder of runs with a secret beside it, one run that is carried out, and persons of each role."""

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
        self.record, history = Record.reopen(
            self.runs / "alive", utc_now
        )  # somebody carries it out, and asks
        bench_s = history.events[-1].bench_s
        self.record.append("run_resumed", bench_s, step=1, instruments={})
        self.record.append("asked", bench_s, **asked_to_json(QUESTION))

    def tree(self) -> Tree:
        """Return size and time of every file that no request may change but by right."""
        found = {}
        for path in (*self.runs.rglob("*"), *self.outside.rglob("*")):
            if path.is_file() and not path.is_symlink():
                told = path.stat()
                found[str(path)] = (told.st_size, told.st_mtime_ns)
        return found

    def allowed(self, path: str, request: Request) -> bool:
        """Whether a request with the right to may change this file."""
        ended = Path(path) != self.runs / "alive" / EVENTS and request.path.endswith(("/give-up", "/wish"))
        if ended and Path(path).name == EVENTS:
            return True
        return Path(path).name in MAY_CHANGE or Path(path).is_relative_to(self.runs / STATE)

    def told(self) -> list[str]:
        """Say what the files that were written by right tell that nobody had the right to."""
        wrong = []
        for line in _lines(self.runs / "alive" / CONTROL):
            if line["role"] == Role.VIEWER and line["wish"] != "stop":
                wrong.append(f"a viewer's wish was left: {line}")
        for line in _lines(self.runs / "alive" / ANSWERS):
            if (
                line["role"] == Role.VIEWER
                or line["id"] != QUESTION.id
                or problem_with_answer(QUESTION, line["answer"])
            ):
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
    """Send a request to the application; who has heard the first of a stream goes away."""
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
    """Send `count` requests and return what became of them."""
    outcome, requests = (
        Outcome(),
        Requests(seed, place.actors, sorted(run.name for run in place.runs.iterdir())),
    )
    prepare(place.app.state.panel)
    before, quarter = place.tree(), 0
    tracemalloc.start()
    with mock.patch("bench.panel.launching.subprocess.Popen", side_effect=OSError(12, "no process")) as popen:
        for number in range(count):
            if number == count // 4:
                gc.collect()
                quarter = tracemalloc.get_traced_memory()[0]
            request = requests.draw()
            started = popen.call_count
            begun = time.perf_counter(), time.process_time()
            try:
                status, body = await send(place.app, request)
            except Exception as error:
                outcome.wrong.append(f"{request}: {type(error).__name__}: {error}")
                continue
            took = time.perf_counter() - begun[0], time.process_time() - begun[1]
            outcome.took.append((*took, str(request)))
            outcome.requests += 1
            outcome.statuses[status] += 1
            outcome.entitled += request.entitled
            after = place.tree()
            changed = {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
            before = after
            outcome.wrong += judged(place, request, status, body, changed, started=popen.call_count - started)
    outcome.wrong += place.told()
    gc.collect()
    outcome.grown = tracemalloc.get_traced_memory()[0] - quarter
    tracemalloc.stop()
    return outcome


def judged(
    place: Place, request: Request, status: int, body: bytes, changed: set[str], *, started: int
) -> list[str]:
    """Say what is wrong with how a request was answered, and with what it changed."""
    wrong = []
    if status >= 500:
        wrong.append(f"{request}: answered {status}: {body[:200]!r}")
    if SECRET.encode() in body:
        wrong.append(f"{request}: showed what lies outside")
    if b"<script>\x1b" in body or b"\x1b" in body:
        wrong.append(f"{request}: a name acts on the page")
    # a lock that is made where there was none is no change of anything
    changed = {path for path in changed if not path.endswith(".lock")}
    if (changed or started) and not request.entitled:
        wrong.append(
            f"{request}: changed {sorted(changed)}, started {started} without the right to ({status})"
        )
    if any(not place.allowed(path, request) for path in changed):
        wrong.append(f"{request}: changed {sorted(changed)} ({status})")
    if request.method in CHANGES and not request.entitled and status < 300:
        wrong.append(f"{request}: answered {status} without the right to")
    return wrong


async def raw(port: int, count: int, seed: int) -> list[str]:
    """Send raw bytes to a real server; return what is wrong with its replies."""
    requests, wrong = Requests(seed, [Actor("stranger", None, None)], ["done"]), []
    for _ in range(count):
        sent = requests.raw(HOST)
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(sent)
        try:
            await writer.drain()
            reply = await asyncio.wait_for(reader.read(4096), 10)
        except (ConnectionError, TimeoutError) as error:
            reply = f"({type(error).__name__})".encode()
        writer.close()
        if reply.startswith(b"HTTP/1.1 5"):
            wrong.append(f"{sent[:120]!r}: {reply[:60]!r}")
    return wrong


async def served(place: Place, count: int, seed: int) -> list[str]:
    """Send raw bytes to the panel behind the server that it comes with."""
    import uvicorn

    logged: list[logging.LogRecord] = []
    listener = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(config_of(place.app))
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    while not server.started:
        await asyncio.sleep(0.05)
    port = listener.getsockname()[1]
    try:
        with (
            mock.patch.object(connections, "REQUEST_S", 0.2),
            mock.patch.object(connections.LOG, "callHandlers", logged.append),
        ):
            wrong = await raw(port, count, seed)
    finally:
        server.should_exit = True
        await serving
    return wrong + [f"logged: {one.getMessage()}" for one in logged if one.levelno > logging.WARNING]


def main() -> None:
    """Send the requests and print what became of them; exit status 1 where anything is wrong."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--requests", type=int, default=10_000)
    options.add_argument("--socket", type=int, default=500)
    options.add_argument("--seed", type=int, default=1)
    asked = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Place(Path(folder))
        outcome = asyncio.run(fuzz(place, asked.requests, asked.seed))
        wrong = outcome.wrong + asyncio.run(served(place, asked.socket, asked.seed))
    print(f"{outcome.requests} requests, {outcome.entitled} with the right to; {asked.socket} raw ones")
    print("statuses: " + ", ".join(f"{status}: {n}" for status, n in sorted(outcome.statuses.items())))
    print("\n".join(outcome.times()))
    print(f"memory since a quarter of them: {outcome.grown / 1e6:+.2f} MB")
    for sentence in wrong[:20]:
        print(f"WRONG {sentence}")
    print(f"{len(wrong)} answered wrongly")
    raise SystemExit(1 if wrong else 0)


if __name__ == "__main__":
    main()
