"""Measure a calibration by panel in Chromium: keys and clicks, delay of live values, duration of live reads.

    python -m benchmarks.panel_evening keys        # a whole 'calibration', typed, then read by an encoder
    python -m benchmarks.panel_evening live        # meters of `bench simulate` over TCP, in real time

`keys` types each reading as its deviation from the commanded angle, and counts the keys and clicks sent to the
browser. With an encoder, simulated hands turn the head, and a person answers only the mountings and the
thermometer. `live` reads the age of each live value on the screen. It then measures the time from a person's answer
to the end of the reading, alternately with and without live reads. That no reading changes is tested in `pytest
tests/run/test_live.py`.
"""

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from datetime import datetime
from itertools import product
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any, Final

from bench.config.shipped import find_bench
from benchmarks.campaign import arguments
from tests.support.browser_runs import PROGRAM, Begun, prompt_of, simulating, typed_for
from tests.support.browsers import find_chromium
from tests.support.served_panel import ServedPanel, served

NO_LOOKS: Final = f"import bench.run.live as l; l.LiveSignals.look = lambda self: None; {PROGRAM}"
"""Program code without live reads."""

PROCEDURE: Final = """\
procedure: live
reading: {samples: 10, nplc: 1, settle: 1 s}
steps:
  - installation: {label: 1, steps: [{turn: {angles: {from: 0 deg, step: 15 deg, count: 20}}}]}
"""

AGES: Final = """() => { window.ages = []; const live = document.getElementById('live');
  new MutationObserver(() => requestAnimationFrame(() => {
    if (live.dataset.shown) ages.push(Date.now() - Date.parse(live.dataset.shown)); }))
  .observe(live, {attributes: true, attributeFilter: ['data-shown']}); }"""


class CountingPerson:
    """A simulated person at the page of a run who counts keys and clicks, and clicks only if no key works."""

    def __init__(self, page: Any) -> None:
        self.page, self.readings = page, 0
        self.keys: dict[str, list[int]] = {"turn": [], "else": []}
        self.clicks = {"turn": 0, "else": 0}

    def answer(self, asked: dict[str, Any], turn: int) -> None:
        """Answer the question on the page."""
        what = "turn" if asked["action"]["do"] == "turn" else "else"
        if asked["action"].get("hands_free"):
            return
        if not self.page.is_visible("#typed"):
            self.page.click("#buttons button >> nth=0")
            self.clicks[what] += 1
            return
        typed = f'+{turn % 10}"' if what == "turn" else typed_for(asked, turn)
        self.page.keyboard.type(typed)  # the page has put the focus into the field
        self.page.keyboard.press("Enter")
        self.keys[what].append(len(typed) + 1)


@contextlib.contextmanager
def signed_in(panel: ServedPanel) -> Iterator[Any]:
    """Yield a browser page in which an operator is signed in."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1024, "height": 768})
        page.set_default_timeout(300_000)
        panel.sign_in(page)
        yield page
        browser.close()


def keys(bench: str) -> CountingPerson:
    """Carry out a whole practice calibration in the panel; return the person with the counts."""
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as panel, signed_in(panel) as page:
        run = Begun(Path(folder), "run", "calibration", "folder", more=("--dry-run", "--bench", bench))
        return carried_out(run, panel, page)


def carried_out(run: Begun, panel: ServedPanel, page: Any, wait_s: float = 0.0) -> CountingPerson:
    """Answer each question of a run on its page after `wait_s`; return the person with the counts."""
    try:
        run.wait_for_events()
        page.goto(f"{panel.url}/runs/{run.name}/")
        page.click("text=Take control")
        page.evaluate(AGES)
        person, asked_id, number = CountingPerson(page), "", 0
        while asked_id := prompt_of(page, asked_id):
            time.sleep(wait_s)
            person.answer(next(asked for asked in run.of_type("asked") if asked["id"] == asked_id), number)
            number += 1
        status, said = run.ended()
        if status not in {0, 1}:
            raise SystemExit(said)
        person.readings = sum("reading" in event for event in run.events())
        return person
    finally:
        run.close()


def reading_times_s(run: Begun) -> list[float]:
    """Return the times from the answer to each turn to the end of its reading, s."""
    times, answered = [], None
    for event in run.events():
        at = datetime.fromisoformat(event["time"]).timestamp()
        if event["type"] == "answered":
            answered = at
        elif "reading" in event and answered is not None:
            times.append(at - answered)
            answered = None
    return times


def live(turns: int) -> None:
    """Print the age of live values on the screen, and the time of readings with and without live reads."""
    ages: list[float] = []
    times: dict[str, list[float]] = {"with": [], "without": []}
    with (
        tempfile.TemporaryDirectory() as name,
        served(Path(name) / "runs") as panel,
        signed_in(panel) as page,
    ):
        folder = Path(name)
        os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        with simulating("bench-lan", folder) as ready:
            text = find_bench("bench-lan").read_text("utf-8")
            for number, one in enumerate(ready["instruments"]):
                host, port = one["tcp"].split(":")
                text = text.replace(f"TCPIP0::192.0.2.{22 + number}::5025", f"TCPIP0::{host}::{port}")
            bench = folder / "bench.yaml"
            bench.write_text(text, "utf-8")
            (folder / "live.yaml").write_text(PROCEDURE, "utf-8")
            of_bench = ("--bench", str(bench))
            for turn, (what, program) in product(range(turns), (("with", PROGRAM), ("without", NO_LOOKS))):
                run = Begun(
                    panel.runs,
                    f"{what}-{turn}",
                    str(folder / "live.yaml"),
                    "folder",
                    more=of_bench,
                    program=program,
                )
                carried_out(run, panel, page, 1.0)
                times[what] += reading_times_s(run)
                ages += page.evaluate("window.ages")
    ages.sort()
    print(
        f"live value on the screen after the meters' answer: median {median(ages):.0f} ms, "
        f"99 % within {ages[int(0.99 * len(ages))]:.0f} ms, longest {ages[-1]:.0f} ms, {len(ages)} values"
    )
    for what, found in times.items():
        error = stdev(found) / len(found) ** 0.5
        print(
            f"from answer to reading, {what} live reads: {mean(found):.4f} ± {error:.4f} s, {len(found)} readings"
        )


def main() -> None:
    asked = arguments(__doc__, what={"positional": True, "choices": ("keys", "live")}, turns=3)
    if asked.what == "live":
        live(asked.turns)
        return
    for bench in ("bench-lan", "bench-encoder"):
        person = keys(bench)
        typed = person.keys["turn"]
        print(
            f"{bench}: {person.readings} readings, {len(typed)} typed, at most {max(typed, default=0)} keys each; "
            f"clicks: {person.clicks['turn']} for readings, {person.clicks['else']} for mountings",
            flush=True,
        )


if __name__ == "__main__":
    main()
