"""A head that an encoder reads: through the panel a person mounts the block, and presses nothing for a reading."""

import math
import time

import pytest

from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.model import ForwardModel
from bench.run.assembly.served import served_bench
from sim.wires.server import TERMINALS
from tests.support.browser_runs import Begun, until
from tests.support.panel_client import Browser

PROCEDURE = """\
procedure: live
reading: {samples: 2, nplc: 1, settle: 1 s}
steps:
  - installation: {label: 2, steps: [{turn: {angles: [10 deg, 30 deg]}}]}
"""
READ = {"read_temperature": "23"}


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "two.yaml").write_text(PROCEDURE, "utf-8")
    return tmp_path / "runs"


def carried_out(runs, *more):
    """Carry out the procedure, answering in the panel whatever is not a turn; return the run's readings."""
    anna = Browser(runs, "anna")
    run = Begun(runs, "one", str(runs.with_name("two.yaml")), "folder", more=more)
    try:
        run.wait_for_events()
        until(lambda: anna.ask("/runs/one/control", do="take")[0] == 200 or run.process.poll() is not None)
        answered = set()
        while run.process.poll() is None:
            for asked in run.of_type("asked"):
                if asked["action"]["do"] != "turn" and asked["id"] not in answered:
                    text = READ.get(asked["action"]["do"], "yes")
                    if anna.ask("/runs/one/answer", id=asked["id"], text=text)[0] == 200:
                        answered.add(asked["id"])
            time.sleep(0.1)
        status, said = run.ended()
        assert status == 0, said
        turns = {asked["id"] for asked in run.of_type("asked") if asked["action"]["do"] == "turn"}
        assert {event["by"] for event in run.of_type("answered") if event["id"] in turns} == {"encoder"}
        return [event["reading"] for event in run.events() if "reading" in event]
    finally:
        run.close()


@pytest.mark.slow
@pytest.mark.skipif(not TERMINALS, reason="this system has no pseudo-terminals")
def test_over_real_wires_simulated_hands_turn_and_the_encoder_answers(runs):
    shipped = find_bench("bench-encoder")
    bench = load_bench(shipped)
    told = []
    model = ForwardModel(bench.installation_models())
    with served_bench(bench, model, 1, hands=runs, tell=told.append) as served:
        text = shipped.read_text("utf-8").replace("settle: 2 s", "settle: 0.5 s")
        for number, one in enumerate(served.instruments):
            text = text.replace(f"/dev/ttyUSB{number}:", f"{one['pty']}:")
        runs.with_name("wired.yaml").write_text(text, "utf-8")
        readings = carried_out(runs, "--bench", str(runs.with_name("wired.yaml")))
    assert [round(reading["angle_deg"], 3) for reading in readings] == [10.0, 30.0]
    turned = ["turned the head to 10°", "turned the head to 30°"]
    assert told == ["mount: done", "read temperature: 23.00", *turned]
    x_g = [reading["mean"][0] / -2.14 for reading in readings]
    assert x_g == pytest.approx([-math.sin(math.radians(angle)) for angle in (10, 30)], abs=2e-3)
    assert [reading["mean"][2] / -2.14 for reading in readings] == pytest.approx([0.0, 0.0], abs=2e-3)
