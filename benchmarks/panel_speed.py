"""What the panel costs and how soon it shows: disk to screen, beside a run, with a long record, at first.

Four figures, each with what it is held to:

- event on disk to pixels: a run's events are written one after the other; a browser says when it has drawn each
  (the frame after the one in which it was changed). 95 % within 300 ms;
- 20 viewers: CPU time and duration of a dry run per reading, alone and with 20 who look at it, in turns. Less than
  5 % more;
- a run of 100,000 events: from asking for its page to the page, and the peak of the server's memory. 2 s, 200 MB;
- first paint of each page in a browser, as the browser tells it. 0.5 s.

    python -m benchmarks.panel_speed
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from bench.panel.access import Role
from bench.run.events import EVENTS
from bench.run.folder import Run
from bench.run.record import Record
from benchmarks.campaign import arguments
from benchmarks.record_size import make_record
from drivers.clock import utc_now
from tests.support.browsers import find_chromium, what_is_missing
from tests.support.served_panel import ServedPanel

SHOWN_MS, VIEWERS_SHARE, OPENED_S, OPENED_MB, PAINTED_S = 300.0, 0.05, 2.0, 200.0, 0.5
VIEWERS: Final = 20
READING_S: Final = 4.1
"""Ten samples of ten power-line cycles with autozero, as the paper's procedure reads on 50 Hz mains."""
PACE_S: Final = 0.15
"""Between two events that are timed; a bench takes longer over each."""

SEEN: Final = """() => {
    const live = document.getElementById("live"), seen = window.seen = {};
    new MutationObserver(() => {
        const events = live.dataset.events;
        const drawn = () => { seen[events] ??= performance.timeOrigin + performance.now(); };
        requestAnimationFrame(() => setTimeout(drawn, 0));
    }).observe(live, { attributes: true, attributeFilter: ["data-events"] });
}"""


@contextmanager
def served_apart(runs: Path) -> Iterator[tuple[ServedPanel, int]]:
    """Serve a panel in a process of its own; return it with the number of the process."""
    context = multiprocessing.get_context("spawn")
    told: Any = context.Queue()
    process = context.Process(target=_serve, args=(runs, told), daemon=True)
    process.start()
    try:
        yield ServedPanel(runs, told.get(timeout=120.0)), process.pid or 0
    finally:
        process.kill()
        process.join()


def _serve(runs: Path, told: Any) -> None:
    from tests.support.served_panel import served

    with served(runs) as panel:
        told.put(panel.port)
        threading.Event().wait()


def signed_in(url: str, token: str) -> urllib.request.OpenerDirector:
    """Return what asks the panel as the person of a token."""
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    request = urllib.request.Request(f"{url}/sign-in", f"token={token}".encode(), {"Origin": url})  # noqa: S310
    opener.open(request).read()
    return opener


# --- from the disk to the screen ---------------------------------------------------------------------


def to_pixels(browser: Any, count: int) -> list[float]:
    """Return after how many ms each event was on the screen, from when it was on the disk."""
    from bench.run.record import parse_line

    with tempfile.TemporaryDirectory() as name:
        runs = Path(name)
        _timed_run(runs, "source", lambda name: nullcontext())
        lines = (runs / "source" / EVENTS).read_bytes().splitlines()
        first = len(lines) // 3
        shutil.copytree(runs / "source", runs / "going")
        (runs / "going" / EVENTS).write_bytes(b"\n".join(lines[:first]) + b"\n")
        record, _ = Record.reopen(runs / "going", utc_now)
        with served_apart(runs) as (panel, _):
            page = browser.new_page()
            panel.sign_in(page)
            page.goto(f"{panel.url}/runs/going/")
            page.wait_for_selector("#plots[data-newest]")
            page.wait_for_timeout(2000)
            page.evaluate(SEEN)
            written: dict[int, float] = {}
            for line in lines[first : first + count]:
                event, _ = parse_line(line)
                number = record.append(event.type, event.bench_s, **event.data).number
                written[number] = time.time() * 1e3
                time.sleep(PACE_S)  # a real wire, a real browser
            page.wait_for_timeout(1500)
            seen = {int(number): at for number, at in page.evaluate("window.seen").items()}
            page.close()
        record.close()
    # what was drawn together with a later event was on the screen with that one
    return [
        min(at for later, at in seen.items() if later >= number) - at_disk
        for number, at_disk in written.items()
    ]


# --- beside a run -------------------------------------------------------------------------------------


def beside_viewers(rounds: int) -> list[tuple[float, float, float, float]]:
    """Return CPU time and duration of a run per reading, ms: alone, then with viewers; a row a round."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        runs = Path(name)
        with served_apart(runs) as (panel, _):
            for number in range(rounds):
                alone = _timed_run(runs, f"alone-{number}", lambda name: nullcontext())
                watched = _timed_run(runs, f"watched-{number}", lambda name: _viewers(panel, name))
                rows.append((*alone, *watched))
    return rows


def _timed_run(
    runs: Path, name: str, beside: Callable[[str], AbstractContextManager[None]]
) -> tuple[float, float]:
    """Carry out a dry run in a process of its own; return CPU time and duration per reading, ms."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_carry_out, args=(runs, name, theirs))
    process.start()
    ours.recv()  # the record is there
    with beside(name):
        ours.send("go on")
        readings, cpu_s, lasted_s = ours.recv()
    process.join()
    return 1e3 * cpu_s / readings, 1e3 * lasted_s / readings


