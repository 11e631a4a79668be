"""How long the panel takes for each of its pages, over a folder of many runs.

`python -m benchmarks.panel_pages --runs 1000` carries out one dry run, copies it so many times, begins a real panel
over them and asks for each page `--times` times, as a browser does. The table of runs is asked for once before the
panel has read them, and then when it has.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx

from bench.panel.access import Access, Role
from bench.panel.launching import BENCH
from bench.panel.serving import begin_panel, url_of
from bench.panel.settings import STATE

PAGES = (
    "/", "/?search=unit-07&state=finished", "/start", "/sign-in", "/runs/unit-0001/", "/runs/unit-0001/verdict",
    "/runs/unit-0001/report", "/runs/unit-0001/figures/residuals",
)  # fmt: skip


def many(runs: Path, count: int) -> None:
    """Make one run, and the folder of so many with its files."""
    options = ["--dry-run", "--name=base", f"--runs={runs.parent}"]
    command = [sys.executable, *BENCH, "run", "calibration", *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - our own
    for number in range(count):
        folder = runs / f"unit-{number:04d}"
        folder.mkdir(parents=True)
        for file in (runs.parent / "base").iterdir():
            os.link(file, folder / file.name)


def seconds(client: httpx.Client, page: str) -> float:
    """Return how long a page takes, s."""
    begun = time.perf_counter()
    client.get(page).raise_for_status()
    return time.perf_counter() - begun


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--runs", type=int, default=1000)
    options.add_argument("--times", type=int, default=9)
    asked = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        runs = Path(folder) / "runs"
        many(runs, asked.runs)
        token = Access(runs / STATE).new_token("anna", Role.OPERATOR)
        panel = begin_panel(runs, [0])
        try:
            with httpx.Client(base_url=url_of(runs), headers={"origin": url_of(runs)}, timeout=60) as client:
                client.post("/sign-in", data={"token": token})
                print(f"{asked.runs} runs; / before they are read: {seconds(client, '/') * 1e3:.0f} ms")
                while "not read yet" in client.get("/").text:
                    time.sleep(1.0)
                for page in PAGES:
                    taken = [seconds(client, page) * 1e3 for _ in range(asked.times)]
                    print(f"{page:40} median {statistics.median(taken):6.0f} ms, worst {max(taken):6.0f} ms")
        finally:
            panel.process.kill()
            panel.process.wait()


if __name__ == "__main__":
    main()