def _carry_out(runs: Path, name: str, told: Any) -> None:
    from rich.console import Console

    from bench.services.execution import carry_out, new_run
    from bench.services.requests.measuring import RunRequest

    new = new_run(RunRequest("paper", None, runs=runs, dry_run=True, seed=1, name=name))
    record = new.record()
    told.send("begun")
    told.recv()
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        begun_s, begun_cpu_s = time.perf_counter(), time.process_time()
        carry_out(Run(new.folder), record, Console(file=nowhere))
        lasted = time.process_time() - begun_cpu_s, time.perf_counter() - begun_s
    told.send((len(Run(new.folder).history.readings), *lasted))


@contextmanager
def _viewers(panel: ServedPanel, name: str) -> Iterator[None]:
    """Let viewers look at a run, each over a connection of its own, from a process of their own."""
    context = multiprocessing.get_context("spawn")
    seen: Any = context.Queue()
    token = panel.token("vera", Role.VIEWER)
    process = context.Process(target=_look, args=(panel.url, token, name, seen), daemon=True)
    process.start()
    for _ in range(VIEWERS):
        seen.get(timeout=120.0)
    try:
        yield
    finally:
        process.kill()
        process.join()


def _look(url: str, token: str, name: str, seen: Any) -> None:
    opener = signed_in(url, token)

    def follow() -> None:
        with opener.open(f"{url}/runs/{name}/stream") as stream:
            for number, _ in enumerate(stream):
                if number == 0:
                    seen.put(1)

    threads = [threading.Thread(target=follow, daemon=True) for _ in range(VIEWERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


# --- a long record ------------------------------------------------------------------------------------


def opened_long(events: int) -> tuple[float, float, float]:
    """Return how long the page of a long run takes, s, the peak of the server's memory, MB, and a bare parse, s."""
    with tempfile.TemporaryDirectory() as name:
        runs = Path(name)
        make_record(runs, events)
        with served_apart(runs) as (panel, process):
            opener = signed_in(panel.url, panel.token("anna", Role.OPERATOR))
            while b"not read yet" in opener.open(f"{panel.url}/").read():
                time.sleep(0.5)  # the table of runs is read once while a panel begins
            begun_s = time.monotonic()
            opener.open(f"{panel.url}/runs/long/").read()
            lasted_s = time.monotonic() - begun_s
            with opener.open(f"{panel.url}/runs/long/stream") as stream:
                while not stream.readline().startswith(b"event: points"):
                    pass
            begun_parse_s = time.monotonic()
            with (runs / "long" / EVENTS).open("rb") as file:
                for line in file:
                    json.loads(line)
            parse_s = time.monotonic() - begun_parse_s
            status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
        peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
        return lasted_s, int(peak.split()[1]) / 1024, parse_s


# --- first paint --------------------------------------------------------------------------------------


def first_paints(browser: Any) -> dict[str, float]:
    """Return after how many s each page has something on the screen, the slowest of five times."""
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        runs = Path(name)
        _timed_run(runs, "done", lambda name: nullcontext())
        with served_apart(runs) as (panel, _):
            page = browser.new_page()
            panel.sign_in(page)
            for path in ("/", "/start", "/runs/done/", "/runs/done/verdict"):
                page.goto(panel.url + path)  # what the server reads once is read
                times = []
                for _ in range(5):
                    page.goto(panel.url + path)
                    page.wait_for_function(PAINTED)
                    times.append(page.evaluate(PAINT) / 1e3)
                found[path] = max(times)
            page.close()
    return found


PAINTED: Final = """() => performance.getEntriesByName("first-contentful-paint").length > 0"""
PAINT: Final = """() => {
    const found = performance.getEntriesByName("first-contentful-paint");
    return found.length ? found[0].startTime : null;
}"""


def main() -> None:
    given = arguments(
        __doc__,
        events=(100, "events timed on their way to the screen"),
        rounds=(5, "runs alone and watched, in turns"),
        long=(100000, "events of the long run"),
    )
    if missing := what_is_missing():
        raise SystemExit(missing)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        late = to_pixels(browser, given.events)
        share = float(np.mean(np.array(late) < SHOWN_MS))
        print(
            f"event on disk to pixels: median {median(late):.0f} ms, 95 % {np.percentile(late, 95):.0f} ms, "
            f"longest {max(late):.0f} ms of {len(late)}; within {SHOWN_MS:.0f} ms: {share:.0%}"
        )
        for path, seconds in first_paints(browser).items():
            print(f"first paint of {path}: {seconds * 1e3:.0f} ms at most (limit {PAINTED_S * 1e3:.0f} ms)")
        browser.close()
    rows = np.array(beside_viewers(given.rounds))
    cpu, lasted, watched_cpu, watched = np.median(rows, axis=0)
    more = watched_cpu / cpu - 1.0
    print(f"per reading, alone: {cpu:.1f} ms CPU, {lasted:.1f} ms")
    print(f"per reading, with {VIEWERS} viewers: {watched_cpu:.1f} ms CPU, {watched:.1f} ms")
    print(f"{VIEWERS} viewers cost the runner {more:+.1%} of CPU time (limit {VIEWERS_SHARE:.0%})")
    longer_s = (watched - lasted) / 1e3
    print(
        f"a dry run, which waits for nothing, lasts {watched / lasted - 1.0:+.0%}; beside the {READING_S:g} s "
        f"of a reading of this procedure on a bench that is {longer_s / READING_S:+.2%}"
    )
    seconds, megabytes, parse_s = opened_long(given.long)
    print(
        f"a run of {given.long} events: its page after {seconds:.2f} s (limit {OPENED_S:g} s), the server's peak "
        f"{megabytes:.0f} MB (limit {OPENED_MB:.0f} MB); json.loads of its lines alone takes {parse_s:.2f} s here"
    )


if __name__ == "__main__":
    main()
